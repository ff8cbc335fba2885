"""Steps of a replay buffer that a model is not trained on, to measure its errors."""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.models.replay import ReplayBuffer
from pgts_torch.ranks import Ranks

BLOCK, _HELD_OUT = 32, 10
"""Of every 10 blocks of 32 steps in a row the last one is held out."""

_AHEAD = (1, 4, 16)
"""The numbers of steps ahead for which the prediction error is measured."""

_MOST_MEASURED = 256
"""The most starts, the latest ones, from which an error is measured."""

_MOST_OFF = 4.0
"""The largest squared error of a change, in variances of changes, that counts: a few large ones, as where a car hits a
wall, do not say that the observation is not the state."""


def held_out_rows(buffer: ReplayBuffer) -> Bool[Tensor, "R"]:
    """Which rows of the ring are held out. The number of a step decides, so that it is never trained on."""
    at_R = torch.arange(len(buffer))
    # A row holds its latest step: the number of that is the row, plus the capacity for each round before it.
    rounds_R = (buffer.num_added - 1 - at_R) // buffer.capacity
    return (at_R + rounds_R * buffer.capacity) // BLOCK % _HELD_OUT == _HELD_OUT - 1


def runs(held_out_R: Bool[Tensor, "R"], follows_R: Bool[Tensor, "R"], steps: int) -> Int[Tensor, "N"]:
    """The rows where `steps` held-out steps of one episode begin, one after another in the ring."""
    good_R = held_out_R.clone()
    for ahead in range(1, steps):
        good_R &= held_out_R.roll(-ahead) & follows_R.roll(1 - ahead)
    good_R[len(good_R) - steps + 1 :] &= steps == 1  # those after them are at the beginning of the ring
    return torch.nonzero(good_R).flatten()


def sequences(
    buffer: ReplayBuffer, held_out_R: Bool[Tensor, "R"], start_N: Int[Tensor, "N"], steps: int
) -> tuple[Int[Tensor, "K N"], Bool[Tensor, "K N"]]:
    """The rows of `steps` steps in a row from each start, and which of them count: those of the same episode, as long
    as none is held out. The starts are not."""
    at_N, counts_N, follows_R = start_N, torch.ones_like(start_N, dtype=torch.bool), buffer.rows("follows")
    rows, counts = [at_N], [counts_N]
    for _ in range(steps - 1):
        next_N = (at_N + 1) % len(buffer)
        counts_N = counts_N & follows_R[at_N] & ~held_out_R[next_N]
        at_N = next_N
        rows.append(at_N)
        counts.append(counts_N)
    return torch.stack(rows), torch.stack(counts)


@torch.no_grad()
def prediction_errors(
    buffer: ReplayBuffer,
    held_out_R: Bool[Tensor, "R"],
    step: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]],
    deviations: Mapping[str, Tensor],
    ranks: Ranks,
) -> dict[str, float]:
    """The errors of a model on the held-out steps of all ranks, by name; left out where too few are held out.

    error_1, error_4, error_16: the root mean square error of the state predicted so many steps ahead, in standard
    deviations of states. unexplained: the share of the variance of changes that is not predicted, but for outliers.

    Args:
        step: returns reward, discount and next state.
        deviations: of "state" and "change"; numbers of deviation 0 do not count.
    """
    errors = {}
    for steps in _AHEAD:
        starts = runs(held_out_R, buffer.rows("follows"), steps)[-_MOST_MEASURED:]
        if ranks.totals("held-out steps", len(starts)) == [0]:
            continue
        device = deviations["state"].device
        state_ND = buffer.rows("state", starts).to(device)
        for ahead in range(steps):
            at_N = (starts + ahead) % buffer.capacity
            state_ND = step(state_ND, buffer.rows("action", at_N).to(device))[2]
        off_ND = state_ND - buffer.rows("next_state", at_N).to(device)
        errors[f"error_{steps}"] = float(_mean(_squares(off_ND, deviations["state"]), ranks).sqrt())
        if steps == 1:
            square_ND = _squares(off_ND, deviations["change"]).clamp(max=_MOST_OFF)
            errors["unexplained"] = float(_mean(square_ND, ranks))
    return errors


def _mean(x_ND: Tensor, ranks: Ranks) -> Tensor:
    """The mean of the numbers of all ranks."""
    if ranks.size == 1:
        return x_ND.mean()
    total, count = ranks.totals("errors", x_ND.sum(), x_ND.numel())
    return torch.tensor(total / count)


def _squares(off_ND: Tensor, deviation_D: Tensor) -> Tensor:
    return torch.where(deviation_D > 0, off_ND / deviation_D, 0.0).square()
