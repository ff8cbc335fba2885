"""The stationary sets: Table 1, how many policies are in each, how bad they are, and how deep is deep enough."""

import itertools
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import scipy.stats

from pgts_torch.experiment.stationary import Counts, count_policies, to_json
from pgts_torch.tabular import ascent, grid, ladder, random_mdp, stationary, tightrope
from study import table1
from study.claims import Claim, Finding, judge
from study.curves import initial_policy
from study.families import FamilyRow, family_study
from study.figure import Effort, Parameter, Report
from study.ladder import ALWAYS_LEFT

COUNTED = {
    "Ladder": ladder,
    "Tightrope": tightrope,
    "Random": random_mdp,
    "Grid 3 x 3, trap in the middle": lambda: grid(3, traps=(4,)),
    "Grid 3 x 3, trap in the middle, no slips": lambda: grid(3, traps=(4,), slip=0.0),
}
"""The MDPs whose deterministic policies are enumerated. The Grid of the paper has 4^100 of them."""

SIGNIFICANT = 0.001
"""A rank correlation with a smaller p-value counts as one."""


def compute(effort: Effort, report: Report) -> dict[str, Any]:
    """The plain data of the part."""
    report("stationary: Table 1")
    found = {name: table1.members(column) for name, column in table1.PAPER.items()}
    tables = {name: table1.table(column, found[name]) for name, column in table1.PAPER.items()}
    report("stationary: enumerating policies")
    counted = {name: count_policies(make()) for name, make in COUNTED.items()}
    seeds = range(2 if effort.quick else 20)
    report(f"stationary: random families, {len(seeds)} seeds")
    rows = family_study(seeds=seeds)
    return {
        "part": "stationary",
        "title": "Stationary sets",
        "quick": effort.quick,
        "parameters": [asdict(parameter) for parameter in _parameters(rows, len(seeds))],
        "table1": tables,
        "counted": {name: to_json(one) for name, one in counted.items()},
        "family": [asdict(row) for row in rows],
        "claims": [claim.plain() for claim in _claims(found, tables, counted, rows)],
    }


def _claims(
    found: Mapping[str, table1.Found],
    tables: Mapping[str, dict[str, Any]],
    counted: Mapping[str, Counts],
    rows: Sequence[FamilyRow],
) -> list[Claim]:
    return [
        judge("Pi^m_eta is the same for every eta >= 0", "Lemma 1", _step_sizes()),
        judge("Pi^m is inside Pi^(m-1)", "Thm. 1", [_nested(name, one) for name, one in found.items()]),
        judge("b^m never falls with m", "Cor. 1", [_worst_return(name, one) for name, one in counted.items()]),
        *(
            judge(f"{name.capitalize()}: the stationary sets are those of Table 1", "Table 1", [_table(one)])
            for name, one in tables.items()
        ),
        judge("A finite depth M suffices: Pi^M is all optimal", "Sec. 4, question 1", _finite(counted, rows)),
        judge("M depends on the diameter", "Sec. 4, question 1", [correlation(rows, "diameter")]),
        judge("M depends on the connectivity (successors)", "Sec. 4, question 1", [correlation(rows, "branching")]),
        judge("M depends on how sparse rewards are", "Sec. 4, question 1", [correlation(rows, "reward_share")]),
    ]


def _step_sizes() -> list[Finding]:
    """A policy that is not stationary must move whatever the step size."""
    mdp = ladder()
    pi_SA = initial_policy(mdp, ALWAYS_LEFT)
    assert not stationary.is_stationary(mdp, pi_SA, 4)
    found = []
    for step in (0.1, 1e-6, 1e6, 0.0):
        after_SA = ascent.ascend(mdp, pi_SA, depth=4, step_size=step, iterations=1).pi_SA
        moved = float((after_SA - pi_SA).abs().max())
        text = f"always left, not in Pi^4 of the Ladder, moves by {moved:.2g}"
        found.append(Finding({"step size": step}, text, moved > 0))
    return found


def _nested(name: str, found: table1.Found) -> Finding:
    rank = {"none": 0, "some": 1, "all": 2}
    ranks = [[rank[membership.verdict] for membership in row] for row in found.values()]
    grown = sum(row != sorted(row, reverse=True) for row in ranks)
    text = f"{name}: {grown} of {len(ranks)} patterns come back at a greater depth, of depths 0 to {len(ranks[0]) - 1}"
    return Finding({"MDP": name}, text, grown == 0)


def _worst_return(name: str, one: Counts) -> Finding:
    worst = [row.worst_return for row in one.depths]
    text = f"{name}: b^m = " + ", ".join(f"{value:.4g}" for value in worst)
    return Finding({"MDP": name}, text, all(b >= a - 1e-9 for a, b in itertools.pairwise(worst)))


def _table(table: dict[str, Any]) -> Finding:
    kinds = [row["kind"] for row in table["differences"]]
    patterns_wrong = sum(row["patterns"] for row in table["differences"])
    text = f"{kinds.count('missing')} classes ({patterns_wrong} patterns) missing, {kinds.count('too many')} too many"
    return Finding({}, text, not kinds)


def _finite(counted: Mapping[str, Counts], rows: Sequence[FamilyRow]) -> list[Finding]:
    named = ", ".join(f"{one.sufficient_depth} ({name})" for name, one in counted.items())
    largest = max(row.sufficient_depth for row in rows)
    text = f"M = {named}; at most {largest} in {len(rows)} random MDPs"
    # Enumeration ends only because every policy that is not optimal escapes at some depth.
    return [Finding({}, text, all(one.depths[-1].lack == 0 for one in counted.values()))]


def correlation(rows: Sequence[FamilyRow], name: str) -> Finding:
    values = [getattr(row, name) for row in rows]
    answer = scipy.stats.spearmanr(values, [row.sufficient_depth for row in rows])
    means = {
        value: statistics.mean(row.sufficient_depth for row in rows if getattr(row, name) == value)
        for value in sorted(set(values))
    }
    shown = [min(means), max(means)]
    text = f"rank correlation {answer.statistic:.2f}; mean M " + ", ".join(
        f"{means[value]:.2g} at {value:g}" for value in shown
    )
    return Finding({}, text, bool(answer.pvalue < SIGNIFICANT))


def _parameters(rows: Sequence[FamilyRow], seeds: int) -> list[Parameter]:
    def values(name: str) -> str:
        return ", ".join(f"{value:g}" for value in sorted({getattr(row, name) for row in rows}))

    return [
        Parameter("start", "s0", "paper, Table 1"),
        Parameter("gamma of Ladder, Tightrope and Grid", "0.9", "not stated"),
        Parameter("policies of Table 1", "all patterns of 0, between and 1; numbers as fractions", "ours"),
        Parameter("random families: successors of (s, a)", values("branching"), "ours"),
        Parameter("random families: share of rewards kept", values("reward_share"), "ours"),
        Parameter("random families: gamma", values("gamma"), "ours"),
        Parameter("random families: states", values("num_states"), "ours"),
        Parameter("random families: MDPs", f"{len(rows)} ({seeds} seeds)", "ours"),
    ]
