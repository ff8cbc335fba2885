"""What a trained policy does: from observations to actions in the form of the environment, without search."""

from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor

from pgts_torch.agent.components import row_shape
from pgts_torch.agent.gaussian import GaussianPolicy, Mean
from pgts_torch.agent.policies import Policy, drawn
from pgts_torch.agent.world import World
from pgts_torch.errors import PgtsError
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.masks import ActionMasks, Masked


@final
class Acting:
    """Takes actions by a policy."""

    def __init__(self, world: World, source: EnvSource) -> None:
        self._world, self._name = world, source.name
        self._own_actions, self._squash = source.own_actions(world.env), source.squash(world.env)

    def __call__(
        self,
        policy: Policy,
        observation: ArrayLike,
        action_mask: ArrayLike | None,
        *,
        deterministic: bool,
        generator: torch.Generator,
    ) -> np.ndarray | np.generic:
        """Actions, as `PGTS.predict` says."""
        observation = self._masked(observation, action_mask)
        observation_N = self._world.encode(observation)
        shape = observation_N.shape[: observation_N.ndim - len(row_shape(self._world.observation_space))]
        observation_N = self._world.perceive(observation_N.reshape(-1, *observation_N.shape[len(shape) :]))
        if isinstance(policy, GaussianPolicy):
            one: Policy = Mean(policy) if deterministic else policy
            vector_NX = one.sample(observation_N, generator=generator).cpu().numpy()
            assert self._squash is not None
            return self._squash.actions(vector_NX.reshape(*shape, -1))
        if isinstance(observation, Masked) and not self._world.shows_masks:
            pi_NA = self._within(policy, observation_N, observation.legal_A)
            action_N = pi_NA.argmax(-1) if deterministic else drawn(pi_NA, generator=generator)
        elif deterministic:
            action_N = policy.probs(observation_N).argmax(-1)
        else:
            action_N = policy.sample(observation_N, generator=generator)
        action = action_N.cpu().numpy().reshape(shape)
        return action[()] if self._own_actions is None else self._own_actions[action]

    def _within(self, policy: Policy, state_N: Int[Tensor, "N"], legal: np.ndarray) -> Float[Tensor, "N A"]:
        """pi(.|s) of the actions that a mask leaves of those that the table allows; 0 of the others."""
        pi_NA = policy.probs(state_N)
        if legal.size != pi_NA.numel():
            raise PgtsError(f"action masks have the shape {legal.shape}; there are {len(pi_NA)} observations")
        legal_NA = torch.from_numpy(legal.reshape(-1, pi_NA.shape[1])).to(pi_NA.device)
        kept_NA = pi_NA * legal_NA
        for n in (kept_NA.sum(-1) == 0).nonzero().flatten().tolist():
            allowed, taken = (row_NA[n].nonzero().flatten().tolist() for row_NA in (legal_NA, pi_NA))
            raise PgtsError(
                f"action_mask allows the actions {allowed} in state {int(state_N[n])} of {self._name}, of which the "
                f"policy takes none: it has learned to take {taken}"
            )
        return kept_NA

    def _masked(self, observation: Any, action_mask: Any) -> Any:
        """An observation with its legal actions."""
        masks = self._world.masks
        if not isinstance(masks, ActionMasks):
            if action_mask is not None:
                raise PgtsError(
                    f"action_mask is given; {self._name} was trained without action masks, with all actions legal"
                )
            return observation
        if action_mask is None and not self._world.shows_masks:
            return observation  # a table knows the legal actions of each state
        if action_mask is None:
            action_mask = masks.given(observation, {})
        if action_mask is None:
            raise PgtsError(
                f"{self._name} has action masks: give the one of this observation, as {masks.what} has it, in "
                "predict(observation, action_mask=...)"
            )
        one = isinstance(action_mask, tuple) or np.ndim(action_mask) <= 1
        legal_A = masks.read(action_mask) if one else np.array([masks.read(row) for row in np.asarray(action_mask)])
        return Masked(observation, legal_A)
