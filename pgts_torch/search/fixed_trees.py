"""Trees in arrays of fixed shape, [roots, simulations], for models that keep a table of all states.

They are those of `tree_kernels`, one simulation after another below each root, in operations on tensors that are the
same whatever the numbers are: nothing is read back while they grow, so a CUDA graph can hold a whole search. All roots
go down side by side; a "lane" is an action of a root with a simulation under way. A lane that has nothing to do, or
less than others, works on a spare node, which belongs to no tree.
"""

import itertools
from collections.abc import Sequence
from typing import final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.options.search import MCTS
from pgts_torch.search.halving import ranked, rounds
from pgts_torch.search.outcome_table import has_weight
from pgts_torch.search.split import Selection, most_lacking

_Q, _VISITS, _OPEN, _PRIOR, _REWARD, _EDGES = range(6)
"""The columns of an arm, a (node, action): numbers of its own, and K each of its edges: values of children, weights
p gamma, probabilities (below 0 where nothing is left to expand), visits, and children, 0 where there is no node yet.
`_OPEN` counts the edges below which something is left to expand."""


@final
class FixedTrees:
    """The trees below B roots, in float64.

    arm_NAC: see `_Q`.
    place_N2: the state and the level of each node. The nodes of root b begin at b S, S the most of a tree.
    nodes_B: how many nodes the tree of each root has.

    Args:
        outcomes: those of all states.
        value_S, prior_SA: the critic's values and the policy, of all states.
        bottom: nodes at this level are never expanded.
        options: of a search with maxima, in trees that are not merged.
        num_roots, num_nodes: B and S.
        legal: how many actions are allowed in a state, all such counts; None: all are allowed in each.
    """

    def __init__(
        self,
        outcomes: Outcomes,
        value_S: Float[Tensor, "S"],
        prior_SA: Float[Tensor, "S A"],
        bottom: int,
        options: MCTS,
        *,
        num_roots: int,
        num_nodes: int,
        legal: Sequence[int] | None = None,
    ) -> None:
        self._bottom, self._options, self._child_SAK = bottom, options, outcomes.child_NAK
        self._selection = Selection(options.rule, 1.25 if options.exploration is None else options.exploration)
        self.A, self.K, device = outcomes.num_actions, outcomes.num_outcomes, outcomes.device
        # What a new node begins with, for each state.
        weighs_SAK = has_weight(outcomes)
        self.outcomes_S = weighs_SAK.sum((1, 2))
        weight_SAK = (outcomes.prob_NAK * outcomes.discount_NAK).double().masked_fill_(~weighs_SAK, 0)
        value_SAK = value_S.double()[outcomes.child_NAK].masked_fill_(~weighs_SAK, 0)
        reward_SA, none_SAK = outcomes.reward_NA.double(), torch.zeros_like(weight_SAK)
        q_SA = (weight_SAK * value_SAK).sum(2).add_(reward_SA)
        own = q_SA, torch.zeros_like(q_SA), weighs_SAK.sum(2).double(), prior_SA.double(), reward_SA
        prob_SAK = outcomes.prob_NAK.double().masked_fill(~weighs_SAK, -1)
        edges = value_SAK, weight_SAK, prob_SAK, none_SAK, none_SAK
        self._begun_SAC = torch.cat([torch.stack(own, 2), *edges], 2)
        self.arm_NAC = self._begun_SAC.new_zeros(num_roots * num_nodes + 1, *self._begun_SAC.shape[1:])
        self.place_N2 = torch.zeros(len(self.arm_NAC), 2, dtype=torch.int64, device=device)
        self.root_B = torch.arange(num_roots, device=device) * num_nodes
        self.nodes_B, self._spare = torch.ones_like(self.root_B), num_roots * num_nodes
        # How many actions have a simulation in each wave: by how many are allowed at the root, and all that occur.
        widths_A = [self._widths(count) for count in range(1, self.A + 1)]
        self._width_TA = torch.tensor(widths_A, dtype=torch.int64, device=device).t()
        self._widths_T = [*zip(*(widths_A[count - 1] for count in legal or [self.A]), strict=True)]

    def search(
        self, state_B: Int[Tensor, "B"], preference_BA: Float[Tensor, "B A"]
    ) -> tuple[Float[Tensor, "B A"], Float[Tensor, "B A"]]:
        """All simulations; q and `Lookahead.pruned_BA` of the roots.

        Args:
            state_B: distinct states.
            preference_BA: what is added to sigma(q) in sequential halving.
        """
        self.arm_NAC.zero_()
        self.nodes_B.fill_(1)
        self._expand(self.root_B, state_B, torch.zeros_like(self.root_B))
        left_B = torch.full_like(self.root_B, self._options.simulations - 1)  # the first one has expanded the root
        survives_BA = torch.ones_like(preference_BA, dtype=torch.bool)
        place_A = torch.arange(self.A, device=left_B.device)
        allowed_B = (self.arm_NAC.index_select(0, self.root_B)[..., _Q] > -torch.inf).sum(1)
        width_TB = self._width_TA.index_select(1, allowed_B - 1)
        for number, widths in enumerate(self._widths_T):
            arm_BAC, width_B = self.arm_NAC.index_select(0, self.root_B), width_TB[number]
            open_BA = arm_BAC[..., _OPEN] > 0
            known = arm_BAC[..., _Q], arm_BAC[..., _VISITS], open_BA
            if self._options.root == "rule":
                action_BW = self._select(arm_BAC).unsqueeze(1)
            else:
                if not number or widths != self._widths_T[number - 1]:
                    # A new round of some roots: the best actions of those that are left go on.
                    order_BA = ranked(preference_BA, *known, survives_BA)
                    best_BA = torch.zeros_like(survives_BA).scatter_(1, order_BA, place_A < width_B.unsqueeze(1))
                    is_new_B = width_B != (width_TB[number - 1] if number else 0)
                    survives_BA = torch.where(is_new_B.unsqueeze(1), best_BA, survives_BA)
                action_BW = ranked(preference_BA, *known, survives_BA)[:, : max(widths)]
            count_B = open_BA.sum(1).minimum(width_B).minimum(left_B)
            left_B -= count_B
            # A wave goes at most a level deeper than the one before it.
            self._wave(action_BW, count_B, min(self._bottom - 1, number + 1))
        return self.arm_NAC.index_select(0, self.root_B)[..., _Q], self._open_mass()

    def _widths(self, count: int) -> list[int]:
        """How many actions of a root with so many allowed ones have a simulation in each wave, if so many are open.

        Each wave uses at least one simulation, so there are as many waves; those at the end may have nothing to do.
        """
        simulations = self._options.simulations - 1 if self._bottom > 1 else 0
        by_rule = self._options.root == "rule"
        waves = rounds(1 if by_rule else count, simulations, 1)
        return [width for width, _ in itertools.islice(waves, simulations)]

    def _wave(self, action_BW: Int[Tensor, "B W"], count_B: Int[Tensor, "B"], levels: int) -> None:
        """A simulation by each of the first actions of each root, through at most so many levels."""
        W = action_BW.shape[1]
        starts_BW = torch.arange(W, device=count_B.device) < count_B.unsqueeze(1)
        new_BW = (self.root_B + self.nodes_B).unsqueeze(1) + torch.arange(W, device=count_B.device)
        self.nodes_B += count_B
        new_L = torch.where(starts_BW, new_BW, self._spare).view(-1)
        on_L, action_L = starts_BW.view(-1), torch.where(starts_BW, action_BW, 0).view(-1)
        node_L = torch.where(starts_BW, self.root_B.unsqueeze(1), self._spare).view(-1)
        level_L = torch.zeros_like(node_L)
        # end_L: the edge, arm * K + k, where a lane ends because its child is no node yet
        path, end_L = list[tuple[Tensor, Tensor, Tensor, Tensor]](), torch.full_like(node_L, self._spare * self.A)
        end_L *= self.K
        for depth in range(levels):
            arm_L = torch.add(action_L, node_L, alpha=self.A)
            k_L, below_L = self._outcome(arm_L)
            path.append((node_L, arm_L, k_L, on_L))
            end_L = torch.where(on_L & (below_L == 0), torch.add(k_L, arm_L, alpha=self.K), end_L)
            if depth < levels - 1:
                on_L = on_L & (below_L > 0)
                level_L = level_L + on_L
                node_L = torch.where(on_L, below_L, self._spare)
                action_L = self._select(self.arm_NAC.index_select(0, node_L))
        edge_L = end_L % (self.A * self.K)
        state_L = self.place_N2[:, 0].index_select(0, torch.div(end_L, self.A * self.K, rounding_mode="floor"))
        state_L = self._child_SAK.view(-1).index_select(0, torch.add(edge_L, state_L, alpha=self.A * self.K))
        below = torch.add(end_L % self.K, torch.div(end_L, self.K, rounding_mode="floor"), alpha=self._columns)
        self.arm_NAC.view(-1).index_copy_(0, below + (_EDGES + 4 * self.K), new_L.double())
        value_L, shut_L = self._expand(new_L, state_L, level_L + 1)
        for node_L, arm_L, k_L, passes_L in reversed(path):
            value_L, shut_L = self._back_up(node_L, arm_L, k_L, passes_L, value_L, shut_L)

    @property
    def _columns(self) -> int:
        return _EDGES + 5 * self.K

    def _of_edges(self, arm: Float[Tensor, "... C"], column: int) -> Float[Tensor, "... K"]:
        return arm[..., _EDGES + column * self.K : _EDGES + (column + 1) * self.K]

    # Select

    def _select(self, arm_LAC: Float[Tensor, "L A C"]) -> Int[Tensor, "L"]:
        """The action of a simulation that passes each of these nodes."""
        return self._selection.best(
            q_NA=arm_LAC[..., _Q],
            visits_NA=arm_LAC[..., _VISITS],
            prior_NA=arm_LAC[..., _PRIOR],
            open_NA=arm_LAC[..., _OPEN] > 0,
        )

    def _outcome(self, arm_L: Int[Tensor, "L"]) -> tuple[Int[Tensor, "L"], Int[Tensor, "L"]]:
        """The outcome that most lacks simulations, p_k (N_a + 1) - N_k, and the node that it leads to, or 0."""
        arm_LC = self.arm_NAC.view(-1, self._columns).index_select(0, arm_L)
        prob_LK = self._of_edges(arm_LC, 2)
        lack_LK = prob_LK * (arm_LC[:, _VISITS : _VISITS + 1] + 1) - self._of_edges(arm_LC, 3)
        k_L = most_lacking(lack_LK.masked_fill_(prob_LK < 0, -torch.inf))
        return k_L, self._of_edges(arm_LC, 4).gather(1, k_L.unsqueeze(1)).squeeze(1).long()

    # Expand

    def _expand(
        self, node_L: Int[Tensor, "L"], state_L: Int[Tensor, "L"], level_L: Int[Tensor, "L"]
    ) -> tuple[Float[Tensor, "L"], Bool[Tensor, "L"]]:
        """Make nodes of these states; their values, and whether nothing below them can be expanded."""
        arm_LAC = self._begun_SAC.index_select(0, state_L)
        is_last_L11 = (level_L + 1 >= self._bottom)[:, None, None]
        arm_LAC[..., _OPEN : _OPEN + 1].masked_fill_(is_last_L11, 0)
        self._of_edges(arm_LAC, 2).masked_fill_(is_last_L11, -1)
        self.arm_NAC.index_copy_(0, node_L, arm_LAC)
        self.place_N2.index_copy_(0, node_L, torch.stack([state_L, level_L], 1))
        return _summed_up(arm_LAC)

    # Backward

    def _back_up(
        self, node_L: Tensor, arm_L: Tensor, k_L: Tensor, passes_L: Tensor, value_L: Tensor, shut_L: Tensor
    ) -> tuple[Float[Tensor, "L"], Bool[Tensor, "L"]]:
        """q of arms whose children k have these values; the same of their nodes. Lanes that have ended above keep what
        they bring."""
        arm_MC, k_L1, K = self.arm_NAC.view(-1, self._columns), k_L.unsqueeze(1), self.K
        arm_L = torch.where(passes_L, arm_L, self._spare * self.A)
        arm_LC = arm_MC.index_select(0, arm_L)
        arm_LC.scatter_(1, k_L1 + _EDGES, value_L.unsqueeze(1))
        arm_LC[:, _VISITS] += 1
        arm_LC.scatter_add_(1, k_L1 + (_EDGES + 3 * K), torch.ones_like(value_L).unsqueeze(1))
        # An edge is shut by a probability below 0.
        shut_L1 = shut_L.double().unsqueeze(1)
        arm_LC[:, _OPEN : _OPEN + 1] -= shut_L1
        arm_LC.scatter_add_(1, k_L1 + (_EDGES + 2 * K), -2 * shut_L1)
        q_L = (self._of_edges(arm_LC, 1) * self._of_edges(arm_LC, 0)).sum(1)
        torch.add(q_L, arm_LC[:, _REWARD], out=arm_LC[:, _Q])
        arm_MC.index_copy_(0, arm_L, arm_LC)
        of_node_L, is_shut_L = _summed_up(self.arm_NAC.index_select(0, node_L))
        return torch.where(passes_L, of_node_L, value_L), torch.where(passes_L, is_shut_L, shut_L)

    def _open_mass(self) -> Float[Tensor, "B A"]:
        """As `Nodes.open_mass`. What one pass over all nodes makes right grows by a level, from the deepest up."""
        weight_NAK, below_NAK = self._of_edges(self.arm_NAC, 1), self._of_edges(self.arm_NAC, 4).long()
        is_last_N1 = self.place_N2[:, 1:] + 1 >= self._bottom
        mass_NA = torch.zeros_like(weight_NAK[..., 0])
        for _ in range(min(self._bottom - 1, self._options.simulations)):
            of_child_NAK = mass_NA.amax(1).take(below_NAK).masked_fill_(below_NAK == 0, 1)
            mass_NA = (weight_NAK * of_child_NAK).sum(2).masked_fill_(is_last_N1, 0)
        return mass_NA.index_select(0, self.root_B)

    def expanded(self) -> Int[Tensor, "N 2"]:
        """The states and levels of all nodes; the host waits for their number."""
        S = (len(self.place_N2) - 1) // len(self.root_B)
        is_node_BS = torch.arange(S, device=self.root_B.device) < self.nodes_B.unsqueeze(1)
        return self.place_N2[:-1][is_node_BS.view(-1)]


def _summed_up(arm_LAC: Float[Tensor, "L A C"]) -> tuple[Float[Tensor, "L"], Bool[Tensor, "L"]]:
    """v of nodes, and whether all their actions are exhausted."""
    return arm_LAC[..., _Q].amax(1), arm_LAC[..., _OPEN].amax(1) <= 0
