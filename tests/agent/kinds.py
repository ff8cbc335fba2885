"""A small environment whose five cells are seen in every kind of space, and what takes these."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

CELLS = 5

Observe = Callable[[int], Any]


class Kind(NamedTuple):
    """A kind of observations.

    observe: the observation of a cell.   policies: the networks that take them; the first is chosen by default.
    learned: the model that is learned of them; None: none is.
    """

    space: spaces.Space
    observe: Observe
    policies: tuple[str, ...] = ("mlp",)
    learned: str | None = None


def filled(shape: tuple[int, ...], dtype: type, factor: float = 1) -> Observe:
    """An array that has a row, or plane, of ones times a factor; the cell says which."""

    def observe(cell: int) -> np.ndarray:
        array = np.zeros(shape, dtype)
        array.reshape(-1)[cell :: CELLS + 1] = factor * (cell + 1)
        return array

    return observe


def box(shape: tuple[int, ...], dtype: type, high: float = 255) -> spaces.Box:
    return spaces.Box(0, high, shape, dtype)


_BITS = spaces.MultiBinary(3)
_CODES = spaces.MultiDiscrete([5, 2], start=[1, -1])


def bits(cell: int) -> np.ndarray:
    return np.array([cell >> k & 1 for k in range(3)], np.int8)


def codes(cell: int) -> np.ndarray:
    return np.array([cell + 1, cell % 2 - 1])


CNN, BOTH = ("cnn", "mlp"), ("mlp", "cnn")

KINDS: dict[str, Kind] = {
    "a number": Kind(spaces.Discrete(CELLS), int, learned="counts"),
    "a number counted from 3": Kind(spaces.Discrete(CELLS, start=3), lambda cell: cell + 3, learned="counts"),
    "bits": Kind(_BITS, bits, learned="counts"),
    "bits in two dimensions": Kind(
        spaces.MultiBinary((2, 3)), lambda cell: np.tile(bits(cell), (2, 1)), learned="counts"
    ),
    "several numbers": Kind(_CODES, codes, learned="counts"),
    "several numbers in two dimensions": Kind(
        spaces.MultiDiscrete([[5, 5], [2, 7]]), lambda cell: np.array([[cell, 0], [1, cell]]), learned="counts"
    ),
    "a single value": Kind(box((), np.float32), lambda cell: np.array(cell, np.float32)),
    "a vector": Kind(spaces.Box(-np.inf, np.inf, (4,), np.float64), filled((4,), np.float64), learned="ensemble"),
    "a vector of float16": Kind(box((6,), np.float16, 9), filled((6,), np.float16), learned="ensemble"),
    "a vector of bytes": Kind(box((8,), np.uint8), filled((8,), np.uint8, 40), learned="ensemble"),
    "a vector of uint16": Kind(box((8,), np.uint16, 60_000), filled((8,), np.uint16), learned="ensemble"),
    "a vector of int64": Kind(box((8,), np.int64, 9), filled((8,), np.int64), learned="ensemble"),
    "a board": Kind(box((3, 3), np.int64, 9), filled((3, 3), np.int64)),
    "four dimensions": Kind(box((2, 2, 2, 2), np.float32, 9), filled((2, 2, 2, 2), np.float32)),
    "an image": Kind(box((8, 9, 3), np.uint8), filled((8, 9, 3), np.uint8, 40), CNN, "latent"),
    "an image, channels first": Kind(box((4, 9, 9), np.uint8), filled((4, 9, 9), np.uint8, 40), CNN, "latent"),
    "an image of floats": Kind(box((5, 5, 2), np.float32, 9), filled((5, 5, 2), np.float32), CNN, "latent"),
    "a grey frame": Kind(box((16, 16), np.uint8), filled((16, 16), np.uint8, 40), CNN, "latent"),
    "an image too small for a cnn": Kind(box((3, 3, 3), np.uint8), filled((3, 3, 3), np.uint8, 40), learned="latent"),
    "a tuple of numbers": Kind(
        spaces.Tuple([spaces.Discrete(CELLS), spaces.Discrete(2, start=7), _BITS]),
        lambda cell: (cell, 7 + cell % 2, bits(cell)),
        learned="counts",
    ),
    "a dictionary with an image": Kind(
        spaces.Dict(image=box((6, 6, 3), np.uint8), direction=spaces.Discrete(CELLS)),
        lambda cell: {"image": np.zeros((6, 6, 3), np.uint8), "direction": cell},
        CNN,
    ),
    "a dictionary with two images": Kind(
        spaces.Dict(front=box((3, 8, 8), np.uint8), map=box((5, 5, 1), np.float32, 1), at=_CODES),
        lambda cell: {
            "front": filled((3, 8, 8), np.uint8)(cell),
            "map": filled((5, 5, 1), np.float32, 0.2)(cell),
            "at": codes(cell),
        },
        CNN,
    ),
    "a dictionary of dictionaries and tuples": Kind(
        spaces.Dict(
            a=spaces.Tuple([spaces.Discrete(CELLS), spaces.Box(-9, 9, (2,), np.float64)]),
            b=spaces.Dict(c=_BITS, d=spaces.Tuple([_CODES])),
        ),
        lambda cell: {"a": (cell, np.full(2, cell / 3)), "b": {"c": bits(cell), "d": (codes(cell),)}},
    ),
}
"""By name."""


class Corridor(gymnasium.Env):
    """Five cells in a row, seen in some kind; going right four times pays 1 and ends. It can be restored."""

    action_space = spaces.Discrete(2)

    def __init__(self, kind: str = "a number") -> None:
        self.observation_space, self._observe, *_ = KINDS[kind]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self._observe(self.cell), {}

    def step(self, action):
        self.cell = max(0, self.cell + (1 if action else -1))
        end = self.cell == CELLS - 1
        return self._observe(self.cell), float(end), end, False, {}

    def get_state(self):
        return (self.cell,)

    def set_state(self, state):
        (self.cell,) = state
