"""`pgts figures`: what the statements of the paper are checked with, and what the command leaves."""

import dataclasses
import json
import subprocess
import sys
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.experiment import stationary as study
from pgts_torch.experiment.cli import main
from pgts_torch.experiment.figures import (
    PARTS,
    command,
    cubes,
    depth,
    figure,
    grid,
    ladder,
    random_mdp,
    sampled,
    sets,
    table1,
    tightrope,
)
from pgts_torch.experiment.figures.claims import Claim, Finding, deciding_names, judge
from pgts_torch.experiment.figures.curves import Trace, arrivals, initial_policy, trace
from pgts_torch.experiment.figures.document import document
from pgts_torch.experiment.figures.figure import Effort, Run
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import ascent, exact, mirage, stationary
from pgts_torch.tabular import grid as make_grid
from pgts_torch.tabular import ladder as make_ladder
from tests.forks import PATIENCE
from tests.support import ZOO, always, random_policy, right_with, zoo

LEFT, RIGHT = 0, 1


def made_up(*J: float, J_optimal: float = 10.0, **watched: list[float]) -> Trace:
    """A run of Algorithm 1 that nobody ran."""
    values = {name.replace("_", " "): torch.tensor(row).double() for name, row in watched.items()}
    return Trace(torch.tensor(J).double(), J_optimal, values)


def made_up_run(traces: dict[int, Trace], **reading: Any) -> Run:
    return Run(reading or {"step size": 0.1}, "s0", zoo("tightrope"), traces)


FLAT, FAST, SLOW, DIP = (made_up(*J) for J in [(0, 0, 0, 0), (0, 10, 10, 10), (0, 2, 4, 10), (0, -3, 10, 10)])
FALLS = made_up(0, 5, 3, 10)


# Exact curves


@pytest.mark.parametrize("name", ["ladder", "tightrope", "random, dense", "grid", "deep_sea"])
@pytest.mark.parametrize("update", [ascent.projected_step, ascent.softmax_step])
def test_many_settings_at_once_are_algorithm_1_one_by_one(name, update):
    mdp, depths, steps = zoo(name), (0, 1, 4), (0.05, 2.0)
    pi_SA = random_policy(mdp)
    if update is ascent.projected_step:
        pi_SA[: mdp.num_states // 2] = always(mdp, LEFT)[: mdp.num_states // 2]  # some states are never visited
    found = trace(mdp, pi_SA, depths=depths, steps=steps, iterations=6, update=update)
    for m in depths:
        for step in steps:
            one = ascent.ascend(mdp, pi_SA, depth=m, step_size=step, iterations=6, step=update)
            torch.testing.assert_close(found[m, step].J_K, one.J_K, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(found[0, 0.05].J_K, found[4, 2.0].J_K, rtol=1e-6)


def test_arrivals_are_those_of_the_whole_curves():
    mdp = make_ladder(start=None)
    settings = {"depths": (0, 2, 4), "steps": (0.01, 0.1)}
    pi_SA = always(mdp, LEFT)
    curves = trace(mdp, pi_SA, iterations=40, **settings)
    found = arrivals(mdp, pi_SA, limit=40, **settings)
    assert found == {setting: run.arrival for setting, run in curves.items()}
    assert found[4, 0.1] == 8
    assert found[0, 0.01] is None


def test_arrival_is_99_percent_of_the_way_also_where_returns_are_negative():
    assert made_up(-45, -18.6, -18.4, J_optimal=-18.225).arrival == 2
    assert made_up(0, 9.89, 9.91).arrival == 2
    assert made_up(0, 9.89).arrival is None


# Verdicts


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
        (figure.stuck, FLAT, SLOW),
        (figure.monotone, SLOW, FALLS),
        (figure.dips, DIP, FALLS),
        (lambda run: figure.arrives_before(run, SLOW), FAST, SLOW),
        (lambda run: figure.arrives_before(run, FLAT), SLOW, FLAT),
        (lambda run: figure.fell_by(run) == 2, FALLS, SLOW),
        (lambda run: figure.largest_gap({0: SLOW, 1: run}) == pytest.approx(0.8), FAST, SLOW),
    ],
)
def test_each_question_about_a_curve_can_be_answered_both_ways(judged, true, false):
    assert judged(true)
    assert not judged(false)


