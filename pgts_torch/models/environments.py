"""The environment that a user gives, understood once: `EnvSource` makes others of its kind, whatever it is."""

import copy
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import TimeLimit

from pgts_torch.envs.cart_poles import CartPoles, is_cart_pole
from pgts_torch.errors import PgtsError, check_count, failure, warn
from pgts_torch.models.actions import Numbered, is_numbered, numbered
from pgts_torch.models.attributes import Unlike, own_to_each, unlike
from pgts_torch.models.ids import Maker, import_modules, maker_named, making, registered, spec_of
from pgts_torch.models.snapshots import each_of, env_name
from pgts_torch.models.squash import Squash, Squashed, squash_of
from pgts_torch.models.wrappers import wrappers_of
from pgts_torch.seeding import numpy_stream

Given = str | EnvSpec | gymnasium.Env | VectorEnv | Callable[[], gymnasium.Env]
"""What a user may give as an environment."""

_TOGETHER = 8
"""From so many environments on the array operations of a vectorised form take less time than their single steps."""

SLOW = "slow environments are shared out by pgts train --processes N"
"""What is there in place of an AsyncVectorEnv."""


@final
@dataclass(eq=False)
class EnvSource:
    """What environments are made from. `EnvSource.of` reads what a user gives; everything else takes this.

    name: what errors call it.
    makers: each makes one environment; several take turns.
    spec: as it is registered; None where that is unknown.
    description: what a saved model says of it, its id; None where it was given as an object, which no file holds.
    given: environments that were given as a VectorEnv, to train in; None: some are made for that, too.
    make_together: makes `num_envs` that step together, of which none can be looked at by itself; None: `makers` do.
    has_table: whether a model needs no more than the table of `make_together`.
    actions_per_dimension, vectors: as in `of`.
    """

    name: str
    makers: Sequence[Maker]
    spec: EnvSpec | None = None
    description: str | None = None
    given: VectorEnv | None = None
    make_together: Callable[[int], VectorEnv] | None = None
    has_table: bool = False
    actions_per_dimension: int | None = None
    vectors: bool = False
    _known: weakref.WeakValueDictionary[int, gymnasium.Env] = field(default_factory=weakref.WeakValueDictionary)

    @classmethod
    def of(
        cls,
        env: Given,
        *,
        kwargs: Mapping[str, Any] | None = None,
        gamma: float | None = None,
        actions_per_dimension: int | None = None,
        vectors: bool = False,
    ) -> "EnvSource":
        """Read what a user gives.

        Args:
            env: an id, as gymnasium.make takes it, or MODULE:NAME of a class; a spec; an instance, which is only looked
                at: others are made from its spec and have to be like it; a function that makes a new environment; or
                several as a VectorEnv that resets by mask.
            kwargs: for gymnasium.make, of an id.
            gamma: handed to environments that carry a discount of their own, pgts/*, by their id.
            actions_per_dimension: into how many evenly spaced values each dimension of continuous actions is divided;
                None: actions are discrete.
            vectors: whether actions are vectors of real numbers (`Squashed`).

        Raises:
            PgtsError: it is none of these, or takes none of these options; an instance is not what its spec makes; or
                a VectorEnv does not take numbers as actions, or resets in another way.
        """
        source = cls._of(env, kwargs, gamma, actions_per_dimension)
        if vectors and source.given is not None:
            raise PgtsError(
                f"{source.name} was given as a VectorEnv, which takes its own actions; policy.type gaussian needs an "
                "id or a function, of which it makes environments"
            )
        if vectors and actions_per_dimension is not None:
            raise PgtsError(
                f"actions_per_dimension is {actions_per_dimension}, which divides continuous actions; policy.type "
                "gaussian takes them as they are: leave one of the two out"
            )
        source.vectors = vectors
        return source

    @classmethod
    def _of(
        cls, env: Given, kwargs: Mapping[str, Any] | None, gamma: float | None, actions_per_dimension: int | None
    ) -> "EnvSource":
        if isinstance(env, str):
            return cls._of_id(env, dict(kwargs or {}), gamma, actions_per_dimension)
        if kwargs:
            raise PgtsError(f"env_kwargs is {kwargs}; an environment that is given as an object takes none")
        if isinstance(env, VectorEnv):
            if (n := actions_per_dimension) is not None:
                raise PgtsError(f"actions_per_dimension is {n}; a VectorEnv takes its own actions, make them discrete")
            return cls._of_several(env)
        if isinstance(env, gymnasium.Env):
            env = _spec_like(env)
        if isinstance(env, EnvSpec):
            return cls(env.id, [registered(env)], spec=env, actions_per_dimension=actions_per_dimension)
        if callable(env):
            name, function = getattr(env, "__name__", str(env)), env
            return cls(name, [lambda **_: function()], actions_per_dimension=actions_per_dimension)
        raise PgtsError(
            f"the environment is {env!r}; it must be a Gymnasium id, an environment, a function that makes one, or a "
            "VectorEnv"
        )

    @classmethod
    def _of_id(cls, env_id: str, kwargs: dict[str, Any], gamma: float | None, count: int | None) -> "EnvSource":
        import_modules(env_id)
        if (spec := spec_of(env_id)) is not None:
            env_id = f"{env_id[: env_id.rfind(':') + 1]}{spec.id}"  # with its version, so that it means the same later
        elif (named := maker_named(env_id)) is not None:
            return cls(env_id, [lambda **_: named(**kwargs)], description=env_id, actions_per_dimension=count)
        ours = spec is not None and spec.namespace == "pgts"
        if ours and count is not None:
            raise PgtsError(f"actions_per_dimension is {count}; {env_id} has discrete actions")
        kwargs |= {"gamma": gamma} if ours and gamma is not None else {}
        make = registered(env_id, **kwargs)
        source = cls(env_id, [make], spec=spec, description=env_id, actions_per_dimension=count)
        if ours:
            modes = {"vectorization_mode": "vector_entry_point", "max_episode_steps": -1}
            options: dict[str, Any] = modes | {"autoreset_mode": AutoresetMode.DISABLED} | kwargs
            source.make_together, source.has_table = partial(gymnasium.make_vec, env_id, **options), True
        elif spec is not None and count is None and is_cart_pole(spec, kwargs):
            source.make_together = partial(CartPoles, spec=spec, **kwargs)
        return source

    @classmethod
    def _of_several(cls, env: VectorEnv) -> "EnvSource":
        check_vector_env(env)
        if not isinstance(env, SyncVectorEnv):
            return cls(env_name(env), [], spec=env.spec, given=env)
        source = cls(env_name(env), [lambda make=make, **_: make() for make in env.env_fns], given=env)
        for one in env.envs:
            source._check_new(one)
        return source

    def make(self, num_envs: int, *, one_by_one: bool = False) -> VectorEnv:
        """New environments that step together and reset by mask. Their actions are numbers from 0 on, and they have no
        registered time limit: the horizon of a rollout ends their episodes.

        Args:
            one_by_one: whether a model may have to look at each of them. It changes no bit of what they return.

        Raises:
            PgtsError: `num_envs` is no whole number above 0; Gymnasium knows no such environment or cannot make it; its
                actions cannot be numbered; or a VectorEnv was given, of which no others can be made or others than it.
        """
        check_count("num_envs", num_envs)
        with making(self.name):
            if self.make_together is not None and (self.has_table or not (one_by_one or num_envs < _TOGETHER)):
                return self.make_together(num_envs)
            makers = [lambda k=k: self.like(k) for k in range(num_envs)]
            made = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)
        check_vector_env(made, vectors=self.vectors)
        if self.given is not None:
            self._check_like(each_of(self.given), made.envs)
        return made

    def like(self, k: int = 0, **options: Any) -> gymnasium.Env:
        """A new environment, as environment k of those that `make` gives, with further options as in `make_one`."""
        made = self.make_one(k, max_episode_steps=-1, **options)
        return Squashed(made) if self.vectors else numbered(made, per_dimension=self.actions_per_dimension)

    def make_one(self, k: int = 0, **options: Any) -> gymnasium.Env:
        """A new environment as it is registered or given, with its own actions and time limit; PgtsError as `make`. Of
        several makers number k makes it, by an id with these options of gymnasium.make."""
        if not self.makers:
            raise PgtsError(
                f"{self.name} was given as a VectorEnv of which no others can be made; give a SyncVectorEnv or an id "
                f"({SLOW})"
            )
        with making(self.name):
            made = self.makers[k % len(self.makers)](**options)
        if not isinstance(made, gymnasium.Env):
            raise PgtsError(f"{self.name} gave {made!r}; it must be a Gymnasium environment")
        for name in ("observation_space", "action_space"):
            if not isinstance(space := getattr(made, name, None), spaces.Space):
                raise PgtsError(f"{self.name} has no {name}; an environment sets it to one of gymnasium.spaces")
            if type(space).__eq__ is object.__eq__:  # not even to that of the next environment
                raise PgtsError(
                    f"{self.name} has the {name} {type(space).__name__}, which is equal to no other one: make it one "
                    "of gymnasium.spaces, for instance by a wrapper"
                )
        self._check_new(made)
        return made

    def own_actions(self, envs: VectorEnv) -> np.ndarray | None:
        """What the numbers of actions stand for in environments of `make`, a row each; None: the numbers themselves."""
        outermost = each_of(envs)[0]
        return np.stack(outermost.actions) if isinstance(outermost, Numbered) and envs is not self.given else None

    def squash(self, envs: VectorEnv) -> Squash | None:
        """What squashes actions in environments of `make`; None where these are numbers."""
        return squash_of(each_of(envs)[0]) if self.vectors else None

    @cached_property
    def time_limit(self) -> int | None:
        """The most steps of an episode, as registered or by a TimeLimit around the environment; None: no limit."""
        spec, limits = self.spec, list[int]()
        if (spec is None or spec.max_episode_steps is None) and self.makers:
            with closing_made(self.make_one) as make:
                env = make() if self.given is None else each_of(self.given)[0]
                spec = env.spec
                limits = [each._max_episode_steps for each in wrappers_of(env) if isinstance(each, TimeLimit)]
        registered = spec.max_episode_steps if spec is not None else None
        limit = min(limits, default=None) if registered is None else registered
        return limit if limit is not None and limit > 0 else None

    def _check_new(self, env: gymnasium.Env) -> None:
        """PgtsError if this environment was made before."""
        base = env.unwrapped
        if self._known.get(id(base)) is base:
            raise PgtsError(
                f"{self.name} gave the same environment twice; the function that makes it must make a new one each time"
            )
        self._known[id(base)] = base

    def _check_like(self, envs: Sequence[gymnasium.Env], made: Sequence[gymnasium.Env]) -> None:
        """PgtsError if environments that were given are not what their functions make."""
        found = _unlike(envs, made, self.like, self.name)
        if found and (found := _unlike(envs, made, self.like, self.name, apart=own_to_each(self.like))):
            raise PgtsError(
                f"environment {found.number} of {self.name} has {found.what}: others come from its function, "
                "which has to make it as it is"
            )


