"""Steps of classic control as a compiled loop, with the bits of `classic`."""

import numpy as np

from pgts_torch.compiled import jit


@jit
def cart_pole(  # type: ignore[no-untyped-def]
    state_ND, action_N, force_A, cos_N, sin_N, constants, is_euler, is_sutton_barto, gamma, reward_N, discount_N,
    next_ND,
):  # fmt: skip
    """As `CartPole._move`, and discounts.

    Args:
        cos_N, sin_N: of the angles, by numpy.
        reward_N, discount_N, next_ND: are written.
    """
    gravity, masspole, total_mass, length, polemass_length, tau, theta_threshold, x_threshold = constants
    for n in range(len(state_ND)):
        x, x_dot, theta, theta_dot = state_ND[n, 0], state_ND[n, 1], state_ND[n, 2], state_ND[n, 3]
        cos, sin = cos_N[n], sin_N[n]
        push = (force_A[action_N[n]] + polemass_length * (theta_dot * theta_dot) * sin) / total_mass
        lever = length * (4.0 / 3.0 - masspole * (cos * cos) / total_mass)
        theta_acc = (gravity * sin - cos * push) / lever
        x_acc = push - polemass_length * theta_acc * cos / total_mass
        x_after, theta_after = x_dot + tau * x_acc, theta_dot + tau * theta_acc
        x += tau * (x_dot if is_euler else x_after)
        theta += tau * (theta_dot if is_euler else theta_after)
        ends = np.abs(x) > x_threshold or np.abs(theta) > theta_threshold
        reward_N[n] = (-1.0 if ends else -0.0) if is_sutton_barto else 1.0
        discount_N[n] = 0.0 if ends else gamma
        next_ND[n, 0], next_ND[n, 1], next_ND[n, 2], next_ND[n, 3] = x, x_after, theta, theta_after
