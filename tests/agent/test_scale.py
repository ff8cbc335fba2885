"""Defaults of tables: no policy depends on the unit of the rewards, nor on a constant in all of them."""

import functools
import itertools
import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.tabular import TabularMDP, corridor, deep_sea, grid, random_mdp, river_swim
from tests.agent.helpers import vector_env
from tests.support import rewarded

MDPS = {
    "grid": lambda: grid(4, goal=15, traps=(5,), slip=0.3, absorbing=True, gamma=0.99),
    "random": lambda: random_mdp(8, 3, branching=2, seed=5),
    "river swim": lambda: river_swim(6),
    "corridor": lambda: corridor(3, 8),
    "deep sea": lambda: deep_sea(5),
}
OPTIONS = {
    "defaults": {},
    "q critic": {"critic": {"type": "tabular", "target": "q", "step_size": "mean"}},
    "exact": {"critic": "exact"},
    "sampled": {"search": {"type": "sampled", "samples": 2}},
    "simplex": {"policy": "simplex", "update": "mirror"},
}


def trained(mdp: TabularMDP, *, iterations: int = 5, **options) -> list[torch.Tensor]:
    """The policies of a training."""
    options = {"num_envs": 4, "horizon": {"type": "fixed", "length": 12}} | options
    model = PGTS(vector_env(mdp, options["num_envs"]), **options)
    policies = []
    for _ in range(iterations):
        model.iterate()
        policies.append(model.policy_table())
    return policies


@functools.cache
def plainly_trained(name: str, depth: int | str) -> list[torch.Tensor]:
    """The policies of a training with the rewards as they are; one for all tests of a process."""
    return trained(MDPS[name](), depth=depth)


def scales() -> Iterator[Any]:
    """Each MDP with each depth and a power of two, of which each comes with every MDP and every depth; the other powers
    in the long form."""
    powers = -20, -3, 20
    for number, (name, depth) in enumerate(itertools.product(MDPS, [0, 4, 16, "adaptive"])):
        for power in powers:
            short = power == powers[number % 3]
            yield pytest.param(name, depth, power, marks=[] if short else pytest.mark.long)


@pytest.mark.fault("rewards in another unit, tables")
@pytest.mark.parametrize(("name", "depth", "power"), [*scales()])
def test_a_power_of_two_on_all_rewards_leaves_every_policy_bit_for_bit(name, depth, power):
    scaled = trained(rewarded(MDPS[name](), factor=math.ldexp(1.0, power)), depth=depth)
    assert all(torch.equal(one, other) for one, other in zip(plainly_trained(name, depth), scaled, strict=True))


@pytest.mark.parametrize("options", OPTIONS)
def test_a_power_of_two_leaves_every_bit_with_other_critics_searches_and_policies(options):
    mdp = MDPS["random"]()
    plain, scaled = (trained(rewarded(mdp, factor=f), depth=3, **OPTIONS[options]) for f in (1.0, 2.0**-20))
    assert all(torch.equal(one, other) for one, other in zip(plain, scaled, strict=True))
    assert (plain[-1] - plain[0]).abs().max() > 0.1


def test_a_step_in_reward_units_does_depend_on_their_scale():
    mdp = MDPS["random"]()
    step = {"update": {"type": "mirror", "normalize": "none"}, "depth": 3}
    assert not torch.equal(trained(mdp, **step)[-1], trained(rewarded(mdp, factor=2.0), **step)[-1])


@pytest.mark.parametrize("factor", [1e-3, 0.3, 1e6])
def test_any_other_factor_changes_no_more_than_the_last_digits(factor):
    scaled = trained(rewarded(MDPS["river swim"](), factor=factor), depth=4)
    torch.testing.assert_close(plainly_trained("river swim", 4), scaled, atol=1e-9, rtol=0)


@pytest.mark.fault("a constant in all rewards of a continuing task, tables")
@pytest.mark.parametrize("constant", [-1.0, 1.0, 1000.0])
@pytest.mark.parametrize("name", ["random", "river swim"])
def test_a_constant_in_all_rewards_of_a_continuing_task_does_not_matter(name, constant):
    mdp = MDPS[name]()
    plain, moved = plainly_trained(name, 4), trained(rewarded(mdp, constant=constant), depth=4)
    torch.testing.assert_close(plain, moved, atol=1e-6, rtol=0)
    critic = {"critic": {"type": "tabular", "initial": 0.0}}
    if name == "river swim":  # where unvisited states count 0 the constant makes them heaven or hell
        assert (trained(rewarded(mdp, constant=constant), depth=4, **critic)[-1] - plain[-1]).abs().max() > 0.01


@pytest.mark.fault("rewards or actions that are all equal, tables")
@pytest.mark.parametrize("critic", ["tabular", "exact"])
@pytest.mark.parametrize("depth", [0, 4, 16])
def test_where_all_rewards_are_equal_rounding_is_no_step(depth, critic):
    mdp = rewarded(random_mdp(8, 3, seed=5, gamma=0.99), factor=0.0, constant=1.0)
    policies = trained(mdp, depth=depth, critic=critic, policy={"type": "softmax", "init": "random"}, iterations=20)
    assert all(torch.equal(pi_SA, policies[0]) for pi_SA in policies)


@pytest.mark.fault("rewards or actions that are all equal, tables")
@pytest.mark.parametrize("policy", ["softmax", "simplex"])
def test_where_all_actions_are_equal_the_policy_stays_as_it_is(policy):
    mdp = random_mdp(8, 1, seed=5)
    outcomes = mdp.outcomes.rows(torch.arange(8))
    P = [
        [
            [
                (float(p), int(child), float(outcomes.reward_NA[s, 0]), False)
                for p, child in zip(outcomes.prob_NAK[s, 0], outcomes.child_NAK[s, 0], strict=True)
            ]
        ]
        * 3
        for s in range(8)
    ]
    init = {"type": "biased", "action": 1, "probability": 1 - 1e-9}
    same = TabularMDP.from_transitions(P, 0.9)
    options = {"update": "mirror", "policy": {"type": policy, "init": init}}
    policies = trained(same, depth=4, **options)
    assert all(torch.equal(pi_SA, policies[0]) for pi_SA in policies)
    assert float(policies[0][0, 1]) == pytest.approx(1 - 1e-9, abs=1e-15)
