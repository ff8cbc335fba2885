"""The errors that a caller can cause. Each message names what is wrong, its value and what is required."""

import sys
import traceback
import warnings
from numbers import Integral
from pathlib import Path

LOST = 75
"""The exit code of a training whose process hangs, or has lost another one: the same command goes on."""


class PgtsError(ValueError):
    """An argument, a file or an environment of the caller cannot be used.

    rank: where several processes train together, the one in which it happened; None: this one.
    """

    rank: int | None = None


class NodeBudgetExceeded(PgtsError):
    """A lookahead would need more nodes than its budget allows."""


class MemoryBudgetExceeded(NodeBudgetExceeded):
    """A lookahead would need more memory than its budget allows."""


class MissingModel(PgtsError):
    """An environment offers no model that a lookahead could query."""


class RandomOutcomes(PgtsError):
    """A model that enumerates outcomes only where it is certain of them was queried where chance decides."""


class RankLost(PgtsError):
    """One of several processes that train together is gone, and so the others cannot go on."""


class NotFinite(PgtsError):
    """A number in training is infinite or NaN. The policy has not been updated with it.

    what: the kind of number: observation, state, reward, discount, value, lookahead, advantage, weight, probability,
        loss or gradient.
    """

    def __init__(self, message: str, *, what: str = "number") -> None:
        super().__init__(message)
        self.what = what


class Failed(PgtsError):
    """Code of the caller, such as an environment, raised an error or returned something invalid."""


class ModelMismatch(PgtsError):
    """A step of the environment is impossible in its model, or more or less frequent than the model says: one of the
    two is wrong, and so may be a lookahead. The policy has not been updated with it."""


def warn(text: str) -> None:
    """Warn the caller: a UserWarning at the line outside of this package, and of torch's decorators, that called it."""
    called = 1
    for level, (frame, _) in enumerate(traceback.walk_stack(sys._getframe(1)), start=2):
        if str(frame.f_globals.get("__name__")).partition(".")[0] in ("pgts_torch", "torch"):
            called = level
    warnings.warn(text, stacklevel=called + 1)


def text_of(error: BaseException) -> str:
    """The message of a PgtsError; for other errors also the name of their class. Some have no printable text, and of
    those without any, as of an assertion, the line is given that raised it."""
    if isinstance(error, PgtsError):
        return str(error)
    try:
        if not (text := str(error)) and (raised := traceback.extract_tb(error.__traceback__)):
            text = f"{raised[-1].line} ({Path(raised[-1].filename).name}, line {raised[-1].lineno})"
        return f"{type(error).__name__}: {text}"
    except Exception as unprintable:
        return f"{type(error).__name__}, whose text cannot be printed ({type(unprintable).__name__})"


def failure(where: str, error: BaseException) -> NotFinite | ModelMismatch | Failed:
    """Return an error whose message says where another one happened; NotFinite and ModelMismatch keep their class.

    SystemExit and the like are handled too, because environments raise them; KeyboardInterrupt is raised again.
    """
    if isinstance(error, KeyboardInterrupt):
        raise error
    if not isinstance(error, PgtsError):
        return Failed(f"{where}: {text_of(error)}")
    located: NotFinite | ModelMismatch | Failed
    if isinstance(error, NotFinite):
        located = NotFinite(f"{where}: {error}", what=error.what)
    else:
        located = (ModelMismatch if isinstance(error, ModelMismatch) else Failed)(f"{where}: {error}")
    located.rank = error.rank
    return located


class Stopped(Exception):
    """A signal has ended training early, after a checkpoint.

    Args:
        message: how to go on.
        signal: its number.
    """

    def __init__(self, message: str, signal: int) -> None:
        super().__init__(message)
        self.signal = signal


def check_count(name: str, value: float, *, least: int = 1) -> int:
    """The value; PgtsError unless it is a whole number of at least `least`."""
    if type(value) is int and value >= least:  # the others take longer to look at
        return value
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise PgtsError(f"{name} is {value!r}; it must be a whole number of at least {least}")
    return value
