"""Attributes of environments as values that can be compared: are two instances alike, and what does a step change?

An error of an environment that is stepped is `Failed`.
"""

import collections
import contextlib
import enum
import functools
import hashlib
import marshal
import pickle
import random
import time
import types
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from pgts_torch.errors import Failed
from pgts_torch.models.actions import all_actions
from pgts_torch.models.trial import environment_code, random_walk, reset

_NONE = frozenset[str]()

_NOT_COMPARED = frozenset({"env", "spec", "_cached_spec", "_np_random", "_np_random_seed", "np_random"})
"""Attributes that differ between instances that are alike: the wrapped environment, its spec and its generator."""

_CONTAINERS = (list, tuple, dict)

_MOST_MIXED = 200
"""After so many containers with parts that are not plain values, the others are looked into part by part."""

_PARTS = object()

_COMPARED_BY_EQUALITY = (type, types.ModuleType, types.CodeType, enum.Enum)

_GENERATORS = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random, torch.Generator)

_LARGE = 4096
"""Larger arrays, in bytes, are compared by a digest."""

_MOST_PARTS = 100_000
"""How many parts of one attribute are compared; an environment may refer to half of the program."""

_INSTANCES = 6
"""How many are compared: two may have drawn the same value by chance."""

_LOOKED_AFTER, _LONGEST, _SECONDS = 5, 200, 0.2
"""`changing` looks for changes after each of the first steps of an episode and at its end, at the latest after so many
steps; and for about these seconds."""

_ACTIONS = 20
"""How many that are no numbers are sampled for the walk in which `unlike` looks for differences."""

_LEAST_RESETS, _MOST_RESETS = 10, 100
"""How often an environment is reset before a difference is taken for a lasting one: of two goals, each the outcome of
every second reset, one is missed in less than one in a thousand cases."""


def attributes(env: gymnasium.Env, *, but: Set[str] = _NONE) -> dict[str, Any]:
    """The `fingerprint` of every attribute of an environment and its wrappers, by name.

    Attributes of a wrapper are called `WRAPPER.NAME`, those of a second of its kind `WRAPPER.2.NAME`. Class attributes
    of classes outside of Gymnasium are included, generators are not.
    """
    but, layers = _NOT_COMPARED.union(but), list[Any]([env])
    while isinstance(layers[-1], gymnasium.Wrapper):
        layers.append(layers[-1].env)
    held, met = dict[str, Any](), collections.Counter[type]()
    for layer in layers:
        met[type(layer)] += 1
        number = f"{met[type(layer)]}." if met[type(layer)] > 1 else ""
        start = "" if layer is layers[-1] else f"{type(layer).__name__}.{number}"
        named = (_class_attributes(type(layer)) | vars(layer)).items()
        # A function among the attributes may enclose one of the layers, which is not compared again there.
        held |= {start + name: fingerprint(value, besides=layers) for name, value in named if name not in but}
    return held


def changing(
    env: gymnasium.Env, actions: Sequence[Any], generator: np.random.Generator, *, times: int = 1, but: Set[str] = _NONE
) -> set[str]:
    """The names of the attributes that change at least so many times in resets and steps of a random walk.

    Args:
        env: an instance for this alone; it is stepped.
    """
    now, found, age = attributes(env, but=but), collections.Counter[str](), 0
    for taken in random_walk(env, actions, generator, steps=0, longest=_LONGEST, seconds=_SECONDS):
        age = 0 if taken.action is None else age + 1
        if age <= _LOOKED_AFTER or taken.ends or age == _LONGEST:
            before, now = now, attributes(env, but=but)
            found.update(different(before, now))
    return {name for name, count in found.items() if count >= times}


class Unlike(NamedTuple):
    """The position of an environment that differs from other instances, and in which attribute, in words."""

    number: int
    what: str


