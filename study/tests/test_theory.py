"""What docs/theory.md proves of stationary policies and depth, on random sparse MDPs and the paper's."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given

from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import (
    TabularMDP,
    ascent,
    exact,
    grid,
    ladder,
    random_mdp,
    stationary,
    stationary_sets,
    tightrope,
)
from study.families import diameter
from study.tests.rules import ladder_rule
from tests.support import mdps_with_policy, random_policy, right_with
from tests.tabular.brute import DEPTHS, EXACT, family, stationary_ones

fast = pytest.mark.usefixtures("unchecked_shapes")


@fast
def test_a_policy_stays_for_all_step_sizes_or_for_none():
    stays = []
    for seed, case in enumerate(family()[::2]):
        depth = (0, 1, 3)[seed % 3]
        policies = [case.pi_SA(p) for p in numpy_stream(seed, "some").integers(0, len(case.J_P), size=2)]
        for pi_SA in [*policies, *(case.pi_SA(p) for m, p in stationary_ones(case)[:2] if m >= depth)]:
            evaluation = exact.evaluate(case.mdp, pi_SA)
            look_SA = exact.lookahead(case.mdp, evaluation.q_SA, depth)
            visited = evaluation.d_S > 0
            verdict = stationary.is_stationary(case.mdp, pi_SA, depth)
            for step_size in (0.01, 1.0, 100.0):
                args = pi_SA[visited], look_SA[visited], evaluation.d_S[visited], step_size
                assert (float((ascent.projected_step(*args) - pi_SA[visited]).abs().max()) < 1e-10) == verdict
            assert torch.allclose(ascent.projected_step(*args[:3], 0.0), pi_SA[visited], atol=1e-14)
            stays.append(verdict)
    assert 30 < sum(stays) < len(stays) - 30


def test_a_policy_takes_best_actions_only_if_and_only_if_its_gap_is_0():
    both = set()
    for case in family():
        taken_MPS = np.take_along_axis(case.look_MPSA, case.action_PS[None, :, :, None], -1)[..., 0]
        takes_best_MP = ((taken_MPS >= case.look_MPSA.max(-1) - EXACT) | ~case.sigma_PS).all(-1)
        assert np.array_equal(takes_best_MP, case.member_MP)
        everywhere_MP = (taken_MPS >= case.look_MPSA.max(-1) - EXACT).all(-1)
        both |= {bool((everywhere_MP != case.member_MP).any())}
    assert both == {True, False}, "states that are not visited would have counted"


@given(mdps_with_policy())
def test_a_stochastic_policy_takes_best_actions_only_if_and_only_if_its_gap_is_0(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    optimum = exact.optimal(mdp)
    mixed_SA = (optimum.q_SA >= optimum.v_S[:, None] - EXACT).double() * pi_SA
    for policy_SA in (pi_SA, mixed_SA / mixed_SA.sum(-1, keepdim=True)):
        evaluation = exact.evaluate(mdp, policy_SA)
        for depth in (0, 2):
            look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
            worst_taken_S = torch.where(policy_SA > 0, look_SA, torch.inf).amin(-1)
            takes_best = (worst_taken_S >= look_SA.amax(-1) - 1e-8)[evaluation.d_S > 0].all()
            assert bool(takes_best) == stationary.is_stationary(mdp, policy_SA, depth, tolerance=1e-8)


def test_the_sets_shrink_with_depth():
    for case in family():
        assert np.all(case.member_MP[1:] <= case.member_MP[:-1])
    assert sum(bool((case.member_MP[1:] < case.member_MP[:-1]).any()) for case in family()) > 40


def test_the_policies_that_never_escape_are_the_optimal_ones():
    for case in family():
        optimal_P = case.lack_P <= EXACT
        assert optimal_P.any()
        assert np.array_equal(case.sets.escape_P.numpy() == stationary_sets.NEVER, optimal_P)
        assert np.all(case.member_MP[:, optimal_P])


@fast
def test_no_stochastic_stationary_policy_is_worse_than_the_worst_deterministic_one():
    tried = 0
    for seed, case in enumerate(family()):
        for depth, p in stationary_ones(case):
            pi_SA = random_policy(case.mdp, seed)
            ties_SA = np.abs(case.look_MPSA[0][p] - case.v_PS[p][:, None]) <= EXACT
            mixed_SA = torch.where(torch.from_numpy(ties_SA), pi_SA, 0.0)
            visited = torch.from_numpy(case.sigma_PS[p])[:, None]
            pi_SA = torch.where(visited, mixed_SA / mixed_SA.sum(-1, keepdim=True).clamp(min=1e-300), pi_SA)
            if stationary.is_stationary(case.mdp, pi_SA, depth):
                J = exact.evaluate(case.mdp, pi_SA).J
                member_P = case.member_MP[depth]
                assert case.J_P[member_P].min() - EXACT <= J
                assert np.abs(case.J_P[member_P] - J).min() <= 1e-8, "it has the return of a deterministic one"
                tried += bool((pi_SA[torch.from_numpy(case.sigma_PS[p])] < 1).any())
    assert tried > 20


@fast
def test_where_ascent_comes_to_rest_it_is_no_worse_than_the_worst_deterministic_policy():
    rested, suboptimal = 0, 0
    for seed, case in enumerate(case for case in family() if case.sets.sufficient_depth > 0):
        start_SA = case.pi_SA(int(numpy_stream(seed, "start").integers(len(case.J_P))))
        end = ascent.ascend(case.mdp, start_SA, depth=0, step_size=100.0, iterations=10)
        if stationary.is_stationary(case.mdp, end.pi_SA, 0):
            assert float(end.J_K[-1]) >= case.sets.worst_return(0) - EXACT
            rested += 1
            suboptimal += float(end.J_K[-1]) < case.sets.J_optimal - 1e-6
    assert rested > 20
    assert suboptimal >= 3, "ascent has met policies that are stationary and not optimal"


def test_the_sufficient_depth_is_at_most_the_closed_form_for_the_smallest_lack():
    for case in family():
        lacks = case.lack_P[case.lack_P > EXACT]
        if len(lacks):
            assert case.sets.sufficient_depth <= stationary.depth_for(case.mdp, 0.999 * lacks.min())


def test_depth_0_suffices_where_every_policy_visits_every_state():
    connected = [case for case in family() if case.sigma_PS.all()]
    assert len(connected) > 42, "a uniform start is not the only way"
    assert all(case.sets.sufficient_depth == 0 for case in connected)
    for mdp in (grid(2, traps=(1,)), grid(3, traps=(1,), gamma=0.99), random_mdp(), ladder(5, start=None)):
        assert stationary_sets.enumerate_sets(mdp).sufficient_depth == 0
    assert stationary_sets.enumerate_sets(grid(2, traps=(), slip=0.0)).sufficient_depth > 0


def test_a_depth_that_reaches_a_reward_earns_something():
    nothing_before = 0
    for case in family():
        rewarded_S = (case.mdp.outcomes.reward_NA > 0).any(-1).numpy()
        reached = [bool((case.reached_S(n) & rewarded_S).any()) for n in DEPTHS]
        if any(reached):
            first = reached.index(True)
            assert all(case.sets.worst_return(depth) > 0 for depth in range(first, 8))
            nothing_before += first > 0 and case.sets.worst_return(first - 1) == 0
    assert nothing_before > 10


def toll(gamma: float, price: float) -> TabularMDP:
    """Two states: staying earns 0 in the first and 1 in the second, crossing to the second costs `price`."""
    there, here = [0.0, 1.0], [1.0, 0.0]
    return TabularMDP.from_dense([[here, there], [there, here]], [[0.0, -price], [1.0, 0.0]], gamma, start=0)


@pytest.mark.parametrize(
    ("gamma", "price", "depth"), [(0.9, 8.0, 21), (0.9, 0.5, 1), (0.9, 8.99, 65), (0.99, 90.0, 239)]
)
def test_a_toll_makes_any_depth_necessary_at_diameter_1(gamma, price, depth):
    mdp = toll(gamma, price)
    expected = math.floor(math.log(1 - price * (1 - gamma) / gamma) / math.log(gamma)) + 1
    assert diameter(mdp) == 1
    assert stationary_sets.enumerate_sets(mdp).sufficient_depth == expected == depth


@pytest.mark.parametrize(("n", "values"), [(2, (0, 0.4, 1)), (4, (0, 0.4, 1)), (5, (0, 0.7))])
@fast
def test_a_policy_of_the_ladder_is_stationary_by_its_zeros(n, values):
    mdp = ladder(n)
    for right in itertools.product(values, repeat=n):
        pattern = "".join(str(a) if a in (0, 1) else "x" for a in right)
        escape = stationary_sets.escape_depth(mdp, right_with(*right))
        verdicts = [escape == stationary_sets.NEVER or depth < escape for depth in range(n + 1)]
        assert verdicts == [ladder_rule(pattern, depth) for depth in range(n + 1)], right


def test_the_ladder_has_as_many_stationary_policies_as_the_formula_says():
    for n in range(1, 11):
        sets = stationary_sets.enumerate_sets(ladder(n))
        for m in range(n + 1):
            formula = 1 + sum(2**m * (2 ** (n - 1 - j - m) - 1) for j in range(n - 1 - m))
            assert sets.count(m) == formula
    assert [stationary_sets.enumerate_sets(ladder(5)).count(m) for m in range(5)] == [27, 23, 17, 9, 1]


@pytest.mark.parametrize("gamma", [0.3, 0.9, 0.99])
def test_on_the_tightrope_staying_stops_being_stationary_at_10_11_for_every_discount(gamma):
    mdp, low, high = tightrope(gamma=gamma), 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        stays = stationary.is_stationary(mdp, right_with(0, middle, 0.5, 0.5), 0, tolerance=1e-12)
        low, high = (middle, high) if stays else (low, middle)
    assert low == pytest.approx(10 / 11, abs=1e-8)


def detour(delta: float, gamma: float = 0.9) -> TabularMDP:
    """From state 0, action 0 leads to 1 a step, action 1 to a state with 0 or 1 - delta a step."""
    to = np.eye(3)
    P = [[to[1], to[2]], [to[1], to[1]], [to[2], to[2]]]
    return TabularMDP.from_dense(P, [[0, 0], [1, 1], [0, 1 - delta]], gamma, start=0)


def test_more_depth_can_see_less_difference_and_take_more_steps():
    gamma, delta = 0.9, 0.1
    mdp = detour(delta, gamma)
    pi_SA = torch.tensor([[0.5, 0.5], [0.5, 0.5], [1.0, 0.0]], dtype=torch.float64)
    q_SA = exact.evaluate(mdp, pi_SA).q_SA
    iterations = []
    for depth in (0, 5, 10, 40):
        look_A = exact.lookahead(mdp, q_SA, depth)[0]
        assert float(look_A[0] - look_A[1]) == pytest.approx(gamma * (delta + (1 - delta) * gamma**depth) / (1 - gamma))
        J_K = ascent.ascend(mdp, pi_SA, depth=depth, step_size=0.12, iterations=20).J_K
        iterations.append(int((J_K >= 0.99 * exact.optimal(mdp).J).nonzero()[0]))
    assert iterations == sorted(iterations)
    assert iterations[0] == 1
    assert iterations[-1] >= 5
