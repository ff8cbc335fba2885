"""Which adapter takes and restores the snapshots of an environment, and the adapters of Gymnasium's own families.

An environment of your own comes first: see the head of `pgts_torch.models.snapshots`.
"""

import inspect
import pickle
import struct
import sys
import types
from collections import deque
from collections.abc import Iterator
from typing import Any, final

import gymnasium
import numpy as np
import torch

from pgts_torch.errors import MissingModel
from pgts_torch.models.adapters_extra import Ale, Mujoco
from pgts_torch.models.adapters_minigrid import MiniGrid
from pgts_torch.models.provenance import overridden
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter, env_name, of_key


@final
class OwnState(SnapshotAdapter):
    """For environments with `get_state` and `set_state` of their own."""

    name = "get_state and set_state of its own"

    def get_state(self, env: Any) -> Snapshot:
        state = env.get_state()
        data = state if type(state) is bytes else pickle.dumps((state,), protocol=5)
        # A prefix tells a state that is bytes from one that is pickled.
        return Snapshot((b"b" if data is state else b"p") + data, (data is state, data))

    def set_state(self, env: Any, data: Any) -> None:
        is_bytes, content = data
        env.set_state(content if is_bytes else pickle.loads(content)[0])

    def same_state(self, one: Snapshot, other: Snapshot) -> bool:
        """Pickles of one state may differ, as where a number is of Python here and of numpy there, or an object is met
        twice; so what they hold is compared."""
        contents = [_content(snapshot.data[1]) for snapshot in (one, other)]
        return one.key == other.key or (None not in contents and same_content(*contents))


def _content(pickled: bytes) -> tuple[Any] | None:
    """What is in a pickle; None where bytes are none."""
    try:
        return (pickle.loads(pickled),) if pickled.startswith(b"\x80") else None
    except Exception:  # bytes of somebody's own making, that begin like a pickle
        return None


_ARRAYS = np.ndarray, np.generic, torch.Tensor
_SEQUENCES = list, tuple, deque
_PLAIN = frozenset({type(None), bool, int, float, complex, str, bytes, bytearray, range, set, frozenset})


def same_content(one: Any, other: Any) -> bool:
    """Whether two values hold the same, however numbers are typed. Objects may lead back to themselves, as cars to a
    road with all cars: a pair that was met before is not looked at again. Objects are the same where what a pickle has
    of them is, whatever their class calls equal; iterators, and what does not pickle, where their class is."""
    met, left = dict[tuple[int, int], Any](), [(one, other)]
    while left:
        first, second = left.pop()
        if first is second or (pair := (id(first), id(second))) in met:
            continue
        if isinstance(first, _ARRAYS) or isinstance(second, _ARRAYS):
            first, second = np.asarray(first), np.asarray(second)
            if first.shape != second.shape:
                return False
            if first.dtype.hasobject or second.dtype.hasobject:
                left += zip(first.ravel(), second.ravel(), strict=True)
            elif not ((first == second) | ((first != first) & (second != second))).all():
                return False
        elif isinstance(first, dict) and isinstance(second, dict):
            if first.keys() != second.keys():
                return False
            met[pair] = first, second
            left += [(first[name], second[name]) for name in first]
        elif isinstance(first, _SEQUENCES) and isinstance(second, _SEQUENCES):
            if len(first) != len(second):
                return False
            met[pair] = first, second
            left += zip(first, second, strict=True)
        elif isinstance(first, types.MethodType) and isinstance(second, types.MethodType):
            left += [(first.__func__, second.__func__), (first.__self__, second.__self__)]
        elif type(first) is type(second) and type(first) not in _PLAIN:
            met[pair] = first, second
            left.append((_reduced(first), _reduced(second)))
        elif not (first == second or (first != first and second != second)):
            return False
    return True


def _reduced(value: Any) -> list[Any]:
    """What a pickle has of an object, for instance its class and its attributes; empty where it is not compared."""
    try:
        reduced = () if isinstance(value, Iterator) else value.__reduce_ex__(5)
    except Exception:  # which errors an object raises that does not pickle is its own affair
        return []
    return [list(part) if isinstance(part, Iterator) else part for part in reduced]


@final
class ToyText(SnapshotAdapter):
    """FrozenLake, CliffWalking and Taxi: the state, and whether Taxi's passenger may still change his mind."""

    name = "toy text"
    restored = frozenset({"s", "lastaction", "fickle_step", "taxi_orientation"})

    def get_state(self, env: Any) -> Snapshot:
        return of_key(struct.pack("<q?", env.s, vars(env).get("fickle_step", False)))

    def set_state(self, env: Any, data: Any) -> None:
        env.s, fickle = struct.unpack("<q?", data)
        if "fickle_step" in vars(env):
            env.fickle_step = fickle

    def is_random(self, env: Any, action: Any) -> bool | None:
        # These environments draw a number even where one outcome is sure.
        fickle = vars(env).get("fickle_step", False)
        return fickle or len({row[1:] for row in env.P[env.s][action] if row[0] > 0}) > 1

    def obstacle(self, env: Any) -> str:
        # Whether chance decides is read from P, which tells what these steps do and no others.
        family = next(cls for cls in type(env).__mro__ if cls.__module__.startswith(_TOY_TEXT))
        why = overridden(env, family)
        return f"{why}, where snapshots are made for {family.__name__}: {methods_for(env)}" if why else ""

    def same_world(self, env: Any, own: Any) -> bool:
        return type(env) is type(own) and env.P == own.P


