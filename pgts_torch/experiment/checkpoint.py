"""Checkpoints of a run: a file each, `checkpoints/STEP.pt`, which is whole or not there, and proves it before anything
in it is used. It is what `PGTS.save` writes, with notes beside the model: `PGTS.load` reads it."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, FiniteFloat, NonNegativeInt, PositiveInt, ValidationError

from pgts_torch import files
from pgts_torch.agent import saving
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.saving import Damaged
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import ownership
from pgts_torch.experiment.summary import EndedBy, first_mistake


class Progress(BaseModel, strict=True, extra="forbid"):
    """What the loop around the algorithm goes on from.

    ended_by: why the training is complete; None: it is not.
    depth: the largest so far.   certificate: the latest one; None: there is none.   seconds: so far.
    evaluations: the states of the callbacks that evaluate, by kind.   movement: the state of `Movement`.
    """

    ended_by: EndedBy | None = None
    depth: NonNegativeInt = 0
    certificate: FiniteFloat | None = None
    seconds: FiniteFloat = 0.0
    evaluations: dict[str, Any] = {}
    movement: dict[str, Any] = {}


class Notes(BaseModel, strict=True, extra="forbid", frozen=True):
    """What a checkpoint says beside the model, in plain values.

    config: as `Config.model_dump` has it.
    versions: of the packages that numbers depend on.
    world_size: how many processes trained.
    files: length and SHA-256 of the metrics, the events and the best model when it was taken, by name.
    """

    iterations: NonNegativeInt
    env_steps: NonNegativeInt
    model_calls: NonNegativeInt
    config: dict[str, Any]
    versions: dict[str, str | None]
    world_size: PositiveInt
    files: dict[str, tuple[NonNegativeInt, str]]
    progress: Progress


def write(run: Path, algorithm: PGTS, notes: Notes, *, keep: int) -> Path:
    """Add a checkpoint to a run folder, and `tidy` it. Of several processes all must call it, and the first one writes.

    Raises:
        PgtsError: it cannot be written; then the others are as they were.
    """
    path = run / ownership.CHECKPOINTS / ownership.checkpoint_name(notes.env_steps)
    content = algorithm.content() | {"notes": notes.model_dump()}

    def put() -> None:
        with files.named(f"the checkpoint {path} cannot be written"):
            path.parent.mkdir(exist_ok=True)
        saving.write(path, content)
        tidy(run, path, keep=keep)
        if (mark := ownership.read_mark(run)) is not None and not mark.has_checkpoints:
            ownership.write_mark(run, replace(mark, has_checkpoints=True))

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
        notes = Notes.model_validate(content.pop("notes", None))
    except ValidationError as error:
        reason = first_mistake(error, "notes")
        raise PgtsError(f"the checkpoint {path} is not of the form that this version writes: {reason}") from error
    if path.name != ownership.checkpoint_name(notes.env_steps):
        raise Damaged(f"{path} is damaged: it is the checkpoint of step {notes.env_steps}")
    return notes, content


def newest(run: Path, *, strict: bool = False) -> tuple[Path, Notes, dict[str, Any]] | None:
    """The newest intact checkpoint of a run folder, as `read` gives it, with its path; None if there is none at all.

    Args:
        strict: refuse a damaged one; else it is named on stderr, and the one before it is used.

    Raises:
        PgtsError: none is intact, or `strict` and the newest is not.
    """
    paths = ownership.checkpoints(run)
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
    kept = [path for path in ownership.checkpoints(run) if path.name <= last.name][-keep:]
    for path in ownership.checkpoints(run):
        if path not in kept:
            path.unlink(missing_ok=True)
    ownership.remove_partial(run)
