"""Copies of an environment that step together and reset by mask."""

import functools
import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeObservation, NormalizeReward, TimeLimit

from pgts_torch.errors import PgtsError, check_count, failure
from pgts_torch.models import snapshots
from pgts_torch.models.environments import (
    MOST_ACTIONS,
    EnvSource,
    all_actions,
    grid_actions,
    make_env,
    spec_like,
    spec_of,
)
from pgts_torch.models.wrappers import wrappers_of


def make_vector_env(
    env: EnvSource, num_envs: int, *, gamma: float | None, actions_per_dimension: int | None = None, **kwargs: Any
) -> VectorEnv:
    """Copies of an environment that reset by mask, without its registered time limit: the horizon is ours. Actions
    that are not numbers from 0 on, of Discrete(n, start) and MultiDiscrete, are numbered.

    Args:
        env: an id; or an instance or a spec, of which others are made; or a function that makes one.
        gamma: handed to environments that carry a discount of their own (pgts/*), if given.
        actions_per_dimension: into how many values each dimension of continuous actions is divided
            (`models.environments.grid_actions`); None: actions are discrete.
        kwargs: for gymnasium.make_vec, of an id.

    Raises:
        PgtsError: Gymnasium knows no such environment or cannot make it; or its actions cannot be divided.
    """
    if num_envs < 1:
        raise PgtsError(f"num_envs is {num_envs}; it must be at least 1")
    if not isinstance(env, str):
        return SyncVectorEnv([_maker(env, actions_per_dimension)] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
    options: dict[str, Any] = {"max_episode_steps": -1, **kwargs}
    try:
        if spec_of(env).namespace == "pgts":
            if actions_per_dimension is not None:
                raise PgtsError(f"actions_per_dimension is {actions_per_dimension}; {env} has discrete actions")
            options |= {} if gamma is None else {"gamma": gamma}
            options |= {"vectorization_mode": "vector_entry_point", "autoreset_mode": AutoresetMode.DISABLED}
        else:
            options |= {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": AutoresetMode.DISABLED}}
            numbered = functools.partial(_numbered, per_dimension=actions_per_dimension)
            options["wrappers"] = [*options.get("wrappers", ()), numbered]
        return gymnasium.make_vec(env, num_envs=num_envs, **options)
    except PgtsError:
        raise
    except (gymnasium.error.Error, ImportError, LookupError, TypeError) as error:
        raise PgtsError(f"{env} cannot be made: {error}") from error
    except BaseException as error:
        raise failure(f"{env} cannot be made", error) from error


def more_copies(env: VectorEnv, num_envs: int) -> VectorEnv:
    """Fresh copies, made as those of `env` were; PgtsError unless it is a SyncVectorEnv, which knows how."""
    if not isinstance(env, SyncVectorEnv):
        raise PgtsError(f"{env_name(env)} was given as copies that cannot be made again; give a SyncVectorEnv or an id")
    makers = itertools.islice(itertools.cycle(env.env_fns), num_envs)
    return SyncVectorEnv(list(makers), autoreset_mode=AutoresetMode.DISABLED)


def close_copies(env: VectorEnv) -> None:
    """Close them all; what one of them raises is a warning, for all that was wanted of it is done."""
    for one in env.envs if isinstance(env, SyncVectorEnv) else [env]:
        try:
            one.close()
        except BaseException as error:
            warnings.warn(str(failure(f"{env_name(env)} failed in close", error)), stacklevel=2)
    env.closed = True


def check_vector_env(env: VectorEnv) -> None:
    """PgtsError unless rollouts can be made in this environment: discrete actions, reset by mask."""
    if not isinstance(env, VectorEnv):
        raise PgtsError(f"the environment is {env!r}; it must be a VectorEnv")
    space = env.single_action_space
    if isinstance(space, spaces.Box):
        raise PgtsError(
            f"the actions of {env_name(env)} are continuous, {space}: set actions_per_dimension, into how many values "
            "each dimension of them is divided"
        )
    if not _is_numbered(space):
        raise PgtsError(f"the actions of {env_name(env)} are {space}; they must be Discrete(n) counted from 0")
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.DISABLED:
        raise PgtsError(f"the environment resets by {mode}; make it with autoreset_mode=AutoresetMode.DISABLED")


def env_name(env: VectorEnv) -> str:
    """What an error calls an environment."""
    if env.spec is None and isinstance(env, SyncVectorEnv):
        return snapshots.env_name(env.envs[0])
    return repr(env) if env.spec is None else env.spec.id


def registered_limit(env: EnvSource | VectorEnv, copies: VectorEnv) -> int | None:
    """The most steps of an episode of an environment of which copies were made, as registered or by a TimeLimit around
    it; None: no limit."""
    spec: EnvSpec | None
    if isinstance(env, str):
        spec = spec_of(env)
    elif isinstance(env, gymnasium.Env | EnvSpec):
        spec = env if isinstance(env, EnvSpec) else env.spec
    else:
        spec = copies.envs[0].spec if isinstance(copies, SyncVectorEnv) else copies.spec
    limit = None if spec is None else spec.max_episode_steps
    if spec is None and isinstance(copies, SyncVectorEnv):
        limits = [w._max_episode_steps for w in wrappers_of(copies.envs[0]) if isinstance(w, TimeLimit)]
        limit = min(limits, default=None)
    return limit if limit is not None and limit > 0 else None


def normalizing_wrapper(env: VectorEnv) -> str:
    """The name of a wrapper that normalises by running statistics of its own; empty where there is none."""
    around = wrappers_of(env.envs[0]) if isinstance(env, SyncVectorEnv) else []
    kinds = NormalizeObservation, NormalizeReward
    return next((type(wrapper).__name__ for wrapper in around if isinstance(wrapper, kinds)), "")


def _maker(env: Any, actions_per_dimension: int | None) -> Callable[[], gymnasium.Env]:
    """A function that makes another instance of an environment."""
    if not isinstance(env, gymnasium.Env | EnvSpec) and not callable(env):
        raise PgtsError(
            f"the environment is {env!r}; it must be a Gymnasium id, an environment, a function that makes one, or a "
            "VectorEnv"
        )
    source = spec_like(env) if isinstance(env, gymnasium.Env) else env
    limit = {"max_episode_steps": -1} if isinstance(source, EnvSpec) else {}
    make = functools.partial(make_env, source, **limit)
    return lambda: _numbered(make(), per_dimension=actions_per_dimension)


@final
class _Numbered(gymnasium.ActionWrapper):
    """An environment of which some actions are numbered from 0 on."""

    def __init__(self, env: gymnasium.Env, actions: Sequence[Any]) -> None:
        super().__init__(env)
        self.actions = actions
        self.action_space = spaces.Discrete(len(actions))

    def action(self, action: Any) -> Any:
        return self.actions[action]


def _numbered(env: gymnasium.Env, *, per_dimension: int | None) -> gymnasium.Env:
    """With actions that are numbers from 0 on, where that can be."""
    space, name = env.action_space, snapshots.env_name(env)
    if per_dimension is None:
        if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete) or _is_numbered(space):
            return env
        if isinstance(space, spaces.MultiDiscrete) and math.prod(space.nvec.reshape(-1).tolist()) > MOST_ACTIONS:
            raise PgtsError(f"the actions of {name} are {space}: more than {MOST_ACTIONS:,} combinations")
        return _Numbered(env, list(all_actions(space)))
    if not isinstance(space, spaces.Box):
        raise PgtsError(f"actions_per_dimension is {per_dimension}; {name} has discrete actions, {space}")
    check_count("actions_per_dimension", per_dimension)
    try:
        return _Numbered(env, grid_actions(space, per_dimension))
    except PgtsError as error:
        raise PgtsError(f"actions_per_dimension is {per_dimension}, but {name} cannot have it: {error}") from error


def own_actions(env: VectorEnv) -> np.ndarray | None:
    """What the numbers of the actions stand for in copies that `make_vector_env` made, a row each; None: the numbers
    themselves."""
    outermost = env.envs[0] if isinstance(env, SyncVectorEnv) else None
    return np.stack(outermost.actions) if isinstance(outermost, _Numbered) else None


def _is_numbered(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Discrete) and space.start == 0
