"""The enumeration of stationary sets, bounds on what their policies lack, and certificates, on random sparse MDPs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pgts_torch.bellman import sweep
from pgts_torch.errors import PgtsError
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, ladder, random_mdp, stationary, stationary_sets
from tests.support import always, mdps, mdps_with_policy, random_policy, rewarded
from tests.tabular.brute import DEPTHS, EXACT, family, stationary_ones, with_ends

fast = pytest.mark.usefixtures("unchecked_shapes")
"""For tests of thousands of calls: shapes are checked in the others, and cost more than the arithmetic."""

LEFT = 0


@fast
def test_the_family_is_worth_testing():
    assert all((case.gap_MP <= 1e-12).any() for case in family())
    gaps = np.concatenate([case.gap_MP.ravel() for case in family()])
    assert not ((gaps > 1e-12) & (gaps < 1e-7)).any(), "whether such a policy is stationary is a matter of rounding"
    depths = [case.sets.sufficient_depth for case in family()]
    assert min(depths) == 0
    assert max(depths) >= 4
    assert sum(depth > 0 for depth in depths) > 40


# The enumeration


def test_the_enumeration_finds_what_plain_numpy_finds():
    for case in family():
        assert case.sets.action_PS.tolist() == case.action_PS.tolist()
        np.testing.assert_allclose(case.sets.J_P, case.J_P, rtol=1e-11, atol=1e-11)
        for depth in DEPTHS:
            assert case.sets.member_P(depth).tolist() == case.member_MP[depth].tolist()


@pytest.mark.parametrize("entries", [1, 40, 1000])
def test_the_enumeration_does_not_depend_on_how_much_is_worked_on_at_once(entries, monkeypatch):
    mdps = [random_mdp(5, 3, branching=2, seed=1), ladder(6), deep_sea(2, gamma=1.0), random_mdp(40, 1)]
    expected = [stationary_sets.enumerate_sets(mdp) for mdp in mdps]
    monkeypatch.setattr(stationary_sets, "BATCH_ENTRIES", entries)
    for mdp, all_at_once in zip(mdps, expected, strict=True):
        sets = stationary_sets.enumerate_sets(mdp)
        np.testing.assert_allclose(sets.J_P, all_at_once.J_P, rtol=1e-12, atol=1e-12)
        assert torch.equal(sets.escape_P, all_at_once.escape_P)


@pytest.mark.parametrize("scale", [1e-5, 1e9])
@fast
def test_rewards_in_other_units_change_no_stationary_set(scale):
    for case in family()[:40]:
        sets = stationary_sets.enumerate_sets(rewarded(case.mdp, factor=scale))
        assert torch.equal(sets.escape_P, case.sets.escape_P)


def test_the_histogram_counts_every_policy_at_its_escape_depth():
    sets = stationary_sets.enumerate_sets(ladder(5))
    assert sets.histogram == {stationary_sets.NEVER: 1, 0: 5, 1: 4, 2: 6, 3: 8, 4: 8}


def test_a_policy_that_never_ends_at_gamma_1_is_refused_and_ends_are_enough():
    with pytest.raises(PgtsError, match="gamma is 1 and from state 0 some policy never ends"):
        stationary_sets.enumerate_sets(ladder(4, gamma=1.0))
    sets = stationary_sets.enumerate_sets(deep_sea(3, gamma=1.0))
    assert (sets.J_optimal, sets.sufficient_depth) == (pytest.approx(0.99), 2)


def test_the_worst_return_grows_with_depth():
    grown = 0
    for case in family():
        worst = [case.J_P[member_P].min() for member_P in case.member_MP]
        assert np.all(np.diff(worst) >= 0)
        assert [case.sets.worst_return(depth) for depth in DEPTHS] == pytest.approx(worst, abs=1e-10)
        grown += worst[-1] > worst[0] + EXACT
    assert grown > 40


# Proposition 3 and Corollary 1: the worst case by depth


@fast
def test_no_stationary_policy_lacks_more_than_its_worst_case_bound():
    tightness = []
    for case in family():
        v_optimal_S = case.v_PS.max(0)
        gamma = float(case.mdp.outcomes.discount_NAK.max())
        for depth, p in stationary_ones(case):
            bound = stationary.worst_case_bound(case.mdp, case.pi_SA(p), depth)
            reached = case.reached_S(depth + 1)
            simple = gamma ** (depth + 1) * np.max((v_optimal_S - case.v_PS[p])[reached], initial=0.0)
            q_lack = (exact.optimal(case.mdp).q_SA.numpy() - case.look_MPSA[0][p]).max()
            assert case.lack_P[p] <= bound + EXACT
            assert bound <= simple + EXACT
            assert case.lack_P[p] <= gamma**depth * q_lack + EXACT
            tightness.append(case.lack_P[p] / bound)
    assert len(tightness) > 100
    assert max(tightness) > 0.99
    assert np.median(tightness) > 0.25


@fast
def test_one_more_discount_in_the_bound_would_be_wrong():
    wrong = sum(
        case.lack_P[p] > stationary.worst_case_bound(case.mdp, case.pi_SA(p), depth + 1) + EXACT
        for case in family()
        for depth, p in stationary_ones(case)
    )
    assert wrong > 10
    mdp = ladder(5)
    for depth in range(4):
        assert stationary.worst_case_bound(mdp, always(mdp, LEFT), depth) == pytest.approx(exact.optimal(mdp).J)


@fast
def test_the_bounds_on_all_stationary_policies_hold_and_each_is_sharper_than_the_next():
    sharper = np.zeros(3)
    for case in family()[::2]:
        worst_SA = stationary.worst_policy(case.mdp)
        for depth in (0, 2):
            lack = case.sets.J_optimal - case.sets.worst_return(depth)
            values = stationary.worst_case_bound(case.mdp, worst_SA, depth)
            reach = stationary.reachable_bound(case.mdp, depth)
            bounds = np.array([lack, values, reach, stationary.closed_form_bound(case.mdp, depth)])
            assert np.all(np.diff(bounds) >= -EXACT), bounds
            sharper += np.diff(bounds) > EXACT
    assert np.all(sharper > 10)


def test_the_worst_policy_has_the_least_value_in_every_state():
    for case in family()[:60]:
        worst_SA = stationary.worst_policy(case.mdp)
        np.testing.assert_allclose(exact.policy_values(case.mdp, worst_SA), case.v_PS.min(0), atol=1e-9)


def end_or_stay(gamma: float, reward: float = 1.0) -> TabularMDP:
    """One state in which action 0 ends and action 1 stays; both earn the same."""
    transitions = [[[(1.0, 0, reward, True)], [(1.0, 0, reward, False)]]]
    return TabularMDP.from_transitions(transitions, gamma)


def test_an_end_counts_as_a_reward_of_0():
    mdp = end_or_stay(0.9)
    sets = stationary_sets.enumerate_sets(mdp)
    assert sets.J_optimal - float(sets.J_P.min()) == pytest.approx(9)
    assert stationary.closed_form_bound(mdp, 0) == pytest.approx(9)
    same_everywhere = TabularMDP.from_dense(np.ones((1, 2, 1)), np.ones((1, 2)), 0.9)
    assert stationary.closed_form_bound(same_everywhere, 0) == 0


@given(mdps(max_states=3, max_actions=2), st.floats(1e-6, 50))
def test_the_depth_for_eps_is_the_first_at_which_the_closed_form_is_at_most_eps(mdp, eps):
    depth = stationary.depth_for(mdp, eps)
    assert stationary.closed_form_bound(mdp, depth) <= eps
    assert depth == 0 or stationary.closed_form_bound(mdp, depth - 1) > eps
    sets = stationary_sets.enumerate_sets(mdp)
    assert sets.J_optimal - sets.worst_return(depth) <= eps + EXACT


@pytest.mark.parametrize("depth", [0, 1, 7, 100])
@pytest.mark.parametrize("gamma", [0.1, 0.5, 0.9, 0.999])
def test_the_depth_for_exactly_what_a_depth_allows_is_that_depth(gamma, depth):
    mdp = ladder(5, gamma=gamma)
    eps = stationary.closed_form_bound(mdp, depth)
    assert stationary.depth_for(mdp, eps) == depth
    assert stationary.depth_for(mdp, eps * (1 - 1e-9)) == depth + 1


def test_the_closed_form_is_infinite_at_gamma_1_and_needs_no_depth_at_gamma_0():
    undiscounted = deep_sea(4, gamma=1.0)
    assert stationary.closed_form_bound(undiscounted, 9) == math.inf
    assert [stationary.reachable_bound(undiscounted, depth) for depth in (2, 3)] == [math.inf, 0]
    with pytest.raises(PgtsError, match=r"the largest discount is 1\.0; a depth in closed form needs one below 1"):
        stationary.depth_for(undiscounted, 0.1)
    assert stationary.depth_for(ladder(5, gamma=0.0), 0.1) == 0


@pytest.mark.parametrize("eps", [0.0, -1.0, math.nan])
def test_an_eps_that_is_not_positive_is_refused(eps):
    with pytest.raises(PgtsError, match="it must be greater than 0"):
        stationary.depth_for(ladder(3), eps)


# Propositions 4, 7 and 8: the sufficient depth


def test_the_sufficient_depth_is_the_smallest_at_which_all_stationary_policies_are_optimal():
    for case in family():
        M = case.sets.sufficient_depth
        assert case.lack_P[case.sets.member_P(M).numpy()].max() <= EXACT
        if M > 0:
            assert case.lack_P[case.sets.member_P(M - 1).numpy()].max() > EXACT


# Propositions 5 and 6: certificates


@given(mdps_with_policy())
def test_the_certificate_is_never_below_the_truth_and_never_grows_with_depth(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    lack = exact.optimal(mdp).J - exact.evaluate(mdp, pi_SA).J
    certificates = [stationary.certificate(mdp, pi_SA, depth) for depth in DEPTHS]
    assert min(certificates) >= lack - EXACT
    assert np.all(np.diff(certificates) <= EXACT)


@fast
def test_the_certificate_is_never_below_the_truth_on_sparse_mdps_and_one_from_values_would_be():
    wrong = 0
    for seed, case in enumerate(family()[::4]):
        pi_SA = random_policy(case.mdp, seed)
        J = exact.evaluate(case.mdp, pi_SA).J
        q_SA = exact.evaluate(case.mdp, pi_SA).q_SA
        for depth in (0, 2):
            assert stationary.certificate(case.mdp, pi_SA, depth) >= case.J_P.max() - J - EXACT
            seen_S = exact.lookahead(case.mdp, q_SA, depth).amax(-1)
            wrong += float(case.mdp.start_S @ seen_S) < case.J_P.max() - EXACT
    assert wrong > 30


@fast
def test_the_certificate_is_exact_where_the_expanded_states_are_closed():
    for seed, case in enumerate(family()[2::4]):
        pi_SA = random_policy(case.mdp, seed)
        lack = case.J_P.max() - exact.evaluate(case.mdp, pi_SA).J
        assert stationary.certificate(case.mdp, pi_SA, case.mdp.num_states) == pytest.approx(lack, abs=EXACT)
    left = always(ladder(5), LEFT)
    # The state beyond is worth 1/(1 - gamma) at best; s4 is worth that, so depth 3 knows already.
    expected = [9.0, 8.1, 7.29, 6.561, 6.561, 6.561]
    assert [stationary.certificate(ladder(5), left, depth) for depth in range(6)] == pytest.approx(expected)


@fast
def test_an_mdp_that_looks_the_same_to_the_lookahead_attains_the_certificate():
    hidden = 0
    for seed, case in enumerate(family()[2::3]):
        mdp, pi_SA = case.mdp, random_policy(case.mdp, seed)
        outcomes = mdp.outcomes
        expanded_S = torch.from_numpy(case.reached_S(0) | case.reached_S(1))
        stays_SA1 = torch.arange(mdp.num_states)[:, None, None].expand(outcomes.child_NAK.shape)
        best = replace(
            outcomes,
            reward_NA=torch.where(expanded_S[:, None], outcomes.reward_NA, outcomes.reward_NA.max()),
            child_NAK=torch.where(expanded_S[:, None, None], outcomes.child_NAK, stays_SA1),
        )
        other = exact.optimal(replace(mdp, outcomes=best))
        attained = stationary.certificate(mdp, pi_SA, 1) + exact.evaluate(mdp, pi_SA).J
        assert attained == pytest.approx(other.J, abs=EXACT)
        hidden += not bool(expanded_S.all())
    assert hidden > 10


@fast
def test_the_certificate_is_no_looser_than_the_bound_from_rewards():
    sharper = 0
    for seed, case in enumerate(family()[1::4]):
        pi_SA = random_policy(case.mdp, seed)
        J, w = exact.evaluate(case.mdp, pi_SA).J, stationary.highest_value(case.mdp.outcomes)
        for depth in (0, 2):
            w_S = torch.full((case.mdp.num_states,), w, dtype=torch.float64)
            simple = float(case.mdp.start_S @ sweep(case.mdp.outcomes, w_S, depth + 1)) - J
            certificate = stationary.certificate(case.mdp, pi_SA, depth)
            assert case.J_P.max() - J - EXACT <= certificate <= simple + EXACT
            sharper += certificate < simple - EXACT
    assert sharper > 30


def test_a_certificate_at_gamma_1_is_infinite_until_the_paths_have_ended():
    mdp = deep_sea(3, gamma=1.0)
    pi_SA = always(mdp, LEFT)
    assert [stationary.certificate(mdp, pi_SA, depth) for depth in range(4)] == pytest.approx(
        [math.inf, math.inf, 0.99, 0.99]
    )


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_where_every_reward_is_negative_the_best_that_may_follow_is_one_more_and_an_end(gamma):
    mdp = with_ends(random_mdp(6, 2, branching=2, seed=3, gamma=0.9), 3)
    costs = rewarded(mdp, factor=-1, constant=-1)
    pi_SA = random_policy(costs)
    lack = exact.optimal(costs).J - exact.evaluate(costs, pi_SA).J
    first = stationary.certificate(costs, pi_SA, 0)
    assert lack < first < -exact.evaluate(costs, pi_SA).J
    assert stationary.highest_value(end_or_stay(gamma, reward=-1.0).outcomes) == -1


@given(mdps(), st.integers(0, 10**6))
def test_the_residual_bound_is_above_the_optimal_values_from_any_start(mdp, seed):
    v_S = exact.optimal(mdp).v_S
    assert torch.allclose(stationary.residual_bound(mdp, v_S), v_S, atol=1e-8)
    for scale in (0.1, 1.0, 100.0):
        u_S = torch.from_numpy(numpy_stream(seed, "u").normal(scale=scale, size=mdp.num_states))
        assert bool((stationary.residual_bound(mdp, u_S) >= v_S - EXACT * scale).all())


def test_the_residual_bound_of_a_single_discount_needs_all_of_its_residual():
    mdp = ladder(5)
    v_S, u_S = exact.optimal(mdp).v_S, torch.zeros(5, dtype=torch.float64)
    assert bool((stationary.residual_bound(mdp, u_S) >= v_S).all())
    assert not bool((stationary.residual_bound(mdp, u_S) - 0.01 >= v_S).all()), "it is attained in the last state"
