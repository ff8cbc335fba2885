"""The runs that are compared: found in folders, and read, finished or not."""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pgts_torch import files
from pgts_torch.config import Config, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.ownership import CONFIG_FILE, FAILURE_FILE, METRICS_FILE
from pgts_torch.experiment.report.facts import metrics
from pgts_torch.experiment.resume import FREE_KEYS, FREE_SECTIONS, flat, plain
from pgts_torch.experiment.summary import summary_in

J, GREEDY, SAMPLED, TRAINING = "exact/J", "eval/deterministic_return", "eval/sampled_return", "charts/episodic_return"

AXES = {"steps": "environment steps", "calls": "model calls", "seconds": "seconds of training, without evaluations"}
"""What curves may be drawn over, in words."""

_NO_PART_OF_IT = ("seed", "env.id", "device", "threads", *FREE_KEYS)
"""Keys in which runs of one configuration may differ; the environment is told apart by itself."""

Points = tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]]


@dataclass(frozen=True, eq=False)
class Trained:
    """A run.

    state: finished, unfinished or failed.
    is_over: whether it has ended before its last environment step because it was good enough, and so stays as it is.
    lines: of metrics.jsonl, with what the summary says of the trained policy as the last one.
    """

    path: Path
    config: Config
    state: str
    is_over: bool
    lines: Sequence[Mapping[str, Any]]

    @property
    def env(self) -> str:
        """The environment, with the arguments that it was made with."""
        kwargs = self.config.env.kwargs
        return self.config.env.id + (f" {json.dumps(kwargs, sort_keys=True)}" if kwargs else "")

    @property
    def settings(self) -> dict[str, Any]:
        """Each key of the configuration that makes it another one, with its value."""
        return {
            key: value
            for key, value in flat(plain(self.config)).items()
            if key not in _NO_PART_OF_IT
            and not key.startswith("env.kwargs.")
            and key.partition(".")[0] not in FREE_SECTIONS
        }

    @property
    def steps(self) -> int:
        return max((line["step"] for line in self.lines), default=0)

    def curve(self, tag: str, x: str) -> Points | None:
        """The finite values of a metric over one of `AXES`, ascending; None: there are none."""
        at = {line["step"]: line[tag] for line in self.lines if line.get(tag) is not None}
        if not at or (cost := self._cost(x)) is None:
            return None
        step_K, value_K = np.array(sorted(at.items()), dtype=np.float64).T
        x_K = np.interp(step_K, *cost)
        is_last_K = np.append(np.diff(x_K) > 0, True)
        return x_K[is_last_K], value_K[is_last_K]

    def _cost(self, x: str) -> Points | None:
        """What had been spent at environment steps: x over steps; None: nothing ever is, or it is not known."""
        if x == "steps":
            return np.array([0.0, 2.0**63]), np.array([0.0, 2.0**63])
        if x == "calls":
            found = [(line["step"], line["search/model_calls"]) for line in self.lines if "search/model_calls" in line]
        else:
            found, before, spent = [], 0, 0.0
            for line in self.lines:
                if line.get("charts/SPS"):
                    spent += (line["step"] - before) / line["charts/SPS"]
                    before = line["step"]
                    found.append((before, spent))
        if not found or found[-1][1] == 0:
            return None
        step_K, cost_K = np.array([(0, 0.0), *found], dtype=np.float64).T
        return step_K, cost_K


class Notes:
    """What is to be said of runs beside the numbers, once for all of which it is true."""

    def __init__(self) -> None:
        self._about: dict[str, list[str]] = {}

    def add(self, what: str, about: str = "") -> None:
        self._about.setdefault(what, []).extend([about] if about else [])

    def lines(self) -> list[str]:
        return [f"{what}: {files.listing(about, most=3)}" if about else what for what, about in self._about.items()]

    def refusal(self, what: str) -> PgtsError:
        """An error that nothing is left, and why."""
        return PgtsError("\n".join([what, *self.lines()]))


def gathered(paths: Sequence[Path], notes: Notes) -> list[Trained]:
    """The runs in some folders, each of which is a run or holds runs; those that say nothing are noted.

    Raises:
        PgtsError: a folder holds no run.
    """
    folders: dict[Path, Path] = {}
    for path in paths:
        found = list(_below(path))
        if not found:
            raise PgtsError(
                f"{path} holds no run: neither it nor a folder in it has a {CONFIG_FILE} and a {METRICS_FILE}"
            )
        for each in found:
            folders.setdefault(Path(os.path.realpath(each)), each)
    runs = list[Trained]()
    for folder in folders.values():
        try:
            run = _read(folder, notes)
        except PgtsError as error:
            notes.add(
                "left out, as the configuration cannot be read", f"{folder} ({'; '.join(str(error).splitlines())})"
            )
            continue
        if run.lines:
            runs.append(run)
        else:
            notes.add("left out, as no iteration has been written down", str(folder))
    return runs


def _below(path: Path) -> Iterator[Path]:
    """The run folders in a folder, itself among them. Symbolic links and hidden folders in it are not followed."""
    if files.kind(path, follow=True) != "folder":
        raise PgtsError(f"{path} is {'not there' if files.kind(path) is None else 'not a folder'}")
    with files.named(f"{path} cannot be read"):
        for parent, names, inside in os.walk(path):
            if CONFIG_FILE in inside and (METRICS_FILE in inside or Path(parent) == path):
                yield Path(parent)
                names.clear()
            names[:] = sorted(name for name in names if not name.startswith("."))


def _read(folder: Path, notes: Notes) -> Trained:
    config = load(folder / CONFIG_FILE)
    unread: list[str] = []
    lines = [line for line in metrics(folder, unread) if line]
    for each in unread if lines else ():
        notes.add(f"{folder}: {each}")
    summary = None
    try:
        summary = summary_in(folder)
    except PgtsError as error:
        notes.add("the run counts as unfinished", str(error))
    if summary is None:
        state = "failed" if files.kind(folder / FAILURE_FILE) is not None else "unfinished"
        return Trained(folder, config, state, False, lines)
    last = {"step": summary.env_steps, J: summary.J}
    last |= {GREEDY: summary.deterministic.episodic_return.mean, SAMPLED: summary.sampled.episodic_return.mean}
    known = {tag: value for tag, value in last.items() if value is not None and math.isfinite(value)}
    return Trained(folder, config, "finished", summary.ended_by != "total_steps", [*lines, known] if lines else [])