def unlike(
    envs: Iterable[gymnasium.Env],
    new: Iterable[gymnasium.Env],
    make: Callable[[], gymnasium.Env],
    generator: np.random.Generator,
    *,
    apart: Set[str] = _NONE,
) -> Unlike | None:
    """The first environment that is not like the new instance beside it, whatever its present state; None: all are.

    An attribute is a difference if its value is neither that of the new instance nor the one that an instance has after
    episodes, unless it keeps changing. One that changes once, as a goal that is set in the first reset, may differ for
    ever.

    Args:
        new: instances that are not changed.
        make: makes an instance for this alone; it is stepped, and rendered if it can be.
        apart: attributes of which each instance has its own.
    """
    pairs = [(attributes(env), attributes(other)) for env, other in zip(envs, new, strict=False)]
    left = [different(*pair) - apart for pair in pairs]
    if not any(left):
        return None
    walked = make()
    space = walked.action_space
    space.seed(int(generator.integers(2**31)))
    # All of them where they are numbers, for it may be that few are legal.
    is_discrete = isinstance(space, spaces.Discrete)
    actions = [*all_actions(space)] if is_discrete else [space.sample() for _ in range(_ACTIONS)]
    of_state = changing(walked, actions, generator, times=2)
    if walked.render_mode is not None:  # attributes that rendering sets are no difference
        with contextlib.suppress(Failed), environment_code():
            walked.render()
    until = time.monotonic() + _SECONDS
    for k in range(_MOST_RESETS):
        now = attributes(walked)
        left = [(names - of_state) & different(held, now) for names, (held, _) in zip(left, pairs, strict=True)]
        if not any(left) or (k >= _LEAST_RESETS and time.monotonic() > until):
            break
        reset(walked, seed=int(generator.integers(2**31)))
        of_state |= different(now, attributes(walked))
    for k, names in enumerate(left):
        if names:
            name, held = min(names), pairs[k][0]
            plain = all(
                name in each and isinstance(each[name], bool | int | float | str | None) for each in (held, now)
            )
            what = f"{name} = {held[name]!r}, where another instance has {now[name]!r}" if plain else f"another {name}"
            return Unlike(k, what)
    return None


def own_to_each(make: Callable[[], gymnasium.Env]) -> set[str]:
    """The names of the attributes in which a few new instances differ, for instance a map that is random."""
    until, first, found = time.monotonic() + _SECONDS, attributes(make()), set[str]()
    for _ in range(_INSTANCES - 1):
        found |= different(first, attributes(make()))
        if time.monotonic() > until:
            break
    return found


def different(held: dict[str, Any], other: dict[str, Any]) -> set[str]:
    """The names under which two environments hold different values, or only one of them holds any."""
    missing = object()
    return {name for name in held.keys() | other.keys() if held.get(name, missing) != other.get(name, missing)}


def fingerprint(value: Any, *, besides: Sequence[Any] = ()) -> Any:
    """A value that is equal for values that are alike. Functions are alike where their code and the values that they
    enclose are; objects where their attributes are; objects that cannot be looked into where their classes are the
    same; and each object in `besides` is like the one at the same position in another call."""
    looks = [look for _, _, look in _inside(value, besides, left_out=_NOT_COMPARED)]
    return looks[0] if len(looks) == 1 else looks


def own_generator(env: Any, *, but: Callable[[Any], Any] | None = None) -> str:
    """The name of a random generator in an environment other than its `np_random` and those that `but` knows, empty
    where there is none: for instance "dice", or "box.0.dice" of the first entry of a list."""
    with environment_code():
        known = env.np_random
    inside = _inside(env, [known], left_out=frozenset({"spec"}))
    others = ((where, part) for where, part, _ in inside if isinstance(part, _GENERATORS) and part is not known)
    return next((where for where, part in others if not (but and but(part))), "")


