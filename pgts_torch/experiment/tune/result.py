"""A tuning from its first trial to its table, its picture and the best configuration."""

import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from pgts_torch import files
from pgts_torch.config import dump, load
from pgts_torch.experiment.compare.comparison import WORDS
from pgts_torch.experiment.compare.drawing import png, shortened
from pgts_torch.experiment.compare.text import WIDTH, interval
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.ownership import check_many, table_targets
from pgts_torch.experiment.processes import train_all
from pgts_torch.experiment.report.curves import COLOURS, GREY
from pgts_torch.experiment.statistics import Mean, estimate
from pgts_torch.experiment.summary import summary_in
from pgts_torch.experiment.tune.space import Option, Plan, Value
from pgts_torch.experiment.tune.study import FAILURE, SCORES, Pruning, check, imported, run_trials, score, trainings

if TYPE_CHECKING:
    import optuna

TABLE_FILE, PICTURE_FILE, BEST_FILE, STORAGE_FILE = "tune.json", "tune.png", "best.yaml", "tune.db"
OWN = r"(trial|best)-\d{4,}|tune\.(json|png|db.*)|best\.yaml|compare\.(html|png)"
"""Names of what a tuning, and a comparison of its runs, leaves in its folder."""

SHOWN = 5


@dataclass(frozen=True)
class Trial:
    """One trial.

    state: complete, pruned or failed.
    score: over its seeds; None where it is not complete.
    last: the last evaluation that was reported, over the seeds so far; None: there was none.
    failure: why it failed; empty where it did not.
    """

    number: int
    state: Literal["complete", "pruned", "failed"]
    values: Mapping[str, Value]
    score: Mean | None
    last: float | None
    failure: str


@dataclass(frozen=True)
class Tuned:
    """What a tuning has come to.

    best: the number of the best complete trial; None: there is none.
    confirmed: the score of its configuration over seeds of its own; None: it was not asked for, or failed.
    importance: of each option, shares of 1 by PED-ANOVA among the complete trials; empty for fewer than two.
    """

    out: str
    metric: str
    seeds: int
    trials: Sequence[Trial]
    best: int | None
    confirmed: Mean | None
    importance: Mapping[str, float]


def tune(
    plan: Plan,
    *,
    trials: int,
    jobs: int,
    pruning: Pruning,
    sampler: Literal["tpe", "random"],
    storage: Path | None,
    confirm: int,
) -> Tuned:
    """Run the trials that are missing, and write tune.json, tune.png and best.yaml.

    Args:
        confirm: seeds for the best configuration, beyond those of the trials.

    Raises:
        PgtsError: as from `check` and `run_trials`; or another process has the folder, or it is not ours.
        Stopped: a signal came; the same command goes on.
    """
    check_many(plan.out, OWN, "tuning")
    others = {PICTURE_FILE: "of a tuning", BEST_FILE: "of a tuning"}
    table, shown, chosen = table_targets(plan.out, TABLE_FILE, Tuned, "the table of a tuning", others)
    storage = storage or plan.out / STORAGE_FILE
    check(plan, storage)
    with RunLock(plan.out, name="--out"):
        study = run_trials(
            plan,
            trials=trials,
            jobs=jobs,
            pruning=pruning,
            sampler=sampler,
            storage=storage,
        )
        found = [_trial(each) for each in study.get_trials(deepcopy=False)]
        complete = [trial for trial in found if trial.score is not None]
        best = max(complete, key=lambda trial: -math.inf if trial.score is None else trial.score.mean, default=None)
        confirmed = None if best is None or not confirm else _confirmed(plan, best, confirm, jobs)
        number = None if best is None else best.number
        answer = Tuned(str(plan.out), plan.metric, plan.seeds, found, number, confirmed, _importance(study, complete))
        files.replace(table, (json.dumps(asdict(answer), indent=2) + "\n").encode())
        files.replace(shown, png(picture(answer, plan.options)))
        if best is not None:
            config = load(plan.path, [*plan.arguments(best.values, {}), "--run.dir=null"])
            files.replace(chosen, dump(config).encode())
    return answer


def _trial(trial: "optuna.trial.FrozenTrial") -> Trial:
    scores, failure = trial.user_attrs.get(SCORES), trial.user_attrs.get(FAILURE, "")
    last = trial.intermediate_values.get(trial.last_step) if trial.last_step is not None else None
    is_complete = trial.state.name == "COMPLETE" and scores
    return Trial(
        trial.number,
        "complete" if is_complete else "failed" if failure else "pruned",
        dict(trial.params),
        estimate([np.array(scores)]) if is_complete else None,
        last,
        failure,
    )


def _confirmed(plan: Plan, best: Trial, count: int, jobs: int) -> Mean | None:
    """Train the best configuration with seeds that no trial has had."""
    place = plan.out / f"best-{best.number:04d}"
    folders = {seed: place / f"seed-{seed}" for seed in range(plan.seeds, plan.seeds + count)}
    train_all(trainings(plan, best.values, folders), jobs=jobs)
    summaries = [summary_in(folder) for folder in folders.values()]
    scores = [score(each, plan.metric) for each in summaries if each is not None]
    return estimate([np.array(scores, dtype=np.float64)]) if len(scores) == count else None


def _importance(study: "optuna.Study", complete: Sequence[Trial]) -> dict[str, float]:
    if len({trial.score.mean for trial in complete if trial.score is not None}) < 2:
        return {}
    return {key: float(share) for key, share in imported().importance.get_param_importances(study).items()}


