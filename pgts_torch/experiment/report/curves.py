"""The curves of metrics.jsonl, and which of them share a panel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

MOST_POINTS = 400
"""Of a line; of more points the lowest and the highest of each stretch are kept."""

SHARED = {
    "Discounted return": {"exact/J": "J, exact", "charts/discounted_return": "episodes"},
    "What is missing": {
        "exact/optimality_gap": "J* - J, exact",
        "search/certificate": "certificate",
        "search/stationarity_gap": "stationarity gap",
    },
    "Return of episodes": {
        "charts/episodic_return": "training",
        "eval/deterministic_return": "greedy",
        "eval/sampled_return": "sampled",
    },
    "Length of episodes": {
        "charts/episodic_length": "training",
        "eval/deterministic_length": "greedy",
        "eval/sampled_length": "sampled",
    },
}
"""Panels of several tags, each with its name in the legend."""

HEADINGS = {"search": "Lookahead", "exact": "Lookahead", "losses": "Learning", "charts": "Learning"}
"""Of the panels of a single tag, by what it begins with."""

NAMES = {"charts/SPS": "Environment steps a second"}
INTERVAL = "_half_width"


@dataclass(frozen=True)
class Curve:
    """One tag over environment steps; None is a value that is not finite.

    half_widths: of the 95 % confidence interval, where there is one.
    """

    tag: str
    label: str
    steps: Sequence[int]
    values: Sequence[float | None]
    half_widths: Sequence[float | None] | None = None


@dataclass(frozen=True)
class Panel:
    """Curves with one axis. `level` is a value to compare them with, J*."""

    title: str
    curves: Sequence[Curve]
    level: float | None = None


@dataclass(frozen=True)
class Curves:
    """All tags: panels by heading, tags that never changed with their value, and tags that never were finite."""

    groups: Mapping[str, Sequence[Panel]]
    constant: Mapping[str, float]
    never_finite: Sequence[str]


def panels(lines: Sequence[Mapping[str, Any]]) -> Curves:
    """The tags of these lines of metrics.jsonl; half-widths belong to their means."""
    tags = list(dict.fromkeys(tag for line in lines for tag in line if tag != "step"))
    finite = {tag for line in lines for tag, value in line.items() if value is not None}
    groups: dict[str, list[Panel]] = {}
    constant: dict[str, float] = {}
    for title, labels in SHARED.items():
        if curves := [_curve(lines, tag, label) for tag, label in labels.items() if tag in finite]:
            level = _optimum(lines) if any(curve.tag == "exact/J" for curve in curves) else None
            groups.setdefault("Return", []).append(Panel(title, curves, level))
    drawn = {tag for labels in SHARED.values() for tag in labels}
    for tag in tags:
        if tag in drawn or tag not in finite or (tag.endswith(INTERVAL) and tag.removesuffix(INTERVAL) in tags):
            continue
        curve = _curve(lines, tag, "")
        if len(set(curve.values)) == 1:
            constant[tag] = next(value for value in curve.values if value is not None)
            continue
        room, _, name = tag.partition("/")
        title = NAMES.get(tag, name.replace("_", " ").capitalize() if room in HEADINGS else tag)
        groups.setdefault(HEADINGS.get(room, "More"), []).append(Panel(title, [curve]))
    order = ["Return", *HEADINGS.values(), "More"]
    return Curves(
        {heading: groups[heading] for heading in order if heading in groups},
        constant,
        [tag for tag in tags if tag not in finite],
    )


def _curve(lines: Sequence[Mapping[str, Any]], tag: str, label: str) -> Curve:
    points = [line for line in lines if tag in line]
    kept = _thinned([line[tag] for line in points])
    widths = [points[k].get(tag + INTERVAL) for k in kept]
    return Curve(
        tag,
        label,
        [points[k]["step"] for k in kept],
        [points[k][tag] for k in kept],
        widths if any(width is not None for width in widths) else None,
    )


def _thinned(values: Sequence[float | None]) -> list[int]:
    """The indices that a curve needs: of many points the first, the last, and each stretch's extremes or a gap."""
    if len(values) <= MOST_POINTS:
        return list(range(len(values)))
    kept = {0, len(values) - 1}
    for stretch in np.array_split(np.arange(len(values)), MOST_POINTS // 2):
        finite = [(value, k) for k in stretch.tolist() if (value := values[k]) is not None]
        kept |= {min(finite)[1], max(finite)[1]} if finite else {int(stretch[0])}
    return sorted(kept)


def _optimum(lines: Sequence[Mapping[str, Any]]) -> float | None:
    """J*, which is J and what is missing to it."""
    known = (line["exact/J"] + line["exact/optimality_gap"] for line in lines if _has_both(line))
    return next(known, None)


def _has_both(line: Mapping[str, Any]) -> bool:
    return line.get("exact/J") is not None and line.get("exact/optimality_gap") is not None
