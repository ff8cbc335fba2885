"""Statements of the paper, each held to what was measured under one or several readings of what it leaves unsaid."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from study.cubes import cover

Verdict = Literal["holds", "does not hold", "depends"]
Reading = Mapping[str, str | float | int]
"""What was assumed, by name: {"step size": 0.1, "m": 4}."""


@dataclass(frozen=True)
class Finding:
    """What was measured under one reading, and whether the statement is true of it."""

    reading: Reading
    measured: str
    holds: bool


@dataclass(frozen=True)
class Claim:
    """A statement of the paper.

    text: in our words.   place: where in the paper.   findings: the first is the reading of the figure.
    """

    text: str
    place: str
    findings: tuple[Finding, ...]

    def __post_init__(self) -> None:
        assert self.findings, self.text

    @property
    def verdict(self) -> Verdict:
        """Of all readings together."""
        holds = {finding.holds for finding in self.findings}
        return "depends" if len(holds) == 2 else "holds" if True in holds else "does not hold"

    @property
    def measured(self) -> str:
        """What the first reading gave and, where another one says the opposite, what that gave."""
        agreeing = f" ({len(self.findings)} readings agree)" if len(self.findings) > 1 else ""
        first = self.findings[0]
        other = next((finding for finding in self.findings if finding.holds != first.holds), None)
        if other is None:
            return first.measured + agreeing
        changed = {name: value for name, value in other.reading.items() if first.reading[name] != value}
        return f"{first.measured}; with {spell(changed)}: {other.measured}"

    @property
    def condition(self) -> str:
        """On what the verdict depends: the fewest names that decide it, and the values for which it holds or fails."""
        if self.verdict != "depends":
            return ""
        names = deciding_names(self.findings)
        points = {tuple(finding.reading[name] for name in names): finding.holds for finding in self.findings}
        kept = {holds: cover(point for point, h in points.items() if h == holds) for holds in (True, False)}
        holds = len(kept[True]) <= len(kept[False])
        tried = [list(dict.fromkeys(point[place] for point in points)) for place in range(len(names))]
        listed = [_spell_cube(names, cube, tried) for cube in kept[holds]]
        return f"{'holds' if holds else 'fails'} for {'; '.join(listed)}"

    def plain(self) -> dict[str, Any]:
        """Plain data, with the verdict and its condition."""
        return asdict(self) | {"verdict": self.verdict, "measured": self.measured, "condition": self.condition}


def deciding_names(findings: Sequence[Finding]) -> tuple[str, ...]:
    """The smallest set of names of the readings whose values settle the verdict."""
    names = tuple(findings[0].reading)
    for count in range(len(names) + 1):
        for chosen in itertools.combinations(names, count):
            settled: dict[tuple[Any, ...], bool] = {}
            key_holds = ((tuple(f.reading[name] for name in chosen), f.holds) for f in findings)
            if all(settled.setdefault(key, holds) == holds for key, holds in key_holds):
                return chosen
    raise AssertionError(f"two findings of one reading contradict each other: {findings}")


def spell(reading: Reading) -> str:
    """`step size 0.1, m = 4`."""
    return ", ".join(_equation(name, [value]) for name, value in reading.items())


def _equation(name: str, values: Sequence[Any]) -> str:
    text = " or ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in values)
    return f"{name} = {text}" if len(name) == 1 else f"{name} {text}"


def _spell_cube(names: Sequence[str], cube: Sequence[frozenset[Any]], tried: Sequence[Sequence[Any]]) -> str:
    """The values of a product of sets, without the names of which every tried value is in it."""
    named = [
        _equation(name, [value for value in all_values if value in values])
        for name, values, all_values in zip(names, cube, tried, strict=True)
        if len(values) < len(all_values)
    ]
    return ", ".join(named)


def judge(text: str, place: str, findings: Iterable[Finding]) -> Claim:
    """The claim with all that was found."""
    return Claim(text, place, tuple(findings))
