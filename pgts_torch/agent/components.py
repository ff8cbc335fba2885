"""What observations are made of: the components of a space, and how they lie in a row.

A row is one observation as one array. A space that is a single component keeps its shape; of several, however nested,
the entries lie one after the other:

    Dict(at=Discrete(5), map=Box(0, 1, (2, 2)))   ->   Tuple(Discrete(5), Box(0, 1, (2, 2)))   ->   rows of 5 floats
"""

import math
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from pgts_torch.errors import PgtsError

Component = spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary | spaces.Box
Path = tuple[Any, ...]
"""The keys and indices that lead to a component of an observation, from the outside."""

_SMALLEST_FRAME = 16
"""From this height and width on bytes in two dimensions are an image; smaller ones are a board, or a table."""

_FREE: dict[str, type[np.generic]] = {
    "bool": np.uint8,
    "uint16": np.int32,
    "uint32": np.int64,
    "uint64": np.float64,
    "float16": np.float32,
    "float128": np.float64,
}
"""The dtypes in place of those that torch lacks, or computes with only in part."""


class ActionMask(spaces.MultiBinary):
    """The legal actions: the last component of a row, where there are masks. Networks do not see it as an input."""


def found_in(space: Space[Any], path: Path = ()) -> Iterator[tuple[Path, Space[Any]]]:
    """Yield what a space consists of, in its own order, each with its path; what is no `Component` too."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for step, part in parts:
            yield from found_in(part, (*path, step))
    else:
        yield path, space


def components(seen: Space[Any]) -> list[Component]:
    """Return the components of a row: those of a Tuple, else the one that it is.

    Raises:
        PgtsError: it is something else, as text, a graph or a nested space.
    """
    found: list[Component] = []
    for part in seen.spaces if isinstance(seen, spaces.Tuple) else [seen]:
        if not isinstance(part, Component):
            raise PgtsError(f"observations are {seen}; a network takes numbers, bits, vectors and images")
        found.append(part)
    return found


def inputs(seen: Space[Any]) -> list[Component]:
    """Return the components of a row that a network sees: all but the legal actions."""
    return [part for part in components(seen) if not isinstance(part, ActionMask)]


def with_mask(seen: Space[Any], num_actions: int) -> Space[Any]:
    """Return the space of rows that end with the legal actions."""
    return spaces.Tuple([*components(seen), ActionMask(num_actions)])


def legal_in(seen: Space[Any], row_N: Shaped[Tensor, "N ..."]) -> Bool[Tensor, "N A"] | None:
    """Return the legal actions in rows of observations; None where all are."""
    last = seen.spaces[-1] if isinstance(seen, spaces.Tuple) else None
    return row_N[..., -size(last) :] != 0 if isinstance(last, ActionMask) else None


def with_legal(row_ND: Float[Tensor, "N D"], legal_NA: Bool[Tensor, "N A"]) -> Float[Tensor, "N E"]:
    """Return rows that end with the legal actions."""
    return torch.cat([row_ND, legal_NA.to(row_ND)], -1)


def legal_only(
    value_NA: Float[Tensor, "N A"], legal_NA: Bool[Tensor, "N A"] | None, other: float = -math.inf
) -> Float[Tensor, "N A"]:
    """Return logits or values with another one in place of those of actions that are not legal."""
    return value_NA if legal_NA is None else torch.where(legal_NA, value_NA, other)


def row_shape(seen: Space[Any]) -> tuple[int, ...]:
    """Return the shape of a row: () of a Discrete space."""
    if isinstance(seen, spaces.Tuple):
        return (sum(map(size, components(seen))),)
    return seen.shape or ()


def size(component: Component) -> int:
    """Return how many entries of a row a component takes."""
    return math.prod(component.shape or ())


def row_dtype(seen: Space[Any]) -> np.dtype[Any]:
    """Return the dtype of rows: int64 of numbers alone, else the smallest that holds all entries."""
    if isinstance(seen, spaces.Discrete):
        return np.dtype(np.int64)
    return np.result_type(*map(_entry_dtype, components(seen)))


def _entry_dtype(component: Component) -> np.dtype[Any]:
    if isinstance(component, spaces.Box):
        return np.dtype(component.dtype)
    return _computed(np.min_scalar_type(int(counts(component).max()) - 1))


def counts(component: Component) -> np.ndarray:
    """Return how many values each entry of what is no Box can have, as int64."""
    assert not isinstance(component, spaces.Box)
    if isinstance(component, spaces.MultiBinary):
        return np.full(size(component), 2)
    return np.reshape(component.n if isinstance(component, spaces.Discrete) else component.nvec, -1).astype(np.int64)


def num_combinations(seen: Space[Any]) -> int | None:
    """Return the number of different rows; None where a Box is in them."""
    total = 1
    for part in components(seen):
        if isinstance(part, spaces.Box):
            return None
        total *= math.prod(counts(part).tolist())
    return total


def plainly(component: Component, channels: Literal["first", "last"] | None) -> Component:
    """Return a component as rows have it: numbers are counted from 0, the channels of images come last, and torch
    computes with its dtype.

    Args:
        channels: where those of images are; None: as the shape tells.

    Raises:
        PgtsError: the shape does not tell; or it is a Box of something else than numbers.
    """
    if isinstance(component, spaces.Discrete):
        return spaces.Discrete(int(component.n))
    if isinstance(component, spaces.MultiDiscrete):
        return spaces.MultiDiscrete(component.nvec)
    if isinstance(component, spaces.MultiBinary):
        return component
    if component.dtype.kind not in "biuf":
        raise PgtsError(f"observations are {component}; they must be real numbers")
    dtype = _computed(component.dtype)
    low, high = component.low.astype(dtype), component.high.astype(dtype)
    if first := has_channels_first(component, channels):
        low, high = np.moveaxis(low, 0, -1), np.moveaxis(high, 0, -1)
    return spaces.Box(low, high, dtype=dtype.type) if first or dtype != component.dtype else component


def has_channels_first(component: Component, channels: Literal["first", "last"] | None) -> bool:
    """Whether it is an image whose channels come first, as (4, 84, 84); PgtsError where that cannot be told.

    The channels are the fewest, and height and width may be equal: (3, 210, 160) is told from (210, 160, 3), and
    (4, 4, 16) is a board of 4 by 4; (8, 8, 8) may be both.
    """
    if not isinstance(component, spaces.Box) or len(component.shape) != 3:
        return False
    if channels is not None:
        return channels == "first"
    first, second, last = component.shape
    if last < min(first, second) or first == second != last:
        return False
    if first < min(second, last):
        return True
    if last in (1, 3):
        return False
    raise PgtsError(
        f"observations of the shape {component.shape} may have their channels first or last: set image_channels to "
        "'first' or 'last'"
    )


def image_shape(component: Component) -> tuple[int, int, int] | None:
    """Return the height, width and channels of what a cnn sees as an image; None of anything else."""
    shape = component.shape or ()
    if not isinstance(component, spaces.Box):
        return None
    if len(shape) == 3:
        return (shape[0], shape[1], shape[2])
    is_frame = len(shape) == 2 and component.dtype == np.uint8 and min(shape) >= _SMALLEST_FRAME
    return (shape[0], shape[1], 1) if is_frame else None


def _computed(dtype: Any) -> np.dtype[Any]:
    dtype = np.dtype(dtype)
    return np.dtype(_FREE.get(dtype.name, dtype))
