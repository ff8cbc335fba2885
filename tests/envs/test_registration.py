"""The environments as Gymnasium sees them, and what importing the package costs."""

import importlib
import importlib.metadata
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import pgts_torch
from pgts_torch import tabular
from pgts_torch.envs import TabularEnv, TabularVectorEnv
from pgts_torch.errors import PgtsError
from tests.forks import PATIENCE

TIME_LIMITS = {
    "pgts/Ladder-v0": 100,
    "pgts/Tightrope-v0": 100,
    "pgts/Random-v0": 100,
    "pgts/Grid-v0": 200,
    "pgts/DeepSea-v0": None,
    "pgts/CombinationLock-v0": 100,
    "pgts/RiverSwim-v0": 200,
    "pgts/Corridor-v0": 200,
}
IDS = list(TIME_LIMITS)


def test_importing_the_package_registers_the_environments_without_torch():
    code = "import sys, gymnasium, pgts_torch; print('torch' in sys.modules, 'pgts/Ladder-v0' in gymnasium.registry)"
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE
    ).stdout
    assert printed.split() == ["False", "True"]


def test_a_second_import_neither_warns_nor_changes_the_registry():
    before = {id: gymnasium.spec(id) for id in IDS}
    importlib.reload(pgts_torch)
    assert {id: gymnasium.spec(id) for id in IDS} == before


def test_public_names_are_loaded_on_first_use():
    assert pgts_torch.tabular is tabular
    assert pgts_torch.envs.TabularEnv is TabularEnv
    assert pgts_torch.__version__ == importlib.metadata.version("pgts_torch")
    assert set(dir(pgts_torch)) == set(pgts_torch.__all__)
    assert all(getattr(pgts_torch, name) is not None for name in dir(pgts_torch))
    with pytest.raises(AttributeError, match="module 'pgts_torch' has no attribute 'nothing'"):
        _ = pgts_torch.nothing


@pytest.mark.parametrize("id", IDS)
def test_gymnasium_finds_nothing_to_warn_of(id):
    env = gymnasium.make(id, disable_env_checker=True).unwrapped
    env.action_space.seed(0)
    check_env(env)


def test_the_gymnasium_check_would_notice_an_observation_outside_the_space():
    env = gymnasium.make("pgts/Ladder-v0", n=5, start=3, disable_env_checker=True).unwrapped
    env.observation_space = gymnasium.spaces.Discrete(1)
    with pytest.raises((AssertionError, UserWarning), match="is not within the observation space"):
        check_env(env)


@pytest.mark.parametrize("id", IDS)
def test_an_episode_runs_under_the_passive_checker_until_its_time_limit(id):
    env = gymnasium.make(id, disable_env_checker=False)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(201):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    # DeepSea-10 ends by itself.
    assert (env.unwrapped.num_steps, terminated, truncated) == (
        (TIME_LIMITS[id] or 10),
        id == "pgts/DeepSea-v0",
        id != "pgts/DeepSea-v0",
    )


def test_keyword_arguments_reach_the_zoo():
    env = gymnasium.make("pgts/Ladder-v0", n=7, gamma=0.95, start=None)
    assert isinstance(env.unwrapped, TabularEnv)
    assert env.unwrapped.mdp.num_states == env.observation_space.n == 7
    assert env.unwrapped.mdp.start_S.tolist() == [1 / 7] * 7
    env.reset(seed=0)
    assert env.step(0)[4] == {"discount": 0.95}
    envs = gymnasium.make_vec("pgts/Grid-v0", num_envs=3, size=3, traps=(4,))
    assert envs.single_observation_space == gymnasium.spaces.Discrete(9)
    assert envs.unwrapped.mdp.outcomes.reward_NA[4].tolist() == pytest.approx([-10.0] * 4)


def test_an_unknown_keyword_argument_is_named():
    expected = "pgts/Ladder-v0 has no argument 'm'; it has n, gamma, start"
    with pytest.raises(PgtsError, match=expected):
        gymnasium.make("pgts/Ladder-v0", m=3)
    with pytest.raises(PgtsError, match=expected):
        gymnasium.make_vec("pgts/Ladder-v0", num_envs=2, m=3)


@pytest.mark.parametrize("id", IDS)
def test_make_vec_picks_the_fast_form_with_the_registered_time_limit(id):
    envs = gymnasium.make_vec(id, num_envs=3)
    assert isinstance(envs.unwrapped, TabularVectorEnv)
    assert envs.num_envs == 3
    assert envs.unwrapped.max_episode_steps == TIME_LIMITS[id]
    assert repr(envs) == f"TabularVectorEnv({id}, num_envs=3)"


@pytest.mark.parametrize(("given", "length"), [(3, 3), (None, 100), (-1, None)])
def test_a_time_limit_means_the_same_to_one_environment_and_to_many(given, length):
    def first_truncation(envs):
        envs.reset(seed=0)
        for step in range(1, 111):
            if envs.step(np.zeros(2, dtype=int))[3].any():
                return step
        return None

    for mode in ("sync", "vector_entry_point"):
        kwargs = {"num_envs": 2, "vectorization_mode": mode, "max_episode_steps": given}
        assert first_truncation(gymnasium.make_vec("pgts/Ladder-v0", **kwargs)) == length


def test_a_made_environment_refuses_a_step_before_its_first_reset():
    with pytest.raises(ResetNeeded):
        gymnasium.make("pgts/Ladder-v0").step(0)
    with pytest.raises(ResetNeeded, match=r"Cannot call env.step\(\) before calling env.reset\(\)"):
        gymnasium.make_vec("pgts/Ladder-v0", num_envs=2).step([0, 0])
