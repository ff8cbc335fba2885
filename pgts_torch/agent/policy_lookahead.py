"""The lookahead of a policy: a search with the critic's values at the leaves."""

from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.agent.critics import Critic
from pgts_torch.agent.gaussian import GaussianPolicy, MixtureProposal
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.world import ModelWorld
from pgts_torch.models.drawn_actions import Drawn, DrawnActions
from pgts_torch.readings import Readings
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.seeding import mix, sample_keys


@final
class PolicyLookahead:
    """(T^m Q)(s, .) at states of a model, with the critic's estimate of Q^pi or v^pi at the leaves.

    Args:
        world: gives the observations of states, for policy and critic.
        policy: gives the prior of a tree search.
        scale: of the proposal from which actions are drawn where the policy is Gaussian (`MixtureProposal`).
    """

    def __init__(
        self, world: ModelWorld, policy: Policy, critic: Critic, search: Search, *, scale: float = 2.0
    ) -> None:
        self.world, self.policy, self.critic, self.search = world, policy, critic, search
        self._drawing = search.model if isinstance(search.model, DrawnActions) else None
        self._scale = scale
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
        model = self.search.model
        nothing = torch.zeros(0, model.num_actions, dtype=model.dtype, device=state_N.device)
        return Lookahead.enumerated(nothing, model_calls=0, critic_calls=0, nodes_per_level=())

    def restart(self, generator: torch.Generator) -> None:
        """Reset the search before a lookahead for which states have got new numbers, or the model has learned. Where
        actions are drawn, others are drawn, from a key of this generator."""
        if self._drawing is not None:
            assert isinstance(self.policy, GaussianPolicy)
            key = mix(sample_keys(1, generator=generator), 1).to(self.world.device)
            count = self._drawing.num_actions
            self._drawing.redraw(MixtureProposal(self.world, self.policy, count, self._scale, key))
        generation = self.world.model.generation
        if not self.world.keeps_numbers or generation != self._generation:
            self.search.reset()
            self._generation = generation

    def drawn(self, state_N: Int[Tensor, "N"]) -> Drawn | None:
        """The actions that are drawn in these states; None where all are numbered."""
        return None if self._drawing is None else self._drawing.drawn(state_N)

    def _leaf(self, state_N: Int[Tensor, "N"]) -> Tensor:
        observation_N = self.world.observe(state_N)
        return self.critic.v(observation_N) if self.critic.target == "v" else self.critic.q(observation_N)

    def _prior(self, state_N: Int[Tensor, "N"]) -> Tensor:
        drawn = self.drawn(state_N)
        return self.policy.probs(self.world.observe(state_N)) if drawn is None else drawn.prob_NK
