"""Algorithm 1 with exact quantities for many settings at once.

`tabular.ascent` says what is computed; here depths, step sizes and policies of one MDP share each solve, which
makes whole maps of settings affordable. A test holds the two to each other.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.tabular.ascent import projected_step
from pgts_torch.tabular.mdp import TabularMDP

CERTAIN = 1e-9
"""A computed occupancy above this is no rounding error."""

Step = Callable[[Tensor, Tensor, Tensor, float], Tensor]


@dataclass(frozen=True, eq=False)
class Cells:
    """B settings of Algorithm 1 on one MDP: depth_B is m, step_B is eta, pi_BSA are the policies as they are."""

    depth_B: Int[Tensor, "B"]
    step_B: Float[Tensor, "B"]
    pi_BSA: Float[Tensor, "B S A"]

    def rows(self, row_N: Tensor) -> Self:
        """Some of the settings, by number or by mask."""
        return type(self)(self.depth_B[row_N], self.step_B[row_N], self.pi_BSA[row_N])


@dataclass(frozen=True, eq=False)
class Iterate:
    """The policies pi_k of B settings, their returns J, and their occupancies d."""

    pi_BSA: Float[Tensor, "B S A"]
    J_B: Float[Tensor, "B"]
    d_BS: Float[Tensor, "B S"]


class Batch:
    """One MDP with its start distribution, ready to move many policies together.

    Args:
        mdp: an MDP of moderate size: its transitions are held as a dense table.
        step: how a policy moves, as in `ascent.ascend`.
    """

    def __init__(self, mdp: TabularMDP, *, step: Step = projected_step) -> None:
        S, A = mdp.num_states, mdp.num_actions
        self._weight_XS = mdp.outcomes.weight.to_dense()
        self._weight_SAS = self._weight_XS.view(S, A, S)
        self._reward_SA = mdp.outcomes.reward_NA
        self._start_S = mdp.start_S
        self._step = step

    def advance(self, cells: Cells) -> tuple[Iterate, Cells]:
        """What the policies are worth, and the cells after one update."""
        S = len(self._reward_SA)
        M_BSS = torch.einsum("bsa,sat->bst", cells.pi_BSA, self._weight_SAS)
        # One factorisation of I - gamma P^pi for each setting serves two solves: v = (I - gamma P^pi)^-1 r^pi here, and
        # below, with its transpose, d = mu^T (I - gamma P^pi)^-1.
        factors, pivots = torch.linalg.lu_factor(torch.eye(S, dtype=torch.float64) - M_BSS)
        reward_BS = (cells.pi_BSA * self._reward_SA).sum(-1)
        v_BS = torch.linalg.lu_solve(factors, pivots, reward_BS[..., None]).squeeze(-1)
        start_BS = self._start_S.expand(v_BS.shape)
        d_BS = torch.linalg.lu_solve(factors, pivots, start_BS[..., None], adjoint=True).squeeze(-1)
        # Rounding may leave a visited state with 0 or less, and one that is not visited with more.
        visited_BS = _reached((start_BS > 0) | (d_BS > CERTAIN), M_BSS)
        d_BS = torch.where(visited_BS, d_BS.clamp(min=torch.finfo(torch.float64).tiny), 0.0)
        iterate = Iterate(cells.pi_BSA, v_BS @ self._start_S, d_BS)
        moved_BSA = self._moved(cells, self._lookahead(cells.depth_B, v_BS), d_BS)
        return iterate, replace(cells, pi_BSA=torch.where(visited_BS[..., None], moved_BSA, cells.pi_BSA))

    def _lookahead(self, depth_B: Tensor, v_BS: Tensor) -> Tensor:
        """T^m Q^pi, with an m for each setting."""
        q_BSA = self._backup(v_BS)
        for level in range(1, int(depth_B.max()) + 1):
            # Settings of a smaller depth are done: only the deeper ones are backed up once more.
            deeper_N = torch.nonzero(depth_B >= level).flatten()
            q_BSA[deeper_N] = self._backup(q_BSA[deeper_N].amax(-1))
        return q_BSA

    def _backup(self, v_BS: Tensor) -> Tensor:
        return (v_BS @ self._weight_XS.T).view(-1, *self._reward_SA.shape) + self._reward_SA

    def _moved(self, cells: Cells, look_BSA: Tensor, d_BS: Tensor) -> Tensor:
        # Every update takes the step size only as a factor of the weights, so each setting can have its own; the states
        # of all settings stand in one batch of N = B * S rows.
        weight_BS = cells.step_B[:, None] * d_BS
        A = look_BSA.shape[-1]
        moved_NA = self._step(cells.pi_BSA.reshape(-1, A), look_BSA.reshape(-1, A), weight_BS.reshape(-1), 1.0)
        return moved_NA.view(look_BSA.shape)


def _reached(reached_BS: Tensor, M_BSS: Tensor) -> Tensor:
    """What follows the given states: the support of d^pi by reachability, as rounding must not make a state visited."""
    while True:
        grown_BS = reached_BS | (torch.bmm(reached_BS.double()[:, None], M_BSS).squeeze(1) > 0)
        if torch.equal(grown_BS, reached_BS):
            return reached_BS
        reached_BS = grown_BS
