"""A simulator as a model whose actions are vectors."""

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.errors import RandomOutcomes, failure
from pgts_torch.models.answers import Seen, Step
from pgts_torch.models.base import FollowingModel, Transitions
from pgts_torch.models.environments import Given
from pgts_torch.models.exact_model import CONTRADICTED, NOT_QUERIED, RANDOM, Happened, step_text
from pgts_torch.models.snapshot_model import SnapshotModel
from pgts_torch.models.snapshots import SnapshotAdapter

_ANY_KEY = 0


@final
class VectorSimulator(SnapshotModel, FollowingModel):
    """As `SimulatorModel`, but for actions that are vectors: each is simulated when it is asked for, and nothing is
    remembered, because hardly any is taken twice. A state in which the environment has truncated an episode leads to
    itself with reward 0 and discount 1 under every action.

    Args:
        env, gamma, action_repeat, adapter, observe, device, dtype: as in `SimulatorModel`.
        size: X, of the vectors that the outermost wrapper takes (`Squashed`).

    Raises:
        MissingModel, PgtsError: as `SimulatorModel`.
    """

    num_actions = 0

    def __init__(
        self,
        env: Given,
        *,
        gamma: float,
        size: int,
        action_repeat: int = 1,
        adapter: SnapshotAdapter | None = None,
        observe: Callable[[Any], Any] | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__(
            env,
            gamma=gamma,
            actions=[np.zeros(size, np.float32)],  # a stepper has one at least
            action_repeat=action_repeat,
            adapter=adapter,
            observe=observe,
            device=device,
            dtype=dtype,
        )
        self._stepper.clock = None

    def follow(self, state_N: Int[Tensor, "N"], action_NX: Float[Tensor, "N X"]) -> Transitions:
        """The one outcome of each (state, action).

        Raises:
            RandomOutcomes: chance decides what follows.
            PgtsError: the environment fails.
        """
        states, taken = self._checked("state", state_N, self.num_states), self._taken(action_NX.cpu().numpy())
        going = [i for i, state in enumerate(states) if not self._seen[state].snapshot.cut]
        requests = [(self._seen[states[i]].snapshot.data, taken[i]) for i in going]
        made, stepper = list[Step](), self._stepper
        with self._watched():
            stepper.chance.watch()
            try:
                stepper.follow_each(requests, self.action_repeat, self.reward_range, made)
            except BaseException as error:
                raise self._failure(states[going[len(made)]], requests[len(made)][1], error) from error
            known = any(step.random for step in made)
            if known or (any(step.random is None for step in made) and stepper.chance.was_drawn()):
                raise RandomOutcomes(
                    f"{self.name} is random in some of {len(states)} states: a lookahead over drawn actions follows "
                    "one outcome of each, and this environment has several; take the estimator 'sampled' at depth 0"
                )
        steps = [_stays(self._seen[state]) for state in states]
        for i, step in zip(going, made, strict=True):
            steps[i] = step
        return self._answer(self._entered(steps))

    def sample(
        self, state_N: Int[Tensor, "N"], action_NX: Float[Tensor, "N X"], *, key_N: Int[Tensor, "N"]
    ) -> Transitions:
        """One outcome of each (state, action): restore the state, seed the generator by the key, step; PgtsError where
        the environment fails."""
        states = self._checked("state", state_N, self.num_states)
        queries = zip(states, self._taken(action_NX.cpu().numpy()), key_N.tolist(), strict=True)
        with self._watched():
            return self._answer(self._entered([self._step(*query, self.action_repeat) for query in queries]))

    def outcome_of(self, happened: Happened, *, query_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """0 where a step is, bit for bit, what the simulator gives, of those that `query_N` names."""
        outcome_N, taken = np.full(len(happened.state_N), NOT_QUERIED), self._taken(happened.action_N)
        asked = list(range(len(outcome_N))) if query_N is None else np.flatnonzero(query_N).tolist()
        with self._watched():
            for i in asked:
                state, _, reward, discount, next_state, follows = (each[i].tolist() for each in vars(happened).values())
                step = self._step(state, taken[i], _ANY_KEY, 1)
                same = self._is_same(step, reward, discount, next_state, follows)
                outcome_N[i] = RANDOM if step.random else 0 if same else CONTRADICTED
        return outcome_N

    def outcomes_text(self, state: int, action: Any) -> str:
        step = self._step(state, self._taken(np.array([action]))[0], _ANY_KEY, 1)
        return step_text(step.reward, step.discount, self.state_text(self._enter(step.child)))

    def _taken(self, action_NX: np.ndarray) -> Sequence[Any]:
        """The actions as the instance takes them."""
        return [self._stepper.transforms.action(action) for action in action_NX]

    def _step(self, state: int, taken: Any, key: int, repeat: int) -> Step:
        seen = self._seen[state]
        if seen.snapshot.cut:
            return _stays(seen)
        try:
            return self._stepper.follow(seen.snapshot.data, taken, key, repeat, self.reward_range)
        except BaseException as error:
            raise self._failure(state, taken, error) from error

    def _failure(self, state: int, taken: Any, error: BaseException) -> BaseException:
        return failure(f"{self.name} failed in state {state} under the action {taken!r}", error)


def _stays(seen: Seen) -> Step:
    return Step(0.0, 1.0, seen, False)
