"""What depth is for, learned from samples: [PGTS Ex. 1, Ex. 3, Fig. 2] without exact quantities."""

import functools

import pytest

from pgts_torch import PGTS
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
