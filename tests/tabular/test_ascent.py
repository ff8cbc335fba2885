"""Algorithm 1 with exact quantities, and the three ways in which a policy may move."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import TabularMDP, exact, ladder, random_mdp, stationary, tightrope
from pgts_torch.tabular.ascent import (
    ascend,
    mirror_step,
    project_simplex,
    projected_step,
    softmax_direction,
    softmax_step,
)
from tests.support import always, random_policy, right_with, uniform_policy, weights, zoo

LEFT, RIGHT = 0, 1
STEPS = [projected_step, softmax_step, mirror_step]


def row(*numbers: float) -> Tensor:
    return torch.tensor([numbers], dtype=torch.float64)


# Projection


def nearest_distribution(x: list[float]) -> list[float]:
    """The projection onto the simplex by trying every support, in exact arithmetic."""
    exact_x = [Fraction(number) for number in x]
    candidates = []
    for size in range(1, len(x) + 1):
        for kept in itertools.combinations(range(len(x)), size):
            tau = (sum(exact_x[i] for i in kept) - 1) / size
            p = [exact_x[i] - tau if i in kept else Fraction(0) for i in range(len(x))]
            if min(p) >= 0:
                candidates.append((sum((a - b) ** 2 for a, b in zip(p, exact_x, strict=True)), p))
    return [float(number) for number in min(candidates)[1]]


numbers = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 0.5, 1e-9, 1e15, -1e15]), st.floats(-2, 2), st.floats(-1e6, 1e6))


@given(st.lists(numbers, min_size=1, max_size=5))
@example([0.0, 0.0, 0.0])
@example([1e15, 1e15, -1e15, 1e15])
@example([1e15, 1e15 - 0.25])
@example([7.0])
@example([0.25, 0.25, 0.5])
@example([1.0, 0.0, 0.0])
@example([-1e300, -1e300])
def test_the_projection_is_the_nearest_distribution(x):
    torch.testing.assert_close(project_simplex(row(*x)), row(*nearest_distribution(x)), rtol=1e-14, atol=1e-14)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=8))
def test_the_projection_is_a_distribution_and_does_not_move_one(x):
    p_NA = project_simplex(row(*x))
    assert torch.all(p_NA >= 0)
    assert p_NA.sum().item() == pytest.approx(1, abs=1e-14)
    torch.testing.assert_close(project_simplex(p_NA), p_NA, rtol=0, atol=1e-15)


def test_each_row_is_projected_by_itself():
    x_NA = torch.cat([row(3.0, 1.0, 0.0), row(0.1, 0.2, 0.3), row(-5.0, -5.0, -5.0)])
    assert torch.equal(project_simplex(x_NA), torch.cat([project_simplex(x_NA[n : n + 1]) for n in range(3)]))


# One step


@pytest.mark.parametrize("step", STEPS)
def test_a_step_is_a_distribution_and_a_step_of_size_0_moves_nothing(step):
    mdp = zoo("garnet")
    pi_SA, q_SA, d_S = random_policy(mdp), torch.randn(30, 3, dtype=torch.float64), torch.rand(30, dtype=torch.float64)
    moved_SA = step(pi_SA, q_SA, d_S, 0.7)
    torch.testing.assert_close(moved_SA.sum(-1), torch.ones(30, dtype=torch.float64), rtol=0, atol=1e-14)
    assert torch.all(moved_SA >= 0)
    assert not torch.allclose(moved_SA, pi_SA, atol=1e-3)
    torch.testing.assert_close(step(pi_SA, q_SA, d_S, 0.0), pi_SA, rtol=0, atol=1e-15)


@pytest.mark.parametrize("step", STEPS)
def test_a_step_raises_the_mean_of_the_values_it_was_given(step):
    mdp = zoo("garnet")
    pi_SA, q_SA, d_S = random_policy(mdp), torch.randn(30, 3, dtype=torch.float64), torch.ones(30, dtype=torch.float64)
    assert torch.all((step(pi_SA, q_SA, d_S, 0.1) * q_SA).sum(-1) > (pi_SA * q_SA).sum(-1))


@pytest.mark.parametrize("step", STEPS)
def test_the_weight_of_a_state_is_a_step_size_of_its_own(step):
    pi_NA, q_NA, one_N = row(0.2, 0.3, 0.5), row(1.0, -1.0, 0.5), torch.ones(1, dtype=torch.float64)
    assert torch.allclose(step(pi_NA, q_NA, 3 * one_N, 0.1), step(pi_NA, q_NA, one_N, 0.3), atol=1e-15)
    assert torch.equal(step(pi_NA, q_NA, 0 * one_N, 0.1), step(pi_NA, q_NA, one_N, 0.0))


@pytest.mark.parametrize("step", [softmax_step, mirror_step])
def test_softmax_and_mirror_steps_leave_zeros_at_zero(step):
    one_N = torch.ones(1, dtype=torch.float64)
    moved_NA = step(row(0.0, 0.4, 0.6), row(100.0, 1.0, 2.0), one_N, 0.5)
    assert moved_NA[0, 0] == 0
    assert moved_NA[0, 2] > 0.6
    assert projected_step(row(0.0, 0.4, 0.6), row(100.0, 1.0, 2.0), one_N, 0.5)[0, 0] == 1


def test_a_projected_step_on_paper():
    moved_NA = projected_step(row(0.5, 0.5), row(1.0, 0.0), torch.full((1,), 2.0, dtype=torch.float64), 0.1)
    torch.testing.assert_close(moved_NA, row(0.6, 0.4), rtol=0, atol=1e-15)


def test_a_mirror_step_maximises_linear_gain_minus_divergence():
    pi_NA, q_NA, eta = row(0.2, 0.3, 0.5), row(1.0, -1.0, 0.5), 0.8
    weight_N = torch.full((1,), 1.7, dtype=torch.float64)

    def objective(p: np.ndarray) -> np.ndarray:
        divergence = (p * np.log(np.maximum(p, 1e-300) / pi_NA.numpy())).sum(-1)
        return (p * (eta * 1.7 * q_NA.numpy())).sum(-1) - divergence

    n = 400
    i, j = np.indices((n + 1, n + 1)).reshape(2, -1)
    every = np.stack([i, j, n - i - j], -1)[i + j <= n] / n
    p_NA = mirror_step(pi_NA, q_NA, weight_N, eta).numpy()
    assert objective(p_NA) >= objective(every).max()
    best = every[objective(every).argmax()]
    assert np.abs(best - p_NA).max() < 2 / n
    assert np.abs(best - projected_step(pi_NA, q_NA, weight_N, eta).numpy()).max() > 2 / n


# The gradient in the logits


@given(st.integers(1, 6), st.integers(1, 4), st.integers(0, 10**6))
def test_the_softmax_direction_is_the_gradient_of_the_surrogate(num_states, num_actions, seed):
    random = np.random.default_rng(seed)
    logits, q, d = (torch.from_numpy(random.normal(size=(num_states, num_actions))) for _ in range(3))
    logits.requires_grad_()
    pi_SA, d_S = logits.softmax(-1), d[:, 0].abs()
    (gradient,) = torch.autograd.grad((d_S * (pi_SA * q).sum(-1)).sum(), logits)
    torch.testing.assert_close(softmax_direction(pi_SA.detach(), q, d_S), gradient, rtol=1e-12, atol=1e-12)


def differentiable_return(mdp: TabularMDP, pi_SA: Tensor) -> Tensor:
    W = torch.from_numpy(weights(mdp))
    matrix = torch.eye(mdp.num_states, dtype=torch.float64) - torch.einsum("sa,sat->st", pi_SA, W)
    return mdp.start_S @ torch.linalg.solve(matrix, (pi_SA * mdp.outcomes.reward_NA).sum(-1))


@pytest.mark.parametrize("name", ["ladder", "random, dense", "deep_sea", "FrozenLake"])
def test_at_depth_0_the_softmax_direction_is_the_gradient_of_the_return(name):
    mdp = zoo(name)
    logits = random_policy(mdp).log().requires_grad_()
    (gradient,) = torch.autograd.grad(differentiable_return(mdp, logits.softmax(-1)), logits)
    evaluation = exact.evaluate(mdp, logits.softmax(-1))
    pi_SA = logits.detach().softmax(-1)
    direction = softmax_direction(pi_SA, evaluation.q_SA, evaluation.d_S)
    torch.testing.assert_close(direction, gradient, rtol=1e-9, atol=1e-10)
    deeper = softmax_direction(pi_SA, exact.lookahead(mdp, evaluation.q_SA, 1), evaluation.d_S)
    assert not torch.allclose(deeper, gradient, rtol=1e-3)


@pytest.mark.parametrize("name", ["ladder", "random, dense", "deep_sea", "FrozenLake"])
def test_the_gradient_of_the_return_in_the_policy_is_occupancy_times_q(name):
    mdp = zoo(name)
    pi_SA = random_policy(mdp).requires_grad_()
    (gradient,) = torch.autograd.grad(differentiable_return(mdp, pi_SA), pi_SA)
    evaluation = exact.evaluate(mdp, pi_SA)
    expected = evaluation.d_S[:, None] * evaluation.q_SA
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-10)


# Algorithm 1


def always_left(mdp: TabularMDP) -> Tensor:
    return always(mdp, LEFT)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("step_size", [0.1, 10.0])
@pytest.mark.parametrize("depth", range(7))
def test_from_always_left_the_ladder_is_climbed_from_depth_4_on(depth, step_size):
    mdp = ladder(5)
    ascent = ascend(mdp, always_left(mdp), depth=depth, step_size=step_size, iterations=15)
    if depth < 4:
        assert torch.equal(ascent.pi_SA, always_left(mdp))
        assert torch.all(ascent.J_K == 0)
    else:
        assert ascent.J_K[-1].item() == pytest.approx(0.9**4 / 0.1)


@pytest.mark.usefixtures("unchecked_shapes")
def test_from_a_uniform_start_plain_policy_gradient_climbs_the_ladder_later_than_depth_4():
    mdp = ladder(5, start=None)
    shallow, deep = (ascend(mdp, always_left(mdp), depth=m, step_size=0.1, iterations=100).J_K for m in (0, 4))
    best = exact.optimal(mdp).J
    assert shallow[-1] == deep[-1] == pytest.approx(best)
    assert (deep > 0.99 * best).nonzero()[0] < (shallow > 0.99 * best).nonzero()[0]


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("step_size", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("seed", range(2))
def test_plain_policy_gradient_never_lowers_the_return(seed, step_size):
    for mdp in (random_mdp(seed=seed, start=None), random_mdp(5, 3, branching=2, seed=seed)):
        J_K = ascend(mdp, uniform_policy(mdp), depth=0, step_size=step_size, iterations=20).J_K
        assert torch.all(J_K.diff() >= -1e-10)
        assert J_K[-1] > J_K[0]


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize("step_size", [0.01, 0.1])
def test_on_the_tightrope_the_return_of_tree_search_falls_before_it_rises(depth, step_size):
    mdp = tightrope()
    J_K = ascend(mdp, always_left(mdp), depth=depth, step_size=step_size, iterations=80).J_K
    assert J_K.min() < -20
    assert J_K.argmin() > 0
    assert J_K[-1] == pytest.approx(8.1, abs=0.5)
    assert torch.all(J_K[J_K.argmin() :].diff() >= -1e-10)


def test_on_the_tightrope_plain_policy_gradient_stays_where_it_is():
    mdp = tightrope()
    ascent = ascend(mdp, always_left(mdp), depth=0, step_size=0.1, iterations=10)
    assert torch.equal(ascent.pi_SA, always_left(mdp))


@pytest.mark.usefixtures("unchecked_shapes")
def test_on_the_tightrope_from_a_uniform_start_the_return_falls_at_depth_1_only():
    # From depth 2 on, 'left' in s0 sees the same reward one step later, so s0 moves slowly and s1 turns in time.
    mdp = tightrope(start=None)
    best = exact.optimal(mdp).J
    for depth, falls in [(0, False), (1, True), (2, False), (3, False)]:
        J_K = ascend(mdp, always_left(mdp), depth=depth, step_size=0.01, iterations=80).J_K
        assert bool((J_K < J_K[0] - 1).any()) == falls
        assert J_K[-1] == pytest.approx(best, abs=0.5)


@pytest.mark.parametrize("step", STEPS)
def test_states_that_are_not_visited_never_move(step):
    mdp, pi_SA = ladder(6), right_with(0.5, 0.5, 0.0, 0.5, 0.3, 0.7)
    moved_SA = ascend(mdp, pi_SA, depth=5, step_size=0.1, iterations=1, step=step).pi_SA
    assert torch.equal(moved_SA[3:], pi_SA[3:])
    everywhere = ascend(ladder(6, start=None), pi_SA, depth=5, step_size=0.1, iterations=1, step=step).pi_SA
    assert torch.all((everywhere[3:] - pi_SA[3:]).abs().amax(-1) > 1e-6)


@pytest.mark.parametrize("depth", [0, 1, 3])
@pytest.mark.parametrize("step_size", [1e-3, 1.0, 1e3])
def test_whether_a_policy_stays_does_not_depend_on_the_step_size(depth, step_size):
    mdp = ladder(5)
    for right in [
        (0, 0, 0, 0, 0),
        (1, 1, 1, 1, 1),
        (0, 0, 0.5, 0.5, 0.5),
        (0.5, 0.5, 0.5, 0, 0),
        (0, 0.5, 0, 1, 1),
    ]:
        pi_SA = right_with(*right)
        moved_SA = ascend(mdp, pi_SA, depth=depth, step_size=step_size, iterations=1).pi_SA
        assert torch.allclose(moved_SA, pi_SA, atol=1e-9) == stationary.is_stationary(mdp, pi_SA, depth)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("step", STEPS)
def test_every_way_to_move_ends_at_the_optimum_of_a_well_connected_mdp(step):
    mdp = random_mdp()
    ascent = ascend(mdp, uniform_policy(mdp), depth=2, step_size=20.0, iterations=60, step=step)
    assert ascent.J_K[-1] == pytest.approx(exact.optimal(mdp).J, rel=1e-3)
    assert ascent.J_K.shape == (61,)
    assert ascent.J_K[0] == exact.evaluate(mdp, uniform_policy(mdp)).J


def test_ascent_does_not_change_the_policy_it_was_given():
    mdp = random_mdp()
    pi_SA = uniform_policy(mdp)
    ascent = ascend(mdp, pi_SA, depth=1, step_size=1.0, iterations=3)
    assert torch.equal(pi_SA, uniform_policy(mdp))
    assert not torch.equal(ascent.pi_SA, pi_SA)


def test_ascent_takes_a_float32_policy():
    mdp = random_mdp()
    single = ascend(mdp, random_policy(mdp).float(), depth=1, step_size=0.1, iterations=5)
    double = ascend(mdp, random_policy(mdp), depth=1, step_size=0.1, iterations=5)
    torch.testing.assert_close(single.J_K, double.J_K, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("step_size", [-0.1, float("nan"), float("inf")])
def test_a_step_size_that_is_no_size_is_refused(step_size):
    mdp = ladder(3)
    with pytest.raises(PgtsError, match=f"step_size is {step_size}; it must be finite and at least 0"):
        ascend(mdp, always_left(mdp), depth=0, step_size=step_size, iterations=1)


def test_a_depth_that_is_no_depth_is_refused_even_without_iterations():
    mdp = ladder(3)
    with pytest.raises(PgtsError, match="depth is -1"):
        ascend(mdp, always_left(mdp), depth=-1, step_size=0.1, iterations=0)
