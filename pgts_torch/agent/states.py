"""Load saved states strictly: a state is accepted only if the part that loads it would save the same state again."""

import math
from collections.abc import Callable, Mapping, Set
from typing import Any

import torch
from torch import Tensor

from pgts_torch.errors import PgtsError

NO_STATE = (KeyError, TypeError, ValueError, AttributeError, IndexError, RuntimeError, OverflowError)
"""The errors that code raises on plain values of an unexpected form."""


def load_checked(
    name: str,
    state: Any,
    load: Callable[[Any], object],
    own: Callable[[], Any],
    *,
    has_bounds: bool = False,
    is_all: bool = True,
) -> None:
    """Load the saved state of a part of a model, and check that all of it was understood.

    A checksum does not show that a state is valid. So each number must be finite, the part checks shapes and ranges
    while it loads, and afterwards its own state must equal the saved one.

    Args:
        name: of the part, as in the saved state.
        own: returns the current state of the part.
        has_bounds: whether numbers in it may be infinite.
        is_all: whether all of it is loaded; else the part may have another state afterwards.

    Raises:
        PgtsError: it is no state of this part; the message says why. The part may have loaded some of it.
    """
    _check_plain(name, state, has_bounds=has_bounds or not is_all)
    try:
        load(state)
        now = own()
    except PgtsError as error:
        raise PgtsError(f"the saved state of {name} does not fit: {error}") from error
    except NO_STATE as error:
        reason = f"{type(error).__name__}: {error}"
        raise PgtsError(f"the saved state of {name} is not of the form that this version writes ({reason})") from error
    if is_all and (difference := _difference(name, state, now)):
        raise PgtsError(f"the saved state of {name} is not of the form that this version writes: {difference}")


def check_keys(name: str, state: Any, keys: set[str], *, others: Set[str] = frozenset()) -> None:
    """PgtsError unless `state` is a dict with all of `keys`, any of `others`, and no more."""
    if not isinstance(state, Mapping):
        raise PgtsError(f"{name} is a {type(state).__name__}; it must be a dict of {', '.join(sorted(keys))}")
    if missing := keys - set(state):
        raise PgtsError(f"{name} lacks {', '.join(sorted(missing))}")
    if extra := [ascii(key) for key in state if key not in keys | others]:
        raise PgtsError(f"{name} has {', '.join(sorted(extra))}, which no version of pgts_torch has written")


def _check_plain(name: str, value: Any, depth: int = 0, *, has_bounds: bool = False) -> None:
    """PgtsError unless all nested values are plain and all numbers finite (`has_bounds`: not NaN)."""
    if depth > 20:
        raise PgtsError(f"the saved state of {name} is nested too deeply")
    if isinstance(value, Tensor):
        if bool((value.isnan() if has_bounds else ~value.isfinite()).any()):
            raise PgtsError(f"the saved state of {name} has numbers that are not finite")
    elif isinstance(value, float):
        if math.isnan(value) or (math.isinf(value) and not has_bounds):
            raise PgtsError(f"the saved state of {name} is {value}; it must be finite")
    elif isinstance(value, Mapping):
        for key, each in value.items():
            _check_plain(f"{name}.{ascii(key).strip(chr(39))}", each, depth + 1, has_bounds=has_bounds)
    elif isinstance(value, list | tuple):
        for index, each in enumerate(value):
            _check_plain(f"{name}[{index}]", each, depth + 1, has_bounds=has_bounds)
    elif not isinstance(value, str | int | None):  # bool is an int
        raise PgtsError(f"the saved state of {name} is a {type(value).__name__}; it must be a plain value")


def _difference(name: str, saved: Any, now: Any) -> str:
    """A message about the first difference between two states; empty where they are equal bit for bit."""
    if type(saved) is not type(now):
        return f"{name} is a {type(saved).__name__}; it must be a {type(now).__name__}"
    if isinstance(saved, Tensor):
        kinds = [f"{each.dtype} of shape {tuple(each.shape)}" for each in (saved, now)]
        if kinds[0] != kinds[1]:
            return f"{name} is {kinds[0]}; it must be {kinds[1]}"
        return "" if torch.equal(saved.cpu(), now.cpu()) else f"{name} has values that it cannot have"
    if isinstance(saved, dict):
        if saved.keys() != now.keys():
            names = ", ".join(sorted(ascii(key) for key in saved.keys() ^ now.keys()))
            return f"{name} has other keys; they differ in {names}"
        pairs = [(f"{name}.{key}", saved[key], now[key]) for key in saved]
    elif isinstance(saved, list | tuple):
        if len(saved) != len(now):
            return f"{name} has {len(saved)} values; it must have {len(now)}"
        pairs = [(f"{name}[{index}]", *each) for index, each in enumerate(zip(saved, now, strict=True))]
    else:
        return "" if saved == now else f"{name} is {saved!r}; it would be {now!r}"
    return next(filter(None, (_difference(*pair) for pair in pairs)), "")
