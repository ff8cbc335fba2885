"""The runtime shape checker of the tests."""

import dataclasses
import functools
import inspect
from collections import Counter
from collections.abc import Callable
from typing import Any, get_args

import beartype
import jaxtyping

_ALL, _ONE_IN = 10, 16
"""So many calls of a function in a test are all checked, and then one in so many: a check takes as long as a small step
of a training, and what a function is given has mostly the shapes of the calls before."""

_calls: Counter[Callable[..., Any]] = Counter()

_jaxtyped = jaxtyping.jaxtyped


def install() -> None:
    """Have the shapes of the package checked. It must come before anything imports the package."""
    jaxtyping.jaxtyped = jaxtyped  # which the import hook puts before each function and class
    jaxtyping.install_import_hook("pgts_torch", "tests.typecheck.check")


def begin_test() -> None:
    """The next calls are all checked."""
    _calls.clear()


def jaxtyped(*, typechecker: Callable[..., Any]) -> Callable[[Any], Any]:
    """jaxtyping's decorator, only where there are shapes, and not in all calls."""

    def decorate(thing: Any) -> Any:
        if inspect.isclass(thing):
            if dataclasses.is_dataclass(thing) and "__init__" in vars(thing):
                thing.__init__ = decorate(thing.__init__)
            return thing
        if not any(map(_has_shape, thing.__annotations__.values())):
            return thing
        checked = _jaxtyped(thing, typechecker=typechecker)

        @functools.wraps(thing)
        def checked_or_not(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            _calls[thing] = count = _calls[thing] + 1
            return (checked if count <= _ALL or count % _ONE_IN == 0 else thing)(*args, **kwargs)

        return checked_or_not

    return decorate


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
