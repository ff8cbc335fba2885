"""The outcomes of states and actions, and the one Bellman backup that exact solvers and searches share.

A tabular MDP is a table of outcomes for all its states, a level of a lookahead one for its frontier. Both are backed up
by `backup`, so exact values and searches cannot differ in what they compute. On the CPU `bellman_kernels` does it.
"""

import functools
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.compiled import can_compile

_INT32_LIMIT = 2**31

_LARGE = 2**20
"""From so many outcomes on torch divides a product among its threads; compiled loops take one."""

COMPILED_FROM = 256
"""From so many outcomes on, backups are compiled where they can be; for fewer if the loops are loaded already."""

_KERNELS = "pgts_torch.bellman_kernels"

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, int, int]
"""Rewards, weights and children, flat; numbers of actions and of outcomes."""


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What may follow each of N states under each of A actions: at most K weighted children.

    A terminal outcome has discount 0, so nothing after it counts: there is no `done` flag and no separate gamma. Where
    (s, a) has fewer than K outcomes the others are padding, with probability 0.

    Args:
        reward_NA: expected immediate reward r(s, a), in reward units; -inf where the action is not allowed.
        prob_NAK: probability p_k of each outcome; every (s, a) sums to 1.
        discount_NAK: gamma_k in [0, 1] of each outcome. An expanded (stride 0) tensor costs no memory.
        child_NAK: index of each child, the next state, in the vector of values that `backup` takes.
        num_children: the length of that vector.
    """

    reward_NA: Float[Tensor, "N A"]
    prob_NAK: Float[Tensor, "N A K"]
    discount_NAK: Float[Tensor, "N A K"]
    child_NAK: Int[Tensor, "N A K"]
    num_children: int

    @classmethod
    def of_rows(cls, reward_NA: Float[Tensor, "N A"], weight: Tensor, child: Tensor, K: int, num_children: int) -> Self:
        """Outcomes with the given sparse `weight`, in the same memory: p gamma stands for p, and 1 for gamma.

        Args:
            weight, child: N A K numbers, flat.
        """
        shape, one = (*reward_NA.shape, K), weight.new_ones(())
        outcomes = cls(reward_NA, weight.view(shape), one.expand(shape), child.view(shape), num_children)
        vars(outcomes)["weight"] = _rows(weight, child, K, num_children)
        return outcomes

    @property
    def num_states(self) -> int:
        return self.reward_NA.shape[0]

    @property
    def num_actions(self) -> int:
        return self.reward_NA.shape[1]

    @property
    def num_outcomes(self) -> int:
        """K, the most outcomes that one (s, a) has."""
        return self.child_NAK.shape[2]

    @property
    def dtype(self) -> torch.dtype:
        return self.reward_NA.dtype

    @property
    def device(self) -> torch.device:
        return self.reward_NA.device

    @cached_property
    def weight(self) -> Tensor:
        """Sparse CSR matrix of p_k gamma_k, shape [N * A, num_children]; its indices are int32 where they fit,
        which makes its product with a vector two to four times faster than int64 does."""
        # Row n A + a holds exactly the K outcomes of (n, a), padding and repeated children included: so the arrays are
        # those of this table, and nothing is sorted or added up.
        narrow = max(self.child_NAK.numel(), self.num_children) < _INT32_LIMIT
        child = self.child_NAK.reshape(-1).to(torch.int32 if narrow else torch.int64)
        return _rows((self.prob_NAK * self.discount_NAK).reshape(-1), child, self.num_outcomes, self.num_children)

    @property
    def is_compiled(self) -> bool:
        """Whether `backup` and `sweep` are compiled."""
        size, device = self._size_and_device
        if size >= _LARGE and torch.get_num_threads() > 1:
            return False
        # Both sum in one order, so that it may depend on what was done before.
        return size > 0 and (size >= COMPILED_FROM or _KERNELS in sys.modules) and can_compile(device)

    @cached_property
    def _size_and_device(self) -> tuple[int, torch.device]:
        """How many outcomes there are, none if no loop is compiled for their dtype."""
        return self.child_NAK.numel() * (self.dtype in (torch.float64, torch.float32)), self.device

    @cached_property
    def arrays(self) -> "Arrays":
        """What compiled backups take, in the same memory."""
        return _arrays(self.reward_NA, self.weight, self.num_outcomes)

    def taken(self, action_N: Int[Tensor, "N"]) -> tuple[Float[Tensor, "N"], Tensor]:
        """The rewards and the rows of `weight` of one action of each state."""
        N, A, K = self.child_NAK.shape
        row_N = torch.arange(0, N * A, A, device=self.device) + action_N
        columns = (self.weight.values(), self.weight.col_indices())
        values, child = (x.view(N * A, K).index_select(0, row_N).view(-1) for x in columns)
        return self.reward_NA.reshape(-1).index_select(0, row_N), _rows(values, child, K, self.num_children)

    @cached_property
    def legal_NA(self) -> Bool[Tensor, "N A"]:
        """Which actions are allowed."""
        return self.reward_NA > -torch.inf

    @property
    def finite_rewards(self) -> Float[Tensor, "R"]:
        """The rewards of actions that are allowed."""
        return self.reward_NA[self.legal_NA]

    def expected(self, v_C: Float[Tensor, "C"]) -> Float[Tensor, "N A"]:
        """sum_k p_k gamma_k v(s'_k)."""
        return _product(self.weight, self.num_outcomes, v_C).view(self.reward_NA.shape)

    def rows(self, row_N: Int[Tensor, "N"]) -> Self:
        """The outcomes of some of the states, in the given order."""
        prob_NAK, discount_NAK = self.prob_NAK[row_N], self.discount_NAK[row_N]
        return type(self)(self.reward_NA[row_N], prob_NAK, discount_NAK, self.child_NAK[row_N], self.num_children)

    def paying(self, reward_NA: Float[Tensor, "N A"]) -> Self:
        """The same outcomes with other rewards, and with the same `weight` in memory; an action that is not allowed
        stays so."""
        other = replace(self, reward_NA=torch.where(self.reward_NA > -torch.inf, reward_NA, -torch.inf))
        vars(other)["weight"] = self.weight
        return other

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """The same outcomes on another device or in another floating dtype."""
        prob_NAK, discount_NAK = self.prob_NAK.to(device, dtype), self.discount_NAK.to(device, dtype)
        reward_NA, child_NAK = self.reward_NA.to(device, dtype), self.child_NAK.to(device)
        return type(self)(reward_NA, prob_NAK, discount_NAK, child_NAK, self.num_children)


def policy_mean(pi_NA: Float[Tensor, "N A"], q_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N"]:
    """The mean of the action values under a policy:

        <pi(.|s), q(s, .)> = sum over a with pi(a|s) > 0 of pi(a|s) q(s, a)

    Actions of probability 0 are left out, because q is -inf where an action is not allowed, and 0 * -inf is NaN.
    """
    return torch.where(pi_NA > 0, pi_NA * q_NA, 0.0).sum(-1)


def backup(outcomes: Outcomes, v_C: Float[Tensor, "C"]) -> Float[Tensor, "N A"]:
    """Action values one step above the values `v` of the children.

        q(s, a) = r(s, a) + sum_k p_k gamma_k v(s'_k)        [PGTS Sec. 2]

    Args:
        outcomes: what may follow each of N states under each action.
        v_C: one value for each of `outcomes.num_children` children, in reward units and in the dtype of `outcomes`.

    Returns:
        q, in the dtype of `outcomes`; it carries no gradient.
    """
    return back_up_steps(((outcomes, 1),), v_C)


def back_up_steps(
    steps: Sequence[tuple[Outcomes, int]], v_C: Float[Tensor, "C"], check: Callable[[], None] | None = None
) -> Float[Tensor, "N A"]:
    """`backup` of `sweep` of `sweep` of ...: in compiled loops without the calls of torch between them.

    Args:
        steps: outcomes, each with how many sweeps, of which the last of all is the backup.
        check: called before, unless the values are finite beyond doubt.
    """
    *lower, (top, times) = steps
    if top.is_compiled and all(outcomes.is_compiled for outcomes, _ in lower):
        kernels = _kernels()
        _check_values(steps[0][0], v_C)
        v = _array(v_C)
        if check is not None and not kernels.is_finite(v):
            check()
        for outcomes, sweeps in lower:
            v = kernels.back_up(*outcomes.arrays, v, sweeps, v[:0])
        arrays = top.arrays
        q_NA = np.empty((len(arrays[0]) // arrays[3], arrays[3]), arrays[0].dtype)
        kernels.back_up(*arrays, v, times, q_NA.reshape(-1))
        return torch.from_numpy(q_NA)
    if check is not None:
        check()
    for outcomes, sweeps in lower:
        v_C = sweep(outcomes, v_C, sweeps) if sweeps > 1 else backup(outcomes, v_C).amax(-1)
    if lower:
        return back_up_steps(((top, times),), v_C)
    _check_values(top, v_C)
    with torch.no_grad():
        v_C = sweep(top, v_C, times - 1) if times > 1 else v_C
        q = _product(top.weight, top.num_outcomes, v_C, top.reward_NA.reshape(-1))
        return q.view(top.reward_NA.shape)


def sweep(
    outcomes: Outcomes, v_S: Float[Tensor, "S"], times: int, action_S: Int[Tensor, "S"] | None = None
) -> Float[Tensor, "S"]:
    """The values after `times` sweeps of value iteration, for outcomes whose children are these same states.

        v(s) <- max_a q(s, a),   or  q(s, action(s)) where actions are given,   q = `backup` of v

    Compiled sweeps share two buffers.
    """
    _check_values(outcomes, v_S)
    with torch.no_grad():
        reward_NA, weight = outcomes.reward_NA, outcomes.weight
        if action_S is not None:
            reward_N, weight = outcomes.taken(action_S)
            reward_NA = reward_N.unsqueeze(1)
        if outcomes.is_compiled and times:
            arrays = outcomes.arrays if action_S is None else _arrays(reward_NA, weight, outcomes.num_outcomes)
            v = _array(v_S)
            return torch.from_numpy(_kernels().back_up(*arrays, v, times, v[:0]))
        v_S, reward = v_S if times else v_S.clone(), reward_NA.reshape(-1)
        for _ in range(times):
            v_S = _product(weight, outcomes.num_outcomes, v_S, reward).view(reward_NA.shape).amax(-1)
        return v_S


def _product(weight: Tensor, K: int, v_C: Float[Tensor, "C"], reward: Float[Tensor, "M"] | None = None) -> Tensor:
    """The rows of `weight` times v, plus the rewards."""
    values, child = weight.values(), weight.col_indices()
    # cuSPARSE takes no rows that have more entries than columns: repeated children are entries of their own.
    if K <= len(v_C) and not sums_in_order(v_C.device, len(values)):
        return torch.mv(weight, v_C) if reward is None else torch.addmv(reward, weight, v_C)
    term_MK = (values * v_C.index_select(0, child)).view(-1, K)
    # The order of `bellman_kernels.back_up`; a cumulative sum adds one after another.
    fours = K // 4 * 4
    parts = [term_MK[:, first:fours:2].cumsum(1)[:, -1] for first in range(2 if fours else 0)]
    parts += [term_MK[:, k] for k in range(fours, K)]
    total = sum(parts[1:], parts[0])
    return total if reward is None else total + reward


def sums_in_order(device: torch.device, size: int) -> bool:
    """Whether a product adds in the order of compiled loops where nothing is compiled: on the CPU, unless it is large.

    The order in which torch's sparse product adds depends on the processor, and on the number of rows, so that a search
    split into batches would be another one.
    """
    return device.type == "cpu" and size < _LARGE


def _rows(values: Tensor, child: Tensor, K: int, num_children: int) -> Tensor:
    """The sparse matrix whose rows have K entries each."""
    size = len(child) // K, num_children
    first = torch.arange(size[0] + 1, dtype=child.dtype, device=child.device) * K
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse (CSR tensor support|invariant checks)")
        return torch.sparse_csr_tensor(first, child, values, size=size, check_invariants=False)


def _check_values(outcomes: Outcomes, v_C: Float[Tensor, "C"]) -> None:
    # Compiled loops read v without looking at its length, and torch makes room of its own for what does not fit.
    if v_C.shape[0] != outcomes.num_children or v_C.dtype != outcomes.reward_NA.dtype:
        raise RuntimeError(
            f"v has size {len(v_C)} and dtype {v_C.dtype}; "
            f"the outcomes have {outcomes.num_children} children and dtype {outcomes.dtype}"
        )


def _arrays(reward_NA: Float[Tensor, "N A"], weight: Tensor, K: int) -> Arrays:
    child = weight.col_indices().numpy()
    child = child.view(np.uint32 if child.dtype == np.int32 else np.uint64)
    return reward_NA.detach().reshape(-1).numpy(), weight.values().numpy(), child, reward_NA.shape[1], K


@functools.cache
def _kernels() -> Any:
    from pgts_torch import bellman_kernels  # with which numba is imported

    return bellman_kernels


def _array(v_C: Float[Tensor, "C"]) -> np.ndarray:
    """Contiguous, because loops are compiled once for each kind of array."""
    return np.ascontiguousarray((v_C.detach() if v_C.requires_grad else v_C).numpy())
