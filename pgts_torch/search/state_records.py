"""What compiled tree searches know of states: what the model, the critic and the policy say of them."""

import functools
import math
from typing import Any, NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.options.search import MCTS
from pgts_torch.search.known import prior_of_allowed
from pgts_torch.search.lookahead import Leaves, check_roots
from pgts_torch.search.memory import check_memory
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree_records import NEW, STATE, as_bytes
from pgts_torch.seeding import draw_keys

_UNKNOWN = np.array([(math.nan, NEW)], STATE)

_SMALL = 2**16
"""So many bytes are not worth an allocation by torch, whose memory is counted."""


@functools.cache
def _log(x: float) -> float:
    """As torch has it."""
    return float(torch.tensor(x, dtype=torch.float64).log())


class Learned(NamedTuple):
    """What the critic and the policy have said, which a kernel is to write.

    child_C, v_C: states and their values.   state_N: states whose priors are the rows row, row + step, ...
    values: those of the critic, as it returned them.
    """

    child_C: Int[np.ndarray, "C"]
    v_C: Float[np.ndarray, "C"]
    state_N: Int[np.ndarray, "N"]
    row: int
    step: int
    values: Float[Tensor, "C ..."] | None = None

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What the kernels read."""
        return self[:5]

    def refuse(self, leaves: Leaves) -> None:
        """NotFinite, naming the state: one of the values is not finite."""
        assert self.values is not None
        leaves.check(self.values, torch.from_numpy(self.child_C))


@final
class StateRecords:
    """A record of each state of the model, found out once a search however often the state occurs in the trees.

    state_S: see `tree_records.STATE`.
    prior_TA: rows of priors; one if they are uniform.
    grown: nodes of the trees, which say so.

    Args:
        places, places_of_state: what the trees take, see `search_bytes`, and of that for each state.

    Raises:
        PgtsError, NodeBudgetExceeded: the methods, as `mcts`.
    """

    def __init__(self, topology: Topology, options: MCTS, *, places: int, places_of_state: int) -> None:
        # Numba is imported with these.
        from pgts_torch.search import state_kernels

        self._kernels: Any = state_kernels
        self._topology, self._table, self._model = topology, topology.table, topology.model
        self._uniform, self._A = options.prior == "uniform", topology.model.num_actions
        self._log_prior = _log(1 / self._A) if self._uniform else 0.0
        self.state_S, self._child_S = np.empty(0, STATE), np.empty(0, np.int64)
        self.prior_TA = np.full((int(self._uniform), self._A), 1 / self._A)
        self.grown, self._places, self._places_of_state = 0, places, places_of_state
        self._afforded: tuple[int, ...] = ()
        self._key_1 = torch.zeros(1, dtype=torch.int64)
        self._key = self._key_1.numpy()

    @property
    def num_outcomes(self) -> int:
        """K, as far as it is known by now."""
        return self._table.num_outcomes

    @property
    def num_states(self) -> int:
        """For how many states there is room."""
        return len(self.state_S)

    @property
    def num_bytes(self) -> int:
        """What it takes between searches."""
        return self.state_S.nbytes + self._child_S.nbytes + self.prior_TA.nbytes

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What the kernels read: the columns of the `OutcomeTable`, `state_S`, `prior_TA`."""
        return *self._table.arrays, self.state_S, self.prior_TA

    def begin(
        self,
        leaves: Leaves,
        root_B: Int[np.ndarray, "B"],
        levels: int,
        wanted_N: Int[np.ndarray, "most"],
        of_search: tuple[Any, ...],
        generator: torch.Generator | None,
    ) -> Learned:
        """Forget the search before, and learn of the roots and of at most so many states that follow within so many
        levels, as far as their outcomes are known: the critic is called at once for what simulations may reach.

        Args:
            wanted_N: scratch.
            of_search: what else a search begins with, as `state_kernels.begin` lists it; the last of it becomes what
                actions of roots are preferred by, log prior(a) plus standard Gumbel noise if there is a generator.
        """
        if generator is not None:
            draw_keys(self._key_1, generator=generator)
        noise = self._log_prior, generator is not None, self._key
        if not self._uniform:
            self.prior_TA = self.prior_TA[:0]
        self._make_room()  # other searches may have met states since
        found = -1
        while found < 0:
            states = self.state_S, root_B, levels, wanted_N, self._child_S
            found, children = self._kernels.begin(*self._table.arrays, *states, *of_search, *noise)
            if found < 0:
                self.query(torch.from_numpy(root_B))
        state_N = wanted_N[:found] if self._uniform else np.sort(wanted_N[:found])
        learned = self._learned(leaves, state_N, self._child_S[:children])
        if not self._uniform:
            prior_BA = self.prior_TA[np.searchsorted(state_N, root_B)]
            of_search[-1][...] += torch.from_numpy(prior_BA).log().numpy()
        return learned

    def learn(self, leaves: Leaves, state_N: Int[np.ndarray, "N"]) -> Learned:
        """The outcomes of these wanted states, the critic's values of their children, and the prior."""
        self._query(torch.from_numpy(state_N))
        states = self.state_S, state_N, len(state_N), 0, self._child_S
        _, children = self._kernels.reach(*self._table.arrays, *states)
        return self._learned(leaves, state_N, self._child_S[:children])

    def query(self, state_N: Int[Tensor, "N"]) -> None:
        """Have the outcomes of these states in the table, and room for the states that the model has met by then."""
        check_roots(state_N, self._model.num_states)
        self._query(state_N)

    def _query(self, state_N: Int[Tensor, "N"]) -> None:
        missing = self._table.missing(state_N)
        if missing.shape[0]:
            self.check_memory(state_N.shape[0], missing.shape[0])
            self._topology.query(missing)
        self._make_room()

    def _make_room(self) -> None:
        more = self._table.row_S.shape[0] - len(self.state_S)
        if more:
            both = as_bytes(self.state_S), as_bytes(_UNKNOWN.repeat(more))
            self.state_S = np.concatenate(both).view(STATE)
            self._child_S = records((len(self.state_S),), self._child_S.dtype)

    def _learned(self, leaves: Leaves, state_N: Int[np.ndarray, "N"], child_C: Int[np.ndarray, "C"]) -> Learned:
        self.check_memory(len(state_N))
        child_C, v_C, row, step, values = child_C.copy(), NOTHING.v_C, 0, 0, None
        if len(child_C):
            child_C.sort()
            v, values = leaves.unchecked(torch.from_numpy(child_C))
            # Loops are compiled for one kind of array.
            v_C = np.ascontiguousarray(v.numpy(force=True), np.float64)
        if not self._uniform:
            row, step = len(self.prior_TA), 1
            states = torch.from_numpy(state_N)
            prior_NA = prior_of_allowed(leaves.prior(states), self._table.reward_RA[self._table.row_S[states]], states)
            self.prior_TA = np.concatenate([self.prior_TA, prior_NA.double().numpy(force=True)])
        return Learned(child_C, v_C, state_N, row, step, values)

    def check_memory(self, looked_up: int = 0, new: int = 0) -> None:
        """NodeBudgetExceeded if a step that looks up so many states, of which so many are new, takes too much."""
        priors = 0 if self._uniform else 2 * self._A * (len(self.prior_TA) + looked_up)
        states = max(len(self.state_S), self._model.num_states)
        step = looked_up, new, priors, states, self.grown, self._table.count, self._table.num_outcomes
        if step == self._afforded:
            return
        # Beside the records of states there is a list of some of them.
        places = self._places + (3 + self._places_of_state) * states + priors
        needed = self._topology.bytes(new, looked_up=looked_up, grown=self.grown, places=places)
        what = f"the search ({self.grown} nodes, {looked_up} states of {self._A} actions)"
        check_memory(needed, self._topology.max_bytes, what)
        self._afforded = step


NOTHING = Learned(np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64), 0, 0)


def records(shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    """An array of these, anything in them."""
    size = math.prod(shape) * kind.itemsize
    if size <= _SMALL:
        return np.empty(shape, kind)
    return torch.empty(size, dtype=torch.uint8).numpy().view(kind).reshape(shape)