def describe(answer: Tuned) -> str:
    """The results as a person reads them, within 80 columns."""
    counts = {state: sum(trial.state == state for trial in answer.trials) for state in ("complete", "pruned", "failed")}
    lines = [", ".join(f"{count} {state}" for state, count in counts.items()) + f" of {len(answer.trials)} trials"]
    for trial in answer.trials:
        if trial.failure:
            lines += textwrap.wrap(f"trial {trial.number} failed: {trial.failure}", WIDTH, subsequent_indent="  ")
    ranked = sorted(
        (trial for trial in answer.trials if trial.score is not None),
        key=lambda trial: 0.0 if trial.score is None else -trial.score.mean,
    )
    if not ranked:
        return "\n".join([*lines, "no trial is complete, so there is no best one"])
    what = WORDS.get(answer.metric, answer.metric)
    lines += ["", f"the best trials, {what}, over {answer.seeds} {'seed' if answer.seeds == 1 else 'seeds'}"]
    lines.append(f"{'trial':>5}{'IQM':>12}{'95 % interval':>26}")
    for trial in ranked[:SHOWN]:
        assert trial.score is not None
        lines.append(f"{trial.number:>5}{trial.score.mean:>12.4g}{interval(trial.score):>26}".rstrip())
    lines += ["", f"{'option':<34}{'best':>22}{'importance':>12}"]
    for key, value in ranked[0].values.items():
        share = f"{answer.importance[key]:.2f}" if key in answer.importance else ""
        shown = value if isinstance(value, str) else f"{value:.6g}"
        lines.append(f"{key:<34}{shown:>22}{share:>12}".rstrip())
    lines.append("")
    if answer.confirmed is not None:
        confirmed = f"{answer.confirmed.mean:.4g} {interval(answer.confirmed)}".strip()
        lines.append(f"the best one with other seeds: {confirmed}")
    else:
        text = "The best of several trials is so by luck, too: --confirm 10 trains it with 10 other seeds."
        lines += textwrap.wrap(text, WIDTH)
    lines += [f"pgts train --config {answer.out}/{BEST_FILE}", f"pgts compare {answer.out} --finished"]
    return "\n".join(lines)


def picture(answer: Tuned, options: Sequence[Option]) -> Figure:
    """The trials in their order, and their scores over each option."""
    columns = min(3, 1 + len(options))
    rows = math.ceil((1 + len(options)) / columns)
    drawn = Figure(figsize=(4.2 * columns, 3.2 * rows), layout="constrained")
    history, *panels = drawn.subplots(rows, columns, squeeze=False).flatten()
    _draw_history(history, answer)
    history.set_ylabel(WORDS.get(answer.metric, answer.metric))
    for axes, option in zip(panels, options, strict=False):
        _draw_option(axes, answer, option)
    for axes in panels[len(options) :]:
        axes.remove()
    handles = [
        Line2D([], [], color=COLOURS[0], linewidth=1, marker="o", markersize=4, label="complete, and the best so far"),
        Line2D([], [], color=COLOURS[1], linewidth=0, marker="o", markersize=7, label="the best"),
        Line2D(
            [], [], color=GREY, linewidth=0, marker="x", markersize=4, label="last evaluation of a pruned or failed one"
        ),
    ]
    drawn.legend(handles=handles, loc="outside upper left", ncols=3, frameon=False, fontsize=9)
    for axes in drawn.axes:
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    return drawn


def _draw_history(axes: Axes, answer: Tuned) -> None:
    best, so_far = -math.inf, []
    for trial in answer.trials:
        best = max(best, -math.inf if trial.score is None else trial.score.mean)
        so_far.append(best if best > -math.inf else math.nan)
    axes.step([trial.number for trial in answer.trials], so_far, where="post", color=COLOURS[0], linewidth=1)
    _draw_trials(axes, answer, [trial.number for trial in answer.trials])
    axes.set_xlabel("trial")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_option(axes: Axes, answer: Tuned, option: Option) -> None:
    values = [trial.values.get(option.key) for trial in answer.trials]
    if option.kind == "choice":
        axes.set_xticks(range(len(option.choices)), [shortened(choice, 14) for choice in option.choices])
        axes.set_xlim(-0.5, len(option.choices) - 0.5)
        at = [math.nan if value is None else float(option.choices.index(str(value))) for value in values]
    else:
        axes.set_xscale("log" if option.is_log else "linear")
        if option.is_whole and not option.is_log:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        at = [math.nan if value is None else float(value) for value in values]
    _draw_trials(axes, answer, at)
    share = f", importance {answer.importance[option.key]:.2f}" if option.key in answer.importance else ""
    axes.set_xlabel(f"{option.key}{share}")


def _draw_trials(axes: Axes, answer: Tuned, at: Sequence[float]) -> None:
    """Complete trials as points with their intervals, the best one larger; last evaluations of others as crosses."""
    for x, trial in zip(at, answer.trials, strict=True):
        if trial.score is None:
            if trial.last is not None:
                axes.plot(x, trial.last, "x", color=GREY, markersize=4)
            continue
        is_best = trial.number == answer.best
        colour = COLOURS[1] if is_best else COLOURS[0]
        if trial.score.low is not None and trial.score.high is not None:
            axes.vlines(x, trial.score.low, trial.score.high, color=colour, alpha=0.4, linewidth=1)
        size, order = (7, 3) if is_best else (4, 2)
        axes.plot(x, trial.score.mean, "o", color=colour, markersize=size, alpha=0.7, zorder=order)
