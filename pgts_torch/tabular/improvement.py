"""Modified policy iteration: nearly optimal values and actions, with a proof of how near they are."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup, sweep

_EVALUATIONS, _MOST_EVALUATIONS = 8, 512
"""How often v <- T_pi v is applied while actions change, and at most where they do not."""

_STALLED = 50
"""After so many steps that bring the bounds no nearer, rounding keeps them apart."""

_EPS = torch.finfo(torch.float64).eps


@dataclass(frozen=True, eq=False)
class Improved:
    """action_S: the best actions for values v.   v_S: between bounds of v* that are at most 2 `error` apart.

    The policy that takes these actions has values between the same bounds.
    """

    action_S: Int[Tensor, "S"]
    v_S: Float[Tensor, "S"]
    error: float


def improve(outcomes: Outcomes, *, error: float) -> Improved:
    """v <- T v, then some times v <- T_pi v for the actions pi that were best, and again  (Puterman and Shin, 1978).

    The difference D = T v - v bounds what is missing. With all sum_k p_k gamma_k in [b, B] and B < 1,

        T v + h(min D)  <=  v^pi  <=  v*  <=  T v + H(max D)        (MacQueen, 1966; Porteus, 1971)

    H(c) = c B / (1 - B) and h(c) = c b / (1 - b) for c >= 0, with B and b exchanged for c < 0: where c is added to v, T
    and T_pi add between b c and B c. A backup in float64 errs by at most (K + 4) eps (max |r| + max |v|); 1 / (1 - B)
    times that is counted as error too.

    Args:
        outcomes: of an MDP in float64 whose actions all discount (B < 1).
        error: it ends with an error of at most this, in reward units, or where rounding keeps it larger.
            Infinite: it ends as soon as the actions stay the same.
    """
    low, high = total_weights(outcomes)
    largest_reward = float(outcomes.finite_rewards.abs().max())
    rounding = (outcomes.num_outcomes + 4) * _EPS / (1 - high)
    v_S = torch.zeros(outcomes.num_states, dtype=outcomes.dtype)
    before_S, best, stalled, times = None, None, 0, _EVALUATIONS
    while True:
        q_SA = backup(outcomes, v_S)
        action_S = q_SA.argmax(-1)
        top_S = q_SA.gather(1, action_S.unsqueeze(1)).squeeze(1)
        least, most = (float(x) for x in torch.aminmax(top_S - v_S))
        below = least * (low / (1 - low) if least >= 0 else high / (1 - high))
        above = most * (high / (1 - high) if most >= 0 else low / (1 - low))
        off = (above - below) / 2 + rounding * (largest_reward + float(v_S.abs().max()))
        same = before_S is not None and torch.equal(action_S, before_S)
        stalled = stalled + 1 if best is not None and off >= best.error else 0
        if best is None or off < best.error:
            best = Improved(action_S, top_S + (below + above) / 2, off)
        if (best.error <= error and (same or error < torch.inf)) or stalled == _STALLED:
            return best
        # Where actions change it does not pay to know what they are worth; where they do not, nothing else is missing.
        times = min(2 * times, _MOST_EVALUATIONS) if same else _EVALUATIONS
        v_S, before_S = sweep(outcomes, top_S, times, action_S), action_S


def total_weights(outcomes: Outcomes) -> tuple[float, float]:
    """The smallest and the largest sum_k p_k gamma_k of a state and action; at least, and at most, these."""
    total_NA = outcomes.expected(torch.ones(outcomes.num_children, dtype=outcomes.dtype))
    least, most = (float(x) for x in torch.aminmax(total_NA))
    margin = (outcomes.num_outcomes + 1) * _EPS  # of rounded products and their sum
    return max(0.0, least - margin), most + margin
