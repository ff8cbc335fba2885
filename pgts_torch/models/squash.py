"""Actions that are vectors of any real numbers, squashed into the bounds of a Box."""

from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.models.snapshots import env_name

_WIDEST = 1e30
"""Bounds that are farther apart say that there are none, as the largest number of a type does."""


@final
class Squash:
    """From R^X into the bounds of a Box, in float64, and then in the dtype of the Box:

        a = low + (high - low) (tanh(x) + 1) / 2        where both bounds are finite,      a = x        where none is

    and never beyond a bound by rounding.

    Log densities of a and of x differ by a function of x alone, so that ratios of two densities, and KL divergences
    between two, are the same of both.

    size: X, the number of entries of an action.

    Args:
        space: of the actions.
        name: of the environment, in errors.

    Raises:
        PgtsError: the space is no Box of floating numbers, has no entries, or one with a single finite bound, or with
            bounds so far apart that they cannot be meant.
    """

    def __init__(self, space: spaces.Space, name: str) -> None:
        if not isinstance(space, spaces.Box) or space.dtype.kind != "f":
            raise PgtsError(
                f"the actions of {name} are {space}; policy.type gaussian needs continuous ones, a Box of floats"
            )
        low, high = (bound.astype(np.float64).reshape(-1) for bound in (space.low, space.high))
        self._bounded = np.isfinite(low) & np.isfinite(high)
        half = np.flatnonzero(np.isfinite(low) != np.isfinite(high))
        if len(half):
            raise PgtsError(
                f"entry {half[0]} of the actions of {name} is bounded on one side, by {low[half[0]]:g} and "
                f"{high[half[0]]:g}; policy.type gaussian needs two bounds or none: give two by a wrapper"
            )
        if not len(low):
            raise PgtsError(f"the actions of {name} are {space}, which has no entries")
        wide = np.flatnonzero(self._bounded & (high / 2 - low / 2 > _WIDEST / 2))
        if len(wide):
            raise PgtsError(
                f"entry {wide[0]} of the actions of {name} is bounded by {low[wide[0]]:g} and {high[wide[0]]:g}, over "
                "which policy.type gaussian would spread its actions: declare bounds that are meant, or none, inf"
            )
        self.size, self._shape, self._dtype = len(low), space.shape, space.dtype
        self._low, self._high = low, high
        # 0 and 1 where there are no bounds, whose infinities would make NaN.
        self._origin, self._width = np.where(self._bounded, low, 0.0), np.where(self._bounded, high - low, 1.0)

    def actions(self, vector_NX: Float[np.ndarray, "*N X"]) -> np.ndarray:
        """The actions, as the environment takes them, of these vectors."""
        vector_NX = np.asarray(vector_NX, np.float64)
        share_NX = (np.tanh(vector_NX) + 1) / 2
        action_NX = np.where(self._bounded, self._origin + self._width * share_NX, vector_NX)
        bounded_NX = action_NX.clip(self._low, self._high)
        return bounded_NX.astype(self._dtype).reshape(vector_NX.shape[:-1] + self._shape)

    def of_tensors(self, vector_NX: Float[Tensor, "N X"]) -> Tensor:
        """The same in operations of torch, which can be traced."""
        numbers = self._low, self._high, self._origin, self._width, self._bounded
        low_X, high_X, origin_X, width_X, bounded_X = map(torch.as_tensor, numbers)
        vector_NX = vector_NX.double()
        action_NX = torch.where(bounded_X, origin_X + width_X * (vector_NX.tanh() + 1) / 2, vector_NX)
        action_NX = action_NX.clamp(low_X, high_X)
        return action_NX.to(torch.from_numpy(np.empty(0, self._dtype)).dtype).reshape(-1, *self._shape)


@final
class Squashed(gymnasium.ActionWrapper):
    """An environment whose actions are any vectors of X real numbers.

    Raises:
        PgtsError: as `Squash`.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.squash = Squash(env.action_space, env_name(env))
        self.action_space = spaces.Box(-np.inf, np.inf, (self.squash.size,), np.float32)

    def action(self, action: Any) -> Any:
        return self.squash.actions(action)


def squash_of(env: gymnasium.Env) -> Squash | None:
    """What squashes the actions of an environment; None where they are numbers."""
    return env.squash if isinstance(env, Squashed) else None
