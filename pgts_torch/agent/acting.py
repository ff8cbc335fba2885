"""Acting with a trained policy: from observations to actions in the environment's own form."""

from typing import final

import numpy as np
import torch
from numpy.typing import ArrayLike

from pgts_torch.agent.policies import Policy
from pgts_torch.agent.world import World


@final
class Actor:
    """Selects actions by a policy, without search.

    Args:
        world: makes tensors of observations.
        actions: the environment's action for each action of the policy; None: the number of the action itself.
        generator: for sampled actions, unless another one is given.
    """

    def __init__(self, world: World, policy: Policy, actions: np.ndarray | None, generator: torch.Generator) -> None:
        self._world, self._policy, self._actions, self._generator = world, policy, actions, generator

    def __call__(
        self, observation: ArrayLike, *, deterministic: bool, generator: torch.Generator | None
    ) -> np.ndarray | np.generic:
        """As `PGTS.predict`."""
        observation_N = self._world.encode(observation)
        shape = observation_N.shape[: observation_N.ndim - len(self._world.observation_space.shape or ())]
        observation_N = observation_N.reshape(-1, *observation_N.shape[len(shape) :])
        if deterministic:
            action_N = self._policy.probs(observation_N).argmax(-1)
        else:
            action_N = self._policy.sample(observation_N, generator=generator or self._generator)
        action = action_N.cpu().numpy().reshape(shape)
        return action[()] if self._actions is None else self._actions[action]
