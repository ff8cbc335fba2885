"""Output that cannot stop a training: a full disk or a closed terminal is survived."""

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Any, TextIO, cast

from pgts_torch.errors import PgtsError


class SafeStream:
    """A text stream that escapes characters outside its encoding and discards everything after a failed write.

    Args:
        stream: where the text goes.
        required: the text is the answer of the command, so losing it is an error: PgtsError, or BrokenPipeError where
            the reader has closed the pipe.
    """

    def __init__(self, stream: TextIO, *, required: bool) -> None:
        self._stream, self._required = stream, required

    def write(self, text: str) -> int:
        """Write text. PgtsError or BrokenPipeError where required text cannot be written."""
        encoding = self._stream.encoding or "utf-8"
        with self._failures():
            self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Flush the buffer; errors as in `write`."""
        with self._failures():
            self._stream.flush()

    @contextlib.contextmanager
    def _failures(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # ValueError: the stream is closed
            self._discard()
            if isinstance(error, BrokenPipeError) and self._required:
                raise
            if self._required:
                reason = getattr(error, "strerror", None) or error
                raise PgtsError(f"the answer cannot be written to stdout: {reason}") from error

    def _discard(self) -> None:
        """Send what is still in the buffer, and everything after it, to the null device."""
        with contextlib.suppress(OSError, ValueError):
            handle = os.open(os.devnull, os.O_WRONLY)
            os.dup2(handle, self._stream.fileno())
            os.close(handle)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def plain_warnings() -> Iterator[None]:
    """Print warnings to the user as one line, without the line of code that raised them."""
    original = warnings.formatwarning

    def formatted(message: Warning | str, category: type[Warning], *place: Any) -> str:
        return f"warning: {message}\n" if category is UserWarning else original(message, category, *place)

    warnings.formatwarning = formatted  # type: ignore[assignment]
    try:
        yield
    finally:
        warnings.formatwarning = original


@contextlib.contextmanager
def safe_output() -> Iterator[None]:
    """Replace stdout and stderr by `SafeStream`s while the context lasts."""
    _open_standard_files()
    before = sys.stdout, sys.stderr
    out, err = (stream or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w") for stream in before)
    sys.stdout, sys.stderr = cast(TextIO, SafeStream(out, required=True)), cast(TextIO, SafeStream(err, required=False))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before[0] or out, before[1] or err


def _open_standard_files() -> None:
    """Open closed file descriptors 0, 1 and 2 on the null device, so that no file of ours gets one of these numbers."""
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(handle)


def print_kept(text: str, *, kept: str) -> None:
    """Print text that is also in the file `kept`: a failed write is only a warning.

    Raises:
        BrokenPipeError: the reader has closed the pipe.
    """
    try:
        print(text, flush=True)
    except PgtsError as error:
        print(f"warning: {error}; it is in {kept}", file=sys.stderr)


def rank() -> int:
    """The rank of this process under torchrun, else 0; rank 0 prints."""
    return int(os.environ["RANK"]) if "TORCHELASTIC_RUN_ID" in os.environ else 0
