"""Numbers of an update that stay where they are computed until all of them are read at once."""

import math
from collections.abc import Callable
from typing import final

import torch
from torch import Tensor


@final
class Readings:
    """Diagnostics, and numbers that are to be checked. A read waits for all work of a GPU, so there is one for all.

    means: the mean of the numbers added under each name; empty before `read`.
    """

    def __init__(self) -> None:
        self._added: dict[str, list[Tensor | float]] = {}
        self._checked: list[tuple[Tensor, Callable[[float], None], Callable[[float], bool]]] = []
        self.means: dict[str, float] = {}

    def add(self, **numbers: Tensor | float) -> None:
        """Add to the numbers of each name."""
        for name, number in numbers.items():
            self._added.setdefault(name, []).append(number.detach() if isinstance(number, Tensor) else number)

    def check(
        self, number: Tensor, refuse: Callable[[float], None], *, is_good: Callable[[float], bool] = math.isfinite
    ) -> None:
        """Check a number in `read`, by default whether it is finite.

        Args:
            refuse: called with the number if it is not good; it raises PgtsError unless it finds that nothing is wrong.
        """
        self._checked.append((number.detach(), refuse, is_good))

    def read(self) -> None:
        """Read all numbers.

        Raises:
            PgtsError: that of the earliest check that fails.
        """
        checked, added, self._checked, self._added = self._checked, self._added, [], {}
        waiting = [number for number, *_ in checked]
        waiting += [each for numbers in added.values() for each in numbers if isinstance(each, Tensor)]
        found = iter(torch.stack(waiting).tolist() if waiting else ())
        for (_, refuse, is_good), number in zip(checked, found, strict=False):
            if not is_good(number):
                refuse(number)
        for name, numbers in added.items():
            floats = [next(found) if isinstance(each, Tensor) else each for each in numbers]
            self.means[name] = sum(floats) / len(floats) if len(floats) > 1 else floats[0]
