"""Rewards are held to the range that was promised, and what needs a bound of them is refused without one."""

import math

import gymnasium
import numpy as np
import pytest
import torch

from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import ModelMismatch, PgtsError
from pgts_torch.models.rewards import RewardRange
from pgts_torch.tabular import exact, random_mdp, stationary
from tests.agent.helpers import vector_env


class Walk(gymnasium.Env):
    """A corridor of 6 cells; 'right' at its end pays `prize` and ends the episode."""

    def __init__(self, prize: float = 1.0, toll: float = 0.0) -> None:
        self.observation_space = gymnasium.spaces.Box(0, 6, (1,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)
        self.prize, self.toll, self.cell = prize, toll, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self._seen(), {}

    def step(self, action):
        ends = self.cell == 5 and action == 1
        self.cell = max(0, min(5, self.cell + (1 if action == 1 else -1)))
        return self._seen(), self.prize if ends else -self.toll, ends, False, {}

    def _seen(self):
        return np.array([self.cell], dtype=np.float32)

    def get_state(self):
        return self.cell

    def set_state(self, state):
        self.cell = state


def walking(**arguments) -> PGTS:
    prizes = {name: arguments.pop(name) for name in ("prize", "toll") if name in arguments}
    return PGTS(lambda: Walk(**prizes), **{"num_envs": 4, "gamma": 0.9, **arguments})


@pytest.mark.fault("no largest reward is known")
@pytest.mark.parametrize("wanted", [{"stop_at": 0.1}, {"depth": "adaptive"}, {"depth": "adaptive", "stop_at": 0.1}])
def test_what_needs_a_bound_is_refused_where_there_is_none(wanted):
    with pytest.raises(
        PgtsError, match=r"(stop_at is 0.1|depth is adaptive), which needs .* set reward_range \(env.reward"
    ):
        walking(**wanted)
    with pytest.raises(PgtsError, match="gamma is 1, with which rewards may add up without limit"):
        walking(**wanted, reward_range=(0, 1), gamma=1.0)
    with pytest.raises(PgtsError, match="action_repeat is 2, and values of repeated actions have no bound"):
        walking(**wanted, action_repeat=2)
    with pytest.raises(PgtsError, match="search that samples outcomes gives no upper bound"):
        PGTS("pgts/Ladder-v0", **wanted, search="sampled")
    walking(**wanted, reward_range=(0, 1))
    walking(**wanted, reward_range=(-1, 0), gamma=1.0, prize=0.0, toll=1.0)
    PGTS("CartPole-v1", **wanted)


def test_an_adaptive_depth_in_a_simulator_is_less_than_its_largest():
    model = walking(depth="adaptive", reward_range=(0, 1))
    iterations = [model.iterate() for _ in range(3)]
    assert max(iteration.depth for iteration in iterations) < 64
    assert iterations[-1].certificate == math.inf  # four sampled starts prove nothing


def test_values_follow_from_the_range_and_bound_those_that_there_are():
    assert RewardRange(-2, 3).values(0.9) == pytest.approx((-20, 30), rel=1e-5)
    assert RewardRange(2, 3).values(0.9) == pytest.approx((0, 30), rel=1e-5)  # an end earns nothing more
    assert RewardRange(-3, -2).values(1.0) == (-math.inf, 0)
    for seed in range(5):
        mdp = random_mdp(8, 2, seed=seed, gamma=0.9)
        rewards_SA = mdp.outcomes.reward_NA
        low, high = RewardRange(float(rewards_SA.min()), float(rewards_SA.max())).values(0.9)
        least_S, most_S = exact.policy_values(mdp, stationary.worst_policy(mdp)), exact.optimal(mdp).v_S
        assert low <= float(least_S.min()) <= float(most_S.max()) <= high


@pytest.mark.fault("a reward outside reward_range")
@pytest.mark.parametrize("depth", [0, 6])
@pytest.mark.parametrize("outside", [{"prize": 1.5}, {"toll": 0.1}])
def test_a_reward_outside_the_range_stops_before_the_policy_moves(depth, outside):
    model = walking(depth=depth, reward_range=(0, 1), **outside)
    before = [parameter.clone() for parameter in model.policy.network.parameters()]
    with pytest.raises(ModelMismatch, match=r"a reward is (1.5|-0.1); reward_range says that all are from 0 to 1"):
        model.learn(2_000)
    if model.num_iterations == 0:
        assert all(map(torch.equal, before, model.policy.network.parameters()))
    walking(depth=depth, reward_range=(-0.1, 1.5), **outside).learn(300)


def test_rewards_in_float32_are_not_outside():
    RewardRange(0.0, 0.1).check(np.float32(0.1))
    RewardRange(-0.3, 1e6).check([np.float32(-0.3), 1e6 + 0.01, -math.inf])
    with pytest.raises(ModelMismatch, match="a reward is 1e-09"):
        RewardRange(-1.0, 0.0).check(1e-9)
    with pytest.raises(ModelMismatch, match=r"a reward is 0\.1001"):
        RewardRange(0.0, 0.1).check(0.1001)


def test_a_table_with_other_rewards_is_refused_and_one_within_keeps_the_smaller_bound():
    mdp = random_mdp(5, 2, seed=0, gamma=0.9)
    high = float(mdp.outcomes.reward_NA.max())
    with pytest.raises(ModelMismatch, match=r"reward_range says that all are from 0 to 0\.5"):
        PGTS(vector_env(mdp, 2), reward_range=(0, 0.5))
    for promised in (high, 1000.0):
        model = PGTS(vector_env(mdp, 2), reward_range=(-1000, promised)).world.model
        assert model.highest_value == pytest.approx(high / 0.1)


@pytest.mark.parametrize("given", [(1, 0), (0, math.inf), (0,), "01x", 3, (math.nan, 1)])
def test_what_is_no_range_is_refused(given):
    with pytest.raises(PgtsError, match=r"reward_range is .*; it must be two"):
        walking(reward_range=given)


def test_it_is_saved_with_the_model(tmp_path):
    walking(reward_range=(0, 1)).save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", env=Walk)
    assert loaded.world.reward_range == RewardRange(0, 1)
