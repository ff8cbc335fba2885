"""The stationary sets Pi^m."""

import itertools

import pytest
import torch
from hypothesis import given

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import exact, ladder, stationary, stationary_sets, tightrope
from tests.support import ZOO, always, mdps, mdps_with_policy, right_with, uniform_policy, zoo

LEFT, RIGHT = 0, 1
DEPTHS = range(6)


# The gap


@given(mdps_with_policy())
def test_the_gap_is_never_negative_is_0_outside_the_support_and_grows_with_depth(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    gaps = torch.stack([stationary.gap(mdp, pi_SA, depth) for depth in DEPTHS])
    assert torch.all(gaps >= 0)
    assert torch.all(gaps[:, ~exact.support(mdp, pi_SA)] == 0)
    assert torch.all(gaps.diff(dim=0) >= -1e-11)


@given(mdps_with_policy())
def test_the_gap_is_how_much_the_best_action_seen_beats_the_value(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    evaluation = exact.evaluate(mdp, pi_SA)
    for depth in (0, 2):
        best_S = exact.lookahead(mdp, evaluation.q_SA, depth).max(-1).values
        visited = exact.support(mdp, pi_SA)
        expected = torch.where(visited, best_S - (pi_SA * evaluation.q_SA).sum(-1), torch.zeros_like(best_S))
        torch.testing.assert_close(stationary.gap(mdp, pi_SA, depth), expected, rtol=1e-9, atol=1e-10)


def test_the_gap_of_always_left_appears_at_the_depth_that_sees_the_top():
    mdp = ladder(5)
    for depth in range(8):
        gap_S = stationary.gap(mdp, always(mdp, LEFT), depth)
        # T^m Q sees reward 1 after four steps to the right, and again in each of the m - 4 steps that remain.
        seen = sum(0.9**k for k in range(4, depth + 1))
        assert gap_S.tolist() == pytest.approx([seen, 0, 0, 0, 0])


def test_states_that_are_not_visited_do_not_count():
    always_left = always(ladder(5), LEFT)
    assert stationary.is_stationary(ladder(5), always_left, 1)
    assert not stationary.is_stationary(ladder(5, start=4), always_left, 1)
    assert not stationary.is_stationary(ladder(5, start=None), always_left, 1)


# Membership


@pytest.mark.parametrize("n", range(2, 8))
def test_always_left_is_stationary_on_the_ladder_exactly_below_depth_n_minus_1(n):
    mdp = ladder(n)
    verdicts = [stationary.is_stationary(mdp, always(mdp, LEFT), depth) for depth in range(n + 3)]
    assert verdicts == [depth < n - 1 for depth in range(n + 3)]


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("name", ZOO)
def test_an_optimal_policy_is_stationary_at_every_depth(name):
    mdp = zoo(name)
    pi_SA = exact.optimal(mdp).pi_SA
    assert all(stationary.is_stationary(mdp, pi_SA, depth, tolerance=1e-8) for depth in (0, 1, 20))
    assert torch.all(stationary.gap(mdp, pi_SA, 0) >= 0)  # though rounding may put v above every q
    assert not stationary.is_stationary(mdp, uniform_policy(mdp), 0)


@given(mdps_with_policy())
def test_what_is_stationary_at_one_depth_is_stationary_at_every_smaller_one(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    pi_SA = torch.nn.functional.one_hot(pi_SA.argmax(-1), mdp.num_actions).double()
    verdicts = [stationary.is_stationary(mdp, pi_SA, depth) for depth in DEPTHS]
    assert verdicts == sorted(verdicts, reverse=True)


def test_a_policy_is_stationary_up_to_the_tolerance():
    mdp = ladder(5)
    almost_best = right_with(1, 1, 1, 1, 1 - 1e-6)
    size = float(stationary.gap(mdp, almost_best, 0).max())
    assert size > 1e-9
    assert not stationary.is_stationary(mdp, almost_best, 0)
    assert stationary.is_stationary(mdp, almost_best, 0, tolerance=1.01 * size)
    assert not stationary.is_stationary(mdp, almost_best, 0, tolerance=0.99 * size)


# All deterministic policies at once


@given(mdps(max_states=3, max_actions=2))
def test_the_enumerated_sets_are_what_membership_says_of_each_policy(mdp):
    sets = stationary_sets.enumerate_sets(mdp)
    every = list(itertools.product(range(mdp.num_actions), repeat=mdp.num_states))
    assert sets.action_PS.tolist() == [list(actions) for actions in every]
    slack = stationary.TOLERANCE * max(1.0, float(exact.optimal(mdp).q_SA.abs().max()))
    for depth in (0, 1, 3):
        member = [
            stationary.is_stationary(mdp, torch.eye(mdp.num_actions).double()[list(actions)], depth, tolerance=slack)
            for actions in every
        ]
        assert sets.member_P(depth).tolist() == member
        assert sets.count(depth) == sum(member)


@given(mdps(max_states=4, max_actions=2))
def test_the_worst_stationary_policy_gets_better_with_depth_and_is_optimal_at_the_sufficient_one(mdp):
    sets = stationary_sets.enumerate_sets(mdp)
    worst = [sets.worst_return(depth) for depth in range(sets.sufficient_depth + 2)]
    assert worst == sorted(worst)
    assert worst[-1] == worst[-2] == pytest.approx(exact.optimal(mdp).J, abs=1e-6)
    if sets.sufficient_depth > 0:
        assert worst[-3] < worst[-2]


def test_the_worst_stationary_policy_of_the_ladder_earns_nothing_below_depth_4():
    sets = stationary_sets.enumerate_sets(ladder(5))
    best = exact.optimal(ladder(5)).J
    assert [sets.worst_return(depth) for depth in range(6)] == pytest.approx([0, 0, 0, 0, best, best])
    assert sets.sufficient_depth == 4
    assert [sets.count(depth) for depth in (0, 4, 9)] == [sum(stays_at_depth_0()), 1, 1]


def stays_at_depth_0() -> list[bool]:
    rights = itertools.product([0.0, 1.0], repeat=5)
    return [stationary.is_stationary(ladder(5), right_with(*right), 0) for right in rights]


@pytest.mark.parametrize("n", range(2, 8))
def test_always_left_escapes_from_the_ladder_at_depth_n_minus_1_and_an_optimal_policy_never(n):
    mdp = ladder(n)
    assert stationary_sets.escape_depth(mdp, always(mdp, LEFT)) == n - 1
    assert stationary_sets.escape_depth(mdp, always(mdp, RIGHT)) == stationary_sets.NEVER
    assert stationary_sets.escape_depth(mdp, uniform_policy(mdp)) == 0


@given(mdps_with_policy())
def test_the_escape_depth_is_the_first_at_which_a_policy_is_not_stationary(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    pi_SA = torch.nn.functional.one_hot(pi_SA.argmax(-1), mdp.num_actions).double()
    slack = stationary.TOLERANCE * max(1.0, float(exact.optimal(mdp).q_SA.abs().max()))
    escape = stationary_sets.escape_depth(mdp, pi_SA)
    last = 40 if escape == stationary_sets.NEVER else escape
    verdicts = [
        stationary.is_stationary(mdp, pi_SA, depth, tolerance=slack) for depth in sorted({0, max(last - 1, 0), last})
    ]
    assert verdicts[-1] == (escape == stationary_sets.NEVER)
    assert all(verdicts[:-1])


def test_more_policies_than_can_be_enumerated_are_refused_with_their_number():
    with pytest.raises(PgtsError, match=r"4\^100 deterministic policies; at most 1048576"):
        stationary_sets.enumerate_sets(zoo("grid"))
    with pytest.raises(PgtsError, match=r"2\^5 deterministic policies; at most 31"):
        stationary_sets.enumerate_sets(ladder(5), max_policies=31)


# Table 2 of the paper, with 0.3, 0.6, 0.8 for x, y, z

LADDER_TABLE = [
    (0, (0.3, 0.6, 0.8, 0, 0)),
    (0, (0, 0, 0.3, 0.6, 0.8)),
    (0, (0.3, 0.6, 0, 0, 0.8)),
    (0, (0.3, 0, 0, 0.6, 0.8)),
    (1, (0, 0.3, 0, 0.6, 0.8)),
    (1, (0.3, 0.6, 0, 0.8, 0)),
    (2, (0.3, 0, 0.6, 0.8, 0)),
    (2, (0, 0.3, 0.6, 0, 0.8)),
    (3, (0, 0.3, 0.6, 0.8, 0)),
    (9, (1, 1, 1, 1, 1)),
]


@pytest.mark.parametrize(("deepest", "right"), LADDER_TABLE)
def test_a_policy_of_the_table_for_the_ladder_is_stationary_up_to_its_depth(deepest, right):
    verdicts = [stationary.is_stationary(ladder(5), right_with(*right), depth) for depth in range(10)]
    assert verdicts == [depth <= deepest for depth in range(10)]


@pytest.mark.parametrize(
    ("deepest", "right"), [(0, (0, 0, 0.3, 0.6)), (9, (1, 1, 0.3, 0.6)), (-1, (0.5, 1, 0.3, 0.6)), (-1, (0, 1, 0, 0))]
)
def test_a_policy_of_the_table_for_the_tightrope_is_stationary_up_to_its_depth(deepest, right):
    verdicts = [stationary.is_stationary(tightrope(), right_with(*right), depth) for depth in range(10)]
    assert verdicts == [depth <= deepest for depth in range(10)]
