"""Environments that are seen as images."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pgts_torch.envs.images import Catch
from pgts_torch.errors import PgtsError
from pgts_torch.models.wrappers import wrappers_of


def test_catch_is_an_environment_as_gymnasium_defines_them():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("images/Catch-v0").unwrapped, skip_render_check=True)


def test_who_follows_the_ball_catches_it_and_who_flees_does_not():
    env, returns = Catch(), {1: set(), -1: set()}
    for towards in returns:
        for seed in range(20):
            image, over = env.reset(seed=seed)[0], False
            while not over:
                ball, paddle = int(image[:-1].max((0, 2)).argmax()), int(image[-1].argmax())
                image, reward, over, truncated, _ = env.step(1 + towards * int(np.sign(ball - paddle)))
                assert not truncated
                assert (reward != 0) == over
            returns[towards].add(reward)
    assert returns[1] == {1.0}
    assert -1.0 in returns[-1]


def test_an_episode_lasts_as_long_as_the_ball_falls():
    env = Catch(rows=4, columns=3)
    assert env.reset(seed=0)[0].shape == (4, 3, 1)
    assert [env.step(1)[2] for _ in range(3)] == [False, False, True]
    with pytest.raises(PgtsError, match="rows is 1"):
        Catch(rows=1)


def test_all_of_a_minigrid_room_is_seen():
    pytest.importorskip("minigrid")
    env = gymnasium.make("images/Minigrid-v0", room="MiniGrid-Empty-8x8-v0")
    image = env.reset(seed=0)[0]
    assert image.shape == (8, 8, 3)
    assert (image[..., 0] == 10).sum() == 1  # the agent
    assert (image[..., 0] == 8).sum() == 1  # the goal, which the agent's own view need not show


def test_a_game_of_atari_is_seen_as_a_stack_of_small_grey_frames_and_its_actions_stick():
    for package in ("ale_py", "cv2"):
        pytest.importorskip(package, exc_type=ImportError)
    env = gymnasium.make("images/Atari-v0", game="ALE/Breakout-v5", size=42, stack=3)
    image = env.reset(seed=0)[0]
    assert image.shape == env.observation_space.shape == (3, 42, 42)
    assert image.max() > 0
    wrappers = [type(each).__name__ for each in wrappers_of(env)]
    assert "StickyAction" in wrappers
    assert env.unwrapped.ale.getFloat("repeat_action_probability") == 0.0
    plain = gymnasium.make("images/Atari-v0", game="ALE/Breakout-v5", sticky=0)
    assert "StickyAction" not in [type(each).__name__ for each in wrappers_of(plain)]
