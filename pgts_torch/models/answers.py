"""What a simulator has answered: remembered where nothing was drawn, as long as it takes little memory."""

import sys
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from pgts_torch.models.snapshots import Snapshot

_MOST_BYTES = 2**28
"""What has been answered is forgotten once it takes more memory than this, roughly."""

_BYTES_OF_AN_ANSWER = 500
"""What an answer takes beside the state that it led to and what that shows."""

Asked = tuple[bytes, int, int]
"""The key of a snapshot, an action, and how often it is taken."""


@dataclass(frozen=True, slots=True)
class Step:
    """What an action gave. shown: what `observe` made of the observation. random: it may give something else under
    another key."""

    reward: float
    discount: float
    child: Snapshot
    shown: Any
    random: bool


@final
class Answers:
    """Steps by what was asked."""

    def __init__(self) -> None:
        self._steps: dict[Asked, Step] = {}
        self.get = self._steps.get
        self._bytes = 0

    def add(self, asked: Asked, step: Step) -> None:
        """Remember a step."""
        self._steps[asked] = step
        self._bytes += (
            _BYTES_OF_AN_ANSWER + len(step.child.key) + sys.getsizeof(step.child.data) + _bytes_of(step.shown)
        )

    def bound(self) -> None:
        """Forget all if it takes too much memory."""
        if self._bytes > _MOST_BYTES:
            self.forget()

    def forget(self) -> None:
        """Forget all."""
        self._steps.clear()
        self._bytes = 0


def copied(shown: Any) -> Any:
    """The same, in arrays and lists that nobody else holds."""
    if isinstance(shown, dict):
        return {name: copied(part) for name, part in shown.items()}
    if isinstance(shown, tuple):
        return tuple(map(copied, shown))
    return shown.copy() if isinstance(shown, np.ndarray | list) else shown


def _bytes_of(shown: Any) -> int:
    """The bytes of the arrays in what was shown."""
    if isinstance(shown, dict | tuple):
        return sum(map(_bytes_of, shown.values() if isinstance(shown, dict) else shown))
    return np.asarray(shown).nbytes
