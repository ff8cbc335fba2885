"""The exact theory of a tabular MDP, in float64: what every estimate in this library is tested against."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup, policy_mean
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.tabular.improvement import improve, total_weights
from pgts_torch.tabular.mdp import TabularMDP

Matrix = scipy.sparse.csr_array | scipy.sparse.csc_array

DENSE_LIMIT = 1500
"""Up to this many states a policy is evaluated by a dense solve, beyond it by a sparse iterative one."""

SOLVE_TOLERANCE = 1e-12
"""Largest residual of the iterative solve, relative to the right-hand side, in the maximum norm."""

UNDISCOUNTED = 1 - 1e-12
"""A discount from here on counts as 1, so that a policy must terminate to have a value that float64 can tell."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What a policy is worth.

    v_S: v^pi = (I - gamma P^pi)^-1 R^pi.   q_SA: Q^pi = R + gamma P v^pi.
    d_S: occupancy mu^T (I - gamma P^pi)^-1, unnormalised.   J: return mu^T v^pi.        [PGTS Sec. 2]

        dJ / dpi(a|s) = d^pi(s) Q^pi(s, a)        [PGTS Eq. (1)]
    """

    v_S: Float[Tensor, "S"]
    q_SA: Float[Tensor, "S A"]
    d_S: Float[Tensor, "S"]
    J: float


@dataclass(frozen=True, eq=False)
class Optimum:
    """v*, Q* and J* = mu^T v*, with a deterministic policy that attains them."""

    v_S: Float[Tensor, "S"]
    q_SA: Float[Tensor, "S A"]
    pi_SA: Float[Tensor, "S A"]
    J: float


def evaluate(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"]) -> Evaluation:
    """v^pi, Q^pi, d^pi and J^pi.        [PGTS Sec. 2]

    Raises:
        PgtsError: a row of pi is not a distribution, or the policy neither discounts nor ends (no finite value).
    """
    v_S = policy_values(mdp, pi_SA)
    return Evaluation(v_S, backup(mdp.outcomes, v_S), occupancy(mdp, pi_SA), float(mdp.start_S @ v_S))


def policy_values(
    mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], *, near_S: Float[Tensor, "S"] | None = None
) -> Float[Tensor, "S"]:
    """v^pi = (I - gamma P^pi)^-1 R^pi.        [PGTS Sec. 2]

    Args:
        near_S: values near them, from which an iterative solve starts. Default: 0.
    """
    pi_SA = check_policy(mdp, pi_SA)
    return _solve(mdp, pi_SA, policy_mean(pi_SA, mdp.outcomes.reward_NA), transpose=False, near_S=near_S)


def occupancy(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"]) -> Float[Tensor, "S"]:
    """d^pi = mu^T (I - gamma P^pi)^-1, unnormalised: it sums to 1/(1 - gamma).        [PGTS Sec. 2]

    It is exactly 0 where pi never goes from the start distribution, and positive everywhere else.
    """
    pi_SA = check_policy(mdp, pi_SA)
    d_S = _solve(mdp, pi_SA, mdp.start_S, transpose=True)
    least = torch.finfo(torch.float64).tiny  # the iterative solve may miss a rare state by more than its occupancy
    return torch.where(support(mdp, pi_SA), d_S.clamp(min=least), 0.0)


def support(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"]) -> Bool[Tensor, "S"]:
    """sigma_pi = {s : d^pi(s) > 0} as a mask, by reachability, which does not round.        [PGTS Sec. 4]"""
    matrix = _policy_matrix(mdp, check_policy(mdp, pi_SA))
    return torch.from_numpy(_closure(matrix.T, mdp.start_S.numpy() > 0))


def bellman(mdp: TabularMDP, q_SA: Float[Tensor, "S A"]) -> Float[Tensor, "S A"]:
    """(T Q)(s, a) = r(s, a) + sum_s' gamma P(s'|s, a) max_a' Q(s', a').        [PGTS Sec. 3]"""
    return backup(mdp.outcomes, q_SA.amax(-1))


def lookahead(mdp: TabularMDP, q_SA: Float[Tensor, "S A"], depth: int) -> Float[Tensor, "S A"]:
    """T^m Q for m = depth.        [PGTS Sec. 3]

    With Q = Q^pi it equals h-PMD's Q_h for h = m + 1 (Protopapas and Barakat, NeurIPS 2024).
    """
    for _ in range(check_count("depth", depth, least=0)):
        q_SA = bellman(mdp, q_SA)
    return q_SA


