"""Which policies tree search cannot improve: the stationary sets Pi^m of the paper, and how bad they can be.

The proofs are in docs/theory.md.
"""

import itertools
import math
from collections import Counter
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup, sweep
from pgts_torch.errors import PgtsError
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
    return _reward_bound(mdp, exact.check_depth(depth), torch.ones(mdp.num_states, dtype=torch.bool))


def depth_for(mdp: TabularMDP, eps: float) -> int:
    """A depth at which every stationary policy is within eps of the optimum (docs/theory.md, Cor. 1).

        M_eps = ceil( ln( eps (1 - gamma) / (r_max - r_min) ) / ln(gamma) ) - 1,   at least 0

    It is the smallest depth at which `closed_form_bound` is at most eps.

    Raises:
        PgtsError: eps is not positive, or gamma is 1 and so no depth is enough whatever the transitions are.
    """
    if not eps > 0:
        raise PgtsError(f"eps is {eps}; it must be greater than 0")
    at_0, gamma = closed_form_bound(mdp, 0), _largest_discount(mdp.outcomes)
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
    first_S = _reached(mdp, exact.check_depth(depth) + 1)
    return _reward_bound(mdp, depth, _reached_within(mdp, first_S, mdp.num_states))


def worst_case_bound(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int) -> float:
    """The most that pi can lack if it is in Pi^m, m = depth (docs/theory.md, Prop. 3).

        J* - J^pi <= mu^T U^{m+1} (v* - v^pi),   (U x)(s) = max_a sum_k p_k gamma_k x(s'_k)

    that is at most gamma^{m+1} times the largest v* - v^pi among the states that m + 1 steps can reach. For the policy
    of `worst_policy` it bounds every policy in Pi^m.
    """
    lack_S = (exact.optimal(mdp).v_S - exact.policy_values(mdp, pi_SA)).clamp(min=0)
    free = replace(mdp.outcomes, reward_NA=torch.zeros_like(mdp.outcomes.reward_NA))
    return float(mdp.start_S @ sweep(free, lack_S, exact.check_depth(depth) + 1))


def worst_policy(mdp: TabularMDP) -> Float[Tensor, "S A"]:
    """A deterministic policy with the least value in every state: the optimum of the negated rewards."""
    negated = replace(mdp.outcomes, reward_NA=-mdp.outcomes.reward_NA)
    return exact.optimal(replace(mdp, outcomes=negated, reward_SAK=None)).pi_SA


# What a lookahead proves without knowing v*


def residual_bound(mdp: TabularMDP, u_S: Float[Tensor, "S"]) -> Float[Tensor, "S"]:
    """An upper bound on v* from any u (MacQueen 1966; docs/theory.md, Prop. 5).

        v* <= T u + gamma delta / (1 - gamma),   delta = max_s [ (T u)(s) - u(s) ], not below 0

    gamma is the largest discount. Where it is 1 the bound is infinite unless delta is 0; then every policy must end.
    """
    next_S, gamma = backup(mdp.outcomes, u_S).amax(-1), _largest_discount(mdp.outcomes)
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
    expanded_S = _reached_within(mdp, mdp.start_S > 0, exact.check_depth(depth))
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
    hopeful = replace(mdp, outcomes=granted, reward_SAK=None)
    v_S = exact.optimal(hopeful).v_S
    if _largest_discount(granted) < UNDISCOUNTED:
        v_S = residual_bound(hopeful, v_S)  # policy iteration ends a rounding error below the optimum
    return float(mdp.start_S @ (v_S - exact.policy_values(mdp, pi_SA)))


# All deterministic policies

MAX_POLICIES = 2**20
"""Most deterministic policies that are enumerated."""

_BATCH_ENTRIES = 2**18
"""Values that are worked on at once: more leave the processor's cache."""

NEVER = -1
"""Escape depth of a policy that no depth escapes: it is optimal."""


