"""The forms in which an MDP's transitions and rewards are stored elsewhere, as one table of outcomes.

[S, A, S]               a dense array, P[s, a, s'] (textbooks, QuantEcon's DiscreteDP)
[A, S, S]               a dense array, P[a, s, s'] (pymdptoolbox)
A matrices [S, S]       scipy.sparse, one for each action (pymdptoolbox); no dense array is made of them
one matrix [S A, S]     scipy.sparse, row s A + a in the order "SAS" (QuantEcon), row a S + s in the order "ASS"

rewards: [S], [S, A], or of single outcomes: in the form and order of P
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError

Order = Literal["SAS", "ASS"]
"""Whether P[s, a] or P[a, s] is the distribution over next states."""

Start = int | ArrayLike | None
"""A state, a distribution over states, or None for the uniform one."""

EXACT, STORED = 1e-9, 1e-5
"""How far from 1 the probabilities of a row may sum: up to EXACT they are taken as they are, up to STORED they were
rounded when they were stored (float32, six digits) and are divided by their sum, beyond it they are refused."""

_MOST_ENTRIES = 2**31


class _Table(NamedTuple):
    """What may follow each (state, action): K successors, padded with probability 0."""

    prob_SAK: Float[np.ndarray, "S A K"]
    child_SAK: Int[np.ndarray, "S A K"]


def normalised(prob: Float[np.ndarray, "... K"]) -> Float[np.ndarray, "... K"]:
    """Rows that rounding has taken a little off 1, divided by their sums; the others keep their bits."""
    total = prob.sum(-1, keepdims=True)
    off = np.abs(total - 1)
    rounded = (off > EXACT) & (off <= STORED)
    return prob / np.where(rounded, total, 1.0) if rounded.any() else prob


def start_distribution(start: Start, num_states: int) -> Float[Tensor, "S"]:
    """mu as a vector."""
    if start is None:
        return torch.full((num_states,), 1 / num_states, dtype=torch.float64)
    if isinstance(start, int | np.integer):
        if not 0 <= start < num_states:
            raise PgtsError(f"start state {start} does not exist; states are 0 to {num_states - 1}")
        return torch.nn.functional.one_hot(torch.tensor(int(start)), num_states).double()
    return torch.from_numpy(normalised(np.array(start, dtype=np.float64, ndmin=1)))


def outcomes_from(P: Any, R: Any, gamma: float, order: Order | None) -> tuple[Outcomes, Float[Tensor, "S A K"] | None]:
    """The outcomes of transitions and rewards in one of the forms above, in float64; and the reward of each outcome,
    where those of one (s, a) differ.

    Args:
        order: which axis comes first; None: as the shape says.

    Raises:
        PgtsError: no such form; an order that the shape leaves open or contradicts; no probability; or rewards that do
            not fit.
    """
    if order not in ("SAS", "ASS", None):
        raise PgtsError(f"order is {order!r}; it must be 'SAS' or 'ASS'")
    if scipy.sparse.issparse(P):
        P, order = _stacked(P, order)
    if _is_sparse_list(P):
        if order == "SAS":
            raise PgtsError("P is a list of matrices, one for each action: that is the order 'ASS', not 'SAS'")
        table, order = _from_sparse(P), "ASS"
    else:
        P = np.asarray(P, dtype=np.float64)
        for name, array in (("P_SAS", P), ("R_SA", R)):
            _check_order_is_clear(name, array, order)
        P, order = _state_first(P, order)
        table = _from_dense(P)
    table = table._replace(prob_SAK=normalised(table.prob_SAK))
    reward_SA, reward_SAK = _rewards(R, table, order)
    prob, child = torch.from_numpy(table.prob_SAK), torch.from_numpy(table.child_SAK)
    discount = torch.tensor(float(gamma), dtype=torch.float64).expand(prob.shape)
    outcomes = Outcomes(torch.from_numpy(reward_SA), prob, discount, child, len(prob))
    return outcomes, None if reward_SAK is None else torch.from_numpy(reward_SAK)


def _is_sparse_list(P: Any) -> bool:
    """Whether this is a sequence in which matrices are scipy's."""
    return isinstance(P, Sequence | np.ndarray) and len(P) > 0 and any(scipy.sparse.issparse(part) for part in P)


def _stacked(P: Any, order: Order | None) -> tuple[list[Any], Order]:
    """The matrix of each action, of one matrix of all pairs."""
    rows, S = P.shape
    if S == 0 or rows == 0 or rows % S:
        raise PgtsError(f"P has shape {P.shape}; a single sparse matrix must be [S A, S]")
    A = rows // S
    if order is None and min(S, A) > 1:
        raise PgtsError(
            f"P is one matrix of shape {P.shape}: give order='SAS' if row s * {A} + a is the distribution of (s, a), "
            f"order='ASS' if row a * {S} + s is"
        )
    P = scipy.sparse.csr_array(P)
    return [P[a::A] if order == "SAS" else P[a * S : (a + 1) * S] for a in range(A)], "ASS"


def _state_first(P: np.ndarray, order: Order | None) -> tuple[np.ndarray, Order]:
    """P[s, a, s'], and the order that it was in."""
    states_of: dict[Order, int] = {"SAS": 0, "ASS": 1}
    full = P.ndim == 3 and 0 not in P.shape
    fits = [known for known, axis in states_of.items() if full and P.shape[axis] == P.shape[2]]
    if not fits or order not in (None, *fits):
        wanted = {"SAS": "[S, A, S]", "ASS": "[A, S, S]", None: "[S, A, S]"}[order]
        raise PgtsError(f"P_SAS has shape {P.shape}; it must be {wanted} with at least one state and one action")
    found = order or fits[0]
    return (P if found == "SAS" else P.swapaxes(0, 1)), found


