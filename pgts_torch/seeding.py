"""Named random streams: one integer seed, as many independent generators as there are names."""

import zlib

import numpy as np
import torch


def seed_sequence(seed: int, *names: str | int) -> np.random.SeedSequence:
    """The numpy seed sequence of one named stream.

    Names enter as the spawn key, so streams of different names, and of neighbouring seeds, are independent
    (numpy.random.SeedSequence; O'Neill 2015).

    Args:
        seed: 0 <= seed < 2**63.
        names: what the stream is for, for instance ("rollout", 3); integers 0 <= name < 2**32.

    Raises:
        ValueError: the seed or an integer name is negative or too large.
    """
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed is {seed}; it must be at least 0 and below 2**63")
    for name in names:
        if isinstance(name, int) and not 0 <= name < 2**32:
            raise ValueError(f"stream name {name} must be at least 0 and below 2**32")
    key = tuple(name if isinstance(name, int) else zlib.crc32(name.encode()) for name in names)
    return np.random.SeedSequence(seed, spawn_key=key)


def numpy_stream(seed: int, *names: str | int) -> np.random.Generator:
    """A numpy generator of its own for each (seed, names)."""
    return np.random.default_rng(seed_sequence(seed, *names))


def stream(seed: int, *names: str | int, device: torch.device | str = "cpu") -> torch.Generator:
    """A torch generator of its own for each (seed, names).

    Torch's CPU generator keeps the lower 32 bits of its seed: two streams coincide with probability 2**-32.
    """
    state = seed_sequence(seed, *names).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(state) % 2**63)