@dataclass(frozen=True, eq=False)
class StationarySets:
    """Pi^0, Pi^1, ... among the deterministic policies of an MDP.

    A policy is in Pi^m for every m below its escape depth (Pi^m shrinks, [PGTS Thm. 1]). The worst return b^m over all
    policies, stochastic ones too, is attained by a deterministic one (docs/theory.md, Prop. 2).

    num_states, num_actions: of the MDP.
    J_P: the returns of the policies.
    escape_P: the smallest m with pi outside Pi^m; NEVER where there is none.
    J_optimal: J*.
    """

    num_states: int
    num_actions: int
    J_P: Float[Tensor, "P"]
    escape_P: Int[Tensor, "P"]
    J_optimal: float

    @property
    def action_PS(self) -> Int[Tensor, "P S"]:
        """The policies, as the action in each state, counted with state 0 as the highest digit."""
        return _policies(0, len(self.J_P), self.num_states, self.num_actions).T

    @property
    def sufficient_depth(self) -> int:
        """The smallest M with Pi^M = Pi^inf: every stationary policy of that depth is optimal."""
        return int(self.escape_P.max().clamp(min=0))

    @property
    def histogram(self) -> dict[int, int]:
        """How many policies have each escape depth, in ascending order; NEVER comes first."""
        return dict(sorted(Counter(self.escape_P.tolist()).items()))

    def member_P(self, depth: int) -> Bool[Tensor, "P"]:
        """Which policies are in Pi^m."""
        return (self.escape_P > depth) | (self.escape_P == NEVER)

    def count(self, depth: int) -> int:
        """|Pi^m|."""
        return int(self.member_P(depth).sum())

    def worst_return(self, depth: int) -> float:
        """b^m = min { J^pi : pi in Pi^m }.        [PGTS Cor. 1]"""
        return float(self.J_P[self.member_P(depth)].min())


def enumerate_sets(
    mdp: TabularMDP, *, max_policies: int = MAX_POLICIES, tolerance: float = TOLERANCE
) -> StationarySets:
    """Decide for every deterministic policy at which depth it stops being stationary.

    Args:
        max_policies: more than these are refused.
        tolerance: largest gap that counts as 0, in units of the largest |Q*| or |reward|.

    Raises:
        PgtsError: the MDP has more than `max_policies` deterministic policies, or one without a value (gamma is 1 and
            it never ends).
    """
    S, A = mdp.num_states, mdp.num_actions
    check_enumerable(S, A, max_policies=max_policies)
    _check_all_end(mdp.outcomes)
    optimum = exact.optimal(mdp)
    slack = _slack(mdp, optimum, tolerance)
    weight_SAS = _dense_weight(mdp.outcomes)
    free = next(n for n in range(S, 0, -1) if S * A**n <= _BATCH_ENTRIES or n == 1)
    parts = []
    for first in range(0, A**S, A**free):
        action_SP = _policies(first, first + A**free, S, A)
        v_SP = _all_values(mdp.outcomes, weight_SAS, action_SP[: S - free, 0])
        visited_SP = _visited(mdp.start_S > 0, weight_SAS > 0, action_SP)
        parts.append((mdp.start_S @ v_SP, _first_escape(mdp, v_SP, visited_SP, optimum, slack)))
    J_P, escape_P = (torch.cat(column) for column in zip(*parts, strict=True))
    return StationarySets(S, A, J_P, escape_P, optimum.J)


def check_enumerable(num_states: int, num_actions: int, *, max_policies: int = MAX_POLICIES) -> None:
    """PgtsError, with their number, if an MDP has more deterministic policies than are enumerated."""
    S, A = num_states, num_actions
    if S * math.log(A) <= math.log(max_policies) + 1e-9:
        return
    digits = S * math.log10(A)
    number = f"{A**S:,}" if digits < 15 else f"about 10^{digits:.0f}"
    fit = next(n for n in itertools.count(0) if A ** (n + 1) > max_policies)
    raise PgtsError(
        f"{number} = {A}^{S} deterministic policies; at most {max_policies} are enumerated: take at most {fit} states "
        f"with {A} actions"
    )


def escape_depth(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], *, tolerance: float = TOLERANCE) -> int:
    """The smallest m with pi outside Pi^m; NEVER if there is none.        [PGTS Thm. 1]

    Args:
        tolerance: largest gap that counts as 0, in units of the largest |Q*| or |reward|.
    """
    optimum = exact.optimal(mdp)
    evaluation = exact.evaluate(mdp, pi_SA)
    v_S1, visited_S1 = evaluation.v_S[:, None], evaluation.d_S[:, None] > 0
    return int(_first_escape(mdp, v_S1, visited_S1, optimum, _slack(mdp, optimum, tolerance)))


