"""Many search trees at once. Simulations go down in waves, level by level, each level a few operations on tensors.

A wave sends b simulations below a root at once: b is split among the actions, an action's share among its outcomes, an
outcome's share goes to the node that it leads to, and so on; a node that is not expanded takes one simulation for that.
Then all nodes that were passed are backed up, deepest level first. A wave of 1 is the textbook's simulation (Kocsis and
Szepesvari 2006); in a larger one simulations do not learn from each other, but they part, because a split goes on as if
they had come one by one. What could be used nowhere below goes back to the root.
"""

from dataclasses import dataclass, field
from typing import final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.known import KnownStates
from pgts_torch.search.nodes import Nodes
from pgts_torch.search.split import Selection, apportion

_DUST = 1e-6
"""Shares of simulations below this are rounding and go nowhere."""


@dataclass(eq=False)
class _Step:
    """What a wave does on one level: it passes F nodes by M of their actions ("arms") and these by L outcomes
    ("edges"), which lead to C children. G of the children pass simulations on.

    An arm is a number node * A + action, an edge a number arm * K + k; K may grow during a wave, arms stay.
    """

    level: int
    node_F: Tensor
    parent_M: Tensor  # position of the arm's node in F
    arm_M: Tensor
    table_arm_M: Tensor  # the same (state, action) in the table of outcomes: row * A + action
    row_L: Tensor  # position of the edge's arm in M
    outcome_L: Tensor  # k
    budget_L: Tensor  # simulations
    child_C: Tensor = field(init=False)  # nodes, distinct in a graph; in trees C = L
    budget_C: Tensor = field(init=False)  # simulations that arrive
    used_C: Tensor = field(init=False)  # those that are used: 1 where the child is new, then what was used below it
    on_G: Tensor = field(init=False)  # position in C
    at_L: Tensor | None = None  # in a graph: position of the edge's child in C

    def edge(self, arm_M: Tensor, K: int) -> Tensor:
        """The L edges of these arms: `arm_M`, or `table_arm_M` for the same outcomes in the table."""
        return torch.add(self.outcome_L, arm_M.index_select(0, self.row_L), alpha=K)


