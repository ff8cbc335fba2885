"""The nodes of many search trees in one table, and the memory that they take."""

from collections.abc import Sequence
from typing import final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.search.known import KnownStates
from pgts_torch.search.memory import GROWTH, Sizes, check_nodes
from pgts_torch.search.table import Table, with_room

_ROOM = 2**22
"""The most edges for which there is room before they are needed."""


@final
class Nodes(Table):
    """A row for each node that has been expanded, of all roots. A node has A actions and A * K edges, its outcomes.

    Row 0 is no node: an edge leads there as long as its child is not expanded.

    known_N: the row of the node's state in `KnownStates`.
    table_row_N: that in the table of the topology, where the outcomes are.
    level_N: 0 for roots.
    visits_NA, visits_NAK: how many simulations took the action, and the outcome; in a graph shares of simulations.
    q_NA, v_N: backed up values.
    value_NAK: what q is backed up from: the critic's value of the child, or v of its node.
    exhausted_NAK, exhausted_NA, exhausted_N: -inf where nothing below is left to expand, else 0.
    below_NAK: the node of the child, or 0. In a graph it is up to date only when the node has just been backed up.
    node_at: in a graph the node of a (state, level), or 0, see `place`; in trees empty.
    most_arms: the most (node, action) that a wave has passed on one level.

    Args:
        bottom: nodes at this level are never expanded.
        merge: whether the nodes are a graph: one for each (state, level), whatever the path (Czech et al. 2021).
        revisits: whether a node may be passed though nothing below it is left to expand, as for averages.
        max_nodes: the most nodes, see `Lookahead.nodes_per_level`.
    """

    axis = "N"

    def __init__(
        self, known: KnownStates, bottom: int, *, merge: bool, revisits: bool, max_nodes: int, room: int
    ) -> None:
        super().__init__(known.num_actions, known.num_outcomes, known.dtype, known.device)
        self.known, self.bottom, self.merge, self._revisits, self._max_nodes = known, bottom, merge, revisits, max_nodes
        self.count, self.most_arms = 1, 0
        known.check_memory(0, places=self._num_places())
        # By level: nodes that the critic has valued, each as often as edges lead there.
        self._valued = [0] * (bottom + 1)
        most = known.topology.max_bytes // (2 * Sizes(self.num_actions, self.num_outcomes, known.dtype).node)
        room = min(room, most, _ROOM // (self.num_actions * self.num_outcomes)) + 1

        def column(axes: str = "", dtype: torch.dtype | None = None) -> Tensor:
            return self._column(axes, room=room, dtype=dtype)

        self.known_N, self.table_row_N, self.level_N = (column(dtype=torch.int64) for _ in range(3))
        self.visits_NA, self.visits_NAK = column("A", torch.float64), column("AK", torch.float64)
        self.q_NA, self.v_N, self.value_NAK = column("A"), column(), column("AK")
        self.exhausted_NAK, self.exhausted_NA, self.exhausted_N = column("AK"), column("A"), column()
        self.below_NAK = column("AK", torch.int64)
        self.node_at = torch.zeros(self._graph_places() if merge else 0, dtype=torch.int64, device=known.device)

    def add(self, state_N: Int[Tensor, "N"], level: int) -> Int[Tensor, "N"]:
        """Expanded nodes for these states; no edge leads to them yet.

        Raises:
            NodeBudgetExceeded: they would not fit into memory, and the model has not been queried for them; or they are
                too many.
        """
        known, N = self.known, len(state_N)
        known_N = known.rows(state_N, **self._counts(N))
        # Room also for as many outcomes of an action, and for as many states, as are known by now.
        self._reserve(N, known.num_outcomes)
        if self.merge:
            self.node_at = with_room(self.node_at, self._graph_places(), fill=0)
        new = slice(self.count, self.count + N)
        self.count += N
        self.known_N[new], self.level_N[new] = known_N, level
        # A node begins with what is known of its state: the critic's values, and which outcomes have no weight.
        for name, of_state in (
            ("table_row_N", known.table_row_T),
            ("q_NA", known.q_TA),
            ("v_N", known.v_T),
            ("value_NAK", known.value_TAK),
            ("exhausted_NAK", known.exhausted_TAK),
            ("exhausted_NA", known.exhausted_TA),
            ("exhausted_N", known.exhausted_T),
        ):
            torch.index_select(of_state, 0, known_N, out=getattr(self, name)[new])
        # Children at the last level are never expanded; only averages go there, to take their values again.
        if level + 1 == self.bottom and (level == 0 or not self._revisits):
            self.exhausted_N[new], self.exhausted_NA[new] = -torch.inf, -torch.inf
        self._valued[level + 1] += int(known.outcomes_T.index_select(0, known_N).sum())
        if sum(self._valued) > self._max_nodes:
            check_nodes(sum(self.nodes_per_level()), self._max_nodes)
        return torch.arange(new.start, new.stop, device=known.device)

    def add_roots(self, root_B: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """A node for each of these distinct states, at level 0."""
        self._valued[0] = len(root_B)
        node_B = self.add(root_B, 0)
        if self.merge:
            self.node_at[self.place(root_B, 0)] = node_B
        return node_B

    def place(self, state_N: Int[Tensor, "*N"], level: int) -> Int[Tensor, "*N"]:
        """Where in `node_at` the nodes of these states are."""
        return state_N * (self.bottom + 1) + level

    def open(self, node_B: Int[Tensor, "B"]) -> Bool[Tensor, "B A"]:
        """Actions of these nodes below which there is something to expand."""
        return torch.isfinite(self.exhausted_NA.index_select(0, node_B))

    def at_level(self, level: int, among_N: Bool[Tensor, "N"]) -> Int[Tensor, "F"]:
        """Those of some nodes that are at this level."""
        return (among_N & (self.level_N[: self.count] == level)).nonzero().squeeze(1)

    def open_mass(self, node_F_by_level: Sequence[Tensor]) -> Float[Tensor, "B A"]:
        """The most discounted probability that a plan after each action of the roots puts on nodes that could be
        expanded.

        Args:
            node_F_by_level: the roots, and the nodes below them that have nodes below.
        """
        known = self.known
        # mass_N: the same after each node. Above the last level all edges of a node lead to nodes that could be
        # expanded; node 0 is one of these.
        mass_T = known.weight_NAK(torch.arange(known.count, device=self.device)).sum(2).amax(1)
        mass_N = mass_T.index_select(0, self.known_N[: self.count])
        mass_N.masked_fill_(self.level_N[: self.count] + 1 >= self.bottom, 0)
        mass_N[0] = 1
        mass_FA = self.q_NA.new_zeros(len(node_F_by_level[0]), self.num_actions)  # of roots at the last level
        for node_F in reversed(node_F_by_level[:-1]):
            # An action has the mass of its children, a node that of its worst action.
            weight_FAK = known.weight_NAK(self.known_N.index_select(0, node_F))
            mass_FA = (weight_FAK * mass_N.take(self.below_NAK.index_select(0, node_F))).sum(2)
            mass_N[node_F] = mass_FA.amax(1)
        return mass_FA

    def nodes_per_level(self) -> tuple[int, ...]:
        """How many nodes have been valued at each level, by the critic or from below."""
        if self.merge:
            # Children of a level are counted without repetition. Row 0 is no node.
            for level in range(self.bottom):
                known_F = self.known_N[1 : self.count][self.level_N[1 : self.count] == level]
                weighs_FAK = torch.isfinite(self.known.exhausted_TAK[known_F])
                child_FAK = self.known.topology.table.child_RAK[self.known.table_row_T[known_F]]
                self._valued[level + 1] = len(child_FAK[weighs_FAK].unique())
        return tuple(self._valued)

    def _counts(self, rows: int) -> dict[str, int]:
        """What `search_bytes` counts once there are so many more nodes."""
        nodes = max(self.count + rows, int(len(self.known_N) / GROWTH) if self.count > 1 else 0)
        return {"nodes": nodes, "places": self._num_places(), "arms": self.most_arms}

    def _num_places(self) -> int:
        """Entries of the tables by level, by state and by (state, level); the last one is copied as it grows."""
        return self.bottom + 1 + 2 * len(self.known.row_S) + (2 * self._graph_places() if self.merge else 0)

    def _graph_places(self) -> int:
        return len(self.known.row_S) * (self.bottom + 1)
