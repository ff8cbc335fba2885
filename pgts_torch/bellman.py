"""The outcomes of states and actions, and the one Bellman backup that exact solvers and searches share.

A tabular MDP is a table of outcomes for all its states. A level of a lookahead is a table of outcomes for its frontier.
Both are `Outcomes` and both are backed up by `backup`, so exact values and searches cannot differ in what they compute.
"""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import scipy.sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor

_INT32_LIMIT = 2**31

LARGE = 2**23
"""From so many outcomes on, `Outcomes.expected` uses scipy."""


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
        N, A, K = self.child_NAK.shape
        # Row n A + a holds exactly the K outcomes of (n, a), padding and repeated children included: so the arrays are
        # those of this table, and nothing is sorted or added up.
        index = torch.int32 if max(N * A * K, self.num_children) < _INT32_LIMIT else torch.int64
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
            return torch.sparse_csr_tensor(
                torch.arange(N * A + 1, dtype=index, device=self.device) * K,
                self.child_NAK.reshape(-1).to(index),
                (self.prob_NAK * self.discount_NAK).reshape(-1),
                size=(N * A, self.num_children),
                check_invariants=False,
            )

    @cached_property
    def _scipy_weight(self) -> scipy.sparse.csr_array:
        """`weight` as scipy sees it, in the same memory."""
        arrays = (self.weight.values(), self.weight.col_indices(), self.weight.crow_indices())
        return scipy.sparse.csr_array(
            tuple(array.numpy() for array in arrays), shape=(self.weight.shape[0], self.num_children), copy=False
        )

    def expected(self, v_C: Float[Tensor, "C"]) -> Float[Tensor, "N A"]:
        """sum_k p_k gamma_k v(s'_k)."""
        # Where memory is the limit scipy's product is up to a third faster than torch's; before that it is slower.
        if self.device.type == "cpu" and self.child_NAK.numel() >= LARGE:
            product = torch.from_numpy(self._scipy_weight @ v_C.numpy())
        else:
            product = torch.mv(self.weight, v_C)
        return product.view(self.reward_NA.shape)

    def rows(self, row_N: Int[Tensor, "N"]) -> Self:
        """The outcomes of some of the states, in the given order."""
        return type(self)(
            self.reward_NA[row_N],
            self.prob_NAK[row_N],
            self.discount_NAK[row_N],
            self.child_NAK[row_N],
            self.num_children,
        )

    def paying(self, reward_NA: Float[Tensor, "N A"]) -> Self:
        """The same outcomes with other rewards, and with the same `weight` in memory; an action that is not allowed
        stays so."""
        other = replace(self, reward_NA=torch.where(self.reward_NA > -torch.inf, reward_NA, -torch.inf))
        vars(other)["weight"] = self.weight
        return other

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """The same outcomes on another device or in another floating dtype."""
        return type(self)(
            self.reward_NA.to(device, dtype),
            self.prob_NAK.to(device, dtype),
            self.discount_NAK.to(device, dtype),
            self.child_NAK.to(device),
            self.num_children,
        )


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
    with torch.no_grad():
        # In place: a second table of N * A fresh numbers would cost as much as the product itself.
        return outcomes.expected(v_C.detach()).add_(outcomes.reward_NA)


def sweep(outcomes: Outcomes, v_S: Float[Tensor, "S"], times: int) -> Float[Tensor, "S"]:
    """The values after `times` sweeps of value iteration, for outcomes whose children are these same states.

        v(s) <- max_a q(s, a),   q = `backup` of v

    The sweeps share two buffers: that takes half the time of separate backups where states are few and the calls cost
    most, and no fresh memory where they are many.
    """
    with torch.no_grad():
        reward = outcomes.reward_NA.reshape(-1)
        q, v_S = torch.empty_like(reward), v_S.clone()
        q_NA = q.view(outcomes.reward_NA.shape)
        for _ in range(times):
            torch.addmv(reward, outcomes.weight, v_S, out=q)
            torch.amax(q_NA, -1, out=v_S)
        return v_S
