"""Many search trees in one table of nodes. Simulations go down in waves, level by level, each level a few tensors.

A wave sends b simulations below a root at once: b is split among the actions, an action's share among its outcomes, an
outcome's share goes to the node that it leads to, and so on; a node that is not expanded takes one simulation for that.
Then all nodes that were passed are backed up, deepest level first. A wave of 1 is the textbook's simulation (Kocsis and
Szepesvari 2006); in a larger one simulations do not learn from each other, but they part, because a split goes on as if
they had come one by one. What could be used nowhere below goes back to the root.
"""

from dataclasses import dataclass, field
from typing import Literal, final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.errors import NodeBudgetExceeded
from pgts_torch.search.known import KnownStates, longer, widened
from pgts_torch.search.memory import GROWTH, Sizes
from pgts_torch.search.split import Selection, apportion

Backup = Literal["max", "mean"]

_ROOM = 2**22
"""The most edges for which there is room before they are needed."""


_DUST = 1e-6
"""Shares of simulations below this are rounding and go nowhere."""


@dataclass(eq=False)
class _Step:
    """What a wave does on one level: it passes F nodes by M of their actions ("arms") and those by L outcomes.

    An arm is a number node * A + action: K may grow during a wave, this stays.
    """

    node_F: Tensor
    parent_M: Tensor  # position in F
    arm_M: Tensor
    known_arm_M: Tensor  # the same in the tables of `known`
    row_L: Tensor  # position in M
    outcome_L: Tensor
    budget_L: Tensor
    level: int
    child_C: Tensor = field(init=False)  # C distinct children; in a tree C = L
    budget_C: Tensor = field(init=False)
    used_C: Tensor = field(init=False)  # 1 where the child is new
    on_G: Tensor = field(init=False)  # position in C of the G children that more simulations pass
    at_L: Tensor | None = None  # in a graph: position in C

    def edge(self, arm_M: Tensor, K: int) -> Tensor:
        """The outcomes, numbered arm * K + k."""
        return torch.add(self.outcome_L, arm_M.index_select(0, self.row_L), alpha=K)


