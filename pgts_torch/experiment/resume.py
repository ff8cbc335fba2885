"""Decide whether a training resumes from a run folder, and from which checkpoint."""

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from torch import Tensor

from pgts_torch import files
from pgts_torch.agent import saving
from pgts_torch.agent.pgts import PGTS
from pgts_torch.config import Config, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.ownership import (
    BEST_FILE,
    CONFIG_FILE,
    METRICS_FILE,
    SUMMARY_FILE,
    Mark,
    digest,
    earlier_checkpoints,
    is_events,
    read_mark,
)
from pgts_torch.experiment.tracking import GrowingDigest, versions

FREE_SECTIONS = ("run", "log")
FREE_KEYS = ("name", "eval.every", "eval.episodes", "eval.keep_best")
"""Keys that may differ when a run resumes, because no bit of its training depends on them."""

_ADVICE = "choose another folder, or set run.overwrite"


@dataclass(frozen=True)
class Start:
    """A checkpoint that a training resumes from.

    state: for `PGTS.load_state_dict`.
    has_events: whether the TensorBoard events are unchanged since the checkpoint.
    lost_best: what is wrong with the best model; empty if nothing is.
    """

    path: Path
    notes: checkpoint.Notes
    state: Mapping[str, Any]
    has_events: bool = True
    lost_best: str = ""

    def check(self, algorithm: PGTS) -> None:
        """PgtsError, naming each tensor, if shapes differ from the algorithm's: its environment has changed."""
        own = {  # without the search, whose state grows and can only be read by all ranks together
            "policy": algorithm.policy.state_dict(),
            "critic": algorithm.critic.state_dict(),
            "update": algorithm.update.state_dict(),
        }
        now, before = dict(_flat("", own)), dict(_flat("", {name: self.state.get(name) for name in own}))
        lines = [
            f"{name} has the shape {tuple(here.shape)}; in {self.path} it is {tuple(there.shape)}"
            for name, here in now.items()
            if isinstance(here, Tensor) and isinstance(there := before.get(name), Tensor) and here.shape != there.shape
        ]
        if lines:
            raise PgtsError("\n".join([*lines, f"the environment has changed since; {_ADVICE}"]))

    def load(self, algorithm: PGTS) -> None:
        """Load the state into the algorithm; PgtsError, naming the part, if it is no state of such a model."""
        try:
            algorithm.load_state_dict(dict(self.state))
            if algorithm.num_env_steps != self.notes.env_steps:
                raise PgtsError(f"its model is of step {algorithm.num_env_steps}, its notes of {self.notes.env_steps}")
        except PgtsError as error:
            raise PgtsError(f"{self.path}: {error}") from error


def find(
    config: Config, run: Path, *, strict: bool = False, world_size: int = 1, any_world_size: bool = False
) -> Start | None:
    """Return the checkpoint from which a configuration resumes in its run folder; None: it starts from the beginning.

    Args:
        strict: refuse a last checkpoint that is damaged or of other versions, and lost events or a lost best model.
        world_size: the number of processes.
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
        if earlier := earlier_checkpoints(run):
            raise PgtsError(
                f"{earlier[-1]} was written by version 0.1, which trains otherwise: go on with that one, or {_ADVICE}"
            )
        if mark is not None and mark.has_checkpoints:
            raise PgtsError(f"run.dir {run} has lost its checkpoints and cannot go on: bring them back, or {_ADVICE}")
        if files.kind(run / CONFIG_FILE) is not None:
            _check_config(config, flat(load(run / CONFIG_FILE)), run)
            print(f"note: the run in {run} was ended before its first checkpoint; it starts over", file=sys.stderr)
        return None
    path, notes, content = found
    _check_config(config, notes.config, run)
    _check_metrics(run, notes, path)
    _complain(_other_versions(notes.versions, path), strict=strict)
    lost_events = config.run.tensorboard and _lost_events(run, notes)
    lost_best = _lost_best(run, notes) if config.eval.keep_best else ""
    if lost_events:
        _complain(
            [f"{lost_events} since {path} was written: the events are rebuilt from {METRICS_FILE}"], strict=strict
        )
    if lost_best:
        _complain([f"{lost_best}: the model of {path} takes its place until a better one comes"], strict=strict)
    if notes.world_size != world_size and not any_world_size:
        raise PgtsError(
            f"{path} was written by {notes.world_size} processes, and {world_size} are to go on: start as many, or "
            "give --any-world-size for other bits"
        )
    has_events = not lost_events and any(map(is_events, notes.files))
    return Start(path, notes, content["state"], has_events, lost_best)


def is_kept(config: Config, run: Path, mark: Mark) -> bool:
    """Whether config.yaml in a run folder is kept, because a user has edited it without changing its meaning.

    Raises:
        PgtsError: it was edited and has another meaning, so that this run would overwrite the user's changes.
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


