"""Environments that are seen as images."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pgts_torch.envs.images import Catch
from pgts_torch.errors import PgtsError


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