@final
class Blackjack(SnapshotAdapter):
    """The two hands. The suit of the dealer's card is for rendering."""

    name = "toy text"
    restored = frozenset({"player", "dealer", "dealer_top_card_suit", "dealer_top_card_value_str"})

    def get_state(self, env: Any) -> Snapshot:
        return of_key(bytes(env.player) + b"|" + bytes(env.dealer))

    def set_state(self, env: Any, data: Any) -> None:
        player, dealer = data.split(b"|")
        env.player, env.dealer = list(player), list(dealer)

    def same_world(self, env: Any, own: Any) -> bool:
        return type(env) is type(own) and (env.natural, env.sab) == (own.natural, own.sab)


_FLOAT64, _HEAD = np.dtype(np.float64), b"dNone:  "
"""Most states are vectors of this dtype, and not after an end: how their keys begin, which are their data too. As long
as a number, so that those behind it are aligned."""


@final
class ClassicControl(SnapshotAdapter):
    """CartPole, Acrobot, MountainCar and Pendulum: the vector `state`, in its dtype, and CartPole's mark of an end."""

    name = "classic control"
    restored = frozenset({"state", "steps_beyond_terminated", "last_u", "screen", "clock", "isopen", "surf"})

    def get_state(self, env: Any) -> Snapshot:
        held, beyond = env.state, env.__dict__.get("steps_beyond_terminated")
        if beyond is None and type(held) is np.ndarray and held.dtype is _FLOAT64 and held.ndim == 1:
            return of_key(_HEAD + held.tobytes())
        state = np.array(held)
        return Snapshot(f"{state.dtype.char}{beyond}:".encode() + state.tobytes(), (state, beyond))

    def set_state(self, env: Any, data: Any) -> None:
        # An array of its own, because the environment may write into its state.
        if type(data) is bytes:
            state, beyond = np.frombuffer(bytearray(data), _FLOAT64, -1, len(_HEAD)), None
        else:
            state, beyond = data[0].copy(), data[1]
        env.state = state
        if "steps_beyond_terminated" in env.__dict__:
            env.steps_beyond_terminated = beyond

    def same_world(self, env: Any, own: Any) -> bool:
        return type(env) is type(own) and _constants(env) == _constants(own)


def _constants(env: Any) -> dict[str, Any]:
    """The plain attributes of an environment of classic control; those of rendering and of its state are left out."""
    left_out = {"steps_beyond_terminated", "last_u", "render_mode", "isopen", "_np_random_seed"}
    plain = (bool, int, float, str, np.floating)
    return {name: value for name, value in vars(env).items() if isinstance(value, plain) and name not in left_out}


_TOY_TEXT = "gymnasium.envs.toy_text"
_CLASSIC = "gymnasium.envs.classic_control"


ADAPTERS: dict[tuple[str, str], type[SnapshotAdapter]] = {
    (f"{_TOY_TEXT}.frozen_lake", "FrozenLakeEnv"): ToyText,
    (f"{_TOY_TEXT}.cliffwalking", "CliffWalkingEnv"): ToyText,
    (f"{_TOY_TEXT}.taxi", "TaxiEnv"): ToyText,
    (f"{_TOY_TEXT}.blackjack", "BlackjackEnv"): Blackjack,
    (f"{_CLASSIC}.cartpole", "CartPoleEnv"): ClassicControl,
    (f"{_CLASSIC}.acrobot", "AcrobotEnv"): ClassicControl,
    (f"{_CLASSIC}.mountain_car", "MountainCarEnv"): ClassicControl,
    (f"{_CLASSIC}.continuous_mountain_car", "Continuous_MountainCarEnv"): ClassicControl,
    (f"{_CLASSIC}.pendulum", "PendulumEnv"): ClassicControl,
    ("minigrid.minigrid_env", "MiniGridEnv"): MiniGrid,
    ("ale_py.env", "AtariEnv"): Ale,
    ("gymnasium.envs.mujoco.mujoco_env", "MujocoEnv"): Mujoco,
}
"""The families by (module, class); subclasses belong to them. A module that nothing has imported has no instances."""


def adapter_for(env: gymnasium.Env) -> SnapshotAdapter:
    """An adapter for this environment. Its own two methods come before what is known of its family.

    Raises:
        MissingModel: it has neither; the message says what to implement.
    """
    if (known := known_adapter(env)) is None:
        raise MissingModel(not_restored(env))
    return known


def not_restored(env: gymnasium.Env) -> str:
    """Why an environment without adapter has no model, and what to write."""
    return (
        f"{env_name(env)} cannot be restored: {methods_for(env.unwrapped)}; or wrap it in pgts_torch.envs.Retraced "
        "(retraced/Env-v0), which restores a state by a reset and all actions since then"
    )


def known_adapter(env: gymnasium.Env) -> SnapshotAdapter | None:
    """`adapter_for`, or None; MissingModel where its family has one that this instance cannot be restored by."""
    base = env.unwrapped
    if callable(getattr(base, "get_state", None)) and _takes_one(getattr(base, "set_state", None)):
        return OwnState()
    for (module, name), make in ADAPTERS.items():
        if module in sys.modules and isinstance(base, getattr(sys.modules[module], name)):
            adapter = make()
            if why := adapter.obstacle(base):
                raise MissingModel(f"{env_name(env)} cannot be restored: {why}")
            return adapter
    return None


def methods_for(base: Any) -> str:
    """What to write, in the words of a refusal."""
    words = (
        f"give {type(base).__name__} the methods get_state(self), which returns all that step reads or changes except "
        "self.np_random (bytes, or what pickles), and set_state(self, state), which puts it back"
    )
    present = getattr(base, "set_state", None)
    if callable(present) and not _takes_one(present):
        words += f"; calls of the present set_state{inspect.signature(present)} must go on to super()"
    return words


def _takes_one(method: Any) -> bool:
    """Whether it is a method that can be called with one argument; `set_state` of MuJoCo's environments takes two."""
    try:
        inspect.signature(method).bind(None)
    except TypeError:
        return False
    return True
