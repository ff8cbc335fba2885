"""Dynamics of one class of environments written for arrays, with the constants of an instance of it."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float, Int, Num
from torch import Tensor

from pgts_torch.compiled import pays
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.actions import base_actions
from pgts_torch.models.exact_model import ExactModel
from pgts_torch.models.provenance import overridden
from pgts_torch.models.rewards import value_range
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.squash import squash_of
from pgts_torch.models.state_index import Merge
from pgts_torch.models.steps import number_of
from pgts_torch.models.tensor import TensorModel
from pgts_torch.models.wrappers import transforms_of

Arrays = Sequence[Any]
"""Columns [N], of numpy or of torch."""


class DynamicsModel(TensorModel, ExactModel):
    """The dynamics of one environment of classic control, with the constants of an instance of it.

    The state is the vector `env.unwrapped.state`. States, rewards and values are float64 by default.

    Args:
        env: an instance, wrapped or not; nothing of it changes. Its actions are discrete, by itself or by an
            action wrapper (`with_torques`), or vectors (`Squashed`). Its wrappers' transforms of rewards are part of
            the outcomes (`transforms_of`).
        gamma: discount in [0, 1] of a step that does not terminate.
        action_repeat, device, merge: as in `TensorModel`.
        dtype: of states, rewards and values.

    Raises:
        PgtsError: the environment is another one, or has something that these dynamics do not know; gamma is no
            discount.
    """

    kind, is_cheap = "dynamics", True
    env_class: type
    size: int
    constants: tuple[str, ...]
    """All attributes of the environment that a step reads, beside its state."""
    takes_vectors: bool = False
    """Whether actions may be vectors."""
    pays_ends_only: bool = True
    """Whether every reward is the lowest or the highest."""

    def __init__(
        self,
        env: gymnasium.Env,
        *,
        gamma: float,
        action_repeat: int = 1,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
        merge: Merge = "auto",
    ) -> None:
        if not 0 <= gamma <= 1:
            raise PgtsError(f"gamma is {gamma}; it must be in [0, 1]")
        self.name, self.gamma = env_name(env), gamma
        if why := self.obstacle(env):
            raise PgtsError(f"{self.name} has no dynamics in torch: {why}")
        self._squash, self.transforms = squash_of(env), transforms_of(env)
        actions = [] if self._squash else base_actions(env)
        options: dict[str, Any] = {"state_dtype": dtype, "dtype": dtype, "device": device, "merge": merge}
        super().__init__(self.size, len(actions), action_repeat=action_repeat, **options)
        # As numbers of Python, which leave arrays in their dtype.
        constants = {name: getattr(env.unwrapped, name) for name in self.constants}
        self._c = SimpleNamespace(
            **{name: x.item() if isinstance(x, np.generic) else x for name, x in constants.items()}
        )
        self._effect_AE = torch.tensor([self._effect(action) for action in actions], dtype=dtype, device=self.device)
        if action_repeat == 1:  # an operator of repeated actions gives no upper bound of v*
            self.lowest_value, self.highest_value = value_range(self._transformed_range(), gamma)
        self._same: list[Any] = []

    @classmethod
    def obstacle(cls, env: gymnasium.Env) -> str:
        """Why these dynamics are not those of `env`; empty where they are."""
        if why := cls._another_class(env.unwrapped) or overridden(env.unwrapped, cls.env_class):
            return why
        try:
            transforms_of(env)
        except MissingModel as missing:
            return str(missing)
        if not (isinstance(env.action_space, spaces.Discrete) or (cls.takes_vectors and _is_squashed(env))):
            return f"its actions are {env.action_space}; make them discrete, as with_torques does"
        return cls._unknown(env.unwrapped)

    @classmethod
    def _another_class(cls, base: Any) -> str:
        return "" if type(base) is cls.env_class else f"it is a {type(base).__name__}, not a {cls.env_class.__name__}"

    @classmethod
    def _unknown(cls, base: Any) -> str:
        """What of an instance is not supported."""
        return ""

    def roots(self, envs: Sequence[gymnasium.Env]) -> Int[Tensor, "B"]:
        """The numbers of the states that several instances are in; raises as `vectors` does."""
        return self.number(self.vectors(envs))

    def vectors(self, envs: Sequence[gymnasium.Env]) -> Float[Tensor, "B D"]:
        """The states that several instances are in, in the dtype of states and on the device of the model.

        Raises:
            PgtsError: one is another environment, has other constants than those read at first, or was not reset.
        """
        rows = np.array([self._state_of(env) for env in envs], dtype=np.float64)
        return torch.from_numpy(rows).to(self.device, self.dtype)

    def _state_of(self, env: gymnasium.Env) -> Any:
        base: Any = env.unwrapped
        if not any(base is known for known in self._same):
            if why := self._another_class(base):
                raise PgtsError(f"{env_name(env)} is not {self.name}: {why}")
            for name, own in vars(self._c).items():
                if (value := getattr(base, name)) != own:
                    raise PgtsError(f"{env_name(env)} has {name} = {value}; the model's is {own}")
            self._same.append(base)
        if base.state is None:
            raise PgtsError(f"{env_name(env)} was not reset: it is in no state")
        return base.state

    @final
    def step(
        self, state_ND: Float[Tensor, "N D"], action_N: Num[Tensor, "N ..."]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N D"]]:
        loops = self._squash is None and state_ND.dtype == torch.float64 and pays(self.device, state_ND.shape[0])
        answer = self._step_compiled(state_ND.contiguous().numpy(), action_N.numpy()) if loops else None
        reward_N, discount_N, next_ND = self._step(state_ND, action_N) if answer is None else answer
        if self.transforms.rewards:
            distinct, index_N = reward_N.unique(return_inverse=True)
            transformed = [number_of("reward", self.transforms.reward(reward)) for reward in distinct.tolist()]
            reward_N = torch.tensor(transformed, dtype=self.dtype, device=self.device)[index_N]
        return reward_N, discount_N, next_ND

    def _step(self, state_ND: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As `step`, with the reward of the bare environment."""
        xp, state = self._columns(state_ND)
        _, effect = self._columns(self._effects(action_N))
        paid, ends, following = self._move(xp, state, effect)
        reward_N, terminated_N = map(torch.as_tensor, (paid, ends))
        discount_N = torch.full_like(reward_N, self.gamma).masked_fill_(terminated_N, 0.0)
        return reward_N, discount_N, self._rows(following)

    def _step_compiled(self, state_ND: np.ndarray, action_N: np.ndarray) -> tuple[Tensor, Tensor, Tensor] | None:
        """The same by a loop in float64; None where there is none."""
        return None

    def _columns(self, x_ND: Float[Tensor, "N D"]) -> tuple[Any, Arrays]:
        """The library that computes with the columns of a table, and these."""
        if x_ND.device.type == "cpu":
            return np, np.ascontiguousarray(x_ND.numpy().T)  # type: ignore[return-value]
        return torch, x_ND.unbind(-1)

    def _rows(self, columns: Arrays) -> Float[Tensor, "N D"]:
        """A table of these columns."""
        on_host = isinstance(columns[0], np.ndarray)
        return torch.from_numpy(np.stack(columns, -1)) if on_host else torch.stack(list(columns), -1)

    @abstractmethod
    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        """The observations of the environment in these states, float32."""

    def _effects(self, action_N: Num[Tensor, "N ..."]) -> Float[Tensor, "N E"]:
        if self._squash is None:
            return self._effect_AE.index_select(0, action_N)
        columns = self._effect(self._squash.actions(action_N.cpu().numpy()))
        return torch.from_numpy(np.stack(columns, -1)).to(self.device, self.dtype)

    @abstractmethod
    def _effect(self, action: Any) -> tuple[Any, ...]:
        """What the dynamics need to know of an action of the environment: numbers, or, where it `takes_vectors`, of
        rows of actions arrays."""

    @abstractmethod
    def _reward_range(self) -> tuple[float, float]:
        """No reward is lower or higher."""

    @abstractmethod
    def _move(self, xp: Any, state: Arrays, effect: Arrays) -> tuple[Any, Any, Arrays]:
        """Reward, whether the episode terminates, and the columns of the next state, from those of the states.

        Args:
            xp: numpy, which for few numbers takes a third of what torch does, or torch: the library of the arrays.
        """

    def _transformed_range(self) -> tuple[float, float]:
        """No reward is lower or higher once wrappers have transformed it."""
        if self.transforms.rewards and not self.pays_ends_only:
            return -math.inf, math.inf
        ends = [number_of("reward", self.transforms.reward(end)) for end in self._reward_range()]
        return min(ends), max(ends)


def _is_squashed(env: gymnasium.Env) -> bool:
    """Whether actions are vectors, of which no other wrapper makes something else."""
    return squash_of(env) is not None and len(transforms_of(env).actions) == 1