def test_similar_is_asked_of_curves_and_of_arrivals():
    by_curves, by_arrivals = figure.similar({}, {0: made_up(0, 5, 10), 1: made_up(0, 8, 10)})
    assert (by_curves.holds, by_arrivals.holds) == (False, True)
    by_curves, by_arrivals = figure.similar({}, {0: made_up(0, 9.95, 9.95, 9.95), 1: made_up(0, 9.5, 9.8, 9.85)})
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
        (ladder._stuck_below_4, BELOW_4, BELOW_4 | {3: SLOW}),
        (ladder._arrives_from_4_on, BELOW_4 | {4: SLOW, 5: FAST}, BELOW_4 | {4: FLAT, 5: FAST}),
        (ladder._arrives_from_4_on, BELOW_4 | {4: SLOW, 5: FAST}, BELOW_4 | {3: SLOW, 4: SLOW, 5: FAST}),
        (ladder._pg_arrives, {0: SLOW}, {0: FLAT}),
        (ladder._slow_at_first, {0: made_up(0, 0, 0, 10), 4: FAST}, {0: FAST, 4: FAST}),
        (ladder._every_depth_beats_pg, {0: SLOW} | dict.fromkeys(range(1, 6), FAST), dict.fromkeys(range(6), FAST)),
        (
            ladder._each_level_is_faster,
            {m: made_up(*[0] * (9 - m), 10, *[10] * m) for m in range(5)},
            {0: SLOW, 1: FAST, 2: FAST, 3: FAST, 4: FAST},
        ),
        (ladder._no_gain_above_4, {4: FAST, 5: FAST}, {4: SLOW, 5: FAST}),
        (tightrope._pg_is_monotone, {0: SLOW}, {0: FALLS}),
        (tightrope._pg_is_stuck, {0: made_up(0, 0, right_at_s0=[0, 0])}, {0: made_up(0, 0, right_at_s0=[0, 0.1])}),
        (tightrope._waits_for_s1, {0: made_up(0, 0, 0, **ABOVE)}, {0: made_up(0, 0, 0, **BELOW)}),
        (grid._pg_stays, {0: made_up(0, 0, 0, **PARKED)}, {0: made_up(0, 0, 0, **LEAVES)}),
        (grid._pg_avoids_traps, {0: made_up(-1, 0, 0, **PARKED)}, {0: made_up(0, -1, 0, **PARKED)}),
    ],
)
def test_each_statement_about_a_figure_can_be_true_and_false(check, true, false):
    assert check(made_up_run(true)).holds
    assert not check(made_up_run(false)).holds


def test_statements_for_each_depth_can_be_true_and_false():
    runs = [made_up_run({0: SLOW, 1: FAST, 2: DIP, 3: FLAT, 4: SLOW, 5: FALLS})]
    assert [f.holds for f in tightrope._pgts_arrives(runs)] == [True, True, False, True, True]
    assert [f.holds for f in tightrope._falls_and_recovers(runs)] == [False, True, False, False, False]
    assert [f.holds for f in tightrope._earlier_than_pg(runs)] == [True, True, False, False, False]
    first_step = {m: made_up(0, 0, right_at_s0=[0, 0.1 if m < 3 else 0]) for m in range(6)}
    assert [f.holds for f in tightrope._moves_at_once([made_up_run(first_step)])] == [True, True, False, False, False]


def test_a_smaller_step_that_is_no_later_is_noticed():
    def runs(small: list[float], large: list[float]) -> list[Run]:
        return [
            made_up_run({0: made_up(0, 0, 0, right_at_s1=values)}, **{"gamma": 0.9, "step size": step})
            for values, step in [(small, 0.01), (large, 0.1)]
        ]

    late, soon = [0.0, 0.5, 1.0], [0.0, 1.0, 1.0]
    assert tightrope._smaller_is_later(runs(late, soon))[0].holds
    assert not tightrope._smaller_is_later(runs(soon, soon))[0].holds
    assert not tightrope._smaller_is_later(runs(soon, late))[0].holds


def test_traps_before_goal_can_be_true_and_false():
    def run(traps: list[float]) -> Run:
        curve = made_up(0, 0, 0, traps=traps, goal=[0, 0, 9.0])
        return Run({"step size": 0.1}, "s0", make_grid(3, traps=(), slip=0.0), {1: curve})

    assert grid._order(run([1, 0, 0]), 1).holds
    assert not grid._order(run([1, 1, 0]), 1).holds


