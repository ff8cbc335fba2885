"""Generators that stand for those of an environment's own in a search: all draw from the bits of its `np_random`."""

import random
from collections.abc import Callable, Mapping
from typing import Any, final

import numpy as np


@final
class _Random(random.Random):
    """`random.Random`; its other methods draw by these two."""

    bits: np.random.BitGenerator

    def random(self) -> float:
        return (self.bits.random_raw() >> 11) * 2.0**-53

    def getrandbits(self, k: int, /) -> int:
        drawn = sum(self.bits.random_raw() << 64 * word for word in range(-(-k // 64)))
        return drawn >> -k % 64

    def seed(self, *args: Any, **kwargs: Any) -> None:
        """The search seeds what it draws from."""
        self.gauss_next = None


@final
class _RandomState(np.random.RandomState):
    """Legacy numpy; it could be seeded with bits of its own only."""

    def seed(self, *args: Any, **kwargs: Any) -> None:
        """The search seeds what it draws from."""


def _random(generator: np.random.Generator) -> _Random:
    made = _Random()
    made.bits = generator.bit_generator
    return made


MAKERS: Mapping[str, Callable[[np.random.Generator], Any]] = {
    "np_random": lambda generator: generator,
    "bits of np_random": lambda generator: generator.bit_generator,
    "random.Random": _random,
    "RandomState": lambda generator: _RandomState(generator.bit_generator),
}
"""Make what stands for a generator, by `name_of` it: a new one where it keeps half of a pair of normal numbers."""

_NAMES: Mapping[type, str] = {
    np.random.Generator: "np_random",
    random.Random: "random.Random",
    _Random: "random.Random",
    np.random.RandomState: "RandomState",
    _RandomState: "RandomState",
} | dict.fromkeys(np.random.BitGenerator.__subclasses__(), "bits of np_random")


def name_of(part: Any) -> str | None:
    """What stands for a generator; None where nothing does, as for one of a user's own class, or `part` is none."""
    return _NAMES.get(type(part))
