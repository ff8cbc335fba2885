"""Gymnasium's classic control written in torch: CartPole, Acrobot, MountainCar and Pendulum, many states at a time.

Constants are read from an instance of the environment, so changed ones are honoured; the arithmetic is Gymnasium's,
operation by operation. On the CPU in float64 rewards, ends and states are those of the environment bit for bit (sines,
cosines and powers by numpy, as there); on other devices, and where numpy's cosine is not that of Python's `math`, which
MountainCar uses, up to the last bits. The observations are float32 roundings of states and no part of the dynamics.
After an end Gymnasium leaves undefined what follows; here an ended state is stepped like any other.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv, MountainCarEnv, PendulumEnv
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.actions import base_actions
from pgts_torch.models.base import ExactModel
from pgts_torch.models.provenance import overridden
from pgts_torch.models.rewards import value_range
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.state_index import Merge
from pgts_torch.models.steps import number_of
from pgts_torch.models.tensor import TensorModel
from pgts_torch.models.wrappers import transforms_of


class ClassicModel(TensorModel, ExactModel):
    """The dynamics of one environment of classic control, with the constants of an instance of it.

    The state is the vector `env.unwrapped.state`. States, rewards and values are float64 by default.

    Args:
        env: an instance, wrapped or not; nothing of it changes. Its actions are discrete, by itself or by an action
            wrapper (`with_torques`). Its wrappers' transforms of rewards are part of the outcomes (`transforms_of`).
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
    pays_ends_only: bool = True
    """Whether every reward is one end of the range of rewards or the other."""

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
        actions, self.transforms = base_actions(env), transforms_of(env)
        super().__init__(
            self.size,
            len(actions),
            state_dtype=dtype,
            dtype=dtype,
            device=device,
            merge=merge,
            action_repeat=action_repeat,
        )
        self._read = self._constants_of(env.unwrapped)
        self._c = SimpleNamespace(**self._read)
        self._effect_AE = torch.tensor([self._effect(action) for action in actions], dtype=dtype, device=self.device)
        if action_repeat == 1:  # an operator of repeated actions gives no upper bound of v*
            self.lowest_value, self.highest_value = value_range(self._range_outside(), gamma)
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
        if not isinstance(env.action_space, spaces.Discrete):
            return f"its actions are {env.action_space}; make them discrete, as with_torques does"
        return cls._unknown(env.unwrapped)

    @classmethod
    def _another_class(cls, base: Any) -> str:
        return "" if type(base) is cls.env_class else f"it is a {type(base).__name__}, not a {cls.env_class.__name__}"

    @classmethod
    def _unknown(cls, base: Any) -> str:
        """What of an instance is not supported."""
        return ""

    def read(self, env: gymnasium.Env) -> Float[Tensor, "D"]:
        """The state that an instance is in, in the dtype of states and on the device of the model.

        Raises:
            PgtsError: it is another environment, has other constants than those read at first, or was not reset.
        """
        return self.vectors([env])[0]

    def roots(self, envs: Sequence[gymnasium.Env]) -> Int[Tensor, "B"]:
        """The numbers of the states that several instances are in; raises as `read` does."""
        return self.number(self.vectors(envs))

    def vectors(self, envs: Sequence[gymnasium.Env]) -> Float[Tensor, "B D"]:
        """The states that several instances are in; raises as `read` does."""
        rows = np.array([self._state_of(env) for env in envs], dtype=np.float64)
        return torch.from_numpy(rows).to(self.device, self.dtype)

    def _state_of(self, env: gymnasium.Env) -> Any:
        base: Any = env.unwrapped
        if not any(base is known for known in self._same):
            if why := self._another_class(base):
                raise PgtsError(f"{env_name(env)} is not {self.name}: {why}")
            for name, value in self._constants_of(base).items():
                if value != self._read[name]:
                    raise PgtsError(f"{env_name(env)} has {name} = {value}; the model's is {self._read[name]}")
            self._same.append(base)
        if base.state is None:
            raise PgtsError(f"{env_name(env)} was not reset: it is in no state")
        return base.state

    @final
    def step(
        self, state_ND: Float[Tensor, "N D"], action_N: Int[Tensor, "N"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N D"]]:
        """Reward, discount (0 where the episode terminates) and next state."""
        effect = self._effect_AE[action_N].unbind(-1)
        reward_N, terminated_N, following = self._move(state_ND.unbind(-1), effect)
        if self.transforms.rewards:
            distinct, index_N = reward_N.unique(return_inverse=True)
            paid = [number_of("reward", self.transforms.reward(reward)) for reward in distinct.tolist()]
            reward_N = torch.tensor(paid, dtype=self.dtype, device=self.device)[index_N]
        discount_N = torch.full_like(reward_N, self.gamma).masked_fill_(terminated_N, 0.0)
        return reward_N, discount_N, torch.stack(list(following), -1)

    @abstractmethod
    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        """What the environment shows in these states, float32."""

    @abstractmethod
    def _effect(self, action: Any) -> tuple[float, ...]:
        """What the dynamics need to know of an action of the environment."""

    @abstractmethod
    def _reward_range(self) -> tuple[float, float]:
        """No reward is lower or higher."""

    @abstractmethod
    def _move(self, state: Sequence[Tensor], effect: Sequence[Tensor]) -> tuple[Tensor, Tensor, Sequence[Tensor]]:
        """Reward, whether the episode terminates, and the columns of the next state, from those of the states."""

    def _range_outside(self) -> tuple[float, float]:
        """No reward is lower or higher once wrappers have transformed it."""
        if not self.transforms.rewards:
            return self._reward_range()
        if not self.pays_ends_only:
            return -math.inf, math.inf
        ends = [number_of("reward", self.transforms.reward(end)) for end in self._reward_range()]
        return min(ends), max(ends)

    def _constants_of(self, base: Any) -> dict[str, Any]:
        return {name: getattr(base, name) for name in self.constants}


@final
class CartPole(ClassicModel):
    """Position, velocity, angle, angular velocity. The reward is 1 in every step, the last one included; with
    `sutton_barto_reward` it is -1 in the last step and 0 before."""

    env_class, size = CartPoleEnv, 4
    constants = (
        *("gravity", "masspole", "total_mass", "length", "polemass_length", "force_mag", "tau"),
        *("kinematics_integrator", "theta_threshold_radians", "x_threshold", "_sutton_barto_reward"),
    )

    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        """The state."""
        return state_ND.float()

    def _effect(self, action: Any) -> tuple[float, ...]:
        return (self._c.force_mag if action == 1 else -self._c.force_mag,)

    def _reward_range(self) -> tuple[float, float]:
        return (-1.0, 0.0) if self._c._sutton_barto_reward else (0.0, 1.0)

    def _move(self, state: Sequence[Tensor], effect: Sequence[Tensor]) -> tuple[Tensor, Tensor, Sequence[Tensor]]:
        (x, x_dot, theta, theta_dot), (force,), c = state, effect, self._c
        cos, sin = _cos(theta), _sin(theta)
        push = (force + c.polemass_length * theta_dot.square() * sin) / c.total_mass
        theta_acc = (c.gravity * sin - cos * push) / (c.length * (4.0 / 3.0 - c.masspole * cos.square() / c.total_mass))
        x_acc = push - c.polemass_length * theta_acc * cos / c.total_mass
        if c.kinematics_integrator == "euler":
            x, theta = x + c.tau * x_dot, theta + c.tau * theta_dot
            x_dot, theta_dot = x_dot + c.tau * x_acc, theta_dot + c.tau * theta_acc
        else:
            x_dot, theta_dot = x_dot + c.tau * x_acc, theta_dot + c.tau * theta_acc
            x, theta = x + c.tau * x_dot, theta + c.tau * theta_dot
        terminated = (x.abs() > c.x_threshold) | (theta.abs() > c.theta_threshold_radians)
        reward = -terminated.to(self.dtype) if c._sutton_barto_reward else torch.ones_like(x)
        return reward, terminated, (x, x_dot, theta, theta_dot)


@final
class Acrobot(ClassicModel):
    """Two angles and their velocities, by one Runge-Kutta step of order 4. The reward is -1, at the end 0.

    Just after a reset the environment's state, and so what it shows, is float32: `observe` may differ in the last bit.
    """

    env_class, size = AcrobotEnv, 4
    constants = (
        *("dt", "LINK_LENGTH_1", "LINK_MASS_1", "LINK_MASS_2", "LINK_COM_POS_1", "LINK_COM_POS_2", "LINK_MOI"),
        *("MAX_VEL_1", "MAX_VEL_2", "AVAIL_TORQUE", "torque_noise_max", "book_or_nips"),
    )

    @classmethod
    def _unknown(cls, base: Any) -> str:
        noise = base.torque_noise_max
        return f"torque_noise_max is {noise}, and its actions have one outcome only without noise" if noise > 0 else ""

    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        """Cosine and sine of the angles, and the velocities."""
        first, second, *speeds = state_ND.unbind(-1)
        return torch.stack([_cos(first), _sin(first), _cos(second), _sin(second), *speeds], -1).float()

    def _effect(self, action: Any) -> tuple[float, ...]:
        return (self._c.AVAIL_TORQUE[action],)

    def _reward_range(self) -> tuple[float, float]:
        return -1.0, 0.0

    def _move(self, state: Sequence[Tensor], effect: Sequence[Tensor]) -> tuple[Tensor, Tensor, Sequence[Tensor]]:
        start_4N, (torque,), dt = torch.stack(list(state)), effect, self._c.dt
        k1 = self._slope(start_4N, torque)
        k2 = self._slope(start_4N + dt / 2.0 * k1, torque)
        k3 = self._slope(start_4N + dt / 2.0 * k2, torque)
        k4 = self._slope(start_4N + dt * k3, torque)
        first, second, speed1, speed2 = start_4N + dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
        first, second = _wrapped(first), _wrapped(second)
        speed1 = speed1.clamp(-self._c.MAX_VEL_1, self._c.MAX_VEL_1)
        speed2 = speed2.clamp(-self._c.MAX_VEL_2, self._c.MAX_VEL_2)
        terminated = -_cos(first) - _cos(second + first) > 1.0
        return terminated.to(self.dtype) - 1.0, terminated, (first, second, speed1, speed2)

    def _slope(self, state_4N: Tensor, torque: Tensor) -> Tensor:
        """The time derivative of the state."""
        c, g = self._c, 9.8
        m1, m2, l1, lc1, lc2 = c.LINK_MASS_1, c.LINK_MASS_2, c.LINK_LENGTH_1, c.LINK_COM_POS_1, c.LINK_COM_POS_2
        inertia = c.LINK_MOI
        first, second, speed1, speed2 = state_4N
        cos2, sin2 = _cos(second), _sin(second)
        d1 = m1 * lc1**2 + m2 * (l1**2 + lc2**2 + 2 * l1 * lc2 * cos2) + inertia + inertia
        d2 = m2 * (lc2**2 + l1 * lc2 * cos2) + inertia
        phi2 = m2 * lc2 * g * _cos(first + second - math.pi / 2.0)
        phi1 = (
            -m2 * l1 * lc2 * _squared(speed2) * sin2
            - 2 * m2 * l1 * lc2 * speed2 * speed1 * sin2
            + (m1 * lc1 + m2 * l1) * g * _cos(first - math.pi / 2)
            + phi2
        )
        pull = torque + d2 / d1 * phi1
        if c.book_or_nips != "nips":
            pull = pull - m2 * l1 * lc2 * _squared(speed1) * sin2
        acc2 = (pull - phi2) / (m2 * lc2**2 + inertia - _squared(d2) / d1)
        return torch.stack([speed1, speed2, -(d2 * acc2 + phi1) / d1, acc2])


@final
class MountainCar(ClassicModel):
    """Position and velocity. The reward is -1 in every step."""

    env_class, size = MountainCarEnv, 2
    constants = (*("min_position", "max_position", "max_speed", "goal_position", "goal_velocity", "force", "gravity"),)

    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        """The state."""
        return state_ND.float()

    def _effect(self, action: Any) -> tuple[float, ...]:
        return ((action - 1) * self._c.force,)

    def _reward_range(self) -> tuple[float, float]:
        return -1.0, 0.0

    def _move(self, state: Sequence[Tensor], effect: Sequence[Tensor]) -> tuple[Tensor, Tensor, Sequence[Tensor]]:
        (position, velocity), (push,), c = state, effect, self._c
        velocity = velocity + (push + _cos(3 * position) * -c.gravity)
        velocity = velocity.clamp(-c.max_speed, c.max_speed)
        position = (position + velocity).clamp(c.min_position, c.max_position)
        velocity = velocity.masked_fill((position == c.min_position) & (velocity < 0), 0.0)
        terminated = (position >= c.goal_position) & (velocity >= c.goal_velocity)
        return -torch.ones_like(position), terminated, (position, velocity)


@final
class Pendulum(ClassicModel):
    """Angle, which is not wrapped, and velocity, under torques from a list. It never terminates."""

    env_class, size, pays_ends_only = PendulumEnv, 2, False
    constants = ("max_speed", "max_torque", "dt", "g", "m", "l")

    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        """Cosine and sine of the angle, and the velocity."""
        angle, speed = state_ND.unbind(-1)
        return torch.stack([_cos(angle), _sin(angle), speed], -1).float()

    def _effect(self, action: Any) -> tuple[float, ...]:
        c = self._c
        torque = np.clip(action, -c.max_torque, c.max_torque)[0]
        return float(3.0 / (c.m * c.l**2) * torque), float(0.001 * (torque**2))

    def _reward_range(self) -> tuple[float, float]:
        dearest = float(self._effect_AE[:, 1].max())
        return -(math.pi**2 + 0.1 * self._c.max_speed**2 + dearest), 0.0

    def _move(self, state: Sequence[Tensor], effect: Sequence[Tensor]) -> tuple[Tensor, Tensor, Sequence[Tensor]]:
        (angle, speed), (push, price), c = state, effect, self._c
        upright = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
        cost = _squared(upright) + 0.1 * _squared(speed) + price
        speed = speed + (3 * c.g / (2 * c.l) * _sin(angle) + push) * c.dt
        speed = speed.clamp(-c.max_speed, c.max_speed)
        return -cost, torch.zeros_like(cost, dtype=torch.bool), (angle + speed * c.dt, speed)


CLASSIC: tuple[type[ClassicModel], ...] = (CartPole, Acrobot, MountainCar, Pendulum)


def dynamics_of(env: gymnasium.Env) -> Callable[..., ClassicModel] | None:
    """The class of these models whose dynamics are those of `env`; None where there is none."""
    return next((model for model in CLASSIC if not model.obstacle(env)), None)


def _wrapped(angle: Tensor) -> Tensor:
    """The angle between -pi and pi."""
    turn = 2 * math.pi
    angle = angle - turn * ((angle - math.pi) / turn).ceil().clamp(min=0)
    return angle + turn * ((-math.pi - angle) / turn).ceil().clamp(min=0)


def _sin(x: Tensor) -> Tensor:
    """On the CPU numpy's, whose last bits are those of the environments."""
    return torch.from_numpy(np.sin(x.numpy())) if x.device.type == "cpu" else x.sin()


def _cos(x: Tensor) -> Tensor:
    """As `_sin`."""
    return torch.from_numpy(np.cos(x.numpy())) if x.device.type == "cpu" else x.cos()


def _squared(x: Tensor) -> Tensor:
    """x**2 as numpy has it for single numbers: by a power, one time in a thousand one bit off the product."""
    exact = x.device.type == "cpu" and x.dtype == torch.float64
    return torch.from_numpy(np.float_power(x.numpy(), 2.0)) if exact else x.square()
