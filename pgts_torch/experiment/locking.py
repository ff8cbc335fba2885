"""One process at a time in a run folder."""

import os
import stat
from pathlib import Path
from types import TracebackType
from typing import Self

from pgts_torch import files
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.ownership import LOCK_FILE, is_lock

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_BEYOND = 2**30
"""Where Windows locks a byte: far behind the content, which other processes may then still read."""


class RunLock:
    """Locks a run folder against other processes until this one ends. Use it as a context.

    Args:
        path: the folder; made here, with all parents.

    Raises:
        PgtsError: it cannot be made or written to; or another process, named by its id, holds it; or the lock file
            was not made by a run.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with files.named(f"run.dir {path} cannot be written to"):
            path.mkdir(parents=True, exist_ok=True)
            self._handle = _opened(path / LOCK_FILE)
        try:
            with files.named(f"run.dir {path} cannot be locked"):
                taken = _take(self._handle)
                os.lseek(self._handle, 0, os.SEEK_SET)
                content = os.read(self._handle, 64)
            if not is_lock(content):
                raise PgtsError(f"{path / LOCK_FILE} is not the lock of a run; choose another folder")
            if not taken:
                raise PgtsError(f"run.dir {path} is in use by the process {content.decode().strip() or 'unknown'}")
            with files.named(f"run.dir {path} cannot be written to"):
                os.ftruncate(self._handle, 0)
                os.lseek(self._handle, 0, os.SEEK_SET)
                os.write(self._handle, f"{os.getpid()}\n".encode())
        except BaseException:
            os.close(self._handle)
            raise

    def check(self) -> None:
        """PgtsError if the locked folder has been moved or replaced."""
        try:
            now = os.stat(self.path / LOCK_FILE, follow_symlinks=False)
        except OSError:
            now = None
        if now is None or not os.path.samestat(now, os.fstat(self._handle)):
            raise PgtsError(f"run.dir {self.path} was moved or replaced while this run had it; nothing more is written")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._handle)  # releases the lock


def _opened(path: Path) -> int:
    """Open a plain file for reading and writing, unchanged; create it if it does not exist."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    found = files.kind(path)
    if found not in (None, "file"):
        raise PgtsError(f"{path} is a {found}; a run keeps a file of its own there: move it away")
    handle = os.open(path, flags, 0o644)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise PgtsError(f"{path} is no file; a run keeps a file of its own there: move it away")
    return handle


def _take(handle: int) -> bool:
    """Try to take the lock; whether this succeeded."""
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            import msvcrt

            os.lseek(handle, _BEYOND, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    except (BlockingIOError, PermissionError):  # which of the two depends on the platform
        return False
    return True
