"""Groups of runs beside each other: curves, scores at equal cost, and how probably one is better than another."""

import itertools
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pgts_torch.errors import PgtsError
from pgts_torch.experiment.compare.groups import Group, by_key, grouped
from pgts_torch.experiment.compare.runs import AXES, GREEDY, TRAINING, J, Notes, Points, Trained, gathered
from pgts_torch.experiment.statistics import Mean, bootstrap_interval, estimate, interquartile_mean
from pgts_torch.experiment.statistics import probability_of_improvement as improvement

CURVE_POINTS = 100
MOST_GROUPS = 20
"""Of more groups, each is compared with the best one only."""

WORDS = {J: "J, the exact return of the policy", GREEDY: "return of greedy episodes", TRAINING: "return of episodes"}


@dataclass(frozen=True)
class Curve:
    """The runs of a group in one environment.

    x, mean, low, high: interquartile means over runs with the ends of their 95 % intervals; None for a single run.
    score_R: of each run at `Panel.at`.
    """

    letter: str
    x: Sequence[float]
    mean: Sequence[float]
    low: Sequence[float] | None
    high: Sequence[float] | None
    score_R: Float[np.ndarray, "R"]
    score: Mean


@dataclass(frozen=True)
class Panel:
    """One environment.

    at: what each run has spent where it is scored, the most that all of them have.
    """

    env: str
    tag: str
    at: float
    curves: Sequence[Curve]


@dataclass(frozen=True)
class Pair:
    """The probability that a run of one group is better than one of another, over the environments of both."""

    better: str
    worse: str
    probability: Mean


@dataclass(frozen=True)
class Comparison:
    """What there is to say of some runs.

    x: one of `AXES`.
    scaled: interquartile means of scores over all environments, scaled by the returns that count as 0 and 1, by letter;
        empty where these are not given for all environments.
    """

    x: str
    groups: Sequence[Group]
    panels: Sequence[Panel]
    pairs: Sequence[Pair]
    scaled: Mapping[str, Mean]
    notes: Sequence[str]


def compare(
    paths: Sequence[Path],
    *,
    by: str = "config",
    x: str = "steps",
    metric: str | None = None,
    finished: bool = False,
    scale: Mapping[str, tuple[float, float]] | None = None,
) -> Comparison:
    """Compare the runs in some folders.

    Args:
        by: what makes runs one group: config, all of it up to the seed; name, the key of this name; folder, the one
            that they lie in; or a regular expression, by what it matches in their paths (its first group, if any).
        metric: the tag that is compared; None: the first of exact J, greedy and training episodes that there is.
        scale: the returns that count as 0 and as 1, by the id of the environment.

    Raises:
        PgtsError: there is nothing to compare.
    """
    notes = Notes()
    runs = list(_counted(gathered(paths, notes), notes, finished=finished))
    if not runs:
        raise notes.refusal("no run is left to compare")
    groups = grouped(runs, by, notes)
    by_env: dict[str, list[tuple[Group, list[Trained]]]] = defaultdict(list)
    for group in groups:
        for env, inside in by_key((run.env, run) for run in group.runs).items():
            by_env[env].append((group, inside))
    panels = [panel for env, parts in by_env.items() if (panel := _panel(env, parts, x, metric, notes)) is not None]
    if not panels:
        raise notes.refusal("nothing can be compared")
    drawn = {curve.letter for panel in panels for curve in panel.curves}
    groups = [group for group in groups if group.letter in drawn]
    scaled = _scaled(panels, scale or {}, notes)
    return Comparison(x, groups, panels, list(_pairs(groups, panels)), scaled, notes.lines())


def _counted(runs: Iterable[Trained], notes: Notes, *, finished: bool) -> Iterator[Trained]:
    """Each training once, with notes about those that are not finished."""
    seen: dict[str, Path] = {}
    for run in runs:
        key = json.dumps([run.env, run.config.seed, run.settings])
        if (other := seen.setdefault(key, run.path)) != run.path:
            notes.add("left out, as the same training with the same seed is there already", f"{run.path} (as {other})")
            continue
        if run.state != "finished":
            what = "left out, as not finished" if finished else "not finished, and --finished leaves them out"
            notes.add(what, f"{run.path} ({run.state}, step {run.steps:,} of {run.config.total_steps:,})")
        if run.state == "finished" or not finished:
            yield run


