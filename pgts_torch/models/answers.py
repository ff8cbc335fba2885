"""What a simulator has answered: remembered where no chance was involved, as long as it takes little memory."""

import gc
import itertools
import math
import pickle
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, final

import numpy as np

from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.snapshots import Reading, Snapshot

_MOST_BYTES = 2**28
"""All answers are dropped once they take more memory than this, roughly."""

_BYTES_OF_AN_ANSWER, _MEASURED = 500, 50
"""What an answer takes beside the state that it led to and its observation; of how many states the
answers are measured."""

_NOTHING: Mapping[int, Any] = MappingProxyType({})

Query = tuple[Hashable, int]
"""The name of a snapshot, or its key where the clock does not matter; and how often each action is taken."""


@dataclass(slots=True)
class Seen:
    """A state, and what `observe` made of its observation: None while that is not known.

    like: the same state at another count of steps, which has the same observation.
    legal: a byte for each action, 1 where it is legal; None: it is not known, or there are no action masks.
    """

    snapshot: Snapshot
    observation: Any = None
    like: "Seen | None" = None
    legal: bytes | None = None


@dataclass(slots=True)
class Step:
    """What followed an action.

    random: whether something else may follow under another key; None: not known yet.
    reading: of the clock; None: there is none, or this is what follows at this count only.
    """

    reward: float
    discount: float
    child: Seen
    random: bool | None
    reading: Reading | None = None


@final
class Answers:
    """Steps that no chance decides, by what was queried.

    Where there is a clock they are remembered without it, so that a step is made once for all counts.

    Args:
        at_count: what a step is if the clock is at another count after it (`Stepper.at_count`); None: there is none.
    """

    def __init__(self, at_count: Callable[[Step, int, RewardRange | None], Step] | None) -> None:
        self._at_count = at_count
        self._rows: dict[Query, dict[int, Step]] = {}
        # By the key of a snapshot: the first state with that key, where there is a clock.
        self._first: dict[bytes, Seen] = {}

    def clear(self) -> None:
        self._rows.clear()
        self._first.clear()

    def clear_if_large(self) -> None:
        """Drop all if they take much memory, by the mean size of some of them."""
        rows = self._rows
        some = itertools.islice(rows.values(), 0, None, math.ceil(len(rows) / _MEASURED) or 1)
        sizes = [sum(map(_bytes_of, row.values())) for row in some]
        if sizes and sum(sizes) / len(sizes) * len(rows) > _MOST_BYTES:
            self.clear()

    def name(self, at: Snapshot) -> Hashable:
        """What the answers of a state are remembered by: without the clock, where there is one."""
        return at.key if at.clock is None or self._at_count else at.name

    def known(self, at: Snapshot, repeat: int, rewards: RewardRange | None) -> Mapping[int, Step]:
        """What follows each action in a state of which that is known.

        Args:
            repeat: how often each action is taken.
            rewards: between which numbers the rewards must be.
        """
        if self._at_count is None:
            return self._rows.get((at.key if at.clock is None else at.name, repeat), _NOTHING)
        row = self._rows.get((at.key, repeat), _NOTHING)
        # What is true at one count only is remembered by the count, too.
        alone = self._rows.get((at.name, repeat), _NOTHING)
        return {**alone, **{action: self._now(step, at, rewards) for action, step in row.items()}}

    def _now(self, step: Step, at: Snapshot, rewards: RewardRange | None) -> Step:
        """What was found at some count, at that of this state."""
        assert self._at_count is not None
        assert at.clock is not None
        after = at.clock + 1
        return step if after == step.child.snapshot.clock else self._at_count(step, after, rewards)

    def remember(self, at: Snapshot, action: int, repeat: int, step: Step) -> None:
        """Keep a step beside which nothing else may follow."""
        name = at.key if at.clock is None or (self._at_count and step.reading is not None) else at.name
        if (row := self._rows.get((name, repeat))) is None:
            row = self._rows[name, repeat] = {}
        row[action] = step
        if step.reading is not None:
            first = self._first.setdefault(step.child.snapshot.key, step.child)
            step.child.like = None if first is step.child else first


@contextmanager
def without_collector() -> Iterator[None]:
    """Python's collector of cycles waits in this context, where a batch of answers is made. They are kept, so it would
    look through all that is remembered and find nothing, which takes longer than many steps."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


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
