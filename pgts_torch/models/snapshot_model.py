"""Models whose states are snapshots, numbered as they are met, equal ones with the same number."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.models.answers import copied
from pgts_torch.models.base import Model
from pgts_torch.models.snapshots import Snapshot


class SnapshotModel(Model):
    """Numbers snapshots, and remembers the observation of each state.

    Args:
        name: of the environment.
        space: of its observations.
        observe: what to remember of an observation; an array, or None for nothing. Default: all.
        device: where numbers lie.
    """

    def __init__(
        self, name: str, space: spaces.Space, observe: Callable[[Any], Any] | None, device: torch.device | str
    ) -> None:
        self.name, self._space, self._observe = name, space, observe
        self.device = torch.empty(0, device=device).device
        self.num_states = 0
        # By number: the snapshot of a state, and what `observe` made of its observation, None where that is unknown.
        self._snapshots: list[Snapshot] = []
        self._observations: list[Any] = []
        # By snapshot: the number.
        self._number: dict[tuple[bytes, bool], int] = {}

    def clear(self) -> None:
        """Drop all states. Their numbers are given to other states from here on."""
        self.generation += 1
        self.num_states = 0
        for kept in (self._snapshots, self._observations, self._number):
            kept.clear()

    def number(self, snapshot: Snapshot, observation: Any = None) -> int:
        """The number of a state: a new one if no equal state was met before."""
        number = self._known(snapshot, None)
        if observation is not None:
            self._observe_once(number, lambda: observation)
        return number

    def _observe_once(self, number: int, observation: Callable[[], Any]) -> None:
        """Remember the observation of a state, if none is known."""
        if self._observations[number] is None:
            made = observation()
            # Copied, because an environment may write into the arrays that it has returned.
            self._observations[number] = copied(self._observe(made) if self._observe else made)

    def _known(self, snapshot: Snapshot, seen: Any) -> int:
        """The number of a state with this observation (as `observe` has made it, or None)."""
        number = self._number.setdefault(snapshot.name, self.num_states)
        if number == self.num_states:
            self.num_states += 1
            self._snapshots.append(snapshot)
            self._observations.append(seen)
        elif self._observations[number] is None:
            self._observations[number] = seen
        return number

    def export(self, state_N: Int[Tensor, "N"]) -> list[tuple[Snapshot, Any]]:
        """The snapshot of each state and what `observe` made of its observation, for `adopt` in another process."""
        return [(self.snapshot(state), self._observations[state]) for state in state_N.tolist()]

    def adopt(self, exported: Iterable[tuple[Snapshot, Any]]) -> Int[Tensor, "N"]:
        """The numbers of states that another model of the same environment has exported."""
        return torch.tensor([self._known(*one) for one in exported], dtype=torch.int64, device=self.device)

    def snapshot(self, state: int) -> Snapshot:
        """The snapshot behind the number of a state."""
        self._check("state", state, self.num_states)
        return self._snapshots[state]

    def is_cut(self, state_N: Int[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Whether the episode was truncated in these states, so that no other step follows."""
        return torch.tensor([self._snapshots[state].cut for state in state_N.tolist()], device=self.device)

    def observations(self, state_N: Int[Tensor, "N"]) -> np.ndarray:
        """What `observe` made of the observation of each state, stacked: [N, ...].

        Without `observe` that is [N, *shape] of a Box, [N] of a Discrete space, and `gymnasium.spaces.flatten` of any
        other, in the dtype of the space.

        Raises:
            PgtsError: one of them is not known, because a root was given without it; or it cannot be flattened.
        """
        rows = [self._observation(state) for state in state_N.tolist()]
        if self._observe is None and not isinstance(self._space, spaces.Box | spaces.Discrete):
            try:
                rows = [spaces.flatten(self._space, row) for row in rows]
            except NotImplementedError:
                raise PgtsError(f"{self.name}: {self._space} cannot be flattened: give `observe`") from None
        return np.asarray(rows)

    def _observation(self, state: int) -> Any:
        self._check("state", state, self.num_states)
        if (seen := self._observations[state]) is None:
            raise PgtsError(f"{self.name}: the observation of state {state} was not given, or `observe` made it None")
        return seen

    def state_text(self, state: int) -> str:
        """With its observation, or else its snapshot."""
        seen = self._observations[state]
        what = repr(self._snapshots[state].key) if seen is None else np.array2string(np.asarray(seen), threshold=20)
        return f"state {state} ({what})"

    def _check(self, what: str, number: int, count: int) -> None:
        if not 0 <= number < count:
            raise PgtsError(f"{self.name}: {what} {number} does not exist; there are {count}, from 0 on")
