"""The nodes of many search trees in one set of tables, and the memory that these take."""

from typing import final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import NodeBudgetExceeded
from pgts_torch.search.known import KnownStates, longer, widened
from pgts_torch.search.memory import GROWTH, Sizes

_ROOM = 2**22
"""The most edges for which there is room before they are needed."""


@final
class Nodes:
    """The N nodes that have been expanded, of all roots, each with A actions and E = A * K edges, its outcomes.

    Row 0 is no node: an edge leads there as long as its child is not expanded.

    known_N: the row of the node's state in `KnownStates`.
    table_row_N: that in the table of the topology, where the outcomes are.
    level_N: 0 for roots.
    visits_NA, visits_NE: how many simulations took the action, and the outcome; in a graph shares of simulations.
    q_NA, v_N: backed up values.
    value_NE: what q is backed up from: the critic's value of the child, or v of its node.
    exhausted_outcome_NE, exhausted_action_NA, exhausted_N: -inf where nothing below is left to expand, else 0.
    below_NE: the node of the child, or 0. In a graph it is up to date only when the node has just been backed up.
    node_at: in a graph the node of a (state, level), or 0, see `place`; in trees empty.
    count: how many rows are filled.

    Args:
        known: what is known of states.
        bottom: nodes at this level are never expanded.
        merge: whether the nodes are a graph: one for each (state, level), whatever the path (Czech et al. 2021).
        revisits: whether a node may be passed though nothing below it is left to expand, as for averages.
        max_nodes: the most nodes, see `Lookahead.nodes_per_level`.
        room: for how many nodes there is room at first.
    """

    def __init__(
        self, known: KnownStates, bottom: int, *, merge: bool, revisits: bool, max_nodes: int, room: int
    ) -> None:
        self.known, self.bottom, self.merge, self._revisits, self._max_nodes = known, bottom, merge, revisits, max_nodes
        self.A, self.K, self.count = known.num_actions, known.num_outcomes, 1
        self.most_arms = 0
        """The most (node, action) that a wave has passed on one level."""
        known.check_memory(0, places=self._num_places())
        self._valued = [0] * (
            bottom + 1
        )  # by level: nodes that the critic has valued, each as often as edges lead there
        most = known.topology.max_bytes // (2 * Sizes(self.A, self.K, known.dtype).node)
        room = min(room, most, _ROOM // (self.A * self.K)) + 1

        def table(*shape: int, dtype: torch.dtype = known.dtype) -> Tensor:
            return torch.zeros(shape, dtype=dtype, device=known.device)

        A, E = self.A, self.A * self.K
        self.known_N, self.table_row_N, self.level_N = (table(room, dtype=torch.int64) for _ in range(3))
        self.visits_NA, self.visits_NE = table(room, A, dtype=torch.float64), table(room, E, dtype=torch.float64)
        self.q_NA, self.v_N, self.value_NE = table(room, A), table(room), table(room, E)
        self.exhausted_action_NA, self.exhausted_N = table(room, A), table(room)
        self.exhausted_outcome_NE, self.below_NE = table(room, E), table(room, E, dtype=torch.int64)
        self.node_at = table(self._graph_places() if merge else 0, dtype=torch.int64)

    def add(self, state_N: Int[Tensor, "N"], level: int) -> Int[Tensor, "N"]:
        """Expanded nodes for these states; no edge leads to them yet.

        Raises:
            NodeBudgetExceeded: they would not fit into memory, and the model has not been queried for them; or they are
                too many.
        """
        known, N = self.known, len(state_N)
        known_N = known.rows(state_N, **self._counts(N))
        self._reserve(N)
        new = slice(self.count, self.count + N)
        self.count += N
        self.known_N[new], self.level_N[new] = known_N, level
        # A node begins with what is known of its state: the critic's values, and which outcomes have no weight.
        for name, of_state in (
            ("table_row_N", known.table_row_T),
            ("q_NA", known.q_TA),
            ("v_N", known.v_T),
            ("value_NE", known.value_TE),
            ("exhausted_outcome_NE", known.exhausted_outcome_TE),
            ("exhausted_action_NA", known.exhausted_action_TA),
            ("exhausted_N", known.exhausted_T),
        ):
            torch.index_select(of_state, 0, known_N, out=getattr(self, name)[new])
        if level + 1 == self.bottom and (level == 0 or not self._revisits):
            self.exhausted_N[new], self.exhausted_action_NA[new] = -torch.inf, -torch.inf
        self._valued[level + 1] += int(known.outcomes_T.index_select(0, known_N).sum())
        nodes = sum(self._valued)
        if nodes > self._max_nodes and (nodes := sum(self.nodes_per_level())) > self._max_nodes:
            raise NodeBudgetExceeded(
                f"the search has {nodes} nodes; max_nodes is {self._max_nodes}: "
                "lower the simulations, search from fewer roots or raise the budget"
            )
        return torch.arange(new.start, new.stop, device=known.device)

    def add_roots(self, root_B: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """A node for each of these distinct states, at level 0."""
        self._valued[0] = len(root_B)
        node_B = self.add(root_B, 0)
        if self.merge:
            self.node_at[self.place(root_B, 0)] = node_B
        return node_B

    def place(self, state_N: Int[Tensor, "*N"], level: int) -> Int[Tensor, "*N"]:
        """Where in `node_at` the nodes of these states stand."""
        return state_N * (self.bottom + 1) + level

    def nodes_per_level(self) -> tuple[int, ...]:
        """How many nodes have been valued at each level, by the critic or by a look below."""
        if self.merge:  # then the children of a level are counted without repetition
            for level in range(self.bottom):
                known_F = self.known_N[1 : self.count][self.level_N[1 : self.count] == level]
                weighs_FE = torch.isfinite(self.known.exhausted_outcome_TE[known_F])
                child_FAK = self.known.topology.table.child_RAK[self.known.table_row_T[known_F]]
                self._valued[level + 1] = len(child_FAK.flatten(1)[weighs_FE].unique())
        return tuple(self._valued)

    def _reserve(self, rows: int) -> None:
        """Room for so many more nodes, for as many outcomes of an action and for as many states as are known by now."""
        if (K := self.known.num_outcomes) > self.K:
            for name in ("visits_NE", "value_NE", "exhausted_outcome_NE", "below_NE"):
                fill = -torch.inf if name.startswith("exhausted") else 0
                setattr(self, name, widened(getattr(self, name), self.K, K, fill))
            self.K = K
        if self.merge and self._graph_places() > len(self.node_at):
            self.node_at = longer(self.node_at, self._graph_places())
        if self.count + rows > len(self.known_N):
            for name, table in vars(self).items():
                if name.endswith(("_N", "_NA", "_NE")):
                    setattr(self, name, longer(table, max(self.count + rows, int(GROWTH * len(table)))))

    def _counts(self, rows: int) -> dict[str, int]:
        """What `search_bytes` counts once there are so many more nodes."""
        nodes = max(self.count + rows, int(len(self.known_N) / GROWTH) if self.count > 1 else 0)
        return {"nodes": nodes, "places": self._num_places(), "arms": self.most_arms}

    def _num_places(self) -> int:
        """Entries of the tables by level, by state and by (state, level); the last one is copied as it grows."""
        return self.bottom + 1 + 2 * len(self.known.row_S) + (2 * self._graph_places() if self.merge else 0)

    def _graph_places(self) -> int:
        return len(self.known.row_S) * (self.bottom + 1)
