"""A ring of what was seen, from which training samples."""

import os
import pickle
from collections.abc import Sequence
from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import MemoryBudgetExceeded, PgtsError, check_count

Column = Tensor | Sequence[Any]
"""One entry for each row: a tensor, or a sequence of other objects, as snapshots."""


def _memory() -> int:
    """The memory of the machine, in bytes; where that is not known, what a process can address."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 2**47


@final
class ReplayBuffer:
    """The last `capacity` rows of some columns, sampled uniformly with replacement (Lin 1992).

    The columns and their types are those of the first call of `add`, which may add none. Memory is taken then.

    num_added: the number of all rows so far.
    """

    def __init__(self, capacity: int) -> None:
        check_count("capacity", capacity)
        self.capacity, self.num_added = capacity, 0
        self._columns: dict[str, Tensor | list[Any]] = {}

    def __len__(self) -> int:
        return min(self.num_added, self.capacity)

    @torch.inference_mode(False)
    @torch.no_grad()
    def add(self, **columns: Column) -> None:
        """Add rows, in place of the oldest ones where there is no more room.

        Raises:
            PgtsError: columns of different lengths, or not those of the first rows.
            MemoryBudgetExceeded: `capacity` rows take more memory than the machine has; nothing is added. That is known
                with the first rows.
        """
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) != 1:
            raise PgtsError(f"the columns have {lengths} rows; they must have the same number")
        if self.num_added == 0:
            self._check_memory(columns, next(iter(lengths.values())))
        if not self._columns:
            self._columns = {name: self._room(column) for name, column in columns.items()}
        if columns.keys() != self._columns.keys():
            raise PgtsError(f"the columns are {sorted(columns)}; in this buffer they are {sorted(self._columns)}")
        count = next(iter(lengths.values()))
        first = max(0, count - self.capacity)  # rows before it would be replaced in this very call
        at_N = (torch.arange(first, count) + self.num_added) % self.capacity
        for name, column in columns.items():
            ring, new = self._columns[name], column[first:]
            if isinstance(ring, Tensor):
                ring[at_N] = torch.as_tensor(new).to(ring)
                continue
            for at, item in zip(at_N.tolist(), new, strict=True):
                ring[at] = item
        self.num_added += count

    def sample(self, count: int, *, generator: torch.Generator) -> Int[Tensor, "N"]:
        """Sample the positions of rows."""
        return torch.randint(len(self), (count,), generator=generator, device=generator.device).cpu()

    def rows(self, name: str, at_N: Int[Tensor, "N"] | None = None) -> Any:
        """The entries of a column at some positions; None: all, in the order of the ring."""
        ring = self._columns[name]
        if at_N is None:
            return ring[: len(self)]
        return ring[at_N] if isinstance(ring, Tensor) else [ring[at] for at in at_N.tolist()]

    def state_dict(self) -> dict[str, Any]:
        """Return the rows, without empty room."""
        columns = {name: self.rows(name) for name in self._columns}
        copied = {name: column.clone() if isinstance(column, Tensor) else column for name, column in columns.items()}
        return {"num_added": self.num_added, "columns": copied}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` of a buffer with the same capacity returned.

        Raises:
            PgtsError: it is something else; nothing is loaded.
        """
        if set(state) != {"num_added", "columns"} or not isinstance(state["columns"], dict):
            raise PgtsError(f"the state of a replay buffer is num_added and columns; this one has {sorted(state)}")
        check_count("num_added", state["num_added"], least=0)
        length = min(state["num_added"], self.capacity)
        for name, column in state["columns"].items():
            if len(column) != length:
                raise PgtsError(f"the column {name} has {len(column)} rows; after {state['num_added']} it has {length}")
        self._columns = {name: self._room(column) for name, column in state["columns"].items()}
        self.num_added = state["num_added"]
        for name, column in state["columns"].items():
            self._columns[name][:length] = column

    def _check_memory(self, columns: dict[str, Column], count: int) -> None:
        """MemoryBudgetExceeded if all rows would take more memory than there is; objects take as much as pickled."""
        needed, most = 0, _memory()
        for column in columns.values():
            if isinstance(column, Tensor):
                needed += self.capacity * column[:0].new_empty(1, *column.shape[1:]).nbytes
            else:
                needed += self.capacity * (8 + (len(pickle.dumps(list(column))) // count if count else 0))
        if needed > most:
            raise MemoryBudgetExceeded(
                f"capacity is {self.capacity:,}; so many rows take {needed:,} bytes, and the machine has {most:,}: set "
                "a smaller one (replay.capacity)"
            )

    def _room(self, column: Column) -> Tensor | list[Any]:
        if isinstance(column, Tensor):
            return torch.zeros(self.capacity, *column.shape[1:], dtype=column.dtype)
        return [None] * self.capacity
