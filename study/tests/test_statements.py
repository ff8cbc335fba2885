"""The statements of the paper: how each is decided, and that each could be decided the other way."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import grid as make_grid
from study import cubes, depth, grid, ladder, random_mdp, readings, sets, tightrope
from study.claims import Claim, Finding, deciding_names, judge
from study.curves import Trace
from study.families import FamilyRow
from study.readings import Run
from study.tests.made_up import DIP, FALLS, FAST, FLAT, SLOW, made_up, made_up_run
from tests.support import ZOO, zoo


def test_a_verdict_holds_fails_or_depends():
    yes, no = Finding({"m": 1}, "1", True), Finding({"m": 2}, "2", False)
    assert judge("", "", [yes]).verdict == judge("", "", [yes, dataclasses.replace(yes, reading={"m": 3})]).verdict
    assert [judge("", "", row).verdict for row in ([yes], [no], [yes, no])] == ["holds", "does not hold", "depends"]


def test_a_claim_that_depends_names_what_decides_and_the_values():
    findings = [
        Finding({"gamma": gamma, "step size": step, "m": m}, f"{m}", m == 1 and step < 1)
        for gamma in (0.9, 0.99)
        for step in (0.1, 1.0)
        for m in (1, 2, 3)
    ]
    claim = Claim("", "", tuple(findings))
    assert deciding_names(findings) == ("step size", "m")
    assert claim.condition == "holds for step size 0.1, m = 1"
    assert claim.measured == "1; with m = 2: 2"
    mostly = Claim("", "", tuple(dataclasses.replace(f, holds=not f.holds) for f in findings))
    assert mostly.condition == "fails for step size 0.1, m = 1"
    assert Claim("", "", (findings[0],)).condition == ""


def test_two_findings_of_one_reading_must_not_contradict_each_other():
    with pytest.raises(AssertionError, match="contradict"):
        deciding_names([Finding({"m": 1}, "", True), Finding({"m": 1}, "", False)])


def test_a_cover_is_disjoint_and_holds_exactly_the_given_points():
    random = numpy_stream(0, "cover")
    for _ in range(50):
        points = {tuple(row) for row in random.integers(0, 3, size=(random.integers(1, 30), 3)).tolist()}
        found = cubes.cover(points)
        inside = [(a, b, c) for one in found for a in one[0] for b in one[1] for c in one[2]]
        assert len(inside) == len(set(inside))
        assert set(inside) == points
    assert cubes.cover([(0, 1), (0, 2), (1, 1), (1, 2)]) == [(frozenset({0, 1}), frozenset({1, 2}))]
    assert cubes.cover([]) == []


@pytest.mark.parametrize(
    ("judged", "true", "false"),
    [
        (lambda run: run.is_stuck, FLAT, SLOW),
        (lambda run: run.is_monotone, SLOW, FALLS),
        (lambda run: run.dips, DIP, FALLS),
        (lambda run: run.arrives_before(SLOW), FAST, SLOW),
        (lambda run: run.arrives_before(FLAT), SLOW, FLAT),
        (lambda run: run.largest_fall == 2, FALLS, SLOW),
        (lambda run: readings.largest_gap({0: SLOW, 1: run}) == pytest.approx(0.8), FAST, SLOW),
    ],
)
def test_each_question_about_a_curve_can_be_answered_both_ways(judged, true, false):
    assert judged(true)
    assert not judged(false)


def test_similar_is_asked_of_curves_and_of_arrivals():
    by_curves, by_arrivals = readings.similar({}, {0: made_up(0, 5, 10), 1: made_up(0, 8, 10)})
    assert (by_curves.holds, by_arrivals.holds) == (False, True)
    by_curves, by_arrivals = readings.similar({}, {0: made_up(0, 9.95, 9.95, 9.95), 1: made_up(0, 9.5, 9.8, 9.85)})
    assert (by_curves.holds, by_arrivals.holds) == (True, False)


BELOW_4 = dict.fromkeys(range(4), FLAT)
PARKED, LEAVES = (
    {"start": [1.0, 10.0, d], "traps": [1.0, 0.05, 0.0], "goal": [0.0, 0.0, g]} for d, g in [(9.9, 0), (1, 9)]
)
ABOVE, BELOW = (
    {"right_at_s0": s0, "right_at_s1": s1}
    for s0, s1 in [([0.0, 0, 0.1], [0.0, 0.95, 1]), ([0.0, 0.1, 0.2], [0.0, 0.5, 1])]
)


@pytest.mark.parametrize(
    ("check", "true", "false"),
    [
        (ladder.stuck_below_4, BELOW_4, BELOW_4 | {3: SLOW}),
        (ladder.arrives_from_4_on, BELOW_4 | {4: SLOW, 5: FAST}, BELOW_4 | {4: FLAT, 5: FAST}),
        (ladder.arrives_from_4_on, BELOW_4 | {4: SLOW, 5: FAST}, BELOW_4 | {3: SLOW, 4: SLOW, 5: FAST}),
        (ladder.pg_arrives, {0: SLOW}, {0: FLAT}),
        (ladder.slow_at_first, {0: made_up(0, 0, 0, 10), 4: FAST}, {0: FAST, 4: FAST}),
        (ladder.every_depth_beats_pg, {0: SLOW} | dict.fromkeys(range(1, 6), FAST), dict.fromkeys(range(6), FAST)),
        (
            ladder.each_level_is_faster,
            {m: made_up(*[0] * (9 - m), 10, *[10] * m) for m in range(5)},
            {0: SLOW, 1: FAST, 2: FAST, 3: FAST, 4: FAST},
        ),
        (ladder.no_gain_above_4, {4: FAST, 5: FAST}, {4: SLOW, 5: FAST}),
        (tightrope.pg_is_monotone, {0: SLOW}, {0: FALLS}),
        (tightrope.pg_is_stuck, {0: made_up(0, 0, right_at_s0=[0, 0])}, {0: made_up(0, 0, right_at_s0=[0, 0.1])}),
        (tightrope.waits_for_s1, {0: made_up(0, 0, 0, **ABOVE)}, {0: made_up(0, 0, 0, **BELOW)}),
        (grid.pg_stays, {0: made_up(0, 0, 0, **PARKED)}, {0: made_up(0, 0, 0, **LEAVES)}),
        (grid.pg_avoids_traps, {0: made_up(-1, 0, 0, **PARKED)}, {0: made_up(0, -1, 0, **PARKED)}),
    ],
)
def test_each_statement_about_a_figure_can_be_true_and_false(check, true, false):
    assert check(made_up_run(true)).holds
    assert not check(made_up_run(false)).holds


def test_statements_for_each_depth_can_be_true_and_false():
    def decided(check: Callable[[Run, int], Finding], traces: dict[int, Trace]) -> list[bool]:
        return [check(*each).holds for each in readings.deeper([made_up_run(traces)])]

    traces = {0: SLOW, 1: FAST, 2: DIP, 3: FLAT, 4: SLOW, 5: FALLS}
    assert decided(tightrope.pgts_arrives, traces) == [True, True, False, True, True]
    assert decided(tightrope.falls_and_recovers, traces) == [False, True, False, False, False]
    assert decided(tightrope.earlier_than_pg, traces) == [True, True, False, False, False]
    first_step = {m: made_up(0, 0, right_at_s0=[0, 0.1 if m < 3 else 0]) for m in range(6)}
    assert decided(tightrope.moves_at_once, first_step) == [True, True, False, False, False]


def test_a_smaller_step_that_is_no_later_is_noticed():
    def runs(small: list[float], large: list[float]) -> list[Run]:
        return [
            made_up_run({0: made_up(0, 0, 0, right_at_s1=values)}, **{"gamma": 0.9, "step size": step})
            for values, step in [(small, 0.01), (large, 0.1)]
        ]

    late, soon = [0.0, 0.5, 1.0], [0.0, 1.0, 1.0]
    assert tightrope.smaller_is_later(runs(late, soon))[0].holds
    assert not tightrope.smaller_is_later(runs(soon, soon))[0].holds
    assert not tightrope.smaller_is_later(runs(soon, late))[0].holds


def test_traps_before_goal_can_be_true_and_false():
    def run(traps: list[float]) -> Run:
        curve = made_up(0, 0, 0, traps=traps, goal=[0, 0, 9.0])
        return Run({"step size": 0.1}, "s0", make_grid(3, traps=(), slip=0.0), {1: curve})

    assert grid.traps_before_goal(run([1, 0, 0]), 1).holds
    assert not grid.traps_before_goal(run([1, 1, 0]), 1).holds


def test_random_mdps_are_judged_by_the_worst_sample():
    def run(last: float, seed: int) -> Run:
        return Run(
            {"initial policy": "uniform", "MDP seed": seed, "step size": 0.1},
            "s0",
            zoo("random, dense"),
            {0: made_up(0, 10, last), 1: made_up(0, 10, 10)},
        )

    assert random_mdp.ends_alike([run(9.95, 0), run(10, 1)])[0].holds
    assert not random_mdp.ends_alike([run(9.95, 0), run(9.8, 1)])[0].holds
    assert random_mdp.all_similar([run(9.95, 0)])[0].holds
    assert not random_mdp.all_similar([run(9.95, 0), run(8, 1)])[0].holds


def test_depth_is_faster_only_if_no_cell_is_slower():
    def of(*rows: list[float | None]) -> depth.Map:
        return depth.Map("Ladder", "s0", range(len(rows)), (0.1, 1.0), list(rows), 100)

    assert of([9, 9], [5, 9], [None, 3]).against_pg() == (2, 1, 1)
    assert depth.faster(of([None, 9], [5, 9])).holds
    assert not depth.faster(of([9, 9], [5, None])).holds
    assert not depth.faster(of([9, 9], [9, 9])).holds
    assert depth.never_slower({"arrival": {"0": 9, "1": 9, "5": 3}}).holds
    assert not depth.never_slower({"arrival": {"0": 9, "1": 10}}).holds
    assert depth.median([1, None, 3]) == 3
    assert depth.median([1, None, None]) is None


def test_facts_of_the_ladder():
    assert ladder.gradient().holds
    assert not ladder.local_maximum().holds
    assert ladder.diameter_is_4().holds
    assert ladder.exploration_time().holds
    torch.testing.assert_close(ladder.hitting_times(3, 1.0), torch.tensor([2.0, 1.0]).double())


def test_a_rank_correlation_can_be_there_and_not():
    def rows(depths: list[int]) -> list[FamilyRow]:
        return [FamilyRow(1, 1.0, 0.9, 5, 0, k % 10, M, 0.0, 1.0) for k, M in enumerate(depths)]

    assert sets.correlation(rows([k % 10 for k in range(40)]), "diameter").holds
    assert not sets.correlation(rows([k // 10 for k in range(40)]), "diameter").holds


def test_the_zoo_of_the_figures_is_that_of_the_paper():
    assert set(random_mdp.ZOO) == {"Ladder", "Tightrope", "Random", "Grid"}
    assert {"ladder", "tightrope", "grid"} <= set(ZOO)
