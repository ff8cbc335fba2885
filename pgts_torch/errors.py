"""The errors that a caller can cause. Each message names the culprit, its value and what is required."""


class PgtsError(ValueError):
    """Something that the caller gave cannot be used."""


class NodeBudgetExceeded(PgtsError):
    """A lookahead would need more nodes than its budget allows."""


class MissingModel(PgtsError):
    """An environment offers no model that a lookahead could ask."""


class RandomOutcomes(PgtsError):
    """A model that lists outcomes where it is certain of them was asked where chance decides."""


class Stopped(Exception):
    """A signal has ended a training early; what was learned is saved.

    Args:
        message: what can be done about it.
        signal: its number.
    """

    def __init__(self, message: str, signal: int) -> None:
        super().__init__(message)
        self.signal = signal
