"""Full-width lookahead that merges equal states: T^m Q at many roots, at a cost linear in m where states recur."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.models.base import EnumeratingModel, FallibleModel
from pgts_torch.options.search import MAX_NODES, Expectimax
from pgts_torch.readings import Readings
from pgts_torch.search.levels import Levels
from pgts_torch.search.lookahead import Leaf, Leaves, Lookahead, checked_errors
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
    leaf_error: float | Leaf | None = None,
    readings: Readings | None = None,
) -> Lookahead:
    """(T^m Q)(s, .) at the roots for m = depth.        [PGTS Sec. 3]

    With `q_leaf` = Q the roots are expanded m levels, and the leaves have the values max_a Q(s, a). With `v_leaf` = v
    they are expanded m + 1 levels, and the leaves have the values v: the lowest backup gives Q = r + gamma P v, and the
    m backups above it are T.

    Paths that meet in a state at the same level share one node, also across roots. Once a level has no new state, every
    state met so far leads to such states only (a closed set); the remaining levels are sweeps over it, without further
    queries. The result is exact, also in stochastic models.

    Args:
        root_B: states of the model, int64; repeated ones cost nothing extra.
        depth: m, a finite whole number of at least 0.
        q_leaf: an estimate of Q^pi: states [N] to [N, A].
        v_leaf: an estimate of v^pi: states [N] to [N]. Exactly one of the two is given.
        topology: what earlier searches of the same model found; this search adds to it. Default: a fresh one.
        max_nodes: the most nodes, summed over levels.
        max_width: W, the most states of each level below the roots that are expanded; the others get the critic's
            values, as leaves do (`pgts_torch.search.pruned`). None: all are expanded.
        leaf_error: a bound of the critic's error, against its policy's values in the environment: one number, or states
            to the shape of the critic's values; 0: it makes none. With it, and where the model is exact or says its own
            error (`FallibleModel`), the result has `doubt_BA`, at no further model call. None: it has none.
        readings: where the check of the leaf values waits, so that a search from the roots of an earlier one, in the
            same tensor, reads nothing back from a GPU. None: it is made at once.

    Raises:
        PgtsError: a bad depth or width, leaf_error with max_width, roots that are no states, leaf values of a wrong
            shape or not finite (naming the state), errors that are no bounds.
        NodeBudgetExceeded: more than `max_nodes` would be needed.
    """
    if max_width is not None or max_nodes is not MAX_NODES:  # checked, which takes longer than a small search
        Expectimax(max_width=max_width, max_nodes=max_nodes, doubt=leaf_error is not None)
    leaves = Leaves(model, depth, q_leaf, v_leaf, leaf_error=leaf_error, readings=readings)
    topology = topology_of(model, topology)
    return search_levels(leaves, topology, root_B, max_nodes=max_nodes, max_width=max_width)


def search_levels(
    leaves: Leaves, topology: Topology, root_B: Int[Tensor, "B"], *, max_nodes: int, max_width: int | None = None
) -> Lookahead:
    """`expectimax`, with leaves and topology at hand: expand the levels, call the critic at the bottom, back up."""
    topology.table.meter = leaves.meter
    with torch.set_grad_enabled(False):  # half of what `no_grad` costs, which small searches notice
        if max_width is not None:
            return pruned(leaves, topology, root_B, max_width=max_width, max_nodes=max_nodes)
        calls_before, expansions = topology.table.model_calls, leaves.expansions
        levels = topology.levels(root_B, expansions, max_nodes=max_nodes, readings=leaves.readings)
        plan = levels.plan(expansions)
        bottom = plan.bottom
        if expansions:
            v_N, values = leaves.unchecked(bottom)
            q_NA = levels.back_up(v_N, expansions, check=lambda: leaves.check(values, bottom))
        else:
            q_NA = leaves.q(bottom).clone()
        doubt_NA = None if leaves.leaf_error is None else _doubt(leaves, levels, topology.model, bottom)
        return Lookahead.enumerated(
            levels.of_roots(q_NA),
            model_calls=topology.table.model_calls - calls_before,
            critic_calls=leaves.calls,
            nodes_per_level=plan.nodes_per_level,
            doubt_BA=None if doubt_NA is None else levels.of_roots(doubt_NA),
        )


def _doubt(
    leaves: Leaves, levels: Levels, model: EnumeratingModel, bottom: Int[Tensor, "leaves"]
) -> Float[Tensor, "N A"] | None:
    """The bound E of the error of all actions in frontier 0, `Lookahead.doubt_BA`: values of an MDP that pays the
    errors of the model, with the errors of the critic at the bottom. 0 where an action is not allowed."""
    if _step_error(model, bottom[:1]) is None:
        return None
    error_N, expansions = leaves.errors(bottom), leaves.expansions
    if expansions == 0:
        return error_N.clone()
    error_N = error_N if error_N.ndim == 1 else error_N.amax(-1)
    doubt_NA = levels.back_up(error_N, expansions, reward=lambda state_N: _step_error(model, state_N))
    return doubt_NA.masked_fill(doubt_NA == -torch.inf, 0.0)


def _step_error(model: EnumeratingModel, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"] | None:
    """What the model says of its error, checked; 0 where it is exact, None where it does not say."""
    shape = len(state_N), model.num_actions
    if model.exact:
        return torch.zeros(shape, dtype=model.dtype, device=model.device)
    error_NA = model.step_error(state_N) if isinstance(model, FallibleModel) else None
    return None if error_NA is None else checked_errors(error_NA, shape, model, state_N, "the model's error")