def _all_values(
    outcomes: Outcomes, weight_SAS: Float[Tensor, "S A S"], action_F: Int[Tensor, "F"]
) -> Float[Tensor, "S P"]:
    """v^pi of every deterministic policy that takes the given actions in the first F states, in counting order.

    Gaussian elimination of (I - gamma P^pi) v = r, a state at a time. What it holds after s states depends on their
    actions only, so policies that agree there share it, and the whole costs about as much as its last step: S numbers
    for each policy. The matrices are diagonally dominant: no pivots are needed.
    """
    S = outcomes.num_states
    row_SAC = torch.cat([weight_SAS, outcomes.reward_NA[:, :, None]], -1)
    # v_i = sum_j solved_ICQ[i, j] v_j + solved_ICQ[i, -1] over the states j to come, for each of Q starts of a policy
    solved_ICQ = torch.zeros(0, S + 1, 1, dtype=torch.float64)
    for s in range(S):
        row_AC = row_SAC[s, action_F[s]][None] if s < len(action_F) else row_SAC[s]
        _, C, Q = solved_ICQ.shape
        new_ACQ = row_AC[:, s:, None] + (row_AC[:, :s] @ solved_ICQ.flatten(1)).view(-1, C, Q)
        new_CQA = (new_ACQ[:, 1:] / (1 - new_ACQ[:, :1])).permute(1, 2, 0)
        old_ICQA = solved_ICQ[:, 1:, :, None] + solved_ICQ[:, :1, :, None] * new_CQA
        solved_ICQ = torch.cat([old_ICQA, new_CQA[None]]).flatten(2)
    return solved_ICQ[:, 0]


def _visited(
    start_S: Bool[Tensor, "S"], leads_SAS: Bool[Tensor, "S A S"], action_SP: Int[Tensor, "S P"]
) -> Bool[Tensor, "S P"]:
    """Where each policy goes with positive discount: sigma_pi."""
    visited_SP, before = start_S[:, None].repeat(1, action_SP.shape[1]), -1
    while (count := int(visited_SP.sum())) > before:
        before = count
        for s, action_P in enumerate(action_SP):
            visited_SP |= leads_SAS[s].T[:, action_P] & visited_SP[s]
    return visited_SP


def _first_escape(
    mdp: TabularMDP,
    v_SP: Float[Tensor, "S P"],
    visited_SP: Bool[Tensor, "S P"],
    optimum: exact.Optimum,
    slack: float,
) -> Int[Tensor, "P"]:
    """For each of P policies the first m at which a visited state sees more than `slack` above v^pi.

    max_a (T^m Q^pi)(s, a) = (T^{m+1} v^pi)(s) grows to v*(s): a policy whose visited states fall short of v* by more
    than `slack` escapes at some m, and no other does.
    """
    enough_SP = torch.where(visited_SP, v_SP + slack, torch.inf)
    depth_P = torch.full(enough_SP.shape[1:], NEVER)
    short_P = (optimum.v_S[:, None] > enough_SP).any(0).nonzero().flatten()
    v_SP, enough_SP = v_SP[:, short_P], enough_SP[:, short_P]
    depth = 0
    while len(short_P):
        seen_SP = _optimal_step(mdp.outcomes, v_SP)
        escaped_P = (seen_SP > enough_SP).any(0)
        depth_P[short_P[escaped_P]] = depth
        # Rounding can hold what is seen a last bit below a v* that is `slack` away: what no longer grows never escapes.
        kept_P = ~escaped_P & (seen_SP > v_SP).any(0)
        short_P, v_SP, enough_SP = short_P[kept_P], seen_SP[:, kept_P], enough_SP[:, kept_P]
        depth += 1
    return depth_P


def _optimal_step(outcomes: Outcomes, v_SP: Float[Tensor, "S P"]) -> Float[Tensor, "S P"]:
    """T v = max_a (r + gamma P v) for many value functions at once: `backup` with a matrix of values."""
    S, A = outcomes.reward_NA.shape
    q_SAP = (outcomes.weight @ v_SP).view(S, A, -1) + outcomes.reward_NA[:, :, None]
    return q_SAP.amax(1)


