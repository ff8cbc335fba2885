"""Checkpoints of a run: a file each, `checkpoints/STEP.pt`, which is whole or not there, and proves it before anything
in it is used. It is what `PGTS.save` writes, with notes beside the model: `PGTS.load` reads it."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pgts_torch import files
from pgts_torch.agent import saving
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.saving import Damaged
from pgts_torch.agent.states import NO_STATE, check_keys
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.experiment.ownership import (
    CHECKPOINTS,
    checkpoint_name,
    read_mark,
    remove_partial,
    write_mark,
)
from pgts_torch.experiment.ownership import checkpoints as listed


@dataclass(frozen=True)
class Notes:
    """What a checkpoint says beside the model, in plain values.

    config: every key of the configuration, dotted, with its value.
    versions: of the packages that numbers depend on.
    world_size: how many processes trained.
    files: length and SHA-256 of the metrics, the events and the best model when it was taken, by name.
    finished: whether the training had come to its end.
    progress: what the loop around the algorithm goes on from.
    """

    iterations: int
    env_steps: int
    model_calls: int
    config: Mapping[str, Any]
    versions: Mapping[str, str]
    world_size: int
    files: Mapping[str, Sequence[Any]]
    finished: bool
    progress: Mapping[str, Any]


def write(run: Path, algorithm: PGTS, notes: Notes, *, keep: int) -> Path:
    """Add a checkpoint to a run folder, and `tidy` it. Of several processes all must call it, and the first one writes.

    Raises:
        PgtsError: it cannot be written; then the others are as they were.
    """
    path = run / CHECKPOINTS / checkpoint_name(notes.env_steps)
    content = algorithm.content() | {"notes": asdict(notes)}

    def put() -> None:
        with files.named(f"the checkpoint {path} cannot be written"):
            path.parent.mkdir(exist_ok=True)
        saving.write(path, content)
        tidy(run, path, keep=keep)
        if (mark := read_mark(run)) is not None and not mark.has_checkpoints:
            write_mark(run, replace(mark, has_checkpoints=True))

    algorithm.ranks.first("a checkpoint", put)
    return path


def read(path: Path) -> tuple[Notes, dict[str, Any]]:
    """The notes of a checkpoint and what `PGTS.save` wrote; nothing is decoded before its checksum is right.

    Raises:
        Damaged: it does not hold what was written.
        PgtsError: it is of another format.
    """
    content = saving.read(path)
    try:
        notes = _notes(content.pop("notes"))
    except NO_STATE as error:
        reason = error if isinstance(error, PgtsError) else f"{type(error).__name__}: {error}"
        raise PgtsError(f"the checkpoint {path} is not of the form that this version writes: {reason}") from error
    if path.name != checkpoint_name(notes.env_steps):
        raise Damaged(f"{path} is damaged: it is the checkpoint of step {notes.env_steps}")
    return notes, content


_NOTES = {"config": dict, "versions": dict, "files": dict, "progress": dict, "finished": bool}


def _notes(content: dict[str, Any]) -> Notes:
    """The notes in a checkpoint; PgtsError where they cannot be."""
    counts = ("iterations", "env_steps", "model_calls", "world_size")
    check_keys("its notes", content, {*_NOTES, *counts})
    for name in counts:
        check_count(name, content[name], least=name == "world_size")
    for name, kind in _NOTES.items():
        if type(content[name]) is not kind:
            raise PgtsError(f"{name} is {content[name]!r}; it must be a {kind.__name__}")
    for name, (size, sha256) in content["files"].items():
        check_count(f"the length of {name}", size, least=0)
        if not isinstance(sha256, str):
            raise PgtsError(f"the SHA-256 of {name} is {sha256!r}")
    return Notes(**content)


def newest(run: Path, *, strict: bool = False) -> tuple[Path, Notes, dict[str, Any]] | None:
    """The newest intact checkpoint of a run folder, as `read` gives it, with its path; None if there is none at all.

    Args:
        strict: refuse a damaged one; else it is named on stderr, and the one before it is used.

    Raises:
        PgtsError: none is intact, or `strict` and the newest is not.
    """
    paths = listed(run)
    for path in reversed(paths):
        try:
            return path, *read(path)
        except Damaged as error:
            if strict:
                raise
            print(f"warning: {error}", file=sys.stderr)
    if paths:
        raise PgtsError(f"{run} has no checkpoint that is intact")
    return None


def tidy(run: Path, last: Path, *, keep: int) -> None:
    """Remove all checkpoints but `last` and the newest before it, `keep` in all; those ahead of it are damaged. And
    what a process that was killed has left half written: nobody else may be writing."""
    kept = [path for path in listed(run) if path.name <= last.name][-keep:]
    for path in listed(run):
        if path not in kept:
            path.unlink(missing_ok=True)
    remove_partial(run)
