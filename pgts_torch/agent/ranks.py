"""Processes that train one policy together, as torchrun starts them."""

import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar, final

import torch
from torch import Tensor, distributed

from pgts_torch.errors import PgtsError, RankLost

T = TypeVar("T")


@final
@dataclass(frozen=True)
class Ranks:
    """All processes of a training, seen from the one with the number `rank`, counted from 0.

    Each makes its part of the episodes and of the lookahead, and learns from the whole. So all hold the same policy,
    bit for bit, and an update is that of one process with the whole batch.
    """

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes, and speaks for all."""
        return self.rank == 0

    @property
    def names(self) -> tuple[str | int, ...]:
        """What the names of its own streams end in; nothing where it is alone."""
        return () if self.size == 1 else ("rank", self.rank)

    def count(self, total: int) -> int:
        """How many of `total` things are its part."""
        return total // self.size + (self.rank < total % self.size)

    def part(self, x_N: Tensor) -> Tensor:
        """Its part of rows that all have: neighbours, because their searches meet. It may be empty."""
        return x_N.tensor_split(self.size)[self.rank]

    def gather(self, make: Callable[[], T]) -> list[T]:
        """What `make` gives in each process, in the order of ranks. All processes must ask, in the same order.

        Args:
            make: gives something that pickles, its tensors on the CPU.

        Raises:
            PgtsError: from `make`, in whichever process: the same one in all, with the `rank` where it happened.
            RankLost: a process is gone.
        """
        if self.size == 1:
            return [make()]
        mine: tuple[T | None, PgtsError | None]
        try:
            mine = make(), None
        except PgtsError as error:
            mine = None, error
        answers: list[Any] = [None] * self.size
        try:
            distributed.all_gather_object(answers, mine)
        except RuntimeError as error:
            raise RankLost(f"rank {self.rank} of {self.size} has lost another one") from error
        for rank, (_, mistake) in enumerate(answers):
            if mistake is not None:
                mistake.rank = rank
                raise mistake
        return [answer for answer, _ in answers]

    def first(self, make: Callable[[], T]) -> T:
        """What `make` gives in rank 0, which alone calls it; otherwise as `gather`."""
        answers: list[Any] = self.gather(lambda: make() if self.leads else None)
        return answers[0]


def present_ranks() -> Ranks:
    """Those of the default process group of torch.distributed; one alone where there is none."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return Ranks()
    return Ranks(distributed.get_rank(), distributed.get_world_size())


@contextmanager
def joined_ranks() -> Iterator[Ranks]:
    """The processes that torchrun has started, as the default process group while the context lasts; one alone where
    it has started none.

    What they exchange, episodes and values, lies in host memory: the backend is gloo on every device. Each process
    takes the GPU of its local rank for "cuda".

    Raises:
        PgtsError: a machine has fewer GPUs than processes.
    """
    if not (distributed.is_available() and distributed.is_torchelastic_launched()):
        yield Ranks()
        return
    if torch.cuda.is_available():
        local, gpus = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if local >= gpus:
            raise PgtsError(f"this machine has {gpus} GPUs; local rank {local} has none")
        torch.cuda.set_device(local)
    distributed.init_process_group("gloo")
    try:
        yield present_ranks()
    finally:
        distributed.destroy_process_group()


def checksum(state: Any, start: int = 0) -> int:
    """Of all tensors in nested mappings. It tells states apart, but protects nobody from malice."""
    if isinstance(state, Tensor):
        return zlib.crc32(state.detach().cpu().contiguous().numpy().tobytes(), start)
    if isinstance(state, Mapping):
        for name in sorted(state):
            start = checksum(state[name], start)
    return start
