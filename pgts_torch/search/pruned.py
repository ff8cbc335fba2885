"""Lookahead of bounded width: the states on which most depends are expanded, the critic values the others."""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup
from pgts_torch.search.lookahead import Leaves, Lookahead, check_roots, unexpanded
from pgts_torch.search.memory import check_nodes
from pgts_torch.search.outcome_table import has_weight
from pgts_torch.search.topology import Topology


def pruned(
    leaves: Leaves, topology: Topology, root_B: Int[Tensor, "B"], *, max_width: int, max_nodes: int
) -> Lookahead:
    """(T^m Q)(s, .) at the roots, where at most W states of each level below the roots are expanded.

    Of a level with more states those of the highest priority are expanded; the others have the critic's value v:

        priority(n) = reach(n) (v(n) - min v),     the minimum taken over the states of the level

    reach(n) is the discounted probability with which a plan that prefers better actions meets n: 1 at every root, and
    the sum of reach(s) pi(a|s) p gamma over all (s, a) of the level above that lead to n, where

        pi(a|s) ~ exp(-(max_b q1(s, b) - q1(s, a)) / t),     q1 = r + sum p gamma v,     t = mean of max_b q1 - q1

    over all pairs so far. So a state that several paths or roots share counts for each of them, and neither the zero
    nor the unit of rewards matters. Of equal priorities the higher reach comes first, then the lower state number.

    (Optimistic planning, Hren and Munos 2008, orders by reach(n) (U - v(n)) with an upper bound U of values: it may
    return to what it left, and this search does not. Beam search orders by v(n) alone, which ignores how likely n is.)

    W bounds a level of all roots together, and the roots are all expanded. With W at least as large as the largest
    level the result is that of the full lookahead. `pruned_BA` backs up 1 from a pruned state and 0 from the last
    level. The critic is called once for each level below the roots; the model is queried for at most (roots + W (levels
    - 1)) A pairs. Pruned nodes count as nodes.

    Args:
        max_width: W, at least 1.

    Raises:
        PgtsError, NodeBudgetExceeded: as `expectimax`.
    """
    check_roots(root_B, topology.model.num_states)
    roots, row_B = torch.unique(root_B, return_inverse=True)
    nodes_per_level, calls_before = [len(roots)], topology.table.model_calls
    _check_nodes(nodes_per_level, max_nodes)
    if leaves.expansions == 0:
        return unexpanded(leaves, root_B)
    levels, v_C = _expand(leaves, topology, roots, max_width, max_nodes, nodes_per_level)
    q_NA, pruned_NA = _back_up(levels, v_C)
    return Lookahead.enumerated(
        q_NA[row_B],
        pruned_BA=pruned_NA[row_B],
        model_calls=topology.table.model_calls - calls_before,
        critic_calls=leaves.calls,
        nodes_per_level=(*nodes_per_level, *[0] * (leaves.expansions + 1 - len(nodes_per_level))),
    )


@dataclass(frozen=True, eq=False)
class _Level:
    """The N distinct states of one level, of which M are expanded.

    v_N: the critic's values; those of the expanded states are replaced by what is backed up from below.
    kept_M: the positions of the expanded ones among the N.
    step: outcomes of the M, with positions in the next level as children.
    """

    v_N: Float[Tensor, "N"]
    kept_M: Int[Tensor, "M"]
    step: Outcomes


def _expand(
    leaves: Leaves, topology: Topology, roots: Tensor, max_width: int, max_nodes: int, nodes_per_level: list[int]
) -> tuple[list[_Level], Float[Tensor, "C"]]:
    """The levels from the roots down, and the critic's values below the last of them."""
    plan = _Plan(roots, topology.model.dtype)
    frontier, v_N = roots, torch.zeros_like(plan.reach_N)
    kept_M = _all(roots)
    levels: list[_Level] = []
    while len(levels) < leaves.expansions and len(kept_M):
        step, children = topology.step(frontier[kept_M], kept=sum(len(level.kept_M) for level in levels))
        levels.append(_Level(v_N, kept_M, step))
        nodes_per_level.append(len(children))
        _check_nodes(nodes_per_level, max_nodes)
        v_N = leaves.v(children) if len(children) else v_N[:0]
        frontier, kept_M = children, _all(children)
        if len(children) and len(levels) < leaves.expansions:
            plan.descend(levels[-1], v_N)
            if len(children) > max_width:
                kept_M = highest(plan.reach_N * (v_N / 2 - v_N.amin() / 2), plan.reach_N, max_width)
    return levels, v_N


