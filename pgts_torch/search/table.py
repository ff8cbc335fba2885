"""Tables that grow while a search goes on."""

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.search.memory import GROWTH


class Table:
    """Rows whose columns are the attributes with names that end in the axes `X`, `XA` or `XAK`, X the letter of the
    rows: a number, one for each action, or one for each of the K outcomes of each action.

    Room grows by the factor `GROWTH` where it is full, so that a row costs the same however many there are.

    axis: the letter X.
    num_outcomes: K; it grows too.
    count: how many rows are filled. Those beyond are room.
    """

    axis: str
    count: int = 0

    def __init__(self, num_actions: int, num_outcomes: int, dtype: torch.dtype, device: torch.device) -> None:
        self.num_actions, self.num_outcomes = num_actions, num_outcomes
        self.dtype, self.device = dtype, device

    def _column(self, axes: str = "", *, room: int = 0, dtype: torch.dtype | None = None) -> Tensor:
        """Zeros with the axes X, XA or XAK."""
        shape = (self.num_actions, self.num_outcomes)[: len(axes)]
        return torch.zeros(room, *shape, dtype=dtype or self.dtype, device=self.device)

    def _reserve(self, rows: int, num_outcomes: int) -> None:
        """Room for so many more rows, and for at least so many outcomes of an action."""
        self.num_outcomes = K = max(self.num_outcomes, num_outcomes)
        last, ends = self.count + rows, tuple(f"_{self.axis}{axes}" for axes in ("", "A", "AK"))
        for name in [name for name in vars(self) if name.endswith(ends)]:
            column = getattr(self, name)
            room = len(column) if last <= len(column) else max(last, int(GROWTH * len(column)))
            wider = K - column.shape[2] if column.ndim == 3 else 0
            if room > len(column) or wider:
                # Padding is written last axis first. An outcome that is padding is exhausted, and else 0.
                pad = [0] * (2 * column.ndim - 1) + [room - len(column)]
                pad[1] += wider
                fill = -torch.inf if name.startswith("exhausted") else 0
                setattr(self, name, torch.nn.functional.pad(column, pad, value=fill))

    def _append(self, **columns: Tensor) -> Int[Tensor, "new"]:
        """Add rows and return where they are. Outcomes beyond those given are padding."""
        given = next(iter(columns.values()))
        K = max((column.shape[2] for column in columns.values() if column.ndim == 3), default=1)
        first, last = self.count, self.count + len(given)
        self._reserve(len(given), K)
        for name, column in columns.items():
            getattr(self, name)[first:last][..., : column.shape[-1]] = column
        self.count = last
        return torch.arange(first, last, device=self.device)


def with_room(x_S: Int[Tensor, "S"], num_states: int, fill: int = -1) -> Int[Tensor, "more"]:
    """The same numbers with room for so many states, at least doubled where there is not enough: growing is rare."""
    room = x_S.shape[0]
    if num_states <= room:
        return x_S
    return torch.nn.functional.pad(x_S, (0, max(num_states - room, room)), value=fill)