def optimal(mdp: TabularMDP, tolerance: float | None = None) -> Optimum:
    """v*, Q*, J* by policy iteration: v^{pi_0} <= v^{pi_1} <= ... ends at v* = T v*  (Howard, 1960).

    The policy changes only where an action is better by more than rounding, so it ends after finitely many steps.
    Where gamma is 1, the policies that end the episode compete. Large MDPs start with the actions that modified policy
    iteration finds.

    With a tolerance modified policy iteration is all, until its bounds prove that v_S and J are within the tolerance of
    v* and J*; so is q_SA of Q*, and pi_SA loses at most twice as much in any state (`improvement.improve`).

    Args:
        tolerance: in reward units. Default: none, and errors are those of rounding.

    Raises:
        PgtsError: no finite value: from some state nothing ends, or the return grows without limit. A tolerance where
            an action does not discount, or one that float64 cannot prove.
    """
    if tolerance is not None:
        return _optimal_within(mdp, tolerance)
    action_S, v_S = mdp.outcomes.reward_NA.argmax(-1), torch.zeros(mdp.num_states, dtype=torch.float64)
    if mdp.num_states > DENSE_LIMIT and total_weights(mdp.outcomes)[1] < UNDISCOUNTED:
        found = improve(mdp.outcomes, error=torch.inf)
        action_S, v_S = found.action_S, found.v_S
    action_S = _ending_actions(mdp.outcomes, action_S)
    while True:
        pi_SA = torch.nn.functional.one_hot(action_S, mdp.num_actions).double()
        v_S = policy_values(mdp, pi_SA, near_S=v_S)
        q_SA = backup(mdp.outcomes, v_S)
        legal_SA = mdp.outcomes.legal_NA
        rounding = 1e-11 * max(float(q_SA[legal_SA].abs().max()), float(mdp.outcomes.finite_rewards.abs().max()))
        kept_S = q_SA.gather(1, action_S[:, None]).squeeze(1)
        better_S = q_SA.amax(-1) > kept_S + rounding
        if not better_S.any():
            return Optimum(v_S, q_SA, pi_SA, float(mdp.start_S @ v_S))
        action_S = torch.where(better_S, q_SA.argmax(-1), action_S)


def _optimal_within(mdp: TabularMDP, tolerance: float) -> Optimum:
    if total_weights(mdp.outcomes)[1] >= UNDISCOUNTED:
        raise PgtsError("a tolerance is proved only where every action discounts: leave it out")
    found = improve(mdp.outcomes, error=tolerance)
    if not found.error <= tolerance:
        raise PgtsError(
            f"tolerance is {tolerance}; what float64 proves for this MDP is {found.error:.1e}: choose a larger one, or "
            "leave it out"
        )
    pi_SA = torch.nn.functional.one_hot(found.action_S, mdp.num_actions).double()
    return Optimum(found.v_S, backup(mdp.outcomes, found.v_S), pi_SA, float(mdp.start_S @ found.v_S))