def check_vector_env(env: VectorEnv, *, vectors: bool = False) -> None:
    """PgtsError unless rollouts can be made in these environments: discrete actions, or vectors, reset by mask."""
    space = env.single_action_space
    if isinstance(space, spaces.Box) and not vectors:
        raise PgtsError(
            f"the actions of {env_name(env)} are continuous, {space}: take the policy 'gaussian', or set "
            "actions_per_dimension, into how many values each dimension of them is divided"
        )
    if not vectors and not is_numbered(space):
        raise PgtsError(
            f"the actions of {env_name(env)} are {space}; they must be Discrete, MultiDiscrete, MultiBinary or "
            "Box; those of a VectorEnv Discrete(n) counted from 0"
        )
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.DISABLED:
        raise PgtsError(f"the environment resets by {mode}; make it with autoreset_mode=AutoresetMode.DISABLED")


def close_environments(env: VectorEnv) -> None:
    """Close them all; what one of them raises is a warning, for all that was wanted of it is done."""
    _close(each_of(env))
    env.closed = True


@contextmanager
def closing_made(make: Maker) -> Iterator[Maker]:
    """The same function; the environments that it has made in this context are closed at its end."""
    made = list[gymnasium.Env]()

    def kept(*args: Any, **options: Any) -> gymnasium.Env:
        made.append(make(*args, **options))
        return made[-1]

    try:
        yield kept
    finally:
        _close(made)


