"""Search trees that compiled loops grow (`tree_kernels`), and the memory that they take."""

import math
from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import check_nodes, tree_nodes
from pgts_torch.search.split import Rule
from pgts_torch.search.state_records import StateRecords, records
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree_records import ARM, EDGE, LANE, NODE, SLOT

_ROOM = 2**20
"""The most edges of all trees that grow side by side, if there is more than one tree."""

_RULES: Sequence[Rule] = "gumbel", "puct", "uct"
"""As the kernels number them."""


@final
class Forest:
    """The trees below distinct roots.

    Where a search does not know a state, all roots go on as far as they come; then the model and the critic are called
    for all such states together. Values are float64, whatever the dtype of the model.

    Args:
        leaves, topology, options: of the search, with simulations one after another in trees that are not merged.
        root_B: distinct states, ascending.

    Raises:
        PgtsError, NodeBudgetExceeded: as `mcts`.
    """

    def __init__(self, leaves: Leaves, topology: Topology, options: MCTS, root_B: Int[Tensor, "B"]) -> None:
        from pgts_torch.search import tree_kernels

        self._kernels: Any = tree_kernels
        self._options, self._root_B, self._A = options, root_B, topology.model.num_actions
        self._bottom = leaves.expansions
        self._trees: Any = None
        B, bottom = len(root_B), self._bottom
        most = min(topology.model.num_states, B * options.simulations)
        self._known = known = StateRecords(leaves, topology, options)
        known.places = bottom + B * (5 * self._A + 4) + most
        known.check_memory()
        # Each of the simulations that are under way, one of each action, may want a state.
        self._wanted_N = torch.empty(max(most, B * self._A), dtype=torch.int64)
        self._valued_L = torch.zeros(bottom + 2, dtype=torch.int64)
        self._valued_L[0] = self._valued_L[-1] = B
        known.reach(root_B, most, min(bottom, options.simulations) - 1)
        self._make_trees()

    @property
    def nodes_per_level(self) -> tuple[int, ...]:
        """How many nodes critic or table have valued at each level."""
        return tuple(self._valued_L[:-1].tolist())

    def search(self, generator: torch.Generator | None) -> tuple[Float[Tensor, "B A"], Float[Tensor, "B A"]]:
        """All simulations; q and `Lookahead.pruned_BA` of the roots.

        Args:
            generator: of the noise in sequential halving.
        """
        B, A = self._root_B.shape[0], self._A
        preference_BA = self._known.preference(self._root_B, generator)
        found = torch.full((2, B, A), torch.inf, dtype=torch.float64)
        begun, scratch = np.zeros(1, np.int64), (np.empty(A), np.empty(A, np.int64))
        given = [x.numpy() for x in (self._root_B, preference_BA, *found, self._wanted_N)]
        while True:
            count = self._kernels.search(
                *(*self._known.arrays, *self._trees, self._rules, *given, begun),
                *(self._valued_L.numpy(), np.empty(self._rules.room), *scratch),
            )
            if count < 0:
                check_nodes(int(self._valued_L[-1]), self._options.max_nodes)
            if count <= 0:
                return found[0], found[1]
            self._known.learn(self._wanted_N[:count].sort().values)
            if self._known.num_outcomes > self._trees[2].shape[2]:
                self._make_trees()

    def _make_trees(self) -> None:
        """Room for the trees, and what is in them already: outcomes of an action may have become more."""
        options, A, B, K, before = self._options, self._A, len(self._root_B), self._known.num_outcomes, self._trees
        bottom = self._bottom
        room = int(min(options.simulations, tree_nodes(1, A * K, bottom - 1)))
        W = min(B, max(1, _ROOM // (room * A * K))) if before is None else len(before[3])
        self._known.grown = W * room
        self._known.check_memory()
        shapes = (W * room,), (W * room, A), (W * room, A, K), (W,), (W, A)
        kinds = NODE, ARM, EDGE, SLOT, LANE
        self._trees = [records(shape, kind) for shape, kind in zip(shapes, kinds, strict=True)]
        if before is None:
            self._trees[3]["root"] = -1
        else:
            for old, new in zip(before, self._trees, strict=True):
                rows = new.reshape(W, -1, *new.shape[1:])[:, : len(old) // W]
                if new.ndim == 3:
                    rows[...] = (0.0, 0.0, -1.0, 0, 0)  # outcomes beyond those that there were have no weight
                    rows = rows[..., : old.shape[2]]
                rows[...] = old.reshape(W, -1, *old.shape[1:])
        phases = 0 if options.root == "rule" else max(1, math.ceil(math.log2(A)))
        exploration = 1.25 if options.exploration is None else options.exploration
        self._rules = self._kernels.Rules(
            room,
            bottom,
            options.simulations,
            phases,
            _RULES.index(options.rule),
            exploration,
            options.backup == "mean",
            options.max_nodes,
        )
