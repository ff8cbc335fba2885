"""The stationary sets Pi^m of an MDP: at which depth each deterministic policy stops being stationary.

The proofs are in docs/theory.md.
"""

import itertools
import math
from collections import Counter
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP
from pgts_torch.tabular.stationary import TOLERANCE

MAX_POLICIES = 2**20
"""Most deterministic policies that are enumerated."""

BATCH_ENTRIES = 2**18
"""Values that are worked on at once. More leave the processor's cache."""

NEVER = -1
"""Escape depth of a policy that no depth escapes, which is optimal."""


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
            it never ends), or does not allow all actions.
    """
    S, A = mdp.num_states, mdp.num_actions
    check_enumerable(S, A, max_policies=max_policies)
    _check_all_allowed(mdp.outcomes)
    _check_all_end(mdp.outcomes)
    optimum = exact.optimal(mdp)
    slack = _slack(mdp, optimum, tolerance)
    weight_SAS = mdp.outcomes.weight.to_dense().view(S, A, S)
    free = next(n for n in range(S, 0, -1) if S * A**n <= BATCH_ENTRIES or n == 1)
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
    largest_q = optimum.q_SA[mdp.outcomes.legal_NA].abs().max()
    return tolerance * float(torch.maximum(largest_q, mdp.outcomes.finite_rewards.abs().max()))


def _check_all_allowed(outcomes: Outcomes) -> None:
    """PgtsError where not all actions are allowed, so that not every table of actions is a policy."""
    if not outcomes.legal_NA.all():
        s, a = torch.nonzero(~outcomes.legal_NA)[0].tolist()
        raise PgtsError(f"action {a} is not allowed in state {s}; policies are enumerated where all actions are")


def _check_all_end(outcomes: Outcomes) -> None:
    """PgtsError if a policy may go on forever undiscounted: then I - gamma P^pi is singular."""
    ends_SA = exact.ends(outcomes)
    if ends_SA.all():
        return
    endless_S = torch.ones(outcomes.num_states, dtype=torch.bool)
    for _ in range(outcomes.num_states):
        leaves_SA = ((outcomes.prob_NAK > 0) & ~endless_S[outcomes.child_NAK]).any(-1)
        endless_S = endless_S & ~(ends_SA | leaves_SA).all(-1)
    if endless_S.any():
        raise PgtsError(
            f"gamma is 1 and from state {int(endless_S.nonzero()[0])} some policy never ends: it has no finite value; "
            f"take a gamma below 1"
        )
