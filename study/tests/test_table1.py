"""Table 1: stationary sets of all policies, pattern by pattern."""

import dataclasses
from fractions import Fraction

import pytest

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import TabularMDP, ladder, random_mdp, stationary, tightrope
from study import table1
from study.patterns import Membership, memberships, patterns
from study.tests.rules import ladder_rule
from tests.support import right_with

DEPTHS = 5


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
                pi_SA = right_with(*(0.4 if mark == "x" else float(mark) for mark in pattern))
                found = stationary.is_stationary(mdp, pi_SA, m, tolerance=1e-12)
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


@pytest.mark.parametrize("pattern", ["00", "0000x", "0a0", ""])
def test_a_pattern_that_does_not_fit_is_refused(pattern):
    with pytest.raises(PgtsError, match=r"pattern is '.*'; it must be 3 characters of 0, x and 1"):
        memberships(ladder(3), pattern, 1)


def test_an_mdp_of_three_actions_is_refused():
    with pytest.raises(PgtsError, match="the MDP has 3 actions; patterns are those of two"):
        memberships(random_mdp(3, 3), "000", 1)


def test_the_table_is_the_closed_rule_for_all_243_patterns_and_its_classes_say_the_same(ladder_members):
    found = table1.table(table1.PAPER["ladder"], ladder_members)
    for m, row in enumerate(found["correct"]):
        classes = [name for later in found["correct"][m:] for name in later["leaving"]] + found["staying"]
        members = {pattern for pattern in ladder_members if any(table1.in_class(pattern, name) for name in classes)}
        assert members == {pattern for pattern in ladder_members if ladder_rule(pattern, m)}
        assert row["patterns"] == len(members)
    deterministic = [sum(ladder_rule(p, m) for p in ladder_members if "x" not in p) for m in range(5)]
    assert deterministic == [27, 23, 17, 9, 1]


@pytest.mark.parametrize("name", ["ladder", "tightrope"])
def test_every_witness_is_stationary_where_the_table_says_and_escapes_one_deeper(name, ladder_members):
    column = table1.PAPER[name]
    mdp = column.make()
    differences = table1.table(column, ladder_members if name == "ladder" else table1.members(column))["differences"]
    assert differences
    for row in differences:
        pi_SA = right_with(*row["witness"])
        assert stationary.is_stationary(mdp, pi_SA, row["stationary_at"]), row
        assert not stationary.is_stationary(mdp, pi_SA, row["escapes_at"]), row
        assert row["escapes_at"] == row["stationary_at"] + 1


def test_a_table_without_errors_has_no_differences_and_a_class_too_many_is_named(ladder_members):
    column = table1.PAPER["ladder"]
    found = table1.table(column, ladder_members)
    rows = [
        dataclasses.replace(row, leaving=tuple(true["leaving"]))
        for row, true in zip(column.rows, found["correct"], strict=True)
    ]
    assert table1.table(dataclasses.replace(column, rows=tuple(rows)), ladder_members)["differences"] == []
    rows[3] = dataclasses.replace(rows[3], leaving=("0***0", "11110"))
    wrong = table1.table(dataclasses.replace(column, rows=tuple(rows)), ladder_members)["differences"]
    assert [(row["kind"], row["class"], row["belongs_in"]) for row in wrong] == [("too many", "11110", "none")]
