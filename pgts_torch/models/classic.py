"""Gymnasium's classic control: CartPole, Acrobot, MountainCar and Pendulum, many states at a time.

The arithmetic is Gymnasium's, operation by operation, by numpy on the CPU and by torch on other devices. On the CPU in
float64 rewards, ends and states are those of the environment bit for bit; on other devices, and where numpy's cosine is
not that of Python's `math`, which MountainCar uses, up to the last bits. The observations are float32 roundings of
states and no part of the dynamics. After an end Gymnasium leaves undefined what follows; here an ended state is stepped
like any other.
"""

import math
from collections.abc import Callable
from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv, MountainCarEnv, PendulumEnv
from jaxtyping import Float
from torch import Tensor

from pgts_torch.models.dynamics import Arrays, DynamicsModel


@final
class CartPole(DynamicsModel):
    """Position, velocity, angle, angular velocity. The reward is 1 in every step, the last one included; with
    `sutton_barto_reward` it is -1 in the last step and 0 before."""

    env_class, size = CartPoleEnv, 4
    constants = (
        *("gravity", "masspole", "total_mass", "length", "polemass_length", "force_mag", "tau"),
        *("kinematics_integrator", "theta_threshold_radians", "x_threshold", "_sutton_barto_reward"),
    )

    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        return state_ND.float()

    def _effect(self, action: Any) -> tuple[float, ...]:
        return (self._c.force_mag if action == 1 else -self._c.force_mag,)

    def _reward_range(self) -> tuple[float, float]:
        return (-1.0, 0.0) if self._c._sutton_barto_reward else (0.0, 1.0)

    def _move(self, xp: Any, state: Arrays, effect: Arrays) -> tuple[Any, Any, Arrays]:
        (x, x_dot, theta, theta_dot), (force,), c = state, effect, self._c
        cos, sin = xp.cos(theta), xp.sin(theta)
        push = (force + c.polemass_length * xp.square(theta_dot) * sin) / c.total_mass
        lever = c.length * (4.0 / 3.0 - c.masspole * xp.square(cos) / c.total_mass)
        theta_acc = (c.gravity * sin - cos * push) / lever
        x_acc = push - c.polemass_length * theta_acc * cos / c.total_mass
        before, after = (x_dot, theta_dot), (x_dot + c.tau * x_acc, theta_dot + c.tau * theta_acc)
        # Euler's method moves by the old velocities, the semi-implicit one by the new ones.
        by_x, by_theta = before if c.kinematics_integrator == "euler" else after
        x, theta, (x_dot, theta_dot) = x + c.tau * by_x, theta + c.tau * by_theta, after
        terminated = (abs(x) > c.x_threshold) | (abs(theta) > c.theta_threshold_radians)
        reward = xp.ones_like(x)
        if c._sutton_barto_reward:
            reward = -xp.where(terminated, reward, 0.0)
        return reward, terminated, (x, x_dot, theta, theta_dot)

    def _step_compiled(self, state_ND: np.ndarray, action_N: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        from pgts_torch.models import classic_kernels

        c, angle_N = self._c, state_ND[:, 2]
        numbers = c.gravity, c.masspole, c.total_mass, c.length, c.polemass_length, c.tau
        constants = tuple(map(float, (*numbers, c.theta_threshold_radians, c.x_threshold)))
        rules = constants, c.kinematics_integrator == "euler", bool(c._sutton_barto_reward), float(self.gamma)
        answer = np.empty(len(state_ND)), np.empty(len(state_ND)), np.empty(state_ND.shape)
        force_A = self._effect_AE.numpy()[:, 0]
        classic_kernels.cart_pole(state_ND, action_N, force_A, np.cos(angle_N), np.sin(angle_N), *rules, *answer)
        reward_N, discount_N, next_ND = map(torch.from_numpy, answer)
        return reward_N, discount_N, next_ND


@final
class Acrobot(DynamicsModel):
    """Two angles and their velocities, by one Runge-Kutta step of order 4. The reward is -1, at the end 0.

    Just after a reset the environment's state and observation are float32: `observe` may differ in the last bit.
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
        xp, (first, second, *speeds) = self._columns(state_ND)
        return self._rows([xp.cos(first), xp.sin(first), xp.cos(second), xp.sin(second), *speeds]).float()

    def _effect(self, action: Any) -> tuple[float, ...]:
        return (self._c.AVAIL_TORQUE[action],)

    def _reward_range(self) -> tuple[float, float]:
        return -1.0, 0.0

    def _move(self, xp: Any, state: Arrays, effect: Arrays) -> tuple[Any, Any, Arrays]:
        start_4N, (torque,), c = xp.stack(list(state)), effect, self._c
        k1 = self._slope(xp, start_4N, torque)
        k2 = self._slope(xp, start_4N + c.dt / 2.0 * k1, torque)
        k3 = self._slope(xp, start_4N + c.dt / 2.0 * k2, torque)
        k4 = self._slope(xp, start_4N + c.dt * k3, torque)
        first, second, speed1, speed2 = start_4N + c.dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
        first, second = _wrapped(xp, first), _wrapped(xp, second)
        speed1, speed2 = xp.clip(speed1, -c.MAX_VEL_1, c.MAX_VEL_1), xp.clip(speed2, -c.MAX_VEL_2, c.MAX_VEL_2)
        terminated = -xp.cos(first) - xp.cos(second + first) > 1.0
        return xp.where(terminated, 0.0, -xp.ones_like(first)), terminated, (first, second, speed1, speed2)

    def _slope(self, xp: Any, state_4N: Any, torque: Any) -> Any:
        """The time derivative of the state."""
        c, g = self._c, 9.8
        m1, m2, inertia = c.LINK_MASS_1, c.LINK_MASS_2, c.LINK_MOI
        l1, lc1, lc2 = c.LINK_LENGTH_1, c.LINK_COM_POS_1, c.LINK_COM_POS_2
        first, second, speed1, speed2 = state_4N
        cos2, sin2 = xp.cos(second), xp.sin(second)
        d1 = m1 * lc1**2 + m2 * (l1**2 + lc2**2 + 2 * l1 * lc2 * cos2) + inertia + inertia
        d2 = m2 * (lc2**2 + l1 * lc2 * cos2) + inertia
        phi2 = m2 * lc2 * g * xp.cos(first + second - math.pi / 2.0)
        phi1 = (
            -m2 * l1 * lc2 * _squared(xp, speed2) * sin2
            - 2 * m2 * l1 * lc2 * speed2 * speed1 * sin2
            + (m1 * lc1 + m2 * l1) * g * xp.cos(first - math.pi / 2)
            + phi2
        )
        pull = torque + d2 / d1 * phi1
        if c.book_or_nips != "nips":
            pull = pull - m2 * l1 * lc2 * _squared(xp, speed1) * sin2
        acc2 = (pull - phi2) / (m2 * lc2**2 + inertia - _squared(xp, d2) / d1)
        return xp.stack([speed1, speed2, -(d2 * acc2 + phi1) / d1, acc2])


@final
class MountainCar(DynamicsModel):
    """Position and velocity. The reward is -1 in every step."""

    env_class, size = MountainCarEnv, 2
    constants = "min_position", "max_position", "max_speed", "goal_position", "goal_velocity", "force", "gravity"

    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        return state_ND.float()

    def _effect(self, action: Any) -> tuple[float, ...]:
        return ((action - 1) * self._c.force,)

    def _reward_range(self) -> tuple[float, float]:
        return -1.0, 0.0

    def _move(self, xp: Any, state: Arrays, effect: Arrays) -> tuple[Any, Any, Arrays]:
        (position, velocity), (push,), c = state, effect, self._c
        velocity = velocity + (push + xp.cos(3 * position) * -c.gravity)
        velocity = xp.clip(velocity, -c.max_speed, c.max_speed)
        position = xp.clip(position + velocity, c.min_position, c.max_position)
        velocity = xp.where((position == c.min_position) & (velocity < 0), 0.0, velocity)
        terminated = (position >= c.goal_position) & (velocity >= c.goal_velocity)
        return -xp.ones_like(position), terminated, (position, velocity)


@final
class Pendulum(DynamicsModel):
    """Angle, which is not wrapped, and velocity, under torques from a list. It never terminates."""

    env_class, size, pays_ends_only, takes_vectors = PendulumEnv, 2, False, True
    constants = ("max_speed", "max_torque", "dt", "g", "m", "l")

    def observe(self, state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N O"]:
        """Cosine and sine of the angle, and the velocity."""
        xp, (angle, speed) = self._columns(state_ND)
        return self._rows([xp.cos(angle), xp.sin(angle), speed]).float()

    def _effect(self, action: Any) -> tuple[Any, Any]:
        c = self._c
        torque = np.clip(action, -c.max_torque, c.max_torque).T[0]
        # One by one, because the power of a number of float32 is one time in a thousand not that in an array.
        square = torque**2 if torque.ndim == 0 else np.array([one**2 for one in torque], torque.dtype)
        return 3.0 / (c.m * c.l**2) * torque, 0.001 * square

    def _reward_range(self) -> tuple[float, float]:
        highest = (
            float(self._effect(np.array([self._c.max_torque], np.float32))[1])
            if self._squash
            else float(self._effect_AE[:, 1].max())
        )
        return -(math.pi**2 + 0.1 * self._c.max_speed**2 + highest), 0.0

    def _move(self, xp: Any, state: Arrays, effect: Arrays) -> tuple[Any, Any, Arrays]:
        (angle, speed), (push, price), c = state, effect, self._c
        upright = xp.remainder(angle + math.pi, 2 * math.pi) - math.pi
        cost = _squared(xp, upright) + 0.1 * _squared(xp, speed) + price
        speed = speed + (3 * c.g / (2 * c.l) * xp.sin(angle) + push) * c.dt
        speed = xp.clip(speed, -c.max_speed, c.max_speed)
        return -cost, xp.zeros_like(cost, dtype=bool), (angle + speed * c.dt, speed)


CLASSIC: tuple[type[DynamicsModel], ...] = (CartPole, Acrobot, MountainCar, Pendulum)


def dynamics_of(env: gymnasium.Env) -> Callable[..., DynamicsModel] | None:
    """The class of these models whose dynamics are those of `env`; None where there is none."""
    return next((model for model in CLASSIC if not model.obstacle(env)), None)


def _wrapped(xp: Any, angle: Any) -> Any:
    """The angle between -pi and pi."""
    turn = 2 * math.pi
    angle = angle - turn * xp.clip(xp.ceil((angle - math.pi) / turn), 0, None)
    return angle + turn * xp.clip(xp.ceil((-math.pi - angle) / turn), 0, None)


def _squared(xp: Any, x: Any) -> Any:
    """x**2 as numpy has it for single numbers: by a power, one time in a thousand one bit off the product."""
    return np.float_power(x, 2.0) if xp is np and x.dtype == np.float64 else xp.square(x)
