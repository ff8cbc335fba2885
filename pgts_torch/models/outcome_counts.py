"""Counts of what followed states and actions, in memory that grows with the distinct outcomes alone."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.errors import PgtsError


@final
@dataclass(frozen=True, eq=False)
class OutcomeCounts:
    """C distinct outcomes, sorted by pair, next state and discount. A pair is state * A + action.

    The mean reward of an outcome is base + excess / count, where base is its first reward and excess the sum of the
    others' differences from it: so the mean of equal rewards is that reward, bit for bit.
    """

    pair_C: Int[np.ndarray, "C"]
    next_C: Int[np.ndarray, "C"]
    discount_C: Float[np.ndarray, "C"]
    count_C: Int[np.ndarray, "C"]
    base_C: Float[np.ndarray, "C"]
    excess_C: Float[np.ndarray, "C"]

    @classmethod
    def nothing(cls) -> Self:
        """No outcomes."""
        integer, real = np.empty(0, dtype=np.int64), np.empty(0)
        return cls(integer, integer, real, integer, real, real)

    @property
    def reward_C(self) -> Float[np.ndarray, "C"]:
        """The mean reward of each outcome."""
        return self.base_C + self.excess_C / self.count_C

    @cached_property
    def size_P(self) -> Int[np.ndarray, "P"]:
        """How many outcomes each of the visited pairs has had, in the order of pairs."""
        return np.unique(self.pair_C, return_counts=True)[1]

    @property
    def most(self) -> int:
        """The largest number of outcomes that a pair has had; 1 where nothing was seen."""
        return int(self.size_P.max(initial=1))

    @cached_property
    def num_repeated(self) -> int:
        """How many pairs were visited more than once."""
        first_P = np.cumsum(self.size_P) - self.size_P
        return int((np.add.reduceat(self.count_C, first_P) > 1).sum()) if len(first_P) else 0

    def summed(self, column_C: np.ndarray) -> np.ndarray:
        """Of each outcome, the sum of a column over all outcomes of its pair."""
        if not len(column_C):
            return column_C
        return np.repeat(np.add.reduceat(column_C, np.cumsum(self.size_P) - self.size_P), self.size_P)

    def visits(self, pair: int) -> int:
        """How often a pair was visited."""
        first, last = self.pair_C.searchsorted([pair, pair + 1])
        return int(self.count_C[first:last].sum())

    def with_steps(self, pair_N: np.ndarray, next_N: np.ndarray, discount_N: np.ndarray, reward_N: np.ndarray) -> Self:
        """These outcomes and N more steps."""
        C = len(self.pair_C)
        pair_M, next_M = np.append(self.pair_C, pair_N), np.append(self.next_C, next_N)
        discount_M = np.append(self.discount_C, discount_N)
        # Stable: first an outcome that was seen before, then its steps in the order in which they happened.
        order_M = np.lexsort((discount_M, next_M, pair_M))
        is_first_M = np.zeros(len(order_M), dtype=bool)
        is_first_M[:1] = True
        for column_M in (pair_M[order_M], next_M[order_M], discount_M[order_M]):
            is_first_M[1:] |= column_M[1:] != column_M[:-1]
        row_M = np.empty(len(order_M), dtype=np.int64)  # of each old outcome and step, its row in the new table
        row_M[order_M] = np.cumsum(is_first_M) - 1
        first_D = order_M[is_first_M]
        base_D = np.append(self.base_C, reward_N)[first_D]
        count_D, excess_D = np.zeros(len(first_D), dtype=np.int64), np.zeros(len(first_D))
        count_D[row_M[:C]], excess_D[row_M[:C]] = self.count_C, self.excess_C
        # One addition after the other, so that many calls add up to the bits of one.
        np.add.at(count_D, row_M[C:], 1)
        np.add.at(excess_D, row_M[C:], reward_N - base_D[row_M[C:]])
        return type(self)(pair_M[first_D], next_M[first_D], discount_M[first_D], count_D, base_D, excess_D)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the columns."""
        return {name: torch.from_numpy(getattr(self, name).copy()) for name in self.__dataclass_fields__}

    @classmethod
    def from_state_dict(cls, state: dict[str, Any], num_states: int, num_actions: int) -> Self:
        """The counts that `state_dict` returned; PgtsError if they are none of so many states and actions."""
        columns = {}
        for name, empty in cls.nothing().state_dict().items():
            column = state.get(name)
            if not isinstance(column, Tensor) or column.ndim != 1 or column.dtype != empty.dtype:
                raise PgtsError(f"{name} of the counts is no vector of {empty.dtype}")
            columns[name] = column.cpu().numpy().copy()
        if len({len(column) for column in columns.values()}) > 1:
            raise PgtsError(f"the counts have columns of {[len(column) for column in columns.values()]} rows")
        counts = cls(**columns)
        order_C = np.lexsort((counts.discount_C, counts.next_C, counts.pair_C))
        for name, fits_C in {
            "pair_C": (counts.pair_C >= 0) & (counts.pair_C < num_states * num_actions),
            "next_C": (counts.next_C >= 0) & (counts.next_C < num_states),
            "discount_C": (counts.discount_C >= 0) & (counts.discount_C <= 1),
            "count_C": counts.count_C > 0,
            "base_C": np.isfinite(counts.base_C),
            "excess_C": np.isfinite(counts.excess_C),
            "the order": order_C == np.arange(len(order_C)),
        }.items():
            if not fits_C.all():
                raise PgtsError(
                    f"{name} of the counts is wrong in row {int(np.argmin(fits_C))}; they are of {num_states} states "
                    f"and {num_actions} actions"
                )
        return counts
