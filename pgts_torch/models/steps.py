"""Rewards, discounts and observations of a step, in all forms in which environments return them."""

import contextlib
import math
from collections.abc import Mapping
from decimal import Decimal
from numbers import Real
from typing import Any

import numpy as np
from gymnasium import spaces
from torch import Tensor, float64

from pgts_torch.errors import Failed, NotFinite, PgtsError

LARGEST_REWARD = float(np.finfo(np.float64).max) ** (1 / 3)
"""The largest size of a reward that is learned from: means of squares of returns stay numbers."""


_NUMBERS = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)

_SHORT = 32
"""Up to so many numbers of an observation are added one by one, to see whether all are finite."""


def number_of(what: str, value: Any) -> float:
    """A number, or an array, tensor or list of one number, as a float.

    Args:
        what: the word for it in a message: "reward", "discount".

    Raises:
        PgtsError: it is something else, as an array of several numbers; the message has its shape.
    """
    if type(value) is float:
        return value
    if isinstance(value, float | int | np.floating | np.integer):
        return _as_float(what, value)
    try:
        array = np.asarray(_plain(value))
    except (ValueError, TypeError):
        array = np.array(None)
    if array.size != 1:
        way_out = ", which a gymnasium.RewardWrapper can make of several" * (what == "reward" and array.size > 1)
        raise PgtsError(f"the {what} has shape {array.shape}; it must be one number{way_out}")
    (single,) = array.reshape(-1).tolist()
    if not isinstance(single, Real | Decimal):
        raise PgtsError(f"the {what} is {value!r}; it must be one number")
    return _as_float(what, single)


def _as_float(what: str, number: Any) -> float:
    try:
        return float(number)
    except OverflowError:
        raise NotFinite(f"the {what} is a whole number that no float can hold", what=what) from None


def _plain(value: Any) -> Any:
    """A tensor as numpy knows it."""
    return value.detach().to("cpu", float64).numpy() if isinstance(value, Tensor) else value


def rewards_of(values: Any, count: int) -> np.ndarray:
    """The rewards of environments that step together, one number each, in float64.

    Raises:
        PgtsError: there is another count of them, or they are no numbers.
    """
    try:
        reward_B = np.array(_plain(values), dtype=np.float64, ndmin=1)
    except (ValueError, TypeError) as error:
        raise PgtsError(f"the rewards are {values!r}; they must be {count} numbers") from error
    if reward_B.size != count or len(reward_B) != count:
        raise PgtsError(f"the rewards have shape {reward_B.shape}; they must be {count} numbers, one each")
    return reward_B.reshape(count)


def check_rewards(reward: float | np.ndarray) -> None:
    """NotFinite unless these are finite, and small enough to be learned from."""
    if type(reward) is float and -LARGEST_REWARD <= reward <= LARGEST_REWARD:
        return
    size = np.abs(reward)
    if (size <= LARGEST_REWARD).all():
        return
    if np.isfinite(reward).all():
        raise NotFinite(f"the reward is {np.max(size)} in size; it must be at most {LARGEST_REWARD:.2g}", what="reward")
    if isinstance(reward, float):
        raise NotFinite(f"the reward is {reward}", what="reward")
    raise NotFinite(f"the rewards are {reward.tolist()}; they must be finite", what="reward")


def check_info(info: Any) -> None:
    """Failed unless what a reset or a step says besides is a dictionary."""
    if not isinstance(info, Mapping):
        raise Failed(f"info is {info!r}; reset and step must return a dictionary, which may be empty")


def names_discounts(env: Any) -> bool:
    """Whether `info["discount"]` of this environment is the discount of a step: where `metadata["discounts"]` is True.
    Elsewhere the key has a meaning of the environment's own."""
    return bool((env.metadata or {}).get("discounts", False))


def discount_of(info: Mapping[str, Any], gamma: float, *, named: bool) -> float:
    """The discount of a step that ends no episode: that which it names, or gamma.

    Args:
        named: whether the environment names discounts (`names_discounts`).

    Raises:
        PgtsError: it is outside [0, 1]; NotFinite where it is no finite number.
    """
    if not named or "discount" not in info:
        return gamma
    discount = number_of("discount", info["discount"])
    check_discounts(np.array([discount]))
    return discount


def check_discounts(discount_B: np.ndarray) -> None:
    """PgtsError unless these are in [0, 1]; NotFinite where one is no finite number."""
    if not np.isfinite(discount_B).all():
        raise NotFinite(f"the discounts are {discount_B.tolist()}; they must be finite", what="discount")
    off_B = (discount_B < 0) | (discount_B > 1)
    if off_B.any():
        raise PgtsError(f"the discount is {discount_B[off_B][0]}; it must be in [0, 1]")


def check_observation(space: spaces.Space, value: Any) -> None:
    """PgtsError, NotFinite where that is it, unless a step may give this observation."""
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
        if space.dtype.kind == "f" and not _all_finite(array):
            raise NotFinite(f"the observation is {array.tolist()}; it must be finite", what="observation")
    elif isinstance(space, spaces.Dict):
        if not isinstance(value, dict) or value.keys() != space.keys():
            raise PgtsError(f"the observation is no dict of {', '.join(map(str, space.keys()))}")
        for name in space:
            check_observation(space[name], value[name])
    elif isinstance(space, spaces.Tuple):
        if not isinstance(value, tuple) or len(value) != len(space):
            raise PgtsError(f"the observation is no tuple of {len(space)} parts")
        for part, content in zip(space, value, strict=True):
            check_observation(part, content)
    elif isinstance(space, _NUMBERS) and not space.contains(value):
        raise PgtsError(f"the observation is {value!r}, which is not in {space}")


def _all_finite(array: np.ndarray) -> bool:
    # A short sum costs a sixth of what numpy takes for so few numbers; where it overflows, numpy decides.
    short = array.ndim == 1 and len(array) <= _SHORT
    return (short and math.isfinite(sum(array.tolist()))) or bool(np.isfinite(array).all())


def as_declared(space: spaces.Space, value: Any) -> Any:
    """An observation in the dtypes that its space declares, in which a policy sees it; what the space cannot hold stays
    as it is."""
    if isinstance(space, spaces.Dict) and isinstance(value, dict):
        return {name: as_declared(space[name], part) if name in space.spaces else part for name, part in value.items()}
    if isinstance(space, spaces.Tuple) and isinstance(value, tuple) and len(value) == len(space):
        return tuple(map(as_declared, space, value))
    if isinstance(space, spaces.Box):
        with contextlib.suppress(PgtsError), np.errstate(over="ignore"):
            check_observation(space, value)
            return np.asarray(value).astype(space.dtype)
    return value


def bits(value: Any) -> bytes:
    """Every bit of an observation, or of a step."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}".encode() + value.tobytes()
    if isinstance(value, dict):
        return b"".join(str(name).encode() + bits(value[name]) for name in sorted(value, key=str))
    if isinstance(value, tuple | list):
        return b"".join(b"(" + bits(part) for part in value)
    return repr(value.item() if isinstance(value, np.generic) else value).encode()