def resuming(run: str | Path, world_size: int, env_id: str) -> str:
    """The command that resumes a run in this environment with the same number of processes."""
    trust = " --trust-imports" if ":" in env_id else ""
    command = "pgts train" if world_size == 1 else f"torchrun --nproc-per-node={world_size} train.py"
    return f"{command} --resume {shlex.quote(str(run))}{trust}"


def flat(config: Config) -> dict[str, Any]:
    """Return all keys of a configuration, dotted, with their values in JSON types."""
    return dict(_flat("", json.loads(json.dumps(config.model_dump(by_alias=True)))))


def _flat(prefix: str, values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{name}.", value)
        else:
            yield f"{prefix}{name}", value


def _check_config(config: Config, earlier: Mapping[str, Any], run: Path) -> None:
    """PgtsError, with a line for each key, if the earlier run had another configuration."""
    if differing := list(_differing(flat(config), _read_again(earlier))):
        lines = (f"{key} is {_shown(now)}; in run.dir {run} it is {_shown(before)}" for key, now, before in differing)
        raise PgtsError("\n".join([*lines, f"run.dir {run} holds an earlier run of another configuration; {_ADVICE}"]))


def _read_again(earlier: Mapping[str, Any]) -> Mapping[str, Any]:
    """A flat configuration, with what this version adds to it; as it is where this version does not read it."""
    sections: dict[str, Any] = {}
    for key, value in earlier.items():
        *path, name = key.split(".")
        section = sections
        for part in path:
            section = section.setdefault(part, {})
        section[name] = value
    try:
        return flat(Config.model_validate(sections))
    except ValidationError:
        return earlier


def _differing(now: Mapping[str, Any], before: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield (key, value now, value before) for each difference that matters; a missing key has the value None."""
    for key in dict.fromkeys((*now, *before)):
        free = key in FREE_KEYS or key.partition(".")[0] in FREE_SECTIONS
        if not free and now.get(key) != before.get(key):
            yield key, now.get(key), before.get(key)


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _changed(path: Path, size: int, sha256: str) -> str:
    """Return how a file has changed since it had this length and SHA-256, apart from growing; empty if it has not."""
    if files.kind(path) != "file":
        return f"{path} is missing"
    if (now := path.stat().st_size) < size:
        return f"{path} has {now} bytes; it had {size}"
    if GrowingDigest(path).now(size) != (size, sha256):
        return f"{path} was changed"
    return ""


def _check_metrics(run: Path, notes: checkpoint.Notes, taken: Path) -> None:
    size, sha256 = notes.files.get(METRICS_FILE, (0, ""))
    if size and (change := _changed(run / METRICS_FILE, size, sha256)):
        raise PgtsError(f"{change} when {taken} was written; {_ADVICE}".replace("changed when", "changed since"))


def _lost_events(run: Path, notes: checkpoint.Notes) -> str:
    noted = {name: told for name, told in notes.files.items() if is_events(name)}
    return next(filter(None, (_changed(run / name, *told) for name, told in noted.items())), "")


def _lost_best(run: Path, notes: checkpoint.Notes) -> str:
    """Return what is wrong with the best model, if there should be one; empty if nothing is. A model that is later than
    the checkpoint is right, because training will save it again."""
    path, told = run / BEST_FILE, notes.files.get(BEST_FILE)
    evaluations = notes.progress.get("evaluations")
    greedy = evaluations.get("deterministic") if isinstance(evaluations, Mapping) else None
    if told is None and not (isinstance(greedy, Mapping) and greedy.get("history")):
        return ""
    if files.kind(path) is None:
        return f"{path} is missing"
    try:
        steps = saving.read(path)["state"]["num_env_steps"]
    except PgtsError as error:
        return str(error)
    except (KeyError, TypeError):
        return f"{path} holds no model"
    is_noted = told is None or GrowingDigest(path).now() == tuple(told)
    return "" if is_noted or steps > notes.env_steps else f"{path} was changed"


def _other_versions(before: Mapping[str, str], path: Path) -> list[str]:
    now = versions()
    return [
        f"{name} is {now.get(name)}; {path} was written with {before.get(name)}: the last bits may differ"
        for name in dict.fromkeys((*now, *before))
        if now.get(name) != before.get(name)
    ]


def _complain(lines: list[str], *, strict: bool) -> None:
    """Print these lines as warnings; with `strict` raise them as an error."""
    if lines and strict:
        raise PgtsError("\n".join(lines))
    for line in lines:
        print(f"warning: {line}", file=sys.stderr)
