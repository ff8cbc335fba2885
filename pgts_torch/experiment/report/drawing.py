"""How a panel of curves is drawn: as SVG that takes the colour and the font of the page around it."""

import io
import re
from html import escape

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullLocator

from pgts_torch.experiment.report.curves import Curve, Panel
from pgts_torch.experiment.report.markup import Html, typeset

COLOURS = ("#2b7bba", "#e07b18", "#3a9a5b")
"""To be seen on white and on black."""

WIDTHS = (2.8, 1.8, 1.2)
"""Curves that lie on each other stay visible: the last is thin and on top."""

INK, FAINT = "#010203", "#8a8a8a"
"""Text, which takes the colour of the page; and lines behind the curves."""

LOGARITHMIC = ("What is missing",)
LOG_RANGE = 100.0
"""A panel that may be is logarithmic once its positive values span more than this factor."""

FEW = 40
"""Up to so many points of a curve are marked."""

_METADATA = ("Date", "Creator", "Format", "Type")


def svg(panel: Panel) -> Html:
    """The panel as an SVG element, as wide as there is room."""
    salt = " ".join(curve.tag for curve in panel.curves)  # so that no two panels of a page share an id
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt, "font.size": 10}):
        figure = Figure(figsize=(4.9, 2.8), layout="constrained")
        axes = figure.subplots()
        widths = WIDTHS[-len(panel.curves) :]
        for curve, colour, width in zip(panel.curves, COLOURS, widths, strict=False):
            _draw(axes, curve, colour, width)
        if panel.level is not None:
            axes.axhline(panel.level, color=FAINT, linewidth=1.2, linestyle=(0, (5, 3)), label="J*")
        _arrange(axes, panel)
        if len(panel.curves) > 1 or panel.level is not None:
            figure.legend(loc="outside upper left", ncols=4, frameon=False, labelcolor=INK, handlelength=1.6)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata=dict.fromkeys(_METADATA))
    return _inline(buffer.getvalue(), describe(panel))


def describe(panel: Panel) -> str:
    """The panel in words, for those who do not see it."""
    return " ".join([f"{panel.title} over environment steps.", *map(_sentence, panel.curves)])


def _sentence(curve: Curve) -> str:
    finite = [(step, value) for step, value in zip(curve.steps, curve.values, strict=True) if value is not None]
    (first_step, first), (last_step, last) = finite[0], finite[-1]
    low, high = min(value for _, value in finite), max(value for _, value in finite)
    return (
        f"{curve.label or curve.tag}: {first:.4g} at step {first_step}, {last:.4g} at step {last_step}, "
        f"between {low:.4g} and {high:.4g}."
    )


def _draw(axes: Axes, curve: Curve, colour: str, width: float) -> None:
    value_K = np.array(curve.values, dtype=np.float64)  # None becomes nan, which leaves a gap
    marker = "." if len(value_K) <= FEW else ""
    axes.plot(curve.steps, value_K, color=colour, linewidth=width, marker=marker, label=typeset(curve.label))
    if curve.half_widths is not None:
        width_K = np.array(curve.half_widths, dtype=np.float64)
        axes.fill_between(curve.steps, value_K - width_K, value_K + width_K, color=colour, alpha=0.2, linewidth=0)


def _arrange(axes: Axes, panel: Panel) -> None:
    positive = [value for curve in panel.curves for value in curve.values if value is not None and value > 0]
    if panel.title in LOGARITHMIC and positive and max(positive) > LOG_RANGE * min(positive):
        axes.set_yscale("log", nonpositive="clip")
        axes.yaxis.set_major_locator(LogLocator(numticks=7))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("environment steps", color=INK)
    axes.tick_params(color=FAINT, labelcolor=INK)
    axes.margins(x=0.01)
    axes.grid(alpha=0.25, color=FAINT)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)


def _inline(document: str, description: str) -> Html:
    """What a page needs of an SVG file."""
    drawing = document[document.index("<svg") :].strip()
    drawing = re.sub(r"<style.*?</style>", "", drawing, flags=re.DOTALL)
    drawing = re.sub(r' id="[A-Za-z0-9.]+_[0-9]+"', "", drawing)  # nothing refers to these
    drawing = re.sub(r" font-family: [^;]*;", "", drawing).replace(INK, "currentColor")
    box = re.search(r'viewBox="[^"]*"', drawing)
    assert box is not None
    start = f'<svg {box[0]} role="img" aria-label="{escape(description)}">'
    return Html(start + drawing[drawing.index(">") + 1 :])
