"""What a simulator has answered: remembered where no chance was involved, as long as it takes little memory."""

import sys
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from pgts_torch.models.snapshots import Snapshot

_MOST_BYTES = 2**28
"""All answers are dropped once they take more memory than this, roughly."""

_BYTES_OF_AN_ANSWER = 500
"""What an answer takes beside the state that it led to and its observation."""

Query = tuple[bytes, int, int]
"""The key of a snapshot, an action, and how often it is taken."""


@dataclass(frozen=True, slots=True)
class Step:
    """What followed an action.

    observation: what `observe` made of it.   random: whether something else may follow under another key.
    """

    reward: float
    discount: float
    child: Snapshot
    observation: Any
    random: bool


@final
class Answers:
    """Steps by query."""

    def __init__(self) -> None:
        self._steps: dict[Query, Step] = {}
        self.get = self._steps.get
        self._bytes = 0

    def add(self, query: Query, step: Step) -> None:
        """Remember a step."""
        self._steps[query] = step
        self._bytes += (
            _BYTES_OF_AN_ANSWER + len(step.child.key) + sys.getsizeof(step.child.data) + _bytes_of(step.observation)
        )

    def bound(self) -> None:
        """Drop all if they take too much memory."""
        if self._bytes > _MOST_BYTES:
            self.clear()

    def clear(self) -> None:
        """Drop all."""
        self._steps.clear()
        self._bytes = 0


def copied(observation: Any) -> Any:
    """The same in arrays and lists of its own."""
    if isinstance(observation, dict):
        return {name: copied(part) for name, part in observation.items()}
    if isinstance(observation, tuple):
        return tuple(map(copied, observation))
    return observation.copy() if isinstance(observation, np.ndarray | list) else observation


def _bytes_of(observation: Any) -> int:
    """The bytes of its arrays."""
    if isinstance(observation, dict | tuple):
        return sum(map(_bytes_of, observation.values() if isinstance(observation, dict) else observation))
    return np.asarray(observation).nbytes
