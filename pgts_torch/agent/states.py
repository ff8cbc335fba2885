"""Saved states taken over: all of one, and only what the part that takes it over would have written itself."""

import math
from collections.abc import Callable, Mapping, Set
from typing import Any

import torch
from torch import Tensor

from pgts_torch.errors import PgtsError

NO_STATE = (KeyError, TypeError, ValueError, AttributeError, IndexError, RuntimeError, OverflowError)
"""What code that reads plain values raises where they are of another form."""


def take_over(
    name: str,
    state: Any,
    load: Callable[[Any], object],
    own: Callable[[], Any],
    *,
    has_bounds: bool = False,
    is_all: bool = True,
) -> None:
    """Have a part of a model take over its saved state.

    What a checksum does not tell is whether the state is one at all. So each number must be finite, the part says what
    it cannot be (its shapes and ranges), and in the end the part must give the same state that it was given.

    Args:
        name: of the part, as it stands in what is saved.
        state: what was saved.
        load: takes it over.
        own: gives the state that the part is in.
        has_bounds: numbers in it may be infinite.
        is_all: all of the state is taken over.

    Raises:
        PgtsError: it is no state of this part; what stands in its way is named, and the part is in some state.
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
    """PgtsError unless it is a dict with these keys, perhaps some of these others, and no more."""
    if not isinstance(state, Mapping):
        raise PgtsError(f"{name} is a {type(state).__name__}; it must be a dict of {', '.join(sorted(keys))}")
    if missing := keys - set(state):
        raise PgtsError(f"{name} lacks {', '.join(sorted(missing))}")
    if extra := [ascii(key) for key in state if key not in keys | others]:
        raise PgtsError(f"{name} has {', '.join(sorted(extra))}, which no version of pgts_torch has written")


def _check_plain(name: str, value: Any, depth: int = 0, *, has_bounds: bool = False) -> None:
    """PgtsError where something in nested plain values is not finite, or no plain value."""
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
    """The first place in which two states differ, and how; empty where they are alike in every bit."""
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
