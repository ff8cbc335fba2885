"""Stationary sets of all policies, pattern by pattern."""

from fractions import Fraction

import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import TabularMDP, ladder, random_mdp, stationary, tightrope
from pgts_torch.tabular.patterns import Membership, memberships, patterns, policy
from tests.support import right_with

DEPTHS = 5


def ladder_rule(pattern: str, depth: int) -> bool:
    """docs/theory.md, Sec. 4: always right, or a first zero at j < n - 1 - m and another one at j + m + 1 or above."""
    if "0" not in pattern:
        return set(pattern) == {"1"}
    j = pattern.index("0")
    return j + depth < len(pattern) - 1 and "0" in pattern[j + depth + 1 :]


def test_there_are_three_patterns_for_each_state():
    found = list(patterns(3))
    assert len(found) == len(set(found)) == 27
    assert found[0] == "000"
    assert "0x1" in found


@pytest.mark.parametrize("n", [2, 3, 4])
def test_the_ladder_follows_its_closed_rule_for_all_patterns(n):
    mdp = ladder(n)
    for pattern in patterns(n):
        expected = [Membership("all" if ladder_rule(pattern, m) else "none") for m in range(DEPTHS)]
        assert memberships(mdp, pattern, DEPTHS) == expected, pattern


def test_the_rule_of_another_depth_would_be_found_out():
    found = memberships(ladder(4), "0x0x", DEPTHS)
    assert [row.verdict == "all" for row in found] != [ladder_rule("0x0x", m + 1) for m in range(DEPTHS)]


@pytest.mark.parametrize("make", [lambda: ladder(4), tightrope])
def test_fractions_agree_with_the_float_library(make):
    mdp = make()
    for pattern in list(patterns(mdp.num_states))[::2]:
        for m, row in enumerate(memberships(mdp, pattern, 3)):
            if row.verdict != "some":
                found = stationary.is_stationary(mdp, policy(pattern, 0.4), m, tolerance=1e-12)
                assert found == (row.verdict == "all"), (pattern, m)


@pytest.mark.parametrize("gamma", [0.5, 0.9])
def test_on_the_tightrope_going_right_in_s1_less_often_than_10_of_11_times_keeps_pg_at_the_start(gamma):
    mdp = tightrope(gamma=gamma)
    for rest in ("00", "0x", "11", "xx"):
        found = memberships(mdp, f"0x{rest}", 3)
        assert found[0] == Membership("some", state=1, threshold=Fraction(10, 11), below=True)
        assert [row.verdict for row in found[1:]] == ["none", "none"]
    assert stationary.is_stationary(mdp, right_with(0, 10 / 11, 0.5, 0.5), 0)
    assert not stationary.is_stationary(mdp, right_with(0, 10 / 11 + 1e-6, 0.5, 0.5), 0)


def test_where_two_probabilities_decide_there_is_no_threshold():
    stay, ends = [(1.0, 0, 0.0, False)], [(1.0, 3, 0.0, True)]
    P = [
        [stay, [(1.0, 1, 0.0, False)]],
        [[(1.0, 3, -1.0, True)], [(1.0, 2, 0.0, False)]],
        [[(1.0, 3, -1.0, True)], [(1.0, 3, 1.0, True)]],
        [ends, ends],
    ]
    mdp = TabularMDP.from_transitions(P, 0.9, start=0)
    assert memberships(mdp, "0xx0", 1) == [Membership("some")]


def test_a_pattern_as_a_policy_has_one_probability_in_all_its_x():
    torch.testing.assert_close(policy("0x1", 0.25), right_with(0, 0.25, 1))


@pytest.mark.parametrize("pattern", ["00", "0000x", "0a0", ""])
def test_a_pattern_that_does_not_fit_is_refused(pattern):
    with pytest.raises(PgtsError, match=r"pattern is '.*'; it must be 3 characters of 0, x and 1"):
        memberships(ladder(3), pattern, 1)


def test_an_mdp_of_three_actions_is_refused():
    with pytest.raises(PgtsError, match="the MDP has 3 actions; patterns are those of two"):
        memberships(random_mdp(3, 3), "000", 1)
