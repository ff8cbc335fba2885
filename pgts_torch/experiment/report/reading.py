"""The files of a run folder, read so that a damaged one, or one that is being written, becomes a note."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.checkpoint import Notes
from pgts_torch.experiment.ownership import (
    CHECKPOINTS,
    FAILURE_FILE,
    LOCK_FILE,
    MARK_FILE,
    METRICS_FILE,
    REPORT_FILE,
    SUMMARY_FILE,
)
from pgts_torch.experiment.summary import Summary, from_json, rows
from pgts_torch.files import PARTIAL

Line = dict[str, Any]

_LARGEST = 1e300


def json_object(path: Path, notes: list[str]) -> dict[str, Any] | None:
    """The object in a file; None where there is none."""
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        notes.append(f"{path.name} cannot be read.")
        return None
    return content


def summary(run: Path, notes: list[str]) -> Summary | None:
    """What a finished run came to; None if it is not finished."""
    content = json_object(run / SUMMARY_FILE, notes)
    if content is None:
        return None
    try:
        found = from_json(content)
        rows(found)  # shows whether all of it can be said
    except (TypeError, KeyError, ValueError, AttributeError):
        notes.append(f"{SUMMARY_FILE} is not as this version writes it; it is left out.")
        return None
    return found


def failure(run: Path, notes: list[str]) -> dict[str, Any] | None:
    """What stopped a training; None if nothing did."""
    content = json_object(run / FAILURE_FILE, notes)
    if content is None or {"iteration", "env_step", "tensor", "message"} <= content.keys():
        return content
    notes.append(f"{FAILURE_FILE} is not as this version writes it; it is left out.")
    return None


def metrics(run: Path, notes: list[str]) -> list[Line]:
    """The lines of metrics.jsonl that can be read; what is not a finite number is None."""
    try:
        raw = (run / METRICS_FILE).read_bytes().splitlines()
    except OSError:
        raw = []
    lines = [line for line in map(_line, raw) if line is not None]
    if unread := len(raw) - len(lines):
        notes.append(f"{unread} of {len(raw)} lines of {METRICS_FILE} cannot be read; they are left out.")
    if not lines:
        notes.append(f"{METRICS_FILE} holds no iteration, so there are no curves.")
    return lines


def _line(raw: bytes) -> Line | None:
    try:
        line = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    if not isinstance(line, dict) or type(line.get("step")) is not int:
        return None
    return {tag: value if is_number(value) else None for tag, value in line.items()}


def is_number(value: Any) -> bool:
    """Whether a value is a number that can be drawn: differences of two of them are finite, too."""
    return isinstance(value, int | float) and abs(value) <= _LARGEST


def last_checkpoint(run: Path, notes: list[str]) -> tuple[Path, Notes] | None:
    """The newest checkpoint that is intact, and what it says."""
    for path in reversed(checkpoint.listed(run)):
        try:
            return path, checkpoint.read(path)[0]
        except PgtsError as error:
            notes.append(f"{error}.")
    notes.append("There is no intact checkpoint, so nothing can be said about the trained policy itself.")
    return None


def files(run: Path) -> Iterator[tuple[str, int]]:
    """Names and bytes of what a run has left; each checkpoint counts as one."""
    for path in sorted(run.iterdir()):
        others = (CHECKPOINTS, LOCK_FILE, MARK_FILE, REPORT_FILE)
        if path.name not in others and not path.name.endswith(PARTIAL):
            yield path.name, _bytes(path)
    for path in checkpoint.listed(run):
        yield f"{CHECKPOINTS}/{path.name}", sum(map(_bytes, path.glob("*")))


def _bytes(path: Path) -> int:
    with contextlib.suppress(FileNotFoundError):  # a run that is being trained removes old checkpoints
        return path.stat().st_size
    return 0
