"""One environment: what a step returns, where an episode starts, and what is refused."""

import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded

from pgts_torch.envs import TabularEnv
from pgts_torch.errors import PgtsError
from pgts_torch.tabular import TabularMDP, deep_sea, grid, ladder, random_mdp


def test_a_walk_on_the_ladder_written_out_by_hand():
    env = TabularEnv(ladder(n=3, gamma=0.9))
    assert env.reset() == (0, {})
    assert [env.step(action) for action in (1, 0, 1, 1, 1)] == [
        (1, 0.0, False, False, {"discount": 0.9}),
        (0, 0.0, False, False, {"discount": 0.9}),
        (1, 0.0, False, False, {"discount": 0.9}),
        (2, 0.0, False, False, {"discount": 0.9}),
        (2, 1.0, False, False, {"discount": 0.9}),
    ]
    assert (env.state, env.last_action, env.num_steps) == (2, 1, 5)
    env.reset()
    assert (env.state, env.last_action, env.num_steps) == (0, None, 0)


def test_a_step_terminates_exactly_when_the_sampled_outcome_has_discount_0():
    env = TabularEnv(deep_sea(n=2, gamma=0.99, move_cost=0.0))
    env.reset()
    assert env.step(1) == (3, 0.0, False, False, {"discount": 0.99})
    assert env.step(1) == (3, 1.0, True, False, {"discount": 0.0})


def test_outcomes_of_one_action_may_have_different_rewards_and_discounts():
    P = [[[(0.5, 0, 0.0, False), (0.5, 1, 4.0, True)]], [[(1.0, 1, 0.0, False)]]]
    env = TabularEnv(TabularMDP.from_transitions(P, 0.8, start=0))
    seen = set()
    for seed in range(20):
        env.reset(seed=seed)
        state, reward, terminated, _, info = env.step(0)
        seen.add((state, reward, terminated, info["discount"]))
    assert seen == {(0, 0.0, False, 0.8), (1, 4.0, True, 0.0)}


def test_an_episode_starts_where_it_is_told_to():
    env = TabularEnv(grid(absorbing=True))
    assert env.reset(options={"state": 99}) == (99, {})
    assert env.step(3)[1:3] == (pytest.approx(10.0), True)
    assert env.reset(options={"state": np.int64(11)})[0] == 11
    assert env.reset(options={"state": None})[0] == env.reset(options={})[0] == env.reset()[0] == 0


def test_starts_follow_the_start_distribution():
    env = TabularEnv(ladder(n=4, start=[0.0, 0.5, 0.0, 0.5]))
    env.reset(seed=0)
    starts = [env.reset()[0] for _ in range(400)]
    # A right count is outside 100 to 300 with probability below 1e-23 (Hoeffding).
    assert set(starts) == {1, 3}
    assert 100 < starts.count(1) < 300


def test_setting_the_state_continues_from_there():
    env = TabularEnv(deep_sea(n=3, move_cost=0.0))
    env.reset(options={"state": 8})
    assert env.step(1)[2]
    env.state = 4
    assert env.step(1)[:3] == (8, 0.0, False)
    with pytest.raises(PgtsError, match="state 9 does not exist; states are 0 to 8"):
        env.state = 9


def trajectory(env, seed):
    env.reset(seed=seed)
    return [env.step(action % 2)[0] for action in range(30)]


def test_the_same_seed_gives_the_same_episode_and_another_seed_another():
    env, other = TabularEnv(random_mdp()), TabularEnv(random_mdp())
    assert trajectory(env, 3) == trajectory(env, 3) == trajectory(other, 3)
    assert trajectory(env, 3) != trajectory(env, 4)


def test_no_global_generator_is_touched():
    legacy = np.random.get_state()[1].copy()  # noqa: NPY002 (what must not move is the legacy generator)
    torch_state = torch.get_rng_state()
    trajectory(TabularEnv(random_mdp(start=None)), 0)
    assert (np.random.get_state()[1] == legacy).all()  # noqa: NPY002
    assert torch.equal(torch.get_rng_state(), torch_state)


@pytest.mark.parametrize("action", [2, -1, 0.5, "right"])
def test_an_action_that_does_not_exist_is_named(action):
    env = TabularEnv(ladder())
    env.reset()
    with pytest.raises(PgtsError, match=f"action {action!r} does not exist; actions are 0 to 1"):
        env.step(action)


@pytest.mark.parametrize("state", [5, -1, 1.0, True, "s"])
def test_a_start_state_that_does_not_exist_is_named(state):
    with pytest.raises(PgtsError, match=f"state {state!r} does not exist; states are 0 to 4"):
        TabularEnv(ladder(n=5)).reset(options={"state": state})


def test_an_unknown_reset_option_is_refused():
    with pytest.raises(PgtsError, match="reset has no option 'low'; it has state"):
        TabularEnv(ladder()).reset(options={"low": 0})


def test_a_step_outside_an_episode_is_refused():
    env = TabularEnv(deep_sea(n=1))
    with pytest.raises(ResetNeeded, match=r"Cannot call env.step\(\) before calling env.reset\(\)"):
        env.step(0)
    env.reset()
    env.step(0)
    with pytest.raises(ResetNeeded, match=r"the episode ended in state 0; call env.reset\(\) before"):
        env.step(0)