def _back_up(levels: list[_Level], v_C: Float[Tensor, "C"]) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
    """q of all actions of the roots, and how much of it depends on pruned states."""
    pruned_C = torch.zeros_like(v_C)
    for level in reversed(levels):
        step = level.step
        if step.num_children == 0:  # every outcome is terminal
            q_MA, pruned_MA = step.reward_NA, torch.zeros_like(step.reward_NA)
        else:
            q_MA = backup(step, v_C)
            pruned_MA = torch.where(step.reward_NA > -torch.inf, step.expected(pruned_C), 0.0)
        # All of a pruned state's value is that of a pruned state; of an expanded one, as much as of its children.
        v_C = level.v_N.index_copy(0, level.kept_M, q_MA.amax(-1))
        pruned_C = torch.ones_like(v_C).index_copy_(0, level.kept_M, pruned_MA.amax(-1))
    return q_MA, pruned_MA


@final
class _Plan:
    """How much discounted probability each state of a level gets from a plan that prefers better actions.

    reach_N: that, for the level at hand; 1 for the roots.
    """

    def __init__(self, roots: Int[Tensor, "N"], dtype: torch.dtype) -> None:
        self.reach_N: Float[Tensor, "N"] = torch.ones(len(roots), dtype=dtype, device=roots.device)
        self._mean_regret, self._pairs = torch.zeros((), dtype=dtype, device=roots.device), 0

    def descend(self, level: _Level, v_C: Float[Tensor, "C"]) -> None:
        """From the reach of a level to that of the next one, whose states the critic values at v."""
        step = level.step
        # Halves, here and in the priority, so that the difference of the largest numbers is finite.
        half_MA = backup(step, v_C) / 2
        regret_MA = half_MA.amax(-1, keepdim=True) - half_MA
        self._average(regret_MA[regret_MA.isfinite()])
        scale = self._mean_regret.clamp(min=torch.finfo(regret_MA.dtype).tiny)
        # flow_MA: the reach of a state, shared out among its actions; each then goes to the children by p gamma.
        flow_MA = torch.softmax(-regret_MA / scale, -1) * self.reach_N[level.kept_M].unsqueeze(-1)
        weight_MAK = (step.prob_NAK * step.discount_NAK).masked_fill(~has_weight(step), 0.0)
        self.reach_N = torch.zeros_like(v_C).scatter_add_(
            0, step.child_NAK.flatten(), (flow_MA.unsqueeze(-1) * weight_MAK).flatten()
        )

    def _average(self, regret_P: Float[Tensor, "P"]) -> None:
        before, self._pairs = self._pairs, self._pairs + len(regret_P)
        self._mean_regret = self._mean_regret * (before / self._pairs) + (regret_P / self._pairs).sum()


def _all(state_N: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
    return torch.arange(len(state_N), device=state_N.device)


def highest(priority_N: Float[Tensor, "N"], reach_N: Float[Tensor, "N"], count: int) -> Int[Tensor, "M"]:
    """The positions of the highest priorities, ascending; of equal ones those of higher reach, then the first."""
    by_reach_N = reach_N.sort(descending=True, stable=True).indices
    order_N = by_reach_N[priority_N[by_reach_N].sort(descending=True, stable=True).indices]
    return order_N[:count].sort().values


def _check_nodes(nodes_per_level: list[int], max_nodes: int) -> None:
    check_nodes(sum(nodes_per_level), max_nodes, f" on levels 0 to {len(nodes_per_level) - 1}")
