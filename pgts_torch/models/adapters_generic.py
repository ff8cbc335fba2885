"""Adapters of what nobody has written one for: the attributes of an environment, and of its wrappers, pickled."""

import collections
import contextlib
import copyreg
import io
import pickle
from collections.abc import Callable, Mapping
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium import spaces

from pgts_torch.errors import Failed
from pgts_torch.models.adapters import known_adapter, same_content
from pgts_torch.models.attributes import own_generator
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter, reseed
from pgts_torch.models.stand_ins import MAKERS, name_of
from pgts_torch.models.trial import reset
from pgts_torch.models.wrappers import only_with_effect, with_effect

_NO_STATE = frozenset(
    {"spec", "metadata", "render_mode", "action_space", "observation_space", "_np_random", "_np_random_seed"}
    | {"env", "_cached_spec", "_action_space", "_observation_space", "_metadata", "_saved_kwargs"}
)
"""Of environments and of wrappers."""


def _array(array: np.ndarray) -> Any:
    if array.dtype.hasobject or array.dtype.fields:
        return array.__reduce__()
    return _restored_array, (array.dtype.str, array.shape, array.tobytes())


def _restored_array(dtype: str, shape: tuple[int, ...], content: bytes) -> np.ndarray:
    return np.frombuffer(content, dtype).reshape(shape).copy()


_NUMBERS = np.bool_, np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint32, np.uint64, np.float32, np.float64
_REDUCERS: Mapping[type, Any] = collections.ChainMap(
    {np.ndarray: _array} | dict.fromkeys(_NUMBERS, lambda number: (type(number), (number.item(),))),
    copyreg.dispatch_table,
)
"""How arrays and numbers of numpy are pickled. By itself numpy pickles those that were unpickled in another way than
those that were not, and equal states would have different bytes."""


class _Part:
    """In what is compared, a part of an environment that stays where it is, or an attribute of it, as a method."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> "_Part":
        if name.startswith("__"):
            raise AttributeError(name)
        return _Part(f"{self._name}.{name}")

    def __call__(self) -> None:
        """What `functools.partial` takes can be called."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Part) and self._name == other._name

    def __hash__(self) -> int:
        return hash(self._name)


@final
class PickledAttributes(SnapshotAdapter):
    """All attributes of an environment, but its spaces, its generators, and what does not pickle, as windows.

    In states that are restored every generator of Python or numpy that the environment holds draws from the bits of its
    `np_random` (`models.stand_ins`), so that all its chance comes from the key that seeds this one.

    That this is its whole state is a guess: it can only be used where walks that are restored (`models.restoring`) go
    on bit for bit as at first, and steps are compared with the model for as long as it is used.

    left_out: the attributes that do not pickle.
    """

    name, shares_generators = "its attributes, pickled", True

    def __init__(self) -> None:
        self.left_out = set[str]()
        self._fixed: Mapping[str, Any] = {}
        # Whether there are other generators than np_random; and the one that stands for all of them since set_state.
        self._has_others, self._shared = False, None

    def get_state(self, env: Any) -> Snapshot:
        try:
            content = self._pickled(env, self._state(env))
        except Exception:  # which errors an object raises that does not pickle is its own affair
            self.left_out.update(name for name, value in self._state(env).items() if not self._pickles(env, value))
            content = self._pickled(env, self._state(env))
        return Snapshot(content, content)

    def set_state(self, env: Any, data: Any) -> None:
        parts, generator = self._parts(env), env.np_random
        attributes = _unpickled(data, lambda name: MAKERS[name](generator) if name in MAKERS else parts[name])
        if vars(env).keys() != attributes.keys():
            for name in self._state(env).keys() - attributes.keys():
                delattr(env, name)
        vars(env).update(attributes)
        self._shared = generator

    def seed(self, env: Any, key: int) -> None:
        reseed(env, key)
        self.share(env)

    def share(self, env: Any) -> None:
        """Let the other generators draw from np_random where the state was not restored just now."""
        if self._has_others and self._shared is not env.np_random:
            self.set_state(env, self.get_state(env).data)
        self._shared = None  # a reset may make others

    def same_state(self, one: Snapshot, other: Snapshot) -> bool:
        """Pickles of one state may differ, as where an object is met twice; so what they hold is compared."""
        return one.key == other.key or same_content(*(_unpickled(each.data) for each in (one, other)))

    def _state(self, env: Any) -> dict[str, Any]:
        held, left_out = vars(env), self.left_out
        return {name: held[name] for name in sorted(held) if name not in _NO_STATE and name not in left_out}

    def _parts(self, env: Any) -> Mapping[str, Any]:
        """What of an environment stays where it is though attributes refer to it, by name."""
        known = self._fixed
        if not known or known["self"] is not env or known["np_random"] is not env.np_random:
            held = {name: value for name, value in vars(env).items() if isinstance(value, spaces.Space)}
            inside = {"env": env.env, "unwrapped": env.unwrapped} if isinstance(env, gymnasium.Wrapper) else {}
            self._fixed = held | inside | {"self": env, "np_random": env.np_random}
        return self._fixed

    def _pickled(self, env: Any, value: Any) -> bytes:
        pickler = _Pickler(file := io.BytesIO(), self._parts(env))
        pickler.dump(value)
        self._has_others |= pickler.has_others
        return file.getvalue()

    def _pickles(self, env: Any, value: Any) -> bool:
        try:
            self._pickled(env, value)
        except Exception:
            return False
        return True


