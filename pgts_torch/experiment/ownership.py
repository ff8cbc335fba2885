"""Which files of a folder belong to a run: only those are ever replaced or removed.

A run writes a mark into its folder before anything else. In a folder with a mark, the files of a run are recognised by
their names. A folder without a mark is not touched.
"""

import hashlib
import os
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from pgts_torch import files
from pgts_torch.errors import PgtsError

MARK_FILE = ".pgts_run"
LOCK_FILE = ".lock"
CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.jsonl"
SUMMARY_FILE = "summary.json"
FAILURE_FILE = "failure.json"
VERSIONS_FILE = "versions.json"
BEST_FILE = "best.pt"
PICTURE_FILE = "policy.png"
REPORT_FILE = "report.html"
EXPORT_FILES = {"torch": "policy.pt2", "onnx": "policy.onnx"}
CHECKPOINTS = "checkpoints"

_RESULTS = (
    SUMMARY_FILE,
    METRICS_FILE,
    FAILURE_FILE,
    VERSIONS_FILE,
    BEST_FILE,
    PICTURE_FILE,
    REPORT_FILE,
    *EXPORT_FILES.values(),
)
"""In the order in which they are removed: a half cleared run is an unfinished one."""

_OWN_FILES = (*_RESULTS, MARK_FILE, CONFIG_FILE)
_CHECKPOINT = re.compile(r"\d{12,}\.pt")
_EVENTS = re.compile(rf"{re.escape(files.EVENTS_PREFIX)}\d+\..+{re.escape(files.EVENTS_SUFFIX)}")
_PARTIAL = re.compile(rf"\.(.+)\.\d+{re.escape(files.PARTIAL)}")


@dataclass(frozen=True, config=ConfigDict(strict=True, extra="forbid"))
class Mark:
    """The content of the mark of a run.

    configs: the SHA-256 of each config.yaml that the run has written.
    has_checkpoints: whether the run has ever written one.
    """

    configs: tuple[str, ...] = ()
    has_checkpoints: bool = False

    def of(self, config: bytes) -> "Mark":
        """This mark with the hash of one more configuration."""
        return replace(self, configs=tuple(dict.fromkeys((*self.configs, digest(config)))))


_MARK = TypeAdapter(Mark)


