"""Signals that end a training, but not in the middle of an iteration."""

import os
import signal
import threading
from collections.abc import Callable, Iterable
from types import FrameType, TracebackType
from typing import Any, Self, final

SIGNALS = (signal.SIGTERM, signal.SIGINT)


@final
class StopFlag:
    """Remembers the first signal; a second one ends the process at once, with exit code 128 + signal.

    Use it as a context: leaving it restores what the signals did before. Outside the main thread, where Python hears
    no signals, it remembers nothing.

    Args:
        signals: which are heard.
        at_once: called before a second one ends the process.

    Attributes:
        signal: the number of the first one; None: there was none.
    """

    def __init__(
        self, signals: Iterable[signal.Signals] = SIGNALS, *, at_once: Callable[[], object] = lambda: None
    ) -> None:
        self.signal: int | None = None
        self._signals, self._at_once = tuple(signals), at_once
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {each: signal.signal(each, self._hear) for each in self._signals}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            self._at_once()
            os._exit(128 + number)
        self.signal = number
