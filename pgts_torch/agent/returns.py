"""Returns of episodes, bootstrapped with the values of a critic where they were cut off."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.rollout import Rollout
from pgts_torch.errors import NotFinite
from pgts_torch.options.critics import MonteCarlo, TDLambda


def lambda_returns(
    rollout: Rollout, next_v_TB: Float[Tensor, "T B"], discount_TB: Float[Tensor, "T B"], lambda_: float
) -> Float[Tensor, "T B"]:
    """G_t = r_t + gamma_t ((1 - lambda) V(s_{t+1}) + lambda G_{t+1}), with G_{t+1} = V(s_{t+1}) at the last step.

    Args:
        rollout: B episodes.
        next_v_TB: V(s_{t+1}).
        discount_TB: gamma_t; 0 after a terminated step, so that nothing is bootstrapped there.
        lambda_: in [0, 1]; 1 gives Monte-Carlo returns.
    """
    lambda_TB = lambda_ * rollout.follows_TB.float()
    returns_TB = rollout.reward_TB + discount_TB * (1 - lambda_TB) * next_v_TB
    # in numpy, where operations on a few numbers cost least
    row_TB, later_TB = returns_TB.cpu().numpy(), (discount_TB * lambda_TB).cpu().numpy()
    for t in reversed(range(len(row_TB) - 1)):
        row_TB[t] += later_TB[t] * row_TB[t + 1]
    return torch.from_numpy(row_TB).to(returns_TB.device)


def critic_targets(
    rollout: Rollout, next_v_TB: Float[Tensor, "T B"], method: TDLambda | MonteCarlo
) -> Float[Tensor, "T B"]:
    """The returns that a critic is fitted to; NotFinite unless their sum over all visits is finite."""
    if isinstance(method, MonteCarlo):
        target_TB = lambda_returns(rollout, next_v_TB, rollout.survival_TB, 1.0)
    else:
        target_TB = lambda_returns(rollout, next_v_TB, rollout.discount_TB, method.lambda_)
    if not math.isfinite(target_TB[rollout.alive_TB].sum()):
        raise NotFinite("a target of the critic is not finite; it has learned nothing from this rollout", what="value")
    return target_TB
