"""Monte-Carlo tree search below many roots at once: where full width is too much, trees grow where values are high."""

import functools
import math
from collections.abc import Iterator
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.compiled import can_compile
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import EnumeratingModel, Model
from pgts_torch.models.drawn_actions import DrawnActions
from pgts_torch.options.search import MAX_NODES, MCTS
from pgts_torch.search.fixed_trees import FixedTrees
from pgts_torch.search.forest import Forest
from pgts_torch.search.known import KnownStates
from pgts_torch.search.lookahead import Leaf, Leaves, Lookahead, check_roots, unexpanded
from pgts_torch.search.memory import check_memory, check_nodes, tree_nodes
from pgts_torch.search.split import Rule, sigma
from pgts_torch.search.topology import Topology, topology_of
from pgts_torch.search.tree import Tree
from pgts_torch.search.widening import WideningTrees
from pgts_torch.seeding import mix, sample_keys, uniform

_KEPT = 2**20
"""The most bytes that compiled trees keep between searches: those that take more have no need of it."""

_WHOLE = 1e-6
"""In a graph shares of simulations add up to whole ones up to rounding."""


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

    A simulation descends from a root by the tree rule, expands one node and backs up its value. An expanded node has
    all its actions evaluated at once, with the critic at all their outcomes, so a maximum is never one over visited
    actions alone:

        q(n, a) = r + sum_k p_k gamma_k v(n_k),   v(n) = max_a q(n, a) where n is expanded, else the critic's

    An action with the reward -inf is not allowed: its q is -inf, nothing below it is queried, and it gets neither prior
    nor simulations. Of the outcomes of an action the one that most lacks simulations is taken,
    argmax_k p_k (N_a + 1) - N_k: outcomes are visited in proportion to their probabilities, not sampled. A node below
    which everything is expanded is exhausted and never selected again, so after finitely many simulations the answer is
    T^m Q.

    On the CPU simulations come one after another, in compiled loops (`pgts_torch.search.forest`), which stop at unknown
    states until the model and the critic have been called for those of all roots together. On other devices, or where
    numba is missing, they go down in waves (`pgts_torch.search.tree`): those of one wave are split among actions and
    outcomes as if they came one by one, but do not know each other's values. What a wave could not use is sent again.
    With waves of 1 both are the same search; without merging, where the model keeps a table of all states, it then is
    one of fixed shape (`pgts_torch.search.fixed_trees`), for which the critic values all states.

    With root="gumbel" the root's actions get simulations by sequential halving of g(a) + log prior(a) + sigma(q(a))
    (Danihelka et al. 2022). With merge=False the answer is the same bit for bit however the roots are split into
    batches or ordered. With merge=True the roots search one graph, in the order of their states: in each round every
    root sends one simulation after another by each of its actions that are due, the best first.

    Args:
        model, root_B, depth, q_leaf, v_leaf: as in `expectimax`.
        simulations: how many for each root, at least 1; the first one expands the root.
        root: sequential halving at the root, or the tree rule there too.
        rule, exploration: how actions are selected below the root, see `Selection`. Default of c: 1.25.
        wave: the most simulations of one action of a root (with root="rule": of the root) that are under way before
            values are backed up. 1 is the ordinary search, one simulation after another. Default: 1 in compiled loops,
            else a whole round of sequential halving (with root="rule": as many as before it together), which is
            several times faster there, and less right with as many simulations.
        prior: the policy, states [N] to probabilities [N, A]; what it gives to actions that are not allowed is shared
            out among the others. Default: uniform.
        backup: "max", or for comparison "mean": q(n, a) = (q_0 + sum_i G_i) / (1 + N_a) over the critic's first
            estimate q_0 and the returns G_i of simulations, which does not converge to T^m Q; its `pruned_BA` is inf.
        merge: a node is a (level, state), shared by all paths and roots. What a simulation could not update is
            backed up at the end.
        widening, widening_power: C and alpha of progressive widening, over drawn actions (`WideningTrees`). Default: a
            node has all its actions; alpha is 0.5.
        topology: as in `expectimax`. Its `max_bytes` is the most memory that the search may take.
        generator: of the Gumbel noise, one number a search. Default: no noise.
        max_nodes: the most nodes, summed over levels: those that the critic valued count too.

    Raises:
        PgtsError: an option that makes no sense or is ignored by the others, roots that are no states, leaf values of a
            wrong shape or not finite (naming the state), a prior that is no distribution, or gives all to actions that
            are not allowed; no action of a state is allowed.
        NodeBudgetExceeded: more than `max_nodes` would be needed; or what is to be expanded next would not fit into
            `max_bytes`, and the model has not been queried for it.
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
        return _search_tree(leaves, topology, root_B, options, generator)


