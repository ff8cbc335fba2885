"""Checks the steps of an environment against the model that a lookahead queries."""

import math
from dataclasses import dataclass
from typing import Any, Literal, final, get_args

import numpy as np
import torch

from pgts_torch.agent.frequencies import MARGINS, Frequencies
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import World
from pgts_torch.agent.worlds import DynamicsWorld, SimulatedWorld, TabularWorld
from pgts_torch.errors import ModelMismatch, PgtsError, warn
from pgts_torch.models.adapters import methods_for
from pgts_torch.models.adapters_generic import PickledAttributes
from pgts_torch.models.exact_model import CONTRADICTED, RANDOM, ExactModel, Happened
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.tabular import TabularModel
from pgts_torch.ranks import Ranks
from pgts_torch.seeding import numpy_stream

Mode = Literal["error", "warn", "off"]
"""What a contradiction does: it stops training; it is a warning and is counted; or steps are not checked."""

_QUERY_PROB = 1 / 64
"""The probability that a simulator is queried about a step that the lookahead has not queried."""

_FALSE_ALARM = 1e-9
"""The probability that a right table is ever called wrong in a run."""

_OBSERVATION_TOLERANCE = 1e-6
"""Observations of dynamics and of their environment may differ by this times (1 + the size of a number): one of the two
may compute them in float32."""

_KINDS = "steps", "starts"
"""The probabilities that are tested: of outcomes and of start states."""

ENOUGH = math.log(len(_KINDS) * len(MARGINS) / _FALSE_ALARM)
"""The log E from which on probabilities are called wrong; `_FALSE_ALARM` is split between all tests of a run."""

_WAY_OUT = (
    "One of the two is wrong, and so would be a lookahead: correct it, give another model, or train without one (depth "
    "0 and the estimator 'sampled'); with model_check 'warn' (search.model_check) training goes on"
)


_COLUMNS = "state_TB", "action_TB", "reward_TB", "discount_TB", "next_state_TB"


