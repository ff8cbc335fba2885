"""Actions as a lookahead needs them: enumerated, with numbers from 0 on."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium import spaces, wrappers

from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.wrappers import transforms_of
from pgts_torch.seeding import numpy_stream

MOST_ACTIONS = 10_000
"""The most actions that the values of several dimensions are combined to."""


def all_actions(space: spaces.Space) -> Iterator[Any]:
    """Every action of a Discrete, MultiDiscrete or MultiBinary space. Numbers are those of numpy, as a VectorEnv hands
    them to its environments: of numbers of Python a step may make other bits.

    Raises:
        PgtsError: the space is another one.
    """
    if isinstance(space, spaces.Discrete):
        return iter(np.arange(space.start, space.start + space.n, dtype=np.int64))
    if isinstance(space, spaces.MultiDiscrete):
        shape, start = space.nvec.shape, space.start
        each = itertools.product(*[range(n) for n in space.nvec.reshape(-1)])
        return (np.array(action, dtype=space.dtype).reshape(shape) + start for action in each)
    if isinstance(space, spaces.MultiBinary):
        every = itertools.product((0, 1), repeat=math.prod(space.shape))
        return (np.array(action, dtype=space.dtype).reshape(space.shape) for action in every)
    raise PgtsError(f"the actions of {space} cannot be enumerated: give some, as grid_actions or sampled_actions do")


def grid_actions(space: spaces.Space, per_dimension: int) -> list[np.ndarray]:
    """A grid over a bounded Box, `per_dimension` values from lowest to highest in each dimension.

    Raises:
        PgtsError: the space is no bounded Box, there are fewer than 2 values, or more than 10,000 actions.
    """
    low, high = _bounds(space)
    if per_dimension < 2 or per_dimension**low.size > MOST_ACTIONS:
        raise PgtsError(
            f"per_dimension is {per_dimension}; it must be at least 2 and give at most 10,000 actions in "
            f"{low.size} dimensions: see sampled_actions"
        )
    values = np.linspace(low.reshape(-1), high.reshape(-1), per_dimension, dtype=low.dtype)
    return [np.array(action, low.dtype).reshape(low.shape) for action in itertools.product(*values.T)]


def sampled_actions(space: spaces.Space, count: int, *, seed: int) -> list[np.ndarray]:
    """`count` actions sampled uniformly from a bounded Box.

    Raises:
        PgtsError: the space is no bounded Box, or count is below 1.
    """
    low, high = _bounds(space)
    if count < 1:
        raise PgtsError(f"count is {count}; it must be at least 1")
    sampled = numpy_stream(seed, "actions").uniform(low, high, (count, *low.shape))
    return list(sampled.astype(low.dtype))


def _bounds(space: spaces.Space) -> tuple[np.ndarray, np.ndarray]:
    if not (isinstance(space, spaces.Box) and space.is_bounded()):
        raise PgtsError(f"{space} is no bounded Box")
    return space.low, space.high


def with_torques(env: gymnasium.Env, count: int = 5) -> gymnasium.Env:
    """An environment with continuous actions, as Pendulum, under `count` values of each dimension of them, evenly
    spaced from the lowest to the highest. PgtsError as in `grid_actions`."""
    actions = grid_actions(env.action_space, count)
    return wrappers.TransformAction(env, actions.__getitem__, spaces.Discrete(len(actions)))


def base_actions(env: gymnasium.Env) -> list[Any]:
    """For each action of a discrete space the action of the environment inside the wrappers of `env`."""
    inner = transforms_of(env).action
    return [inner(action) for action in all_actions(env.action_space)]


@final
class Numbered(gymnasium.ActionWrapper):
    """An environment whose actions are numbers from 0 on: positions in `actions`."""

    def __init__(self, env: gymnasium.Env, actions: Sequence[Any]) -> None:
        super().__init__(env)
        self.actions = actions
        self.action_space = spaces.Discrete(len(actions))

    def action(self, action: Any) -> Any:
        return self.actions[action]


def numbered(env: gymnasium.Env, *, per_dimension: int | None) -> gymnasium.Env:
    """The environment under actions that are numbers from 0 on, where that is possible.

    Args:
        per_dimension: into how many values each dimension of continuous actions is divided; None: they stay as they
            are.

    Raises:
        PgtsError: the actions cannot be divided, or there are more than 10,000 combinations.
    """
    space, name = env.action_space, env_name(env)
    if per_dimension is None:
        if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary) or is_numbered(space):
            return env
        each = (
            2 * np.ones(space.shape, np.int64) if isinstance(space, spaces.MultiBinary) else getattr(space, "nvec", 1)
        )
        if math.prod(np.reshape(each, -1).tolist()) > MOST_ACTIONS:
            raise PgtsError(f"the actions of {name} are {space}: more than {MOST_ACTIONS:,} combinations")
        return Numbered(env, list(all_actions(space)))
    if not isinstance(space, spaces.Box):
        raise PgtsError(f"actions_per_dimension is {per_dimension}; {name} has discrete actions, {space}")
    check_count("actions_per_dimension", per_dimension)
    try:
        return Numbered(env, grid_actions(space, per_dimension))
    except PgtsError as error:
        raise PgtsError(f"actions_per_dimension is {per_dimension}, but {name} cannot have it: {error}") from error


def is_numbered(space: spaces.Space) -> bool:
    """Whether actions are numbers from 0 on."""
    return isinstance(space, spaces.Discrete) and space.start == 0
