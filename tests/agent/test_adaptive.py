"""Adaptive depth, and the certificate that ends a training."""

import math

import pytest
import torch

from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.tabular import exact, ladder, random_mdp, stationary, stationary_sets

LEFT = {"type": "simplex", "init": {"type": "biased", "action": 0, "probability": 1.0}}
EXACT = {"type": "exact"}


def always_left(**arguments):
    """Always 'left' on Ladder(9), with the exact critic."""
    return PGTS("pgts/Ladder-v0", policy=LEFT, critic=EXACT, num_envs=4, env_kwargs={"n": 9}, **arguments)


def optimality_gap(model):
    return exact.optimal(model.mdp).J - exact.evaluate(model.mdp, model.policy.table()).J


def test_a_small_tolerance_takes_the_smallest_depth_at_which_always_left_is_not_stationary():
    model = always_left(depth="adaptive", tolerance=0.05)
    left_SA = model.policy.table()
    assert model.iterate().depth == stationary_sets.escape_depth(model.mdp, left_SA) == 8


def test_by_default_an_adaptive_depth_is_the_first_whose_gap_is_most_of_the_bound():
    model = always_left(depth="adaptive")
    missing_S = exact.optimal(model.mdp).v_S - exact.evaluate(model.mdp, model.policy.table()).v_S
    iteration = model.iterate()
    seen = {m: float(stationary.gap(model.mdp, always_left(depth=m).policy.table(), m)[0]) for m in (18, 19)}
    assert seen[18] <= 0.7 * float(missing_S[0]) < seen[19]
    assert iteration.depth == 19


def test_an_adaptive_depth_goes_no_deeper_than_its_maximum():
    model = always_left(depth="adaptive", max_depth=7)
    for _ in range(3):
        assert model.iterate().depth == 7
    assert optimality_gap(model) > 4


def test_an_adaptive_depth_stays_shallow_where_there_is_a_slope():
    model = PGTS("pgts/Random-v0", depth="adaptive", tolerance=0.05, critic=EXACT, num_envs=4, update="mirror")
    assert model.iterate().depth == 0


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_proved_policy_ends_the_training_and_is_kept():
    model = always_left(depth="adaptive", stop_at=0.05, update={"type": "projected", "step_size": 1.0})
    iterations = []
    model.learn(10**6, callback=lambda _, iteration: iterations.append(iteration))
    assert iterations[-1].certificate <= 0.05 < iterations[-2].certificate
    assert model.num_env_steps < 10**6
    assert optimality_gap(model) <= iterations[-1].certificate
    assert torch.equal(model.policy.table()[iterations[-1].state_N], iterations[-1].pi_NA)


@pytest.mark.usefixtures("unchecked_shapes")
def test_without_stop_at_nothing_ends_early():
    model = always_left(depth=8, update={"type": "projected", "step_size": 1.0})
    assert model.learn(4_000).num_env_steps >= 4_000


@pytest.mark.parametrize("target", ["v", "q"])
@pytest.mark.parametrize("depth", [0, 1, 3, 8, 40])
def test_with_the_exact_critic_the_certificate_is_above_the_optimality_gap(depth, target):
    model = PGTS("pgts/Random-v0", depth=depth, critic={"type": "exact", "target": target}, num_envs=4)
    for _ in range(3):
        missing = optimality_gap(model)
        assert model.iterate().certificate >= missing - 1e-9
    if depth == 40:
        assert model.iterate().certificate < optimality_gap(model) + 0.2


def test_the_certificate_costs_no_model_calls():
    calls = []
    for depth in (0, 3):
        for target in ("v", "q"):
            model = PGTS(
                "pgts/Ladder-v0", depth=depth, policy=LEFT, critic={"type": "exact", "target": target}, num_envs=2
            )
            model.iterate()
            calls.append(model.search.model_calls)
    # From s0, m levels ask about m states of 2 actions each, and v at the leaves takes one level more.
    assert calls == [2, 0, 8, 6]


def test_where_gamma_is_1_there_is_no_certificate():
    assert TabularModel(random_mdp(3, 2, gamma=1.0)).highest_value == math.inf
    assert TabularModel(ladder(gamma=0.5)).highest_value == 2.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"depth": 3, "max_depth": 4}, "max_depth is 4, which only depth adaptive uses; depth is 3"),
        ({"depth": 3, "tolerance": 0.1}, "tolerance is 0.1, which only depth adaptive uses"),
        ({"depth": "adaptive", "max_depth": -1}, "depth is -1"),
        ({"depth": "adaptive", "tolerance": -1.0}, "tolerance is -1.0; it must be a number >= 0"),
        ({"depth": "deep"}, "depth is 'deep'"),
        ({"stop_at": -0.1}, "stop_at is -0.1; it must be a number >= 0"),
    ],
)
def test_arguments_that_are_out_of_range_or_have_no_effect_are_refused(arguments, message):
    with pytest.raises(PgtsError, match=message):
        PGTS("pgts/Ladder-v0", **arguments)
