"""Signals that end a training, but not in the middle of an iteration."""

import os
import re
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self, final

_HANG_UP = getattr(signal, "SIGHUP", None)
"""The terminal is gone; None where the platform has no such signal."""


@final
class StopFlag:
    """Records the first signal; a second one ends the process at once, with exit code 128 + signal.

    Handles SIGTERM, SIGINT and SIGHUP. SIGHUP is left alone where it is ignored (as under nohup) or handled by C code
    (`faulthandler.register`, detected on Linux), and a second one is ignored: a closing terminal may send two.
    SIGTERM and SIGINT are always handled: SDL, which pygame starts, would swallow them.

    Use it as a context: leaving it restores the previous handlers, but those of C code are lost, for Python does not
    know them. Outside the main thread, where Python receives no
    signals, it records nothing.

    Args:
        at_once: called before a second signal ends the process.

    Attributes:
        signal: the number of the first signal; None: there was none.
    """

    def __init__(self, *, at_once: Callable[[], object] = lambda: None) -> None:
        self.signal: int | None = None
        self._at_once = at_once
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            heard = [signal.SIGTERM, signal.SIGINT]
            if _HANG_UP is not None and signal.getsignal(_HANG_UP) is not signal.SIG_IGN and not _is_foreign(_HANG_UP):
                heard.append(_HANG_UP)
            self._before = {each: signal.signal(each, self._on_signal) for each in heard}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for each, handler in self._before.items():
            signal.signal(each, signal.SIG_DFL if handler is None else handler)  # None: a handler of C code

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.signal is None:
            self.signal = number
        elif number != _HANG_UP:
            self._at_once()
            os._exit(128 + number)


def _is_foreign(number: signal.Signals) -> bool:
    """Whether a handler is installed that Python does not know of: it reports None, or believes that there is none."""
    if (known := signal.getsignal(number)) is None or callable(known):
        return known is None
    try:
        caught = re.search(r"^SigCgt:\s*(\w+)", Path("/proc/self/status").read_text(), re.MULTILINE)
    except OSError:
        return False
    return caught is not None and bool(int(caught[1], 16) >> (number - 1) & 1)
