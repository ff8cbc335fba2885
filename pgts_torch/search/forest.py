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
from pgts_torch.search.state_records import StateRecords, records
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree_records import ARM, EDGE, LANE, NODE, SLOT, STEP

_ROOM = 2**20
"""The most edges for which there is room at first, if there is more than one tree."""

_RULES: Sequence[Rule] = "gumbel", "puct", "uct"
"""As the kernels number them."""

_TOO_MANY, _FULL, _UNKNOWN = -1, -2, -3
"""What the kernels return where there are more nodes than are allowed, or than there is room for; a graph also where a
state is unknown."""


@final
class Forest:
    """The trees below distinct roots; with `merge` the one graph below all of them.

    Where a search does not know a state, all roots go on as far as they come; then the model and the critic are called
    for all such states together. Values are float64, whatever the dtype of the model.

    Args:
        leaves, topology, options: of the search, with simulations one after another.
        root_B: distinct states, ascending.

    Raises:
        PgtsError, NodeBudgetExceeded: as `mcts`.
    """

    def __init__(self, leaves: Leaves, topology: Topology, options: MCTS, root_B: Int[Tensor, "B"]) -> None:
        self._options, self._root_B, self._A, self._bottom = (
            options,
            root_B,
            topology.model.num_actions,
            leaves.expansions,
        )
        B, bottom = len(root_B), self._bottom
        most = min(topology.model.num_states, B * options.simulations)
        self._known = known = StateRecords(leaves, topology, options)
        known.places = bottom + B * (7 * self._A + 9) + most
        known.places_of_state = (bottom + 1) * options.merges
        known.check_memory()
        # Each of the simulations that are under way, one of each action, may want a state.
        self._wanted_N = torch.empty(max(most, B * self._A), dtype=torch.int64)
        self._valued_L = torch.zeros(bottom + 2, dtype=torch.int64)
        self._valued_L[0] = self._valued_L[-1] = B
        known.reach(root_B, most, min(bottom, options.simulations) - 1)
        self._nodes: list[Any] = []
        self._make_room()
        slots = B if options.merges else len(self._nodes[0])
        self._slots = [np.full((slots,), -1, SLOT), np.zeros((slots, self._A), LANE)]

    @property
    def nodes_per_level(self) -> tuple[int, ...]:
        """How many nodes critic or table have valued at each level."""
        return tuple(self._valued_L[:-1].tolist())

    def search(self, generator: torch.Generator | None) -> tuple[Float[Tensor, "B A"], Float[Tensor, "B A"]]:
        """All simulations; q and `Lookahead.pruned_BA` of the roots.

        Args:
            generator: of the noise in sequential halving.
        """
        known, merges, kernels = self._known, self._options.merges, self._kernels()
        preference_BA = known.preference(self._root_B, generator)
        found = torch.full((2, *preference_BA.shape), torch.inf, dtype=torch.float64)
        roots = [x.numpy() for x in (self._root_B, preference_BA, *found, self._wanted_N)]
        valued_L = self._valued_L.numpy()
        turn, scratch = np.zeros(5, np.int64), [np.empty(self._A), np.empty(self._A, np.int64)]
        graph = [np.empty(0, np.int32), np.empty(self._bottom, STEP)] if merges else []
        while True:
            room = self._nodes[0].shape[1]
            if merges:
                missing = len(known.state_S) * (self._bottom + 1) - len(graph[0])
                graph[0] = np.concatenate([graph[0], np.zeros(missing, np.int32)])
            nodes, mass_N = [x.reshape(-1, *x.shape[2:]) for x in self._nodes], np.empty(room)
            rest = (*nodes, *self._slots, self._rules(room), *roots, turn, valued_L, mass_N, *scratch, *graph)
            count = kernels.search(*known.arrays, *rest)
            if count == _UNKNOWN:
                count = _run_ahead(kernels, known.arrays, rest, turn, [*(x[: turn[0]] for x in nodes), *self._slots])
            if count == _TOO_MANY:
                check_nodes(int(self._valued_L[-1]), self._options.max_nodes)
            if count == 0:
                return found[0], found[1]
            if count > 0:
                known.learn(self._wanted_N[:count].sort().values)
            if count == _FULL or known.num_outcomes > self._nodes[2].shape[3]:
                self._make_room(full=count == _FULL)

    def _make_room(self, *, full: bool = False) -> None:
        """Room for nodes, and what is in them already: there are more of them, or more outcomes of an action."""
        known, before, simulations = self._known, self._nodes, self._options.simulations
        A, K, B, levels = self._A, known.num_outcomes, len(self._root_B), self._bottom - 1
        if not self._options.merges:
            room = int(min(simulations, tree_nodes(1, A * K, levels)))
            trees = len(before[0]) if before else min(B, max(1, _ROOM // (room * A * K)))
        elif before:
            trees, room = 1, int((GROWTH if full else 1) * before[0].shape[1]) + 1
        else:
            trees, room = 1, max(B, min(B * simulations, B + levels * len(known.state_S), _ROOM // (A * K)))
        known.grown = trees * room
        known.check_memory()
        shapes = (trees, room), (trees, room, A), (trees, room, A, K)
        self._nodes = [records(shape, kind) for shape, kind in zip(shapes, (NODE, ARM, EDGE), strict=True)]
        for old, new in zip(before, self._nodes, strict=False):
            rows = new[:, : old.shape[1]]
            if new.ndim == 4:
                rows[...] = (0.0, 0.0, -1.0, 0, 0)  # outcomes beyond those that there were have no weight
                rows = rows[..., : old.shape[3]]
            rows[...] = old

    def _kernels(self) -> Any:
        # Numba is imported with these.
        if self._options.merges:
            from pgts_torch.search import graph_kernels

            return graph_kernels
        from pgts_torch.search import tree_kernels

        return tree_kernels

    def _rules(self, room: int) -> Any:
        """The options as the kernels read them."""
        from pgts_torch.search.node_kernels import Rules

        options = self._options
        return Rules(
            room,
            self._bottom,
            options.simulations,
            halves=options.root == "gumbel",
            rule=_RULES.index(options.rule),
            exploration=1.25 if options.exploration is None else options.exploration,
            mean=options.backup == "mean",
            max_nodes=options.max_nodes,
        )


def _run_ahead(kernels: Any, known: Sequence[Any], rest: Sequence[Any], turn: np.ndarray, grown: Sequence[Any]) -> int:
    """How many states the simulations of a round may want; what has grown meanwhile is taken back."""
    before = [x.copy() for x in grown]
    turn[-1] = 1
    count: int = kernels.search(*known, *rest)
    turn[-1] = 0
    for x, old in zip(grown, before, strict=True):
        x[...] = old
    return count