def test_random_mdps_are_judged_by_the_worst_that_was_drawn():
    def run(last: float, seed: int) -> Run:
        return Run(
            {"initial policy": "uniform", "MDP seed": seed, "step size": 0.1},
            "s0",
            zoo("random, dense"),
            {0: made_up(0, 10, last), 1: made_up(0, 10, 10)},
        )

    assert random_mdp._ends_alike([run(9.95, 0), run(10, 1)])[0].holds
    assert not random_mdp._ends_alike([run(9.95, 0), run(9.8, 1)])[0].holds
    assert random_mdp._similar([run(9.95, 0)])[0].holds
    assert not random_mdp._similar([run(9.95, 0), run(8, 1)])[0].holds


def test_depth_is_faster_only_if_no_cell_is_slower():
    def of(*rows: list[float | None]) -> depth.Map:
        return depth.Map("Ladder", "s0", range(len(rows)), (0.1, 1.0), list(rows), 100, 1)

    assert of([9, 9], [5, 9], [None, 3]).against_pg() == (2, 1, 1)
    assert depth._faster(of([None, 9], [5, 9])).holds
    assert not depth._faster(of([9, 9], [5, None])).holds
    assert not depth._faster(of([9, 9], [9, 9])).holds
    assert depth._never_slower({"arrival": {"0": 9, "1": 9, "5": 3}}).holds
    assert not depth._never_slower({"arrival": {"0": 9, "1": 10}}).holds
    assert depth._median([1, None, 3]) == 3
    assert depth._median([1, None, None]) is None


def test_facts_of_the_ladder():
    assert ladder._gradient().holds
    assert not ladder._local_maximum().holds
    assert ladder._diameter().holds
    assert ladder._exploration_time().holds
    torch.testing.assert_close(ladder._hitting_times(3, 1.0), torch.tensor([2.0, 1.0]).double())


