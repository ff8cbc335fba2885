"""A simulator as a model: its states are snapshots, numbered as they are met, equal ones with the same number."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError, RandomOutcomes, failure
from pgts_torch.models.adapters import methods_for
from pgts_torch.models.answers import Answers, Step, without_collector
from pgts_torch.models.base import EnumeratingModel, SamplingModel, Transitions
from pgts_torch.models.clocks import trusted_clock
from pgts_torch.models.environments import Given
from pgts_torch.models.exact_model import CONTRADICTED, NOT_QUERIED, RANDOM, Happened, step_text
from pgts_torch.models.masks import ActionMasks
from pgts_torch.models.snapshot_model import SnapshotModel
from pgts_torch.models.snapshots import SnapshotAdapter
from pgts_torch.seeding import SharedGenerators

_ANY_KEY, _CALLS_OF_A_PART = 0, 1024
"""The key of steps of which it matters only whether they are random; how many are made before there may be garbage."""


@final
class SimulatorModel(SnapshotModel, EnumeratingModel, SamplingModel):
    """An instance of a Gymnasium environment that is put into a state and stepped, to find what may follow an action.

    The instance is used by the model alone, so queries never touch the environment that an agent acts in. What its
    wrappers make of actions, rewards and observations is part of the outcomes (`transforms_of`); a `TimeLimit` is left
    out. Where the environment itself truncates an episode the model never steps on: such a state leads to itself with
    reward 0 and discount 1, under its first action alone, so that T leaves it the critic's value at any depth.

    Chance comes from the keys of the search, so a search cannot foresee what the environment of the agent will do. What
    uses no chance is simulated once: such answers outlive `clear`, unless they take much memory.

    Args:
        env: an id, a spec, an environment that has a spec (another one is made from it) or a function that makes one.
        gamma: discount in [0, 1] of an outcome that does not terminate. An environment whose
            `metadata["discounts"]` is True may name another one in `info["discount"]`.
        actions: the actions, as the outermost wrapper takes them, in the order of their numbers. Default: all of a
            discrete space; for a continuous one see `grid_actions` and `sampled_actions`.
        action_repeat: how often an action is taken in one outcome, as in `TensorModel`.
        adapter: takes and restores snapshots. Default: the one for the environment's family.
        observe: what to remember of an observation, for `observations`; an array, or None for nothing. Default: all.
        masks: how the environment says which actions are legal. The others are never taken: their reward is -inf. Which
            are legal is known of states that steps have led to, and of roots that it was given for.
        highest_value: an upper bound of v*, where one is known.
        device, dtype: of the answers.

    Raises:
        MissingModel: no adapter knows the environment, or a wrapper may change more than single answers.
        PgtsError: it cannot be made, an argument is out of range, its actions cannot be enumerated, or action_repeat is
            above 1 beside a highest value or action masks.
    """

    num_outcomes, answers_singly = 1, True

    def __init__(
        self,
        env: Given,
        *,
        gamma: float,
        actions: Sequence[Any] | None = None,
        action_repeat: int = 1,
        adapter: SnapshotAdapter | None = None,
        observe: Callable[[Any], Any] | None = None,
        masks: ActionMasks | None = None,
        highest_value: float = math.inf,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__(
            env,
            gamma=gamma,
            actions=actions,
            action_repeat=action_repeat,
            adapter=adapter,
            observe=observe,
            masks=masks,
            device=device,
            dtype=dtype,
        )
        if action_repeat > 1 and highest_value < math.inf:
            raise PgtsError(f"highest_value is {highest_value}; under repeated actions no bound of v* stays one")
        if action_repeat > 1 and masks is not None:
            raise PgtsError(
                f"action_repeat is {action_repeat}, and {masks.what} may forbid the second of two equal actions: take "
                "1, or set action_masks to 'off'"
            )
        stepper, self.highest_value = self._stepper, highest_value
        self.actions, self.num_actions = stepper.actions, len(stepper.actions)
        stepper.clock = trusted_clock(stepper) if action_repeat == 1 else None
        self._answers = Answers(stepper.at_count if stepper.clock else None)

    def clear(self) -> None:
        super().clear()
        self._answers.clear_if_large()

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The one outcome of each (state, action), in an environment that is not random there.

        Raises:
            RandomOutcomes: chance decides what follows.
            PgtsError: the environment fails, see `sample`.
        """
        states, part = self._checked("state", state_N, self.num_states), max(1, _CALLS_OF_A_PART // self.num_actions)
        with self._watched(self._answers.clear):
            steps = [step for i in range(0, len(states), part) for step in self._certain(states[i : i + part])]
        # K = 1: the one outcome of each action has probability 1.
        answer, shape = self._answer(steps), (len(state_N), self.num_actions, 1)
        certain_NAK = torch.ones(shape, dtype=self.dtype, device=self.device)
        reward_NA, discount_NAK = answer.reward_N.view(shape[:2]), answer.discount_N.view(shape)
        return Outcomes(reward_NA, certain_NAK, discount_NAK, answer.next_state_N.view(shape), self.num_states)

    def sample(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"], *, key_N: Int[Tensor, "N"]) -> Transitions:
        """One outcome of each (state, action): restore the state, seed the generator by the key, step.

        Raises:
            PgtsError: no such state or action; or the environment raises, or answers with a reward or an observation
                that is not finite or does not fit its space: naming environment, state, action and key.
        """
        states = self._checked("state", state_N, self.num_states)
        queries = zip(states, self._checked("action", action_N, self.num_actions), key_N.tolist(), strict=True)
        with self._watched(self._answers.clear):
            return self._answer([self._step(*query, self.action_repeat) for query in queries])

    def is_random(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Whether chance decides what follows each (state, action), by a step of the simulator; raises as `sample`."""
        random, states = [], self._checked("state", state_N, self.num_states)
        for pair in zip(states, self._checked("action", action_N, self.num_actions), strict=True):
            with SharedGenerators() as shared:
                step, _ = self._step(*pair, _ANY_KEY, self.action_repeat)
            if shared.used:
                # A step that used a global generator looked certain, and may have been remembered.
                self._answers.clear()
            random.append(step.random or bool(shared.used))
        return torch.tensor(random, dtype=torch.bool, device=self.device)

    def outcome_of(self, happened: Happened, *, query_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """0 where a step is, bit for bit, what the simulator gives: from memory where it was queried for that before,
        and where `query_N` says so by a step of the simulator."""
        # Plain Python numbers: each step is compared by itself, and in numpy that would take ten times as long.
        columns = [column_N.tolist() for column_N in vars(happened).values()]
        query = itertools.repeat(True) if query_N is None else query_N.tolist()
        with self._watched(self._answers.clear):
            return np.array([self._outcome_of(*one) for one in zip(*columns, query, strict=False)], dtype=np.int64)

    def _outcome_of(
        self, state: int, action: int, reward: float, discount: float, next_state: int, follows: bool, query: bool
    ) -> int:
        step = self._known(state, 1).get(action)
        if step is None:
            if not query:
                return NOT_QUERIED
            step, _ = self._step(state, action, _ANY_KEY, 1)
            if step.random:
                return RANDOM
        return 0 if self._is_same(step, reward, discount, next_state, follows) else CONTRADICTED

    def outcomes_text(self, state: int, action: int) -> str:
        step, child = self._step(state, action, _ANY_KEY, 1)
        then = self.state_text(child) + step.child.snapshot.cut * ", where the episode is truncated"
        text = step_text(step.reward, step.discount, then)
        if (clock := self._stepper.clock) is not None:
            now = self._stepper.follow(self._seen[state].snapshot.data, self.actions[action], _ANY_KEY, 1, None)
            if (now.reward, now.discount, now.child.snapshot.name) != (
                step.reward,
                step.discount,
                step.child.snapshot.name,
            ):
                text += f", as at another {clock.name}, on which it depends: {methods_for(self.env)}"
        return text

    @without_collector()
    def _certain(self, states: Sequence[int]) -> list[tuple[Step, int]]:
        """What follows every action in each state, and the number of the state reached, in the order of a table [N, A].
        What is not remembered is simulated in one batch."""
        count, repeat = self.num_actions, self.action_repeat
        rows = [self._known(state, repeat) for state in states]
        while pairs := self._unknown(states, rows):
            self._simulate(pairs)
            rows = [row if len(row) == count else self._known(n, repeat) for n, row in zip(states, rows, strict=True)]
        # The children get their numbers now, in this order, so that numbers do not depend on what is remembered.
        return self._entered(row[action] for row in rows for action in range(count))

    def _unknown(self, states: Sequence[int], rows: Sequence[Mapping[int, Step]]) -> list[tuple[int, int]]:
        """The states and actions that rows lack; of states that differ in the clock alone the last one."""
        found = dict[Any, tuple[int, int]]()
        for state, row in zip(states, rows, strict=True):
            if len(row) < self.num_actions:
                name = self._answers.name(self._seen[state].snapshot)
                found |= {(name, action): (state, action) for action in range(self.num_actions) if action not in row}
        return list(found.values())

    def _simulate(self, pairs: list[tuple[int, int]]) -> None:
        """Remember what follows these states and actions.

        Raises:
            RandomOutcomes: something else may follow, too.
        """
        steps, seen, remember, repeat = self._simulated(pairs), self._seen, self._answers.remember, self.action_repeat
        for (state, action), step in zip(pairs, steps, strict=True):
            if not step.random:
                remember(seen[state].snapshot, action, repeat, step)
        if (random := next((i for i, step in enumerate(steps) if step.random), None)) is not None:
            raise RandomOutcomes(
                f"{self.name} is random in state {pairs[random][0]} under action {pairs[random][1]}: its outcomes "
                "cannot be enumerated; search it by `sampled`, or make a TabularModel of it if it has a table P"
            )

    def _simulated(self, pairs: list[tuple[int, int]]) -> list[Step]:
        """What follows these states and actions, where nothing may be random. The generator is looked at once for all:
        only if something was drawn are they taken again one by one, with a key, to tell which are random."""
        requests = [(self._seen[state].snapshot.data, self.actions[action]) for state, action in pairs]
        steps, stepper = list[Step](), self._stepper
        stepper.chance.watch()
        try:
            stepper.follow_each(requests, self.action_repeat, self.reward_range, steps)
        except BaseException as error:
            raise self._failure(*pairs[len(steps)], error) from error
        if any(step.random is None for step in steps) and stepper.chance.was_drawn():
            return [self._followed(*pair, _ANY_KEY, self.action_repeat) for pair in pairs]
        return steps

    def _step(self, state: int, action: int, key: int, repeat: int) -> tuple[Step, int]:
        """What follows an action that is taken so many times, from memory where no chance is involved, and the number
        of the state reached."""
        if (step := self._known(state, repeat).get(action)) is None:
            step = self._followed(state, action, key, repeat)
            if not step.random:
                self._answers.remember(self._seen[state].snapshot, action, repeat, step)
        return self._entered([step])[0]

    def _followed(self, state: int, action: int, key: int, repeat: int) -> Step:
        """What follows an action, by the simulator."""
        try:
            data = self._seen[state].snapshot.data
            return self._stepper.follow(data, self.actions[action], key, repeat, self.reward_range)
        except BaseException as error:
            raise self._failure(state, action, error, f" with key {key}") from error

    def _failure(self, state: int, action: int, error: BaseException, key: str = "") -> BaseException:
        where = f"{self.name} failed in state {state} under action {action} ({self.actions[action]}){key}"
        return failure(where, error)

    def _known(self, state: int, repeat: int) -> Mapping[int, Step]:
        """What follows in a state without a step of the simulator, by action."""
        seen = self._seen[state]
        if seen.snapshot.cut:
            # It leads to itself under its first action alone, see the class.
            return {action: Step(-math.inf if action else 0.0, 1.0, seen, False) for action in range(self.num_actions)}
        known = self._answers.known(seen.snapshot, repeat, self.reward_range)
        if self._masks is None or seen.legal == b"\1" * self.num_actions:
            return known
        if seen.legal is None:
            raise PgtsError(f"{self.name}: which actions are legal in {self.state_text(state)} is not known")
        illegal = Step(-math.inf, 1.0, seen, False)
        return {action: illegal for action, legal in enumerate(seen.legal) if not legal} | dict(known)
