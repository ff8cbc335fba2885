"""Whether a run folder holds a training that goes on, and from where."""

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from pgts_torch import files
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.config import Config
from pgts_torch.experiment.loading import load
from pgts_torch.experiment.ownership import CONFIG_FILE, METRICS_FILE, SUMMARY_FILE, Mark, digest
from pgts_torch.experiment.tracking import versions

FREE_SECTIONS = ("run", "log")
FREE_KEYS = ("name", "eval.every", "eval.episodes", "eval.keep_best")
"""What may differ when a run goes on: no bit of its training depends on it."""

_ADVICE = "choose another folder, or set run.overwrite"


@dataclass(frozen=True)
class Start:
    """A checkpoint that a training goes on from.

    state: for `PGTS.load_state_dict`.
    """

    path: Path
    notes: checkpoint.Notes
    state: Mapping[str, Any]

    def check(self, algorithm: PGTS) -> None:
        """PgtsError, naming each tensor, where the algorithm has others: its environment is no longer what it was."""
        own = {  # by part: what a search remembers grows, and all ranks must ask for the whole together
            "policy": algorithm.policy.state_dict(),
            "critic": algorithm.critic.state_dict(),
            "update": algorithm.update.state_dict(),
        }
        now, before = dict(_flat("", own)), dict(_flat("", {name: self.state[name] for name in own}))
        lines = [
            f"{name} has the shape {tuple(here.shape)}; in {self.path} it is {tuple(there.shape)}"
            for name, here in now.items()
            if isinstance(here, Tensor) and isinstance(there := before.get(name), Tensor) and here.shape != there.shape
        ]
        if lines:
            raise PgtsError("\n".join([*lines, f"the environment has changed since; {_ADVICE}"]))


def find(
    config: Config, run: Path, *, strict: bool = False, world_size: int = 1, any_world_size: bool = False
) -> Start | None:
    """Where the training of a configuration begins in its run folder; None: at the beginning.

    Args:
        strict: refuse a last checkpoint that is damaged or of other versions.
        world_size: how many processes are to go on.
        any_world_size: whether it may have been another number before.

    Raises:
        PgtsError: the folder holds a finished run, or one of another configuration, naming what differs, or of another
            number of processes; or no checkpoint in it is intact, or not the one that is asked for.
    """
    if not (run / CONFIG_FILE).is_file():
        return None
    if (run / SUMMARY_FILE).is_file():
        raise PgtsError(f"run.dir {run} holds a finished run; {_ADVICE}")
    try:
        found = checkpoint.newest(run, strict=strict)
    except PgtsError as error:
        raise PgtsError(f"{error}\n{_ADVICE}") from error
    earlier = flat(load(run / CONFIG_FILE)) if found is None else found[1].config
    if differing := list(_differing(flat(config), earlier)):
        lines = (f"{key} is {_shown(now)}; in run.dir {run} it is {_shown(before)}" for key, now, before in differing)
        raise PgtsError("\n".join([*lines, f"run.dir {run} holds an earlier run of another configuration; {_ADVICE}"]))
    if found is None:
        return None
    path, notes, content = found
    _check_metrics(run / METRICS_FILE, notes.metrics_bytes, path)
    _check_versions(notes.versions, path, strict=strict)
    if notes.world_size != world_size and not any_world_size:
        raise PgtsError(
            f"{path} was written by {notes.world_size} processes, and {world_size} are to go on: start as many, or "
            "give --any-world-size for other bits"
        )
    return Start(path, notes, content["state"])


def is_kept(config: Config, run: Path, mark: Mark) -> bool:
    """Whether config.yaml in a run folder stays as it is, because somebody has edited it and it means the same.

    Raises:
        PgtsError: it was edited, and to write the configuration of this run would undo that.
    """
    path = run / CONFIG_FILE
    if files.kind(path) is None or digest(files.read(path)) in mark.configs:
        return False
    try:
        is_same = load(path).model_copy(update={"run": config.run}) == config
    except PgtsError:
        is_same = False
    if not is_same:
        raise PgtsError(f"{path} is not as a run has written it, and says something else than this one: move it away")
    return True


def resuming(run: str | Path, world_size: int) -> str:
    """The command by which as many processes go on with a run."""
    command = "pgts train" if world_size == 1 else f"torchrun --nproc-per-node={world_size} train.py"
    return f"{command} --resume {shlex.quote(str(run))}"


def flat(config: Config) -> dict[str, Any]:
    """Every key of a configuration, dotted, with its value as JSON has it."""
    return dict(_flat("", json.loads(json.dumps(config.model_dump(by_alias=True)))))


def _flat(prefix: str, values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{name}.", value)
        else:
            yield f"{prefix}{name}", value


def _differing(now: Mapping[str, Any], before: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """(key, value now, value before) where it matters; a key that is missing on one side has None there."""
    for key in dict.fromkeys((*now, *before)):
        free = key in FREE_KEYS or key.partition(".")[0] in FREE_SECTIONS
        if not free and now.get(key) != before.get(key):
            yield key, now.get(key), before.get(key)


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _check_metrics(path: Path, metrics_bytes: int, taken: Path) -> None:
    size = path.stat().st_size if path.is_file() else 0
    if size < metrics_bytes:
        raise PgtsError(f"{path} has {size} bytes; it had {metrics_bytes} when {taken} was written; {_ADVICE}")


def _check_versions(before: Mapping[str, str], path: Path, *, strict: bool) -> None:
    now = versions()
    lines = [
        f"{name} is {now.get(name)}; {path} was written with {before.get(name)}"
        for name in dict.fromkeys((*now, *before))
        if now.get(name) != before.get(name)
    ]
    if lines and strict:
        raise PgtsError("\n".join(lines))
    for line in lines:
        print(f"warning: {line}: the last bits may differ", file=sys.stderr)
