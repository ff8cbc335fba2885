"""Inversion of the distribution function, at its edges."""

import numpy as np
import pytest
import torch

from pgts_torch.bellman import Outcomes
from pgts_torch.envs.sampler import OutcomeSampler
from pgts_torch.tabular import TabularMDP, grid, ladder, random_mdp

LARGEST_UNIFORM = np.nextafter(1.0, 0.0)


class FixedUniform(np.random.Generator):
    """A generator whose uniform numbers are all the same given one."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self.value = value

    def random(self, size):
        return np.full(size, self.value)


def one_row_mdp(prob, start=0):
    """State 0 has the given outcomes, child k for outcome k; every state is as wide and as likely."""
    K = len(prob)
    outcomes = Outcomes(
        torch.zeros(K, 1, dtype=torch.float64),
        torch.tensor([[prob]], dtype=torch.float64).expand(K, 1, K).clone(),
        torch.full((K, 1, K), 0.9, dtype=torch.float64),
        torch.arange(K).expand(K, 1, K).clone(),
        K,
    )
    start_S = torch.nn.functional.one_hot(torch.tensor(0), K).double() if start == 0 else torch.tensor(start)
    return TabularMDP(outcomes, start_S)


def sampled_child(prob, uniform):
    sampler = OutcomeSampler(one_row_mdp(prob))
    return int(sampler.child_SAK.take(sampler.outcomes(FixedUniform(uniform), np.array([0])))[0])


@pytest.mark.parametrize(
    ("prob", "uniform", "child"),
    [
        ([0.25, 0.75], 0.0, 0),
        ([0.25, 0.75], 0.2499, 0),
        ([0.25, 0.75], 0.25, 1),
        ([0.25, 0.75], LARGEST_UNIFORM, 1),
        ([0.0, 0.5, 0.0, 0.5, 0.0], 0.0, 1),
        ([0.0, 0.5, 0.0, 0.5, 0.0], 0.5, 3),
        ([0.0, 0.5, 0.0, 0.5, 0.0], LARGEST_UNIFORM, 3),
        ([1.0], LARGEST_UNIFORM, 0),
        ([0.1] * 10, LARGEST_UNIFORM, 9),
        ([0.1] * 10, 0.65, 6),
        ([0.5, 0.5 - 9e-10, 0.0], LARGEST_UNIFORM, 1),
        ([0.5, 0.5 + 9e-10, 0.0], LARGEST_UNIFORM, 1),
    ],
)
def test_the_outcome_is_the_interval_that_the_uniform_number_falls_into(prob, uniform, child):
    assert sampled_child(prob, uniform) == child


@pytest.mark.parametrize("K", [1, 2, 3, 4, 5, 7, 8, 9, 16, 17])
def test_bisection_equals_a_linear_search(K):
    random = np.random.default_rng(K)
    prob = random.exponential(size=K) * (random.random(K) < 0.7)
    prob[random.integers(K)] += 1.0
    prob /= prob.sum()
    sampler = OutcomeSampler(one_row_mdp(prob.tolist()))
    for uniform in random.random(50):
        linear = next((k for k in range(K) if uniform < prob[: k + 1].sum()), int(np.flatnonzero(prob)[-1]))
        assert sampler.outcomes(FixedUniform(uniform), np.array([0])) == linear


@pytest.mark.parametrize("uniform", [0.0, 0.5, LARGEST_UNIFORM])
def test_no_outcome_of_probability_0_is_ever_sampled(uniform):
    mdp = grid(size=4, slip=0.0, traps=())  # each row keeps one possible outcome among padding and zeros
    sampler = OutcomeSampler(mdp)
    pair = np.arange(mdp.num_states * mdp.num_actions)
    outcome = sampler.outcomes(FixedUniform(uniform), pair)
    s, a, k = np.unravel_index(outcome, sampler.child_SAK.shape)
    assert (k < mdp.outcomes.num_outcomes).all()
    assert (mdp.outcomes.prob_NAK.numpy()[s, a, k] == 1.0).all()
    assert (s * mdp.num_actions + a == pair).all()


@pytest.mark.parametrize(("uniform", "state"), [(0.0, 1), (0.3, 2), (LARGEST_UNIFORM, 2)])
def test_no_start_of_probability_0_is_ever_sampled(uniform, state):
    sampler = OutcomeSampler(ladder(n=4, start=[0.0, 0.3, 0.7, 0.0]))
    assert sampler.starts(FixedUniform(uniform), 3).tolist() == [state] * 3


def numbers_used(mdp, count):
    """How many uniform numbers `count` outcomes take, read off the generator's position."""
    sampler, random = OutcomeSampler(mdp), np.random.default_rng(0)
    sampler.outcomes(random, np.zeros(count, dtype=int))
    for used in (0, count):
        bits = np.random.PCG64(0)
        if np.random.Generator(bits.advance(used)).bit_generator.state["state"] == random.bit_generator.state["state"]:
            return used
    return None


def test_an_outcome_costs_one_uniform_number_and_a_certain_one_none():
    assert numbers_used(random_mdp(), 1000) == 1000
    assert numbers_used(ladder(), 1000) == 0
