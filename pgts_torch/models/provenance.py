"""Whether an environment runs code that is known: the `step` and `reset` of one class, and its generators."""

import dis
import functools
import inspect
import types
from typing import Any

from pgts_torch.models.wrappers import wrappers_of

_ALWAYS = ("__getattribute__", "__setattr__", "__getattr__")
_NO_MATTER = frozenset({"render", "close", "render_mode", "metadata", "_np_random", "_np_random_seed"})


def overridden(env: Any, family: type, methods: tuple[str, ...] = ("step", "reset")) -> str:
    """Which of these methods, or of the attributes that they use (except for rendering), an unwrapped environment does
    not have from `family`, a class among its bases: "step is overridden by Shaped"; empty where it has all.

    An attribute is overridden if a class that is not among the bases of `family` defines it, or if it is a method that
    is set on the instance.
    """
    strangers = [cls for cls in type(env).__mro__ if cls not in family.__mro__]
    for name in _used_by(family, methods):
        if name in vars(env) and callable(inspect.getattr_static(family, name, None)):
            return f"{name} was set on the instance"
        if cls := next((cls for cls in strangers if name in vars(cls)), None):
            return f"{name} is overridden by {cls.__qualname__}"
    return ""


def origin(env: Any, attribute: str) -> type:
    """The class that an attribute of an environment belongs to: the most derived one that sets it, or whose `step`
    reads it. Where none does it was set from outside, and belongs to the class of the instance."""
    return next((cls for cls in type(env).__mro__ if _writes(cls, attribute)), type(env))


def _writes(cls: type, attribute: str) -> bool:
    stored = {
        line.argval
        for value in vars(cls).values()
        for code in _codes_of(value)
        for line in dis.get_instructions(code)
        if line.opname == "STORE_ATTR"
    }
    read = {name for code in _codes_of(vars(cls).get("step")) for name in code.co_names}
    return attribute in vars(cls) or attribute in stored or attribute in read


@functools.cache
def _used_by(family: type, methods: tuple[str, ...]) -> tuple[str, ...]:
    """These methods, and all attributes of the class that their code uses, directly or through each other."""
    found, entrances = dict[str, None](), (*methods, *_ALWAYS)
    waiting = [*entrances]
    while waiting:
        name = waiting.pop(0)
        # Those of all bases, because `super().reset` runs them too.
        holders = [vars(cls)[name] for cls in family.__mro__ if cls is not object and name in vars(cls)]
        if name in found or name in _NO_MATTER or not (holders or name in entrances):
            continue
        found[name] = None
        waiting += [used for value in holders for code in _codes_of(value) for used in code.co_names]
    return tuple(found)


def _codes_of(value: Any) -> list[types.CodeType]:
    """The code of a function, a property or a method of a class, with that of functions inside."""
    functions = [value.fget, value.fset] if isinstance(value, property) else [getattr(value, "__func__", value)]
    waiting, codes = [f.__code__ for f in functions if isinstance(f, types.FunctionType)], list[types.CodeType]()
    while waiting:
        codes.append(waiting.pop())
        waiting += [inner for inner in codes[-1].co_consts if isinstance(inner, types.CodeType)]
    return codes


_OWN_GENERATORS = ("gymnasium.envs.toy_text.", "gymnasium.envs.classic_control.", "pgts_torch.envs.")
_WITHOUT_GENERATORS = ("gymnasium.wrappers.common", "pgts_torch.models.actions")


def draws_its_own(env: Any) -> bool:
    """Whether an environment is known to draw from generators of its own alone, and never from those of a process."""
    around, base = wrappers_of(env), env.unwrapped
    known = all(type(wrapper).__module__ in _WITHOUT_GENERATORS for wrapper in around)
    changed = any({"step", "reset"} & vars(each).keys() for each in (*around, base))
    return known and not changed and type(base).__module__.startswith(_OWN_GENERATORS)
