"""How the simulations of a root are divided among its actions: sequential halving, or the tree rule there too."""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.split import sigma
from pgts_torch.search.tree import Tree
from pgts_torch.search.widening import WideningTrees
from pgts_torch.seeding import mix, sample_keys, uniform

_WHOLE = 1e-6
"""In a graph shares of simulations add up to whole ones up to rounding."""


def divide(
    tree: Tree | WideningTrees,
    node_B: Int[Tensor, "B"],
    options: MCTS,
    prior_BA: Float[Tensor, "B A"],
    state_B: Int[Tensor, "B"],
    generator: torch.Generator | None,
) -> None:
    """Send all simulations of these roots, whose first one has expanded them."""
    if options.root == "rule":
        _by_rule(tree, node_B, options)
    else:
        _halve(tree, node_B, options, preference(prior_BA, state_B, generator))


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
    of_allowed = [rounds(allowed, simulations, options.wave) for allowed in range(1, tree.A + 1)]
    while True:
        if isinstance(tree, Tree):
            tree.back_up_shared(node_B)
        # Each root has the rounds of as many actions as are allowed there.
        of_count = [next(each) for each in of_allowed]
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


def rounds(actions: int, simulations: int, wave: int | None) -> Iterator[tuple[int, int]]:
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
    nodes = tree.nodes
    return ranked(preference_BA, nodes.q_NA[node_B], nodes.visits_NA[node_B], nodes.open(node_B), alive_BA)


def ranked(
    preference_BA: Float[Tensor, "B A"],
    q_BA: Float[Tensor, "B A"],
    visits_BA: Float[Tensor, "B A"],
    open_BA: Bool[Tensor, "B A"],
    alive_BA: Bool[Tensor, "B A"],
) -> Int[Tensor, "B A"]:
    """The actions of each root, best first: survivors before the others, exhausted ones last."""
    by_score_BA = (preference_BA + sigma(q_BA, visits_BA)).argsort(dim=1, descending=True, stable=True)
    rank_BA = torch.where(open_BA, (~alive_BA).long(), 2).gather(1, by_score_BA)
    return by_score_BA.gather(1, rank_BA.argsort(dim=1, stable=True))


def preference(
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