def _panel(
    env: str, parts: Sequence[tuple[Group, list[Trained]]], x: str, metric: str | None, notes: Notes
) -> Panel | None:
    """The curves and the scores of an environment; None, with a note, where no run has any."""
    tag = metric or _tag([runs for _, runs in parts])
    points: dict[str, list[tuple[Trained, Points]]] = {}
    for group, runs in parts:
        for run in runs:
            if (curve := run.curve(tag, x)) is not None:
                points.setdefault(group.letter, []).append((run, curve))
            elif run.curve(tag, "steps") is None:
                known = sorted({name for line in run.lines for name in line if name != "step"})
                close = [name for name in known if name.partition("/")[0] == tag.partition("/")[0]]
                notes.add(f"left out, as they have no {tag} (but {', '.join(close or known)})", str(run.path))
            else:
                notes.add(f"left out, as they have no {AXES[x]}", str(run.path))
    if not points:
        return None
    ends = {run: np.inf if run.is_over else x_K[-1] for runs in points.values() for run, (x_K, _) in runs}
    last = max(x_K[-1] for runs in points.values() for _, (x_K, _) in runs)
    at = min(last, *ends.values())
    late = [run for runs in points.values() for run, (x_K, _) in runs if x_K[0] > at]
    if late:
        first = min(ends, key=lambda run: ends[run])
        what = f"{env}: no {tag} before {at:,.4g} {x}, where {first.path} ends, and so scored by their first one"
        for run in late:
            notes.add(what, str(run.path))
    return Panel(env, tag, float(at), [_curve(letter, runs, at) for letter, runs in points.items()])


def _tag(groups: Sequence[Sequence[Trained]]) -> str:
    """The metric by which runs are compared: the first of which a run of each group has a curve."""
    same_gamma = len({run.config.env.gamma for runs in groups for run in runs}) == 1
    for tag in (J, GREEDY):
        most = [max(sum(line.get(tag) is not None for line in run.lines) for run in runs) for runs in groups]
        if min(most) > 1 and (tag != J or same_gamma):
            return tag
    return TRAINING


def _curve(letter: str, runs: Sequence[tuple[Trained, Points]], at: float) -> Curve:
    first = max(x_K[0] for _, (x_K, _) in runs)
    lasts = [x_K[-1] for _, (x_K, _) in runs]
    ends = [np.inf if run.is_over else x_K[-1] for run, (x_K, _) in runs]
    last = max(first, min(max(lasts), *ends))
    x_X = np.linspace(first, last, CURVE_POINTS if last > first else 1)
    value_XR = np.stack([np.interp(x_X, *points) for _, points in runs], axis=-1)
    score_R = np.array([np.interp(at, *points) for _, points in runs])
    low = high = None
    if len(runs) > 1:
        low, high = bootstrap_interval(value_XR).tolist()
    return Curve(letter, x_X.tolist(), interquartile_mean(value_XR).tolist(), low, high, score_R, estimate([score_R]))


def _pairs(groups: Sequence[Group], panels: Sequence[Panel]) -> Iterator[Pair]:
    scores = [{curve.letter: curve.score_R for curve in panel.curves} for panel in panels]
    letters = [group.letter for group in groups]
    pairs: Iterable[tuple[str, str]] = itertools.combinations(letters, 2)
    if len(letters) > MOST_GROUPS:
        first = max(panels[0].curves, key=lambda curve: curve.score.mean).letter
        pairs = ((first, letter) for letter in letters if letter != first)
    for one, other in pairs:
        shared = [each for each in scores if one in each and other in each]
        if not shared:
            continue
        found = estimate([each[letter] for each in shared for letter in (one, other)], statistic=improvement)
        if found.mean < 0.5:
            one, other, found = other, one, opposite(found)
        yield Pair(one, other, found)


def opposite(probability: Mean) -> Mean:
    """The probability that it is the other one that is better."""
    low, high = probability.low, probability.high
    return Mean(1 - probability.mean, None if high is None else 1 - high, None if low is None else 1 - low)


def _scaled(panels: Sequence[Panel], scale: Mapping[str, tuple[float, float]], notes: Notes) -> dict[str, Mean]:
    """The interquartile means over all environments of the groups that are in all of them."""
    envs = {panel.env.partition(" ")[0] for panel in panels}
    if unknown := [env for env in scale if env not in envs]:
        raise PgtsError(f"--scale names {unknown[0]}; the environments are {', '.join(sorted(envs))}")
    in_all = set.intersection(*({curve.letter for curve in panel.curves} for panel in panels))
    if not in_all or (len(panels) < 2 and not scale):
        return {}
    if missing := sorted(envs - scale.keys()):
        notes.add(
            f"no mean over environments: --scale {missing[0]}=LOW,HIGH says which of its returns count as 0 and 1"
        )
        return {}
    strata: dict[str, list[np.ndarray]] = defaultdict(list)
    for panel in panels:
        low, high = scale[panel.env.partition(" ")[0]]
        for curve in panel.curves:
            strata[curve.letter].append((curve.score_R - low) / (high - low))
    return {letter: estimate(each) for letter, each in strata.items() if letter in in_all}
