"""What models of vectors that are fitted to steps have in common: the steps that they keep, and random ends."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.models.base import Experience, LearningModel, Transitions
from pgts_torch.models.held_out import BLOCK
from pgts_torch.models.replay import ReplayBuffer
from pgts_torch.models.tensor import TensorModel
from pgts_torch.seeding import uniform

SELDOM = 0.02
"""Smaller probabilities of an end count as 0: a classifier never returns 0, and over many steps small ones add up."""


class FittedModel(TensorModel, LearningModel):
    """Dynamics of vectors of D numbers, fitted to the steps that are kept. What follows is certain but for whether the
    episode ends.

    replay: the steps, with the columns state, action, reward, end, next_state and follows, and those of a subclass.

    Args:
        state_size: D.
        num_actions: A; 0 where actions are vectors.   action_size: X, of these.
        observations: none, in the form in which they are kept.
        gamma: discount of a step after which the episode goes on.
        capacity: the number of steps that are kept; PgtsError unless it is above 32, and memory has room.
        columns: no rows of further columns.
    """

    def __init__(
        self,
        state_size: int,
        num_actions: int,
        observations: Tensor,
        *,
        gamma: float,
        capacity: int,
        device: torch.device | str,
        action_repeat: int,
        action_size: int = 0,
        **columns: Tensor,
    ) -> None:
        super().__init__(
            state_size, num_actions, merge=False, dtype=torch.float64, device=device, action_repeat=action_repeat
        )
        if capacity <= BLOCK:
            raise PgtsError(
                f"capacity is {capacity}; a learned model keeps more than {BLOCK} steps, because so many in a row may "
                "be held out (replay.capacity)"
            )
        self.gamma, none = gamma, torch.zeros(0)
        self.replay: ReplayBuffer = ReplayBuffer(capacity)
        actions = none.long() if num_actions else torch.zeros(0, action_size)
        seen = {"state": observations, "next_state": observations, "action": actions, "follows": none.bool()}
        self.replay.add(**seen, reward=none, end=none, **columns)

    def _ends(self, discount_N: Float[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Whether each step has ended its episode; PgtsError where a discount is neither gamma nor 0."""
        named_N = (discount_N != 0) & (discount_N != self.gamma)
        if bool(named_N.any()):
            raise PgtsError(
                f"a step has the discount {float(discount_N[named_N][0])}; what is learned is only whether an episode "
                f"ends, so that discounts must be 0 or gamma, and gamma is {self.gamma}: give the gamma that all steps "
                "have, if there is one"
            )
        return discount_N == 0

    def _keep(self, steps: Experience, **columns: Tensor) -> None:
        self.replay.add(
            state=steps.observation_N,
            action=steps.action_N,
            reward=steps.reward_N,
            end=steps.discount_N == 0,
            next_state=steps.next_observation_N,
            follows=steps.follows_N,
            **columns,
        )

    def _with_ends(
        self,
        reward_N: Float[Tensor, "N"],
        discount_N: Float[Tensor, "N"],
        next_ND: Float[Tensor, "N D"],
        *,
        key_N: Int[Tensor, "N"],
        trusted_N: Bool[Tensor, "N"] | None = None,
    ) -> Transitions:
        """Steps of these mean discounts, with an end, discount 0, or without one, discount gamma."""
        self.simulator_steps += len(reward_N)
        goes_on_N = uniform(key_N) * self.gamma < discount_N
        return Transitions(reward_N, self.gamma * goes_on_N.double(), self.number(next_ND), trusted_N)
