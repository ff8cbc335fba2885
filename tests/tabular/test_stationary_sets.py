"""What docs/theory.md proves of the stationary sets, on hundreds of random sparse MDPs.

`Brute` is the second route: every deterministic policy by plain numpy, without the package's own operators.
"""

import functools
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pgts_torch.bellman import sweep
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.stationary import diameter, sparse_random_mdp
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, ascent, deep_sea, exact, grid, ladder, random_mdp, stationary, tightrope
from tests.support import always, mdps, mdps_with_policy, random_policy, right_with, weights

fast = pytest.mark.usefixtures("unchecked_shapes")
"""For tests of thousands of calls: shapes are checked in the others, and cost more than the arithmetic."""

LEFT = 0
DEPTHS = range(5)
EXACT = 1e-9
"""What rounding may do to values of up to 100."""


@dataclass(frozen=True)
class Brute:
    """All deterministic policies of an MDP: their values, where they go, what a lookahead of each depth sees."""

    mdp: TabularMDP
    sets: stationary.StationarySets
    action_PS: np.ndarray
    v_PS: np.ndarray
    sigma_PS: np.ndarray
    look_MPSA: np.ndarray

    @functools.cached_property
    def J_P(self) -> np.ndarray:
        return self.v_PS @ self.mdp.start_S.numpy()

    @functools.cached_property
    def lack_P(self) -> np.ndarray:
        return self.J_P.max() - self.J_P

    @functools.cached_property
    def gap_MP(self) -> np.ndarray:
        return np.where(self.sigma_PS, self.look_MPSA.max(-1) - self.v_PS, 0).max(-1)

    @property
    def member_MP(self) -> np.ndarray:
        return self.gap_MP <= EXACT

    def pi_SA(self, p: int) -> torch.Tensor:
        return torch.eye(self.mdp.num_actions, dtype=torch.float64)[torch.from_numpy(self.action_PS[p])]


def brute(mdp: TabularMDP) -> Brute:
    weight_SAS, reward_SA = weights(mdp), mdp.outcomes.reward_NA.numpy()
    S, A = reward_SA.shape
    action_PS = np.array(list(itertools.product(range(A), repeat=S)))
    P_PSS, r_PS = weight_SAS[np.arange(S), action_PS], reward_SA[np.arange(S), action_PS]
    v_PS = np.linalg.solve(np.eye(S) - P_PSS, r_PS[..., None])[..., 0]
    sigma_PS = np.linalg.matrix_power(np.eye(S) + (P_PSS > 0), S).transpose(0, 2, 1) @ mdp.start_S.numpy() > 0
    look, best_PS = [], v_PS
    for _ in DEPTHS:
        look.append(reward_SA + np.einsum("sat,pt->psa", weight_SAS, best_PS))
        best_PS = look[-1].max(-1)
    return Brute(mdp, stationary.enumerate_sets(mdp), action_PS, v_PS, sigma_PS, np.stack(look))


def with_ends(mdp: TabularMDP, seed: int) -> TabularMDP:
    """The MDP with some outcomes ending and some discounted more than the others."""
    random, discount = numpy_stream(seed, "with_ends"), mdp.outcomes.discount_NAK
    factor = torch.from_numpy(random.choice([0.0, 0.5, 1.0], p=[0.2, 0.1, 0.7], size=tuple(discount.shape)))
    return replace(mdp, outcomes=replace(mdp.outcomes, discount_NAK=discount * factor))


@functools.cache
def family() -> tuple[Brute, ...]:
    """Sparse random MDPs of 3 to 6 states: a fifth starts in two states, a fifth everywhere, a third has ends."""
    found = []
    for seed in range(210):
        random = numpy_stream(seed, "family")
        S = int(random.integers(3, 7))
        mdp = sparse_random_mdp(
            S,
            3 if S == 3 else 2,
            branching=int(random.integers(1, 4)),
            reward_share=float(random.choice([0.1, 0.3, 1.0])),
            gamma=float(random.choice([0.5, 0.9, 0.97])),
            seed=seed,
            start=None if seed % 5 == 0 else 0,
        )
        if seed % 5 == 1:
            mdp = replace(mdp, start_S=torch.tensor([0.25, 0.75] + [0.0] * (S - 2), dtype=torch.float64))
        found.append(brute(with_ends(mdp, seed) if seed % 3 == 0 else mdp))
    return tuple(found)


