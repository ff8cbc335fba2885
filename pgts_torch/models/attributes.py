"""Attributes of environments as values that can be compared: are two instances alike, and what does a step change?"""

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
from collections.abc import Callable, Iterable, Sequence, Set
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

_NOT_COMPARED = frozenset({"env", "spec", "_cached_spec", "_np_random", "_np_random_seed", "np_random"})
"""Attributes that differ between instances that are alike: the wrapped environment, its spec and its generator."""

_GENERATORS = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random, torch.Generator)

_LARGE = 4096
"""Larger arrays, in bytes, are compared by a digest."""

_MOST_PARTS = 100_000
"""How many parts of one attribute are compared; an environment may refer to half of the program."""

_INSTANCES = 6
"""How many are compared: two may have drawn the same value by chance."""

_EPISODES, _LOOKED_AFTER, _LONGEST, _SECONDS = 3, 5, 200, 0.2
"""How `changing` looks for changes: in so many episodes, after each of the first steps and at the end. An episode is
ended after so many steps, and after one step once these seconds are over."""

_ACTIONS = 20
"""How many are sampled for the walk in which `unlike` looks for differences."""

_LEAST_RESETS, _MOST_RESETS = 10, 100
"""How often an environment is reset before a difference is taken for a lasting one: of two goals, each the outcome of
every second reset, one is missed in less than one in a thousand cases."""


def attributes(env: gymnasium.Env, *, but: Iterable[str] = ()) -> dict[str, Any]:
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
        own = {name: value for cls in reversed(_classes_outside(type(layer))) for name, value in _data_of(cls).items()}
        named = {name: value for name, value in (own | vars(layer)).items() if name not in but}
        # A function among the attributes may enclose one of the layers, which is not compared again there.
        held |= {start + name: fingerprint(value, besides=layers) for name, value in named.items()}
    return held


def changing(env: gymnasium.Env, actions: Sequence[Any], generator: np.random.Generator, **but: Any) -> set[str]:
    """The names of the attributes that change in resets and steps of a random walk.

    Args:
        env: an instance for this alone; it is stepped.
        but: as in `attributes`.
    """
    return set(_changes(env, actions, generator, **but))


def _changes(
    env: gymnasium.Env, actions: Sequence[Any], generator: np.random.Generator, **but: Any
) -> collections.Counter[str]:
    """How often each attribute is seen to change in a random walk."""
    now, found, until = attributes(env, **but), collections.Counter[str](), time.monotonic() + _SECONDS
    for _ in range(_EPISODES):
        env.reset(seed=int(generator.integers(2**31)))
        over, taken = False, 0
        while not over:
            if taken <= _LOOKED_AFTER:
                before, now = now, attributes(env, **but)
                found.update(different(before, now))
            *_, terminated, truncated, _ = env.step(actions[int(generator.integers(len(actions)))])
            taken += 1
            over = terminated or truncated or taken == _LONGEST or time.monotonic() > until
        before, now = now, attributes(env, **but)
        found.update(different(before, now))
    return found


class Unlike(NamedTuple):
    """An environment that differs from other instances: its position, and the attribute in words."""

    number: int
    what: str


def unlike(
    envs: Iterable[gymnasium.Env],
    new: Iterable[gymnasium.Env],
    walked: gymnasium.Env,
    generator: np.random.Generator,
    *,
    apart: Set[str] = frozenset(),
) -> Unlike | None:
    """The first environment that is not like the new instance beside it, whatever its present state; None: all are.

    An attribute is a difference if its value is neither that of the new instance nor the one that an instance has after
    episodes, unless it keeps changing. One that changes once, as a goal that is set in the first reset, may differ for
    ever.

    Args:
        envs: the environments.
        new: instances that are not changed.
        walked: an instance for this alone; it is stepped, and rendered if it can be.
        apart: attributes of which each instance has its own.
    """
    pairs = [(attributes(env), attributes(other)) for env, other in zip(envs, new, strict=False)]
    left = [different(*pair) - apart for pair in pairs]
    if not any(left):
        return None
    walked.action_space.seed(int(generator.integers(2**31)))
    actions = [walked.action_space.sample() for _ in range(_ACTIONS)]
    of_state = {name for name, count in _changes(walked, actions, generator).items() if count > 1}
    if walked.render_mode is not None:  # attributes that rendering sets are no difference
        with contextlib.suppress(Exception):
            walked.render()
    until = time.monotonic() + _SECONDS
    for k in range(_MOST_RESETS):
        now = attributes(walked)
        left = [(names - of_state) & different(held, now) for names, (held, _) in zip(left, pairs, strict=True)]
        if not any(left) or (k >= _LEAST_RESETS and time.monotonic() > until):
            break
        walked.reset(seed=int(generator.integers(2**31)))
        of_state |= different(now, attributes(walked))
    return next((Unlike(k, in_words(min(names), pairs[k][0], now)) for k, names in enumerate(left) if names), None)


