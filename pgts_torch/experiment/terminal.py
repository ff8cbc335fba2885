"""What a process says, wherever that goes: a full disk or a closed terminal ends no training."""

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Any, TextIO, cast

from pgts_torch.errors import PgtsError


class Telling:
    """A stream of text that escapes what its encoding lacks, and falls silent once it cannot be written to.

    Args:
        stream: takes what is written.
        must: what is written is what was asked for, so that it is an error if it is lost. A reader that leaves early
            is BrokenPipeError.
    """

    def __init__(self, stream: TextIO, *, must: bool) -> None:
        self._stream, self._must = stream, must

    def write(self, text: str) -> int:
        """As that of a stream. PgtsError or BrokenPipeError where text that must be written cannot be."""
        encoding = self._stream.encoding or "utf-8"
        with self._heard():
            self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """As `write`."""
        with self._heard():
            self._stream.flush()

    @contextlib.contextmanager
    def _heard(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # ValueError: it was closed
            self._silence()
            if isinstance(error, BrokenPipeError) and self._must:
                raise
            if self._must:
                reason = getattr(error, "strerror", None) or error
                raise PgtsError(f"the answer cannot be written to stdout: {reason}") from error

    def _silence(self) -> None:
        """What is still in the buffer, and all that follows, goes nowhere."""
        with contextlib.suppress(OSError, ValueError):
            handle = os.open(os.devnull, os.O_WRONLY)
            os.dup2(handle, self._stream.fileno())
            os.close(handle)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def plain_warnings() -> Iterator[None]:
    """Warnings to the user are one line, without the place in the code that they come from."""
    original = warnings.formatwarning

    def formatted(message: Warning | str, category: type[Warning], *place: Any) -> str:
        return f"warning: {message}\n" if category is UserWarning else original(message, category, *place)

    warnings.formatwarning = formatted  # type: ignore[assignment]
    try:
        yield
    finally:
        warnings.formatwarning = original


@contextlib.contextmanager
def telling() -> Iterator[None]:
    """Has stdout and stderr of this process as streams that end no training, while the context lasts."""
    _open_standard_files()
    before = sys.stdout, sys.stderr
    out, err = (stream or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w") for stream in before)
    sys.stdout, sys.stderr = cast(TextIO, Telling(out, must=True)), cast(TextIO, Telling(err, must=False))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before[0] or out, before[1] or err


def _open_standard_files() -> None:
    """Take the numbers of stdin, stdout and stderr where they are closed, lest a file of ours get one of them."""
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(handle)


def tell(text: str, *, kept: str) -> None:
    """Print what also stands in a file: that stdout cannot be written to is only said then.

    Raises:
        BrokenPipeError: the reader has left.
    """
    try:
        print(text, flush=True)
    except PgtsError as error:
        print(f"warning: {error}; it stands in {kept}", file=sys.stderr)
