"""Snapshots of simulators: all that their next step depends on, except chance, which belongs to the search.

An adapter takes a snapshot of an environment and puts it back, bit for bit. The generator of the environment is no part
of a snapshot: a search that restored it would foresee what the environment is about to draw. What only rendering reads
is no part of it either, and neither is the clock of a `TimeLimit` wrapper, because models live on `env.unwrapped`; a
clock that the environment itself keeps is, in MiniGrid apart from the rest, in ALE among it.

An environment of your own needs no adapter, but two methods:

    def get_state(self):          # all that step reads or changes, except self.np_random: bytes, or what pickles
        return self.position, self.fuel

    def set_state(self, state):
        self.position, self.fuel = state

and draws chance from `self.np_random` only. States with equal bytes are one node of a search: bytes of your own making
merge surest.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv

from pgts_torch.errors import MissingModel

_MASK = 2**64 - 1
_ODD = 0x9E3779B97F4A7C15


class Snapshot(NamedTuple):
    """A state of a simulator.

    key: equal for equal states, at any count of a clock.   data: what `SnapshotAdapter.set_state` takes; often the key.
    cut: whether the step that led here truncated the episode, so that no other step may follow.
    clock: the steps that the environment itself has counted, where the adapter keeps that apart (`Clock`); else None.
    """

    key: bytes
    data: Any
    cut: bool = False
    clock: int | None = None

    @property
    def name(self) -> Hashable:
        """What tells states apart: one in which an episode was cut off is not the one in which it would go on."""
        return (self.key, self.clock, self.cut) if self.cut or self.clock is not None else self.key


def of_key(key: bytes) -> Snapshot:
    """A snapshot whose key is its data, without a clock; in half of the time of `Snapshot(key, key)`."""
    return tuple.__new__(Snapshot, (key, key, False, None))


class Reading(NamedTuple):
    """What a step has read of a clock.

    limit: the count from which on an episode is truncated.   pays: whether its reward is that of the count after it.
    """

    limit: int
    pays: bool


class Clock(ABC):
    """A count of the steps of an episode, which an environment reads for rewards and for truncation alone.

    So what a step does at one count says what it does at any other: transitions are remembered without it.

    name: of the attribute that counts.
    """

    name: str

    @abstractmethod
    def reading(self, reward: Any, truncated: bool) -> Reading | None:
        """What the last step has read, by the reward and the truncation that it gave; None where these have another
        reason, so that the step says nothing of other counts. To be called after each step."""

    @abstractmethod
    def reward(self, reading: Reading, count: int) -> float:
        """The reward of a step that pays by the clock, if the count is so high after it."""

    @abstractmethod
    def at(self, snapshot: Snapshot, count: int) -> Snapshot:
        """The same state at another count, where no episode was cut off."""


class SnapshotAdapter(ABC):
    """Takes and restores the states of one environment, which is `unwrapped`.

    Attributes:
        name: of the family of environments.
        restored: the attributes of an environment that change in steps and resets and are in a snapshot, or are for
            rendering only; None: whatever there is.
        is_plain: whether all snapshots are made by `of_key`, of bytes of the same length that `set_state` copies and
            does not decode: then they can be saved, and loaded from files of others.
        shares_generators: whether `seed` seeds all generators of Python and numpy that an environment holds, not
            np_random alone.
    """

    name: str
    restored: frozenset[str] | None = None
    is_plain = False
    shares_generators = False

    @abstractmethod
    def get_state(self, env: Any) -> Snapshot:
        """The state of `env`, or of another instance of its class; nothing of it changes."""

    @abstractmethod
    def set_state(self, env: Any, data: Any) -> None:
        """Give `env` the state whose `Snapshot.data` this is."""

    def same_state(self, one: Snapshot, other: Snapshot) -> bool:
        """Whether two snapshots are of one state, also where their keys differ."""
        return one.key == other.key and one.clock == other.clock

    def seed(self, env: Any, key: int) -> None:
        """Whatever `env` draws from here on is a function of the 64 bits of `key`; its state stays as it is."""
        reseed(env, key)

    def is_random(self, env: Any, action: Any) -> bool | None:
        """Whether chance decides what follows `action` in the present state; None: see whether the step draws."""
        return None

    def skip_observations(self, env: Any) -> Callable[[], Any] | None:
        """Make the steps of `env` return None for their observation, where making one is expensive and equal states
        have equal observations.

        Returns:
            What makes the observation of the present state; None where nothing was changed and steps still return it.
        """
        return None

    def clock(self, env: Any) -> Clock | None:
        """The clock that snapshots keep apart, read by this instance from here on; None where there is none, or where
        its rewards are made by code of which that is not known."""
        return None

    def obstacle(self, env: Any) -> str:
        """Why this instance cannot be restored after all; empty where it can."""
        return ""

    def same_world(self, env: Any, own: Any) -> bool:
        """Whether what is no part of a snapshot, as maps and constants, is the same in both instances."""
        return type(env) is type(own)


def reseed(env: Any, key: int) -> None:
    """Give `env` a generator of its own for each key; a new one only where the present one is no PCG64.

    The 64 bits are stretched to the 128 of PCG64 by SplitMix64 (Steele, Lea and Flood 2014), as in `seeding.mix`: a
    fifth of what `numpy.random.default_rng(key)` costs.
    """
    generator = env.np_random
    bits = getattr(generator, "bit_generator", None)
    if type(bits) is not np.random.PCG64:
        if bits is None:
            raise MissingModel(
                f"np_random is a {type(generator).__name__}; super().reset(seed=seed) makes it one of numpy, whose "
                "bits a search seeds: give a generator of another kind another name"
            )
        generator = env.np_random = np.random.Generator(np.random.PCG64(0))
    high, low = _avalanche((key + _ODD) & _MASK), _avalanche((key + 2 * _ODD) & _MASK)
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": high << 64 | low, "inc": _ODD},
        "has_uint32": 0,
        "uinteger": 0,
    }


def generator_state(env: Any) -> Mapping[str, Any]:
    """The state of the generator of `env`: unchanged if and only if nothing was drawn from it."""
    return env.np_random.bit_generator.state


def _avalanche(x: int) -> int:
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & _MASK
    return x ^ (x >> 31)


def each_of(env: gymnasium.Env | VectorEnv) -> Sequence[Any]:
    """The environments that step together, where one can look at each; else the environment itself, alone."""
    return env.envs if isinstance(env, SyncVectorEnv) else [env]


def env_name(env: gymnasium.Env | VectorEnv) -> str:
    """The id of an environment, or the name of its class where it has none; of several that step together, that of the
    first."""
    env = each_of(env)[0] if env.spec is None else env
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
