"""Table 1 of the paper beside the stationary sets as they are, for all policies."""

import math
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pgts_torch.tabular import TabularMDP, ladder, tightrope
from study.cubes import Cube, cover
from study.patterns import ALWAYS, NEVER, SOMETIMES, Membership, memberships, patterns

SIGNS: dict[frozenset[str], str] = {
    frozenset(NEVER): "0",
    frozenset(SOMETIMES): "x",
    frozenset(ALWAYS): "1",
    frozenset(SOMETIMES + ALWAYS): "+",
    frozenset(NEVER + SOMETIMES): "-",
    frozenset(NEVER + SOMETIMES + ALWAYS): "*",
    frozenset(NEVER + ALWAYS): "b",
}
"""One character for what a place of a policy class allows."""

LEGEND = "0 never right, 1 always, x strictly between, + above 0, - below 1, b 0 or 1, * anything"

MARKS = {sign: marks for marks, sign in SIGNS.items()}

NOWHERE, FOREVER = -1, sys.maxsize
"""Stand for the last depth of policies that are stationary at no depth, and at all of them."""


@dataclass(frozen=True)
class PaperRow:
    """One line of the table as printed, and the classes that leave after this depth."""

    depth: int
    printed: str
    leaving: tuple[str, ...]


@dataclass(frozen=True)
class PaperTable:
    """A column of Table 1. staying: the classes that never leave."""

    make: Callable[[], TabularMDP]
    rows: tuple[PaperRow, ...]
    staying: tuple[str, ...]


PAPER: dict[str, PaperTable] = {
    "ladder": PaperTable(
        ladder,
        (
            PaperRow(
                0,
                "Pi^1 and pi_xyz00, pi_00xyz, pi_xy00z, pi_x00yz, 0 < x,y,z <= 1",
                ("+++00", "00+++", "++00+", "+00++"),
            ),
            PaperRow(1, "Pi^2 and pi_0x0yz, pi_xy0z0, 0 < x,y,z <= 1", ("0+0++", "++0+0")),
            PaperRow(2, "Pi^3 and pi_x0yz0, pi_0xy0z, 0 < x,y,z <= 1", ("+0++0", "0++0+")),
            PaperRow(3, "Pi^4 and pi_0xyz0, 0 <= x,y,z <= 1", ("0***0",)),
            PaperRow(4, "pi_11111", ()),
        ),
        ("11111",),
    ),
    "tightrope": PaperTable(
        tightrope,
        (
            PaperRow(0, "pi_00xy, pi_11xy, 0 <= x,y <= 1", ("00**",)),
            PaperRow(1, "pi_11xy, 0 <= x,y <= 1", ()),
            PaperRow(2, "Pi^1", ()),
            PaperRow(3, "Pi^1", ()),
            PaperRow(4, "Pi^1", ()),
        ),
        ("11**",),
    ),
}
"""Table 1 as printed: 'right' in s_i with probability a_i, start s0."""


@dataclass(frozen=True)
class Decided:
    """What is true of a pattern: the last depth at which all its policies are stationary, and the condition under
    which they still are at the next one."""

    last: int
    condition: str = ""
    interior: float = 0.5


Found = Mapping[str, list[Membership]]
"""The memberships of each pattern, depth by depth."""


def members(column: PaperTable) -> Found:
    """Decide all patterns of a column at all its depths."""
    mdp = column.make()
    return {pattern: memberships(mdp, pattern, len(column.rows)) for pattern in patterns(mdp.num_states)}


def table(column: PaperTable, found: Found) -> dict[str, Any]:
    """The plain data of one column: printed, correct, and where they differ, with witnesses."""
    truth = {pattern: decided(row) for pattern, row in found.items()}
    printed = {pattern: printed_last(column, pattern) for pattern in truth}
    return {
        "printed": [asdict(row) | {"patterns": _members(printed, row.depth)} for row in column.rows],
        "correct": [_correct_row(truth, row.depth) for row in column.rows],
        "staying": _spelled(pattern for pattern, found in truth.items() if found.last == FOREVER),
        "differences": _differences(truth, printed),
        "legend": LEGEND,
    }