def _close(envs: Sequence[Any]) -> None:
    for env in envs:
        try:
            env.close()
        except BaseException as error:
            warn(str(failure(f"{env_name(env)} failed in close", error)))


def kinds_of(env: gymnasium.Env) -> list[type]:
    """The class of each wrapper, from the outside, and of the environment."""
    return [*map(type, wrappers_of(env)), type(env.unwrapped)]


def _spec_like(env: gymnasium.Env) -> EnvSpec:
    """The spec of an instance, from which others are made that are like it, in whatever state it is.

    Raises:
        PgtsError: it has none, or what this makes has other wrappers, or another value of an attribute that does not
            change from reset to reset or step to step: the message names it.
    """
    name = env_name(env)
    if env.spec is None:
        raise PgtsError(f"{name} has no spec to make another instance from: give a function that makes one")
    if isinstance(env, TimeLimit) and type(env) is type(env.env) is TimeLimit:
        # A spec has only the outermost limit; the shortest ends an episode.
        spec = copy.copy(_spec_like(env.env))
        spec.max_episode_steps = min(env._max_episode_steps, spec.max_episode_steps or env._max_episode_steps)
        return spec
    given, way_out = f"{name} was given as an instance", "give a function that makes it as it is"
    try:
        with making(name):
            made = gymnasium.make(env.spec)
    except PgtsError as error:
        raise PgtsError(f"{given} that its spec cannot make again ({error}): {way_out}") from error
    with closing(made):
        if kinds_of(env) != kinds_of(made):
            own, other = (" in ".join(kind.__name__ for kind in reversed(kinds_of(each))) for each in (env, made))
            raise PgtsError(f"{given}, {own}, of whose spec comes {other}: {way_out}")
        if found := _unlike([env], [made], lambda: made, name):
            raise PgtsError(f"{given} with {found.what} of its spec: {way_out}")
    return env.spec


def _unlike(
    envs: Sequence[gymnasium.Env], new: Sequence[gymnasium.Env], make: Maker, name: str, **apart: Any
) -> Unlike | None:
    try:
        return unlike(envs, new, make, numpy_stream(0, "unlike"), **apart)
    except PgtsError as error:
        raise failure(f"{name} failed in a random walk", error) from error
