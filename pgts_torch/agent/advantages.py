"""Returns of episodes, and from them advantages of the actions taken, in the form that updates expect."""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.rollout import Rollout
from pgts_torch.errors import NotFinite
from pgts_torch.options.critics import MonteCarlo, TDLambda
from pgts_torch.readings import Readings


def lambda_returns(
    rollout: Rollout, next_v_TB: Float[Tensor, "T B"], discount_TB: Float[Tensor, "T B"], lambda_: float
) -> Float[Tensor, "T B"]:
    """G_t = r_t + gamma_t ((1 - lambda) V(s_{t+1}) + lambda G_{t+1}), with G_{t+1} = V(s_{t+1}) at the last step.

    Args:
        next_v_TB: V(s_{t+1}).
        discount_TB: gamma_t; 0 after a terminated step, so that nothing is bootstrapped there.
        lambda_: in [0, 1]; 1 gives Monte-Carlo returns.
    """
    columns = rollout.reward_TB, discount_TB, next_v_TB, rollout.alive_TB.to(rollout.reward_TB)
    # in numpy, where operations on a few numbers cost least
    reward_TB, rate_TB, value_TB, alive_TB = torch.stack(columns).cpu().numpy()
    lambda_TB = np.zeros(alive_TB.shape, np.float32)
    lambda_TB[:-1] = lambda_ * alive_TB[1:]
    returns_TB = reward_TB + rate_TB * (1 - lambda_TB) * value_TB
    later_TB = rate_TB * lambda_TB
    for t in reversed(range(len(returns_TB) - 1)):
        returns_TB[t] += later_TB[t] * returns_TB[t + 1]
    return torch.from_numpy(returns_TB).to(discount_TB.device)


def critic_targets(
    rollout: Rollout,
    next_v_TB: Float[Tensor, "T B"],
    method: TDLambda | MonteCarlo,
    readings: Readings | None = None,
) -> Float[Tensor, "V"]:
    """The returns that a critic is fitted to, of all visits; NotFinite, with readings when these are read, unless their
    sum is finite."""
    if isinstance(method, MonteCarlo):
        target_TB = lambda_returns(rollout, next_v_TB, rollout.survival_TB, 1.0)
    else:
        target_TB = lambda_returns(rollout, next_v_TB, rollout.discount_TB, method.lambda_)
    target_V = rollout.of_visits(target_TB)
    total = target_V.sum()
    if readings is not None:
        readings.check(total, _refuse_target)
    elif not math.isfinite(total):
        _refuse_target()
    return target_V


def _refuse_target(_: float = math.nan) -> None:
    raise NotFinite("a target of the critic is not finite; it has learned nothing from this rollout", what="value")


def gae(
    rollout: Rollout, v_TB: Float[Tensor, "T B"], next_v_TB: Float[Tensor, "T B"], lambda_: float
) -> Float[Tensor, "T B"]:
    """Generalised advantage estimates (Schulman et al. 2016): the lambda-return minus v.

        A_t = G_t^lambda - v(s_t) = delta_t + gamma_t lambda A_{t+1},    delta_t = r_t + gamma_t v(s_{t+1}) - v(s_t)

    Where an episode was cut off it is bootstrapped with v(s_{t+1}), but not where it terminated.

    Args:
        v_TB, next_v_TB: v(s_t) and v(s_{t+1}) of one critic.
        lambda_: in [0, 1].
    """
    return lambda_returns(rollout, next_v_TB, rollout.discount_TB, lambda_) - v_TB


def score_function(
    action_N: Int[Tensor, "N"], advantage_N: Float[Tensor, "N"], pi_NA: Float[Tensor, "N A"]
) -> Float[Tensor, "N A"]:
    """The unbiased estimate of the advantages of all actions from the action taken: A / pi(a|s) for it, 0 for others.

        sum_a rho_a pi(a|s) adv(s, a) = rho_{a_t} A_t   for any numbers rho

    So objectives over all actions become those of A2C (Mnih et al. 2016) and PPO (Schulman et al. 2017).

    Args:
        pi_NA: the policy that took the actions.
    """
    index_N1 = action_N[:, None]
    estimate_N1 = advantage_N[:, None] / pi_NA.gather(-1, index_N1).to(advantage_N.dtype)
    return torch.zeros_like(pi_NA, dtype=advantage_N.dtype).scatter(-1, index_N1, estimate_N1)