def check_policy(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"]) -> Float[Tensor, "S A"]:
    """pi in float64, its rows summing to 1 in that precision; PgtsError unless each row is a distribution over the
    actions that are allowed."""
    if pi_SA.shape != (mdp.num_states, mdp.num_actions):
        raise PgtsError(f"pi_SA has shape {tuple(pi_SA.shape)}; the MDP needs {(mdp.num_states, mdp.num_actions)}")
    tolerance = 1e-9 if pi_SA.dtype == torch.float64 else 1e-5
    pi_SA = pi_SA.detach().to("cpu", torch.float64)
    bad_S = ~((pi_SA >= 0).all(-1) & ((pi_SA.sum(-1) - 1).abs() <= tolerance))
    if bad_S.any():
        s = int(torch.nonzero(bad_S)[0])
        raise PgtsError(f"pi_SA[{s}] is not a distribution: {pi_SA[s].tolist()}")
    if (illegal_SA := (pi_SA > 0) & ~mdp.outcomes.legal_NA).any():
        s, a = torch.nonzero(illegal_SA)[0].tolist()
        raise PgtsError(f"pi_SA[{s}, {a}] is {float(pi_SA[s, a])}; action {a} is not allowed in state {s}")
    return pi_SA / pi_SA.sum(-1, keepdim=True)


def _policy_matrix(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"]) -> scipy.sparse.csr_array:
    """gamma P^pi as a sparse [S, S] matrix, without the entries of actions that pi never takes."""
    S, A, K = mdp.outcomes.child_NAK.shape
    weight = mdp.outcomes.weight
    # The A rows of a state, which stand side by side in `weight`, become one; what is 0 is left out.
    values = (pi_SA[:, :, None] * weight.values().view(S, A, K)).view(S, A * K).numpy()
    children, kept = weight.col_indices().numpy(), values != 0
    rows = np.zeros(S + 1, dtype=children.dtype)
    np.cumsum(kept.sum(axis=1), out=rows[1:])
    return scipy.sparse.csr_array((values[kept], children[kept.reshape(-1)], rows), shape=(S, S), copy=False)


def _solve(
    mdp: TabularMDP, pi_SA: Tensor, b_S: Float[Tensor, "S"], *, transpose: bool, near_S: Tensor | None = None
) -> Float[Tensor, "S"]:
    """x with (I - gamma P^pi) x = b, or with the transposed matrix."""
    forward = _policy_matrix(mdp, pi_SA)
    _check_ends(mdp.outcomes, pi_SA, forward)
    matrix, b = forward.T if transpose else forward, b_S.numpy()
    if mdp.num_states <= DENSE_LIMIT:
        # By torch, which keeps to the threads it was given: on busy cores those of numpy make it much slower.
        identity = torch.eye(len(b), dtype=torch.float64)
        return torch.linalg.solve(identity - torch.from_numpy(matrix.toarray()), b_S)
    return torch.from_numpy(_solve_iterative(matrix, b, np.zeros_like(b) if near_S is None else near_S.numpy()))


def ends(outcomes: Outcomes) -> Bool[Tensor, "S A"]:
    """Where an outcome of (s, a) discounts or terminates."""
    if float(outcomes.discount_NAK.amax()) < UNDISCOUNTED:
        return torch.ones_like(outcomes.reward_NA, dtype=torch.bool)
    return ((outcomes.discount_NAK < UNDISCOUNTED) & (outcomes.prob_NAK > 0)).any(-1)


def _ending_actions(outcomes: Outcomes, action_S: Tensor) -> Tensor:
    """The given actions, but in states from which these might never end, one that leads toward an end."""
    ends_SA, found_S = ends(outcomes) & outcomes.legal_NA, torch.zeros(outcomes.num_states, dtype=torch.bool)
    while True:
        leads_SA = torch.mv(outcomes.weight, found_S.double()).view(ends_SA.shape) > 0
        leads_SA = ends_SA | (leads_SA & outcomes.legal_NA)
        new_S = leads_SA.any(-1) & ~found_S
        if not new_S.any():
            return action_S
        kept_S = leads_SA.gather(1, action_S[:, None]).squeeze(1)
        action_S = torch.where(new_S & ~kept_S, leads_SA.int().argmax(-1), action_S)
        found_S = found_S | new_S


def _check_ends(outcomes: Outcomes, pi_SA: Tensor, matrix: scipy.sparse.csr_array) -> None:
    """PgtsError unless every state can reach one where the policy discounts or terminates: else I - M is singular."""
    found = _closure(matrix, (ends(outcomes) & (pi_SA > 0)).any(-1).numpy())
    if not found.all():
        raise PgtsError(
            f"the policy has no finite value in state {int(np.argmin(found))}: from there on it neither discounts "
            f"(gamma is 1) nor terminates"
        )


def _closure(matrix: Matrix, found: np.ndarray) -> np.ndarray:
    """The states found, and those with a path of positive entries to one of them: rows lead to columns."""
    while not found.all():
        grown = found | ((matrix @ found.astype(np.float64)) > 0)
        if (grown == found).all():
            break
        found = grown
    return found


def _solve_iterative(matrix: Matrix, b: np.ndarray, x: np.ndarray) -> np.ndarray:
    """BiCGSTAB from x on, restarted until the residual b - (I - M) x is within SOLVE_TOLERANCE of b."""

    def identity_minus(x: np.ndarray) -> np.ndarray:
        return x - matrix @ x

    operator = scipy.sparse.linalg.LinearOperator(matrix.shape, matvec=identity_minus, dtype=b.dtype)
    scale = max(float(np.abs(b).max()), np.finfo(float).tiny)
    for _ in range(20):
        residual = b - identity_minus(x)
        if np.abs(residual).max() <= SOLVE_TOLERANCE * scale:
            return x
        correction, _ = scipy.sparse.linalg.bicgstab(operator, residual, rtol=1e-10, atol=0.0, maxiter=2000)
        x = x + correction
    raise PgtsError(f"the iterative solve of {len(b)} states stopped at a residual of {np.abs(residual).max():.1e}")
