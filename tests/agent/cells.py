"""Small environments that publish a table, or are restored, and what tests of their worlds share."""

import warnings
from collections.abc import Callable, Sequence
from inspect import signature
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from pgts_torch.agent.make_world import make_world
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.agent.worlds import SimulatedWorld
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.environments import EnvSource
from pgts_torch.options.environment import Observed

KEYWORDS: dict[str, Any] = {"num_envs": 2, "gamma": 0.9, "observed": Observed(), "plain": False, "device": "cpu"}
N = 6


def world_of(env: Any, *, actions_per_dimension: int | None = None, **options: Any) -> World:
    """The world of an environment; options that `make_world` does not know are for the environment."""
    kwargs = {name: options.pop(name) for name in options.keys() - signature(make_world).parameters}
    gamma = options.get("gamma", KEYWORDS["gamma"])
    source = EnvSource.of(env, kwargs=kwargs, gamma=gamma, actions_per_dimension=actions_per_dimension)
    return make_world(source, **KEYWORDS | options)


def refusal_of(env: Any, **options: Any) -> str:
    with pytest.raises(PgtsError) as refused:
        world_of(env, **options)
    return str(refused.value)


def told_of(env: Any) -> str:
    """Why an environment has no table or dynamics: what its refusal says, or a warning beside the simulator that takes
    their place."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            assert type(world_of(env)) is SimulatedWorld
        except MissingModel as refused:
            return str(refused)
    return str(said[0].message)


def vector_of(*makers: Callable[[], gymnasium.Env]) -> SyncVectorEnv:
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)


def reached(world: ModelWorld) -> tuple[torch.Tensor, torch.Tensor]:
    """The number of the state in which the first environment begins, and its observation, after a reset with seed 0."""
    observation, _ = world.env.reset(seed=0)
    encoded = world.encode(observation)
    return world.numbers(world.read(observation, encoded))[:1], encoded[:1]


def agrees(world: ModelWorld, actions: Sequence[int]) -> bool:
    """Whether the model gives the reward and the observation of each of these steps in the first environment."""
    state, _ = reached(world)
    for action in actions:
        outcomes = world.model.outcomes(state)
        observation, reward, *_ = world.env.step(np.full(world.env.num_envs, action))
        state = outcomes.child_NAK[0, action, :1]
        shown = world.encode(observation)[:1].double()
        if float(outcomes.reward_NA[0, action]) != pytest.approx(float(reward[0]), rel=1e-9):
            return False
        if not torch.allclose(world.observe(state).double(), shown, atol=1e-6):
            return False
    return True


def row_of_cells(n: int = N) -> dict[int, dict[int, list[tuple[float, int, float, bool]]]]:
    """Left and right along n cells; the last one pays 1 and ends."""
    P = {
        s: {0: [(1.0, max(0, s - 1), 0.0, False)], 1: [(1.0, s + 1, float(s == n - 2), s == n - 2)]}
        for s in range(n - 1)
    }
    return P | {n - 1: {a: [(1.0, n - 1, 0.0, True)] for a in (0, 1)}}


class Cells(gymnasium.Env):
    """A row of cells that publishes what it is told to."""

    def __init__(self, P: Any, *, starts: Any = None, slip: float = 0.0, pays: float = 1.0, begins: int = 1) -> None:
        self.P, self.position, self.slip, self.pays, self.begins = P, 0, slip, pays, begins
        if starts is not None:
            self.initial_state_distrib = starts
        self.observation_space, self.action_space = spaces.Discrete(N), spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = int(self.np_random.integers(self.begins))
        return self.position, {}

    def step(self, action: int) -> Any:
        if self.slip and self.np_random.random() < self.slip:
            action = 1 - action
        self.position = min(N - 1, max(0, self.position + 2 * int(action) - 1))
        ends = self.position == N - 1
        return self.position, self.pays * ends, ends, False, {}


FIRST = np.eye(N)[0]


class Walk(gymnasium.Env):
    """Right four times pays 1 and ends; restored by its own methods."""

    n = 5
    action_space, observation_space = spaces.Discrete(2), spaces.Box(-1, 10, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = 0
        return self.shown(), {}

    def shown(self) -> np.ndarray:
        return np.array([self.position], np.float32)

    def step(self, action: int) -> Any:
        self.position = max(0, self.position + (1 if action == 1 else -1))
        ends = self.position >= self.n - 1
        return self.shown(), float(ends), ends, False, {}

    def get_state(self) -> Any:
        return self.position

    def set_state(self, state: Any) -> None:
        self.position = state


def heavier() -> gymnasium.Env:
    env = gymnasium.make("CartPole-v1")
    env.unwrapped.gravity = 20  # type: ignore[attr-defined]
    return env
