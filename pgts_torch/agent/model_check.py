"""What happens in an environment, held to the model that a lookahead asks about it."""

import math
import warnings
from dataclasses import dataclass
from typing import Any, Literal, final, get_args

import numpy as np
import torch

from pgts_torch.agent.frequencies import MARGINS, Frequencies
from pgts_torch.agent.ranks import Ranks
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import TabularWorld, World
from pgts_torch.errors import ModelMismatch, PgtsError
from pgts_torch.models.base import CONTRADICTED, RANDOM, ExactModel, Happened, step_text
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.tabular import TabularModel
from pgts_torch.seeding import numpy_stream

Mode = Literal["error", "warn", "off"]
"""What comes of a contradiction: it stops the training, it is said and counted, or nobody looks for it."""

_SHARE = 1 / 64
"""Of the steps that a simulator was not asked about by the lookahead it is asked about so many."""

_FALSE_ALARM = 1e-9
"""The probability that a right table is ever called wrong in a run."""

_KINDS = "steps", "starts"
"""Whose frequencies are held."""

ENOUGH = math.log(len(_KINDS) * len(MARGINS) / _FALSE_ALARM)
"""The log E from which on frequencies are called wrong: all tests of a run share the probability of a false alarm."""

_WAY_OUT = (
    "One of the two is wrong, and a lookahead would be: mend it, give another model, or train without one (depth 0 and "
    "the estimator 'sampled'); with model_check 'warn' (search.model_check) training goes on"
)


_COLUMNS = "state_TB", "action_TB", "reward_TB", "discount_TB", "next_state_TB"