def _search_tree(
    leaves: Leaves, topology: Topology, root_B: Int[Tensor, "B"], options: MCTS, generator: torch.Generator | None
) -> Lookahead:
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
    if not (model.table.reward_NA > -torch.inf).all():  # roots differ in how often their actions are halved
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
    prior_SA = leaves.prior(state_S)
    trees = FixedTrees(table, leaves.v(state_S), prior_SA, bottom, options, num_roots=B, num_nodes=num_nodes)
    values = trees.search(state_B, _preference(prior_SA[state_B].double(), state_B, generator))
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
        if options.root == "rule":
            _by_rule(tree, node_B, options)
        else:
            _halve(tree, node_B, options, _preference(known.prior_TA[known.rows(state_B)], state_B, generator))
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
    if options.root == "rule":
        _by_rule(trees, node_B, alone)
    else:
        _halve(trees, node_B, alone, _preference(leaves.prior(state_B).double(), state_B, generator))
    topology.table.model_calls += trees.model_calls
    q_BA, pruned_BA = (value_BA.to(model.dtype) for value_BA in (trees.q_NA[node_B], trees.pruned(node_B)))
    return q_BA, pruned_BA, tuple(trees.nodes_per_level)


def drawn_actions(model: Model, options: MCTS) -> DrawnActions:
    """The model, if its actions are drawn; else PgtsError."""
    if not isinstance(model, DrawnActions):
        raise PgtsError(
            f"search.widening is {options.widening}, which is for actions that are drawn (policy.type gaussian); those "
            f"of {type(model).__name__} are numbered"
        )
    return model


def _by_rule(tree: Tree | WideningTrees, node_B: Tensor, options: MCTS) -> None:
    """The tree rule at the root too. Without a given size a wave is as large as all waves before it together."""
    used_B = torch.zeros(len(node_B), dtype=torch.float64, device=node_B.device)
    place_A = torch.arange(tree.A, device=node_B.device)
    while True:
        if isinstance(tree, Tree):
            tree.back_up_shared(node_B)
        # at_B: the roots that have a whole simulation left and something to expand.
        open_B = tree.nodes.open(node_B).any(1)
        budget_B = (options.simulations - 1 - used_B + _WHOLE).floor_()
        at_B = ((budget_B >= 1) & open_B).nonzero().squeeze(1)
        if len(at_B) == 0:
            return
        most_B = (used_B[at_B] + _WHOLE).floor_().clamp_min_(1)
        if options.wave is not None:
            most_B.fill_(options.wave)
        share_BA = tree.split(node_B[at_B], budget_B[at_B].minimum(most_B))
        used_B[at_B] += _send(tree, node_B[at_B], share_BA, place_A.expand_as(share_BA), options.wave)