def stationary_ones(case: Brute) -> list[tuple[int, int]]:
    """(depth, policy) for a few stationary policies that are not optimal."""
    pairs = [(m, int(p)) for m in DEPTHS for p in np.flatnonzero(case.member_MP[m] & (case.lack_P > EXACT))]
    return pairs[:: max(1, len(pairs) // 4)]


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
    expected = [stationary.enumerate_sets(mdp) for mdp in mdps]
    monkeypatch.setattr(stationary, "_BATCH_ENTRIES", entries)
    for mdp, all_at_once in zip(mdps, expected, strict=True):
        sets = stationary.enumerate_sets(mdp)
        np.testing.assert_allclose(sets.J_P, all_at_once.J_P, rtol=1e-12, atol=1e-12)
        assert torch.equal(sets.escape_P, all_at_once.escape_P)


@pytest.mark.parametrize("scale", [1e-5, 1e9])
@fast
def test_rewards_in_other_units_change_no_stationary_set(scale):
    for case in family()[:40]:
        scaled = replace(case.mdp.outcomes, reward_NA=scale * case.mdp.outcomes.reward_NA)
        sets = stationary.enumerate_sets(replace(case.mdp, outcomes=scaled))
        assert torch.equal(sets.escape_P, case.sets.escape_P)


def test_the_histogram_counts_every_policy_at_its_escape_depth():
    sets = stationary.enumerate_sets(ladder(5))
    assert sets.histogram == {stationary.NEVER: 1, 0: 5, 1: 4, 2: 6, 3: 8, 4: 8}


def test_a_policy_that_never_ends_at_gamma_1_is_refused_and_ends_are_enough():
    with pytest.raises(PgtsError, match="gamma is 1 and from state 0 some policy never ends"):
        stationary.enumerate_sets(ladder(4, gamma=1.0))
    sets = stationary.enumerate_sets(deep_sea(3, gamma=1.0))
    assert (sets.J_optimal, sets.sufficient_depth) == (pytest.approx(0.99), 2)


# The paper's lemmas and its theorem


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
        assert np.array_equal(case.sets.escape_P.numpy() == stationary.NEVER, optimal_P)
        assert np.all(case.member_MP[:, optimal_P])


def test_the_worst_return_grows_with_depth():
    grown = 0
    for case in family():
        worst = [case.J_P[member_P].min() for member_P in case.member_MP]
        assert np.all(np.diff(worst) >= 0)
        assert [case.sets.worst_return(depth) for depth in DEPTHS] == pytest.approx(worst, abs=1e-10)
        grown += worst[-1] > worst[0] + EXACT
    assert grown > 40


# Proposition 2: stochastic policies


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


# Proposition 3 and Corollary 1: the worst case by depth


@fast
def test_no_stationary_policy_lacks_more_than_its_worst_case_bound():
    tightness = []
    for case in family():
        v_optimal_S = case.v_PS.max(0)
        gamma = float(case.mdp.outcomes.discount_NAK.max())
        for depth, p in stationary_ones(case):
            bound = stationary.worst_case_bound(case.mdp, case.pi_SA(p), depth)
            reached = stationary._reached(case.mdp, depth + 1).numpy()
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
    sets = stationary.enumerate_sets(mdp)
    assert sets.J_optimal - float(sets.J_P.min()) == pytest.approx(9)
    assert stationary.closed_form_bound(mdp, 0) == pytest.approx(9)
    same_everywhere = TabularMDP.from_dense(np.ones((1, 2, 1)), np.ones((1, 2)), 0.9)
    assert stationary.closed_form_bound(same_everywhere, 0) == 0


@given(mdps(max_states=3, max_actions=2), st.floats(1e-6, 50))
def test_the_depth_for_eps_is_the_first_at_which_the_closed_form_is_at_most_eps(mdp, eps):
    depth = stationary.depth_for(mdp, eps)
    assert stationary.closed_form_bound(mdp, depth) <= eps
    assert depth == 0 or stationary.closed_form_bound(mdp, depth - 1) > eps
    sets = stationary.enumerate_sets(mdp)
    assert sets.J_optimal - sets.worst_return(depth) <= eps + EXACT


@pytest.mark.parametrize("depth", [0, 1, 7, 100])
@pytest.mark.parametrize("gamma", [0.1, 0.5, 0.9, 0.999])
def test_the_depth_for_exactly_what_a_depth_allows_is_that_depth(gamma, depth):
    mdp = ladder(5, gamma=gamma)
    eps = stationary.closed_form_bound(mdp, depth)
    assert stationary.depth_for(mdp, eps) == depth
    assert stationary.depth_for(mdp, eps * (1 - 1e-9)) == depth + 1


def test_with_gamma_1_or_0_the_closed_form_says_what_it_can():
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
        assert stationary.enumerate_sets(mdp).sufficient_depth == 0
    assert stationary.enumerate_sets(grid(2, traps=(), slip=0.0)).sufficient_depth > 0


def test_a_depth_that_reaches_a_reward_earns_something():
    nothing_before = 0
    for case in family():
        rewarded_S = (case.mdp.outcomes.reward_NA > 0).any(-1)
        reached = [bool((stationary._reached(case.mdp, n) & rewarded_S).any()) for n in DEPTHS]
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
    assert stationary.enumerate_sets(mdp).sufficient_depth == expected == depth


# Propositions 5 and 6: certificates


@given(mdps_with_policy())
def test_the_certificate_is_never_below_the_truth_and_never_grows_with_depth(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    lack = exact.optimal(mdp).J - exact.evaluate(mdp, pi_SA).J
    certificates = [stationary.certificate(mdp, pi_SA, depth) for depth in DEPTHS]
    assert min(certificates) >= lack - EXACT
    assert np.all(np.diff(certificates) <= EXACT)


@fast
def test_the_certificate_is_never_below_the_truth_on_sparse_mdps_and_values_in_place_of_hope_would_be():
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
def test_nothing_smaller_than_the_certificate_follows():
    hidden = 0
    for seed, case in enumerate(family()[2::3]):
        mdp, pi_SA = case.mdp, random_policy(case.mdp, seed)
        outcomes = mdp.outcomes
        expanded_S = stationary._reached_within(mdp, mdp.start_S > 0, 1)
        stays_SA1 = torch.arange(mdp.num_states)[:, None, None].expand(outcomes.child_NAK.shape)
        paradise = replace(
            outcomes,
            reward_NA=torch.where(expanded_S[:, None], outcomes.reward_NA, outcomes.reward_NA.max()),
            child_NAK=torch.where(expanded_S[:, None, None], outcomes.child_NAK, stays_SA1),
        )
        other = exact.optimal(replace(mdp, outcomes=paradise))
        promised = stationary.certificate(mdp, pi_SA, 1) + exact.evaluate(mdp, pi_SA).J
        assert promised == pytest.approx(other.J, abs=EXACT)
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
def test_where_everything_costs_hope_is_to_pay_once_and_end(gamma):
    mdp = with_ends(random_mdp(6, 2, branching=2, seed=3, gamma=0.9), 3)
    costs = replace(mdp, outcomes=replace(mdp.outcomes, reward_NA=-1 - mdp.outcomes.reward_NA))
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


# The paper's example sets


def membership_rule(right: tuple[float, ...], depth: int) -> bool:
    zeros = [i for i, a in enumerate(right) if a == 0]
    if not zeros:
        return set(right) == {1}
    return zeros[0] + depth < len(right) - 1 and zeros[-1] >= zeros[0] + depth + 1


@pytest.mark.parametrize(("n", "values"), [(2, (0, 0.4, 1)), (4, (0, 0.4, 1)), (5, (0, 0.7))])
@fast
def test_a_policy_of_the_ladder_is_stationary_by_its_zeros(n, values):
    mdp = ladder(n)
    for right in itertools.product(values, repeat=n):
        escape = stationary.escape_depth(mdp, right_with(*right))
        verdicts = [escape == stationary.NEVER or depth < escape for depth in range(n + 1)]
        assert verdicts == [membership_rule(right, depth) for depth in range(n + 1)], right


def test_the_ladder_has_as_many_stationary_policies_as_the_formula_says():
    for n in range(1, 11):
        sets = stationary.enumerate_sets(ladder(n))
        for m in range(n + 1):
            formula = 1 + sum(2**m * (2 ** (n - 1 - j - m) - 1) for j in range(n - 1 - m))
            assert sets.count(m) == formula
    assert [stationary.enumerate_sets(ladder(5)).count(m) for m in range(5)] == [27, 23, 17, 9, 1]


@pytest.mark.parametrize("gamma", [0.3, 0.9, 0.99])
def test_on_the_tightrope_staying_stops_being_stationary_at_10_11_for_every_discount(gamma):
    mdp, low, high = tightrope(gamma=gamma), 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        stays = stationary.is_stationary(mdp, right_with(0, middle, 0.5, 0.5), 0, tolerance=1e-12)
        low, high = (middle, high) if stays else (low, middle)
    assert low == pytest.approx(10 / 11, abs=1e-8)


# Depth and speed


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