@final
class ModelCheck:
    """Holds each step of the environment to its model, and their frequencies to the probabilities that it lists.

    Only models that claim to be the environment are held (`Model.exact`). Steps must be among the outcomes of positive
    probability and episodes must begin in possible states (`ExactModel.hold`): tables and dynamics are held to all
    steps, simulators to those that the lookahead has asked about already and to one in 64 of the others, drawn from a
    stream of their own. What a simulator only draws cannot be held, which is said once. Frequencies are held to tables
    (`Frequencies`); an event whose probability is off by more than 2 % is a contradiction, a smaller difference is
    said. All of this is false of a right model with a probability below 1e-9 in a run of any length.

    contradictions: how many there have been.
    model_calls: how often the model was asked for the check alone; the lookahead's calls do not include them.

    Args:
        world: whose model is held.
        mode: "error", "warn" or "off".
        is_asked: whether a lookahead asks the model; else nothing is held.
        seed: of the drawn steps.
        ranks: that train together; they stop together.
    """

    def __init__(self, world: World, *, mode: Mode, is_asked: bool, seed: int, ranks: Ranks) -> None:
        if mode not in get_args(Mode):
            raise PgtsError(f"model_check is {mode!r}; it must be one of {', '.join(map(repr, get_args(Mode)))}")
        self.mode, self.contradictions, self.model_calls = mode, 0, 0
        self._world, self._seed, self._ranks = world, seed, ranks
        model = world.model if is_asked and mode != "off" else None
        self._model = model if isinstance(model, ExactModel) else None
        self._said: list[str] = []
        self._frequencies: dict[str, Frequencies] = {}
        if isinstance(self._model, TabularModel):
            assert isinstance(world, TabularWorld)
            assert world.mdp is not None
            self._is_start_S = world.mdp.start_S.numpy() > 0
            self._frequencies["steps"] = Frequencies(self._model.frequencies())
            if world.starts_known:
                self._frequencies["starts"] = Frequencies(world.mdp.start_S.unsqueeze(0))

    @property
    def is_held(self) -> bool:
        """Whether there is a model that claims to be the environment, and it is looked at."""
        return self._model is not None

    def __call__(self, experience: Rollout, iteration: int) -> None:
        """Hold the episodes of an iteration to the model.

        Args:
            experience: of all ranks, after the lookahead from its states.
            iteration: names the stream that drawn steps come from.

        Raises:
            ModelMismatch: the environment contradicts its model, with the mode "error". In all ranks.
        """
        if self._model is None:
            return
        told = self._ranks.gather("what the model denies", lambda: self._hold(experience, iteration))
        # What is cheap is held by every rank to all steps, the rest to those of its part.
        for each in told[:1] if self._model.is_cheap else told:
            self.model_calls += each.calls
            if each.drawn:
                self._say("drawn", self._only_drawn())
            if each.denied:
                self._contradicted("steps", each.story, each.denied)
        if isinstance(self._model, TabularModel):
            self._hold_starts(experience.state_TB[0].cpu().numpy())
            self._hold_frequencies()

    def _hold(self, experience: Rollout, iteration: int) -> "_Told":
        """What comes of this rank's part of the steps; those of tables are handed to the test of their frequencies."""
        model, query_N = self._model, None
        assert model is not None
        # Tables and dynamics cut no episode off, so whether one went on says nothing about them.
        happened = _steps(experience, follows="alive_TB" if model.is_cheap else "follows_TB")
        if not model.is_cheap:
            if self._ranks.size > 1:
                mine = self._ranks.part(torch.from_numpy(np.unique(happened.state_N))).numpy()
                happened = happened.part(np.isin(happened.state_N, mine))
            random = numpy_stream(self._seed, "iteration", iteration, "model check", *self._ranks.names)
            query_N = random.random(len(happened.state_N)) < _SHARE
        steps_before = model.simulator_steps
        held_N = model.outcome_of(happened, query_N=query_N)
        calls, agrees = model.simulator_steps - steps_before, not len(held_N) or held_N.min() >= 0
        if isinstance(model, TabularModel) and self._frequencies["steps"].has_chance:
            known = slice(None) if agrees else held_N >= 0
            self._frequencies["steps"].observe(model.rows(happened)[known], held_N[known])
        if agrees:
            return _Told(calls)
        denied = np.flatnonzero(held_N == CONTRADICTED)
        story = self._denied(happened.part(denied[:1])) if len(denied) else ""
        return _Told(calls, len(denied), story, bool((held_N == RANDOM).any()))

    def _denied(self, one: Happened) -> str:
        """A step that the model denies, and what it says."""
        model = self._model
        assert model is not None
        state, action, reward, discount, next_state, follows = (column.item() for column in vars(one).values())
        happened = step_text(reward, discount, model.state_text(next_state))
        happened += ", and the episode went on" * (follows and not model.is_cheap)
        return (
            f"{self._name} contradicts its {model.kind}: {model.state_text(state)} under action {action} "
            f"gave {happened}; the {model.kind} says {model.outcomes_text(state, action)}. {_WAY_OUT}"
        )

    def _only_drawn(self) -> str:
        return (
            f"{self._name} decides some steps by chance, and its {self._kind} lists no outcomes of them: whether these "
            "steps can be, and how often, is not checked"
        )

    def _hold_starts(self, start_B: np.ndarray) -> None:
        """Whether episodes begin where the table says they can."""
        possible_B = self._is_start_S[start_B]
        if (known := self._frequencies.get("starts")) is not None and known.has_chance:
            known.observe(np.zeros_like(start_B)[possible_B], start_B[possible_B])
        if possible_B.all():
            return
        began = f"an episode began in state {start_B[~possible_B][0]}"
        if known is not None:
            rule = f"the start distribution of its {self._kind} has {self._is_start_S.sum()} states without it"
            self._contradicted("starts", f"{self._name} contradicts its {self._kind}: {began}; {rule}. {_WAY_OUT}", 1)
        else:
            self._say(
                "starts",
                f"{self._name}: {began}, in which none of the resets began that the start distribution was counted "
                "from: what is said of J speaks of other starts",
            )

    def _hold_frequencies(self) -> None:
        """Whether outcomes and starts are as frequent as the table says. The same in all ranks."""
        for what, frequencies in self._frequencies.items():
            kind, (surely, perhaps) = f"frequencies of {what}", frequencies.log_evidence
            if surely >= ENOUGH and kind not in self._said:
                self._contradicted(kind, f"{self._unlikely(what)}. {_WAY_OUT}", 1)
            elif perhaps >= ENOUGH and surely < 0:  # bets on more than the margin have lost
                self._say(kind, f"{self._unlikely(what)}; probabilities are off, but not by 2 %, as far as is known")

    def _unlikely(self, what: str) -> str:
        """What is more or less frequent than listed, in the row with most evidence of its own."""
        model = self._model
        assert isinstance(model, TabularModel)
        worst = self._frequencies[what].worst()
        if what == "starts":
            where, event = "an episode began in", model.state_text(worst.outcome)
        else:
            state, action = divmod(worst.row, model.num_actions)
            where = f"{model.state_text(state)} under action {action} gave"
            event = model.outcome_text(state, action, worst.outcome)
        return (
            f"{self._name} contradicts the probabilities of its {self._kind}: {where} {event} in {worst.happened} of "
            f"{worst.seen} cases ({worst.happened / worst.seen:.4g}); the {self._kind} says {worst.listed:.4g}"
        )

    def _contradicted(self, kind: str, story: str, count: int) -> None:
        self.contradictions += count
        if self.mode == "error":
            raise ModelMismatch(story)
        self._say(kind, story)

    def _say(self, kind: str, story: str) -> None:
        """A warning, once for each kind, from the rank that speaks for all."""
        if kind not in self._said:
            self._said.append(kind)
            if self._ranks.leads:
                warnings.warn(story, stacklevel=4)

    @property
    def _name(self) -> str:
        return env_name(self._world.env)

    @property
    def _kind(self) -> str:
        assert self._model is not None
        return self._model.kind

    def state_dict(self) -> dict[str, Any]:
        """What a later check goes on from: tensors on the CPU and plain values."""
        frequencies = {what: each.state_dict() for what, each in self._frequencies.items()}
        return {
            "contradictions": self.contradictions,
            "model_calls": self.model_calls,
            "said": list(self._said),
            "frequencies": frequencies,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave; what the saved check did not count begins anew."""
        self.contradictions, self.model_calls = state["contradictions"], state["model_calls"]
        self._said = list(state["said"])
        for what, each in self._frequencies.items():
            if what in state["frequencies"]:
                each.load_state_dict(state["frequencies"][what])


@dataclass(frozen=True)
class _Told:
    """Of the steps that a rank held to the model: how many calls it took, how many are denied, the first of them, and
    whether some are only drawn."""

    calls: int
    denied: int = 0
    story: str = ""
    drawn: bool = False


def _steps(experience: Rollout, *, follows: str) -> Happened:
    """The steps that were made, without padding; `follows` names the column that says whether the episode went on."""
    alive_V = experience.alive_TB.cpu().numpy().reshape(-1)
    columns = [getattr(experience, name).cpu().numpy().reshape(-1) for name in (*_COLUMNS, follows)]
    at = np.flatnonzero(alive_V)
    return Happened(*(columns if len(at) == len(alive_V) else [column_V[at] for column_V in columns]))
