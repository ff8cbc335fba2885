"""Environments as models need them: made anew, their actions in a list, what they say held to what they declare."""

import contextlib
import importlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces, wrappers
from gymnasium.envs.registration import EnvSpec

from pgts_torch.errors import NotFinite, PgtsError, failure
from pgts_torch.models.attributes import attributes, changing, different, told
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.steps import check_rewards
from pgts_torch.models.wrappers import transforms_of, wrappers_of
from pgts_torch.seeding import numpy_stream

EnvSource = str | EnvSpec | gymnasium.Env | Callable[[], gymnasium.Env]
"""What an environment can be made from: an id, a spec, another instance (by its spec) or a function."""

MOST_ACTIONS = 10_000
"""That are made of those of several dimensions."""

_ACTIONS_DRAWN = 20


def make_env(env: EnvSource, **kwargs: Any) -> gymnasium.Env:
    """A new environment, with these arguments if `env` is an id or a spec. An instance is not used itself: another one
    is made from its spec, and has to be like it.

    Raises:
        PgtsError: there is no such id, an extra is missing, an instance is not what its spec makes (`spec_like`), a
            function makes none, or the environment raises an error of its own.
    """
    if isinstance(env, gymnasium.Env):
        env = spec_like(env)
    if not isinstance(env, str | EnvSpec):
        try:
            made = env()
        except PgtsError:
            raise
        except BaseException as error:
            raise failure(f"{getattr(env, '__name__', env)} cannot be made", error) from error
        if not isinstance(made, gymnasium.Env):
            raise PgtsError(f"{env!r} gave {made!r}; it must be a Gymnasium environment")
        return made
    name = env if isinstance(env, str) else env.id
    register(name)
    try:
        return gymnasium.make(env, **kwargs)
    except gymnasium.error.DependencyNotInstalled as error:
        raise PgtsError(f"{name} needs something that is not installed: {error}") from error
    except (gymnasium.error.Error, ModuleNotFoundError, TypeError) as error:
        raise PgtsError(f"{name} cannot be made: {error}") from error
    except BaseException as error:
        raise failure(f"{name} cannot be made", error) from error


def spec_like(env: gymnasium.Env) -> EnvSpec:
    """The spec of an instance, from which others are made that are like it, in whatever state it is.

    Raises:
        PgtsError: it has none, or what this makes has other wrappers, or another value of an attribute that neither
            reset nor step changes: the message names it.
    """
    name = env_name(env)
    if env.spec is None:
        raise PgtsError(f"{name} has no spec to make another instance from: give a function that makes one")
    way_out = "give a function that makes it as it is"
    try:
        made = make_env(env.spec)
    except PgtsError as error:
        raise PgtsError(
            f"{name} was given as an instance that its spec cannot make again ({error}): {way_out}"
        ) from error
    kinds = [[type(layer) for layer in (*wrappers_of(one), one.unwrapped)] for one in (env, made)]
    if kinds[0] != kinds[1]:
        given, other = (" in ".join(kind.__name__ for kind in reversed(each)) for each in kinds)
        raise PgtsError(f"{name} was given as an instance, {given}, of whose spec comes {other}: {way_out}")
    own, held = attributes(env), attributes(made)
    names = different(own, held)
    if names:
        try:
            names -= changing(made, drawn_actions(made, 0), numpy_stream(0, "spec_like"))
        except Exception as error:
            raise failure(f"{name} failed in a random walk", error) from error
    if names:
        raise PgtsError(f"{name} was given as an instance with {told(min(names), own, held)} of its spec: {way_out}")
    return env.spec


_MODULES = {"MiniGrid-": ("minigrid", "envs"), "BabyAI-": ("minigrid", "envs"), "ALE/": ("ale_py", "atari")}
"""Environments that are registered by a module, by the start of their ids, and the extra that installs it."""


def register(env_id: str) -> None:
    """Import what registers an environment with Gymnasium: the module of `MODULE:ID`, or one that is known.

    Raises:
        PgtsError: it is not installed; the message names the extra, if there is one.
    """
    own, colon, _ = env_id.rpartition(":")
    if colon:
        try:
            importlib.import_module(own)
        except ModuleNotFoundError as error:
            raise PgtsError(f"{env_id} cannot be made: {error}") from error
    for start, (module, extra) in _MODULES.items():
        if env_id.startswith(start):
            try:
                importlib.import_module(module)
            except ModuleNotFoundError as error:
                raise PgtsError(f"{env_id} needs {module}: pip install 'pgts_torch[{extra}]'") from error


def spec_of(env_id: str) -> EnvSpec:
    """What Gymnasium knows of an id; its own error where it knows nothing."""
    register(env_id)
    return gymnasium.spec(env_id.rpartition(":")[2])