def _policies(low: int, high: int, num_states: int, num_actions: int) -> Int[Tensor, "S P"]:
    """Deterministic policies number low .. high - 1, counted with state 0 as the highest digit."""
    digit = range(num_states - 1, -1, -1)
    return torch.stack([torch.arange(low, high) // num_actions**place % num_actions for place in digit])


def _slack(mdp: TabularMDP, optimum: exact.Optimum, tolerance: float) -> float:
    """The tolerance in reward units; multiplying all rewards by a number changes no stationary set."""
    return tolerance * float(torch.maximum(optimum.q_SA.abs().max(), mdp.outcomes.reward_NA.abs().max()))


# Properties of the outcomes


def _largest_discount(outcomes: Outcomes) -> float:
    return float(outcomes.discount_NAK[outcomes.prob_NAK > 0].max())


def _reward_bound(mdp: TabularMDP, depth: int, states_S: Bool[Tensor, "S"]) -> float:
    """gamma^{m+1} (r_max - r_min) / (1 - gamma) over some states; 0 where there are none or all earn the same."""
    if not states_S.any():
        return 0.0
    outcomes, gamma = mdp.outcomes.rows(states_S.nonzero().flatten()), _largest_discount(mdp.outcomes)
    low, high = float(outcomes.reward_NA.min()), float(outcomes.reward_NA.max())
    if _has_ends(outcomes, gamma):
        low, high = min(low, 0.0), max(high, 0.0)
    if high == low:
        return 0.0
    return math.inf if gamma >= UNDISCOUNTED else gamma ** (depth + 1) * (high - low) / (1 - gamma)


def highest_value(outcomes: Outcomes) -> float:
    """The most that a state can be worth if only gamma, r_max and whether something ends are known.

    r_max / (1 - gamma), from earning r_max for ever; but r_max, from ending at once, if that is more. Where gamma is 1
    it is infinite, unless no reward is positive: then it is r_max.
    """
    gamma, highest = _largest_discount(outcomes), float(outcomes.reward_NA.max())
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


def _dense_weight(outcomes: Outcomes) -> Float[Tensor, "S A S"]:
    return outcomes.weight.to_dense().view(outcomes.num_states, outcomes.num_actions, -1)


def _followers(mdp: TabularMDP, from_S: Bool[Tensor, "S"]) -> Bool[Tensor, "S"]:
    """States that one step leads to, along outcomes with positive probability and discount."""
    outcomes = mdp.outcomes
    alive_NAK = (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0) & from_S[:, None, None]
    next_S = torch.zeros_like(from_S)
    next_S[outcomes.child_NAK[alive_NAK]] = True
    return next_S


def _reached(mdp: TabularMDP, steps: int) -> Bool[Tensor, "S"]:
    """R_n: the states that some policy reaches in exactly n steps from the start."""
    states_S = mdp.start_S > 0
    for _ in range(steps):
        states_S = _followers(mdp, states_S)
    return states_S


def _reached_within(mdp: TabularMDP, states_S: Bool[Tensor, "S"], steps: int) -> Bool[Tensor, "S"]:
    """Some states and those that some policy reaches from them in at most n steps; n = S: all that follow."""
    for _ in range(min(steps, mdp.num_states)):
        new_S = _followers(mdp, states_S) & ~states_S
        if not new_S.any():
            break
        states_S = states_S | new_S
    return states_S


def _check_all_end(outcomes: Outcomes) -> None:
    """PgtsError if a policy may go on for ever undiscounted: then I - gamma P^pi is singular."""
    if _largest_discount(outcomes) < UNDISCOUNTED:
        return
    may_end_SA = ((outcomes.discount_NAK < UNDISCOUNTED) & (outcomes.prob_NAK > 0)).any(-1)
    endless_S = torch.ones(outcomes.num_states, dtype=torch.bool)
    for _ in range(outcomes.num_states):
        leaves_SA = ((outcomes.prob_NAK > 0) & ~endless_S[outcomes.child_NAK]).any(-1)
        endless_S = endless_S & ~(may_end_SA | leaves_SA).all(-1)
    if endless_S.any():
        raise PgtsError(
            f"gamma is 1 and from state {int(endless_S.nonzero()[0])} some policy never ends: it has no finite value; "
            f"take a gamma below 1"
        )
