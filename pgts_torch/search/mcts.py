"""Monte-Carlo tree search below many roots at once: where full width is too much, trees grow where values are high."""

import functools
from typing import Any, Literal

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.compiled import can_compile
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import EnumeratingModel, Model
from pgts_torch.options.search import MAX_NODES, MCTS
from pgts_torch.search.fixed_trees import FixedTrees
from pgts_torch.search.forest import Forest
from pgts_torch.search.halving import divide, preference
from pgts_torch.search.known import KnownStates, prior_of_allowed
from pgts_torch.search.lookahead import Leaf, Leaves, Lookahead, check_roots, unexpanded
from pgts_torch.search.memory import check_memory, check_nodes, tree_nodes
from pgts_torch.search.split import Rule
from pgts_torch.search.topology import Topology, topology_of
from pgts_torch.search.tree import Tree
from pgts_torch.search.widening import WideningTrees, drawn_actions

_KEPT = 2**20
"""The most bytes that compiled trees keep between searches: those that take more have no need of it."""


def mcts(
    model: EnumeratingModel,
    root_B: Int[Tensor, "B"],
    *,
    depth: int,
    q_leaf: Leaf | None = None,
    v_leaf: Leaf | None = None,
    simulations: int,
    root: Literal["gumbel", "rule"] = "gumbel",
    rule: Rule = "gumbel",
    exploration: float | None = None,
    wave: int | None = None,
    prior: Leaf | None = None,
    backup: Literal["max", "mean"] = "max",
    merge: bool = False,
    widening: float | None = None,
    widening_power: float | None = None,
    topology: Topology | None = None,
    generator: torch.Generator | None = None,
    max_nodes: int = MAX_NODES,
) -> Lookahead:
    """(T^m Q)(s, .) at the roots for m = depth, approached by so many simulations.

    A simulation descends from a root by the tree rule, expands one node and backs up its value. All actions of an
    expanded node are evaluated at once, with the critic at all their outcomes:

        q(n, a) = r + sum_k p_k gamma_k v(n_k),   v(n) = max_a q(n, a) where n is expanded, else the critic's

    An action with the reward -inf is not allowed: its q is -inf, and it gets neither prior nor simulations. Outcomes
    are not sampled but visited in proportion to their probabilities: a simulation takes argmax_k p_k (N_a + 1) - N_k. A
    node below which everything is expanded is exhausted and never selected again, so after finitely many simulations
    the answer is T^m Q.

    On the CPU simulations come one after another, in compiled loops (`search.forest`). On other devices, or without
    numba, they come in waves (`search.tree`): the simulations of a wave are split among actions and outcomes as if they
    came one by one, but do not know each other's values. Waves of 1 are the search of the CPU; where the model keeps a
    table of all states, in arrays of fixed shape (`search.fixed_trees`).

    With root="gumbel" the root's actions get simulations by sequential halving of g(a) + log prior(a) + sigma(q(a))
    (Danihelka et al. 2022). With merge=False the answer is the same bit for bit however the roots are split into
    batches or ordered. With merge=True the roots search one graph, in the order of their states: in each round every
    root sends one simulation after another by each of its actions that are due, the best first.

    Args:
        model, root_B, depth, q_leaf, v_leaf: as in `expectimax`.
        simulations, root, rule, exploration, wave, backup, widening, widening_power, max_nodes: see `options.MCTS`. The
            first simulation expands the root.
        prior: the policy, states [N] to probabilities [N, A]; what it gives to actions that are not allowed is shared
            out among the others. Default: uniform.
        backup: with "mean" q(n, a) = (q_0 + sum_i G_i) / (1 + N_a) over the critic's first estimate q_0 and the returns
            G_i of simulations, which does not converge to T^m Q; `pruned_BA` is inf.
        merge: a node is a (level, state), shared by all paths and roots.
        topology: as in `expectimax`. Its `max_bytes` is the most memory that the search may take.
        generator: of the Gumbel noise, one number a search. Default: no noise.

    Raises:
        PgtsError: an option that makes no sense or is ignored by the others, roots that are no states, leaf values of a
            wrong shape or not finite (naming the state), a prior that is no distribution over the allowed actions.
        NodeBudgetExceeded: more than `max_nodes`, or more memory than `max_bytes`, would be needed.
    """
    options = _options(
        simulations=simulations,
        root=root,
        rule=rule,
        exploration=exploration,
        wave=wave,
        prior="uniform" if prior is None else "policy",
        backup=backup,
        merge=merge,
        widening=widening,
        widening_power=widening_power,
        max_nodes=max_nodes,
    )
    if widening is not None:
        drawn_actions(model, options)
    if root == "rule" and generator is not None:
        raise PgtsError("only root='gumbel' uses a generator")
    return search_tree(
        Leaves(model, depth, q_leaf, v_leaf, prior), topology_of(model, topology), root_B, options, generator
    )


