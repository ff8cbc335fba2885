"""Search trees that compiled loops grow (`tree_kernels`): their memory, and what the model and the critic say."""

import math
from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import check_memory, check_nodes, tree_nodes
from pgts_torch.search.split import Rule
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree_records import ARM, EDGE, LANE, NEW, NODE, SLOT, STATE, WANTED
from pgts_torch.seeding import sample_keys

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
        # Numba is imported with these.
        from pgts_torch.search import state_kernels, tree_kernels

        self._tree_kernels: Any = tree_kernels
        self._state_kernels: Any = state_kernels
        self._leaves, self._topology, self._options = leaves, topology, options
        self._root_B, self._table, self._A = root_B, topology.table, topology.model.num_actions
        self._trees: Any = None
        self._nodes = 0  # of the trees, for which there is room
        num_states, B, bottom = topology.model.num_states, len(root_B), leaves.expansions
        most = min(num_states, B * options.simulations)
        self._places = bottom + B * (5 * self._A + 4) + most
        self._state_S = np.empty(0, STATE)
        # One row if priors are uniform.
        self._prior_TA = torch.full((int(options.prior == "uniform"), self._A), 1 / self._A, dtype=torch.float64)
        self._check_memory(0)
        # Each of the simulations that are under way, one of each action, may want a state.
        self._wanted_N = torch.empty(max(most, B * self._A), dtype=torch.int64)
        self._valued_L = torch.zeros(bottom + 2, dtype=torch.int64)
        self._valued_L[0] = self._valued_L[-1] = B
        self._query(root_B)
        # The critic is called at once for what simulations may reach, as far as the outcomes are known.
        self._wanted_N[:B] = root_B
        self._state_S["row"][root_B.numpy()] = WANTED
        wanted_N, levels = self._wanted_N.numpy()[:most], min(bottom, options.simulations) - 1
        reached = self._state_kernels.reach(*self._outcomes, self._state_S, wanted_N, B, levels)
        self._learn(self._wanted_N[:reached].sort().values)
        self._make_trees()

    def preference(self, generator: torch.Generator | None) -> Float[Tensor, "B A"]:
        """log prior(a) of the roots, plus standard Gumbel noise if there is a generator."""
        preference_BA = self._prior_TA[torch.from_numpy(self._state_S["row"][self._root_B.numpy()])].log()
        if generator is not None:
            key = sample_keys(1, generator=generator).numpy().view(np.uint64)[0]
            self._state_kernels.add_noise(key, self._root_B.numpy(), preference_BA.numpy())
        return preference_BA

    @property
    def nodes_per_level(self) -> tuple[int, ...]:
        """How many nodes critic or table have valued at each level."""
        return tuple(self._valued_L[:-1].tolist())

    def search(self, preference_BA: Float[Tensor, "B A"]) -> tuple[Float[Tensor, "B A"], Float[Tensor, "B A"]]:
        """All simulations; q and `Lookahead.pruned_BA` of the roots.

        Args:
            preference_BA: what is added to sigma(q) in sequential halving.
        """
        options = self._options
        B, A = self._root_B.shape[0], self._A
        found = torch.full((2, B, A), torch.inf, dtype=torch.float64)
        begun, scratch = np.zeros(1, np.int64), (np.empty(A), np.empty(A, np.int64))
        given = [x.numpy() for x in (self._root_B, preference_BA.double(), *found, self._wanted_N)]
        while True:
            count = self._tree_kernels.search(
                *(*self._outcomes, self._state_S, self._prior_TA.numpy(), *self._trees, self._rules),
                *(*given, begun, self._valued_L.numpy(), np.empty(self._rules.room), *scratch),
            )
            if count < 0:
                check_nodes(int(self._valued_L[-1]), options.max_nodes)
            if count <= 0:
                return found[0], found[1]
            state_N = self._wanted_N[:count].sort().values
            self._query(state_N)
            self._learn(state_N)
            if self._table.num_outcomes > self._trees[2].shape[2]:
                self._make_trees()

    # What is known

    def _query(self, state_N: Int[Tensor, "N"]) -> None:
        """Have the outcomes of these states in the table, and room for the states that the model has met by then."""
        missing = self._table.missing(state_N)
        if len(missing):
            self._check_memory(len(state_N), len(missing))
            self._topology.step(missing)
        more = len(self._table.row_S) - len(self._state_S)
        if more:
            new_S = _records((more,), STATE)
            new_S[...] = (math.nan, NEW)
            self._state_S = np.concatenate([self._state_S, new_S])

    def _learn(self, state_N: Int[Tensor, "N"]) -> None:
        """The critic's values of the children of these states, and the prior."""
        self._check_memory(len(state_N))
        edges = len(state_N) * self._A * self._table.num_outcomes
        child_C = torch.empty(min(edges, len(self._state_S)), dtype=torch.int64)
        count = self._state_kernels.children(*self._outcomes, self._state_S, state_N.numpy(), child_C.numpy())
        if count:
            child_C = child_C[:count].sort().values
            self._state_S["v"][child_C.numpy()] = self._leaves.v(child_C).numpy(force=True)
        row: Any = 0
        if self._options.prior == "policy":
            row = np.arange(len(self._prior_TA), len(self._prior_TA) + len(state_N))
            self._prior_TA = torch.cat([self._prior_TA, self._leaves.prior(state_N).double()])
        self._state_S["row"][state_N.numpy()] = row

    @property
    def _outcomes(self) -> Any:
        table = self._table
        columns = table.reward_RA, table.prob_RAK, table.discount_RAK, table.child_RAK, table.row_S
        return [column.numpy() for column in columns]

    # Trees

    def _make_trees(self) -> None:
        """Room for the trees, and what is in them already: outcomes of an action may have become more."""
        options, A, B, K, before = self._options, self._A, len(self._root_B), self._table.num_outcomes, self._trees
        bottom = self._leaves.expansions
        room = int(min(options.simulations, tree_nodes(1, A * K, bottom - 1)))
        W = min(B, max(1, _ROOM // (room * A * K))) if before is None else len(before[3])
        self._nodes = W * room
        self._check_memory(0)
        shapes = (W * room,), (W * room, A), (W * room, A, K), (W,), (W, A)
        kinds = NODE, ARM, EDGE, SLOT, LANE
        self._trees = [_records(shape, kind) for shape, kind in zip(shapes, kinds, strict=True)]
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
        self._rules = self._tree_kernels.Rules(
            room,
            bottom,
            options.simulations,
            phases,
            _RULES.index(options.rule),
            exploration,
            options.backup == "mean",
            options.max_nodes,
        )

    def _check_memory(self, looked_up: int, new: int = 0) -> None:
        """NodeBudgetExceeded if a step that looks up so many states, of which so many are new, takes too much."""
        priors = 0 if self._options.prior == "uniform" else 2 * self._A * (len(self._prior_TA) + looked_up)
        places = self._places + 2 * max(len(self._state_S), self._topology.model.num_states) + priors
        needed = self._topology.bytes(new, looked_up=looked_up, grown=self._nodes, places=places)
        what = f"the search ({self._nodes} nodes, {looked_up} states of {self._A} actions)"
        check_memory(needed, self._topology.max_bytes, what)


def _records(shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    """An array of these, anything in them."""
    return torch.empty(math.prod(shape) * kind.itemsize, dtype=torch.uint8).numpy().view(kind).reshape(shape)
