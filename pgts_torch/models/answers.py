"""What a simulator has answered: remembered where no chance was involved, as long as it takes little memory."""

import itertools
import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pgts_torch.models.snapshots import Snapshot

_MOST_BYTES = 2**28
"""All answers are dropped once they take more memory than this, roughly."""

_BYTES_OF_AN_ANSWER, _MEASURED = 500, 100
"""What an answer takes beside the state that it led to and its observation; of how many answers these are measured."""

Query = tuple[bytes, int, int]
"""The key of a snapshot, an action, and how often it is taken."""


@dataclass(slots=True)
class Seen:
    """A state, and what `observe` made of its observation: None while that is not known."""

    snapshot: Snapshot
    observation: Any = None


@dataclass(slots=True)
class Step:
    """What followed an action.

    random: whether something else may follow under another key; None: not known yet.
    """

    reward: float
    discount: float
    child: Seen
    random: bool | None


def take_much_memory(steps: dict[Query, Step]) -> bool:
    """Whether answers should be dropped, by the mean size of some of them."""
    some = list(itertools.islice(steps.values(), 0, None, math.ceil(len(steps) / _MEASURED) or 1))
    return bool(some) and sum(map(_bytes_of, some)) / len(some) * len(steps) > _MOST_BYTES


def observed(observation: Any, observe: Callable[[Any], Any] | None) -> Any:
    """What is remembered of an observation: a copy, because an environment may write into its arrays."""
    return copied(observe(observation) if observe else observation)


def copied(observation: Any) -> Any:
    """The same in arrays and lists of its own."""
    if type(observation) is np.ndarray:
        return observation.copy()
    if isinstance(observation, dict):
        return {name: copied(part) for name, part in observation.items()}
    if isinstance(observation, tuple):
        return tuple(map(copied, observation))
    return observation.copy() if isinstance(observation, np.ndarray | list) else observation


def _bytes_of(step: Step) -> int:
    """The memory that an answer takes."""
    snapshot, observation = step.child.snapshot, step.child.observation
    return _BYTES_OF_AN_ANSWER + len(snapshot.key) + len(pickle.dumps(snapshot.data)) + _bytes_of_arrays(observation)


def _bytes_of_arrays(observation: Any) -> int:
    if isinstance(observation, dict | tuple):
        return sum(map(_bytes_of_arrays, observation.values() if isinstance(observation, dict) else observation))
    return np.asarray(observation).nbytes
