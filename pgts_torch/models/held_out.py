"""Steps of a replay buffer that a model is not trained on, to measure its errors."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.models.replay import ReplayBuffer

BLOCK, _HELD_OUT = 32, 10
"""Of every 10 blocks of 32 steps in a row the last one is held out."""


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
