"""What depth is for, learned from samples: [PGTS Ex. 1, Ex. 3, Fig. 2] without exact quantities; and that each family
of environments is learned at all."""

import functools
from typing import Any

import pytest

from pgts_torch import PGTS
from pgts_torch.agent import candidates as worlds
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.tabular import exact

pytestmark = pytest.mark.usefixtures("unchecked_shapes")  # other tests check them; here they cost half the time

LADDER_OPTIMUM = 0.9**4 / 0.1
TIGHTROPE_OPTIMUM = 0.9**2 / 0.1


def exact_return(model: PGTS) -> float:
    return exact.evaluate(model.mdp, model.policy.table()).J


@functools.cache
def climbed(depth: int, seed: int) -> float:
    """J of a policy that began 99 % 'left' on the ladder, after 20 iterations of 320 steps."""
    model = PGTS(
        "pgts/Ladder-v0",
        depth=depth,
        policy={"type": "softmax", "init": {"type": "biased", "action": 0, "probability": 0.99}},
        critic={"type": "tabular", "method": {"type": "td_lambda", "lambda": 0.9}, "step_size": 0.5},
        update={"type": "softmax", "step_size": 10.0},
        horizon={"type": "fixed", "length": 20},
        num_envs=16,
        seed=seed,
    )
    return exact_return(model.learn(20 * 320))


@pytest.mark.parametrize("depth", [4, 5])
def test_with_a_lookahead_of_four_steps_or_more_the_ladder_is_climbed(depth):
    assert sum(climbed(depth, seed) >= 0.95 * LADDER_OPTIMUM for seed in range(10)) >= 9


@pytest.mark.parametrize("depth", [0, 1, 2, 3])
def test_with_a_shorter_lookahead_and_equal_samples_the_policy_stays_at_the_foot(depth):
    assert all(climbed(depth, seed) < 0.05 * LADDER_OPTIMUM for seed in range(5))


def test_from_always_left_the_tightrope_is_crossed_at_depth_2_and_never_entered_at_depth_0():
    def trained(depth: int) -> PGTS:
        model = PGTS(
            "pgts/Tightrope-v0",
            depth=depth,
            policy={"type": "simplex", "init": {"type": "biased", "action": 0, "probability": 1}},
            update={"type": "projected", "step_size": 0.1},
            horizon={"type": "fixed", "length": 30},
            num_envs=8,
        )
        return model.learn(30 * 240)

    assert exact_return(trained(2)) == pytest.approx(TIGHTROPE_OPTIMUM)
    stuck = trained(0)
    assert exact_return(stuck) == 0
    assert stuck.policy.table()[0].tolist() == [1.0, 0.0]


def test_mirror_steps_find_the_treasure_of_the_deep_sea():
    def trained(depth: int) -> float:
        model = PGTS(
            "pgts/DeepSea-v0",
            depth=depth,
            update={"type": "mirror", "step_size": 5.0, "state_weight": "uniform"},
            num_envs=4,
            env_kwargs={"n": 12},
        )
        return exact_return(model.learn(15 * 4 * 12))

    # 60 episodes of a policy that is still uniform meet the treasure with probability 60 / 2^12.
    optimum = exact.optimal(PGTS("pgts/DeepSea-v0", env_kwargs={"n": 12}).mdp).J
    assert trained(11) >= 0.95 * optimum > 0.5
    assert trained(0) < 0.05 * optimum


def shown(model: PGTS, episodes: int = 10) -> float:
    """The mean return of episodes of a policy, its actions drawn."""
    return evaluate(model, episodes=episodes, deterministic=False, seed=0).episodic_return.mean


def test_the_cliff_is_passed_on_the_shortest_way_at_depth_12_and_feared_at_depth_0():
    def trained(depth: int) -> float:
        model = PGTS(
            "CliffWalking-v1",
            depth=depth,
            critic={"type": "tabular", "method": {"type": "td_lambda", "lambda": 0.9}, "step_size": 0.5},
            update={"type": "mirror", "step_size": 1.0, "state_weight": "uniform"},
            horizon={"type": "fixed", "length": 100},
            num_envs=8,
        )
        return evaluate(model.learn(2_000), episodes=1, deterministic=True, seed=0).episodic_return.mean

    assert trained(12) == -13  # the least number of steps
    assert trained(0) < -100  # as far as 100 steps and more from the goal


@pytest.mark.parametrize("kind", [worlds.DynamicsWorld, worlds.SimulatedWorld])
def test_a_network_learns_to_balance_a_pole_by_dynamics_in_torch_and_by_a_simulator(kind, monkeypatch):
    if kind is worlds.SimulatedWorld:
        monkeypatch.setattr(worlds, "CLASSIC", ())
    network: dict[str, Any] = {"type": "mlp", "hidden": [32]}
    model = PGTS(
        "CartPole-v1",
        depth=1,
        policy=network,
        critic={"type": "network", "network": network, "learning_rate": 1e-2},
        update={"type": "ppo", "learning_rate": 1e-2},
        horizon={"type": "fixed", "length": 200},
        num_envs=8,
    )
    assert isinstance(model.world, kind)
    assert shown(model) < 40
    assert shown(model.learn(4_000)) > 80


def test_a_cnn_learns_to_walk_to_the_goal_that_it_sees():
    pytest.importorskip("minigrid", exc_type=ImportError)
    network: dict[str, Any] = {"type": "cnn", "channels": [8, 16], "hidden": [32], "scale": 10.0}
    model = PGTS(
        "MiniGrid-Empty-5x5-v0",
        depth=2,
        observation_keys=["image"],
        policy=network,
        critic={"type": "network", "network": network, "learning_rate": 3e-3},
        update={"type": "mirror", "temperature": 0.01, "learning_rate": 3e-3},
        horizon={"type": "fixed", "length": 25},
        num_envs=8,
        seed=1,
    )
    assert shown(model) < 0.4
    assert shown(model.learn(1_000)) > 0.8