# From one root a search takes hardly longer than the checks of its options.
_known_options = functools.lru_cache(maxsize=64, typed=True)(MCTS)


def _options(**given: Any) -> MCTS:
    try:
        return _known_options(**given)
    except TypeError:  # something that has no hash, and so is no option: MCTS says which
        return MCTS(**given)


def search_tree(
    leaves: Leaves, topology: Topology, root_B: Int[Tensor, "B"], options: MCTS, generator: torch.Generator | None
) -> Lookahead:
    """`mcts`, with leaves and topology at hand."""
    with torch.set_grad_enabled(False):  # half of what `no_grad` costs, which small searches notice
        compiled = options.widening is None and _can_compile(topology.model, options)
        if not compiled or root_B.shape != (1,) or root_B.dtype != torch.int64 or leaves.expansions == 0:
            check_roots(root_B, topology.model.num_states)  # compiled loops look at a single root themselves
        if leaves.expansions == 0:
            return unexpanded(leaves, root_B)
        topology.table.meter = leaves.meter
        # A root alone needs no sorting, which takes as long as many of its simulations.
        state_B, row_B = (root_B, None) if root_B.shape[0] == 1 else root_B.unique(return_inverse=True)
        calls_before = topology.table.model_calls
        grow = _grow_compiled
        if not compiled:
            grow = _grow_fixed if _fits_arrays(topology.model, len(state_B), options) else _grow
            grow = grow if options.widening is None else _grow_widening
        q_NA, pruned_NA, nodes_per_level = grow(leaves, topology, state_B, options, generator)
        return Lookahead.enumerated(
            q_NA if row_B is None else q_NA[row_B],
            pruned_BA=pruned_NA if row_B is None else pruned_NA[row_B],
            model_calls=topology.table.model_calls - calls_before,
            critic_calls=leaves.calls,
            nodes_per_level=nodes_per_level,
        )


def _can_compile(model: Model, options: MCTS) -> bool:
    """Whether the search is one of one simulation after another, for which there are compiled loops."""
    return options.wave in (None, 1) and model.dtype in (torch.float32, torch.float64) and can_compile(model.device)


