"""Processes that train one policy together, as torchrun starts them."""

import os
import pickle
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar, final

import torch
from torch import Tensor, distributed

from pgts_torch.errors import PgtsError, RankLost
from pgts_torch.seeding import stream

T = TypeVar("T")


@final
@dataclass(frozen=True)
class Ranks:
    """All processes of a training, seen from the one with the number `rank`, counted from 0.

    Each makes its part of the episodes and of the lookahead, and learns from the whole. So all hold the same policy,
    bit for bit, and the update is that of one process that has made all of it.
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

    def draws(self, seed: int, number: int, device: torch.device) -> "Draws":
        """What iteration `number` draws from."""
        names = ("iteration", number)
        own = stream(seed, *names, *self.names, device=device)
        common = own if self.size == 1 else stream(seed, *names, "common", device=device)
        return Draws(seed, number, (*names, *self.names), own, common)

    def gather(self, what: str, make: Callable[[], T]) -> list[T]:
        """What `make` gives in each process, in the order of ranks. All processes must ask for the same.

        Args:
            what: names it, so that processes that ask for different things are noticed.
            make: gives something that pickles, its tensors on the CPU.

        Raises:
            PgtsError: from `make`, in whichever process: the same one in all, with the `rank` where it happened; or
                the processes ask for different things.
            RankLost: a process is gone.
        """
        if self.size == 1:
            return [make()]
        answer, mine = None, None
        try:
            answer = make()
        except PgtsError as error:
            mine = error
        sent = pickle.dumps((what, answer, mine))
        told: list[Any] = [None] * self.size
        try:
            distributed.all_gather_object(told, sent)
        except RuntimeError as error:
            raise RankLost(f"rank {self.rank} of {self.size} has lost another one, asking for {what}") from error
        answers = []
        for rank, (other, answer, mistake) in enumerate(map(pickle.loads, told)):
            if other != what:
                raise PgtsError(f"rank {self.rank} asks for {what}, rank {rank} for {other}: they have parted ways")
            if mistake is not None:
                mistake = mine if rank == self.rank and mine is not None else mistake
                mistake.rank = rank
                raise mistake
            answers.append(answer)
        return answers

    def total(self, count: int, policy: Mapping[str, Any]) -> int:
        """The sum of what all ranks have counted; PgtsError if they hold different policies."""
        if self.size == 1:
            return count
        told = self.gather("policies", lambda: (count, checksum(policy)))
        if len({each for _, each in told}) > 1:
            raise PgtsError("the ranks hold different policies: do they run on different hardware or versions?")
        return sum(each for each, _ in told)

    def together(self, what: str, make: Callable[[], T]) -> T:
        """What `make` gives in this process, if it fails in none; otherwise as `gather`. It need not pickle."""
        made: list[T] = []
        self.gather(what, lambda: made.append(make()))
        return made[0]

    def first(self, what: str, make: Callable[[], T]) -> T:
        """What `make` gives in rank 0, which alone calls it; otherwise as `gather`."""
        answers: list[Any] = self.gather(what, lambda: make() if self.leads else None)
        return answers[0]


@final
@dataclass(frozen=True)
class Draws:
    """What an iteration draws from: generators of streams that are named by (seed, "iteration", number).

    names: the streams of this process for its part of the work begin so.
    own: for its part of the work.
    common: for what all processes do alike; of one alone it is `own`.
    """

    seed: int
    number: int
    names: tuple[str | int, ...]
    own: torch.Generator
    common: torch.Generator

    def search(self) -> torch.Generator:
        """For a search, the same for all of an iteration."""
        return stream(self.seed, "iteration", self.number, "search", device=self.own.device)


def present_ranks() -> Ranks:
    """Those of the default process group of torch.distributed; one alone where there is none."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return Ranks()
    return Ranks(distributed.get_rank(), distributed.get_world_size())


@contextmanager
def joined_ranks(device: str) -> Iterator[Ranks]:
    """The processes that torchrun has started, as the default process group while the context lasts; one alone where
    it has started none.

    What they exchange, episodes and values, lies in host memory: the backend is gloo on every device.

    Args:
        device: where they compute; "cuda" is the GPU of the local rank.

    Raises:
        PgtsError: a machine has fewer GPUs than processes that want one each.
    """
    if not (distributed.is_available() and distributed.is_torchelastic_launched()):
        yield Ranks()
        return
    distributed.init_process_group("gloo")
    try:
        ranks = present_ranks()
        # They meet here: who leaves while another one still connects breaks that connection.
        ranks.gather("a device", _take_gpu if device == "cuda" else lambda: None)
        yield ranks
    finally:
        distributed.destroy_process_group()


def _take_gpu() -> None:
    local, gpus = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
    if local >= gpus:
        raise PgtsError(f"this machine has {gpus} GPUs; local rank {local} has none")
    torch.cuda.set_device(local)


def checksum(state: Any, start: int = 0) -> int:
    """Of all tensors in nested mappings. It tells states apart, but protects nobody from malice."""
    if isinstance(state, Tensor):
        return zlib.crc32(state.detach().cpu().contiguous().numpy().tobytes(), start)
    if isinstance(state, Mapping):
        for name in sorted(state):
            start = checksum(state[name], start)
    return start
