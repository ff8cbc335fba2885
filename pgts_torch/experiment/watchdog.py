"""A watch over a training: it ends the process where one call, such as a step of an environment, does not return."""

import faulthandler
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import CodeType, FrameType
from typing import Self, final

from pgts_torch.errors import LOST
from pgts_torch.ranks import Ranks

PERIOD = 5.0
"""The most seconds between two looks at the training."""

SUSPICIOUS = 1 / 4
"""The share of the time limit after which a call at the same instruction may be one that hangs."""

_PACKAGE = __name__.partition(".")[0]
_WAITS = f"{_PACKAGE}.exchange"

_ACTIVITIES = {
    "agent.make_world": "while environments were made",
    "agent.visit": "in its episodes",
    "agent.policy_lookahead": "in the lookahead",
    "agent.dyna": "in imagined episodes",
    "agent.model_check": "in the check of the model",
    "agent.evaluate": "in an evaluation",
    "experiment.checkpoint": "in a checkpoint",
}
"""What a process is doing that is in one of these modules."""


@final
class Watchdog:
    """Ends the process, with one line and the exit code `LOST`, once the thread that made this has been in one call for
    `seconds`, or a third longer. Use it as a context.

    A second thread looks where the first one is: in which call of a function of this package, and at which instruction
    of it. While both stay the same, what was called there has not returned. So the training itself does nothing for it.
    Waiting for other processes is no hang: they have watchdogs of their own. Looks are counted, not seconds, so that a
    process that was stopped for a while (Ctrl-Z) does not hang.

    A call that does not even let other threads run (of C code that holds the interpreter's lock) is ended by
    `faulthandler`, with a traceback in place of the line and exit code 1. It cannot tell a process that was stopped.

    Under torchrun the thread also notices that the process is an orphan, and ends it as SIGTERM would.

    Args:
        ranks: who this process is.
    """

    def __init__(self, seconds: float, ranks: Ranks) -> None:
        self._seconds, self._ranks = seconds, ranks
        self._period = min(PERIOD, seconds / 10)
        self._watched = threading.get_ident()
        self._parent = os.getppid() if "TORCHELASTIC_RUN_ID" in os.environ else None
        self._place: tuple[CodeType, int] | None = None
        self._call: FrameType | None = None
        self._looks = 0
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> Self:
        self._postpone()  # so that a call before the first look is ended too
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._left.set()
        self._thread.join()
        self._call = None

    def _watch(self) -> None:
        try:
            while not self._left.wait(self._period):
                if self._parent is not None and os.getppid() != self._parent:
                    self._parent = None
                    os.kill(os.getpid(), signal.SIGTERM)
                self._postpone()
                if self._looks_in_one_call() * self._period >= self._seconds:
                    self._end()
        finally:
            faulthandler.cancel_dump_traceback_later()

    def _postpone(self) -> None:
        """Have the process ended by `faulthandler` unless this is called again in time."""
        faulthandler.dump_traceback_later(self._seconds + self._period, exit=True, file=2)

    def _looks_in_one_call(self) -> int:
        """Look at the training: for how many looks it has been in the same call; 0 where it waits for others.

        To know a call again its frame must be kept, and with it the variables of all functions that have called it. So
        that happens only where it has been at the same instruction for long, in this call or others.
        """
        frame = next(_own(sys._current_frames().get(self._watched)), None)
        if frame is None or frame.f_globals["__name__"] == _WAITS:
            self._place = self._call = None
            return 0
        place = frame.f_code, frame.f_lasti
        if place != self._place:
            self._place, self._call, self._looks = place, None, 0
        elif self._call is not None and frame is not self._call:
            self._call, self._looks = frame, 0
        else:
            self._looks += 1
        if self._call is None and self._looks * self._period >= SUSPICIOUS * self._seconds:
            self._call, self._looks = frame, 0
        return 0 if self._call is None else self._looks

    def _end(self) -> None:
        innermost = sys._current_frames()[self._watched]
        modules = [frame.f_globals["__name__"].removeprefix(f"{_PACKAGE}.") for frame in _own(innermost)]
        activity = next((_ACTIVITIES[name] for name in reversed(modules) if name in _ACTIVITIES), "in the training")
        who = "the process" if self._ranks.size == 1 else f"rank {self._ranks.rank} of {self._ranks.size}"
        code = innermost.f_code
        where = f"{code.co_name} in line {innermost.f_lineno} of {code.co_filename}"
        line = (
            f"error: {who} hangs {activity}: {where} has not come back for {self._seconds:g} s (run.timeout); --resume "
            "goes on from the last checkpoint\n"
        )
        os.write(2, ("\n" * os.isatty(2) + line).encode(errors="backslashreplace"))  # the stream may be what hangs
        os._exit(LOST)


def _own(frame: FrameType | None) -> Iterator[FrameType]:
    """The frames of this package among a frame and its callers, the innermost first."""
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] == _PACKAGE:
            yield frame
        frame = frame.f_back
