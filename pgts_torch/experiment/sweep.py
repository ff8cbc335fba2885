"""Train one configuration at several depths and with several seeds: `pgts sweep`."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pgts_torch import files
from pgts_torch.config import Config, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.locking import wait_for
from pgts_torch.experiment.ownership import CONFIG_FILE, check_many, table_targets
from pgts_torch.experiment.processes import train_all
from pgts_torch.experiment.statistics import Mean, estimate, interquartile_mean

if TYPE_CHECKING:
    from pgts_torch.experiment.summary import Summary

TABLE_FILE, CURVES_FILE = "table.json", "curves.png"
OWN = r"depth-(\d+|adaptive)|table\.json|curves\.png|compare\.(html|png)"
"""Names of what a sweep, and a comparison of its runs, leaves in its folder."""

SET_BY_MANY = {
    "seed": "--seeds says how many",
    "run.dir": "--out is the folder of all runs",
    "run.overwrite": "finished runs are kept, others go on",
    "threads": "every run has one, --jobs says how many run at once",
    "processes": "every run is one, --jobs says how many run at once",
    "max-restarts": "the same command goes on with runs that were cut off",
}
"""Keys that a command sets itself which trains many runs, and which option to use instead."""

SET_BY_SWEEP = {"search.depth": "--depths says which"} | SET_BY_MANY
"""Keys that a sweep sets itself, and which option to use instead."""


@dataclass(frozen=True)
class Run:
    """One run of a sweep: its depth, its seed, its whole configuration, and the arguments of `pgts train`."""

    depth: int | str
    seed: int
    config: Config
    arguments: tuple[str, ...]

    @property
    def folder(self) -> Path:
        return Path(str(self.config.run.dir))

    @property
    def name(self) -> str:
        return f"depth {self.depth}, seed {self.seed}"


@dataclass(frozen=True)
class Row:
    """The results at one depth.

    score: of the trained policies, J where it is known exactly, else the mean return of sampled episodes.
    greedy: the mean return of greedy episodes.
    env_steps, model_calls, seconds: interquartile means.
    """

    depth: int | str
    num_runs: int
    score: Mean
    greedy: Mean
    env_steps: float
    model_calls: float
    seconds: float


@dataclass(frozen=True)
class Sweep:
    """The results of a sweep: a row for each depth with a finished run, what `score` means, and the failed runs."""

    rows: tuple[Row, ...]
    score_is: str
    failures: Mapping[str, str]
    out: str


def plan(
    path: str | None, overrides: Sequence[str], *, depths: Sequence[int | str], num_seeds: int, out: Path
) -> list[Run]:
    """The runs of a sweep, with the seeds 0, 1, ... at each depth.

    Args:
        path, overrides: of the configuration, as `load` takes them.
        depths: none: the configuration's own.

    Raises:
        ConfigError: a configuration is wrong.
        PgtsError: an override that the sweep sets itself, or a folder that holds a run, finished or not, of another
            configuration, or a table or a picture that no sweep has made; or `out` holds files, but none of a sweep.
    """
    check_many(out, OWN, "sweep")
    _targets(out)
    check_overrides(overrides, SET_BY_SWEEP, "sweep")
    shared = ["--config", path] if path is not None else []
    runs = []
    for depth in depths or [load(path, overrides).search.depth]:
        for seed in range(num_seeds):
            folder = out / f"depth-{depth}" / f"seed-{seed}"
            own = {"search.depth": depth, "seed": seed, "threads": 1, "run.dir": folder, "run.overwrite": "false"}
            arguments = [*overrides, *(f"--{key}={value}" for key, value in own.items())]
            runs.append(Run(depth, seed, load(path, arguments), (*shared, *arguments)))
    from pgts_torch.experiment.summary import summary_in  # torch waits until the arguments have proved themselves

    for run in runs:
        summary_in(run.folder)
        earlier = run.folder / CONFIG_FILE
        if earlier.is_file() and load(earlier).model_copy(update={"run": run.config.run}) != run.config:
            raise PgtsError(f"{run.folder} holds a run of another configuration; choose another --out")
    return runs


def check_overrides(overrides: Sequence[str], set_here: Mapping[str, str], what: str) -> None:
    """PgtsError where an override is of a key that is set here: which option to use instead, by key."""
    for key in (override.removeprefix("--").partition("=")[0] for override in overrides if override.startswith("--")):
        if key in set_here:
            raise PgtsError(f"--{key} is set by the {what}: {set_here[key]}")


def sweep(runs: Sequence[Run], *, jobs: int, out: Path) -> Sweep:
    """Run the unfinished trainings, each in its own process, and write table.json and curves.png.

    An interrupted training resumes from its last checkpoint; one that outlived a killed sweep is waited for.

    Raises:
        PgtsError: what a configuration describes cannot be built; nothing was started.
        Stopped: a signal came; see `train_all`.
    """
    # torch waits until the arguments have proved themselves
    from pgts_torch.experiment.compare.comparison import compare
    from pgts_torch.experiment.compare.drawing import figure, png
    from pgts_torch.experiment.run import build
    from pgts_torch.experiment.summary import summary_in

    wait_for(run.folder for run in runs)
    waiting = [run for run in runs if summary_in(run.folder) is None]
    for config in {run.depth: run.config for run in waiting}.values():
        build(config)
    failures = train_all({run.name: run.arguments for run in waiting}, jobs=jobs)
    finished = [(run, summary) for run in runs if (summary := summary_in(run.folder)) is not None]
    score_is = "return" if any(summary.J is None for _, summary in finished) else "J"
    answer = Sweep(tuple(_rows(finished, score_is)), score_is, failures, str(out))
    with files.named(f"--out {out} cannot be written to"):
        out.mkdir(parents=True, exist_ok=True)
    table, curves = _targets(out)
    files.replace(table, (json.dumps(asdict(answer), indent=2) + "\n").encode())
    if finished:
        files.replace(curves, png(figure(compare([run.folder for run, _ in finished]))))
    return answer


def describe(answer: Sweep) -> str:
    """The table as a person reads it, within 80 columns."""
    lines = [f"{'depth':>8}{'runs':>5}{answer.score_is:>11}{'95 % interval':>24}{'steps':>10}{'calls':>11}{'s':>8}"]
    for row in answer.rows:
        score = row.score
        interval = "" if score.low is None else f"[{score.low:.4g}, {score.high:.4g}]"
        lines.append(
            f"{row.depth:>8}{row.num_runs:>5}{score.mean:>11.4g}{interval:>24}"
            f"{row.env_steps:>10.0f}{row.model_calls:>11.0f}{row.seconds:>8.1f}"
        )
    if not answer.rows:
        return "no run has finished"
    what = "return of the policy" if answer.score_is == "J" else "return of sampled episodes"
    return "\n".join([*lines, "", f"Interquartile means over seeds; {answer.score_is}: {what}.", f"in {answer.out}"])


def _targets(out: Path) -> list[Path]:
    """Where the table and the picture of the curves may be written."""
    return table_targets(out, TABLE_FILE, Sweep, "the table of a sweep", {CURVES_FILE: "the curves of a sweep"})


def _rows(finished: "Sequence[tuple[Run, Summary]]", score_is: str) -> Iterator[Row]:
    for depth in dict.fromkeys(run.depth for run, _ in finished):
        summaries = [summary for run, summary in finished if run.depth == depth]
        returns = [each.sampled.episodic_return.mean for each in summaries]
        scores = [each.J for each in summaries if each.J is not None] if score_is == "J" else returns
        greedy = [each.deterministic.episodic_return.mean for each in summaries]
        costs = [[each.env_steps, each.model_calls, each.seconds] for each in summaries]
        mean_costs = interquartile_mean(np.array(costs, dtype=np.float64).T).tolist()
        yield Row(depth, len(summaries), estimate([np.array(scores)]), estimate([np.array(greedy)]), *mean_costs)
