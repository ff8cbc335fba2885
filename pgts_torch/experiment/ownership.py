"""Which files of a folder belong to a run: only those are ever replaced or removed.

A run writes a mark into its folder before anything else. In a folder with a mark, the files of a run are recognised by
their names. A folder without a mark is not touched, unless its content is that of a run of version 0.1.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

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
CHECKPOINTS = "checkpoints"
EVENTS_SUFFIX = ".pgts"

_OWN_FILES = (
    SUMMARY_FILE,
    METRICS_FILE,
    FAILURE_FILE,
    VERSIONS_FILE,
    BEST_FILE,
    PICTURE_FILE,
    REPORT_FILE,
    MARK_FILE,
    CONFIG_FILE,
)
_EVENTS = re.compile(r"events\.out\.tfevents\.\d+\..+")
EARLIER_MODEL = "model.pt"
_EARLIER_FILES = (EARLIER_MODEL, "manifest.json")
"""What is in each checkpoint of version 0.1."""

_FORMAT = 1


@dataclass(frozen=True)
class Mark:
    """The content of the mark of a run.

    configs: the SHA-256 of each config.yaml that the run has written.
    events: names of the event files, for a run begun by version 0.1.
    has_checkpoints: whether the run has ever written one.
    """

    configs: tuple[str, ...] = ()
    events: tuple[str, ...] = ()
    has_checkpoints: bool = False

    def of(self, config: bytes) -> "Mark":
        """This mark with the hash of one more configuration."""
        return replace(self, configs=tuple(dict.fromkeys((*self.configs, digest(config)))))


def digest(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()


def write_mark(run: Path, mark: Mark) -> None:
    files.replace(run / MARK_FILE, sealed({"pgts_torch run": _FORMAT, **asdict(mark)}))


def read_mark(run: Path) -> Mark | None:
    """The mark of a run folder, or one made for a folder of version 0.1; None: this is no run folder.

    Raises:
        PgtsError: the mark is damaged, or of a later version.
    """
    path = run / MARK_FILE
    if files.kind(path) != "file":
        return _earlier_mark(run)
    content = unsealed(files.read(path))
    if content is None or "pgts_torch run" not in content:
        raise PgtsError(f"{path} is damaged, so it cannot be told which files here are a run's; choose another folder")
    if content.pop("pgts_torch run") != _FORMAT:
        raise PgtsError(f"{run} is the folder of a run of a later version of pgts_torch")
    return Mark(tuple(content["configs"]), tuple(content["events"]), content["has_checkpoints"])


def _earlier_mark(run: Path) -> Mark | None:
    """The mark of a run of version 0.1, which is recognised by a sealed manifest, its metrics or its versions."""
    proofs = [_is_manifest(path / _EARLIER_FILES[1]) for path in earlier_checkpoints(run)]
    if not (any(proofs) or _are_metrics(run / METRICS_FILE) or _are_versions(run / VERSIONS_FILE)):
        return None
    config, has_checkpoints = _content(run / CONFIG_FILE), files.kind(run / CHECKPOINTS) == "folder"
    own = (
        () if config is None or b"#" in config else (digest(config),)
    )  # a run writes no comments: somebody has edited it
    return Mark(own, tuple(name for name in _names(run) if _EVENTS.fullmatch(name)), has_checkpoints)


def _content(path: Path) -> bytes | None:
    return files.read(path) if files.kind(path) == "file" else None


def _is_manifest(path: Path) -> bool:
    content = unsealed(_content(path) or b"")
    return content is not None and "notes" in content


def _are_metrics(path: Path) -> bool:
    first = _object((_content(path) or b"").partition(b"\n")[0])
    return type(first.get("step")) is int and not {"charts/SPS", "eval/deterministic_return"}.isdisjoint(first)


def _are_versions(path: Path) -> bool:
    return {"python", "pgts_torch", "torch", "threads"} <= _object(_content(path) or b"").keys()


def _object(raw: bytes) -> dict[str, Any]:
    try:
        content = json.loads(raw)
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


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
    mark, names = read_mark(path), _names(path)
    if mark is None:
        foreign = [name for name in names if not _is_left_over(path / name)]
        if foreign:
            raise PgtsError(
                f"run.dir {path} holds files that no run has left ({listing(foreign)}); choose another folder"
            )
        return Mark()
    for name in names:
        right = "folder" if name == CHECKPOINTS else "file"
        if (name in (*_OWN_FILES, CHECKPOINTS, LOCK_FILE)) and (kind := files.kind(path / name)) != right:
            raise PgtsError(f"{path / name} is a {kind}; a run keeps a {right} of its own there: move it away")
    return mark


def listing(names: list[str], most: int = 5) -> str:
    """The first names in one line, and how many more there are."""
    shown = [ascii(name)[1:-1] for name in names[:most]]
    return ", ".join([*shown, f"{len(names) - most} more"] if len(names) > most else shown)


def _names(folder: Path) -> list[str]:
    with files.named(f"{folder} cannot be read"):
        return sorted(entry.name for entry in folder.iterdir())


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
    own = re.fullmatch(rf"\.(.+)\.\d+{re.escape(files.PARTIAL)}", name)
    return own is not None and (own[1] in _OWN_FILES or re.fullmatch(r"\d{12,}\.pt", own[1]) is not None)


def is_events(name: str, mark: Mark = Mark()) -> bool:
    """Whether this is the name of an event file of a run (of the run with this mark)."""
    return name in mark.events or (name.endswith(EVENTS_SUFFIX) and _EVENTS.fullmatch(name) is not None)


def clear(run: Path, mark: Mark) -> list[str]:
    """Remove the files of a run except its lock and its mark; returns the names of the files that stay.

    The summary is removed first and the configuration last, so that a half cleared run is an unfinished one.
    """
    remove_partial(run)
    folders = [*earlier_checkpoints(run), *_in_checkpoints(run, rf"\.\d{{12,}}{re.escape(files.PARTIAL)}")]
    for path in [*checkpoints(run), *(part for folder in folders for part in _earlier_files(folder))]:
        with suppress(OSError):
            path.unlink()
    for path in [*folders, run / CHECKPOINTS]:
        with suppress(OSError):  # missing, or files of the user are in it
            path.rmdir()
    ours = [name for name in _names(run) if name != MARK_FILE and _is_removable(run / name, mark)]
    for name in sorted(ours, key=lambda name: (name == CONFIG_FILE, name != SUMMARY_FILE)):
        with files.named(f"{run / name} cannot be removed"):
            (run / name).unlink()
    return [name for name in _names(run) if name not in (MARK_FILE, LOCK_FILE)]


def clear_events(run: Path, mark: Mark) -> None:
    """Remove the event files of a run."""
    for name in _names(run):
        if is_events(name, mark) and files.kind(run / name) == "file":
            with files.named(f"{run / name} cannot be removed"):
                (run / name).unlink()


def _is_removable(path: Path, mark: Mark) -> bool:
    if files.kind(path) != "file":
        return False
    if path.name == CONFIG_FILE:
        return digest(files.read(path)) in mark.configs
    return path.name in _OWN_FILES or is_events(path.name, mark)


def checkpoint_name(env_steps: int) -> str:
    """The name of the checkpoint of this step: names are in the order of steps."""
    return f"{env_steps:012d}.pt"


def checkpoints(run: Path) -> list[Path]:
    """The checkpoints of a run, oldest first, intact or damaged."""
    return [path for path in _in_checkpoints(run, r"\d{12,}\.pt") if files.kind(path) == "file"]


def earlier_checkpoints(run: Path) -> list[Path]:
    """Those of version 0.1, each a folder of a model and a manifest, oldest first. They can be evaluated, but a
    training does not go on from them."""
    return [path for path in _in_checkpoints(run, r"\d{12,}") if any(map(files.kind, _earlier_files(path)))]


def _earlier_files(path: Path) -> list[Path]:
    return [path / name for name in _EARLIER_FILES] if files.kind(path) == "folder" else []


def _in_checkpoints(run: Path, name: str) -> list[Path]:
    """What has such a name in the folder of checkpoints."""
    folder = run / CHECKPOINTS
    names = _names(folder) if files.kind(folder) == "folder" else []
    return [folder / each for each in names if re.fullmatch(name, each)]


def remove_partial(run: Path) -> None:
    """Remove half written files of a killed process. The caller must hold the lock."""
    for path in [*(run / name for name in _names(run)), *_in_checkpoints(run, r"\..*")]:
        if _is_partial(path.name) and files.kind(path) == "file":
            with suppress(OSError):
                path.unlink()


def sealed(content: Mapping[str, Any]) -> bytes:
    """JSON that contains its own SHA-256, in one canonical form, so that any changed bit is noticed."""
    plain = json.dumps(content, sort_keys=True)
    seal = digest(plain.encode())
    return (json.dumps({"content": content, "sha256": seal}, sort_keys=True, indent=1) + "\n").encode()


def unsealed(raw: bytes) -> dict[str, Any] | None:
    """The sealed content; None if this is not exactly what `sealed` returns for it."""
    try:
        content = json.loads(raw)["content"]
        return content if sealed(content) == raw else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
