"""A comparison as text within 80 columns, and as plain values."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from pgts_torch.experiment.compare.comparison import WORDS, Comparison, Curve, Panel
from pgts_torch.experiment.compare.runs import AXES
from pgts_torch.experiment.statistics import Mean

WIDTH = 79
LABEL = 34
MOST_NOTES, MOST_PAIRS = 12, 45
FOOT = "IQM: mean of runs without the lowest and the highest quarter. Intervals: 95 %, stratified bootstrap over runs."


def describe(comparison: Comparison) -> str:
    """The tables as a person reads them."""
    labels = {group.letter: group.label for group in comparison.groups}
    lines = []
    for panel in comparison.panels:
        lines += [
            *textwrap.wrap(heading(panel, comparison.x), WIDTH),
            *_table([(curve.letter, labels[curve.letter], len(curve.score_R), curve.score) for curve in panel.curves]),
            "",
        ]
    if comparison.scaled:
        runs = {
            letter: sum(len(c.score_R) for p in comparison.panels for c in p.curves if c.letter == letter)
            for letter in labels
        }
        rows = [(letter, labels[letter], runs[letter], score) for letter, score in comparison.scaled.items()]
        lines += ["all environments, scores scaled to [0, 1]", *_table(rows), ""]
    if comparison.pairs:
        lines += [*_pairs(comparison), ""]
    for note in comparison.notes[:MOST_NOTES]:
        lines += textwrap.wrap(f"note: {note}", WIDTH, subsequent_indent="  ", break_on_hyphens=False)
    if (rest := len(comparison.notes) - MOST_NOTES) > 0:
        lines.append(f"note: and {rest} more, in --json")
    return "\n".join([*lines, *textwrap.wrap(FOOT, WIDTH)])


def heading(panel: Panel, x: str) -> str:
    """What the scores of an environment are."""
    return f"{panel.env}: {WORDS.get(panel.tag, panel.tag)}, after {number(panel.at)} {AXES[x]}"


def number(value: float) -> str:
    """A number with the digits that a person reads."""
    return f"{value:,.0f}" if value == int(value) and abs(value) < 1e15 else f"{value:.4g}"


def interval(mean: Mean) -> str:
    """Its ends; empty where there are none."""
    return "" if mean.low is None or mean.high is None else f"[{mean.low:.4g}, {mean.high:.4g}]"


def _table(rows: Sequence[tuple[str, str, int, Mean]]) -> Iterator[str]:
    yield f"{'':3}{'':{LABEL}}{'runs':>5}{'IQM':>11}{'95 % interval':>25}"
    for letter, label, runs, score in rows:
        first, *more = textwrap.wrap(label, LABEL, break_on_hyphens=False) or [""]
        yield f"{letter:3}{first:{LABEL}}{runs:>5}{score.mean:>11.4g}{interval(score):>25}".rstrip()
        yield from (f"{'':5}{line}" for line in more)


def _pairs(comparison: Comparison) -> Iterator[str]:
    yield "probability that a run of one group is better than a run of another"
    pairs = comparison.pairs
    if len(pairs) > MOST_PAIRS:
        wins = [sum(pair.better == group.letter for pair in pairs) for group in comparison.groups]
        best = comparison.groups[wins.index(max(wins))].letter
        pairs = [pair for pair in pairs if best in (pair.better, pair.worse)]
    cells = [
        f"{f'{pair.better} > {pair.worse}':<9}{pair.probability.mean:.2f} "
        + ("" if pair.probability.low is None else f"[{pair.probability.low:.2f}, {pair.probability.high:.2f}]")
        for pair in pairs
    ]
    for start in range(0, len(cells), 3):
        yield "".join(f"{cell:<27}" for cell in cells[start : start + 3]).rstrip()
    if len(pairs) < len(comparison.pairs):
        yield f"and {len(comparison.pairs) - len(pairs)} more, in --json"


def to_json(comparison: Comparison) -> dict[str, Any]:
    """All of it in JSON types."""
    return {
        "x": comparison.x,
        "groups": [
            {
                "letter": group.letter,
                "label": group.label,
                "settings": dict(group.settings),
                "runs": [
                    {
                        "path": str(run.path),
                        "env": run.env,
                        "seed": run.config.seed,
                        "state": run.state,
                        "steps": run.steps,
                    }
                    for run in group.runs
                ],
            }
            for group in comparison.groups
        ],
        "environments": [
            {
                "env": panel.env,
                "metric": panel.tag,
                "at": panel.at,
                "curves": [_plain(curve) for curve in panel.curves],
            }
            for panel in comparison.panels
        ],
        "pairs": [asdict(pair) for pair in comparison.pairs],
        "scaled": {letter: asdict(score) for letter, score in comparison.scaled.items()},
        "notes": list(comparison.notes),
    }


def _plain(curve: Curve) -> dict[str, Any]:
    kept = {name: getattr(curve, name) for name in ("letter", "x", "mean", "low", "high")}
    return kept | {"scores": curve.score_R.tolist(), "score": asdict(curve.score)}