def digest(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()


def write_mark(run: Path, mark: Mark) -> None:
    files.replace(run / MARK_FILE, _MARK.dump_json(mark))


def read_mark(run: Path) -> Mark | None:
    """The mark of a run folder; None: this is no run folder.

    Raises:
        PgtsError: the mark is damaged, or of another version.
    """
    path = run / MARK_FILE
    if files.kind(path) != "file":
        return None
    try:
        return _MARK.validate_json(files.read(path))
    except ValidationError as error:
        raise PgtsError(
            f"{path} is damaged or of another version, so it cannot be told which files here are a run's; choose "
            "another folder"
        ) from error


def check_folder(path: Path) -> Mark:
    """Check that `path` can be a run folder, without writing to it.

    Returns:
        Its mark; an empty one where there is none.

    Raises:
        PgtsError: it is no folder, or holds files that no run has written.
    """
    found = files.kind(path, follow=True)
    if found is None and files.kind(path) is None:
        return Mark()
    if found != "folder":
        raise PgtsError(f"run.dir {path} is a {found or 'link to nowhere'}; it must be a folder or not exist")
    mark, names = read_mark(path), files.names(path)
    if mark is None:
        if foreign := [name for name in names if not _is_left_over(path / name)]:
            whose = (
                "a run of version 0.1" if is_earlier(path) else f"files that no run has left ({files.listing(foreign)})"
            )
            raise PgtsError(f"run.dir {path} holds {whose}; choose another folder")
        return Mark()
    for name in names:
        right = "folder" if name == CHECKPOINTS else "file"
        if name in (*_OWN_FILES, CHECKPOINTS, LOCK_FILE) and (kind := files.kind(path / name)) != right:
            raise PgtsError(f"{path / name} is a {kind}; a run keeps a {right} of its own there: move it away")
    return mark


def is_earlier(run: Path) -> bool:
    """Whether the folder has a checkpoint of version 0.1, which was a folder of a model and a manifest."""
    return any((run / CHECKPOINTS).glob("*/manifest.json"))


def check_many(out: Path, own: str, what: str) -> None:
    """Check that many runs can be put into a folder, without writing to it; where it also holds something else, that is
    said.

    Args:
        own: a regular expression of the names that `what` ("sweep", "tuning") gives to files and folders.

    Raises:
        PgtsError: nothing in it is ours, and something is there.
    """
    if files.kind(out, follow=True) is None:
        return
    names = [name for name in files.names(out) if name != LOCK_FILE and not name.endswith(files.PARTIAL)]
    foreign = [name for name in names if not re.fullmatch(own, name)]
    if not foreign:
        return
    if len(foreign) == len(names):
        raise PgtsError(
            f"--out {out} holds files that no {what} has left ({files.listing(foreign)}); choose another folder"
        )
    print(f"note: --out {out} also holds {files.listing(foreign)}, which no {what} has left; it stays", file=sys.stderr)


def table_targets(out: Path, table: str, content: type, what: str, others: Mapping[str, str]) -> list[Path]:
    """Where the table of many runs may be written, and the files that belong to it if it is beside them.

    Args:
        content: what the table holds.
        what, others: what the files must be, to be replaced; of the others by name.

    Raises:
        PgtsError: something else has one of these names.
    """

    def is_table(raw: bytes) -> bool:
        try:
            TypeAdapter(content).validate_json(raw)
        except ValidationError:
            return False
        return True

    has_table = files.kind(out / table) is not None
    place = files.target(out / table, is_table, what)
    beside = [
        files.target(out / name, lambda raw: has_table, f"{other}: no table is beside it")
        for name, other in others.items()
    ]
    return [place, *beside]


def _is_left_over(path: Path) -> bool:
    """Whether a file is left from a run that was killed before it wrote its mark."""
    if files.kind(path) != "file":
        return False
    return is_lock(files.read(path)) if path.name == LOCK_FILE else _is_partial(path.name)


def is_lock(raw: bytes) -> bool:
    """Whether this is the content of a lock file: a process id, or nothing."""
    return re.fullmatch(rb"(\d+\r?\n)?", raw) is not None


def _is_partial(name: str) -> bool:
    """Whether this is the temporary name of a file of a run that is being written."""
    own = _PARTIAL.fullmatch(name)
    return own is not None and (own[1] in _OWN_FILES or _CHECKPOINT.fullmatch(own[1]) is not None)


def is_events(name: str) -> bool:
    """Whether this is the name of an event file of a run."""
    return _EVENTS.fullmatch(name) is not None


def clear(run: Path, mark: Mark) -> list[str]:
    """Remove the files of a run except its lock and its mark; returns the names of the files that stay."""
    remove_partial(run)
    for path in [run / name for name in _RESULTS] + checkpoints(run):
        _remove(path)
    cut_events(run, {})
    with suppress(OSError):  # missing, or files of the user are in it
        (run / CHECKPOINTS).rmdir()
    config = run / CONFIG_FILE
    if files.kind(config) is not None and digest(files.read(config)) in mark.configs:
        _remove(config)
    return [name for name in files.names(run) if name not in (MARK_FILE, LOCK_FILE)]


def cut_events(run: Path, noted: Mapping[str, tuple[int, str]]) -> None:
    """Cut the event files of a run to the lengths that are noted of them, and remove the others."""
    for name in filter(is_events, files.names(run)):
        if name not in noted:
            _remove(run / name)
        elif files.kind(run / name) == "file":
            with files.named(f"{run / name} cannot be written to"):
                os.truncate(run / name, noted[name][0])


def remove_partial(run: Path) -> None:
    """Remove half written files of a killed process. The caller must hold the lock."""
    for path in [run / name for name in files.names(run)] + _in_checkpoints(run):
        if _is_partial(path.name):
            _remove(path)


def checkpoint_name(env_steps: int) -> str:
    """The name of the checkpoint of this step: names are in the order of steps."""
    return f"{env_steps:012d}.pt"


def checkpoints(run: Path) -> list[Path]:
    """The checkpoints of a run, oldest first, intact or damaged."""
    return [path for path in _in_checkpoints(run) if _CHECKPOINT.fullmatch(path.name) and files.kind(path) == "file"]


def _in_checkpoints(run: Path) -> list[Path]:
    folder = run / CHECKPOINTS
    return [folder / name for name in files.names(folder)] if files.kind(folder) == "folder" else []


def _remove(path: Path) -> None:
    """Remove a file; what is no file stays."""
    if files.kind(path) == "file":
        with files.named(f"{path} cannot be removed"):
            path.unlink()