def decided(found: list[Membership]) -> Decided:
    """What the memberships in Pi^0, Pi^1, ... of a pattern come to; by Theorem 1 they can only be lost."""
    full = sum(membership.verdict == "all" for membership in found)
    if full == len(found):
        return Decided(FOREVER)
    partial = found[full]
    if partial.verdict == "none":
        return Decided(full - 1)
    if partial.threshold is None:
        return Decided(full - 1, "for some values")
    sign = "<=" if partial.below else ">="
    inside = partial.threshold / 2 if partial.below else (partial.threshold + 1) / 2
    return Decided(full - 1, f"a_{partial.state} {sign} {partial.threshold}", float(inside))


def printed_last(column: PaperTable, pattern: str) -> int:
    """The last depth at which the paper has the pattern in its set."""
    if any(in_class(pattern, name) for name in column.staying):
        return FOREVER
    depths = [row.depth for row in column.rows if any(in_class(pattern, name) for name in row.leaving)]
    return max(depths, default=NOWHERE)


def in_class(pattern: str, name: str) -> bool:
    """Whether the policies of a pattern are in a class like +0**0."""
    return all(mark in MARKS[sign] for mark, sign in zip(pattern, name, strict=True))


def class_name(cube: Cube[str]) -> str:
    """+0**0 for a product of sets of marks."""
    return "".join(SIGNS[marks] for marks in cube)


def _spelled(chosen: Iterable[str]) -> list[str]:
    return sorted(class_name(cube) for cube in cover(chosen))


def _members(last: Mapping[str, int], depth: int) -> int:
    return sum(found >= depth for found in last.values())


def _correct_row(truth: Mapping[str, Decided], depth: int) -> dict[str, Any]:
    """The classes that are stationary at this depth and not at the next one."""
    leaving = [pattern for pattern, found in truth.items() if found.last == depth]
    partly = {pattern: found for pattern, found in truth.items() if found.condition and found.last + 1 == depth}
    conditions = {found.condition for found in partly.values()}
    conditional = [
        {"classes": _spelled(p for p, found in partly.items() if found.condition == condition), "condition": condition}
        for condition in sorted(conditions)
    ]
    members = _members({pattern: found.last for pattern, found in truth.items()}, depth)
    return {"depth": depth, "leaving": _spelled(leaving), "conditional": conditional, "patterns": members}


def _differences(truth: Mapping[str, Decided], printed: Mapping[str, int]) -> list[dict[str, Any]]:
    """The classes whose last depth the paper has wrong, each with a witness policy."""
    keyed: dict[tuple[int, str, int], list[str]] = {}
    for pattern, found in truth.items():
        if printed[pattern] != found.last or found.condition:
            keyed.setdefault((found.last, found.condition, printed[pattern]), []).append(pattern)
    answer = []
    for (last, condition, said), chosen in keyed.items():
        for cube in cover(chosen):
            witness = "".join(next(mark for mark in "x10" if mark in marks) for marks in cube)
            probabilities = {NEVER: 0.0, SOMETIMES: truth[witness].interior, ALWAYS: 1.0}
            true_last = last + 1 if condition else last
            row = {
                "kind": "missing" if true_last > said else "too many",
                "class": class_name(cube),
                "condition": condition,
                "patterns": math.prod(map(len, cube)),
                "printed_in": _sets(said),
                "belongs_in": _sets(true_last),
                "witness": [probabilities[mark] for mark in witness],
                "stationary_at": None if true_last in (NOWHERE, FOREVER) else true_last,
                "escapes_at": None if true_last == FOREVER else true_last + 1,
            }
            answer.append((row["kind"], true_last, row["class"], row))
    return [row for *_, row in sorted(answer, key=lambda entry: entry[:3])]


def _sets(last: int) -> str:
    if last in (NOWHERE, FOREVER):
        return "none" if last == NOWHERE else "all"
    return "Pi^0" if last == 0 else f"Pi^0 .. Pi^{last}"
