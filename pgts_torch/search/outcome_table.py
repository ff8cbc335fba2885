"""What a model has answered so far, one row for each state, checked: the one copy of outcomes that searches read."""

import functools
import operator
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.compiled import pays
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.base import EnumeratingModel, Model
from pgts_torch.search.price import Meter
from pgts_torch.search.table import Table, with_room

_TOLERANCE = 1e-4
"""By how much the probabilities of a model may miss 1: enough for many of them in float32."""

_NOT_QUERIED, _NO_ROW = -1, -2


@functools.cache
def _kernels() -> Any:
    from pgts_torch.search import table_kernels  # numba is imported with it

    return table_kernels


@final
class OutcomeTable(Table):
    """The outcomes of the states that a model was queried for, in the order of the queries: each state only once.

    reward_RA, prob_RAK, discount_RAK, child_RAK: as in `Outcomes`, children as states of the model.
    row_S: the row R of a state; -1 where the model was not queried, -2 where it was, and its own table was read. It may
        be longer than there are states.
    num_queried: for how many states the model was queried.   model_calls: for how many (state, action).
    meter: measures what queries cost; None: nothing does.
    """

    axis = "R"

    def __init__(self, model: EnumeratingModel) -> None:
        super().__init__(model.num_actions, 1, model.dtype, model.device)
        self.model, self.num_queried, self.model_calls = model, 0, 0
        self.reward_RA = self._column("A")
        self.prob_RAK, self.discount_RAK = self._column("AK"), self._column("AK")
        self.child_RAK = self._column("AK", dtype=torch.int64)
        self.row_S = torch.empty(0, dtype=torch.int64, device=model.device)
        self._missing: tuple[Tensor | None, int] = None, 0
        self._seen: tuple[tuple[Tensor, ...], list[np.ndarray]] = (), []
        self.meter: Meter | None = None

    @property
    def arrays(self) -> list[np.ndarray]:
        """The columns and `row_S` as compiled loops read them, in the same memory; on the CPU."""
        columns = self.reward_RA, self.prob_RAK, self.discount_RAK, self.child_RAK, self.row_S
        if not all(map(operator.is_, columns, self._seen[0])) or not self._seen[0]:
            self._seen = columns, [column.numpy() for column in columns]
        return self._seen[1]

    @property
    def queried(self) -> Int[Tensor, "N"]:
        """The states that the model was queried for, ascending."""
        return torch.nonzero(self.row_S != _NOT_QUERIED).flatten()

    def missing(self, state_N: Int[Tensor, "N"]) -> Int[Tensor, "missing"]:
        """Those of the states that have no row."""
        if state_N is self._missing[0] and self.num_queried == self._missing[1]:  # found before, of other states
            return state_N
        self.row_S = with_room(self.row_S, self.model.num_states)
        if pays(self.device, state_N.shape[0]):
            found_N = torch.empty_like(state_N)
            count = _kernels().missing(state_N.numpy(), self.arrays[-1], found_N.numpy())
            self._missing = found_N[:count], self.num_queried
            return self._missing[0]
        missing_N = self.row_S.index_select(0, state_N) < 0
        return state_N if bool(missing_N.all()) else state_N[missing_N]

    def read(self, state_N: Int[Tensor, "N"]) -> None:
        """These distinct states count as queried; what follows them is read in the model's own table."""
        missing = self.missing(state_N)
        self._count(missing)
        self.row_S[missing] = _NO_ROW

    def query(self, state_N: Int[Tensor, "N"]) -> None:
        """Have rows of these distinct states; the model is queried for the missing ones.

        Raises:
            PgtsError: the answer cannot be true, see `check_outcomes`.
        """
        # The states are distinct, so that none is queried, or gets a row, twice.
        missing = self.missing(state_N)
        if missing.shape[0] and self.meter is not None:
            known, divides = self.num_queried, self.model.answers_singly
            self.meter.query(missing, self._ask, self._children, known=known, divides=divides)
        elif missing.shape[0]:
            self._ask(missing)

    def _ask(self, missing: Int[Tensor, "missing"]) -> None:
        answer = self.model.outcomes(missing)
        self._count(missing)
        # The model may have met new states, which get room before their ids are used.
        self.row_S = with_room(self.row_S, self.model.num_states)
        if self._can_write(missing.shape[0], answer) and self._write(missing, answer):
            return
        check_outcomes(self.model, missing, answer)
        self.row_S[missing] = self._append(
            reward_RA=answer.reward_NA,
            prob_RAK=answer.prob_NAK,
            discount_RAK=answer.discount_NAK,
            child_RAK=answer.child_NAK,
        )

    def _children(self, state_N: Int[Tensor, "N"]) -> tuple[Int[Tensor, "C"], Int[Tensor, "D"]]:
        """The distinct states that follow these queried ones; and those of them that were not queried."""
        outcomes = self._rows(self.row_S[state_N])
        children = outcomes.child_NAK[has_weight(outcomes)].unique()
        return children, children[self.row_S[children] < 0]

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """A copy of the outcomes of these distinct states, after `query`."""
        self.query(state_N)
        return self._rows(self.row_S[state_N])

    def all(self) -> tuple[Int[Tensor, "R"], Outcomes]:
        """The queried states and their outcomes, with states as children: in the memory of this table, or rows of the
        model's own."""
        queried = self.queried
        if self.model.table is not None:
            return queried, self.model.table.rows(queried)
        # The inverse of `row_S`.
        state_R = torch.empty_like(queried)
        state_R[self.row_S[queried]] = queried
        return state_R, self._rows(slice(self.count))

    def _count(self, missing: Int[Tensor, "missing"]) -> None:
        # Only states of a table of its own can have been queried and have no row.
        read = self.model.table is not None
        new = int((self.row_S[missing] == _NOT_QUERIED).sum()) if read else missing.shape[0]
        self.num_queried += new
        self.model_calls += new * self.num_actions

    def _can_write(self, states: int, answer: Outcomes) -> bool:
        """Whether the answer is of a kind that a compiled loop can check and write."""
        dtypes = {answer.reward_NA.dtype, answer.prob_NAK.dtype, answer.discount_NAK.dtype, self.dtype}
        fits = len(dtypes) == 1 and tuple(answer.reward_NA.shape) == (states, self.num_actions)
        return fits and self.dtype in (torch.float32, torch.float64) and pays(self.device, answer.child_NAK.numel())

    def _write(self, state_N: Int[Tensor, "N"], answer: Outcomes) -> bool:
        """Write the answer for these states, checked in the same pass; False where something seems to be off."""
        first, last = self.count, self.count + answer.num_states
        if last > self.reward_RA.shape[0] or answer.num_outcomes > self.num_outcomes:
            self._reserve(answer.num_states, answer.num_outcomes)
        given = state_N, answer.reward_NA, answer.prob_NAK, answer.discount_NAK, answer.child_NAK
        arrays = [x.detach().contiguous().numpy() for x in given]
        if not _kernels().write(first, self.model.num_states, _TOLERANCE, *arrays, *self.arrays):
            return False
        self.count = last
        return True

    def _rows(self, at: Tensor | slice) -> Outcomes:
        columns = self.reward_RA[at], self.prob_RAK[at], self.discount_RAK[at], self.child_RAK[at]
        return Outcomes(*columns, self.model.num_states)