def own_to_each(make: Callable[[], gymnasium.Env]) -> set[str]:
    """The names of the attributes in which a few new instances differ, for instance a map that is random."""
    until, first, found = time.monotonic() + _SECONDS, attributes(make()), set[str]()
    for k in range(_INSTANCES - 1):
        if k and time.monotonic() > until:
            break
        found |= different(first, attributes(make()))
    return found


def different(held: dict[str, Any], other: dict[str, Any]) -> set[str]:
    """The names under which two environments hold different values, or only one of them holds any."""
    missing = object()
    return {name for name in held.keys() | other.keys() if held.get(name, missing) != other.get(name, missing)}


def in_words(name: str, held: dict[str, Any], other: dict[str, Any]) -> str:
    """An attribute that differs between two environments, in words; with its values where they are short."""
    plain = [name in each and isinstance(each[name], bool | int | float | str | None) for each in (held, other)]
    return f"{name} = {held[name]!r}, where another instance has {other[name]!r}" if all(plain) else f"another {name}"


def fingerprint(value: Any, *, besides: Sequence[Any] = ()) -> Any:
    """A value that is equal for values that are alike. Functions are alike where their code and the values that they
    enclose are; objects where their attributes are; objects that cannot be looked into where their classes are the
    same; and each object in `besides` is like the one at the same position in another call."""
    return _print_of(value, {id(known): -1 - k for k, known in enumerate(besides)}, [0])


def _print_of(value: Any, seen: dict[int, int], parts: list[int]) -> Any:
    parts[0] += 1
    kind = type(value)
    if value is None or kind in (bool, int, str, bytes) or isinstance(value, type | types.ModuleType | enum.Enum):
        return value
    if isinstance(value, float | np.generic):
        plain = value.item() if isinstance(value, np.generic) else float(value)
        return plain if plain == plain else "nan"
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        content = value.tobytes()
        return value.dtype.str, value.shape, content if len(content) < _LARGE else hashlib.blake2b(content).digest()
    if isinstance(value, _GENERATORS) or parts[0] > _MOST_PARTS:
        return kind
    if kind in (list, tuple, dict):
        try:
            return marshal.dumps(value, 2)  # a large table takes a millisecond; entry by entry twenty
        except ValueError:
            pass
    if id(value) in seen:
        return "=", seen[id(value)]
    seen[id(value)] = len(seen)
    inner = functools.partial(_print_of, seen=seen, parts=parts)
    return kind, _parts_of(value, inner)


def _parts_of(value: Any, inner: Callable[[Any], Any]) -> Any:
    """What a value consists of."""
    if isinstance(value, dict):
        return [(repr(name), inner(part)) for name, part in value.items()]
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if isinstance(value, list | tuple | collections.deque | np.ndarray):
        return [inner(part) for part in value]
    if isinstance(value, types.FunctionType):
        cells = [inner(cell.cell_contents) for cell in value.__closure__ or ()]
        return value.__code__, inner(value.__defaults__), inner(value.__kwdefaults__), cells
    if isinstance(value, types.MethodType):
        return inner(value.__func__), inner(value.__self__)
    if isinstance(value, functools.partial):
        return inner(value.func), inner(value.args), inner(value.keywords)
    slots = [name for cls in type(value).__mro__ for name in getattr(cls, "__slots__", ()) if hasattr(value, name)]
    named = {name: getattr(value, name) for name in slots} | getattr(value, "__dict__", {})
    if named or isinstance(value, spaces.Space):
        return [(name, inner(part)) for name, part in named.items() if name not in _NOT_COMPARED]
    try:
        return pickle.dumps(value)
    except Exception:  # a window, a lock, a file: nothing to compare
        return None


def _classes_outside(cls: type) -> list[type]:
    """The classes among the bases of an environment that are not Gymnasium's or Python's own."""
    return [base for base in cls.__mro__ if base.__module__.split(".")[0] not in ("gymnasium", "typing", "builtins")]


def _data_of(cls: type) -> dict[str, Any]:
    """The attributes of a class that are not code."""
    code = (types.FunctionType, staticmethod, classmethod, property, functools.cached_property, type)
    plain = {name: value for name, value in vars(cls).items() if not name.startswith("__")}
    return {name: value for name, value in plain.items() if not isinstance(value, code) and name != "metadata"}