@final
class ModelCheck:
    """Checks each step of the environment against its model, and how often outcomes happen against its probabilities.

    Only models that claim to be the environment are checked (`Model.exact`). Each step must be an outcome of positive
    probability (`ExactModel.outcome_of`) and each episode must begin in a possible state. Tables and dynamics are
    checked by all steps, simulators by those that the lookahead has queried already and by one in 64 of the others,
    sampled from a stream of its own. Dynamics must also show in the visited states what the environment did, within
    1e-6 (1 + its size). Where a simulator only samples outcomes its steps cannot be checked, which is a warning.
    The probabilities of tables are tested (`Frequencies`): an event whose probability is wrong by more than 0.02 is a
    contradiction, a smaller difference a warning. The probability of calling a right model wrong is below 1e-9, in a
    run of any length.

    contradictions: how many there have been.
    model_calls: the queries made for this check alone; the calls of the lookahead do not include them.

    Args:
        is_queried: whether a lookahead queries the model; else nothing is checked.
        seed: for the sample of steps.
        ranks: the processes that train together; a contradiction stops all of them.
    """

    def __init__(self, world: World, *, mode: Mode, is_queried: bool, seed: int, ranks: Ranks) -> None:
        if mode not in get_args(Mode):
            raise PgtsError(f"model_check is {mode!r}; it must be one of {', '.join(map(repr, get_args(Mode)))}")
        self.mode, self.contradictions, self.model_calls = mode, 0, 0
        self._world, self._seed, self._ranks = world, seed, ranks
        if is_queried and mode == "off" and isinstance(world, SimulatedWorld):
            _check_known(world)
        model = world.model if is_queried and mode != "off" else None
        self._model = model if isinstance(model, ExactModel) else None
        self._warned: list[str] = []
        self._frequencies: dict[str, Frequencies] = {}
        if isinstance(self._model, TabularModel):
            assert isinstance(world, TabularWorld)
            assert world.mdp is not None
            self._is_start_S = world.mdp.start_S.numpy() > 0
            self._frequencies["steps"] = Frequencies(self._model.frequencies())
            if world.starts_known:
                self._frequencies["starts"] = Frequencies(world.mdp.start_S.unsqueeze(0))

    @property
    def is_active(self) -> bool:
        """Whether steps are checked: the model claims to be the environment, is queried, and `mode` is not "off"."""
        return self._model is not None

    def __call__(self, experience: Rollout, iteration: int) -> None:
        """Check the episodes of an iteration against the model.

        Args:
            experience: those of this process, after the lookahead from its states.
            iteration: its number, which names the stream for the sample of steps.

        Raises:
            ModelMismatch: the environment contradicts its model, with the mode "error". In all ranks.
        """
        if self._model is None:
            return
        for each in self._ranks.gather("model check", lambda: self._check_steps(experience, iteration)):
            self.model_calls += each.calls
            if each.samples_only:
                self._warn(
                    "random",
                    f"{self._name} has random steps whose outcomes its {self._kind} does not enumerate: whether these "
                    "steps are possible, and with which probability, is not checked",
                )
            if each.contradictions:
                self._contradicted("steps", each.text, each.contradictions)
            if each.shown[0]:
                self._contradicted("observations", each.shown[1], each.shown[0])
        if isinstance(self._model, TabularModel):
            [start_B] = self._ranks.rows("first states", experience.start_state_N.cpu())
            self._check_starts(start_B.numpy())
            self._check_frequencies()

    def _check_steps(self, experience: Rollout, iteration: int) -> "_Result":
        """Check the steps of this rank; outcomes of tables, in all ranks, are added to the test of their
        probabilities."""
        model, query_N = self._model, None
        assert model is not None
        # Tables and dynamics have no time limit, so whether an episode went on cannot contradict them.
        happened = _steps(experience, follows="alive_TB" if model.is_cheap else "follows_TB")
        if not model.is_cheap:
            random = numpy_stream(self._seed, "iteration", iteration, "model check", *self._ranks.names)
            query_N = random.random(len(happened.state_N)) < _QUERY_PROB
        steps_before = model.simulator_steps
        outcome_N = model.outcome_of(happened, query_N=query_N)
        calls, agrees = model.simulator_steps - steps_before, not len(outcome_N) or outcome_N.min() >= 0
        if isinstance(model, TabularModel) and self._frequencies["steps"].has_chance:
            known = slice(None) if agrees else outcome_N >= 0
            rows = (torch.from_numpy(x_N[known]) for x_N in (model.rows(happened), outcome_N))
            self._frequencies["steps"].observe(*(x_N.numpy() for x_N in self._ranks.rows("outcomes", *rows)))
        shown = self._other_observations(experience)
        if agrees:
            return _Result(calls, shown=shown)
        wrong = np.flatnonzero(outcome_N == CONTRADICTED)
        text = model.contradiction(happened.part(wrong)) if len(wrong) else ""
        return _Result(calls, len(wrong), text, bool((outcome_N == RANDOM).any()), shown)

    def _other_observations(self, experience: Rollout) -> tuple[int, str]:
        """In how many visits dynamics show critics, at the leaves of a lookahead, something else than the environment;
        and the first of these in words."""
        world = self._world
        if not isinstance(world, DynamicsWorld) or world.model.transforms.observations:
            return 0, ""
        state_V, seen_VO = experience.state_TB[experience.alive_TB], experience.observation_V
        told_VO = world.observe(state_V)
        wrong_V = ((seen_VO - told_VO).abs() > _OBSERVATION_TOLERANCE * (1 + told_VO.abs())).any(-1)
        if not wrong_V.any():
            return 0, ""
        first = int(wrong_V.nonzero()[0, 0])
        return int(wrong_V.sum()), (
            f"{world.model.state_text(int(state_V[first]))} shows {seen_VO[first].tolist()}; the {self._kind} says "
            f"{told_VO[first].tolist()}"
        )

    def _check_starts(self, start_B: np.ndarray) -> None:
        """Check that episodes begin in states of positive start probability."""
        possible_B = self._is_start_S[start_B]
        if (known := self._frequencies.get("starts")) is not None and known.has_chance:
            known.observe(np.zeros_like(start_B)[possible_B], start_B[possible_B])
        if possible_B.all():
            return
        began = f"an episode began in state {start_B[~possible_B][0]}"
        if known is not None:
            rule = f"the start distribution of its {self._kind} has {self._is_start_S.sum()} states without it"
            self._contradicted("starts", f"{began}; {rule}", 1)
        else:
            self._warn(
                "starts",
                f"{self._name}: {began}, which was not among the resets that the start distribution was estimated "
                "from: values of J are for other start states",
            )

    def _check_frequencies(self) -> None:
        """Check the evidence against the probabilities of outcomes and starts. The same in all ranks."""
        for what, frequencies in self._frequencies.items():
            kind, (beyond_margin, any_error) = f"frequencies of {what}", frequencies.log_evidence
            if beyond_margin >= ENOUGH and kind not in self._warned:
                self._contradicted(kind, self._unlikely(what), 1)
            elif any_error >= ENOUGH and beyond_margin < 0:  # bets on an error beyond the margin have lost
                self._warn(kind, f"{self._name}: {self._unlikely(what)}, which is off by less than 0.02 so far")

    def _unlikely(self, what: str) -> str:
        """In words: the outcome whose frequency contradicts its probability most."""
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
            f"{where} {event} in {worst.happened} of {worst.seen} cases ({worst.happened / worst.seen:.4g}); the "
            f"{self._kind} says with probability {worst.claimed:.4g}"
        )

    def _contradicted(self, kind: str, what: str, count: int) -> None:
        """Count contradictions, and raise or warn as `mode` says."""
        self.contradictions += count
        text = f"{self._name} contradicts its {self._kind}: {what}. {_WAY_OUT}"
        if self.mode == "error":
            raise ModelMismatch(text)
        self._warn(kind, text)

    def _warn(self, kind: str, text: str) -> None:
        """Warn once for each kind, in rank 0 only."""
        if kind not in self._warned:
            self._warned.append(kind)
            if self._ranks.leads:
                warn(text)

    @property
    def _name(self) -> str:
        return env_name(self._world.env)

    @property
    def _kind(self) -> str:
        assert self._model is not None
        return self._model.kind

    def state_dict(self) -> dict[str, Any]:
        """Return the counters, the warnings given and the evidence: tensors on the CPU and plain values."""
        frequencies = {what: each.state_dict() for what, each in self._frequencies.items()}
        return {
            "contradictions": self.contradictions,
            "model_calls": self.model_calls,
            "warned": list(self._warned),
            "frequencies": frequencies,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned; frequencies that the saved check did not count begin empty."""
        self.contradictions, self.model_calls = state["contradictions"], state["model_calls"]
        self._warned = list(state["warned"])
        for what, each in self._frequencies.items():
            if what in state["frequencies"]:
                each.load_state_dict(state["frequencies"][what])


@dataclass(frozen=True)
class _Result:
    """The result of checking the steps of a rank.

    calls: of the simulator.
    contradictions: the number of steps that are no outcome of the model.   text: the message about the first of them.
    samples_only: whether there are steps whose outcomes the model only samples.
    shown: the number of visits in which the model shows another observation, and the message about the first of them.
    """

    calls: int
    contradictions: int = 0
    text: str = ""
    samples_only: bool = False
    shown: tuple[int, str] = (0, "")


def _steps(experience: Rollout, *, follows: str) -> Happened:
    """The steps of all episodes, without padding; `follows` names the column that says whether the episode went on."""
    alive_V = experience.alive_TB.cpu().numpy().reshape(-1)
    columns = [getattr(experience, name).flatten(0, 1).cpu().numpy() for name in (*_COLUMNS, follows)]
    at = np.flatnonzero(alive_V)
    return Happened(*(columns if len(at) == len(alive_V) else [column_V[at] for column_V in columns]))


def _check_known(world: SimulatedWorld) -> None:
    """PgtsError if only the check tells whether the simulator's snapshots are its whole state."""
    if isinstance(world.model.adapter, PickledAttributes):
        raise PgtsError(
            f"model_check is off, but it alone tells whether the attributes of {env_name(world.env)} are its whole "
            f"state: leave it on, or {methods_for(world.model.env)}"
        )
