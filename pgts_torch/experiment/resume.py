"""Decide whether a training resumes from a run folder, and from which checkpoint."""

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pgts_torch import files
from pgts_torch.agent import saving
from pgts_torch.agent.pgts import PGTS
from pgts_torch.config import Config, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.ownership import BEST_FILE, CONFIG_FILE, METRICS_FILE, SUMMARY_FILE, is_events, read_mark
from pgts_torch.experiment.tracking import GrowingDigest, versions
from pgts_torch.options.own import Own

FREE_SECTIONS = ("run", "log")
FREE_KEYS = ("name", "eval.every", "eval.episodes", "eval.keep_best")
"""Keys that may differ when a run resumes, because no bit of its training depends on them."""

_ADVICE = "choose another folder, or set run.overwrite"


@dataclass(frozen=True)
class Start:
    """A checkpoint that a training resumes from.

    state: for `PGTS.load_state_dict`.
    has_events: whether the TensorBoard events are unchanged since the checkpoint.
    lost_best: whether the best model is missing or is another one.
    """

    path: Path
    notes: checkpoint.Notes
    state: dict[str, Any]
    has_events: bool
    lost_best: bool

    def load(self, algorithm: PGTS) -> None:
        """Load the state into the algorithm; PgtsError, naming the part, if it is no state of such a model."""
        try:
            algorithm.load_state_dict(self.state)
            algorithm.check_complete()
        except PgtsError as error:
            raise PgtsError(
                f"{self.path}: {error}\nif the environment has changed since it was written, {_ADVICE}"
            ) from error
        if algorithm.num_env_steps != self.notes.env_steps:
            raise PgtsError(
                f"{self.path}: its model is of step {algorithm.num_env_steps}, its notes of {self.notes.env_steps}"
            )


def find(
    config: Config, run: Path, *, strict: bool = False, world_size: int = 1, any_world_size: bool = False
) -> Start | None:
    """Return the checkpoint from which a configuration resumes in its run folder; None: it starts from the beginning.

    Args:
        strict: refuse a last checkpoint that is damaged or of other versions, and lost events or a lost best model.
        any_world_size: whether the run may have had another number of processes before.

    Raises:
        PgtsError: the folder has a finished run, or one of another configuration (the message names the differences),
            or of another number of processes; or no checkpoint is intact, or with `strict` not the last one.
    """
    mark = read_mark(run)
    if files.kind(run / SUMMARY_FILE) is not None and mark is not None:
        raise PgtsError(f"run.dir {run} holds a finished run; {_ADVICE}")
    try:
        found = checkpoint.newest(run, strict=strict)
    except PgtsError as error:
        raise PgtsError(f"{error}\n{_ADVICE}") from error
    if found is None:
        if mark is not None and mark.has_checkpoints:
            raise PgtsError(f"run.dir {run} has lost its checkpoints and cannot go on: bring them back, or {_ADVICE}")
        if files.kind(run / CONFIG_FILE) is not None:
            _check_config(config, plain(load(run / CONFIG_FILE)), run)
            print(f"note: the run in {run} was ended before its first checkpoint; it starts over", file=sys.stderr)
        return None
    path, notes, content = found
    _check_config(config, _as_now(notes.config), run)
    if metrics := _changed(run, notes, METRICS_FILE):
        raise PgtsError(f"{metrics} since {path} was written; {_ADVICE}")
    if notes.world_size != world_size and not any_world_size:
        raise PgtsError(
            f"{path} was written by {notes.world_size} processes, and {world_size} are to go on: start as many, or "
            "give --any-world-size for other bits"
        )
    complaints = list(_other_versions(notes.versions, path))
    events = [name for name in notes.files if is_events(name)]
    lost_events = [change for name in events if (change := _changed(run, notes, name))]
    if config.run.tensorboard and lost_events:
        complaints.append(f"{lost_events[0]} since {path} was written: the events are rebuilt from {METRICS_FILE}")
    lost_best = _lost_best(run, notes) if config.eval.keep_best else ""
    if lost_best:
        complaints.append(f"{lost_best}: the model of {path} takes its place until a better one comes")
    if complaints and strict:
        raise PgtsError("\n".join(complaints))
    for line in complaints:
        print(f"warning: {line}", file=sys.stderr)
    return Start(path, notes, content["state"], bool(events) and not lost_events, bool(lost_best))


def names_modules(config: Config) -> bool:
    """Whether a configuration names modules that are imported."""
    parts = config.model, config.policy, *(getattr(part, "network", None) for part in (config.policy, config.critic))
    return ":" in config.env.id or any(isinstance(part, Own) for part in parts)


def resuming(run: str | Path, world_size: int, *, imports: bool) -> str:
    """The command that resumes a run with the same number of processes; `imports`: if it imports modules."""
    trust = " --trust-imports" if imports else ""
    processes = "" if world_size == 1 else f" --processes {world_size}"
    return f"pgts train{processes} --resume {shlex.quote(str(run))}{trust}"


def plain(config: Config) -> dict[str, Any]:
    """Return a configuration in JSON types."""
    return config.model_dump(mode="json", by_alias=True)


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return all keys of nested mappings, dotted, with their values."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found


def _as_now(earlier: dict[str, Any]) -> dict[str, Any]:
    """The configuration in a checkpoint, with what this version adds; as it is where this version does not read it."""
    try:
        return plain(Config.model_validate(earlier))
    except ValidationError:
        return earlier


def _check_config(config: Config, earlier: dict[str, Any], run: Path) -> None:
    """PgtsError, with a line for each key, if the earlier run had another configuration."""
    now, before = flat(plain(config)), flat(earlier)
    lines = [
        f"{key} is {_shown(now.get(key))}; in run.dir {run} it is {_shown(before.get(key))}"
        for key in dict.fromkeys((*now, *before))
        if key not in FREE_KEYS and key.partition(".")[0] not in FREE_SECTIONS and now.get(key) != before.get(key)
    ]
    if lines:
        raise PgtsError("\n".join([*lines, f"run.dir {run} holds an earlier run of another configuration; {_ADVICE}"]))


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _changed(run: Path, notes: checkpoint.Notes, name: str) -> str:
    """Return how a file of a run has changed since a checkpoint, apart from growing; empty if it has not."""
    path, told = run / name, notes.files[name]
    if files.kind(path) != "file":
        return f"{path} was removed"
    now = GrowingDigest(path).now(told[0])
    if now == told:
        return ""
    return f"{path} was changed" if now[0] == told[0] else f"{path} was cut to {now[0]} bytes"


def _lost_best(run: Path, notes: checkpoint.Notes) -> str:
    """Return what is wrong with the best model, if there should be one; empty if nothing is. A model that is later than
    the checkpoint is right, because training will save it again."""
    path, told = run / BEST_FILE, notes.files.get(BEST_FILE)
    if told is None and not notes.progress.evaluations.get("deterministic", {}).get("history"):
        return ""
    if files.kind(path) is None:
        return f"{path} is missing"
    try:
        steps = saving.read(path)["state"]["num_env_steps"]
    except PgtsError as error:
        return str(error)
    except (KeyError, TypeError):
        return f"{path} holds no model"
    is_noted = told is None or GrowingDigest(path).now() == told
    return "" if is_noted or steps > notes.env_steps else f"{path} was changed"


def _other_versions(before: Mapping[str, Any], path: Path) -> Iterator[str]:
    now = versions()
    for name in dict.fromkeys((*now, *before)):
        if now.get(name) != before.get(name):
            yield (f"{name} is {now.get(name)}; {path} was written with {before.get(name)}: the last bits may differ")
