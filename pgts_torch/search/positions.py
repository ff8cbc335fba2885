"""Sets of states in time linear in their size: one write and one read a state in place of sorting."""

from typing import final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.models.base import Model
from pgts_torch.search.table import with_room


@final
class Positions:
    """One number for each state of a model, written and read again within a method.

    Args:
        model: it may meet more states.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._scratch_S = torch.empty(0, dtype=torch.int64, device=model.device)

    def of(self, states: Int[Tensor, "N"]) -> Int[Tensor, "S"]:
        """A table with, at each of the distinct `states`, its position among them; elsewhere anything. Valid until the
        next call."""
        scratch_S = self._room()
        scratch_S[states] = torch.arange(len(states), device=scratch_S.device)
        return scratch_S

    def distinct(self, states: Int[Tensor, "N"]) -> Int[Tensor, "distinct"]:
        """The states without repetition, ascending."""
        # Of the positions of a state one is written last: that occurrence stays.
        scratch_S, order_N = self._room(), torch.arange(len(states), device=states.device)
        scratch_S[states] = order_N
        return states[scratch_S[states] == order_N].sort().values

    def missing(self, states: Int[Tensor, "N"], among: Int[Tensor, "C"]) -> Int[Tensor, "missing"]:
        """Those of the states that are not `among` others."""
        # -1 stays where `among` writes no position.
        self._room()[states] = -1
        return states[self.of(among)[states] < 0]

    def _room(self) -> Int[Tensor, "S"]:
        self._scratch_S = with_room(self._scratch_S, self._model.num_states)
        return self._scratch_S