def all_actions(space: spaces.Space) -> Iterator[Any]:
    """Every action of a Discrete or MultiDiscrete space.

    Raises:
        PgtsError: the space is another one.
    """
    if isinstance(space, spaces.Discrete):
        return (int(space.start) + a for a in range(int(space.n)))
    if isinstance(space, spaces.MultiDiscrete):
        shape, start = space.nvec.shape, space.start
        each = itertools.product(*[range(n) for n in space.nvec.reshape(-1)])
        return (np.array(action, dtype=space.dtype).reshape(shape) + start for action in each)
    raise PgtsError(f"the actions of {space} cannot be listed: give some, as grid_actions or sampled_actions do")


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
    """`count` actions drawn uniformly from a bounded Box.

    Raises:
        PgtsError: the space is no bounded Box, or count is below 1.
    """
    low, high = _bounds(space)
    if count < 1:
        raise PgtsError(f"count is {count}; it must be at least 1")
    drawn = numpy_stream(seed, "actions").uniform(low, high, (count, *low.shape))
    return list(drawn.astype(low.dtype))


def _bounds(space: spaces.Space) -> tuple[np.ndarray, np.ndarray]:
    if not (isinstance(space, spaces.Box) and space.is_bounded()):
        raise PgtsError(f"{space} is no bounded Box")
    return space.low, space.high


def check_step(space: spaces.Space, observation: Any, reward: float) -> None:
    """PgtsError, NotFinite where that is it, unless a step may give this."""
    check_rewards(reward)
    _check_observation(space, observation)


def _check_observation(space: spaces.Space, value: Any) -> None:
    if isinstance(space, spaces.Box):
        try:
            array = np.asarray(value)
        except ValueError:
            raise PgtsError(f"the observation is {value!r}, which has no shape; {space.shape} is declared") from None
        if array.shape != space.shape:
            raise PgtsError(f"the observation has shape {array.shape}; {space.shape} is declared")
        # What a vector environment would put into its array of this dtype.
        if array.dtype != space.dtype and not np.can_cast(array.dtype, space.dtype, "same_kind"):
            raise PgtsError(f"the observation is of {array.dtype}; {space.dtype} is declared")
        if space.dtype.kind == "f" and not np.isfinite(array).all():
            raise NotFinite(f"the observation is {array.tolist()}; it must be finite", what="observation")
    elif isinstance(space, spaces.Dict):
        if not isinstance(value, dict) or value.keys() != space.keys():
            raise PgtsError(f"the observation is no dict of {', '.join(map(str, space.keys()))}")
        for name in space:
            _check_observation(space[name], value[name])
    elif isinstance(space, spaces.Tuple):
        if not isinstance(value, tuple) or len(value) != len(space):
            raise PgtsError(f"the observation is no tuple of {len(space)} parts")
        for part, content in zip(space, value, strict=True):
            _check_observation(part, content)
    elif isinstance(space, spaces.Discrete) and not space.contains(value):
        raise PgtsError(f"the observation is {value!r}, which is not in {space}")


def as_declared(space: spaces.Space, value: Any) -> Any:
    """An observation in the dtypes that its space declares, in which a policy sees it; what the space cannot hold stays
    as it is."""
    if isinstance(space, spaces.Dict) and isinstance(value, dict):
        return {name: as_declared(space[name], part) if name in space.spaces else part for name, part in value.items()}
    if isinstance(space, spaces.Tuple) and isinstance(value, tuple) and len(value) == len(space):
        return tuple(map(as_declared, space, value))
    if isinstance(space, spaces.Box):
        with contextlib.suppress(PgtsError), np.errstate(over="ignore"):
            _check_observation(space, value)
            return np.asarray(value).astype(space.dtype)
    return value


def with_torques(env: gymnasium.Env, count: int = 5) -> gymnasium.Env:
    """An environment with continuous actions, as Pendulum, under `count` values of each dimension of them, evenly
    spaced from the lowest to the highest. PgtsError as in `grid_actions`."""
    actions = grid_actions(env.action_space, count)
    return wrappers.TransformAction(env, actions.__getitem__, spaces.Discrete(len(actions)))


def base_actions(env: gymnasium.Env) -> list[Any]:
    """What each action of a discrete space becomes on its way through the wrappers of `env`."""
    inner = transforms_of(env).action
    return [inner(action) for action in all_actions(env.action_space)]


def drawn_actions(env: gymnasium.Env, seed: int) -> list[Any]:
    """Some actions of an instance that nobody else needs."""
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(_ACTIONS_DRAWN)]


_OWN_GENERATORS = ("gymnasium.envs.toy_text.", "gymnasium.envs.classic_control.", "pgts_torch.envs.")
_WITHOUT_GENERATORS = ("gymnasium.wrappers.common", "pgts_torch.agent.copies")


def draws_its_own(env: Any) -> bool:
    """Whether an environment is known to draw from generators of its own alone, and never from those of a process."""
    around, base = wrappers_of(env), env.unwrapped
    known = all(type(wrapper).__module__ in _WITHOUT_GENERATORS for wrapper in around)
    changed = any({"step", "reset"} & vars(each).keys() for each in (*around, base))
    return known and not changed and type(base).__module__.startswith(_OWN_GENERATORS)
