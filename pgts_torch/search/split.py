"""How simulations are split among the actions of a node and among the outcomes of an action.

Both as if the simulations came one by one, and none saw the results of those before it.
"""

import math
from dataclasses import dataclass
from typing import Literal, final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

Rule = Literal["gumbel", "puct", "uct"]

_VISITS, _SCALE = 50.0, 0.1
"""c_visit and c_scale of sigma, as in mctx."""

_TIE = 1e-8
"""Values that differ by less than this share of them are ties: rounding must not choose."""

_GRID = 2.0**20
"""Deficits that are equal in units of 1 / _GRID are ties, for the same reason: rounding must not choose."""


@final
@dataclass(frozen=True)
class Selection:
    """Which actions simulations take.

        gumbel:  pi'(a) (N + b) - N_a,   pi' ~ P exp(sigma(q))   (Danihelka et al. 2022, Sec. 5)
        puct:    q~(a) + c P(a) sqrt(1 + N) / (1 + N_a)          (Rosin 2011, Silver et al. 2017)
        uct:     q~(a) + c sqrt(log(1 + N) / (1 + N_a))          (Kocsis and Szepesvari 2006)

    Each simulation takes the action with the largest number and adds to its N_a; with puct and uct also to N, while b
    is how many there are. q~ is q on the scale on which the values of the actions lie between -1 and 0.
    """

    rule: Rule
    exploration: float

    def split(
        self,
        budget_N: Float[Tensor, "N"],
        *,
        q_NA: Float[Tensor, "N A"],
        visits_NA: Float[Tensor, "N A"],
        prior_NA: Float[Tensor, "N A"],
        exhausted_NA: Float[Tensor, "N A"],
        most_NA: Float[Tensor, "N A"] | None,
    ) -> Float[Tensor, "N A"]:
        """How many of the simulations of a node each action gets: none where it is exhausted, at most `most_NA`."""
        if self.rule == "gumbel":
            deficit_NA = _deficits(q_NA, visits_NA, prior_NA, budget_N)
            return apportion(deficit_NA.add_(exhausted_NA), budget_N, most_NA)
        # One simulation of every node at a time, each to the best action; their number grows with `given_NA`.
        limit_NA = None if most_NA is None else visits_NA + most_NA
        q_NA, given_NA = scaled(q_NA).add_(exhausted_NA), visits_NA.clone()
        for given in range(math.ceil(budget_N.amax())):
            score_NA = self._bonus(given_NA, prior_NA).add_(q_NA)
            if limit_NA is not None:
                score_NA.masked_fill_(given_NA >= limit_NA, -torch.inf)
            best_N1, a_N1 = score_NA.max(1, keepdim=True)
            # In a graph a budget may end in a fraction, and the last simulation is one.
            takes_N1 = (budget_N - given).clamp_(0, 1).unsqueeze(1).masked_fill_(best_N1 == -torch.inf, 0)
            given_NA.scatter_add_(1, a_N1, takes_N1.to(given_NA.dtype))
        return given_NA - visits_NA

    def best(
        self,
        *,
        q_NA: Float[Tensor, "N A"],
        visits_NA: Float[Tensor, "N A"],
        prior_NA: Float[Tensor, "N A"],
        open_NA: Bool[Tensor, "N A"],
    ) -> Int[Tensor, "N"]:
        """The open action that gets the one simulation of a node. Nothing is read back from a GPU."""
        if self.rule == "gumbel":
            score_NA = _deficits(q_NA, visits_NA, prior_NA, 1).mul_(_GRID).round_()
        else:
            score_NA = self._bonus(visits_NA, prior_NA).add_(scaled(q_NA))
        return score_NA.masked_fill_(~open_NA, -torch.inf).argmax(1)

    def _bonus(self, visits_NA: Float[Tensor, "N A"], prior_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N A"]:
        """What puct and uct add to values."""
        total_N1, next_NA = visits_NA.sum(1, keepdim=True), visits_NA + 1
        if self.rule == "puct":
            bonus_NA = (total_N1 + 1).sqrt_() / next_NA * prior_NA
        else:
            bonus_NA = (total_N1.log1p() / next_NA).sqrt_()
        return bonus_NA.mul_(self.exploration)


def _deficits(q_NA: Tensor, visits_NA: Tensor, prior_NA: Tensor, budget_N: Tensor | int) -> Float[Tensor, "N A"]:
    """The visits that pi' deals each action of all N + b, minus those it has had."""
    policy_NA = prior_NA.double() * sigma(q_NA, visits_NA).exp_()
    policy_NA /= policy_NA.sum(1, keepdim=True).clamp_min_(torch.finfo(torch.float64).tiny)
    total_N1 = visits_NA.sum(1).add_(budget_N).unsqueeze(1)
    return policy_NA.mul_(total_N1).sub_(visits_NA)


def most_lacking(lack_NK: Float[Tensor, "N K"]) -> Int[Tensor, "N"]:
    """The place with the largest deficit, which gets one unit; of equal ones the first."""
    return lack_NK.mul(_GRID).round_().argmax(1)


def sigma(q_NA: Float[Tensor, "N A"], visits_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N A"]:
    """(c_visit + max_a N_a) c_scale q~(a): values grow into logits as visits confirm them (Danihelka et al. 2022)."""
    return scaled(q_NA) * visits_NA.amax(1, keepdim=True).add_(_VISITS).mul_(_SCALE)


def scaled(q_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N A"]:
    """Values on the scale on which the best action of a node has 0 and the worst that is allowed -1."""
    # The span is at least a share of the values, so that differences by rounding stay small, and never 0.
    high_N1 = q_NA.amax(1, keepdim=True)
    # -inf of actions that are not allowed does not count: the worst is that of the others.
    low_N1 = torch.where(q_NA > -torch.inf, q_NA, high_N1).amin(1, keepdim=True)
    span_N1 = (high_N1 - low_N1).add_(high_N1.abs(), alpha=_TIE).clamp_min_(torch.finfo(q_NA.dtype).tiny)
    return (q_NA - high_N1).div_(span_N1)


def apportion(
    deficit_NK: Float[Tensor, "N K"], budget_N: Float[Tensor, "N"], most_NK: Float[Tensor, "N K"] | None = None
) -> Float[Tensor, "N K"]:
    """Give each row so many units, one after the other to the place with the largest deficit, which falls by 1; none to
    places at -inf.

    That is water-filling: with the level mu for which sum_k max(0, d_k - mu) = b every place gets the whole part of
    max(0, d_k - mu), and what is left goes to the largest fractions. mu = max_i (d_(1) + .. + d_(i) - b) / i over the
    deficits in descending order, as in the projection on a simplex (Held, Wolfe and Crowder 1974).

    Of equal places the first has precedence. b = 1 is the argmax.

    Args:
        deficit_NK: every row has a place that is not -inf.
        budget_N: whole numbers.
        most_NK: the most that a place takes; what no place takes is left over.
    """
    K = deficit_NK.shape[1]
    if K == 1:
        given_NK = budget_N.unsqueeze(1)
        return given_NK if most_NK is None else given_NK.minimum(most_NK)
    # sharp_NK: deficits in units of the grid, with the least preference for earlier places: no two are equal.
    place_K = torch.arange(K, dtype=deficit_NK.dtype, device=deficit_NK.device)
    sharp_NK = deficit_NK.mul(_GRID).round_().sub_(place_K, alpha=1 / _GRID).div_(_GRID)
    if int(budget_N.amax()) == 1:
        return torch.zeros_like(sharp_NK).scatter_(1, sharp_NK.argmax(1, keepdim=True), budget_N.unsqueeze(1))
    # mu_NK: the level if the i + 1 largest deficits were filled; the largest of these is the level.
    mu_NK = sharp_NK.sort(1, descending=True).values.cumsum(1).sub_(budget_N.unsqueeze(1)).div_(place_K + 1)
    filled_NK = sharp_NK.sub_(mu_NK.amax(1, keepdim=True)).clamp_min_(0)
    given_NK = filled_NK.floor()
    left_N1 = (budget_N - given_NK.sum(1)).unsqueeze(1)  # fewer units than places that were filled
    order_NK = filled_NK.sub_(given_NK).sort(1, descending=True).indices
    given_NK.scatter_add_(1, order_NK, (place_K < left_N1).to(given_NK.dtype))
    if most_NK is None or not bool((given_NK > most_NK).any()):
        return given_NK
    # What full places cannot take goes to the others, by the same rule.
    given_NK = given_NK.minimum(most_NK)
    left_N = budget_N - given_NK.sum(1)
    free_NK = (deficit_NK > -torch.inf) & (given_NK < most_NK)
    at_N = ((left_N > 0) & free_NK.any(1)).nonzero().squeeze(1)
    if len(at_N):
        rest_NK = (deficit_NK - given_NK).masked_fill_(~free_NK, -torch.inf)
        given_NK[at_N] += apportion(rest_NK[at_N], left_N[at_N], (most_NK - given_NK)[at_N])
    return given_NK
