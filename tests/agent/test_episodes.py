"""Environments are stepped one by one or together; their episodes are the same."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper

from pgts_torch.agent.collect import rollout
from pgts_torch.agent.make_world import make_world
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.models.environments import EnvSource
from pgts_torch.options import FixedHorizon, GeometricHorizon
from pgts_torch.options.environment import Observed
from pgts_torch.options.rollouts import Horizon
from pgts_torch.seeding import stream


class Counted(gymnasium.Wrapper):
    """Counts its steps; every third one has a discount of its own, in each environment another one."""

    def __init__(self, env, phase):
        super().__init__(env)
        self.metadata = env.metadata | {"discounts": True}
        self.num_steps, self.phase = 0, phase

    def step(self, action):
        self.num_steps += 1
        *answer, info = self.env.step(action)
        return *answer, info | ({} if (self.num_steps + self.phase) % 3 else {"discount": 0.5})


class Halved(SyncVectorEnv):
    """Has a step of its own, in which rewards are halved."""

    def step(self, actions):
        observation, reward_B, *rest = super().step(actions)
        return observation, reward_B / 2, *rest


def envs_of(kind: type[SyncVectorEnv] = SyncVectorEnv) -> SyncVectorEnv:
    make = lambda phase: Counted(gymnasium.make("CartPole-v1", max_episode_steps=-1), phase)  # noqa: E731
    return kind([partial(make, phase) for phase in range(6)], autoreset_mode=AutoresetMode.DISABLED)


def made(env: VectorEnv, horizon: Horizon = FixedHorizon(length=100)) -> Rollout:  # noqa: B008 - frozen
    world = make_world(EnvSource.of(env), num_envs=6, gamma=0.9, observed=Observed(), plain=True, device="cpu")
    policy = NetworkPolicy(world.observation_space, 2, seed=1)
    return rollout(world, policy, horizon, seed=0, names=("test",), generator=stream(0, "test"))


def test_environments_whose_episode_is_over_are_not_stepped():
    env, together = envs_of(), envs_of()
    experience = made(env)
    assert sum(each.num_steps for each in env.envs) == experience.num_steps < experience.alive_TB.numel()
    assert [each.num_steps for each in env.envs] == experience.alive_TB.sum(0).tolist()
    made(VectorWrapper(together))
    assert sum(each.num_steps for each in together.envs) == experience.alive_TB.numel()


@pytest.mark.parametrize("horizon", [FixedHorizon(length=100), FixedHorizon(length=7), GeometricHorizon()], ids=str)
def test_stepping_one_by_one_gives_the_episodes_of_stepping_together(horizon):
    alone, together = made(envs_of(), horizon), made(VectorWrapper(envs_of()), horizon)
    alive_TB = alone.alive_TB
    assert torch.equal(alive_TB, together.alive_TB)
    for name in ("action_TB", "reward_TB", "weight_TB", "survival_TB"):
        assert torch.equal(getattr(alone, name)[alive_TB], getattr(together, name)[alive_TB]), name
    for rows in (slice(0, -1), slice(1, None)):  # before a step, and after it
        assert torch.equal(*(one.observation_UB[rows][alive_TB] for one in (alone, together)))
    assert np.array_equal(alone.returns(), together.returns())


@pytest.mark.parametrize("together", [False, True])
def test_a_discount_in_info_is_that_of_its_environment(together):
    experience = made(VectorWrapper(envs_of()) if together else envs_of(), FixedHorizon(length=7))
    named_TB = (torch.arange(1, 8)[:, None] + torch.arange(6)) % 3 == 0
    assert torch.equal(experience.discount_TB, torch.from_numpy(np.where(named_TB, 0.5, 0.9)))


def test_a_vector_environment_with_its_own_step_method_is_stepped_by_it():
    assert float(made(envs_of(Halved)).returns()[0]) == float(made(envs_of()).returns()[0]) / 2
