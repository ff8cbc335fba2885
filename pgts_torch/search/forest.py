"""Search trees that compiled loops grow, or, merged, a graph (`tree_kernels`, `graph_kernels`), and their memory."""

from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import GROWTH, check_nodes, tree_nodes
from pgts_torch.search.split import Rule
from pgts_torch.search.state_records import NOTHING, StateRecords, records
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree_records import (
    ARM,
    EDGE,
    FULL,
    LANE,
    NODE,
    NOT_FINITE,
    SLOT,
    STEP,
    TOO_MANY,
    UNKNOWN,
    as_bytes,
)

_ROOM = 2**20
"""The most edges for which there is room at first, if there is more than one tree."""

_RULES: Sequence[Rule] = "gumbel", "puct", "uct"
"""As the kernels number them."""


_INT, _FLOAT = np.dtype(np.int64), np.dtype(np.float64)


@final
class Forest:
    """The trees below distinct roots; with `merge` the one graph below all of them.

    num_bytes: what it takes between searches.

    Where a search does not know a state, all roots go on as far as they come; then the model and the critic are called
    for all such states together. Values are float64, whatever the dtype of the model.

    What does not change from one search to the next is made once: searches with the same options below as many roots
    take turns in one memory.

    Args:
        topology, options: of the searches, with simulations one after another.
        bottom: nodes at this level are never expanded.
        num_roots: B.

    Raises:
        PgtsError, NodeBudgetExceeded: as `mcts`.
    """

    def __init__(self, topology: Topology, options: MCTS, bottom: int, num_roots: int) -> None:
        A, num_states = topology.model.num_actions, topology.model.num_states
        self._options, self._bottom, self._B, self._A = options, bottom, num_roots, A
        self._num_states, self._levels = num_states, min(bottom, options.simulations) - 1
        most = min(num_states, num_roots * options.simulations)
        # Each of the simulations that are under way, one of each action, may want a state.
        wanted = max(most, num_roots * A)
        self._known = StateRecords(
            topology,
            options,
            places=bottom + num_roots * (8 * A + 9) + wanted,
            places_of_state=(bottom + 1) * options.merges,
        )
        self._known.check_memory()
        self._wanted_N, self._first_N = (wanted_N := records((wanted,), _INT)), wanted_N[:most]
        self._valued_L, self._turn = np.zeros(bottom + 2, np.int64), np.zeros(6, np.int64)
        self._preference_BA = records((num_roots, A), _FLOAT)
        self._scratch = [np.empty(A), np.empty(A, np.int64)]
        self._kernels = _kernels(options)
        self._nodes: list[Any] = []
        self._slots: list[Any] = []
        self._rows: list[Any] = []
        self._rules: Any = None
        self.num_bytes = 0

    def serves(self, options: MCTS, bottom: int, num_roots: int, num_states: int) -> bool:
        """Whether such a search can be made in it."""
        same = options is self._options or options == self._options
        return same and (bottom, num_roots, num_states) == (self._bottom, self._B, self._num_states)

    def search(
        self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator | None
    ) -> tuple[Float[Tensor, "B A"], Float[Tensor, "B A"], tuple[int, ...]]:
        """All simulations; q and `Lookahead.pruned_BA` of the roots, and how many nodes critic or table have valued at
        each level.

        Args:
            root_B: distinct states.
            generator: of the noise in sequential halving.
        """
        known, turn, valued_L, wanted_N = self._known, self._turn, self._valued_L, self._wanted_N
        roots = root_B.numpy()
        if not self._nodes:
            known.query(root_B)  # which tells how many outcomes there are
            self._make_room()
        of_search = self._slots[0], turn, valued_L, self._preference_BA
        learned = known.begin(leaves, roots, self._levels, self._first_N, of_search, generator)
        q_BA, pruned_BA = np.empty((self._B, self._A)), np.empty((self._B, self._A))
        found = roots, self._preference_BA, q_BA, pruned_BA, wanted_N, turn, valued_L
        graph: list[np.ndarray] = [np.empty(0, np.int32), np.empty(self._bottom, STEP)] if self._options.merges else []
        while True:
            if known.num_outcomes > self._nodes[2].shape[3]:
                self._make_room()
            missing = len(known.state_S) * (self._bottom + 1) - len(graph[0]) if graph else 0
            if missing:
                graph[0] = np.concatenate([graph[0], np.zeros(missing, np.int32)])
            *rows, mass_N = self._rows
            rest = *rows, *self._slots, self._rules, *found, mass_N, *self._scratch
            count = self._kernels.search(*known.arrays, *rest, *learned.arrays, *graph)
            if count == 0:
                return torch.from_numpy(q_BA), torch.from_numpy(pruned_BA), tuple(valued_L[:-1].tolist())
            if count == NOT_FINITE:
                learned.refuse(leaves)
            if count == UNKNOWN:
                count = self._run_ahead((*rest, *NOTHING.arrays, *graph))
            if count == TOO_MANY:
                check_nodes(int(valued_L[-1]), self._options.max_nodes)
            if count == FULL:
                self._make_room(full=True)
            learned = known.learn(leaves, np.sort(wanted_N[:count])) if count > 0 else NOTHING

    def _make_room(self, *, full: bool = False) -> None:
        """Room for nodes, and what is in them already: there are more of them, or more outcomes of an action."""
        known, before, options = self._known, self._nodes, self._options
        A, K, B, levels = self._A, known.num_outcomes, self._B, self._bottom - 1
        if not options.merges:
            room = int(min(options.simulations, tree_nodes(1, A * K, levels)))
            trees = len(before[0]) if before else min(B, max(1, _ROOM // (room * A * K)))
        elif before:
            trees, room = 1, int((GROWTH if full else 1) * before[0].shape[1]) + 1
        else:
            most = min(B * options.simulations, B + levels * known.num_states, _ROOM // (A * K))
            trees, room = 1, max(B, most)
        known.grown = trees * room
        known.check_memory()
        shapes = (trees, room), (trees, room, A), (trees, room, A, K)
        self._nodes = [records(shape, kind) for shape, kind in zip(shapes, (NODE, ARM, EDGE), strict=True)]
        for old, new in zip(before, self._nodes, strict=False):
            rows = new[:, : old.shape[1]]
            if new.ndim == 4:
                as_bytes(rows)[...] = 0
                rows["prob"] = -1.0  # outcomes beyond those that there were have no weight
                rows = rows[..., : old.shape[3]]
            as_bytes(rows)[...] = as_bytes(old)
        self._rows = [*(x.reshape(-1, *x.shape[2:]) for x in self._nodes), records((room,), _FLOAT)]
        if not self._slots:
            slots = B if options.merges else trees
            self._slots = [np.empty(slots, SLOT), np.empty((slots, A), LANE)]
        arrays = *self._rows, *self._slots, self._wanted_N, self._preference_BA
        self.num_bytes = known.num_bytes + sum(x.nbytes for x in arrays)
        from pgts_torch.search.node_kernels import Rules

        self._rules = Rules(
            room,
            self._bottom,
            options.simulations,
            halves=options.root == "gumbel",
            rule=_RULES.index(options.rule),
            exploration=1.25 if options.exploration is None else options.exploration,
            mean=options.backup == "mean",
            uniform=options.prior == "uniform",
            max_nodes=options.max_nodes,
        )

    def _run_ahead(self, rest: Sequence[Any]) -> int:
        """How many states the simulations of a round may want; what has grown meanwhile is taken back."""
        grown = [*(x[: self._turn[0]] for x in self._rows[:3]), *self._slots, rest[-1]]
        before = [as_bytes(x).copy() for x in grown]
        self._turn[4] = 1
        count: int = self._kernels.search(*self._known.arrays, *rest)
        self._turn[4] = 0
        for x, old in zip(grown, before, strict=True):
            as_bytes(x)[...] = old
        return count


def _kernels(options: MCTS) -> Any:
    # Numba is imported with these.
    if options.merges:
        from pgts_torch.search import graph_kernels

        return graph_kernels
    from pgts_torch.search import tree_kernels

    return tree_kernels