@final
class Tree:
    """Nodes that have been expanded, of all roots. Node 0 is none: an edge leads there before its child is expanded.

    Args:
        known: what is known of states.
        bottom: nodes at this level are never expanded.
        merge: a node is a (level, state), whatever the path that led to it: Czech et al. 2021.
        max_nodes: the most nodes, see `Lookahead.nodes_per_level`.
        room: for how many nodes there is room at first.
    """

    def __init__(
        self,
        known: KnownStates,
        bottom: int,
        selection: Selection,
        *,
        backup: Backup,
        merge: bool,
        max_nodes: int,
        room: int,
    ) -> None:
        self.known, self.bottom, self.selection = known, bottom, selection
        self.merge, self.mean, self.max_nodes = merge, backup == "mean", max_nodes
        self.A, self.K, self.count = known.num_actions, known.num_outcomes, 1
        self.arms = 0
        known.check_memory(0, places=bottom + 1 + 2 * len(known.row_S) + (2 * self._places() if merge else 0))
        self.valued = [0] * (bottom + 1)
        self._full_T = dict[tuple[int, int], Tensor]()
        most = known.max_bytes // (2 * Sizes(self.A, self.K, known.dtype).node)
        room = min(room, most, _ROOM // (self.A * self.K)) + 1

        def table(*shape: int, dtype: torch.dtype = known.dtype) -> Tensor:
            return torch.zeros(shape, dtype=dtype, device=known.device)

        A, E = self.A, self.A * self.K
        self.state_N, self.level_N = table(room, dtype=torch.int64), table(room, dtype=torch.int64)  # rows of `known`
        self.visits_NA, self.visits_NE = table(room, A, dtype=torch.float64), table(room, E, dtype=torch.float64)
        self.q_NA, self.v_N, self.value_NE = table(room, A), table(room), table(room, E)
        self.shut_action_NA, self.shut_N, self.shut_outcome_NE = table(room, A), table(room), table(room, E)
        self.below_NE = table(room, E, dtype=torch.int64)
        self.node_at = table(self._places() if merge else 0, dtype=torch.int64)  # in a graph, by (state, level)

    # What a search does

    def plant(self, root_B: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """A node for each of these distinct states; it is expanded."""
        self.valued[0] = len(root_B)
        node_B = self._add(root_B, 0)
        if self.merge:
            self.node_at[self._place(root_B, 0)] = node_B
        return node_B

    def open(self, node_B: Int[Tensor, "B"]) -> Bool[Tensor, "B A"]:
        """Actions of roots below which there is something to expand."""
        return torch.isfinite(self.shut_action_NA.index_select(0, node_B))

    def split(self, node_F: Int[Tensor, "F"], budget_F: Float[Tensor, "F"], level: int = 0) -> Float[Tensor, "F A"]:
        """How many of the simulations that pass a node take each action."""
        state_F, most_FA = self.state_N.index_select(0, node_F), None
        visits_FA = self.visits_NA.index_select(0, node_F)
        if not self.mean and int(budget_F.amax()) > 1:
            most_FA = self.known.width_TA.index_select(0, state_F) * self._full(state_F, level).unsqueeze(1)
            most_FA.sub_(visits_FA).clamp_min_(1)
        return self.selection.split(
            budget_F,
            q_NA=self.q_NA.index_select(0, node_F),
            visits_NA=visits_FA,
            prior_NA=self.known.prior_TA.index_select(0, state_F),
            shut_NA=self.shut_action_NA.index_select(0, node_F),
            most_NA=most_FA,
        )

    def wave(self, node_B: Int[Tensor, "B"], budget_BA: Float[Tensor, "B A"]) -> Float[Tensor, "B"]:
        """So many simulations below each action of these distinct roots; how many of each root could be used."""
        steps, node_F, budget_FA = list[_Step](), node_B, budget_BA
        for level in range(self.bottom):
            step, budget_F = self._descend(node_F, budget_FA, level)
            steps.append(step)
            if len(budget_F) == 0:
                break
            node_F = step.child_C.index_select(0, step.on_G)
            budget_FA = self.split(node_F, budget_F, level + 1)
        used_F, return_F = budget_F, budget_F
        for step in reversed(steps):
            used_F, return_F = self._ascend(step, used_F, return_F)
        return used_F

    def settle(self, node_B: Int[Tensor, "B"]) -> Float[Tensor, "B A"]:
        """Back up a whole graph once from the bottom, for what the waves could not reach.

        Returns:
            `Lookahead.pruned_BA`: the most discounted probability that a plan after each action of the roots puts on
            nodes that could be expanded; inf for averages, which have no bound and are as the waves left them.
        """
        if self.mean:
            return torch.full_like(self.q_NA[node_B], torch.inf)
        known, A, K = self.known, self.A, self.K
        leaf_T = known.weight_TE.view(-1, A, K).sum(2).amax(1)
        mass_N = leaf_T.index_select(0, self.state_N[: self.count])
        mass_N.masked_fill_(self.level_N[: self.count] + 1 >= self.bottom, 0)
        mass_N[0] = 1
        inner_N = (self.visits_NA[: self.count].sum(1) > 0) | self.merge
        inner_N[node_B], inner_N[0] = True, False
        for level in range(self.bottom - 1, -1, -1):
            node_F = (inner_N & (self.level_N[: self.count] == level)).nonzero().squeeze(1)
            if self.merge:
                self._meet(node_F, level)
            if level + 1 < self.bottom:
                weight_FE = known.weight_TE.index_select(0, self.state_N.index_select(0, node_F))
                below_FE = self.below_NE.index_select(0, node_F)
                mass_FE = weight_FE * mass_N.index_select(0, below_FE.view(-1)).view_as(weight_FE)
                mass_FA = mass_FE.view(-1, A, K).sum(2)
                mass_N[node_F] = mass_FA.amax(1)
        if self.bottom == 1:
            return torch.zeros_like(self.q_NA[node_B])
        return mass_FA  # of the roots: level 0 has no other nodes

    def nodes_per_level(self) -> tuple[int, ...]:
        """How many nodes have been valued at each level, by the critic or by a look below."""
        if self.merge:
            for level in range(self.bottom):
                state_F = self.state_N[1 : self.count][self.level_N[1 : self.count] == level]
                seen_FE = torch.isfinite(self.known.shut_outcome_TE[state_F])
                self.valued[level + 1] = len(self.known.child_TE[state_F][seen_FE].unique())
        return tuple(self.valued)

    # Down

    def _descend(self, node_F: Tensor, budget_FA: Tensor, level: int) -> tuple[_Step, Tensor]:
        """Share simulations among outcomes and expand what they meet; how many are left, where they can go on."""
        known, A, K = self.known, self.A, self.K
        at_M = budget_FA.view(-1).nonzero().squeeze(1)
        self.arms = max(self.arms, len(at_M))
        budget_M = budget_FA.view(-1).index_select(0, at_M)
        parent_M = at_M.div(A, rounding_mode="trunc")
        node_M = node_F.index_select(0, parent_M)
        arm_M = torch.add(at_M, node_M - parent_M, alpha=A)
        state_M = self.state_N.index_select(0, node_M)
        known_arm_M = torch.add(arm_M, state_M - node_M, alpha=A)
        lack_MK = known.prob_TE.view(-1, K).index_select(0, known_arm_M)
        lack_MK.mul_((self.visits_NA.view(-1).index_select(0, arm_M) + budget_M).unsqueeze(1))
        visits_MK, most_MK = self.visits_NE.view(-1, K).index_select(0, arm_M), None
        lack_MK.sub_(visits_MK)
        lack_MK.add_(self.shut_outcome_NE.view(-1, K).index_select(0, arm_M))
        if not self.mean and int(budget_M.amax()) > 1:
            most_MK = (self._full(state_M, level).unsqueeze(1) - visits_MK).clamp_min_(1)
        split = apportion(lack_MK, budget_M, most_MK).view(-1)
        at_L = split.nonzero().squeeze(1)
        budget_L = split.index_select(0, at_L)
        row_L = at_L.div(K, rounding_mode="trunc")
        outcome_L = torch.sub(at_L, row_L, alpha=K)
        step = _Step(node_F, parent_M, arm_M, known_arm_M, row_L, outcome_L, budget_L, level)
        if level + 1 == self.bottom:  # averages alone get here
            step.budget_C = step.used_C = budget_L
            step.child_C, step.on_G = torch.zeros_like(at_L), at_L[:0]
            return step, budget_L[:0]
        state_L = known.child_TE.view(-1).index_select(0, step.edge(known_arm_M, K))
        if self.merge:
            self._expand_graph(step, state_L)
        else:
            self._expand_tree(step, state_L)
        rest_C = step.budget_C - step.used_C
        can_C = (rest_C > _DUST) & (self.shut_N.index_select(0, step.child_C) == 0)
        step.on_G = can_C.nonzero().squeeze(1)
        return step, rest_C.index_select(0, step.on_G)

    def _full(self, state_F: Tensor, level: int) -> Tensor:
        """What a subtree below each outcome can use, if all states in it have as many outcomes as its root's parent.

        An estimate, in order that simulations do not crowd where there is little to expand: 1 + e + e^2 + ...
        """
        key = level, self.known.count
        if key not in self._full_T:
            outcomes_T = self.known.outcomes_T.double()
            full_T = torch.zeros_like(outcomes_T)
            for _ in range(self.bottom - 1 - level):
                full_T.mul_(outcomes_T).add_(1)
            self._full_T[key] = full_T
        return self._full_T[key].index_select(0, state_F)

    def _expand_tree(self, step: _Step, state_L: Tensor) -> None:
        child_L = self.below_NE.view(-1).index_select(0, step.edge(step.arm_M, self.K))
        new = (child_L == 0).nonzero().squeeze(1)
        step.budget_C, step.used_C, step.child_C = step.budget_L, torch.zeros_like(step.budget_L), child_L
        if len(new):
            node = self._add(state_L.index_select(0, new), step.level + 1)
            child_L.scatter_(0, new, node)
            step.used_C.index_fill_(0, new, 1)
            self.below_NE.view(-1).scatter_(0, step.edge(step.arm_M, self.K).index_select(0, new), node)

    def _expand_graph(self, step: _Step, state_L: Tensor) -> None:
        """As in a tree; all that meet in a node put their simulations together, and it hears what others found."""
        new_C = state_L[self.node_at.index_select(0, self._place(state_L, step.level + 1)) == 0].unique()
        first = self.count
        if len(new_C):
            node_C = self._add(new_C, step.level + 1)
            self.node_at[self._place(new_C, step.level + 1)] = node_C
        child_L = self.node_at[self._place(state_L, step.level + 1)]
        step.child_C, step.at_L = child_L.unique(return_inverse=True)
        step.budget_C = step.budget_L.new_zeros(len(step.child_C)).index_add_(0, step.at_L, step.budget_L)
        step.used_C = (step.child_C >= first).to(step.budget_L.dtype)
        self._meet(step.child_C[step.child_C < first], step.level + 1)

    def _add(self, state_N: Tensor, level: int) -> Tensor:
        """Nodes for these states; nothing leads to them yet.

        Raises:
            NodeBudgetExceeded: they would not fit into memory, and the model has not been asked about them; or they are
                too many.
        """
        known, N = self.known, len(state_N)
        state_N = known.rows(state_N, **self._counts(N))
        self._reserve(N)
        new = slice(self.count, self.count + N)
        self.count += N
        self.state_N[new], self.level_N[new] = state_N, level
        for name in ("q", "shut_action"):
            torch.index_select(getattr(known, f"{name}_TA"), 0, state_N, out=getattr(self, f"{name}_NA")[new])
        for name in ("value", "shut_outcome"):
            torch.index_select(getattr(known, f"{name}_TE"), 0, state_N, out=getattr(self, f"{name}_NE")[new])
        for name in ("v", "shut"):
            torch.index_select(getattr(known, f"{name}_T"), 0, state_N, out=getattr(self, f"{name}_N")[new])
        if level + 1 == self.bottom and (level == 0 or not self.mean):
            self.shut_N[new], self.shut_action_NA[new] = -torch.inf, -torch.inf
        self.valued[level + 1] += int(known.outcomes_T.index_select(0, state_N).sum())
        nodes = sum(self.valued)
        if nodes > self.max_nodes and (nodes := sum(self.nodes_per_level())) > self.max_nodes:
            raise NodeBudgetExceeded(
                f"the search has {nodes} nodes; max_nodes is {self.max_nodes}: "
                "lower the simulations, ask for fewer roots or raise the budget"
            )
        return torch.arange(new.start, new.stop, device=known.device)

    def _reserve(self, rows: int) -> None:
        """Room for so many more nodes, and for what has become known since."""
        if (K := self.known.num_outcomes) > self.K:
            for name in ("visits_NE", "value_NE", "shut_outcome_NE", "below_NE"):
                fill = -torch.inf if name.startswith("shut") else 0
                setattr(self, name, widened(getattr(self, name), self.K, K, fill))
            self.K = K
        if self.merge and self._places() > len(self.node_at):
            self.node_at = longer(self.node_at, self._places())
        if self.count + rows > len(self.state_N):
            for name, table in vars(self).items():
                if name.endswith(("_N", "_NA", "_NE")):
                    setattr(self, name, longer(table, max(self.count + rows, int(GROWTH * len(table)))))

    def _counts(self, rows: int) -> dict[str, int]:
        """What `search_bytes` counts once there are so many more nodes."""
        nodes = max(self.count + rows, int(len(self.state_N) / GROWTH) if self.count > 1 else 0)
        places = self.bottom + 1 + 2 * len(self.known.row_S) + (2 * self._places() if self.merge else 0)
        return {"nodes": nodes, "places": places, "arms": self.arms}

    def _places(self) -> int:
        return len(self.known.row_S) * (self.bottom + 1)

    def _place(self, state_N: Tensor, level: int) -> Tensor:
        """In a graph: where in `node_at` the nodes of these states stand."""
        return state_N * (self.bottom + 1) + level

    # Up

    def _ascend(self, step: _Step, used_G: Tensor, return_G: Tensor) -> tuple[Tensor, Tensor]:
        """Back up the nodes of a level; how many simulations each used, and, for averages, the sum of their returns."""
        edge_L = step.edge(step.arm_M, self.K)
        used_C = step.used_C.index_add(0, step.on_G, used_G)
        used_L = used_C if step.at_L is None else step.budget_L * (used_C / step.budget_C)[step.at_L]
        if self.mean:
            used_L = step.budget_L
        used_M = used_G.new_zeros(len(step.arm_M)).index_add_(0, step.row_L, used_L)
        F, visits_M = len(step.node_F), self.visits_NA.view(-1).index_select(0, step.arm_M)
        if self.mean:
            return_G = self._average(step, edge_L, return_G, visits_M, used_M)
        elif self.merge:
            self._meet(step.node_F, step.level)
        else:
            for name in ("value", "shut_outcome"):
                of_child_N = self.v_N if name == "value" else self.shut_N
                getattr(self, f"{name}_NE").view(-1).scatter_(0, edge_L, of_child_N.index_select(0, step.child_C))
            self._back_up(step.node_F, step.arm_M, step.known_arm_M)
        self.visits_NA.view(-1).scatter_(0, step.arm_M, visits_M + used_M)
        self.visits_NE.view(-1).scatter_add_(0, edge_L, used_L)
        return used_M.new_zeros(F).index_add_(0, step.parent_M, used_M), return_G

    def _back_up(self, node_F: Tensor, arm_M: Tensor, known_arm_M: Tensor) -> None:
        """q of these actions and v of these nodes, and whether they are shut."""
        known, K = self.known, self.K
        q_MK = self.value_NE.view(-1, K).index_select(0, arm_M)
        q_MK *= known.weight_TE.view(-1, K).index_select(0, known_arm_M)
        q_M = q_MK.sum(1).add_(known.reward_TA.view(-1).index_select(0, known_arm_M))
        self.q_NA.view(-1).scatter_(0, arm_M, q_M)
        shut_M = self.shut_outcome_NE.view(-1, K).index_select(0, arm_M).amax(1)
        self.shut_action_NA.view(-1).scatter_(0, arm_M, shut_M)
        self.v_N.scatter_(0, node_F, self.q_NA.index_select(0, node_F).amax(1))
        self.shut_N.scatter_(0, node_F, self.shut_action_NA.index_select(0, node_F).amax(1))

    def _meet(self, node_F: Tensor, level: int) -> None:
        """In a graph: back up nodes from all children that there are now, whoever expanded them."""
        known, state_F = self.known, self.state_N[node_F]
        below_FE = self.node_at[self._place(known.child_TE[state_F], level + 1)]
        self.below_NE[node_F] = below_FE
        self.value_NE[node_F] = torch.where(below_FE > 0, self.v_N[below_FE], known.value_TE[state_F])
        if level + 1 < self.bottom:
            self.shut_outcome_NE[node_F] = known.shut_outcome_TE[state_F] + self.shut_N[below_FE]
        else:
            self.shut_outcome_NE[node_F] = -torch.inf
        action_A = torch.arange(self.A, device=known.device)
        arm_FA, known_arm_FA = (x_F.unsqueeze(1) * self.A + action_A for x_F in (node_F, state_F))
        self._back_up(node_F, arm_FA.view(-1), known_arm_FA.view(-1))

    def _average(
        self, step: _Step, edge_L: Tensor, return_G: Tensor, visits_M: Tensor, used_M: Tensor
    ) -> Float[Tensor, "F"]:
        """q = (q_0 + sum of returns) / (1 + N). A return is a critic's value, backed up along the path."""
        known, ended_L = self.known, step.budget_L.clone()
        if len(step.on_G):
            ended_L[step.on_G] = step.used_C[step.on_G]
        if step.level + 1 == self.bottom:
            value_L = self.value_NE.view(-1).index_select(0, edge_L)
        else:
            value_L = self.v_N.index_select(0, step.child_C)
        return_L = (ended_L * value_L).index_add_(0, step.on_G, return_G)
        return_L *= known.carry_TE.view(-1).index_select(0, step.edge(step.known_arm_M, self.K))
        return_M = used_M * known.reward_TA.view(-1).index_select(0, step.known_arm_M)
        return_M.index_add_(0, step.row_L, return_L)
        before_M = self.q_NA.view(-1).index_select(0, step.arm_M)
        q_M = (before_M * (1 + visits_M) + return_M) / (1 + visits_M + used_M)
        self.q_NA.view(-1).scatter_(0, step.arm_M, q_M.to(before_M.dtype))
        return used_M.new_zeros(len(step.node_F)).index_add_(0, step.parent_M, return_M)