def _grow_compiled(
    leaves: Leaves, topology: Topology, state_B: Tensor, options: MCTS, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """q and pruned mass of the roots, and the nodes of each level."""
    kind = options, leaves.expansions, state_B.shape[0]
    # While it is in use, or when it has failed, no other search has it.
    forest, topology.forest = topology.forest, None
    if not isinstance(forest, Forest) or not forest.serves(*kind, topology.model.num_states):
        forest = Forest(topology, *kind)
    q_BA, pruned_BA, nodes_per_level = forest.search(leaves, state_B, generator)
    if forest.num_bytes <= _KEPT:
        topology.forest = forest
    if topology.model.dtype != torch.float64:
        q_BA, pruned_BA = q_BA.to(topology.model.dtype), pruned_BA.to(topology.model.dtype)
    return q_BA, pruned_BA, nodes_per_level


def _fits_arrays(model: EnumeratingModel, roots: int, options: MCTS) -> bool:
    """Whether the search is one for which there are trees of fixed shape, and its table no larger than they may be: the
    critic values all its states."""
    if model.table is None or options.wave != 1 or options.backup != "max" or options.merges:
        return False
    return model.num_states <= roots * options.simulations * model.num_actions * model.table.num_outcomes


def _grow_fixed(
    leaves: Leaves, topology: Topology, state_B: Tensor, options: MCTS, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """The same by torch, one simulation after another, from the values of all states."""
    model, bottom, B = topology.model, leaves.expansions, len(state_B)
    table, S, A = model.table, model.num_states, model.num_actions
    assert table is not None
    num_nodes = int(min(options.simulations, tree_nodes(1, A * table.num_outcomes, bottom - 1)))
    needed = topology.bytes(0, fixed=2 * S + B * (num_nodes + 2 * A) + 1, places=2 * bottom)
    check_memory(needed, topology.max_bytes, f"the search ({B * num_nodes} nodes, {S} states of {A} actions)")
    state_S = torch.arange(S, device=model.device)
    prior_SA = prior_of_allowed(leaves.prior(state_S), table.reward_NA, state_S)
    legal = (table.reward_NA > -torch.inf).sum(1).unique().tolist()
    shape = {"num_roots": B, "num_nodes": num_nodes, "legal": legal}
    trees = FixedTrees(table, leaves.v(state_S), prior_SA, bottom, options, **shape)
    values = trees.search(state_B, preference(prior_SA[state_B].double(), state_B, generator))
    state_N, level_N = trees.expanded().unbind(1)
    topology.table.read(state_N.unique())
    valued_L = torch.zeros(bottom + 1, dtype=torch.int64, device=model.device)
    valued_L[0] = B
    nodes_per_level = tuple(valued_L.index_add_(0, level_N + 1, trees.outcomes_S[state_N]).tolist())
    check_nodes(sum(nodes_per_level), options.max_nodes)
    q_BA, pruned_BA = (value_BA.to(model.dtype) for value_BA in values)
    return q_BA, pruned_BA, nodes_per_level


def _grow(
    leaves: Leaves, topology: Topology, state_B: Tensor, options: MCTS, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """The same by torch, in waves."""
    # A level is tens of small operations, each a fifth cheaper without the bookkeeping of autograd.
    with torch.inference_mode():
        known = KnownStates(topology, leaves)
        known.rows(state_B)  # before the tree is made, so that its tables have room for K outcomes at once
        tree = Tree(known, leaves.expansions, options, room=len(state_B) * options.simulations)
        node_B = tree.nodes.add_roots(state_B)
        divide(tree, node_B, options, known.prior_TA[known.rows(state_B)], state_B, generator)
        pruned_NA = tree.backup_all(node_B)
        return tree.nodes.q_NA[node_B], pruned_NA, tree.nodes.nodes_per_level()


def _grow_widening(
    leaves: Leaves, topology: Topology, state_B: Tensor, options: MCTS, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """The same over drawn actions, of which nodes get more as they are visited; one simulation after another."""
    model, alone = drawn_actions(topology.model, options), options.model_copy(update={"wave": 1})
    bounds = {"num_roots": len(state_B), "max_bytes": topology.max_bytes}
    trees = WideningTrees(model, leaves, leaves.expansions, options, **bounds)
    node_B = trees.add_roots(state_B)
    divide(trees, node_B, alone, leaves.prior(state_B).double(), state_B, generator)
    topology.table.model_calls += trees.model_calls
    q_BA, pruned_BA = (value_BA.to(model.dtype) for value_BA in (trees.q_NA[node_B], trees.pruned(node_B)))
    return q_BA, pruned_BA, tuple(trees.nodes_per_level)
