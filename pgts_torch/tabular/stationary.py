"""Whether tree search can improve a policy, and how bad one can be that it cannot: the sets Pi^m of the paper.

The proofs are in docs/theory.md.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup, sweep
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.tabular import exact
from pgts_torch.tabular.exact import UNDISCOUNTED
from pgts_torch.tabular.mdp import TabularMDP

TOLERANCE = 1e-9
"""Largest gap that counts as 0."""


def gap(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int) -> Float[Tensor, "S"]:
    """How far pi is from being stationary for a lookahead of m = depth.        [PGTS Lemma 2]

        g_m(s) = max_a (T^m Q^pi)(s, a) - v^pi(s) >= 0   where d^pi(s) > 0,   and 0 elsewhere

    pi is in Pi^m if and only if g_m is 0. It grows with m, so Pi^m shrinks [PGTS Thm. 1].
    """
    evaluation = exact.evaluate(mdp, pi_SA)
    look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
    gap_S = (look_SA.amax(-1) - evaluation.v_S).clamp(min=0)
    return torch.where(evaluation.d_S > 0, gap_S, 0.0)


def is_stationary(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int, *, tolerance: float = TOLERANCE) -> bool:
    """Whether pi is in Pi^m, m = depth: no visited state sees anything better than v^pi.        [PGTS Lemma 2]

        pi in Pi^m  <=>  pi = proj[ pi + eta D^pi T^m Q^pi ]        [PGTS Eq. (4)]

    It holds for all step sizes eta > 0 or for none [PGTS Lemma 1]; optimal policies are in every Pi^m [PGTS Prop. 1].

    Args:
        tolerance: largest gap that counts as 0, in reward units.
    """
    return bool((gap(mdp, pi_SA, depth) <= tolerance).all())


# How bad a stationary policy can be: bounds on J* - J^pi that hold for every pi in Pi^m


def closed_form_bound(mdp: TabularMDP, depth: int) -> float:
    """The most that a policy in Pi^m, m = depth, can lack, from gamma and the rewards alone (docs/theory.md, Cor. 1).

        J* - J^pi <= gamma^{m+1} (r_max - r_min) / (1 - gamma)

    gamma is the largest discount. Where some outcome has a smaller one, an end for instance, 0 counts as a reward:
    after an end nothing is earned. Infinite where gamma is 1.
    """
    return _reward_bound(mdp, check_count("depth", depth, least=0), torch.ones(mdp.num_states, dtype=torch.bool))


def depth_for(mdp: TabularMDP, eps: float) -> int:
    """A depth at which every stationary policy is within eps of the optimum (docs/theory.md, Cor. 1).

        M_eps = ceil( ln( eps (1 - gamma) / (r_max - r_min) ) / ln(gamma) ) - 1,   at least 0

    It is the smallest depth at which `closed_form_bound` is at most eps.

    Raises:
        PgtsError: eps is not positive, or gamma is 1 and so no depth is enough whatever the transitions are.
    """
    if not eps > 0:
        raise PgtsError(f"eps is {eps}; it must be greater than 0")
    at_0, gamma = closed_form_bound(mdp, 0), largest_discount(mdp.outcomes)
    if at_0 <= eps:
        return 0
    if math.isinf(at_0):
        raise PgtsError(f"the largest discount is {gamma}; a depth in closed form needs one below 1")
    depth = math.ceil(math.log(eps / at_0) / math.log(gamma))
    # The logarithms round: where eps is met exactly they may be one off.
    near = range(max(depth - 1, 0), depth + 1)
    return next((m for m in near if closed_form_bound(mdp, m) <= eps), depth + 1)


def reachable_bound(mdp: TabularMDP, depth: int) -> float:
    """`closed_form_bound` with the rewards of those states only that can still be met after depth + 1 steps.

    0 where every path has ended by then, also with gamma 1.
    """
    states_S = mdp.start_S > 0
    for _ in range(check_count("depth", depth, least=0) + 1):
        states_S = _followers(mdp, states_S)
    return _reward_bound(mdp, depth, _reached_within(mdp, states_S, mdp.num_states))


def worst_case_bound(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int) -> float:
    """The most that pi can lack if it is in Pi^m, m = depth (docs/theory.md, Prop. 3).

        J* - J^pi <= mu^T U^{m+1} (v* - v^pi),   (U x)(s) = max_a sum_k p_k gamma_k x(s'_k)

    that is at most gamma^{m+1} times the largest v* - v^pi among the states that m + 1 steps can reach. For the policy
    of `worst_policy` it bounds every policy in Pi^m.
    """
    lack_S = (exact.optimal(mdp).v_S - exact.policy_values(mdp, pi_SA)).clamp(min=0)
    return _behind(mdp, lack_S, depth)


def gap_bound(
    mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int, *, lack_S: Float[Tensor, "S"] | None = None
) -> float:
    """An upper bound on J* - J^pi, for any pi, from its gap at the start states (docs/theory.md, Prop. 12).

        J* - J^pi <= mu^T g_m + mu^T U^{m+1} x,        x >= v* - v^pi

    What a lookahead of m = depth sees, and what may lie behind it. `worst_case_bound` is the second term with x = v* -
    v^pi; it is all for pi in Pi^m.

    Args:
        lack_S: x. Default: w - v^pi with w = `highest_value`, for which v* need not be known; `certificate` is no
            larger then.
    """
    v_S = exact.policy_values(mdp, pi_SA)
    if lack_S is None:
        lack_S = highest_value(mdp.outcomes) - v_S
    return float(mdp.start_S @ gap(mdp, pi_SA, depth)) + _behind(mdp, lack_S, depth)


def _behind(mdp: TabularMDP, lack_S: Float[Tensor, "S"], depth: int) -> float:
    """mu^T U^{m+1} x, with x what is lacking after m + 1 steps."""
    free = mdp.outcomes.paying(torch.zeros_like(mdp.outcomes.reward_NA))
    return float(mdp.start_S @ sweep(free, lack_S, check_count("depth", depth, least=0) + 1))


def worst_policy(mdp: TabularMDP) -> Float[Tensor, "S A"]:
    """A deterministic policy with the least value in every state: the optimum of the negated rewards."""
    negated = mdp.outcomes.paying(-mdp.outcomes.reward_NA)
    return exact.optimal(replace(mdp, outcomes=negated, reward_SAK=None)).pi_SA


# What a lookahead proves without knowing v*


def residual_bound(mdp: TabularMDP, u_S: Float[Tensor, "S"]) -> Float[Tensor, "S"]:
    """An upper bound on v* from any u (MacQueen 1966; docs/theory.md, Prop. 5).

        v* <= T u + gamma delta / (1 - gamma),   delta = max_s [ (T u)(s) - u(s) ], not below 0

    gamma is the largest discount. Where it is 1 the bound is infinite unless delta is 0; then every policy must end.
    """
    next_S, gamma = backup(mdp.outcomes, u_S).amax(-1), largest_discount(mdp.outcomes)
    delta = max(0.0, float((next_S - u_S).max()))
    if gamma >= UNDISCOUNTED:
        return next_S + (math.inf if delta else 0.0)
    return next_S + gamma * delta / (1 - gamma)


def certificate(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int) -> float:
    """An upper bound on J* - J^pi, for any pi, that a lookahead of m = depth proves (docs/theory.md, Prop. 6).

    The lookahead expands the states that the start distribution reaches in at most m steps. Of all others it knows
    only that no reward exceeds r_max, so it grants them w = r_max / (1 - gamma), and takes the optimum of what it sees:

        J* - J^pi <= mu^T (v_hat - v^pi),   v_hat = T v_hat where expanded,   v_hat = w elsewhere

    (w = r_max where it is not positive and outcomes may end.)

    It never grows with m, and it is J* - J^pi itself once the expanded states lead nowhere else. Nothing smaller
    follows from the expanded states and r_max. Infinite where w is (gamma is 1).
    """
    expanded_S = _reached_within(mdp, mdp.start_S > 0, check_count("depth", depth, least=0))
    beyond_S = _followers(mdp, expanded_S) & ~expanded_S
    w = highest_value(mdp.outcomes) if beyond_S.any() else 0.0
    if math.isinf(w):
        return math.inf
    outcomes = mdp.outcomes
    granted = replace(
        outcomes,
        reward_NA=torch.where(expanded_S[:, None], outcomes.reward_NA, w),
        discount_NAK=torch.where(expanded_S[:, None, None], outcomes.discount_NAK, 0.0),
    )
    optimistic = replace(mdp, outcomes=granted, reward_SAK=None)
    v_S = exact.optimal(optimistic).v_S
    if largest_discount(granted) < UNDISCOUNTED:
        v_S = residual_bound(optimistic, v_S)  # policy iteration ends a rounding error below the optimum
    return float(mdp.start_S @ (v_S - exact.policy_values(mdp, pi_SA)))


# Properties of the outcomes


def largest_discount(outcomes: Outcomes) -> float:
    """Of the outcomes of positive probability."""
    return float(outcomes.discount_NAK[outcomes.prob_NAK > 0].max())


def _reward_bound(mdp: TabularMDP, depth: int, states_S: Bool[Tensor, "S"]) -> float:
    """gamma^{m+1} (r_max - r_min) / (1 - gamma) over some states; 0 where there are none or all earn the same."""
    if not states_S.any():
        return 0.0
    outcomes, gamma = mdp.outcomes.rows(states_S.nonzero().flatten()), largest_discount(mdp.outcomes)
    low, high = (float(x) for x in torch.aminmax(outcomes.finite_rewards))
    if _has_ends(outcomes, gamma):
        low, high = min(low, 0.0), max(high, 0.0)
    if high == low:
        return 0.0
    return math.inf if gamma >= UNDISCOUNTED else gamma ** (depth + 1) * (high - low) / (1 - gamma)


def highest_value(outcomes: Outcomes) -> float:
    """The most that a state can be worth if only gamma, r_max and whether something ends are known.

    r_max / (1 - gamma), from earning r_max forever; but r_max, from ending at once, if that is more. Where gamma is 1
    it is infinite, unless no reward is positive: then it is r_max.
    """
    gamma, highest = largest_discount(outcomes), float(outcomes.reward_NA.max())
    if highest <= 0 and (gamma >= UNDISCOUNTED or _has_ends(outcomes, gamma)):
        return highest
    return math.inf if gamma >= UNDISCOUNTED else highest / (1 - gamma)


def lowest_value(outcomes: Outcomes) -> float:
    """The least that a policy can be worth in a state, if only as much is known as in `highest_value`. Actions that
    are not allowed, with rewards of -inf, do not count."""
    negated_NA = -outcomes.reward_NA
    return -highest_value(replace(outcomes, reward_NA=torch.where(negated_NA < math.inf, negated_NA, -math.inf)))


def _has_ends(outcomes: Outcomes, gamma: float) -> bool:
    """Whether some outcome has a smaller discount than gamma.

    It is one with discount gamma that ends with probability 1 - gamma_k / gamma (docs/theory.md, Words).
    """
    return float(outcomes.discount_NAK[outcomes.prob_NAK > 0].min()) < gamma


def _followers(mdp: TabularMDP, from_S: Bool[Tensor, "S"]) -> Bool[Tensor, "S"]:
    """States that one step leads to, along outcomes with positive probability and discount."""
    outcomes = mdp.outcomes
    alive_NAK = (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0) & from_S[:, None, None]
    next_S = torch.zeros_like(from_S)
    next_S[outcomes.child_NAK[alive_NAK]] = True
    return next_S


def _reached_within(mdp: TabularMDP, states_S: Bool[Tensor, "S"], steps: int) -> Bool[Tensor, "S"]:
    """These states and those that some policy reaches from them in at most so many steps; S steps: all that follow."""
    for _ in range(min(steps, mdp.num_states)):
        new_S = _followers(mdp, states_S) & ~states_S
        if not new_S.any():
            break
        states_S = states_S | new_S
    return states_S
