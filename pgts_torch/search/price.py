"""What a lookahead will cost, foreseen from the first states that it queries."""

import math
from collections.abc import Callable
from typing import final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch import compiled

_FIRST, _FEW = 8, 32
"""How many states of a level are queried before the others: the first ones to warm up, the next ones to be measured."""


@final
class Meter:
    """Measures what a lookahead costs level by level, and foresees the rest before a step that takes long.

    Of a tree search it knows how many states can be queried at most. Else levels grow as they did so far, within the
    limits of the search: by a constant factor g where g has not fallen; where it has, by 1 + (g - 1) (l / j)^p at level
    j > l, as in a grid, where paths meet again.

    roots: how many states the latest search starts from.

    Args:
        tell: called once, before a step that takes longer than `patience`, or with which the iteration does, with the
            number of states that the model will have been queried for in this update, and the seconds of queries from
            now on.
        planned: how many levels the deepest search of an update expands; None: those of the one under way.
        patience: in seconds.   clock: returns seconds.
    """

    def __init__(
        self,
        tell: Callable[[float, float], None],
        planned: int | None,
        *,
        patience: float = 3.0,
        clock: Callable[[], float] = compiled.clock,
    ) -> None:
        self._tell, self._planned, self._patience, self._clock = tell, planned, patience, clock
        self._begun = clock()
        self.roots = 0
        self._sizes, self._levels, self._most, self._is_tree = list[int](), 0, math.inf, False
        self._fits: Callable[[float, float], bool] = lambda size, total: True
        self._rate, self._updates, self._has_told = math.inf, 0, False

    @property
    def seconds(self) -> float:
        """Since the iteration began, without what is done once: compiling, and what else the first query waits for."""
        return self._clock() - self._begun

    def update(self) -> None:
        """An update begins, which does not know what the last one has queried."""
        self._sizes, self._updates = [], self._updates + 1

    def search(
        self,
        roots: int,
        expansions: int,
        most: Callable[[int, int], float],
        fits: Callable[[float, float], bool],
        *,
        is_tree: bool,
    ) -> None:
        """A search begins.

        Args:
            most: the most states that are queried below so many roots in so many levels.
            fits: whether a level of so many states, after so many on those above it, is within the limits.
            is_tree: whether it does not go level by level.
        """
        self._levels, self._fits = max(self._planned or 0, expansions), fits
        self.roots, self._most, self._is_tree = roots, most(roots, self._levels), is_tree

    def query(
        self,
        state_N: Int[Tensor, "N"],
        ask: Callable[[Tensor], None],
        children: Callable[[Tensor], tuple[Tensor, Tensor]],
        *,
        known: int,
        divides: bool,
    ) -> None:
        """Query the model for the states of a level.

        Args:
            ask: queries it.
            children: the distinct states that follow queried ones, and those of them that were not queried.
            known: for how many states the model has been queried before, in this search and those that it knows of.
            divides: whether it may be queried for a few first.
        """
        if known <= 1:  # one alone is queried for the number of its outcomes
            self._sizes = []
        level, left, growth = len(self._sizes), state_N, None
        if divides and level <= 1 and len(state_N) > 2 * (_FIRST + _FEW):
            begun = self._clock()
            self._timed(ask, left[:_FIRST])
            first = self._clock() - begun
            probe, left = left[_FIRST : _FIRST + _FEW], left[_FIRST + _FEW :]
            self._timed(ask, probe)
            self._begun += max(0.0, first - self._rate * _FIRST)
            # States follow each other along episodes. Their children that were visited are no new states, but what
            # follows the others grows by all.
            follow, new = children(probe)
            growth = (len(new[~torch.isin(new, state_N)]) if level else len(follow)) / _FEW
        is_measured, seconds = level > 0 or growth is not None, self._rate * len(left)
        # More is known with each level: a short step is waited for.
        is_late = seconds > self._patience or (
            (level > 1 or self._updates > 1) and self.seconds + seconds > self._patience
        )
        if is_measured and is_late and not self._has_told:
            self._has_told = True
            sizes = [*self._sizes, len(state_N)]
            states = min(
                self._most,
                max(sum(sizes), math.inf if self._is_tree else _summed(sizes, growth, self._levels, self._fits)),
            )
            self._tell(states, self._rate * (states - sum(sizes) + len(left)))
        self._timed(ask, left)
        self._sizes.append(len(state_N))

    def _timed(self, ask: Callable[[Tensor], None], state_N: Tensor) -> None:
        begun = self._clock()
        ask(state_N)
        self._rate = (self._clock() - begun) / len(state_N)


def _summed(sizes: list[int], growth: float | None, levels: int, fits: Callable[[float, float], bool]) -> float:
    """How many states `levels` levels will have; a level that does not fit is halved until it does.

    Args:
        sizes: of the levels that are known.
        growth: how many states follow a state of the last one; None: as many as before.
    """
    last, power, (total, size) = len(sizes) - 1, 0.0, (float(sum(sizes)), float(sizes[-1]))
    if growth is None:
        growth = sizes[-1] / sizes[-2]
        before = sizes[-2] / sizes[-3] if last >= 2 else growth
        if before > growth > 1:
            power = math.log((before - 1) / (growth - 1)) / math.log(last / (last - 1))
    for level in range(last + 1, levels):
        size *= 1 + (growth - 1) * (last / level) ** power if power else growth
        while size > 1 and not fits(size, total):
            size /= 2
        total += size
    return total
