"""Action masks: which actions an environment allows in its present state, and how it says so.

    action_masks()                a method of the environment, or of a wrapper around it: the convention of MaskablePPO
    info["action_mask"]           in what reset and each step return: the convention of Gymnasium and PettingZoo
    observation["action_mask"]    an entry of dictionary observations with as many values from 0 to 1: the convention
                                  of PettingZoo, RLlib and Shimmy. It is no part of what policies see

The first of these that an environment has is read. A mask has an entry for each action, 1 (or True) where it is legal.
Of MultiDiscrete actions it has an entry for each value of each number, those of one number after those of another, or
is a tuple with an array for each number; an action is legal where all its values are. Masks are those of the layer that
gives them: a wrapper outside of it which only transforms actions is looked through; one that does so in a `step` of its
own gives masks of its own.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, Self, final

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces import Space
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv
from jaxtyping import Bool, Int

from pgts_torch.envs.cart_poles import CartPoles
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import PgtsError
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.wrappers import hook_of, wrappers_of

METHOD, KEY = "action_masks", "action_mask"

Source = Literal["method", "info", "observation"]

_BYTES = np.dtype(np.int8), np.dtype(np.uint8)


class Masked(NamedTuple):
    """An observation of an environment, or of several, with its legal actions; none of them where the episode is over,
    and it does not matter."""

    observation: Any
    legal_A: Bool[np.ndarray, "... A"]


@final
@dataclass(frozen=True, eq=False)
class ActionMasks:
    """How the masks of an environment are read.

    source: what gives them.
    num_entries: of a mask, as it is given.
    index_AJ: the entries that must all be 1 for an action to be legal, a row for each action.
    """

    source: Source
    num_entries: int
    index_AJ: Int[np.ndarray, "A J"]

    @classmethod
    def of_env(cls, env: gymnasium.Env, actions: Sequence[Any], *, source: Source) -> Self:
        """How the masks of such an environment are read.

        Args:
            actions: all actions as `env` takes them, in the order of their numbers.

        Raises:
            PgtsError: its actions are no numbers, or are transformed to something else.
        """
        layers: list[Any] = [*wrappers_of(env), env.unwrapped]
        outside: list[Any] = []  # those outside of the layer whose actions the entries stand for
        for layer in layers[:-1]:
            gives = callable(getattr(layer, METHOD, None)) if source == "method" else hook_of(layer) is None
            if gives:
                break
            outside.append(layer)
        inside = layers[len(outside) + 1 :]
        if source != "method" and any(hook_of(layer) == "action" for layer in inside[:-1]):
            around = type(layers[len(outside)]).__name__
            raise PgtsError(
                f"{env_name(env)} has {source}[{KEY!r}], and a wrapper that changes actions within {around}, which may "
                f"change the mask: say what is legal by a method {METHOD}()"
            )
        space = layers[len(outside)].action_space
        for layer in outside:
            if hook_of(layer) == "action":
                actions = [layer.action(action) for action in actions]
        if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
            raise PgtsError(
                f"{env_name(env)} has action masks, which Discrete and MultiDiscrete actions can have; its actions are "
                f"{space}: leave the masks out, or set action_masks to 'off'"
            )
        sizes = np.reshape(space.n if isinstance(space, spaces.Discrete) else space.nvec, -1)
        # an action as several numbers counted from 0, and where the entries of each number begin
        number_AJ = np.array([np.reshape(action - np.asarray(space.start), -1) for action in actions], dtype=np.int64)
        return cls(source, int(sizes.sum()), number_AJ + (sizes.cumsum() - sizes))

    @classmethod
    def plain(cls, num_actions: int, *, source: Source) -> Self:
        """Masks with an entry for each action, in the order of their numbers."""
        return cls(source, num_actions, np.arange(num_actions)[:, None])

    @property
    def what(self) -> str:
        """The convention, in words."""
        return f"{METHOD}()" if self.source == "method" else f"{self.source}[{KEY!r}]"

    def of(self, env: gymnasium.Env, observation: Any, info: Mapping[str, Any]) -> Bool[np.ndarray, "A"]:
        """The legal actions in the present state of an environment.

        Raises:
            PgtsError: there is no mask, it is none, or no action is legal.
        """
        return self.read(env.get_wrapper_attr(METHOD)() if self.source == "method" else self.given(observation, info))

    def given(self, observation: Any, info: Mapping[str, Any]) -> Any:
        """The mask, or those of several environments, as no method gives it; None: there is none."""
        given = observation if self.source == "observation" else info
        return given.get(KEY) if isinstance(given, Mapping) else None

    def after(
        self, env: gymnasium.Env, observation: Any, info: Mapping[str, Any], terminated: bool, truncated: bool
    ) -> Bool[np.ndarray, "A"]:
        """The legal actions after a step: none after an end, where no mask is needed. After a truncation they are those
        of the mask, where there is one that allows any."""
        if not terminated:
            if not truncated:
                return self.of(env, observation, info)
            with suppress(PgtsError):
                return self.of(env, observation, info)
        return np.zeros(len(self.index_AJ), dtype=bool)

    def read(self, given: Any) -> Bool[np.ndarray, "A"]:
        """The legal actions by a mask; PgtsError as in `of`."""
        if given is None:
            raise PgtsError(
                f"there is no {self.what}, which was there before: an environment that masks actions does so in each "
                "reset and step; or set action_masks to 'off'"
            )
        legal_A = self._entries(given)
        if not self._as_given:
            legal_A = legal_A[self.index_AJ].all(-1)
        if not legal_A.any():
            raise PgtsError(
                f"no action is legal by {self.what}, and the episode is not over: end it there, or allow one"
            )
        return legal_A

    @cached_property
    def _as_given(self) -> bool:
        """Whether entry a is that of action a."""
        return np.array_equal(self.index_AJ, np.arange(self.num_entries)[:, None])

    def _entries(self, given: Any) -> Bool[np.ndarray, "E"]:
        # The common forms are told in few calls: in a mask of int8 each byte is 0 or 1.
        is_plain = type(given) is np.ndarray and given.shape == (self.num_entries,)
        if is_plain and (given.dtype == np.bool_ or (given.dtype in _BYTES and max(given.tobytes()) <= 1)):
            return given.view(np.bool_)
        try:
            array = np.concatenate([np.ravel(part) for part in given]) if type(given) is tuple else np.asarray(given)
        except ValueError:
            array = np.array(None)
        is_mask = array.shape == (self.num_entries,) and array.dtype.kind in "biuf"
        if not is_mask or not ((array == 0) | (array == 1)).all():
            shown = f"an array of the shape {array.shape}" if array.size > 20 else repr(given)
            raise PgtsError(
                f"{self.what} is {shown}; it must be a vector of {self.num_entries} booleans, or of 0 and 1, one for "
                "each action; if it means something else, set action_masks to 'off'"
            )
        return array.astype(bool)

    def of_all(
        self,
        env: VectorEnv,
        observation: Any,
        info: Mapping[str, Any],
        needed_B: Bool[np.ndarray, "B"],
        allowed: Callable[[int], None],
    ) -> Bool[np.ndarray, "B A"]:
        """The legal actions in environments that step together; none where they are not needed and not given.

        Args:
            info: with an array of all masks, or with those that `_action_mask` says.
            needed_B: in which of them some action must be legal.
            allowed: called with the number of each environment before its mask is read.
        """
        legal_BA = np.zeros((env.num_envs, len(self.index_AJ)), dtype=bool)
        given_B = self._given_by_all(env, observation, info)
        for b, needed in enumerate(needed_B):
            allowed(b)
            if needed:
                legal_BA[b] = self.read(given_B[b])
            elif given_B[b] is not None:
                with suppress(PgtsError):
                    legal_BA[b] = self.read(given_B[b])
        return legal_BA

    def _given_by_all(self, env: VectorEnv, observation: Any, info: Mapping[str, Any]) -> Sequence[Any]:
        if self.source == "method":
            own: Any = getattr(env, METHOD, None) or getattr(env.unwrapped, METHOD, None)
            return own() if own is not None else env.unwrapped.call(METHOD)  # type: ignore[attr-defined]
        if (rows := self.given(observation, info)) is None:
            return [None] * env.num_envs
        is_there = np.ones(env.num_envs, dtype=bool)
        if self.source == "info":
            is_there = info.get(f"_{KEY}", is_there)
        return [row if there else None for row, there in zip(rows, is_there, strict=True)]


def masks_in(env: gymnasium.Env, actions: Sequence[Any], info: Mapping[str, Any]) -> ActionMasks | None:
    """How the masks of an environment are read, by its methods, what a reset has returned and its observation space;
    None: it has none.

    Args:
        actions: as in `ActionMasks.of_env`, which says what is raised.
    """
    if (source := _source(env, env.observation_space, info)) is None:
        return None
    return _fitting(ActionMasks.of_env(env, actions, source=source), env.observation_space)


def _source(env: gymnasium.Env | VectorEnv, space: Space[Any], info: Mapping[str, Any]) -> Source | None:
    if has_method(env):
        return "method"
    return "info" if KEY in info else "observation" if entries_in(space) else None


def _fitting(masks: ActionMasks, space: Space[Any]) -> ActionMasks | None:
    """None where the entry of observations has another size than masks have, and so is none."""
    return None if masks.source == "observation" and entries_in(space) != masks.num_entries else masks


def entries_in(space: Space[Any]) -> int:
    """How many entries the masks in such observations have; 0: there are none."""
    part = space.get(KEY) if isinstance(space, spaces.Dict) else None
    is_mask = isinstance(part, spaces.MultiBinary) or (
        isinstance(part, spaces.Box) and (part.low >= 0).all() and (part.high <= 1).all()
    )
    shape = (part.shape or ()) if part is not None and is_mask else ()
    return shape[0] if len(shape) == 1 else 0


def has_method(env: gymnasium.Env | VectorEnv) -> bool:
    """Whether `action_masks` is a method of an environment or of one of its wrappers."""
    base: Any = env.unwrapped
    layers: list[Any] = [*wrappers_of(env), base] if isinstance(env, gymnasium.Env) else [env, base]
    if any(callable(getattr(layer, METHOD, None)) for layer in layers):
        return True
    if isinstance(base, SyncVectorEnv):
        return has_method(base.envs[0])
    return isinstance(base, AsyncVectorEnv) and all(base.call("has_wrapper_attr", METHOD))


def masks_of(env: VectorEnv, make: Callable[[], gymnasium.Env] | None) -> ActionMasks | None:
    """How the masks of environments that step together are read; None: they have none, or continuous actions.

    Args:
        make: makes another one of them, which is reset to see what `info` has; None: they are reset.

    Raises:
        PgtsError: as `ActionMasks.of_env`.
    """
    base, space = env.unwrapped, env.single_action_space
    if isinstance(base, TabularVectorEnv | CartPoles) or not isinstance(space, spaces.Discrete):
        return None
    info = {} if has_method(env) else (env if make is None else make()).reset(seed=0)[1]
    if not isinstance(info, Mapping):
        raise PgtsError(f"{env_name(env)} returns an info that is {info!r} in reset; it must be a dictionary")
    if (source := _source(env, env.single_observation_space, info)) is None:
        return None
    if isinstance(base, SyncVectorEnv):
        masks = ActionMasks.of_env(base.envs[0], range(int(space.n)), source=source)
    else:
        masks = ActionMasks.plain(int(space.n), source=source)
    return _fitting(masks, env.single_observation_space)
