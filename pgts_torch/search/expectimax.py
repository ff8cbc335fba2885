"""Full-width lookahead in which equal states are one node: T^m Q at any number of states, at a cost linear in m."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import backup, sweep
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import EnumeratingModel
from pgts_torch.search.topology import Topology
from pgts_torch.tabular.exact import check_depth

Leaf = Callable[[Tensor], Tensor]
"""A critic as a search asks it: states [N] to values [N, A] (of Q^pi) or [N] (of v^pi)."""

MAX_NODES = 10_000_000


@dataclass(frozen=True, eq=False)
class Lookahead:
    """(T^m Q)(s, .) at the roots, and what it cost.

    q_BA: lookahead values of all actions, in the dtype of the model; they carry no gradient.
    model_calls: how many (state, action) the model was asked for in this search.
    critic_calls: how often the critic was asked, each time for all leaves together.
    nodes_per_level: how many states are backed up at each level, from the roots to the leaves: the distinct ones that
        paths lead to, and from the level on that brings no new state, all those met so far.
    """

    q_BA: Float[Tensor, "B A"]
    model_calls: int
    critic_calls: int
    nodes_per_level: tuple[int, ...]

    @property
    def nodes(self) -> int:
        """All nodes of all levels."""
        return sum(self.nodes_per_level)


@torch.no_grad()
def expectimax(
    model: EnumeratingModel,
    root_B: Int[Tensor, "B"],
    *,
    depth: int,
    q_leaf: Leaf | None = None,
    v_leaf: Leaf | None = None,
    topology: Topology | None = None,
    max_nodes: int = MAX_NODES,
) -> Lookahead:
    """(T^m Q)(s, .) at the roots for m = depth.        [PGTS Sec. 3]

    With `q_leaf` = Q the model is unfolded m levels and max_a Q(s, a) stands at the bottom. With `v_leaf` = v it is
    unfolded m + 1 levels with v at the bottom, which is T^m Q for Q = r + gamma P v: the lowest backup takes no maximum
    before it, the others do.

    Paths of one level that meet in a state are one node, also across roots, and once a level brings no new state the
    closed set is swept without asking the model again. In deterministic and in stochastic models the result is exact.

    Args:
        model: lists the outcomes of a state.
        root_B: states of the model, int64; repeated ones cost nothing.
        depth: m, a finite whole number of at least 0.
        q_leaf: an estimate of Q^pi: states [N] to [N, A].
        v_leaf: an estimate of v^pi: states [N] to [N]. Exactly one of the two is given.
        topology: what earlier searches of the same model found; this search adds to it. Default: a fresh one.
        max_nodes: the most nodes, summed over levels.

    Raises:
        PgtsError: a bad depth, roots that are no states, leaf values of a wrong shape or not finite (naming the state).
        NodeBudgetExceeded: more than `max_nodes` would be needed.
    """
    if (q_leaf is None) == (v_leaf is None):
        raise PgtsError("give exactly one of q_leaf and v_leaf")
    topology = topology or Topology(model)
    if topology.model is not model:
        raise PgtsError("the topology belongs to another model")
    calls_before = topology.model_calls
    expansions = check_depth(depth) + (v_leaf is not None)
    levels = topology.levels(root_B, expansions, max_nodes=max_nodes)
    leaves = levels.leaves(expansions)
    if q_leaf is not None:
        q_NA = _leaf_values(q_leaf, leaves, (len(leaves), model.num_actions), model.dtype)
        v_N = q_NA.amax(-1)
    else:
        assert v_leaf is not None
        v_N = _leaf_values(v_leaf, leaves, (len(leaves),), model.dtype)
    if sweeps := levels.sweeps(expansions):
        assert levels.closed is not None
        v_N = sweep(levels.closed, v_N, sweeps)
    for outcomes in reversed(levels.outcomes[:expansions]):
        q_NA = backup(outcomes, v_N)
        v_N = q_NA.amax(-1)
    q_BA = q_NA.index_select(0, levels.root_row_B)
    return Lookahead(q_BA, topology.model_calls - calls_before, 1, levels.nodes_per_level(expansions))


def _leaf_values(leaf: Leaf, states: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """What the critic says of the leaves; PgtsError if it says anything that is not one finite number for each."""
    values = leaf(states).to(dtype)
    if values.shape != shape:
        raise PgtsError(f"the critic answered with shape {tuple(values.shape)}; {len(states)} leaves ask for {shape}")
    if math.isfinite(values.sum()):  # one cheap call; only a sum that overflows makes it look closer in vain
        return values
    off = torch.nonzero(~torch.isfinite(values))
    if len(off):
        row = int(off[0, 0])
        raise PgtsError(f"the critic's value of state {int(states[row])} is {values[row].tolist()}; it must be finite")
    return values
