"""Random numbers without global state: named streams from one seed, and keys for single samples. `SharedGenerators`
makes the random generators of the whole process, which other code may use, a function of the seed as well.

Numbers of a stream depend on the order in which they are taken. A key belongs to one sample, for instance to sample 3
of an action in a state, and its number depends on nothing else: a batch may be split or reordered.
"""

import pickle
import random
import secrets
import zlib
from types import TracebackType
from typing import Any, Self, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

_ODD = 0x9E3779B97F4A7C15 - 2**64
_FACTORS = 0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64


def seed_sequence(seed: int, *names: str | int) -> np.random.SeedSequence:
    """The numpy seed sequence of one named stream.

    Names enter as the spawn key, so streams of different names, and of neighbouring seeds, are independent
    (numpy.random.SeedSequence; O'Neill 2015).

    Args:
        seed: 0 <= seed < 2**63.
        names: what the stream is for, for instance ("rollout", 3); integers 0 <= name < 2**32.

    Raises:
        ValueError: the seed is no whole number, or it or an integer name is negative or too large.
    """
    if not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise ValueError(f"seed is {seed}; it must be a whole number, at least 0 and below 2**63")
    for name in names:
        if isinstance(name, int) and not 0 <= name < 2**32:
            raise ValueError(f"stream name {name} must be at least 0 and below 2**32")
    key = tuple(name if isinstance(name, int) else zlib.crc32(name.encode()) for name in names)
    return np.random.SeedSequence(seed, spawn_key=key)


def drawn_seed() -> int:
    """A seed from the entropy of the operating system."""
    return secrets.randbelow(2**31)


def numpy_stream(seed: int, *names: str | int) -> np.random.Generator:
    """A numpy generator of its own for each (seed, names)."""
    return np.random.default_rng(seed_sequence(seed, *names))


def stream(seed: int, *names: str | int, device: torch.device | str = "cpu") -> torch.Generator:
    """A torch generator of its own for each (seed, names).

    Torch's CPU generator keeps the lower 32 bits of its seed: two streams coincide with probability 2**-32.
    """
    state = seed_sequence(seed, *names).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(state) % 2**63)


@final
class SharedGenerators:
    """A context in which the global generators of `random`, `numpy.random` and torch are seeded from a stream. At its
    end, also after an error, their states are restored.

    used: after the context: the modules whose generators were used in it.

    Args:
        seed, names: the stream, as in `stream`. Without a seed the generators go on from where they are.
    """

    def __init__(self, seed: int | None = None, *names: str | int) -> None:
        self._seed, self._names = seed, names
        self.used: tuple[str, ...] = ()

    def __enter__(self) -> Self:
        self._before = _shared_states()
        self._begun = self._before
        if self._seed is not None:
            words = seed_sequence(self._seed, *self._names, "shared generators").generate_state(3).tolist()
            random.seed(words[0])
            np.random.seed(words[1])  # noqa: NPY002
            torch.default_generator.manual_seed(words[2])
            self._begun = _shared_states()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        ended = _shared_states()
        self.used = tuple(name for name, state in ended.items() if state != self._begun[name])
        if ended != self._before:
            random.setstate(self._before["random"])
            state: Any = pickle.loads(self._before["numpy.random"])
            np.random.set_state(state)  # noqa: NPY002
            torch.set_rng_state(torch.frombuffer(bytearray(self._before["torch"]), dtype=torch.uint8))


def _shared_states() -> dict[str, Any]:
    """The state of each module's global generator, in values that can be compared."""
    return {
        "random": random.getstate(),
        "numpy.random": pickle.dumps(np.random.get_state(legacy=False)),  # noqa: NPY002
        "torch": torch.get_rng_state().numpy().tobytes(),
    }


def sample_keys(count: int, *, generator: torch.Generator) -> Int[Tensor, "N"]:
    """Keys, 64 bits each, from a stream."""
    key_N = torch.empty(count, dtype=torch.int64, device=generator.device)
    draw_keys(key_N, generator=generator)
    return key_N


def draw_keys(key_N: Int[Tensor, "N"], *, generator: torch.Generator) -> None:
    """`sample_keys`, written into a tensor."""
    key_N.random_(-(2**63), 2**63 - 1, generator=generator)


def mix(key_N: Int[Tensor, "*#N"], *name_N: Int[Tensor, "*#N"] | int) -> Int[Tensor, "..."]:
    """A key for each (key, names), as independent of its neighbours' as 64 bits allow; the same on every device.

    SplitMix64 (Steele, Lea and Flood 2014), with one round for each name. Shapes broadcast.
    """
    for name in name_N:
        key_N = _avalanche(key_N * _ODD + name)
    return key_N


def uniform(key_N: Int[Tensor, "*N"], dtype: torch.dtype = torch.float64) -> Float[Tensor, "*N"]:
    """A number in [0, 1) for each key: its upper bits, as many as a mantissa of the dtype holds."""
    bits = 53 if dtype == torch.float64 else 24
    return _shifted(_avalanche(key_N + _ODD), 64 - bits).to(dtype) * 2.0**-bits


def _avalanche(x_N: Tensor) -> Tensor:
    """Every bit of the answer depends on every bit of x."""
    for shift, factor in zip((30, 27), _FACTORS, strict=True):
        x_N = (x_N ^ _shifted(x_N, shift)) * factor
    return x_N ^ _shifted(x_N, 31)


def _shifted(x_N: Tensor, bits: int) -> Tensor:
    """The bits of x moved down, zeros moving in; torch's own shift repeats the sign."""
    return (x_N >> bits) & ((1 << (64 - bits)) - 1)
