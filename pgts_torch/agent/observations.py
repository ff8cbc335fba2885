"""Observations of an environment as tensors, the inputs of policies and critics."""

from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.snapshots import env_name


@final
class Observations:
    """Makes tensors of the observations of an environment: numbers, vectors or images.

    space: of these tensors.

    Args:
        env: the environments.
        key: the entry of dictionary observations that is used.

    Raises:
        PgtsError: dictionary observations without a key, a key that they do not have, or another kind of space.
    """

    def __init__(self, env: VectorEnv, key: str | None, device: torch.device) -> None:
        space, what = env.single_observation_space, f"the observations of {env_name(env)}"
        if isinstance(space, spaces.Dict):
            known = ", ".join(map(str, space.keys()))
            if key is None:
                raise PgtsError(f"{what} are dictionaries of {known}: set observation_key to the one to learn from")
            if key not in space.spaces:
                raise PgtsError(f"{what} have no part {key!r}; they have {known}")
            space = space[key]
        elif key is not None:
            raise PgtsError(f"{what} are {space}; they have no part {key!r}")
        if not isinstance(space, spaces.Discrete | spaces.Box):
            raise PgtsError(f"{what} are {space}; a policy takes numbers, vectors or images")
        self.key, self.device, self._first = key, device, 0
        self.space: spaces.Discrete | spaces.Box = space
        if isinstance(space, spaces.Discrete):  # as tensors, numbers are counted from 0
            self._first, self.space = int(space.start), spaces.Discrete(int(space.n))

    def part(self, observation: Any) -> Any:
        """The entry of a dictionary observation that is used; other observations are returned as they are."""
        return observation if self.key is None else observation[self.key]

    def encode(self, observation: Any) -> Tensor:
        """As `World.encode`."""
        return self.encode_part(self.part(observation))

    def encode_part(self, part: Any) -> Tensor:
        """As `encode`, from the result of `part`."""
        if isinstance(self.space, spaces.Discrete):
            return states_of(part, self._first, int(self.space.n)).to(self.device)
        try:
            array = np.asarray(part)
        except ValueError as error:
            raise PgtsError(f"an observation is {part!r}; its space is {self.space}") from error
        if array.shape[max(0, array.ndim - len(self.space.shape)) :] != self.space.shape:
            raise PgtsError(f"an observation has shape {array.shape}; its space is {self.space}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            off = array[~np.isfinite(array)][:3].tolist()
            raise NotFinite(f"an observation is not finite: {off}", what="observation")
        return torch.from_numpy(np.array(array)).to(self.device)


def states_of(observation: Any, first: int, num_states: int) -> Int[Tensor, "..."]:
    """Observations that are counted from `first` on as int64 states, counted from 0; PgtsError unless they are such."""
    state = np.asarray(observation)
    if not np.issubdtype(state.dtype, np.integer):
        raise PgtsError(f"observation is of {state.dtype}; states are integers")
    off = state[(state < first) | (state >= first + num_states)]
    if off.size:
        raise PgtsError(f"state {off.flat[0]} does not exist; states are {first} to {first + num_states - 1}")
    return torch.from_numpy(np.asarray(state.astype(np.int64) - first))
