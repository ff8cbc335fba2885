"""The curves of metrics.jsonl, grouped into panels, and the plot of a panel."""

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

RETURN, MISSING = "Discounted return", "What is missing"
SHARED = {
    RETURN: {"exact/J": "J, exact", "charts/discounted_return": "episodes"},
    MISSING: {
        "exact/optimality_gap": "J* \N{MINUS SIGN} J, exact",
        "search/certificate": "certificate",
        "search/gap_bound": "estimate from the gap",
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
"""Panels with several tags, by title; each tag with its name in the legend."""

HEADINGS = {"search": "Lookahead", "exact": "Lookahead", "losses": "Learning", "charts": "Learning"}
"""The headings of panels with a single tag, by its prefix."""

INTERVAL = "_half_width"
INK, GREY = "#010203", "#8a8a8a"
"""The colours of text, replaced by a light one on dark pages, and of axes and grid."""

COLOURS, WIDTHS = ("#2b7bba", "#e07b18", "#3a9a5b", "#8e5aa8"), (3.8, 2.8, 1.8, 1.2)
"""Later curves are thinner and on top, so that curves that coincide stay visible."""


class Curve(TypedDict):
    """A tag over environment steps, with half-widths of 95 % confidence intervals; None: not finite, or unknown."""

    tag: str
    label: str
    steps: Sequence[int]
    values: Sequence[float | None]
    half_widths: Sequence[float | None] | None


class Panel(TypedDict):
    """Curves on common axes, and the level of a horizontal line."""

    title: str
    curves: Sequence[Curve]
    level: float | None


def panels(lines: Sequence[Mapping[str, Any]]) -> tuple[dict[str, list[Panel]], dict[str, float], list[str]]:
    """Return panels by heading, the tags that never change with their value, and the tags that are never finite."""
    tags = list(dict.fromkeys(tag for line in lines for tag in line if tag != "step"))
    finite = {tag for line in lines for tag, value in line.items() if value is not None}
    groups: dict[str, list[Panel]] = {heading: [] for heading in ("Return", *HEADINGS.values(), "More")}
    constant: dict[str, float] = {}
    pairs = [(line.get("exact/J"), line.get("exact/optimality_gap")) for line in lines]
    optimum = next((J + gap for J, gap in pairs if J is not None and gap is not None), None)
    for title, labels in SHARED.items():
        if found := [_curve(lines, tag, label) for tag, label in labels.items() if tag in finite]:
            groups["Return"].append(Panel(title=title, curves=found, level=optimum if title == RETURN else None))
    drawn = {tag for labels in SHARED.values() for tag in labels} | {f"{tag}{INTERVAL}" for tag in tags}
    for tag in (tag for tag in tags if tag in finite - drawn):
        curve = _curve(lines, tag, "")
        if len(set(curve["values"])) == 1:
            constant[tag] = lines[-1].get(tag, curve["values"][0])
            continue
        kind, _, name = tag.replace("/SPS", "/environment steps a second").partition("/")
        title = name[:1].upper() + name[1:].replace("_", " ") if kind in HEADINGS else tag
        groups[HEADINGS.get(kind, "More")].append(Panel(title=title, curves=[curve], level=None))
    never = [tag for tag in tags if tag not in finite]
    return {heading: found for heading, found in groups.items() if found}, constant, never


def _curve(lines: Sequence[Mapping[str, Any]], tag: str, label: str) -> Curve:
    points = [line for line in lines if tag in line]
    steps, values = [line["step"] for line in points], [line[tag] for line in points]
    widths = [line.get(tag + INTERVAL) for line in points]
    return Curve(tag=tag, label=label, steps=steps, values=values, half_widths=widths if any(widths) else None)


def draw(panel: Panel) -> Figure:
    """Plot the curves of a panel, with a legend where there is more than one line."""
    figure = Figure(figsize=(5, 2.9), layout="constrained")
    axes = figure.subplots()
    for curve, colour, width in zip(panel["curves"], COLOURS, WIDTHS[-len(panel["curves"]) :], strict=False):
        value_K = np.array(curve["values"], dtype=np.float64)  # None becomes nan, which leaves a gap
        marker = "." if len(value_K) <= 40 else ""
        axes.plot(curve["steps"], value_K, color=colour, linewidth=width, marker=marker, label=curve["label"])
        if curve["half_widths"] is not None:
            width_K = np.array(curve["half_widths"], dtype=np.float64)
            band = (value_K - width_K, value_K + width_K)
            axes.fill_between(curve["steps"], *band, color=colour, alpha=0.2, linewidth=0)
    if panel["level"] is not None:
        axes.axhline(panel["level"], color=GREY, linewidth=1.2, linestyle="--", label="J*")
    positive = [value for curve in panel["curves"] for value in curve["values"] if value is not None and value > 0]
    if panel["title"] == MISSING and positive and max(positive) > 100 * min(positive):
        axes.set_yscale("log", nonpositive="clip")
    style(axes, "environment steps")
    if len(axes.lines) > 1:
        figure.legend(loc="outside upper left", ncols=4, frameon=False, labelcolor=INK, handlelength=1.6)
    return figure


def style(axes: Axes, x: str) -> None:
    """Name the horizontal axis, and draw axes and grid in colours that fit light and dark pages."""
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel(x, color=INK)
    axes.tick_params(color=GREY, labelcolor=INK)
    axes.margins(x=0.01)
    axes.grid(alpha=0.25, color=GREY)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