@final
class Layered(SnapshotAdapter):
    """An environment with wrappers that have a memory: the state of the environment inside, and the attributes of each
    wrapper that has an effect, pickled. It takes and restores the outermost of these, not the environment inside.

    Args:
        inner: for the environment inside.
    """

    def __init__(self, inner: SnapshotAdapter) -> None:
        self.name, self.inner = f"{inner.name}, with its wrappers", inner
        self.shares_generators = inner.shares_generators
        self._each: list[PickledAttributes] = []

    def get_state(self, env: Any) -> Snapshot:
        inner, layers = self.inner.get_state(env.unwrapped), self.layers(env)
        return Snapshot(pickle.dumps((inner.key, inner.clock, layers), 5), (inner.data, layers))

    def set_state(self, env: Any, data: Any) -> None:
        inner, layers = data
        self.inner.set_state(env.unwrapped, inner)
        for (adapter, wrapper), layer in zip(self._pairs(env), layers, strict=True):
            adapter.set_state(wrapper, layer)

    def same_state(self, one: Snapshot, other: Snapshot) -> bool:
        if one.key == other.key:
            return True
        (inner, clock, layers), (other_inner, other_clock, others) = (pickle.loads(each.key) for each in (one, other))
        inside = (Snapshot(inner, one.data[0], clock=clock), Snapshot(other_inner, other.data[0], clock=other_clock))
        pairs = zip(layers, others, strict=True)
        return self.inner.same_state(*inside) and all(
            same_content(_unpickled(layer), _unpickled(another)) for layer, another in pairs
        )

    def seed(self, env: Any, key: int) -> None:
        self.inner.seed(env.unwrapped, key)
        for adapter, wrapper in self._pairs(env):
            adapter.share(wrapper)

    def same_world(self, env: Any, own: Any) -> bool:
        kinds = [[type(wrapper) for wrapper in with_effect(each)] for each in (env, own)]
        return kinds[0] == kinds[1] and self.inner.same_world(env.unwrapped, own.unwrapped)

    def layers(self, env: Any) -> list[bytes]:
        """The states of the wrappers, the outermost first."""
        return [adapter.get_state(wrapper).data for adapter, wrapper in self._pairs(env)]

    def _pairs(self, env: Any) -> list[tuple[PickledAttributes, Any]]:
        wrappers = with_effect(env)
        while len(self._each) < len(wrappers):
            self._each.append(PickledAttributes())
        return list(zip(self._each, wrappers, strict=False))


def known_or_none(env: gymnasium.Env, make: Callable[[], gymnasium.Env]) -> SnapshotAdapter | None:
    """`known_adapter`; None also where an environment has generators of its own, which its get_state may return and
    a search must not restore, and `PickledAttributes` can share them.

    Args:
        make: makes another instance, which is reset.
    """
    if (known := known_adapter(env)) is not None:
        with contextlib.suppress(Failed):
            reset(other := make(), seed=0)
            one, another = (own_generator(other.unwrapped, but=but) for but in (None, name_of))
            return None if one and not another else known
    return known


def inside(env: gymnasium.Env, adapter: SnapshotAdapter) -> Any:
    """What of an instance an adapter takes and restores. With `Layered` its other wrappers are taken off."""
    return only_with_effect(env) if isinstance(adapter, Layered) else env.unwrapped


class _Pickler(pickle.Pickler):
    """Pickles references to parts of an environment, by identity, as their names, and other generators as what stands
    for them.

    persistent_id and persistent_load are methods, because since Python 3.13 they cannot be set on an instance.
    """

    dispatch_table = _REDUCERS

    def __init__(self, file: io.BytesIO, parts: Mapping[str, Any]) -> None:
        super().__init__(file, protocol=5)
        self._names, self.has_others = {id(part): name for name, part in parts.items()}, False

    def persistent_id(self, part: Any) -> str | None:
        if (name := self._names.get(id(part))) is None and (name := name_of(part)) is not None:
            self.has_others = True
        return name


class _Unpickler(pickle.Unpickler):
    def __init__(self, content: bytes, part_of: Callable[[str], Any]) -> None:
        super().__init__(io.BytesIO(content))
        self._part_of = part_of

    def persistent_load(self, name: str) -> Any:
        return self._part_of(name)


def _unpickled(content: bytes, part_of: Callable[[str], Any] = _Part) -> Any:
    """What was pickled, with parts of an environment in place of their names; without one with a `_Part` for each."""
    return _Unpickler(content, part_of).load()
