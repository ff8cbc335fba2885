"""What a simulator has answered: remembered where no chance was involved, as long as it takes little memory."""

import itertools
import math
import pickle
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.snapshots import Reading, Snapshot

_MOST_BYTES = 2**28
"""All answers are dropped once they take more memory than this, roughly."""

_BYTES_OF_AN_ANSWER, _MEASURED = 500, 100
"""What an answer takes beside the state that it led to and its observation; of how many answers these are measured."""

Query = tuple[Hashable, int, int]
"""The name of a snapshot, or its key where the clock does not matter; an action, and how often it is taken."""


@dataclass(slots=True)
class Seen:
    """A state, and what `observe` made of its observation: None while that is not known.

    like: the same state at another count of steps, which has the same observation.
    """

    snapshot: Snapshot
    observation: Any = None
    like: "Seen | None" = None


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
        self._steps: dict[Query, Step] = {}
        # By the key of a snapshot: the first state with that key, where there is a clock.
        self._first: dict[bytes, Seen] = {}

    def clear(self) -> None:
        self._steps.clear()
        self._first.clear()

    def take_much_memory(self) -> bool:
        """Whether they should be dropped, by the mean size of some of them."""
        steps = self._steps
        some = list(itertools.islice(steps.values(), 0, None, math.ceil(len(steps) / _MEASURED) or 1))
        return bool(some) and sum(map(_bytes_of, some)) / len(some) * len(steps) > _MOST_BYTES

    def known(
        self,
        at: Snapshot,
        action: int,
        repeat: int,
        rewards: RewardRange | None,
        found: dict[Query, Step] | None = None,
    ) -> Step | None:
        """What follows an action, from memory; None: it is not known.

        Args:
            rewards: between which numbers the reward must be.
            found: more steps, that may turn out to be random.
        """
        step = self._steps.get((at.name, action, repeat))
        if step is None and self._at_count is not None:
            assert at.clock is not None
            query = at.key, action, repeat
            step = self._steps.get(query) or (found or {}).get(query)
            if step is not None and at.clock + 1 != step.child.snapshot.clock:
                return self._at_count(step, at.clock + 1, rewards)
        return step

    def remember(
        self, at: Snapshot, action: int, repeat: int, step: Step, found: dict[Query, Step] | None = None
    ) -> None:
        """Keep a step, or put it among those `found`, for `add`."""
        found = self._steps if found is None else found
        found[at.key if step.reading else at.name, action, repeat] = step
        if step.reading:
            first = self._first.setdefault(step.child.snapshot.key, step.child)
            step.child.like = None if first is step.child else first

    def add(self, found: dict[Query, Step]) -> None:
        """Keep these for good."""
        self._steps.update(found)


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
