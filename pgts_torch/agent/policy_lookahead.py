"""The lookahead of a policy: a search with the critic's values at the leaves."""

from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.agent.critics import Critic
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.world import ModelWorld
from pgts_torch.readings import Readings
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import Lookahead


@final
class PolicyLookahead:
    """(T^m Q)(s, .) at states of a model, with the critic's estimate of Q^pi or v^pi at the leaves.

    Args:
        world: gives the observations of states, for policy and critic.
        policy: gives the prior of a tree search.
        critic: gives the values of this policy.
        search: computes the lookahead.
    """

    def __init__(self, world: ModelWorld, policy: Policy, critic: Critic, search: Search) -> None:
        self.world, self.policy, self.critic, self.search = world, policy, critic, search
        self._generation = world.model.generation
        self._leaves: dict[str, Any] = {f"{critic.target}_leaf": self._leaf, "prior": self._prior}

    def __call__(
        self, state_N: Int[Tensor, "N"], *, depth: int, generator: torch.Generator, readings: Readings | None = None
    ) -> Lookahead:
        """(T^m Q)(s, .) at these states, of which there may be none where other processes have them all.

        Args:
            readings: where the checks of values wait.
        """
        if len(state_N):
            return self.search(state_N, depth=depth, generator=generator, readings=readings, **self._leaves)
        model = self.world.model
        nothing = torch.zeros(0, model.num_actions, dtype=model.dtype, device=state_N.device)
        return Lookahead.enumerated(nothing, model_calls=0, critic_calls=0, nodes_per_level=())

    def restart(self) -> None:
        """Reset the search before a lookahead for which states have got new numbers, or the model has learned."""
        generation = self.world.model.generation
        if not self.world.keeps_numbers or generation != self._generation:
            self.search.reset()
            self._generation = generation

    def _leaf(self, state_N: Int[Tensor, "N"]) -> Tensor:
        observation_N = self.world.observe(state_N)
        return self.critic.v(observation_N) if self.critic.target == "v" else self.critic.q(observation_N)

    def _prior(self, state_N: Int[Tensor, "N"]) -> Tensor:
        return self.policy.probs(self.world.observe(state_N))
