"""Full-width lookahead that merges equal states: T^m Q at many roots, at a cost linear in m where states recur."""

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.models.base import EnumeratingModel
from pgts_torch.options.search import MAX_NODES, Expectimax
from pgts_torch.search.lookahead import Leaf, Leaves, Lookahead
from pgts_torch.search.pruned import pruned
from pgts_torch.search.topology import Topology, topology_of


def expectimax(
    model: EnumeratingModel,
    root_B: Int[Tensor, "B"],
    *,
    depth: int,
    q_leaf: Leaf | None = None,
    v_leaf: Leaf | None = None,
    topology: Topology | None = None,
    max_nodes: int = MAX_NODES,
    max_width: int | None = None,
) -> Lookahead:
    """(T^m Q)(s, .) at the roots for m = depth.        [PGTS Sec. 3]

    With `q_leaf` = Q the roots are expanded m levels, and the leaves have the values max_a Q(s, a). With `v_leaf` = v
    they are expanded m + 1 levels, and the leaves have the values v: the lowest backup gives Q = r + gamma P v, and the
    m backups above it are T.

    Paths that meet in a state at the same level share one node, also across roots. Once a level has no new state, every
    state met so far leads to such states only (a closed set); the remaining levels are sweeps over it, without further
    queries. The result is exact, also in stochastic models.

    Args:
        model: enumerates the outcomes of a state.
        root_B: states of the model, int64; repeated ones cost nothing extra.
        depth: m, a finite whole number of at least 0.
        q_leaf: an estimate of Q^pi: states [N] to [N, A].
        v_leaf: an estimate of v^pi: states [N] to [N]. Exactly one of the two is given.
        topology: what earlier searches of the same model found; this search adds to it. Default: a fresh one.
        max_nodes: the most nodes, summed over levels.
        max_width: W, the most states of each level below the roots that are expanded; the others get the critic's
            values, as leaves do (`pgts_torch.search.pruned`). None: all are expanded.

    Raises:
        PgtsError: a bad depth or width, roots that are no states, leaf values of a wrong shape or not finite (naming
            the state).
        NodeBudgetExceeded: more than `max_nodes` would be needed.
    """
    options = Expectimax(max_width=max_width, max_nodes=max_nodes)
    leaves, topology = Leaves(model, depth, q_leaf, v_leaf), topology_of(model, topology)
    return search_levels(leaves, topology, root_B, max_nodes=options.max_nodes, max_width=options.max_width)


@torch.no_grad()
def search_levels(
    leaves: Leaves, topology: Topology, root_B: Int[Tensor, "B"], *, max_nodes: int, max_width: int | None = None
) -> Lookahead:
    """`expectimax`, with leaves and topology at hand: expand the levels, call the critic at the bottom, back up."""
    if max_width is not None:
        return pruned(leaves, topology, root_B, max_width=max_width, max_nodes=max_nodes)
    calls_before, expansions = topology.table.model_calls, leaves.expansions
    levels = topology.levels(root_B, expansions, max_nodes=max_nodes)
    bottom = levels.bottom(expansions)
    q_NA = levels.back_up(leaves.v(bottom), expansions) if expansions else leaves.q(bottom)
    return Lookahead.enumerated(
        q_NA.index_select(0, levels.root_row_B),
        model_calls=topology.table.model_calls - calls_before,
        critic_calls=leaves.calls,
        nodes_per_level=levels.nodes_per_level(expansions),
    )
