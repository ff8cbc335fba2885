"""Observations of an environment as tensors, the inputs of policies and critics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from gymnasium.vector import VectorEnv
from jaxtyping import Bool
from torch import Tensor

from pgts_torch.agent import components
from pgts_torch.agent.components import Component, Path
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.masks import Masked
from pgts_torch.models.snapshots import env_name
from pgts_torch.options.environment import Observed


@dataclass(frozen=True)
class _Part:
    """A component, with the way to it in an observation, as the environment declares it and as rows have it."""

    path: Path
    declared: Component
    seen: Component
    channels_first: bool

    def read(self, observation: Any) -> np.ndarray:
        """Return it of an observation, or of several, as rows have it: [..., *shape]."""
        part = observation
        try:
            for step in self.path:
                part = part[step]
        except (KeyError, IndexError, TypeError) as error:
            raise PgtsError(f"an observation is {observation!r}; it has no part {self.path}") from error
        try:
            array = np.asarray(part)
        except ValueError as error:
            raise PgtsError(f"an observation is {part!r}; its space is {self.declared}") from error
        shape = self.declared.shape or ()
        if array.shape[max(0, array.ndim - len(shape)) :] != shape:
            raise PgtsError(f"an observation has shape {array.shape}; its space is {self.declared}")
        if not isinstance(self.declared, spaces.Box):
            return _from_zero(array, self.declared)
        array = _cast(array, self.declared)
        return np.moveaxis(array, -3, -1) if self.channels_first else array

    @property
    def name(self) -> str:
        """The keys and indices that lead to it, as in "camera.left"."""
        steps = self.path if self.path and isinstance(self.path[0], str) else ("observation", *self.path)
        return ".".join(map(str, steps))

    def example(self, count: int) -> Tensor:
        """So many of them, as the environment declares them, in a dtype that torch has."""
        number = np.int8 if isinstance(self.declared, spaces.MultiBinary) else np.int64
        dtype = self.declared.dtype if isinstance(self.declared, spaces.Box) else number
        dtype = self.seen.dtype if dtype == np.longdouble else dtype
        first = getattr(self.declared, "start", 0)
        return torch.from_numpy(np.full((count, *(self.declared.shape or ())), first, dtype))

    def read_tensor(self, x_N: Tensor) -> Tensor:
        """As `read`, without checks, of a tensor like `example`."""
        if isinstance(self.declared, spaces.Box):
            return x_N.movedim(-3, -1) if self.channels_first else x_N
        first = 0 if isinstance(self.declared, spaces.MultiBinary) else torch.as_tensor(self.declared.start)
        return x_N.long() - first


def fit_keys(space: spaces.Dict) -> list[str]:
    """The entries of dictionary observations that can be learned from."""
    return [
        key for key, one in space.items() if all(isinstance(leaf, Component) for _, leaf in components.found_in(one))
    ]


@final
class Observations:
    """Makes tensors of the observations of an environment, a row of each (`components`).

    space: of rows. Numbers are counted from 0, the channels of images come last, and after all come the legal actions.
    as_given: whether rows, without legal actions, are the observations themselves, in their dtype.

    Args:
        options: what is seen of dictionaries, and where images have their channels.
        numbered: whether the combinations of several numbers are numbered in their turn: then rows are Discrete.
        masked: how many actions there are, where observations are `Masked`; None: they are not.

    Raises:
        PgtsError: a key that the observations do not have, images that may have their channels first or last, or a
            kind of observation that no network takes.
    """

    def __init__(
        self,
        env: VectorEnv,
        options: Observed,
        device: torch.device,
        *,
        numbered: bool = False,
        masked: int | None = None,
    ) -> None:
        self.options, self.device, self.numbered, self.masked = options, device, numbered, masked
        self._what = f"the observations of {env_name(env)}"
        space, channels = env.single_observation_space, options.image_channels
        self._parts = [
            _Part(path, part, components.plainly(part, channels), components.has_channels_first(part, channels))
            for path, part in self._known(self._selected(space))
        ]
        seen: list[Component] = [part.seen for part in self._parts]
        self._row: Space[Any] = seen[0] if len(seen) == 1 else spaces.Tuple(seen)
        self._dtype = components.row_dtype(self._row)
        self.space: Space[Any] = spaces.Discrete(components.num_combinations(self._row) or 0) if numbered else self._row
        self.as_given = isinstance(space, spaces.Box | spaces.Discrete) and self.space == space
        self._inner_axes = len(components.row_shape(self.space))
        if masked is not None:
            self.space = components.with_mask(self.space, masked)
            self._masked_dtype = components.row_dtype(self.space)
        if channels is not None and not any(len(part.shape or ()) == 3 for part in seen):
            raise PgtsError(f"image_channels is {channels!r}; {self._what} are {space}, without an image of three axes")

    def _selected(self, space: Space[Any]) -> Space[Any]:
        """The space without the entries that are not seen."""
        keys = self.options.observation_keys
        if keys is None:
            return space
        known = list(space.spaces) if isinstance(space, spaces.Dict) else []
        for key in keys:
            if key not in known:
                has = f"have {', '.join(map(str, known))}" if known else f"are {space}"
                raise PgtsError(f"{self._what} have no part {key!r}; they {has}")
        selected = spaces.Dict()
        selected.spaces = {key: space[key] for key in keys}  # type: ignore[index]  # in this order, not by name
        return selected

    def _known(self, space: Space[Any]) -> list[tuple[Path, Component]]:
        """The components of a space; PgtsError where a part of it is none."""
        known: list[tuple[Path, Component]] = []
        for path, part in components.found_in(space):
            if isinstance(part, Component):
                known.append((path, part))
                continue
            strange = f"{self._what} are {type(part).__name__}, which no network takes"
            if not path or not isinstance(space, spaces.Dict):
                raise PgtsError(f"{strange}: make numbers of them by a wrapper")
            raise PgtsError(
                f"{strange}, in their part {path[0]!r}: set observation_keys to those to learn from, {fit_keys(space)}"
            )
        return known

    def encode(self, observation: Any) -> Tensor:
        """As `World.encode`."""
        if isinstance(observation, Masked) and self.masked is None:
            observation = observation.observation
        if isinstance(observation, Masked):
            rows = self.with_legal(self.rows(observation.observation), observation.legal_A)
        else:
            rows = self.rows(observation)
        return torch.from_numpy(rows).to(self.device)

    def with_legal(self, rows: np.ndarray, legal_NA: np.ndarray) -> np.ndarray:
        """Return rows of `encode` from those without legal actions; where none is, all count as legal."""
        flat = rows.reshape(*rows.shape[: rows.ndim - self._inner_axes], -1)
        legal_NA = legal_NA | ~legal_NA.any(-1, keepdims=True)
        if legal_NA.shape[:-1] != flat.shape[:-1]:
            raise PgtsError(f"action masks have the shape {legal_NA.shape}; observations have {rows.shape}")
        return np.concatenate([flat, legal_NA], -1, dtype=self._masked_dtype, casting="unsafe")

    def rows(self, observation: Any) -> np.ndarray:
        """Return the rows of observations, without their legal actions, as an array of its own."""
        found = [part.read(observation) for part in self._parts]
        if len(found) == 1 and not self.numbered:
            return np.array(found[0], self._dtype)
        # [..., *shape] -> [..., entries]; before the shape comes how many observations there are
        flat = [array.reshape(*self._before(array, part), -1) for array, part in zip(found, self._parts, strict=True)]
        if len({array.shape[:-1] for array in flat}) > 1:
            raise PgtsError(f"the parts of an observation have the shapes {[array.shape for array in found]}")
        if self.numbered:
            return np.asarray(self._numbers(flat))
        return np.concatenate(flat, -1, dtype=self._dtype, casting="unsafe")

    @cached_property
    def examples(self) -> dict[str, Tensor]:
        """Two observations as named tensors: those of each component, as the environment declares it, without those
        that are not seen. The legal actions are not among them."""
        named: dict[str, Tensor] = {}
        for part in self._parts:
            name = part.name
            while name in named:
                name += "_"
            named[name] = part.example(2)
        return named

    def row_tensors(self, given: Mapping[str, Tensor], legal_NA: Bool[Tensor, "N A"] | None) -> Tensor:
        """As `encode`, of N observations and their legal actions, as tensors like `examples` and in operations of torch
        alone, so that they can be traced; nothing is checked.

        Args:
            legal_NA: None: there are no masks. Where none is legal, all count as such.
        """
        found = [part.read_tensor(given[name]) for part, name in zip(self._parts, self.examples, strict=True)]
        flat = [x_N.reshape(x_N.shape[0], -1) for x_N in found]
        if self.numbered:
            row_N = self._numbers(flat)
        elif len(found) == 1:
            row_N = found[0].to(_torch_dtype(self._dtype))
        else:
            row_N = torch.cat([x_ND.to(_torch_dtype(self._dtype)) for x_ND in flat], 1)
        if legal_NA is None:
            return row_N
        legal_NA = legal_NA | ~legal_NA.any(-1, keepdim=True)
        row_ND = row_N.reshape(row_N.shape[0], -1).to(_torch_dtype(self._masked_dtype))
        return components.with_legal(row_ND, legal_NA)

    @staticmethod
    def _before(array: np.ndarray, part: _Part) -> tuple[int, ...]:
        return array.shape[: array.ndim - len(part.seen.shape or ())]

    def _numbers(self, flat: Sequence[Any]) -> Any:
        """The numbers of combinations, in mixed radix; the last entry counts fastest. Arrays or tensors."""
        number = 0 * flat[0][..., 0]
        for part, array in zip(self._parts, flat, strict=True):
            for k, count in enumerate(components.counts(part.seen).tolist()):
                number = number * count + array[..., k]
        return number


def _torch_dtype(dtype: np.dtype[Any]) -> torch.dtype:
    return torch.from_numpy(np.empty(0, dtype)).dtype


def _from_zero(array: np.ndarray, space: spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary) -> np.ndarray:
    """Numbers or bits of a space, counted from 0, as int64; PgtsError unless they are such."""
    if array.dtype.kind not in ("biu" if isinstance(space, spaces.MultiBinary) else "iu"):
        raise PgtsError(f"observation is of {array.dtype}; states are integers")
    first = np.asarray(0 if isinstance(space, spaces.MultiBinary) else space.start)
    number, count = array.astype(np.int64) - first, components.counts(space).reshape(space.shape or ())
    off = (number < 0) | (number >= count)
    if not off.any():
        return number
    if isinstance(space, spaces.Discrete):
        raise PgtsError(f"state {array[off].flat[0]} does not exist; states are {first} to {first + count - 1}")
    raise PgtsError(f"an observation holds {array[off].flat[0]}, where its space {space} has no such value")


def _cast(array: np.ndarray, space: spaces.Box) -> np.ndarray:
    """Numbers in the dtype of their space; PgtsError where they are none of it, NotFinite where they are not finite."""
    if array.dtype != space.dtype:
        if array.dtype.kind not in "biuf":
            raise PgtsError(f"an observation is of {array.dtype}; its space is {space}")
        given = array
        with np.errstate(over="ignore", invalid="ignore"):
            array = given.astype(space.dtype)
        if array.dtype.kind != "f" and (array != given).any():
            raise PgtsError(f"an observation holds {given[array != given].flat[0]}, which {space.dtype} cannot hold")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        off = array[~np.isfinite(array)][:3].tolist()
        raise NotFinite(f"an observation is not finite: {off}", what="observation")
    return array
