"""What the tests of continuous actions share: a double integrator with a policy, and draws from it."""

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from benchmarks.linear import LinearQuadratic
from pgts_torch.agent.gaussian import GaussianPolicy, MixtureProposal
from pgts_torch.models.drawn_actions import DrawnActions
from pgts_torch.options import MLP, Gaussian

GAMMA = 0.9


def gaussian(size: int = 1, observed: int = 2, *, seed: int = 0, spread: float = 0.3, **options) -> GaussianPolicy:
    """A linear policy whose mean and deviation depend on the state."""
    space = spaces.Box(-np.inf, np.inf, (observed,))
    policy = GaussianPolicy(space, size, Gaussian(network=MLP(hidden=[]), **options))
    generator = torch.Generator().manual_seed(seed)
    for weight in policy.network.weights:
        weight.data = spread * torch.randn(weight.shape, generator=generator)
    return policy


class Observing:
    """As much of a world as a proposal reads: observations are states."""

    def __init__(self, model: LinearQuadratic) -> None:
        self.model = model

    def observe(self, state_N: Tensor) -> Tensor:
        return self.model.states(state_N).float()


def drawing(model: LinearQuadratic, policy: GaussianPolicy, count: int, *, key: int = 0, scale: float = 2.0):
    """The model under `count` drawn actions."""
    drawn = DrawnActions(model, count)
    drawn.redraw(MixtureProposal(Observing(model), policy, count, scale, torch.tensor([key])))
    return drawn


def some_states(model: LinearQuadratic, count: int, *, seed: int = 0) -> Tensor:
    """The numbers of random states."""
    generator = torch.Generator().manual_seed(seed)
    return model.number(torch.randn(count, model.state_size, generator=generator, dtype=torch.float64))


class Cart(gymnasium.Env):
    """The double integrator as an environment, with bounded forces."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, bound: float = 2.0, reward_scale: float = 1.0) -> None:
        self.action_space = spaces.Box(-bound, bound, (1,), np.float32)
        self._scale, self._state = reward_scale, np.zeros(2)

    def get_state(self) -> np.ndarray:
        return self._state.copy()

    def set_state(self, state: np.ndarray) -> None:
        self._state = np.array(state)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._state = self.np_random.normal(size=2)
        return self._state.copy(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        x, speed = self._state
        reward = -self._scale * float(x**2 + 0.1 * speed**2 + 0.5 * action[0] ** 2)
        force = float(action[0])
        self._state = np.array([x + 0.5 * speed + 0.125 * force, speed + 0.5 * force])
        return self._state.copy(), reward, False, False, {}