def test_a_rank_correlation_can_be_there_and_not():
    def rows(depths: list[int]) -> list[study.FamilyRow]:
        return [study.FamilyRow(1, 1.0, 0.9, 5, 0, k % 10, M, 0.0, 1.0) for k, M in enumerate(depths)]

    assert sets._correlation(rows([k % 10 for k in range(40)]), "diameter").holds
    assert not sets._correlation(rows([k // 10 for k in range(40)]), "diameter").holds


# Table 1


@pytest.fixture(scope="module")
def ladder_members() -> table1.Found:
    return table1.members(table1.PAPER["ladder"])


def correct_class(pattern: str, m: int) -> bool:
    """docs/theory.md, Sec. 4."""
    if "0" not in pattern:
        return pattern == "11111"
    j = pattern.index("0")
    return j + m < 4 and "0" in pattern[j + m + 1 :]


def test_the_table_is_the_closed_rule_for_all_243_patterns_and_its_classes_say_the_same(ladder_members):
    found = table1.table(table1.PAPER["ladder"], ladder_members)
    for m, row in enumerate(found["correct"]):
        classes = [name for later in found["correct"][m:] for name in later["leaving"]] + found["staying"]
        members = {pattern for pattern in ladder_members if any(table1.in_class(pattern, name) for name in classes)}
        assert members == {pattern for pattern in ladder_members if correct_class(pattern, m)}
        assert row["patterns"] == len(members)
    deterministic = [sum(correct_class(p, m) for p in ladder_members if "x" not in p) for m in range(5)]
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


# The mirage


@pytest.mark.parametrize(("width", "delta", "gamma"), [(10, 0.05, 0.9), (1, 0.3, 0.5), (4, 0.01, 0.99)])
def test_the_advantage_of_right_on_the_mirage_is_that_of_the_formula(width, delta, gamma):
    mdp = mirage(width, delta=delta, gamma=gamma)
    q_SA = exact.evaluate(mdp, always(mdp, LEFT)).q_SA
    for m in (0, 1, 2, 7, 30):
        look_S = exact.lookahead(mdp, q_SA, m)[0]
        formula = gamma / (1 - gamma) * (1 - (1 - delta) * (1 - gamma**m))
        assert float(look_S[RIGHT] - look_S[LEFT]) == pytest.approx(formula)
    assert exact.optimal(mdp).J == pytest.approx(gamma / (1 - gamma))
    assert exact.evaluate(mdp, always(mdp, RIGHT)).J == pytest.approx(gamma / (1 - gamma))


def test_on_the_mirage_every_level_of_depth_is_slower():
    mdp = mirage()
    depths = (0, 1, 5, 20, 50)
    found = arrivals(mdp, always(mdp, LEFT), depths=depths, steps=[0.03], limit=200)
    times = [found[m, 0.03] for m in depths]
    assert times == sorted(times)
    assert times[-1] > 10 * times[0]


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        ({"width": 0}, "width is 0; it must be at least 1"),
        ({"delta": 0.0}, r"delta is 0.0; it must be above 0 and below 1"),
        ({"delta": 1.0}, r"delta is 1.0; it must be above 0 and below 1"),
        ({"gamma": 2.0}, r"gamma is 2.0"),
    ],
)
def test_a_mirage_that_cannot_be_is_refused(arguments, mistake):
    with pytest.raises(PgtsError, match=mistake):
        mirage(**arguments)


# Samples


def test_a_band_is_the_interquartile_mean_inside_its_interval():
    J_NK = numpy_stream(1, "band").normal(size=(10, 4)) + np.arange(4)
    found = sampled.band(J_NK, "test")
    assert found.iqm == pytest.approx([np.sort(column)[2:-2].mean() for column in J_NK.T])
    assert all(low < iqm < high for low, iqm, high in zip(found.low, found.iqm, found.high, strict=True))
    assert sampled.band(J_NK, "test") == found
    one = sampled.band(J_NK[:1], "test")
    assert one.low == one.iqm == one.high == J_NK[0].tolist()


@pytest.mark.usefixtures("unchecked_shapes")
def test_runs_draw_independently_and_the_number_of_workers_changes_nothing():
    given = sampled.arguments(
        depth=1,
        update="projected",
        step_size=0.3,
        init={"type": "uniform"},
        critic={"type": "tabular"},
        horizon={"type": "fixed", "length": 5},
        num_envs=4,
        gamma=0.9,
        env_kwargs={"start": None},
    )
    jobs = [sampled.Job(("test", seed), "pgts/Random-v0", 2, given) for seed in range(2)]
    with sampled.executor(0) as here, sampled.executor(1) as elsewhere:
        found = [[one.submit(sampled.returns, job).result() for job in jobs] for one in (here, elsewhere)]
    assert found[0] == found[1]
    assert found[0][0][0] == found[0][1][0]
    assert found[0][0][-1] != found[0][1][-1]
    assert len(found[0][0]) == 3


def test_sampled_runs_use_the_initial_policy_of_the_exact_ones():
    for one in command.CURVES.values():
        panel = figure._panel(one, "projected", "s0")
        mdp = one.make(start=0)
        J = exact.evaluate(mdp, initial_policy(mdp, one.moves["projected"].init)).J
        assert panel["exact"]["0"][0] == pytest.approx(J, rel=1e-5)


# The command


def smallest(shown: figure.Figure) -> figure.Figure:
    """The same figure with next to nothing to compute."""

    def claims(quick: bool) -> list[Claim]:
        return [
            judge(f"A statement about {shown.name}", "Sec. 3", [({"m": 1}, "1.25 a", True), ({"m": 2}, "2.5 b", False)])
        ]

    few = {"s0": 2, "uniform": 2}
    return dataclasses.replace(
        shown,
        depths=(0, 1),
        iterations=few,
        sampled_iterations=few,
        quick_depths=(1,),
        num_envs=2,
        critic={"type": "tabular"},
        horizon={"type": "fixed", "length": 3},
        claims=claims,
    )


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, ladder_members: table1.Found) -> None:
    monkeypatch.setattr(command, "CURVES", {name: smallest(shown) for name, shown in command.CURVES.items()})
    monkeypatch.setattr(command, "QUICK", Effort(quick=True, seeds=2, workers=0))
    monkeypatch.setattr(command, "DOTS_PER_INCH", 20)
    monkeypatch.setattr(depth, "FAMILIES", (depth.FAMILIES[1], depth.FAMILIES[4]))
    monkeypatch.setattr(depth, "QUICK", depth.Scale((0.3, 1.0), 8, 8, 2))
    monkeypatch.setattr(depth, "_in_S_iterations", lambda: [Finding({}, "made up", True)])
    monkeypatch.setattr(table1, "PAPER", {"ladder": table1.PAPER["ladder"]})
    monkeypatch.setattr(table1, "members", lambda column: ladder_members)
    monkeypatch.setattr(sets, "COUNTED", {"Ladder": make_ladder})
    family = study.family_study(branchings=(1, 2), sizes=(4,), gammas=(0.5, 0.9), seeds=range(3))
    monkeypatch.setattr(study, "family_study", lambda seeds: family)


