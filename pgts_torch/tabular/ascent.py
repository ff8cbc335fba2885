"""Algorithm 1 of the paper with exact quantities, and the three ways in which a policy may move."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.bellman import policy_mean
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP

_RECORD = 1e-9
"""By how much, beside 1 or its size, a return must exceed all before it to count as larger."""


def centred(
    q_NA: Float[Tensor, "N A"], pi_NA: Float[Tensor, "N A"], *, rounding: Float[Tensor, ""] | float = 0.0
) -> Float[Tensor, "N A"]:
    """Advantages of all actions, none on the average of the policy:

        A(s, a) = q(s, a) - <pi(.|s), q(s, .)>,        so that sum_a pi(a|s) A(s, a) = 0

    The largest value of a state is taken off first. So actions of equal values have advantages of exactly 0, the
    rounding is that of the differences and not of q, and q times 2^k gives exactly 2^k times the advantages.

    The average is that of the policy given that it takes an allowed action, one with q > -inf.

    Args:
        q_NA: (T^m Q)(s, .); -inf where an action is not allowed, and so is its advantage.
        rounding: advantages of at most this size are 0.
    """
    below_NA = q_NA - q_NA.amax(-1, keepdim=True)
    allowed_NA = below_NA > -math.inf
    kept_NA = torch.where(allowed_NA, pi_NA, 0.0)
    share_N1, mass_N1 = policy_mean(kept_NA, below_NA).unsqueeze(-1), kept_NA.sum(-1, keepdim=True)
    is_part_N1 = (~allowed_NA & (pi_NA > 0)).any(-1, keepdim=True) & (mass_N1 > 0)
    advantage_NA = below_NA - torch.where(is_part_N1, share_N1 / mass_N1, share_N1)
    return torch.where(advantage_NA.abs() > rounding, advantage_NA, 0.0)


def normalised(
    advantage_NA: Float[Tensor, "N A"], pi_NA: Float[Tensor, "N A"], *, noise: float = 0.0
) -> Float[Tensor, "N A"]:
    """Advantages in units of their root mean square, or of their noise where that is larger:

        A(s, a) / max(noise, sqrt(mean_s sum_a pi(a|s) A(s, a)^2))

    0 where all are 0. The largest |A| is divided by first, so that squares neither overflow nor vanish, and a factor of
    2^k on advantages and noise changes no bit. Actions that are not allowed stay at -inf and do not count.
    """
    allowed_NA = advantage_NA > -math.inf
    largest = advantage_NA[allowed_NA].abs().amax()
    if not largest > 0:
        return advantage_NA
    unit_NA = advantage_NA / largest
    square_NA = torch.where(allowed_NA & (pi_NA > 0), pi_NA * unit_NA.square(), 0.0)
    size = square_NA.sum(-1).mean().sqrt().clamp(min=float(noise / largest))
    return unit_NA / torch.where(size > 0, size, 1.0)  # 0: only actions that the policy never takes are better


def floored(log_NA: Float[Tensor, "N A"], step_NA: Float[Tensor, "N A"], floor: float | None) -> Float[Tensor, "N A"]:
    """log pi + step, the largest of each row at 0 and the others at -floor or above; None: as low as they are. Where
    the step is -inf the action is not allowed, and stays at -inf."""
    next_NA = log_NA + step_NA
    next_NA = next_NA - next_NA.amax(-1, keepdim=True)
    return next_NA if floor is None else torch.where(step_NA == -math.inf, -math.inf, next_NA.clamp(min=-floor))


def project_simplex(x_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N A"]:
    """The nearest distribution to each row, in the Euclidean norm.

        proj[x] = max(x - tau, 0),  tau such that it sums to 1

    tau is found by sorting (Held, Wolfe and Crowder 1974; Duchi et al. 2008). Rows are shifted by their maximum first,
    which changes nothing but the rounding.
    """
    x_NA = x_NA - x_NA.amax(-1, keepdim=True)
    sorted_NA = x_NA.sort(-1, descending=True).values
    rank_A = torch.arange(1, x_NA.shape[-1] + 1, dtype=x_NA.dtype, device=x_NA.device)
    tau_NA = (sorted_NA.cumsum(-1) - 1) / rank_A
    last_N1 = (sorted_NA > tau_NA).sum(-1, keepdim=True) - 1
    return (x_NA - tau_NA.gather(-1, last_N1)).clamp(min=0)


def projected_step(
    pi_NA: Float[Tensor, "N A"], q_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"], step_size: float
) -> Float[Tensor, "N A"]:
    """The paper's update.        [PGTS Eq. (3)]

    pi'(.|s) = proj[ pi(.|s) + eta w(s) q(s, .) ]
    """
    return project_simplex(pi_NA + scaled(q_NA, step_size * weight_N))


def mirror_step(
    pi_NA: Float[Tensor, "N A"], q_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"], step_size: float
) -> Float[Tensor, "N A"]:
    """Mirror ascent with the KL divergence (Protopapas and Barakat 2024; Xiao 2022). It leaves zeros at zero.

    pi'(a|s) ~ pi(a|s) exp(eta w(s) q(s, a)) = argmax_p  eta w(s) <p, q(s, .)> - KL(p, pi(.|s))
    """
    return (pi_NA.log() + scaled(q_NA, step_size * weight_N)).softmax(-1)


def scaled(q_NA: Float[Tensor, "N A"], factor_N: Float[Tensor, "N"]) -> Float[Tensor, "N A"]:
    """factor(s) q(s, a); -inf where an action is not allowed, also where the factor is 0."""
    return torch.where(q_NA > -math.inf, factor_N[:, None] * q_NA, -math.inf)


def softmax_direction(
    pi_NA: Float[Tensor, "N A"], q_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"]
) -> Float[Tensor, "N A"]:
    """Gradient in the logits of sum_s w(s) sum_a pi(a|s) q(s, a), with w and q held fixed.

        w(s) pi(a|s) (q(s, a) - <pi(.|s), q(s, .)>)

    It is 0 where pi is. With w = d^pi and q = Q^pi it is the gradient of J (Sutton et al. 1999); with q = T^m Q^pi the
    direction of PGTS.
    """
    above_NA = q_NA - policy_mean(pi_NA, q_NA).unsqueeze(-1)
    return torch.where(pi_NA > 0, weight_N[:, None] * pi_NA * above_NA, 0.0)


def softmax_step(
    pi_NA: Float[Tensor, "N A"], q_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"], step_size: float
) -> Float[Tensor, "N A"]:
    """One gradient step of size eta on the logits log pi. It leaves zeros at zero."""
    return (pi_NA.log() + step_size * softmax_direction(pi_NA, q_NA, weight_N)).softmax(-1)


@dataclass(frozen=True, eq=False)
class Ascent:
    """What Algorithm 1 did in K iterations: the return of pi_0 .. pi_K, pi_K, and the depth m at the end."""

    J_K: Float[Tensor, "K"]
    pi_SA: Float[Tensor, "S A"]
    depth: int


def ascend(
    mdp: TabularMDP,
    pi_SA: Float[Tensor, "S A"],
    *,
    depth: int,
    step_size: float,
    iterations: int,
    step: Callable[[Tensor, Tensor, Tensor, float], Tensor] = projected_step,
    patience: int | None = None,
) -> Ascent:
    """Algorithm 1 with exact quantities: only states with d^pi(s) > 0 move.        [PGTS Alg. 1]

    Args:
        depth: m, how often T is applied to Q^pi. 0 is plain policy gradient [PGTS Eq. (2)].
        step_size: eta, finite and at least 0; the same in every iteration.
        step: `projected_step` (the paper's, default), `softmax_step` or `mirror_step`.
        patience: m grows by 1 after so many iterations without a new largest return. With a fixed m the iteration may
            go round for ever (`zoo.roundabout`); with growing m its returns converge to J*, by projected and by mirror
            steps, whatever the step size (docs/theory.md, Prop. 18). None: m is fixed.
    """
    if not 0 <= step_size < math.inf:
        raise PgtsError(f"step_size is {step_size}; it must be finite and at least 0")
    check_count("depth", depth, least=0)
    if patience is not None:
        check_count("patience", patience)
    pi_SA = exact.check_policy(mdp, pi_SA)
    returns, largest, waited = [], -math.inf, 0
    for _ in range(iterations):
        evaluation = exact.evaluate(mdp, pi_SA)
        returns.append(evaluation.J)
        is_record = evaluation.J > largest + _RECORD * max(1.0, abs(largest))
        largest, waited = (evaluation.J, 0) if is_record else (largest, waited + 1)
        if patience is not None and waited >= patience:
            depth, waited = depth + 1, 0
        look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
        visited = evaluation.d_S > 0
        pi_SA = pi_SA.clone()
        pi_SA[visited] = step(pi_SA[visited], look_SA[visited], evaluation.d_S[visited], step_size)
    returns.append(exact.evaluate(mdp, pi_SA).J)
    return Ascent(torch.tensor(returns, dtype=torch.float64), pi_SA, depth)
