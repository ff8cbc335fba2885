"""The runtime shape checker of the tests."""

from collections.abc import Callable
from typing import Any, get_args

import beartype
import jaxtyping


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, its array shapes checked by beartype. All other types are mypy's to check, and stay free here."""
    hints = getattr(function, "__annotations__", {})
    if not any(map(_has_shape, hints.values())):
        return function
    function.__annotations__ = {name: hint if _has_shape(hint) else Any for name, hint in hints.items()}
    return beartype.beartype(function)


def _has_shape(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(_has_shape(part) for part in get_args(hint))