@final
class Tree:
    """Selects, expands and backs up nodes.

    Args:
        bottom: nodes at this level are never expanded.
        options: how actions are selected; maxima or averages; with `merges` a node is a (level, state), whatever the
            path that led to it (Czech et al. 2021).
        room: for how many nodes there is room at first.
    """

    def __init__(self, known: KnownStates, bottom: int, options: MCTS, *, room: int) -> None:
        self.known, self.bottom, self.A = known, bottom, known.num_actions
        self.merge, self.mean = options.merges, options.backup == "mean"
        self.selection = Selection(options.rule, 1.25 if options.exploration is None else options.exploration)
        self.nodes = Nodes(known, bottom, merge=self.merge, revisits=self.mean, max_nodes=options.max_nodes, room=room)

    def wave(self, node_B: Int[Tensor, "B"], budget_BA: Float[Tensor, "B A"]) -> Float[Tensor, "B"]:
        """So many simulations below each action of these distinct roots; how many of each root could be used."""
        steps, node_F, budget_FA = list[_Step](), node_B, budget_BA
        for level in range(self.bottom):
            step = self._select(node_F, budget_FA, level)
            left_G = self._expand(step)
            steps.append(step)
            if len(left_G) == 0:
                break
            node_F = step.child_C.index_select(0, step.on_G)
            budget_FA = self.split(node_F, left_G, level + 1)
        used_F, return_F = left_G, left_G  # there are none: no simulation passes the nodes at the last level
        for step in reversed(steps):
            used_F, return_F = self._backward(step, used_F, return_F)
        return used_F

    # Select

    def split(self, node_F: Int[Tensor, "F"], budget_F: Float[Tensor, "F"], level: int = 0) -> Float[Tensor, "F A"]:
        """How many of the simulations that pass a node take each action."""
        nodes, most_FA = self.nodes, None
        known_F = nodes.known_N.index_select(0, node_F)
        visits_FA = nodes.visits_NA.index_select(0, node_F)
        if not self.mean and int(budget_F.amax()) > 1:
            # No more than can be of use below the action, as far as that is known; but one, in case it is not.
            useful_F1 = self.known.useful(known_F, self.bottom - 1 - level)
            most_FA = self.known.width_TA.index_select(0, known_F) * useful_F1
            most_FA.sub_(visits_FA).clamp_min_(1)
        return self.selection.split(
            budget_F,
            q_NA=nodes.q_NA.index_select(0, node_F),
            visits_NA=visits_FA,
            prior_NA=self.known.prior_TA.index_select(0, known_F),
            exhausted_NA=nodes.exhausted_NA.index_select(0, node_F),
            most_NA=most_FA,
        )

    def _select(self, node_F: Tensor, budget_FA: Tensor, level: int) -> _Step:
        """Split the simulations of each action among its outcomes."""
        nodes, A, K = self.nodes, self.A, self.nodes.num_outcomes
        # M of the F * A actions have simulations; `at_M` is parent * A + action, so that node * A + action, the arm,
        # is at_M + (node - parent) * A.
        at_M = budget_FA.view(-1).nonzero().squeeze(1)
        nodes.most_arms = max(nodes.most_arms, len(at_M))
        budget_M = budget_FA.view(-1).index_select(0, at_M)
        parent_M = at_M.div(A, rounding_mode="trunc")
        node_M = node_F.index_select(0, parent_M)
        arm_M = torch.add(at_M, node_M - parent_M, alpha=A)
        table_arm_M = torch.add(arm_M, nodes.table_row_N.index_select(0, node_M) - node_M, alpha=A)
        # What each outcome lacks of the simulations due to it, p_k (N_a + b) - N_k: chance is enumerated evenly.
        lack_MK = self.known.topology.table.prob_RAK.view(-1, K).index_select(0, table_arm_M).double()
        lack_MK.mul_((nodes.visits_NA.view(-1).index_select(0, arm_M) + budget_M).unsqueeze(1))
        visits_MK, most_MK = nodes.visits_NAK.view(-1, K).index_select(0, arm_M), None
        lack_MK.sub_(visits_MK)
        lack_MK.add_(nodes.exhausted_NAK.view(-1, K).index_select(0, arm_M))
        if not self.mean and int(budget_M.amax()) > 1:
            useful_M1 = self.known.useful(nodes.known_N.index_select(0, node_M), self.bottom - 1 - level)
            most_MK = (useful_M1 - visits_MK).clamp_min_(1)
        split = apportion(lack_MK, budget_M, most_MK).view(-1)
        # L of the M * K outcomes get simulations.
        at_L = split.nonzero().squeeze(1)
        row_L = at_L.div(K, rounding_mode="trunc")
        outcome_L = torch.sub(at_L, row_L, alpha=K)
        return _Step(level, node_F, parent_M, arm_M, table_arm_M, row_L, outcome_L, split.index_select(0, at_L))

    # Expand

    def _expand(self, step: _Step) -> Tensor:
        """Expand new children, which takes one simulation each; how many are left where they can go on."""
        if step.level + 1 == self.bottom:  # only averages pass edges to the last level, to average its values again
            step.budget_C = step.used_C = step.budget_L
            step.child_C, step.on_G = torch.zeros_like(step.row_L), step.row_L[:0]
            return step.budget_L[:0]
        child = self.known.topology.table.child_RAK.view(-1)
        state_L = child.index_select(0, step.edge(step.table_arm_M, self.nodes.num_outcomes))
        if self.merge:
            self._expand_graph(step, state_L)
        else:
            self._expand_tree(step, state_L)
        # G: the children with simulations left and something below them to expand.
        left_C = step.budget_C - step.used_C
        can_C = (left_C > _DUST) & (self.nodes.exhausted_N.index_select(0, step.child_C) == 0)
        step.on_G = can_C.nonzero().squeeze(1)
        return left_C.index_select(0, step.on_G)

    def _expand_tree(self, step: _Step, state_L: Tensor) -> None:
        nodes = self.nodes
        child_L = nodes.below_NAK.view(-1).index_select(0, step.edge(step.arm_M, nodes.num_outcomes))
        new = (child_L == 0).nonzero().squeeze(1)
        step.budget_C, step.used_C, step.child_C = step.budget_L, torch.zeros_like(step.budget_L), child_L
        if len(new):
            node = nodes.add(state_L.index_select(0, new), step.level + 1)
            child_L.scatter_(0, new, node)
            step.used_C.index_fill_(0, new, 1)
            # Nodes may have more outcomes now, and edges other numbers.
            edge_L = step.edge(step.arm_M, nodes.num_outcomes)
            nodes.below_NAK.view(-1).scatter_(0, edge_L.index_select(0, new), node)

    def _expand_graph(self, step: _Step, state_L: Tensor) -> None:
        """As in trees, but the simulations of all edges that lead to a node arrive there together, and nodes that other
        paths have expanded are backed up first, so that what was found below them counts."""
        nodes, level = self.nodes, step.level + 1
        place_L, first = nodes.place(state_L, level), nodes.count
        child_L = nodes.node_at.index_select(0, place_L)
        # The states among the children that have no node at this level yet, each once.
        new_C = state_L[child_L == 0].unique()
        if len(new_C):
            node_C = nodes.add(new_C, level)
            nodes.node_at[nodes.place(new_C, level)] = node_C
            child_L = nodes.node_at.index_select(0, place_L)
        step.child_C, step.at_L = child_L.unique(return_inverse=True)
        step.budget_C = step.budget_L.new_zeros(len(step.child_C)).index_add_(0, step.at_L, step.budget_L)
        # Children ascend: the new ones are the last.
        num_old = len(step.child_C) - len(new_C)
        step.used_C = (step.child_C >= first).to(step.budget_L.dtype)
        if num_old:
            self._back_up(step.child_C[:num_old], level)

    # Backward

    def _backward(self, step: _Step, used_G: Tensor, return_G: Tensor) -> tuple[Tensor, Tensor]:
        """Back up the nodes of a level; how many simulations each used, and, for averages, the sum of their returns.

        Args:
            used_G, return_G: the same of the children that more simulations passed.
        """
        nodes, edge_L = self.nodes, step.edge(step.arm_M, self.nodes.num_outcomes)
        if self.mean:  # a return can be averaged however little was expanded
            used_L = step.budget_L
        else:
            used_C = step.used_C.index_add(0, step.on_G, used_G)
            # In a graph the edges that lead to a node share what it used, as they have shared in what arrived there.
            used_L = used_C if step.at_L is None else step.budget_L * (used_C / step.budget_C)[step.at_L]
        used_M = used_G.new_zeros(len(step.arm_M)).index_add_(0, step.row_L, used_L)
        if self.mean:
            return_G = self._average(step, edge_L, return_G, used_M)
        else:
            if not self.merge:
                # What a child's node knows replaces what the critic and the table said of the edge.
                nodes.value_NAK.view(-1).scatter_(0, edge_L, nodes.v_N.index_select(0, step.child_C))
                nodes.exhausted_NAK.view(-1).scatter_(0, edge_L, nodes.exhausted_N.index_select(0, step.child_C))
            self._back_up(step.node_F, step.level)
        nodes.visits_NA.view(-1).scatter_add_(0, step.arm_M, used_M)
        nodes.visits_NAK.view(-1).scatter_add_(0, edge_L, used_L)
        return used_M.new_zeros(len(step.node_F)).index_add_(0, step.parent_M, used_M), return_G

    def _back_up(self, node_F: Tensor, level: int) -> None:
        """q and v of the nodes of a level from the values at their edges, and whether they are exhausted.

        In a graph these are first read from the children that there are now, whoever expanded them.
        """
        nodes, known = self.nodes, self.known
        table, table_row_F = known.topology.table, nodes.table_row_N.index_select(0, node_F)
        if self.merge:
            known_F = nodes.known_N.index_select(0, node_F)
            place_FAK = nodes.place(table.child_RAK.index_select(0, table_row_F), level + 1)
            below_FAK = nodes.node_at.take(place_FAK)
            of_critic_FAK = known.value_TAK.index_select(0, known_F)
            value_FAK = torch.where(below_FAK > 0, nodes.v_N.take(below_FAK), of_critic_FAK)
            if level + 1 < self.bottom:
                # Node 0, which stands for a child that is not expanded, is not exhausted.
                exhausted_FAK = known.exhausted_TAK.index_select(0, known_F).add_(nodes.exhausted_N.take(below_FAK))
            else:
                exhausted_FAK = torch.full_like(value_FAK, -torch.inf)
            nodes.below_NAK.index_copy_(0, node_F, below_FAK)
            nodes.exhausted_NAK.index_copy_(0, node_F, exhausted_FAK)
        else:
            value_FAK = nodes.value_NAK.index_select(0, node_F)
            exhausted_FAK = nodes.exhausted_NAK.index_select(0, node_F)
        # p_k gamma_k v_k of each outcome; their sum and the reward are q.
        q_FAK = table.prob_RAK.index_select(0, table_row_F)
        q_FAK *= table.discount_RAK.index_select(0, table_row_F)
        q_FA = q_FAK.mul_(value_FAK).sum(2).add_(table.reward_RA.index_select(0, table_row_F))
        exhausted_FA = exhausted_FAK.amax(2)
        nodes.q_NA.index_copy_(0, node_F, q_FA)
        nodes.v_N.index_copy_(0, node_F, q_FA.amax(1))
        nodes.exhausted_NA.index_copy_(0, node_F, exhausted_FA)
        nodes.exhausted_N.index_copy_(0, node_F, exhausted_FA.amax(1))

    def back_up_shared(self, node_B: Int[Tensor, "B"]) -> None:
        """In a graph back up the roots, whose children other roots may have expanded."""
        if self.merge:
            self._back_up(node_B, 0)

    def _average(self, step: _Step, edge_L: Tensor, return_G: Tensor, used_M: Tensor) -> Float[Tensor, "F"]:
        """q = (q_0 + sum of returns) / (1 + N). A return is a critic's value, backed up along the path.

        Returns:
            The sum of the returns that pass each node.
        """
        nodes, table = self.nodes, self.known.topology.table
        # Simulations that end here take the child's value, the others bring a return from below.
        ended_L = step.budget_L.clone()
        if len(step.on_G):
            ended_L[step.on_G] = step.used_C[step.on_G]
        if step.level + 1 == self.bottom:
            value_L = nodes.value_NAK.view(-1).index_select(0, edge_L)
        else:
            value_L = nodes.v_N.index_select(0, step.child_C)
        return_L = (ended_L * value_L).index_add_(0, step.on_G, return_G)
        # Only outcomes that have weight are taken: gamma_k, times the probability that one has.
        node_M = step.node_F.index_select(0, step.parent_M)
        known_arm_M = torch.add(step.arm_M, nodes.known_N.index_select(0, node_M) - node_M, alpha=self.A)
        weighed_M = self.known.weighed_TA.view(-1).index_select(0, known_arm_M)
        carry_L = table.discount_RAK.view(-1).index_select(0, step.edge(step.table_arm_M, nodes.num_outcomes))
        return_L *= carry_L.mul_(weighed_M.index_select(0, step.row_L))
        # N and q of the actions before this wave, and their returns in it.
        return_M = used_M * table.reward_RA.view(-1).index_select(0, step.table_arm_M)
        return_M.index_add_(0, step.row_L, return_L)
        visits_M = nodes.visits_NA.view(-1).index_select(0, step.arm_M)
        before_M = nodes.q_NA.view(-1).index_select(0, step.arm_M)
        q_M = (before_M * (1 + visits_M) + return_M) / (1 + visits_M + used_M)
        nodes.q_NA.view(-1).scatter_(0, step.arm_M, q_M.to(before_M.dtype))
        return used_M.new_zeros(len(step.node_F)).index_add_(0, step.parent_M, return_M)

    def backup_all(self, node_B: Int[Tensor, "B"]) -> Float[Tensor, "B A"]:
        """Back up a whole graph once from the bottom, for what the waves could not reach.

        Returns:
            `Lookahead.pruned_BA`; inf for averages, which have no bound and are as the waves left them.
        """
        nodes = self.nodes
        if self.mean:
            return torch.full_like(nodes.q_NA[node_B], torch.inf)
        # In trees all values are backed up already, and only nodes that a wave has passed have something below.
        inner_N = (nodes.visits_NA[: nodes.count].sum(1) > 0) | self.merge
        inner_N[node_B], inner_N[0] = True, False
        node_F_by_level = [nodes.at_level(level, inner_N) for level in range(self.bottom)]
        if self.merge:
            for level in reversed(range(self.bottom)):
                self._back_up(node_F_by_level[level], level)
        return nodes.open_mass(node_F_by_level)
