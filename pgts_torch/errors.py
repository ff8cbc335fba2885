"""The errors that a caller can cause. Each message names the culprit, its value and what is required."""


class PgtsError(ValueError):
    """Something that the caller gave cannot be used.

    rank: the process in which it happened, where several train together; None: in this one.
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
    """A number that training stands on is infinite or not a number. The policy has not been moved by it.

    what: which number: observation, state, reward, discount, value, lookahead, advantage, weight, probability, loss or
        gradient.
    """

    def __init__(self, message: str, *, what: str = "number") -> None:
        super().__init__(message)
        self.what = what


class Failed(PgtsError):
    """Something of the caller's, as an environment, raised an error or answered wrongly."""


class ModelMismatch(PgtsError):
    """The environment did what its model rules out, or not as often as the model says: one of the two is wrong, and a
    lookahead is not to be trusted. The policy has not been moved by it."""


def text_of(error: BaseException) -> str:
    """Kind and text of an error of the caller's, the text alone of one of ours. Some texts cannot be printed."""
    if isinstance(error, PgtsError):
        return str(error)
    try:
        return f"{type(error).__name__}: {error}"
    except Exception as unprintable:
        return f"{type(error).__name__}, whose text cannot be printed ({type(unprintable).__name__})"


def failure(where: str, error: BaseException) -> NotFinite | ModelMismatch | Failed:
    """The error that says where another one happened; NotFinite and ModelMismatch stay what they are.

    Also of SystemExit and the like, which environments raise too; only Ctrl-C is raised again, for it is the user's.
    """
    if isinstance(error, KeyboardInterrupt):
        raise error
    if not isinstance(error, PgtsError):
        return Failed(f"{where}: {text_of(error)}")
    story = f"{where}: {error}"
    told: NotFinite | ModelMismatch | Failed
    if isinstance(error, NotFinite):
        told = NotFinite(story, what=error.what)
    else:
        told = ModelMismatch(story) if isinstance(error, ModelMismatch) else Failed(story)
    told.rank = error.rank
    return told


class Stopped(Exception):
    """A signal has ended a training early; what was learned is saved.

    Args:
        message: what can be done about it.
        signal: its number.
    """

    def __init__(self, message: str, signal: int) -> None:
        super().__init__(message)
        self.signal = signal


def check_count(name: str, value: int, *, least: int = 1) -> None:
    """PgtsError unless it is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise PgtsError(f"{name} is {value!r}; it must be a whole number of at least {least}")
