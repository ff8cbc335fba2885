"""One process at a time in a run folder."""

import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path
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


class InUse(PgtsError):
    """Another process has the folder."""


class RunLock:
    """Locks a run folder against other processes until this one ends. Use it as a context.

    Args:
        path: the folder; made here, with all parents.
        name: which option names it.

    Raises:
        InUse: another process, named by its id, holds it.
        PgtsError: it cannot be made or written to, or the lock file was not made by a run.
    """

    def __init__(self, path: Path, *, name: str = "run.dir") -> None:
        self.path, self._name = path, name
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        with files.named(f"{name} {path} cannot be written to"):
            path.mkdir(parents=True, exist_ok=True)
            self._file = os.fdopen(os.open(path / LOCK_FILE, flags, 0o644), "r+b", buffering=0)
        try:
            with files.named(f"{name} {path} cannot be locked"):
                is_taken = self._take()
                self._file.seek(0)
                if not is_lock(content := self._file.read(64)):
                    raise PgtsError(f"{path / LOCK_FILE} is not the lock of a run; choose another folder")
                if not is_taken:
                    raise InUse(f"{name} {path} is in use by the process {content.decode().strip() or 'unknown'}")
                self._file.seek(0)
                self._file.truncate()
                self._file.write(f"{os.getpid()}\n".encode())
        except BaseException:
            self._file.close()
            raise

    def _take(self) -> bool:
        """Try to take the lock; whether this succeeded."""
        try:
            if fcntl is not None:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            else:
                import msvcrt

                self._file.seek(_BEYOND)
                msvcrt.locking(self._file.fileno(), msvcrt.LK_NBLCK, 1)
        except (BlockingIOError, PermissionError):  # which of the two depends on the platform
            return False
        return True

    def check(self) -> None:
        """PgtsError if the locked folder has been moved or replaced."""
        try:
            now = os.stat(self.path / LOCK_FILE, follow_symlinks=False)
        except OSError:
            now = None
        if now is None or not os.path.samestat(now, os.fstat(self._file.fileno())):
            raise PgtsError(
                f"{self._name} {self.path} was moved or replaced while this run had it; nothing more is written"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()  # releases the lock


def wait_for(folders: Iterable[Path]) -> None:
    """Wait for trainings that have outlived a command that was killed: what they come to counts."""
    for place in folders:
        is_said = False
        while files.kind(place / LOCK_FILE) is not None:
            try:
                with RunLock(place):
                    break
            except InUse as error:
                if not is_said:
                    print(f"waiting: {error}", file=sys.stderr, flush=True)
                is_said = True
                time.sleep(1)