@pytest.mark.usefixtures("unchecked_shapes")
def test_the_command_leaves_a_document_that_is_made_of_its_data_alone(small, tmp_path, capsys):
    assert main(["figures", "--quick", "--json", "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    printed = json.loads(out)
    folder = tmp_path / "figures"
    assert list(printed) == list(PARTS)
    assert all("s  " in line for line in err.splitlines())
    stored = {name: json.loads((folder / f"{name}.json").read_text()) for name in PARTS}
    assert printed == stored
    drawn = {path.stem for path in folder.glob("*.png")}
    assert drawn == {*PARTS, "mirage"}
    text = (tmp_path / "reproduction.md").read_text()
    assert text == document(stored)
    assert "**Made with `--quick`**" in text
    assert all(f"figures/{name}.png" in text for name in drawn)
    for claim in (claim for part in stored.values() for claim in part["claims"]):
        assert claim["text"] in text
        assert claim["measured"].replace("|", "\\|") in text or claim["measured"] in text
    stored["ladder"]["claims"][0] |= {"measured": "something else", "verdict": "holds", "condition": ""}
    stored["stationary"]["counted"]["Ladder"]["depths"][0]["count"] = 123
    changed = document(stored)
    assert "something else" in changed
    assert "| 0 | 123 |" in changed
    assert "something else" not in text


@pytest.mark.usefixtures("unchecked_shapes")
def test_one_part_alone_keeps_the_others_and_missing_ones_are_named(small, tmp_path, capsys):
    assert main(["figures", "--quick", "--only", "ladder", "--out", str(tmp_path)]) == 0
    assert "Run `pgts figures --only random`" in (tmp_path / "reproduction.md").read_text()
    kept = (tmp_path / "figures" / "ladder.json").read_bytes()
    assert main(["figures", "--quick", "--only", "depth", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "figures" / "ladder.json").read_bytes() == kept
    text = (tmp_path / "reproduction.md").read_text()
    assert "## Figure 1: Ladder" in text
    assert "### Where more depth is slower" in text
    out = capsys.readouterr().out
    assert "depends        A statement about ladder" in out
    assert "holds for m = 1" in out
    assert max(map(len, out.splitlines())) < 80


def test_what_was_computed_twice_is_the_same_and_another_figure_is_not():
    def computed(one: figure.Figure) -> str:
        effort = Effort(quick=True, seeds=2, workers=0)
        runs = figure.start(one, effort, sampled.Here())
        return json.dumps(figure.finish(one, effort, runs, lambda message: None)["panels"])

    shown = smallest(random_mdp.FIGURE)
    assert computed(shown) == computed(shown)
    assert computed(shown) != computed(dataclasses.replace(shown, name="other"))


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        (["--only", "laddr"], "argument --only: invalid choice: 'laddr'"),
        (["--out", "file"], "argument --out: 'file' is not a folder"),
        (["--quik"], "unrecognized arguments: --quik"),
        (["ladder"], "unrecognized arguments: ladder"),
    ],
)
def test_a_mistake_is_one_line(arguments, mistake, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert main(["figures", *arguments]) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    assert mistake in err


def test_damaged_data_of_an_earlier_run_are_named_before_any_work(tmp_path, capsys):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "grid.json").write_text("{")
    assert main(["figures", "--only", "ladder", "--out", str(tmp_path)]) == 2
    assert "grid.json cannot be read" in capsys.readouterr().err


def test_mistakes_and_help_do_not_wait_for_torch(tmp_path):
    source = (
        "import sys; from pgts_torch.experiment.cli import main; main(['figures', '--help']); "
        "main(['figures', '--only', 'x']); sys.exit('torch' in sys.modules or 'matplotlib' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", source], cwd=tmp_path, capture_output=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0
    assert list(tmp_path.iterdir()) == []


def test_the_zoo_of_the_figures_is_that_of_the_paper():
    assert set(random_mdp.ZOO) == {"Ladder", "Tightrope", "Random", "Grid"}
    assert {"ladder", "tightrope", "grid"} <= set(ZOO)


def test_an_executor_of_no_processes_answers_at_once():
    future = sampled.executor(0).submit(max, 1, 2)
    assert isinstance(future, Future)
    assert future.result() == 2
