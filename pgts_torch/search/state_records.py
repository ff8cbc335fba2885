"""What compiled tree searches know of states: what the model, the critic and the policy say of them."""

import functools
import math
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.known import prior_of_allowed
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import check_memory
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree_records import NEW, STATE
from pgts_torch.seeding import sample_keys

_UNKNOWN = np.array([(math.nan, NEW)], STATE)

_NO_VALUES = np.empty(0)

_SMALL = 2**16
"""So many bytes are not worth an allocation by torch, whose memory is counted."""


@functools.cache
def _log(x: float) -> float:
    """As torch has it."""
    return float(torch.tensor(x, dtype=torch.float64).log())


@final
class StateRecords:
    """A record of each state of the model, found out once however often the state occurs in the trees.

    state_S: see `tree_records.STATE`.
    prior_TA: rows of priors; one if they are uniform.
    grown, places, places_of_state: what the trees take, see `search_bytes`, and of that for each state; they say so.

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
        self.prior_TA = np.full((int(self._uniform), self._A), 1 / self._A)
        self.grown = self.places = self.places_of_state = 0

    @property
    def num_outcomes(self) -> int:
        """K, as far as it is known by now."""
        return self._table.num_outcomes

    @property
    def arrays(self) -> list[Any]:
        """What the kernels read: the columns of the `OutcomeTable`, `state_S`, `prior_TA`."""
        return [*self._table.arrays, self.state_S, self.prior_TA]

    def preference(self, root_B: Int[Tensor, "B"], generator: torch.Generator | None) -> Float[Tensor, "B A"]:
        """log prior(a) of known states, plus standard Gumbel noise if there is a generator."""
        if self._uniform:
            preference_BA = torch.from_numpy(np.full((root_B.shape[0], self._A), _log(1 / self._A)))
        else:
            preference_BA = torch.from_numpy(self.prior_TA[self.state_S["row"][root_B.numpy()]]).log()
        if generator is not None:
            key = sample_keys(1, generator=generator).numpy().view(np.uint64)[0]
            self._kernels.add_noise(key, root_B.numpy(), preference_BA.numpy())
        return preference_BA

    def reach(self, root_B: Int[Tensor, "B"], most: int, levels: int) -> None:
        """Learn of these states, and of at most so many that follow within so many levels, as far as their outcomes are
        known: the critic is called at once for what simulations may reach."""
        self.query(root_B)
        wanted_N = np.empty(most, np.int64)
        found = self._kernels.begin(*self._table.arrays, self.state_S, root_B.numpy(), levels, wanted_N)
        self._learn(wanted_N[:found])

    def query(self, state_N: Int[Tensor, "N"]) -> None:
        """Have the outcomes of these states in the table, and room for the states that the model has met by then."""
        table = self._table
        has_room = table.row_S.shape[0] >= self._topology.model.num_states
        if not (has_room and self._kernels.has_rows(table.arrays[-1], state_N.numpy())):
            missing = table.missing(state_N)
            if missing.shape[0]:
                self.check_memory(state_N.shape[0], missing.shape[0])
                self._topology.query(missing)
        more = table.row_S.shape[0] - len(self.state_S)
        if more:
            new_S = _UNKNOWN.repeat(more)
            self.state_S = np.concatenate([self.state_S, new_S]) if len(self.state_S) else new_S

    def learn(self, state_N: Int[Tensor, "N"]) -> None:
        """The outcomes of these wanted states, the critic's values of their children, and the prior."""
        self.query(state_N)
        self._learn(state_N.numpy())

    def _learn(self, state_N: Int[np.ndarray, "N"]) -> None:
        self.check_memory(len(state_N))
        edges = len(state_N) * self._A * self._table.num_outcomes
        child_C = np.empty(min(edges, len(self.state_S)), np.int64)
        count = self._kernels.children(*self._table.arrays, self.state_S, state_N, child_C)
        child_C, row, step, v_C = child_C[:count], 0, 0, _NO_VALUES
        if count:
            v_C = self._leaves.v(torch.from_numpy(child_C)).numpy(force=True)
        if not self._uniform:
            row, step = len(self.prior_TA), 1
            states = torch.from_numpy(state_N)
            prior_NA = prior_of_allowed(
                self._leaves.prior(states), self._table.reward_RA[self._table.row_S[states]], states
            )
            self.prior_TA = np.concatenate([self.prior_TA, prior_NA.double().numpy(force=True)])
        self._kernels.learn(self.state_S, child_C, v_C, state_N, row, step)

    def check_memory(self, looked_up: int = 0, new: int = 0) -> None:
        """NodeBudgetExceeded if a step that looks up so many states, of which so many are new, takes too much."""
        priors = 0 if self._uniform else 2 * self._A * (len(self.prior_TA) + looked_up)
        states = max(len(self.state_S), self._topology.model.num_states)
        places = self.places + (2 + self.places_of_state) * states + priors
        needed = self._topology.bytes(new, looked_up=looked_up, grown=self.grown, places=places)
        what = f"the search ({self.grown} nodes, {looked_up} states of {self._A} actions)"
        check_memory(needed, self._topology.max_bytes, what)


def records(shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    """An array of these, anything in them."""
    size = math.prod(shape) * kind.itemsize
    if size <= _SMALL:
        return np.empty(shape, kind)
    return torch.empty(size, dtype=torch.uint8).numpy().view(kind).reshape(shape)
