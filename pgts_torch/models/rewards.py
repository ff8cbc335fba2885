"""The range of rewards that a user or an environment declares, and the bounds of values that follow."""

import math
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from pgts_torch.errors import ModelMismatch, PgtsError

_SLACK = 1e-6
"""In units of a bound: by how much a reward may be outside of it, because it may have been stored in float32."""


@final
@dataclass(frozen=True)
class RewardRange:
    """A declaration that every reward of a single step lies in [low, high]; one outside is an error."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not -math.inf < self.low <= self.high < math.inf:
            raise PgtsError(f"reward_range is [{self.low}, {self.high}]; it must be two finite numbers, ascending")

    @classmethod
    def of(cls, given: Any) -> "RewardRange":
        """The range between two numbers; PgtsError if these are none."""
        try:
            low, high = map(float, given)
        except (TypeError, ValueError):
            raise PgtsError(
                f"reward_range is {given!r}; it must be two numbers, the lowest reward and the highest"
            ) from None
        return cls(low, high)

    def values(self, gamma: float) -> tuple[float, float]:
        """The lowest and the highest value that a state can have (`value_range`)."""
        return value_range(self._wide, gamma)

    def check(self, reward_N: Any) -> None:
        """ModelMismatch if one of these rewards is outside; -inf stands for an action that is not allowed."""
        reward_N = np.asarray(reward_N, dtype=np.float64)
        low, high = self._wide
        off_N = (reward_N > high) | ((reward_N < low) & (reward_N > -math.inf))
        if off_N.any():
            raise ModelMismatch(
                f"a reward is {reward_N[off_N].flat[0]:g}; reward_range says that all are from {self.low:g} to "
                f"{self.high:g}"
            )

    @property
    def _wide(self) -> tuple[float, float]:
        """The range with its slack. 0 stays 0, so that costs alone cannot have a positive sum."""
        return self.low - _SLACK * abs(self.low), self.high + _SLACK * abs(self.high)


def value_range(reward_range: tuple[float, float], gamma: float) -> tuple[float, float]:
    """The values that a state can have if all rewards are in [low, high], and 0 after an end:

    min(0, low) / (1 - gamma)  to  max(0, high) / (1 - gamma),        infinite where gamma is 1, 0 where it is 0 / 0
    """
    low, high = min(0.0, reward_range[0]), max(0.0, reward_range[1])
    if gamma >= 1:
        return -math.inf if low < 0 else 0.0, math.inf if high > 0 else 0.0
    return low / (1 - gamma), high / (1 - gamma)
