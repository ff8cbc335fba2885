"""Checkpoints of a run: a directory each, which is whole or not there, and proves it before anything in it is used.

`checkpoints/STEP/` holds the model as `PGTS.save` writes it and a manifest with its SHA-256, written last; one rename
puts the directory in its place. The manifest is sealed by a SHA-256 of its own.
"""

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pgts_torch import files
from pgts_torch.agent import saving
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.states import NO_STATE, check_keys
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.experiment.ownership import (
    CHECKPOINTS,
    MANIFEST_FILE,
    METRICS_FILE,
    MODEL_FILE,
    digest,
    read_mark,
    remove_checkpoint,
    remove_partial,
    sealed,
    unsealed,
    write_mark,
)
from pgts_torch.experiment.ownership import checkpoints as listed

_FORMAT = 3
_FORMAT_0_1 = 2


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


class Damaged(PgtsError):
    """A checkpoint does not hold what was written."""


def write(run: Path, algorithm: PGTS, notes: Notes, *, keep: int) -> Path:
    """Add a checkpoint to a run folder, and `tidy` it. Of several processes all must call it, and the first one writes.

    Raises:
        PgtsError: it cannot be written; then the others are as they were.
    """
    path = run / CHECKPOINTS / f"{notes.env_steps:012d}"
    content = algorithm.content()

    def put() -> None:
        _put(path, content, notes)
        tidy(run, path, keep=keep)
        if (mark := read_mark(run)) is not None and not mark.has_checkpoints:
            write_mark(run, replace(mark, has_checkpoints=True))

    algorithm.ranks.first("a checkpoint", put)
    return path


def _put(path: Path, content: dict[str, Any], notes: Notes) -> None:
    partial = path.with_name(f".{path.name}{files.PARTIAL}")
    try:
        path.parent.mkdir(exist_ok=True)
        remove_checkpoint(partial)
        partial.mkdir()
        saving.write(partial / MODEL_FILE, content)
        digests = {MODEL_FILE: digest((partial / MODEL_FILE).read_bytes())}
        files.replace(partial / MANIFEST_FILE, sealed({"format": _FORMAT, "files": digests, "notes": asdict(notes)}))
        _sync(partial)
        remove_checkpoint(path)
        if files.kind(path) is None:
            partial.rename(path)
        else:  # somebody else's things are in it; without its manifest a checkpoint is damaged, so that comes last
            for name in (MODEL_FILE, MANIFEST_FILE):
                (partial / name).rename(path / name)
            _sync(path)
        _sync(path.parent)
    except OSError as error:
        raise PgtsError(f"the checkpoint {path} cannot be written: {error.strerror}") from error
    finally:
        remove_checkpoint(partial)


def read(path: Path) -> tuple[Notes, dict[str, Any]]:
    """The notes of a checkpoint and what `PGTS.save` wrote; nothing is decoded before its checksum is right.

    Raises:
        Damaged: a file is missing, or does not hold what was written.
        PgtsError: it is of another format.
    """
    try:
        manifest, model = files.read(path / MANIFEST_FILE), files.read(path / MODEL_FILE)
    except PgtsError as error:
        raise Damaged(f"the checkpoint {path} is damaged: {error}") from error
    content = unsealed(manifest)
    if content is None:
        raise Damaged(f"the checkpoint {path} is damaged: the checksum of {MANIFEST_FILE} does not fit")
    if content.get("format") not in (_FORMAT, _FORMAT_0_1):
        raise PgtsError(f"the checkpoint {path} has the format {content.get('format')}; this version reads {_FORMAT}")
    if content.get("files") != {MODEL_FILE: digest(model)}:
        raise Damaged(f"the checkpoint {path} is damaged: the checksum of {MODEL_FILE} does not fit")
    try:
        notes = _notes(content["notes"], is_old=content["format"] == _FORMAT_0_1)
    except NO_STATE as error:
        reason = error if isinstance(error, PgtsError) else f"{type(error).__name__}: {error}"
        raise PgtsError(f"the checkpoint {path} is not of the form that this version writes: {reason}") from error
    return notes, saving.decode(model, path / MODEL_FILE)


_NOTES = {"config": dict, "versions": dict, "files": dict, "progress": dict, "finished": bool}


def _notes(content: dict[str, Any], *, is_old: bool) -> Notes:
    """The notes in a manifest, PgtsError where they cannot be; version 0.1 had no checksum of the files beside it."""
    if is_old:
        content["files"] = {METRICS_FILE: [content.pop("metrics_bytes"), None]}
    counts = ("iterations", "env_steps", "model_calls", "world_size")
    check_keys("its notes", content, {*_NOTES, *counts})
    for name in counts:
        check_count(name, content[name], least=name == "world_size")
    for name, kind in _NOTES.items():
        if type(content[name]) is not kind:
            raise PgtsError(f"{name} is {content[name]!r}; it must be a {kind.__name__}")
    for name, (size, sha256) in content["files"].items():
        check_count(f"the length of {name}", size, least=0)
        if not isinstance(sha256, str | None):
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
            remove_checkpoint(path)
    remove_partial(run)


def _sync(folder: Path) -> None:
    """Have the names in a folder on the disk; Windows does so by itself."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
