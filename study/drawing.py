"""The pictures, each from the plain data of its part."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from pgts_torch.experiment.statistics import bootstrap_interval
from pgts_torch.seeding import numpy_stream

Data = Mapping[str, Any]
Colour = tuple[float, float, float, float]

SMALLEST_GROUP = 5
"""Means of fewer MDPs say little and are left out."""

START_TITLES = {"s0": "start in s0", "uniform": "uniform start"}
UPDATE_TITLES = {"projected": "simplex policy, projected update", "softmax": "softmax policy"}


def pictures(part: str) -> Mapping[str, Callable[[Data], Figure]]:
    """What draws the pictures of a part from its data, by file name without its ending."""
    several = {"depth": {"depth": depth_maps, "mirage": mirage_curves}, "stationary": {"stationary": sufficient_depths}}
    several["bounds"] = {"bounds": bounds_over_training}
    return several.get(part, {part: curves})


def curves(data: Data) -> Figure:
    """Return against iteration: a column for each start, a row for each update; solid exact, dashed from samples."""
    panels = data["panels"]
    updates = list(dict.fromkeys(panel["update"] for panel in panels))
    starts = list(dict.fromkeys(panel["start"] for panel in panels))
    figure = Figure(figsize=(11, 3.6 * len(updates)), layout="constrained")
    axes = figure.subplots(len(updates), len(starts), squeeze=False)
    depths = [int(depth) for depth in panels[0]["exact"]]
    colours = depth_colours(depths)
    for panel in panels:
        ax = axes[updates.index(panel["update"])][starts.index(panel["start"])]
        _draw_panel(ax, panel, colours)
    sampled = any(panel["sampled"] for panel in panels)
    figure.legend(handles=_legend(colours, sampled=sampled), loc="outside right upper", frameon=False)
    return figure


def depth_colours(depths: Sequence[Any]) -> dict[Any, Colour]:
    """From dark for the least to bright for the largest, in even steps that colour-blind readers can tell apart."""
    scale = matplotlib.colormaps["viridis"](np.linspace(0, 0.92, len(depths)))
    return {depth: (r, g, b, alpha) for depth, (r, g, b, alpha) in zip(depths, scale.tolist(), strict=True)}


def _draw_panel(ax: Axes, panel: Data, colours: Mapping[int, Colour]) -> None:
    for order, (depth, colour) in enumerate(colours.items()):
        # Lines that lie on each other stay visible: the shallow ones are broad, the deep ones thin and on top.
        width = 4.5 - 3.3 * order / max(1, len(colours) - 1)
        ax.plot(panel["exact"][str(depth)], color=colour, linewidth=width, alpha=0.85, zorder=2 + 0.1 * order)
        band = panel["sampled"].get(str(depth))
        if band:
            iterations = range(len(band["iqm"]))
            ax.fill_between(iterations, band["low"], band["high"], color=colour, alpha=0.2, linewidth=0)
            ax.plot(iterations, band["iqm"], color=colour, linewidth=1.1, linestyle=(0, (4, 2)), zorder=4)
    ax.axhline(panel["J_optimal"], color="0.4", linewidth=0.9, linestyle=":")
    ax.set_title(f"{UPDATE_TITLES[panel['update']]}, {START_TITLES[panel['start']]}", fontsize=10)
    ax.set_xlabel(f"iteration (step size {panel['step_size']:g})")
    ax.set_ylabel("return J")
    ax.margins(x=0.01)
    ax.grid(alpha=0.25)


def _legend(colours: Mapping[int, Colour], *, sampled: bool) -> list[Line2D | Patch]:
    names = {0: "m = 0 (PG)"}
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=colour, linewidth=3, label=names.get(depth, f"m = {depth}"))
        for depth, colour in colours.items()
    ]
    handles.append(Line2D([], [], color="0.4", linestyle=":", label="J*"))
    handles.append(Line2D([], [], color="k", linewidth=2, label="exact"))
    if sampled:
        handles.append(Line2D([], [], color="k", linewidth=1.1, linestyle=(0, (4, 2)), label="from samples (IQM)"))
        handles.append(Patch(color="k", alpha=0.2, linewidth=0, label="95 % interval"))
    return handles


def depth_maps(data: Data) -> Figure:
    """Iterations to arrive over depth and step size: a row for each MDP, a column for each start."""
    names = list(dict.fromkeys(one["mdp"] for one in data["maps"]))
    starts = list(dict.fromkeys(one["start"] for one in data["maps"]))
    heights = [max(len(one["depths"]) for one in data["maps"] if one["mdp"] == name) for name in names]
    figure = Figure(figsize=(11, 0.3 * sum(heights) + 0.95 * len(names)), layout="constrained")
    axes = figure.subplots(len(names), len(starts), squeeze=False, height_ratios=heights)
    norm = LogNorm(1, max(one["limit"] for one in data["maps"]))
    colours = matplotlib.colormaps["viridis_r"].with_extremes(bad="0.85")
    for one in data["maps"]:
        ax = axes[names.index(one["mdp"])][starts.index(one["start"])]
        values = np.array([[np.nan if k is None else max(k, 1) for k in row] for row in one["iterations"]], dtype=float)
        image = ax.imshow(values, cmap=colours, norm=norm, aspect="auto")
        _write_cells(ax, one, norm)
        ax.set_xticks(range(len(one["steps"])), [f"{step:g}" for step in one["steps"]])
        ax.set_yticks(range(len(one["depths"])), [str(depth) for depth in one["depths"]])
        ax.set_title(f"{one['mdp']}, {START_TITLES[one['start']]}", fontsize=10)
        ax.set_ylabel("depth m")
    for ax in axes[-1]:
        ax.set_xlabel("step size")
    label = "iterations to 99 % of the way from J of the initial policy to J* (grey: not within the limit)"
    figure.colorbar(image, ax=axes, label=label, shrink=0.4)
    return figure


def _write_cells(ax: Axes, one: Data, norm: LogNorm) -> None:
    for y, row in enumerate(one["iterations"]):
        for x, k in enumerate(row):
            if k is None:
                ax.text(x, y, f"> {one['limit']}", ha="center", va="center", fontsize=7, color="0.35")
            else:
                dark = norm(max(k, 1)) > 0.5
                ax.text(x, y, f"{k:g}", ha="center", va="center", fontsize=8, color="w" if dark else "k")


def mirage_curves(data: Data) -> Figure:
    """The MDP where depth slows: exact returns, and the advantage that each depth sees beside the formula."""
    shown = data["mirage"]
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    depths = [int(depth) for depth in shown["exact"]]
    colours = depth_colours(depths)
    for depth, colour in colours.items():
        left.plot(shown["exact"][str(depth)], color=colour, linewidth=2, label=f"m = {depth}")
    left.axhline(shown["J_optimal"], color="0.4", linewidth=0.9, linestyle=":", label="J*")
    left.set_xlabel(f"iteration (step size {shown['step_size']:g})")
    left.set_ylabel("return J")
    left.legend(loc="lower right", frameon=False, fontsize=9)
    right.plot(depths, [shown["formula"][str(m)] for m in depths], color="0.6", linewidth=3, label="formula")
    for depth, colour in colours.items():
        right.plot(depth, shown["advantage"][str(depth)], "o", color=colour, zorder=3)
    right.plot([], [], "ko", label="computed")
    right.set_xlabel("depth m")
    right.set_ylabel("advantage of 'right' in state 0")
    right.set_ylim(bottom=0)
    right.legend(frameon=False, fontsize=9)
    for ax in (left, right):
        ax.grid(alpha=0.25)
    return figure


def bounds_over_training(data: Data) -> Figure:
    """For each MDP: what is lacking and the measured bounds over the training, and bounds over depth at its end."""
    figure = Figure(figsize=(11, 3.1 * len(data["mdps"])), layout="constrained")
    axes = figure.subplots(len(data["mdps"]), 2, squeeze=False)
    colours = depth_colours(data["shown"])
    kinds = {"true": "true values behind it", "known": "range of values", "measured": "and with errors"}
    for (name, found), (left, right) in zip(data["mdps"].items(), axes, strict=True):
        rows, last = found["rows"], found["rows"][-1]
        iterations = [row["iteration"] for row in rows]
        left.plot(iterations, [row["lacks"] for row in rows], color="k", linewidth=2.2, label="J* \N{MINUS SIGN} J")
        for depth, colour in colours.items():
            place = data["depths"].index(depth)
            values = [row["measured"][place] for row in rows]
            left.plot(iterations, values, color=colour, linewidth=1.6, label=f"bound, m = {depth}")
        left.set_title(f"{name}: bounds with errors, over a training", fontsize=10)
        left.set_xlabel(f"iteration (depth {found['training_depth']})")
        for (kind, label), ink in zip(kinds.items(), ("#3a9a5b", "#2b7bba", "#e07b18"), strict=True):
            values = last[kind]
            right.plot(data["depths"], values, color=ink, linewidth=1.6, label=label)
            best = found["best"][kind]
            right.plot(best, values[data["depths"].index(best)], "o", color=ink, markersize=5)
        right.axhline(last["lacks"], color="k", linestyle=":", linewidth=1.2, label="J* \N{MINUS SIGN} J")
        right.set_title(f"{name}: bounds on the last policy, over depth", fontsize=10)
        right.set_xlabel("depth m")
        for ax in (left, right):
            ax.set_yscale("symlog", linthresh=1e-2 * max(last["known"]))
            ax.set_ylim(bottom=0)
            ax.set_ylabel("return")
            ax.grid(alpha=0.25)
    for ax, place in zip(axes[0], ("lower right", "upper right"), strict=True):
        ax.legend(frameon=False, fontsize=8, ncols=2, loc=place)  # for all rows
    return figure


def sufficient_depths(data: Data) -> Figure:
    """The sufficient depth M of random MDPs against diameter, reward sparsity and discount; means, 95 % intervals."""
    rows = data["family"]
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    axes = figure.subplots(1, 3)
    _draw_groups(axes[0], rows, "diameter", "gamma", "diameter (longest shortest path)")
    _draw_groups(axes[1], rows, "reward_share", "gamma", "share of (s, a) with a reward")
    _draw_groups(axes[2], rows, "gamma", "branching", "discount gamma")
    axes[0].set_ylabel("sufficient depth M")
    return figure


def _draw_groups(ax: Axes, rows: Sequence[Data], across: str, by: str, label: str) -> None:
    """The mean of M over the rows of each value of `across`, a line for each value of `by`, evenly spaced."""
    sizes = Counter((row[by], row[across]) for row in rows)
    ticks = sorted({tick for (_, tick), size in sizes.items() if size >= SMALLEST_GROUP})
    values = sorted({row[by] for row in rows})
    names = {"branching": "successors", "gamma": "gamma"}
    for order, (value, colour) in enumerate(depth_colours(values).items()):
        groups = [[row["sufficient_depth"] for row in rows if row[by] == value and row[across] == t] for t in ticks]
        at = [tick for tick, group in enumerate(groups) if len(group) >= SMALLEST_GROUP]
        bars = np.array([mean_interval(groups[tick], by, order, tick) for tick in at]).reshape(-1, 3).T
        place = np.array(at) + 0.08 * (order - (len(values) - 1) / 2)
        ax.errorbar(
            place,
            bars[0],
            (bars[0] - bars[1], bars[2] - bars[0]),
            color=colour,
            marker="o",
            capsize=3,
            label=f"{names[by]} {value:g}",
        )
    ax.set_xticks(range(len(ticks)), [f"{tick:g}" for tick in ticks])
    ax.set_xlabel(label)
    ax.set_yscale("symlog", linthresh=1)
    ax.set_yticks([0, 1, 2, 5, 10, 20, 50, 100], ["0", "1", "2", "5", "10", "20", "50", "100"])
    ax.set_ylim(-0.05, 150)
    ax.legend(frameon=False, fontsize=9, loc="upper left")
    ax.grid(alpha=0.25)


def mean_interval(values: Sequence[float], *names: str | int) -> tuple[float, float, float]:
    """The mean and its 95 % bootstrap percentile interval.

    Args:
        names: of the stream that resamples.
    """
    given = np.asarray(values, dtype=float)
    random = numpy_stream(0, "mean_interval", *names)
    low, high = bootstrap_interval(given, statistic=lambda drawn: drawn.mean(axis=-1), random=random)
    return float(given.mean()), float(low), float(high)
