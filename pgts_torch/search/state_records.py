"""What compiled tree searches know of states: what the model, the critic and the policy say of them."""

import math
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import check_memory
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree_records import NEW, STATE, WANTED
from pgts_torch.seeding import sample_keys


@final
class StateRecords:
    """A record of each state of the model, found out once however often the state occurs in the trees.

    state_S: see `tree_records.STATE`.
    prior_TA: rows of priors; one if they are uniform.
    grown, places: what the trees take, see `search_bytes`; they say so.

    Raises:
        PgtsError, NodeBudgetExceeded: the methods, as `mcts`.
    """

    def __init__(self, leaves: Leaves, topology: Topology, options: MCTS) -> None:
        # Numba is imported with these.
        from pgts_torch.search import state_kernels

        self._kernels: Any = state_kernels
        self._leaves, self._topology, self._table = leaves, topology, topology.table
        self._uniform, self._A = options.prior == "uniform", topology.model.num_actions
        self.state_S = np.empty(0, STATE)
        self.prior_TA = torch.full((int(self._uniform), self._A), 1 / self._A, dtype=torch.float64)
        self.grown = self.places = 0

    @property
    def num_outcomes(self) -> int:
        """K, as far as it is known by now."""
        return self._table.num_outcomes

    @property
    def arrays(self) -> list[Any]:
        """What the kernels read: the columns of the `OutcomeTable`, `state_S`, `prior_TA`."""
        return [*self._outcomes, self.state_S, self.prior_TA.numpy()]

    def preference(self, root_B: Int[Tensor, "B"], generator: torch.Generator | None) -> Float[Tensor, "B A"]:
        """log prior(a) of known states, plus standard Gumbel noise if there is a generator."""
        preference_BA = self.prior_TA[torch.from_numpy(self.state_S["row"][root_B.numpy()])].log()
        if generator is not None:
            key = sample_keys(1, generator=generator).numpy().view(np.uint64)[0]
            self._kernels.add_noise(key, root_B.numpy(), preference_BA.numpy())
        return preference_BA

    def reach(self, root_B: Int[Tensor, "B"], most: int, levels: int) -> None:
        """Learn of these states, and of at most so many that follow within so many levels, as far as their outcomes are
        known: the critic is called at once for what simulations may reach."""
        self.query(root_B)
        wanted_N = torch.empty(max(most, len(root_B)), dtype=torch.int64)
        wanted_N[: len(root_B)] = root_B
        self.state_S["row"][root_B.numpy()] = WANTED
        found = self._kernels.reach(*self._outcomes, self.state_S, wanted_N.numpy()[:most], len(root_B), levels)
        self._learn(wanted_N[:found].sort().values)

    def query(self, state_N: Int[Tensor, "N"]) -> None:
        """Have the outcomes of these states in the table, and room for the states that the model has met by then."""
        missing = self._table.missing(state_N)
        if missing.shape[0]:
            self.check_memory(state_N.shape[0], missing.shape[0])
            self._topology.query(missing)
        more = self._table.row_S.shape[0] - len(self.state_S)
        if more:
            new_S = records((more,), STATE)
            new_S[...] = (math.nan, NEW)
            self.state_S = np.concatenate([self.state_S, new_S])

    def learn(self, state_N: Int[Tensor, "N"]) -> None:
        """The outcomes of these wanted states, the critic's values of their children, and the prior."""
        self.query(state_N)
        self._learn(state_N)

    def _learn(self, state_N: Int[Tensor, "N"]) -> None:
        self.check_memory(state_N.shape[0])
        edges = state_N.shape[0] * self._A * self._table.num_outcomes
        child_C = np.empty(min(edges, len(self.state_S)), np.int64)
        count = self._kernels.children(*self._outcomes, self.state_S, state_N.numpy(), child_C)
        if count:
            child_C = np.sort(child_C[:count])
            self.state_S["v"][child_C] = self._leaves.v(torch.from_numpy(child_C)).numpy(force=True)
        row: Any = 0
        if not self._uniform:
            row = np.arange(len(self.prior_TA), len(self.prior_TA) + len(state_N))
            self.prior_TA = torch.cat([self.prior_TA, self._leaves.prior(state_N).double()])
        self.state_S["row"][state_N.numpy()] = row

    def check_memory(self, looked_up: int = 0, new: int = 0) -> None:
        """NodeBudgetExceeded if a step that looks up so many states, of which so many are new, takes too much."""
        priors = 0 if self._uniform else 2 * self._A * (len(self.prior_TA) + looked_up)
        places = self.places + 2 * max(len(self.state_S), self._topology.model.num_states) + priors
        needed = self._topology.bytes(new, looked_up=looked_up, grown=self.grown, places=places)
        what = f"the search ({self.grown} nodes, {looked_up} states of {self._A} actions)"
        check_memory(needed, self._topology.max_bytes, what)

    @property
    def _outcomes(self) -> list[Any]:
        table = self._table
        columns = table.reward_RA, table.prob_RAK, table.discount_RAK, table.child_RAK, table.row_S
        return [column.numpy() for column in columns]


def records(shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    """An array of these, anything in them."""
    return torch.empty(math.prod(shape) * kind.itemsize, dtype=torch.uint8).numpy().view(kind).reshape(shape)
