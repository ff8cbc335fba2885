"""A simulator as a model whose actions are vectors."""

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.errors import PgtsError, RandomOutcomes, check_count, failure
from pgts_torch.models.answers import Seen, Step
from pgts_torch.models.base import FollowingModel, Transitions
from pgts_torch.models.environments import Given
from pgts_torch.models.exact_model import CONTRADICTED, NOT_QUERIED, RANDOM, ExactModel, Happened, step_text
from pgts_torch.models.provenance import draws_its_own
from pgts_torch.models.snapshot_model import SnapshotModel, watched
from pgts_torch.models.snapshots import SnapshotAdapter
from pgts_torch.models.stepper import Stepper

_ANY_KEY = 0


@final
class VectorSimulator(SnapshotModel, FollowingModel, ExactModel):
    """As `SimulatorModel`, but for actions that are vectors: each is simulated when it is asked for, and nothing is
    remembered, because hardly any is taken twice. A state in which the environment has truncated an episode leads to
    itself with reward 0 and discount 1 under every action.

    Args:
        env, gamma, action_repeat, adapter, observe, device, dtype: as in `SimulatorModel`.
        size: X, of the vectors that the outermost wrapper takes (`Squashed`).

    Raises:
        MissingModel, PgtsError: as `SimulatorModel`.
    """

    kind, is_cheap, num_actions = "simulator", False, 0

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
        if not 0 <= gamma <= 1:
            raise PgtsError(f"gamma is {gamma}; it must be in [0, 1]")
        check_count("action_repeat", action_repeat)
        some = [np.zeros(size, np.float32)]  # a stepper has one at least
        self._stepper = stepper = Stepper(env, gamma=gamma, actions=some, adapter=adapter, observe=observe)
        super().__init__(stepper.name, stepper.space, observe, device)
        stepper.clock = None
        self.gamma, self.action_repeat, self.dtype = gamma, action_repeat, dtype
        self.env, self.adapter = stepper.env, stepper.adapter
        self._draws_its_own = draws_its_own(stepper.made)

    @property
    def simulator_steps(self) -> int:  # type: ignore[override]
        """How often the simulator was stepped."""
        return self._stepper.steps

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
        with watched(self.name, draws_its_own=self._draws_its_own):
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
        return self._answer(steps)

    def sample(
        self, state_N: Int[Tensor, "N"], action_NX: Float[Tensor, "N X"], *, key_N: Int[Tensor, "N"]
    ) -> Transitions:
        """One outcome of each (state, action): restore the state, seed the generator by the key, step; PgtsError where
        the environment fails."""
        states = self._checked("state", state_N, self.num_states)
        queries = zip(states, self._taken(action_NX.cpu().numpy()), key_N.tolist(), strict=True)
        with watched(self.name, draws_its_own=self._draws_its_own):
            return self._answer([self._step(*query, self.action_repeat) for query in queries])

    def outcome_of(self, happened: Happened, *, query_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """0 where a step is, bit for bit, what the simulator gives, of those that `query_N` names."""
        outcome_N, taken = np.full(len(happened.state_N), NOT_QUERIED), self._taken(happened.action_N)
        asked = list(range(len(outcome_N))) if query_N is None else np.flatnonzero(query_N).tolist()
        with watched(self.name, draws_its_own=self._draws_its_own):
            for i in asked:
                step = self._step(int(happened.state_N[i]), taken[i], _ANY_KEY, 1)
                outcome_N[i] = RANDOM if step.random else 0 if self._is_same(step, happened, i) else CONTRADICTED
        return outcome_N

    def _is_same(self, step: Step, happened: Happened, i: int) -> bool:
        reached = step.child.snapshot
        discount = float(happened.discount_N[i])
        if step.reward != happened.reward_N[i] or step.discount != discount or (reached.cut and happened.follows_N[i]):
            return False
        after = self.snapshot(int(happened.next_state_N[i]))
        return discount == 0 or self.adapter.same_state(reached, after)

    def outcomes_text(self, state: int, action: Any) -> str:
        """The one outcome of a single step."""
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

    def _answer(self, steps: Sequence[Step]) -> Transitions:
        children = [self._enter(step.child) for step in steps]
        return Transitions(
            torch.tensor([step.reward for step in steps], dtype=self.dtype, device=self.device),
            torch.tensor([step.discount for step in steps], dtype=self.dtype, device=self.device),
            torch.tensor(children, dtype=torch.int64, device=self.device),
        )

    def _failure(self, state: int, taken: Any, error: BaseException) -> BaseException:
        return failure(f"{self.name} failed in state {state} under the action {taken!r}", error)

    def _late(self, state: int) -> Any:
        return None


def _stays(seen: Seen) -> Step:
    return Step(0.0, 1.0, seen, False)
