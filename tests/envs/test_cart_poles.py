"""CartPole as array operations for all: every bit is that of single environments."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.agent.rollout import COLUMNS
from pgts_torch.agent.world import World
from pgts_torch.envs.cart_poles import CartPoles, is_cart_pole
from pgts_torch.models import environments
from pgts_torch.models.environments import EnvSource, check_vector_env

NUM_ENVS = 16
SPEC = gymnasium.spec("CartPole-v1")


def both(**options):
    single = [lambda: gymnasium.make(SPEC, max_episode_steps=-1, **options)] * NUM_ENVS
    return CartPoles(NUM_ENVS, SPEC, **options), SyncVectorEnv(single, autoreset_mode=AutoresetMode.DISABLED)


@pytest.mark.parametrize("options", [{}, {"sutton_barto_reward": True}])
@pytest.mark.parametrize("seeds", ["one", "each", "only at first"])
def test_starts_steps_and_later_starts_have_the_bits_of_single_environments(options, seeds):
    together, single = both(**options)
    random, over = np.random.default_rng(0), 0
    start = list(range(7, 7 + NUM_ENVS)) if seeds == "each" else 7
    assert np.array_equal(together.reset(seed=start)[0], single.reset(seed=start)[0])
    for t in range(300):
        actions = random.integers(0, 2, NUM_ENVS)
        (*ours, _), (*theirs, _) = together.step(actions), single.step(actions)
        for one, other in zip(ours, theirs, strict=True):
            assert np.array_equal(one, other)
        if not (over_B := ours[2]).any():
            continue
        over += int(over_B.sum())
        seed = {"one": t, "each": list(range(t, t + NUM_ENVS)), "only at first": None}[seeds]
        masked = {"seed": seed, "options": {"reset_mask": over_B}}
        assert np.array_equal(together.reset(**masked)[0], single.reset(**masked)[0])
    assert over > NUM_ENVS
    assert np.array_equal(together.state.T, [env.unwrapped.state for env in single.envs])
    check_vector_env(together)


def test_no_step_is_taken_before_a_reset_or_after_the_end_of_an_episode():
    envs, right = CartPoles(2, SPEC), np.array([1, 0])
    with pytest.raises(ResetNeeded):
        envs.step(right)
    with pytest.raises(ResetNeeded):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset(seed=0)
    for _ in range(50):
        if envs.step(right)[2].any():
            break
    with pytest.raises(ResetNeeded):
        envs.step(right)


def test_a_cart_pole_that_was_changed_is_another_environment(monkeypatch):
    assert is_cart_pole(SPEC, {})
    assert is_cart_pole(SPEC, {"sutton_barto_reward": True})
    assert not is_cart_pole(gymnasium.spec("MountainCar-v0"), {})
    assert not is_cart_pole(SPEC, {"render_mode": "rgb_array"})
    plain = CartPoleEnv.step
    monkeypatch.setattr(CartPoleEnv, "step", lambda self, action: plain(self, 1 - action))
    assert not is_cart_pole(SPEC, {})
    assert isinstance(EnvSource.of("CartPole-v1").make(NUM_ENVS), SyncVectorEnv)


@pytest.mark.parametrize("env_kwargs", [{}, {"sutton_barto_reward": True}])
def test_a_training_and_its_evaluation_have_the_bits_of_single_environments(monkeypatch, env_kwargs):
    found = []
    for together in (0, 10**6):
        monkeypatch.setattr(environments, "_TOGETHER", together)
        horizon = {"type": "fixed", "length": 40}
        model = PGTS(
            "CartPole-v1", depth=0, estimator="sampled", num_envs=4, horizon=horizon, gamma=0.99, env_kwargs=env_kwargs
        )
        assert isinstance(model.world.env, CartPoles) == (together == 0)
        model.learn(300)
        found.append((*model.policy.state_dict().values(), evaluate(model, episodes=4).episodic_return.mean))
    for one, other in zip(*found, strict=True):
        assert torch.equal(torch.as_tensor(one), torch.as_tensor(other))


def test_episodes_that_go_on_and_are_restored_have_the_bits_of_single_environments():
    columns = []
    for env in both():
        world = World(env, gamma=0.99)
        policy = NetworkPolicy(world.observation_space, 2)
        episodes, again = (OngoingEpisodes(world, max_length=9, seed=3, names=()) for _ in range(2))
        collect = {"policy": policy, "length": 25, "names": ()}
        episodes.collect(**collect, generator=torch.Generator().manual_seed(0))
        again.load_state_dict(episodes.state_dict())
        made = again.collect(**collect, generator=torch.Generator().manual_seed(1))
        columns.append([made.observation_UB, *(getattr(made, name) for name in COLUMNS)])
        assert made.finished
    for ours, theirs in zip(*columns, strict=True):
        assert torch.equal(ours, theirs)


def test_what_a_model_looks_at_is_single_environments():
    assert isinstance(PGTS("CartPole-v1", num_envs=NUM_ENVS).world.env, SyncVectorEnv)
    assert isinstance(PGTS("CartPole-v1", num_envs=NUM_ENVS, model="ensemble").world.env, CartPoles)