def _check_order_is_clear(name: str, array: Any, order: Order | None) -> None:
    """PgtsError if no order is given and the shape of the array leaves it open: as many states as actions."""
    shape = np.shape(array) if order is None and not _is_sparse_list(array) else ()
    if len(shape) == 3 and len(set(shape)) == 1 and not np.array_equal(array, np.swapaxes(array, 0, 1), equal_nan=True):
        raise PgtsError(
            f"{name} has shape {shape}, which does not tell states from actions: give order='SAS' if P[s, a] is the "
            "distribution of state s and action a, order='ASS' if P[a, s] is"
        )


def _from_dense(P: Float[np.ndarray, "S A S"]) -> _Table:
    off = (P < 0) | ~np.isfinite(P)
    if off.any():
        s, a, t = np.argwhere(off)[0]
        raise PgtsError(f"P_SAS[{s}, {a}, {t}] is {P[s, a, t]}; probabilities are finite and at least 0")
    K = max(1, int((P > 0).sum(-1).max()))
    child = np.argsort(P == 0, axis=-1, kind="stable")[..., :K]  # the successors first, in their order
    return _Table(np.take_along_axis(P, child, axis=-1), child)


def _from_sparse(matrices: Sequence[Any]) -> _Table:
    S = matrices[0].shape[0]
    rows = [_csr(f"P[{a}]", matrix, S) for a, matrix in enumerate(matrices)]
    for a, matrix in enumerate(rows):
        off = np.flatnonzero((matrix.data < 0) | ~np.isfinite(matrix.data))
        if len(off):
            s = int(np.searchsorted(matrix.indptr, off[0], side="right")) - 1
            t, p = matrix.indices[off[0]], matrix.data[off[0]]
            raise PgtsError(f"P_SAS[{s}, {a}, {t}] is {p}; probabilities are finite and at least 0")
        matrix.eliminate_zeros()
    count_AS = np.array([np.diff(matrix.indptr) for matrix in rows])
    A, K = len(rows), max(1, int(count_AS.max()))
    if S * A * K > _MOST_ENTRIES:
        widest = np.unravel_index(count_AS.argmax(), count_AS.shape)
        raise PgtsError(
            f"action {widest[0]} has {K} successors in state {widest[1]}; a table of so many for each of {S * A} pairs "
            "is too large"
        )
    prob = np.zeros((S, A, K))
    child = np.broadcast_to(np.arange(S)[:, None, None], prob.shape).copy()
    for a, matrix in enumerate(rows):
        # The state of each stored entry, and its place k among the entries of this state.
        state = np.repeat(np.arange(S), count_AS[a])
        k = np.arange(matrix.nnz) - matrix.indptr[state]
        prob[state, a, k], child[state, a, k] = matrix.data, matrix.indices
    return _Table(prob, child)


def _csr(name: str, matrix: Any, num_states: int) -> Any:
    """A copy with sorted rows, in float64."""
    if np.shape(matrix) != (num_states, num_states) or num_states == 0:
        raise PgtsError(f"{name} has shape {np.shape(matrix)}; P must hold one matrix [S, S] for each action")
    copy = scipy.sparse.csr_array(matrix, dtype=np.float64, copy=True)
    copy.sum_duplicates()
    return copy


def _rewards(R: Any, table: _Table, order: Order) -> tuple[Float[np.ndarray, "S A"], Float[np.ndarray, "S A K"] | None]:
    """Expected rewards; and those of outcomes, where they differ."""
    S, A, _ = table.prob_SAK.shape
    if _is_sparse_list(R):
        if order != "ASS" or len(R) != A:
            raise PgtsError(f"R is a list of {len(R)} matrices; that needs P in the order 'ASS' with {len(R)} actions")
        states = np.arange(S)[:, None]
        rows = [_csr(f"R[{a}]", matrix, S)[states, table.child_SAK[:, a]] for a, matrix in enumerate(R)]
        return _expected(np.stack([row.toarray() for row in rows], axis=1), table)
    R = np.asarray(R, dtype=np.float64)
    if R.shape == (S, A):
        return R.copy(), None
    if R.shape == (S,):
        return np.repeat(R[:, None], A, axis=1), None
    if R.shape == ((S, A, S) if order == "SAS" else (A, S, S)):
        by_state = R if order == "SAS" else R.swapaxes(0, 1)
        return _expected(np.take_along_axis(by_state, table.child_SAK, axis=-1), table)
    raise PgtsError(
        f"R_SA has shape {R.shape}; P_SAS needs {(S, A)}, or {(S,)} where the action does not matter, or one reward "
        "for each entry of P"
    )


def _expected(
    reward_SAK: Float[np.ndarray, "S A K"], table: _Table
) -> tuple[Float[np.ndarray, "S A"], Float[np.ndarray, "S A K"] | None]:
    """The means over outcomes, and the rewards themselves where outcomes differ in them."""
    possible = table.prob_SAK > 0
    first = np.take_along_axis(reward_SAK, possible.argmax(-1)[..., None], axis=-1)
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused by the MDP
        # Counted from the first reward, so that equal rewards have exactly this mean.
        above = np.where(possible, table.prob_SAK * (reward_SAK - first), 0.0).sum(-1, keepdims=True)
        reward_SAK = np.where(possible, reward_SAK, first + above)
    differ = (possible & (reward_SAK != first)).any()
    return (first + above)[..., 0], reward_SAK if differ else None