def _halve(tree: Tree | WideningTrees, node_B: Tensor, options: MCTS, preference_BA: Tensor) -> None:
    """Sequential halving of the root's actions (Karnin, Koren and Somekh 2013; Danihelka et al. 2022, Sec. 3.2).

    The simulations of an exhausted action go to the next best one, also after the last round.
    """
    simulations = options.simulations - 1  # the first one has expanded the root
    used_B = torch.zeros(len(node_B), dtype=torch.float64, device=node_B.device)
    alive_BA = torch.ones_like(preference_BA, dtype=torch.bool)
    place_A = torch.arange(tree.A, device=node_B.device)
    allowed_B = (tree.nodes.q_NA[node_B] > -torch.inf).sum(1)
    widths, width_B1 = list[int](), torch.zeros_like(allowed_B).unsqueeze(1)
    rounds = [_rounds(allowed, simulations, options.wave) for allowed in range(1, tree.A + 1)]
    while True:
        if isinstance(tree, Tree):
            tree.back_up_shared(node_B)
        # Each root has the rounds of as many actions as are allowed there.
        of_count = [next(each) for each in rounds]
        before_B1, (width_B1, most_B1) = (
            width_B1,
            torch.tensor(of_count, device=node_B.device)[allowed_B - 1].split(1, 1),
        )
        if widths != (widths := [width for width, _ in of_count]):
            # In a new round the best `width` actions of those that are left go on.
            order_BA = _order(tree, node_B, preference_BA, alive_BA)
            survives_BA = torch.zeros_like(alive_BA).scatter_(1, order_BA, place_A < width_B1)
            alive_BA = torch.where(width_B1 != before_B1, survives_BA, alive_BA)
        # total_B1: the simulations of this wave; the best `lanes_B1` actions share them evenly, the first get one more.
        lanes_B1 = tree.nodes.open(node_B).sum(1, keepdim=True).minimum(width_B1)
        left_B1 = (simulations - used_B + _WHOLE).floor_().unsqueeze(1)
        total_B1 = left_B1.minimum(lanes_B1 * most_B1)
        at_B = (total_B1.squeeze(1) >= 1).nonzero().squeeze(1)
        if len(at_B) == 0:
            return
        lanes_B1, total_B1 = lanes_B1[at_B], total_B1[at_B]
        share_B1 = (total_B1 / lanes_B1).floor_()
        share_BA = share_B1 + (place_A < total_B1 - share_B1 * lanes_B1)
        share_BA.masked_fill_(place_A >= lanes_B1, 0)
        order_BA = _order(tree, node_B[at_B], preference_BA[at_B], alive_BA[at_B])
        share_BA = torch.zeros_like(share_BA).scatter_(1, order_BA, share_BA)
        used_B[at_B] += _send(tree, node_B[at_B], share_BA, order_BA, options.wave)


def _send(
    tree: Tree | WideningTrees, node_B: Tensor, share_BA: Tensor, order_BA: Tensor, wave: int | None
) -> Float[Tensor, "B"]:
    """A wave of so many simulations below each action of these roots; how many of each root could be used.

    Below roots of one graph waves of 1 are sent one after another, root by root, in this order of actions.
    """
    if not (isinstance(tree, Tree) and tree.merge and wave == 1):
        return tree.wave(node_B, share_BA)
    used_B = torch.zeros_like(share_BA[:, 0])
    for b, a in ((b, a) for b, order in enumerate(order_BA.tolist()) for a in order if share_BA[b, a] > 0):
        # Others may have expanded all that was left below it.
        if tree.nodes.open(node_B[b : b + 1])[0, a]:
            alone_1A = torch.zeros_like(share_BA[b : b + 1]).index_fill_(1, order_BA.new_tensor([a]), 1)
            used_B[b : b + 1] += tree.wave(node_B[b : b + 1], alone_1A)
    return used_B


def _rounds(actions: int, simulations: int, wave: int | None) -> Iterator[tuple[int, int]]:
    """How many of the allowed actions of a root a wave considers, and the most simulations each of them gets.

    The last round takes what is left.
    """
    phases, width = max(1, math.ceil(math.log2(actions))), actions
    for _ in range(phases - 1):
        left = max(1, simulations // (phases * width))
        while left > 0:
            yield width, min(wave or left, left)
            left -= wave or left
        width = max(2, width // 2)
    while True:
        yield width, wave or simulations


def _order(tree: Tree | WideningTrees, node_B: Tensor, preference_BA: Tensor, alive_BA: Tensor) -> Int[Tensor, "B A"]:
    """The actions of each root, best first: survivors before the others, exhausted ones last."""
    score_BA = preference_BA + sigma(tree.nodes.q_NA[node_B], tree.nodes.visits_NA[node_B])
    by_score_BA = score_BA.argsort(dim=1, descending=True, stable=True)
    rank_BA = torch.where(tree.nodes.open(node_B), torch.where(alive_BA, 0, 1), 2).gather(1, by_score_BA)
    return by_score_BA.gather(1, rank_BA.argsort(dim=1, stable=True))


def _preference(
    prior_BA: Float[Tensor, "B A"], state_B: Tensor, generator: torch.Generator | None
) -> Float[Tensor, "B A"]:
    """log prior(a), plus standard Gumbel noise if there is a generator: a function of the search, the state and the
    action."""
    if generator is None:
        return prior_BA.log()
    key = sample_keys(1, generator=generator).to(state_B.device)
    action_A = torch.arange(prior_BA.shape[1], device=state_B.device)
    u_BA = uniform(mix(key, state_B.unsqueeze(1), action_A)).clamp_min(torch.finfo(torch.float64).tiny)
    return prior_BA.log() - (-u_BA.log()).log().to(prior_BA.dtype)