def _inside(value: Any, known: Sequence[Any], *, left_out: Set[str]) -> Iterator[tuple[str, Any, Any]]:
    """Everything that a value consists of, itself first: where it is, what it is, and what it looks like.

    An object that was met before, or is among those `known`, looks like its number; its parts are not met again.
    """
    met = {id(each): -1 - k for k, each in enumerate(known)}
    waiting: list[tuple[str, Any]] = [("", value)]
    mixed = 0  # containers that hold more than plain values: of many in each other each would be read to the end
    for _ in range(_MOST_PARTS):
        if not waiting:
            return
        where, part = waiting.pop()
        look = _look_of(part, as_one=mixed < _MOST_MIXED)
        mixed += look is _PARTS and type(part) in _CONTAINERS
        if look is _PARTS and id(part) in met:
            look = "=", met[id(part)]
        elif look is _PARTS:
            met[id(part)] = len(met)
            parts = _parts_of(part, _NOT_COMPARED if isinstance(part, spaces.Space) else left_out)
            look = type(part), [repr(name) for name, _ in parts]
            # The first part comes next, so the looks of all parts follow that of the whole in one order.
            waiting += [(f"{where}.{name}" if where else str(name), inner) for name, inner in reversed(parts)]
        yield where, part, look


def _look_of(value: Any, *, as_one: bool) -> Any:
    """What a value looks like that needs no look into its parts; else `_PARTS`.

    Args:
        as_one: take a container of plain values as one of them.
    """
    kind = type(value)
    if value is None or kind in (bool, int, str, bytes) or isinstance(value, _COMPARED_BY_EQUALITY):
        return value
    if isinstance(value, float | np.generic):
        plain = value.item() if isinstance(value, np.generic) else float(value)
        return plain if plain == plain else "nan"
    if isinstance(value, torch.Tensor):
        if value.layout is not torch.strided:
            return _PARTS
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        content = value.tobytes()
        return value.dtype.str, value.shape, content if len(content) < _LARGE else hashlib.blake2b(content).digest()
    if isinstance(value, _GENERATORS):
        return kind
    if isinstance(value, set | frozenset):
        return kind, sorted(map(repr, value))
    if kind in _CONTAINERS and as_one:
        try:
            return marshal.dumps(value, 2)  # a large table takes a millisecond; entry by entry twenty
        except ValueError:
            pass
    return _PARTS


def _parts_of(value: Any, left_out: Set[str]) -> list[tuple[Any, Any]]:
    """The names and the values of which a value consists."""
    if isinstance(value, dict):
        return list(value.items())
    if isinstance(value, list | tuple | collections.deque):
        return list(enumerate(value))
    if isinstance(value, np.ndarray):
        return list(enumerate(value.ravel().tolist()))
    if isinstance(value, torch.Tensor):  # a sparse one
        entries = value.detach().to_sparse_coo().coalesce()
        return [("shape", str(entries.shape)), ("indices", entries.indices()), ("values", entries.values())]
    if isinstance(value, types.FunctionType):
        return [(name, getattr(value, name)) for name in ("__code__", "__defaults__", "__kwdefaults__", "__closure__")]
    if isinstance(value, types.CellType):
        return [("cell_contents", value.cell_contents)] if value != types.CellType() else []
    if isinstance(value, types.MethodType):
        return [("__func__", value.__func__), ("__self__", value.__self__)]
    if isinstance(value, functools.partial):
        return [("func", value.func), ("args", value.args), ("keywords", value.keywords)]
    if (named := _held_by(value)) or isinstance(value, spaces.Space):
        return [(name, part) for name, part in named.items() if name not in left_out]
    try:
        return [("pickle", pickle.dumps(value))]
    except Exception:  # a window, a lock, a file: nothing to compare
        return []


def _held_by(value: Any) -> dict[str, Any]:
    """The attributes of an object, also those in slots."""
    slots = [name for cls in type(value).__mro__ for name in getattr(cls, "__slots__", ()) if hasattr(value, name)]
    return {name: getattr(value, name) for name in slots} | getattr(value, "__dict__", {})


def _class_attributes(cls: type) -> dict[str, Any]:
    """The attributes that are not code, of a class and of its bases outside of Gymnasium."""
    code = (types.FunctionType, staticmethod, classmethod, property, functools.cached_property, type)
    own = [base for base in cls.__mro__ if base.__module__.split(".")[0] not in ("gymnasium", "typing", "builtins")]
    named = {name: value for base in reversed(own) for name, value in vars(base).items() if not name.startswith("__")}
    return {name: value for name, value in named.items() if not isinstance(value, code) and name != "metadata"}
