"""The learning curves of a comparison as a picture, and the page about it."""

import io
import itertools
import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pgts_torch import files
from pgts_torch.experiment.compare.comparison import WORDS, Comparison, Panel, opposite
from pgts_torch.experiment.compare.runs import AXES
from pgts_torch.experiment.compare.text import heading, interval, number
from pgts_torch.experiment.report.curves import GREY, INK, style
from pgts_torch.experiment.report.html import Filters, image, render

PAGE_FILE, PICTURE_FILE = "compare.html", "compare.png"
SIGN = "pgts compare"
"""By which a page and a picture are recognised as ours."""

COLOURS = ("#2b7bba", "#e07b18", "#3a9a5b", "#c23b3b", "#8b62b8", "#8a5a44", "#d770b8", "#1fa6b8", "#a0a01f", "#5a6b7a")
"""More groups are grey: the ten best have a colour."""


def figure(comparison: Comparison) -> Figure:
    """A panel for each environment: interquartile means over runs, with 95 % intervals, against what was spent."""
    panels = comparison.panels
    columns = min(len(panels), 3)
    rows = math.ceil(len(panels) / columns)
    colours = _colours(comparison)
    labels = {
        group.letter: f"{group.letter}  {shortened(group.label, 110 if columns > 1 else 92)}"
        for group in comparison.groups
    }
    height = 0.19 * (len(colours) + 1)
    drawn = Figure(figsize=(7 if columns == 1 else 4.4 * columns, 3.6 * rows + height), layout="constrained")
    for panel, axes in itertools.zip_longest(panels, drawn.subplots(rows, columns, squeeze=False).flatten()):
        if panel is None:
            axes.remove()
        else:
            _draw(axes, panel, colours, comparison.x)
    handles = [Line2D([], [], color=colour, linewidth=2.2, label=labels[letter]) for letter, colour in colours.items()]
    if len(colours) < len(labels):
        handles.append(Line2D([], [], color=GREY, linewidth=1, label=f"{len(labels) - len(colours)} others"))
    drawn.legend(handles=handles, loc="outside lower left", frameon=False, labelcolor=INK, fontsize=9)
    return drawn


def _alone(panel: Panel, colours: dict[str, str], x: str) -> Figure:
    drawn = Figure(figsize=(6, 3.6), layout="constrained")
    _draw(drawn.subplots(), panel, colours, x)
    return drawn


def _draw(axes: Axes, panel: Panel, colours: dict[str, str], x: str) -> None:
    widths = dict(zip(colours, np.linspace(2.8, 1.4, len(colours)), strict=True))  # those that coincide stay visible
    for curve in sorted(panel.curves, key=lambda curve: curve.letter in colours):
        colour, width = colours.get(curve.letter, GREY), widths.get(curve.letter, 0.8)
        marker = "o" if len(curve.x) == 1 else ""
        axes.plot(curve.x, curve.mean, color=colour, linewidth=width, marker=marker, markersize=4)
        if curve.low is not None and curve.high is not None and curve.letter in colours:
            axes.fill_between(curve.x, curve.low, curve.high, color=colour, alpha=0.18, linewidth=0)
    if len(panel.curves) > 1 and panel.at < axes.get_xlim()[1]:
        axes.axvline(panel.at, color=GREY, linewidth=0.8, linestyle=":")
    style(axes, AXES[x])
    axes.set_ylabel(WORDS.get(panel.tag, panel.tag), color=INK)
    axes.set_title(shortened(panel.env, 48), color=INK, fontsize=11)


def _colours(comparison: Comparison) -> dict[str, str]:
    """Colours of the groups, or of the best of them, in their order."""
    letters = [group.letter for group in comparison.groups]
    if len(letters) > len(COLOURS):
        scores = {curve.letter: curve.score.mean for panel in comparison.panels[:1] for curve in panel.curves}
        best = sorted(letters, key=lambda letter: -scores.get(letter, -math.inf))[: len(COLOURS)]
        letters = [letter for letter in letters if letter in best]
    return dict(zip(letters, COLOURS, strict=False))


def shortened(text: str, most: int) -> str:
    """A text of at most so many characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def png(drawn: Figure) -> bytes:
    """A picture as PNG, by which it is recognised as ours."""
    raw = io.BytesIO()
    drawn.savefig(raw, dpi=120, metadata={"Software": SIGN})
    return raw.getvalue()


def write(comparison: Comparison, out: Path) -> list[str]:
    """Write page and picture into a folder; their paths.

    Raises:
        PgtsError: something else is in their place, or cannot be replaced.
    """
    places = {
        name: files.target(out / name, lambda raw: SIGN.encode() in raw, f"of {SIGN}")
        for name in (PAGE_FILE, PICTURE_FILE)
    }
    drawn = figure(comparison)
    with files.named(f"--out {out} cannot be written to"):
        out.mkdir(parents=True, exist_ok=True)
    files.replace(places[PICTURE_FILE], png(drawn))
    files.replace(places[PAGE_FILE], page(comparison))
    return [str(out / name) for name in places]


def page(comparison: Comparison) -> bytes:
    """The page about a comparison, with its pictures inside."""
    colours = _colours(comparison)
    pairs = {(pair.better, pair.worse): pair.probability for pair in comparison.pairs}
    pairs |= {(worse, better): opposite(each) for (better, worse), each in pairs.items()}
    values = {
        "comparison": comparison,
        "colours": colours,
        "pairs": pairs,
        "sign": SIGN,
    }
    filters: Filters = {
        "number": number,
        "interval": interval,
        "heading": lambda panel: heading(panel, comparison.x),
        "curve": lambda panel: image(_alone(panel, colours, comparison.x), transparent=True),
    }
    return render("compare.html", values, filters=filters)
