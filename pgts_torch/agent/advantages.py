"""Advantages of the actions taken, in the form of advantages of all actions, which updates expect."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.returns import lambda_returns
from pgts_torch.agent.rollout import Rollout


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
