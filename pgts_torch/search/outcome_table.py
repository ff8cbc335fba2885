"""What a model has answered so far, one row a state, checked: the one copy of outcomes that searches read from."""

from typing import final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.base import Model
from pgts_torch.search.memory import GROWTH

_TOLERANCE = 1e-4
"""By how much the probabilities of a model may miss 1: enough for many of them in float32."""


@final
class OutcomeTable:
    """The outcomes of the states that a model was queried for, in the order of the queries.

    Room grows by a factor where it is full, so that a row costs the same however many there are. Rows at `count` and
    beyond are room; outcomes beyond those that the model gave are padding of probability 0.

    reward_RA, prob_RAK, discount_RAK, child_RAK: as in `Outcomes`, children as states of the model.
    count: how many rows are filled.
    num_outcomes: the largest K so far; 1 where nothing was added.
    """

    def __init__(self, model: Model) -> None:
        A, float_, device = model.num_actions, model.dtype, model.device
        self.reward_RA: Float[Tensor, "R A"] = torch.empty(0, A, dtype=float_, device=device)
        self.prob_RAK: Float[Tensor, "R A K"] = torch.empty(0, A, 1, dtype=float_, device=device)
        self.discount_RAK: Float[Tensor, "R A K"] = torch.empty(0, A, 1, dtype=float_, device=device)
        self.child_RAK: Int[Tensor, "R A K"] = torch.empty(0, A, 1, dtype=torch.int64, device=device)
        self.count = 0

    @property
    def num_outcomes(self) -> int:
        return self.prob_RAK.shape[2]

    def rows(self, row_N: Int[Tensor, "N"], num_children: int) -> Outcomes:
        """A copy of some of the rows, in the given order."""
        return Outcomes(
            self.reward_RA[row_N], self.prob_RAK[row_N], self.discount_RAK[row_N], self.child_RAK[row_N], num_children
        )

    def all(self, num_children: int) -> Outcomes:
        """All rows, in the memory of the table."""
        n = self.count
        return Outcomes(self.reward_RA[:n], self.prob_RAK[:n], self.discount_RAK[:n], self.child_RAK[:n], num_children)

    def append(self, more: Outcomes) -> Int[Tensor, "N"]:
        """Add copies of these rows, padded to the largest K so far, and return where they are."""
        first, last = self.count, self.count + more.num_states
        room, K = len(self.reward_RA), max(self.num_outcomes, more.num_outcomes)
        room = room if last <= room else max(last, int(GROWTH * room))
        columns = {
            "reward_RA": more.reward_NA,
            "prob_RAK": more.prob_NAK,
            "discount_RAK": more.discount_NAK,
            "child_RAK": more.child_NAK,
        }
        for name, given in columns.items():  # one after the other, so that only one is there twice
            setattr(self, name, _padded(getattr(self, name), room, K))
            getattr(self, name)[first:last, ..., : given.shape[-1]] = given
        self.count = last
        return torch.arange(first, last, device=more.device)


def _padded(column: Tensor, R: int, K: int) -> Tensor:
    """The same column with room for R rows, and for K outcomes if it has outcomes."""
    by_outcome = column.ndim == 3
    if len(column) == R and (not by_outcome or column.shape[-1] == K):
        return column
    more = (0, K - column.shape[-1], 0, 0, 0, R - len(column)) if by_outcome else (0, 0, 0, R - len(column))
    return torch.nn.functional.pad(column, more)


def has_weight(outcomes: Outcomes) -> Bool[Tensor, "N A K"]:
    """Which outcomes count. A terminal outcome, an action that is not allowed and padding have no weight, and what
    follows them needs no node."""
    allowed_NA1 = outcomes.reward_NA.unsqueeze(-1) > -torch.inf
    return (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0) & allowed_NA1


def check_outcomes(model: Model, state_N: Int[Tensor, "N"], outcomes: Outcomes) -> None:
    """PgtsError, naming the state, unless these can be the outcomes of these states of the model."""
    expected, shape = (len(state_N), model.num_actions), tuple(outcomes.reward_NA.shape)
    if shape != expected:
        raise PgtsError(f"the model returned outcomes of {shape} states and actions; they must be of {expected}")
    for name, x in (("reward", outcomes.reward_NA), ("prob", outcomes.prob_NAK), ("discount", outcomes.discount_NAK)):
        if x.dtype != model.dtype:
            raise PgtsError(f"the model's {name} is {x.dtype}; its dtype is {model.dtype}")
    best_N = outcomes.reward_NA.amax(-1)
    if not bool(best_N.isfinite().all()):
        n = int(torch.nonzero(~best_N.isfinite())[0, 0])
        raise NotFinite(
            f"the model's rewards in state {int(state_N[n])} are {outcomes.reward_NA[n].tolist()}; they must be "
            "numbers, or -inf where an action is not allowed, and one action must be",
            what="reward",
        )
    # Probabilities of actions that are not allowed need not sum to 1: as if they did.
    total_NA = torch.where(outcomes.reward_NA > -torch.inf, outcomes.prob_NAK.sum(-1), 1.0)
    fair_NA = (total_NA - 1).abs() <= _TOLERANCE
    if not bool(fair_NA.all()):
        n, a = torch.nonzero(~fair_NA)[0].tolist()
        raise PgtsError(
            f"the model's probabilities of what follows state {int(state_N[n])} and action {a} sum to "
            f"{float(total_NA[n, a])}"
        )
    most = 1 + _TOLERANCE
    for name, x_NAK, highest in (("probability", outcomes.prob_NAK, most), ("discount", outcomes.discount_NAK, 1.0)):
        off_NAK = ~((x_NAK >= 0) & (x_NAK <= highest))  # so put that NaN is off too
        if bool(off_NAK.any()):
            n, a, k = torch.nonzero(off_NAK)[0].tolist()
            raise PgtsError(
                f"the model's {name} of outcome {k} of state {int(state_N[n])} and action {a} is "
                f"{float(x_NAK[n, a, k])}; it must be in [0, 1]"
            )
    child_NAK = outcomes.child_NAK
    off_NAK = (child_NAK < 0) | (child_NAK >= model.num_states)
    if off_NAK.any():
        n, a, k = torch.nonzero(off_NAK)[0].tolist()
        raise PgtsError(
            f"the model leads from state {int(state_N[n])} by action {a} to {int(child_NAK[n, a, k])}; "
            f"states are 0 to {model.num_states - 1}"
        )
