"""The user's files: read only where they are plain files, and replaced whole or not at all."""

import contextlib
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from pgts_torch.errors import PgtsError

PARTIAL = ".partial"
"""The end of the name of a file, or a folder, that is being written."""

EVENTS_PREFIX, EVENTS_SUFFIX = "events.out.tfevents.", ".pgts"
"""How the names of TensorBoard's event files begin, and how those that we write end."""

_NO_WAITING = getattr(os, "O_NONBLOCK", 0)
_STREAMS = ("/dev/fd/", "/dev/stdin", "/proc/self/fd/")
_KINDS = {
    stat.S_IFREG: "file",
    stat.S_IFDIR: "folder",
    stat.S_IFLNK: "symbolic link",
    stat.S_IFIFO: "pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}


@contextlib.contextmanager
def named(complaint: str) -> Iterator[None]:
    """PgtsError, with the reason after the complaint, where the system refuses a path."""
    try:
        yield
    except UnicodeEncodeError as error:
        reason = "its name has letters that this locale lacks; set PYTHONUTF8=1, or LC_ALL to a locale of UTF-8"
        raise PgtsError(f"{complaint}: {reason}") from error
    except (OSError, ValueError) as error:  # ValueError: a null byte
        if isinstance(error, PgtsError):
            raise
        raise PgtsError(f"{complaint}: {getattr(error, 'strerror', None) or error}") from error


def kind(path: str | Path, *, follow: bool = False) -> str | None:
    """What is at a path, in a word; None: nothing.

    Args:
        follow: where it is a symbolic link, what that leads to.

    Raises:
        PgtsError: the system does not tell, as where a name is too long.
    """
    with named(str(path)):
        try:
            mode = os.stat(path, follow_symlinks=follow).st_mode
        except (FileNotFoundError, NotADirectoryError):
            return None
        return _KINDS.get(stat.S_IFMT(mode), "special file")


def read(path: str | Path, *, most: int | None = None, name: str | None = None) -> bytes:
    """What is in a file, `most` bytes of it. What a pipe or a device at that path holds is not waited for, unless it
    was handed to this process, as by `<(...)` of a shell.

    Args:
        name: what errors call it; default its path.

    Raises:
        PgtsError: it is no file, or cannot be read.
    """
    name = str(path) if name is None else name
    with named(f"{name} cannot be read"):
        is_stream = str(path).startswith(_STREAMS)
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | (0 if is_stream else _NO_WAITING))
        with open(handle, "rb") as file:
            mode = os.fstat(handle).st_mode
            if not (is_stream or stat.S_ISREG(mode)):
                raise PgtsError(f"{name} is a {_KINDS.get(stat.S_IFMT(mode), 'special file')}; it must be a file")
            return file.read(-1 if most is None else most)


def names(folder: Path) -> list[str]:
    """The names of what is in a folder, in order; PgtsError where it cannot be read."""
    with named(f"{folder} cannot be read"):
        return sorted(entry.name for entry in folder.iterdir())


def listing(names: list[str], most: int = 5) -> str:
    """The first names in one line, and how many more there are."""
    shown = [ascii(name)[1:-1] for name in names[:most]]
    return ", ".join([*shown, f"{len(names) - most} more"] if len(names) > most else shown)


def replace(path: str | Path, raw: bytes) -> None:
    """Write a file, to the disk; a reader meanwhile finds the old file or the new one.

    Raises:
        PgtsError: it cannot be written; then nothing has changed.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        with named(f"{path} cannot be written"):
            with partial.open("wb") as file:
                file.write(raw)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
            _sync(path.parent)
    finally:
        with contextlib.suppress(OSError, ValueError):
            partial.unlink(missing_ok=True)


def _sync(folder: Path) -> None:
    """Have the names in a folder on the disk; Windows does so by itself."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def as_path(path: str | Path) -> Path:
    """The path; PgtsError where it is none."""
    if not isinstance(path, str | Path):
        raise PgtsError(f"{path!r} is no path; it must be a str or a pathlib.Path")
    return Path(path)


def target(path: str | Path, is_ours: Callable[[bytes], bool], what: str, *, most: int | None = None) -> Path:
    """Where a file may be written, behind symbolic links: nothing is there, or an empty file, or one that we have
    written before.

    Args:
        is_ours: whether the content of a file, the first `most` bytes of it, is ours.
        what: it must be, to be replaced.

    Raises:
        PgtsError: something else is there, or it is no path.
    """
    with named(f"{path} cannot be written"):
        place = Path(os.path.realpath(as_path(path)))
    found = kind(place)
    if found == "file" and (raw := read(place, most=most)) and not is_ours(raw):
        raise PgtsError(f"{path} exists and is not {what}: move it away, or choose another name")
    if found not in (None, "file"):
        raise PgtsError(f"{path} is a {found}; it must be a file, or not exist")
    return place