def has_weight(outcomes: Outcomes) -> Bool[Tensor, "N A K"]:
    """Which outcomes count. A terminal outcome, an action that is not allowed and padding have no weight, and what
    follows them needs no node."""
    allowed_NA1 = outcomes.reward_NA.unsqueeze(-1) > -torch.inf
    return (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0) & allowed_NA1


def check_outcomes(model: Model, state_N: Int[Tensor, "N"], outcomes: Outcomes) -> None:
    """PgtsError, naming the state, unless these can be the outcomes of these states of the model."""
    reward_NA, child_NAK = outcomes.reward_NA, outcomes.child_NAK
    expected, shape = (len(state_N), model.num_actions), tuple(reward_NA.shape)
    if shape != expected:
        raise PgtsError(f"the model returned outcomes of {shape} states and actions; they must be of {expected}")
    for name, x in (("reward", reward_NA), ("prob", outcomes.prob_NAK), ("discount", outcomes.discount_NAK)):
        if x.dtype != model.dtype:
            raise PgtsError(f"the model's {name} is {x.dtype}; its dtype is {model.dtype}")
    if (off := _first(~reward_NA.amax(-1).isfinite())) is not None:
        raise NotFinite(
            f"the model's rewards in state {int(state_N[off[0]])} are {reward_NA[off[0]].tolist()}; they must be "
            "numbers, or -inf where an action is not allowed, and one action must be",
            what="reward",
        )

    # What follows is named by the first entry that is off: [state, action] or [state, action, outcome].
    def named(off: list[int]) -> str:
        outcome = f"of outcome {off[2]} " if len(off) > 2 else ""
        return outcome + f"of state {int(state_N[off[0]])} and action {off[1]}"

    # Probabilities of actions that are not allowed need not sum to 1: as if they did.
    total_NA = torch.where(reward_NA > -torch.inf, outcomes.prob_NAK.sum(-1), 1.0)
    if (off := _first(~((total_NA - 1).abs() <= _TOLERANCE))) is not None:
        raise PgtsError(f"the model's probabilities {named(off)} sum to {float(total_NA[*off])}")
    most = 1 + _TOLERANCE
    for name, x_NAK, highest in (("probability", outcomes.prob_NAK, most), ("discount", outcomes.discount_NAK, 1.0)):
        # Comparisons with NaN are false: it is off too.
        if (off := _first(~((x_NAK >= 0) & (x_NAK <= highest)))) is not None:
            raise PgtsError(f"the model's {name} {named(off)} is {float(x_NAK[*off])}; it must be in [0, 1]")
    if (off := _first((child_NAK < 0) | (child_NAK >= model.num_states))) is not None:
        child = f"{int(child_NAK[*off])}; states are 0 to {model.num_states - 1}"
        raise PgtsError(f"the model's child {named(off)} is {child}")


def _first(off: Bool[Tensor, "..."]) -> list[int] | None:
    """Where the first true entry is; None where there is none."""
    return torch.nonzero(off)[0].tolist() if bool(off.any()) else None
