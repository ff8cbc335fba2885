"""A simulator as a model: its states are snapshots, numbered as they are met, equal ones with the same number."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import MissingModel, PgtsError, RandomOutcomes, failure
from pgts_torch.models.answers import Answers, Step, copied
from pgts_torch.models.base import (
    CONTRADICTED,
    NOT_QUERIED,
    RANDOM,
    EnumeratingModel,
    ExactModel,
    Happened,
    SamplingModel,
    Transitions,
    step_text,
)
from pgts_torch.models.environments import Given, draws_its_own
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter, env_name
from pgts_torch.models.stepper import Stepper
from pgts_torch.seeding import SharedGenerators

_KEY_OF_CERTAINTY = 0
"""The key of steps that must not use any: a step that does is random, and is not enumerated."""


@final
class SimulatorModel(EnumeratingModel, SamplingModel, ExactModel):
    """An instance of a Gymnasium environment that is put into a state and stepped, to find what may follow an action.

    The instance is used by the model alone, so queries never touch the environment that an agent acts in. What its
    wrappers make of actions, rewards and observations is part of the outcomes (`transforms_of`); a `TimeLimit` is left
    out and ends no episode here. Where the environment itself truncates an episode the model never steps on: such a
    state leads to itself with reward 0 and discount 1, under its first action alone, so that at any depth T leaves it
    the value that the critic gives it at the leaves.

    Chance comes from the keys of the search, so a search cannot foresee what the environment of the agent will do. For
    a transition that uses no chance the simulator is stepped once. The answer is kept by snapshot, so it outlives
    `clear`; only where answers take much memory are they dropped.

    Args:
        env: an id, a spec, an environment that has a spec (another one is made from it) or a function that makes one.
        gamma: discount in [0, 1] of an outcome that ends no episode; truncation does not end it, what follows is worth
            what the critic says. An environment with `metadata["discounts"] = True` may name another one in
            `info["discount"]`.
        actions: the actions, as the outermost wrapper takes them, in the order of their numbers. Default: all of a
            discrete space; for a continuous one see `grid_actions` and `sampled_actions`.
        action_repeat: how often an action is taken in one outcome, as in `TensorModel`.
        adapter: takes and restores snapshots. Default: the one for the environment's family.
        observe: what to remember of an observation, for `observations`; an array, or None for nothing. Default: all.
        highest_value: an upper bound of v*, where one is known.
        device, dtype: of the answers.

    Raises:
        MissingModel: no adapter knows the environment, or a wrapper may change more than single answers.
        PgtsError: it cannot be made, gamma is no discount, its actions cannot be enumerated, or action_repeat is below
            1, or above 1 beside a highest value.
    """

    kind, is_cheap = "simulator", False

    num_outcomes = 1

    def __init__(
        self,
        env: Given,
        *,
        gamma: float,
        actions: Sequence[Any] | None = None,
        action_repeat: int = 1,
        adapter: SnapshotAdapter | None = None,
        observe: Callable[[Any], Any] | None = None,
        highest_value: float = math.inf,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        if not 0 <= gamma <= 1:
            raise PgtsError(f"gamma is {gamma}; it must be in [0, 1]")
        if action_repeat < 1:
            raise PgtsError(f"action_repeat is {action_repeat}; it must be at least 1")
        if action_repeat > 1 and highest_value < math.inf:
            raise PgtsError(f"highest_value is {highest_value}; under repeated actions no bound of v* stays one")
        self.action_repeat = action_repeat
        self._stepper = Stepper(env, gamma=gamma, actions=actions, adapter=adapter)
        self.name, self.env, self.actions = self._stepper.name, self._stepper.env, self._stepper.actions
        self.adapter, self.transforms = self._stepper.adapter, self._stepper.transforms
        self.num_actions, self.gamma, self.highest_value = len(self.actions), gamma, highest_value
        self.device, self.dtype = torch.empty(0, device=device).device, dtype
        self._observe = observe
        self._draws_its_own = draws_its_own(self._stepper.made)
        self._sure = Answers()
        self.generation = -1
        self.clear()

    @property
    def simulator_steps(self) -> int:  # type: ignore[override]
        """How often the simulator was stepped."""
        return self._stepper.steps

    def clear(self) -> None:
        """Drop all states. Their numbers are given to other states from here on."""
        self.generation += 1
        # By number: the snapshot of a state, and its observation, None where that is unknown. By snapshot: the number.
        self.num_states = 0
        self._snapshots: list[Snapshot] = []
        self._observations: list[Any] = []
        self._number: dict[tuple[bytes, bool], int] = {}
        self._sure.bound()
        self._known_worlds: list[Any] = []

    def root(self, env: gymnasium.Env, observation: Any = None) -> int:
        """The number of the state that another instance of this environment is in. Nothing of that instance changes.

        Args:
            env: wrapped or not; it has been reset.
            observation: its observation there, through its wrappers; needed only by critics that read observations.

        Raises:
            PgtsError: it is another environment, or has another map or other constants than the model's.
        """
        # Each instance is compared with the model's own once.
        base: Any = env.unwrapped
        if not any(base is known for known in self._known_worlds):
            if not self.adapter.same_world(base, self.env):
                raise PgtsError(
                    f"{env_name(env)} is not the environment that the model was made from ({self.name}): its class, "
                    "map or constants differ; make both with the same arguments"
                )
            self._known_worlds.append(base)
        return self.number(self.adapter.get_state(base), observation)

    def roots(self, envs: Iterable[gymnasium.Env], observations: Iterable[Any] | None = None) -> Int[Tensor, "B"]:
        """`root` of each of several instances."""
        pairs = zip(envs, itertools.repeat(None) if observations is None else observations, strict=False)
        return torch.tensor([self.root(*pair) for pair in pairs], dtype=torch.int64, device=self.device)

    def number(self, snapshot: Snapshot, observation: Any = None) -> int:
        """The number of a state: a new one if no equal state was met before."""
        number = self._known(snapshot, None)
        if self._observations[number] is None and observation is not None:
            self._see(number, observation)
        return number

    def _see(self, number: int, observation: Any) -> None:
        seen = self._observe(observation) if self._observe else observation
        # Copied, because an environment may write into the arrays that it has returned.
        self._observations[number] = copied(seen)

    def _known(self, snapshot: Snapshot, seen: Any) -> int:
        """The number of a state with this observation (as `observe` has made it, or None)."""
        number = self._number.setdefault(snapshot.name, self.num_states)
        if number == self.num_states:
            self.num_states += 1
            self._snapshots.append(snapshot)
            self._observations.append(seen)
        elif self._observations[number] is None:
            self._observations[number] = seen
        return number

    def export(self, state_N: Int[Tensor, "N"]) -> list[tuple[Snapshot, Any]]:
        """The snapshot of each state and what `observe` made of its observation, for `adopt` in another process."""
        return [(self.snapshot(state), self._observations[state]) for state in state_N.tolist()]

    def adopt(self, exported: Iterable[tuple[Snapshot, Any]]) -> Int[Tensor, "N"]:
        """The numbers of states that another model of the same environment has exported."""
        return torch.tensor([self._known(*one) for one in exported], dtype=torch.int64, device=self.device)

    def snapshot(self, state: int) -> Snapshot:
        """The snapshot behind the number of a state."""
        self._check("state", state, self.num_states)
        return self._snapshots[state]

    def observations(self, state_N: Int[Tensor, "N"]) -> np.ndarray:
        """What `observe` made of the observation of each state, stacked: [N, ...].

        Without `observe` that is [N, *shape] of a Box, [N] of a Discrete space, and `gymnasium.spaces.flatten` of any
        other, in the dtype of the space.

        Raises:
            PgtsError: one of them is not known, because a root was given without it; or it cannot be flattened.
        """
        rows = []
        for state in state_N.tolist():
            self._check("state", state, self.num_states)
            if self._observations[state] is None:
                raise PgtsError(
                    f"{self.name}: the observation of state {state} was not given, or `observe` made it None"
                )
            rows.append(self._observations[state])
        space = self._stepper.space
        if self._observe is None and not isinstance(space, spaces.Box | spaces.Discrete):
            try:
                rows = [spaces.flatten(space, row) for row in rows]
            except NotImplementedError:
                raise PgtsError(f"{self.name}: {space} cannot be flattened: give `observe`") from None
        return np.asarray(rows)

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The one outcome of each (state, action), in an environment that is not random there.

        Raises:
            RandomOutcomes: chance decides what follows.
            PgtsError: the environment fails, see `sample`.
        """
        steps = []
        with self._watched():
            for state, action in itertools.product(state_N.tolist(), range(self.num_actions)):
                step = self._step(state, action, _KEY_OF_CERTAINTY, repeat=self.action_repeat)
                if step.random:
                    raise RandomOutcomes(
                        f"{self.name} is random in state {state} under action {action}: its outcomes cannot be "
                        "enumerated; search it by `sampled`, or make a TabularModel of it if it has a table P"
                    )
                steps.append(step)
        reward_N, discount_N, child_N = self._answer(steps)
        shape = len(state_N), self.num_actions
        return Outcomes(
            reward_N.view(shape),
            torch.ones(*shape, 1, dtype=self.dtype, device=self.device),
            discount_N.view(*shape, 1),
            child_N.view(*shape, 1),
            self.num_states,
        )

    def sample(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"], *, key_N: Int[Tensor, "N"]) -> Transitions:
        """One outcome of each (state, action): restore the state, seed the generator by the key, step.

        Raises:
            PgtsError: no such state or action; or the environment raises, or answers with a reward or an observation
                that is not finite or does not fit its space: naming environment, state, action and key.
        """
        queries = zip(state_N.tolist(), action_N.tolist(), key_N.tolist(), strict=True)
        with self._watched():
            return Transitions(*self._answer([self._step(*one, repeat=self.action_repeat) for one in queries]))

    def is_random(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Whether chance decides what follows each (state, action), by a step of the simulator; raises as `sample`."""
        random = []
        for pair in zip(state_N.tolist(), action_N.tolist(), strict=True):
            with SharedGenerators() as shared:
                step = self._step(*pair, _KEY_OF_CERTAINTY, repeat=self.action_repeat)
            if shared.used:
                # A step that used a global generator looked certain, and may have been remembered.
                self._sure.clear()
            random.append(step.random or bool(shared.used))
        return torch.tensor(random, dtype=torch.bool, device=self.device)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """MissingModel where a step in this context has drawn from a generator that the whole process shares."""
        if self._draws_its_own:
            yield
            return
        with SharedGenerators() as shared:
            yield
        if shared.used:
            self._sure.clear()
            raise MissingModel(
                f"{self.name} cannot be a model: step draws from the global generator of {shared.used[0]}: draw from "
                "self.np_random only; or take depth 0 and the estimator 'sampled', which need no model"
            )

    def _answer(self, steps: Sequence[Step]) -> tuple[Tensor, Tensor, Tensor]:
        """Rewards, discounts and children."""
        return (
            torch.tensor([step.reward for step in steps], dtype=self.dtype, device=self.device),
            torch.tensor([step.discount for step in steps], dtype=self.dtype, device=self.device),
            torch.tensor([self._number[step.child.name] for step in steps], dtype=torch.int64, device=self.device),
        )

    def outcome_of(self, happened: Happened, *, query_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """0 where a step is, bit for bit, what the simulator gives: from memory where it was queried for that before,
        and where `query_N` says so by a step of the simulator."""
        columns = [column_N.tolist() for column_N in vars(happened).values()]
        query = itertools.repeat(True) if query_N is None else query_N.tolist()
        with self._watched():
            return np.array([self._outcome_of(*one) for one in zip(*columns, query, strict=False)], dtype=np.int64)

    def _outcome_of(
        self, state: int, action: int, reward: float, discount: float, next_state: int, follows: bool, query: bool
    ) -> int:
        step = self._sure.get((self._snapshots[state].key, action, 1))
        if step is None:
            if not query:
                return NOT_QUERIED
            step = self._step(state, action, _KEY_OF_CERTAINTY, repeat=1)
            if step.random:
                return RANDOM
        # A truncated episode cannot have gone on.
        if step.reward != reward or step.discount != discount or (step.child.cut and follows):
            return CONTRADICTED
        return 0 if discount == 0 or self.adapter.same_state(step.child, self._snapshots[next_state]) else CONTRADICTED

    def state_text(self, state: int) -> str:
        """With its observation, or else its snapshot."""
        seen = self._observations[state]
        what = repr(self._snapshots[state].key) if seen is None else np.array2string(np.asarray(seen), threshold=20)
        return f"state {state} ({what})"

    def outcomes_text(self, state: int, action: int) -> str:
        """The one outcome of a single step."""
        step = self._step(state, action, _KEY_OF_CERTAINTY, repeat=1)
        then = self.state_text(self._number[step.child.name]) + step.child.cut * ", where the episode is truncated"
        return step_text(step.reward, step.discount, then)

    def _step(self, state: int, action: int, key: int, *, repeat: int) -> Step:
        """What follows an action that is taken so many times; from memory where no chance is involved."""
        self._check("state", state, self.num_states)
        self._check("action", action, self.num_actions)
        at = self._snapshots[state]
        if at.cut:
            # The state leads to itself under its first action alone, see the class.
            return Step(-math.inf if action else 0.0, 1.0, at, self._observations[state], random=False)
        query = at.key, action, repeat
        if (known := self._sure.get(query)) is not None:
            # The child gets its number now, so that numbers do not depend on what is remembered.
            self._known(known.child, known.observation)
            return known
        taken = self.actions[action]
        try:
            total, discount, reached, random = self._stepper.follow(
                at.data, taken, key, repeat=repeat, rewards=self.reward_range
            )
            child = self._known(reached, None)
            if self._observations[child] is None:
                self._see(child, self._stepper.observation(total))
        except BaseException as error:
            where = f"{self.name} failed in state {state} under action {action} ({taken!r}) with key {key}"
            raise failure(where, error) from error
        step = Step(total, discount, self._snapshots[child], self._observations[child], random)
        if not random:
            self._sure.add(query, step)
        return step

    def _check(self, what: str, number: int, count: int) -> None:
        if not 0 <= number < count:
            raise PgtsError(f"{self.name}: {what} {number} does not exist; there are {count}, from 0 on")
