"""Processes that train one policy together, as torchrun starts them."""

import os
import pickle
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar, final

import torch
from torch import Tensor, distributed

from pgts_torch.errors import PgtsError, RankLost
from pgts_torch.seeding import stream

T = TypeVar("T")


@final
@dataclass(frozen=True)
class Ranks:
    """The `size` processes that train one policy together, as seen from process number `rank`, counted from 0.

    Each collects its part of the episodes and computes its part of the lookahead, and all learn from the whole batch.
    So all have the same policy, bit for bit, and the update is that of a single process with the same batch.
    """

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes files and prints messages."""
        return self.rank == 0

    @property
    def names(self) -> tuple[str | int, ...]:
        """The suffix of the names of this process's own random streams; empty for a single process."""
        return () if self.size == 1 else ("rank", self.rank)

    def count(self, total: int) -> int:
        """The size of this process's part of `total` items."""
        return total // self.size + (self.rank < total % self.size)

    def part(self, x_N: Tensor) -> Tensor:
        """This process's part of rows that all processes have; it may be empty.

        Parts are contiguous, because the searches from neighbouring states share nodes.
        """
        return x_N.tensor_split(self.size)[self.rank]

    def draws(self, seed: int, number: int, device: torch.device) -> "Draws":
        """The random generators of iteration `number`."""
        names = ("iteration", number)
        own = stream(seed, *names, *self.names, device=device)
        common = own if self.size == 1 else stream(seed, *names, "common", device=device)
        return Draws(seed, number, (*names, *self.names), own, common, names)

    def gather(self, what: str, make: Callable[[], T]) -> list[T]:
        """Return the results of `make` in all processes, in the order of ranks. All processes must call it alike.

        Args:
            what: the name of this exchange; processes that are at different exchanges get an error.
            make: returns something that pickles, its tensors on the CPU.

        Raises:
            PgtsError: `make` has raised it in some process; all raise the same error, whose `rank` is that of the
                process where it happened. Or the processes are at different exchanges.
            RankLost: a process is gone.
        """
        if self.size == 1:
            return [make()]
        result, own_error = None, None
        try:
            result = make()
        except PgtsError as error:
            own_error = error
        sent = pickle.dumps((what, result, own_error))
        received: list[Any] = [None] * self.size
        try:
            distributed.all_gather_object(received, sent)
        except RuntimeError as error:
            raise RankLost(f"rank {self.rank} of {self.size} has lost another one, asking for {what}") from error
        results = []
        for rank, (other, result, failed) in enumerate(map(pickle.loads, received)):
            if other != what:
                raise PgtsError(f"rank {self.rank} asks for {what}, rank {rank} for {other}: they are out of step")
            if failed is not None:
                # its own error object has the traceback, which the pickled one lacks
                failed = own_error if rank == self.rank and own_error is not None else failed
                failed.rank = rank
                raise failed
            results.append(result)
        return results

    def total(self, count: int, policy: Callable[[], Mapping[str, Any]]) -> int:
        """The sum of `count` over all ranks; PgtsError if their policies, of which `policy` is the state, differ."""
        if self.size == 1:
            return count
        received = self.gather("policies", lambda: (count, checksum(policy())))
        if len({policy_sum for _, policy_sum in received}) > 1:
            raise PgtsError("the ranks have different policies: do they run on different hardware or versions?")
        return sum(each for each, _ in received)

    def together(self, what: str, make: Callable[[], T]) -> T:
        """Return the result of `make` in this process, if it fails in none. It need not pickle. Raises as `gather`."""
        made: list[T] = []
        self.gather(what, lambda: made.append(make()))
        return made[0]

    def first(self, what: str, make: Callable[[], T]) -> T:
        """Return the result of `make` in rank 0; no other rank calls it. Raises as `gather`."""
        results: list[Any] = self.gather(what, lambda: make() if self.leads else None)
        return results[0]


@final
@dataclass(frozen=True)
class Draws:
    """The random generators of an iteration, from streams named by (seed, "iteration", number).

    names: the prefix of the names of this process's own streams.
    own: for its part of the episodes and of the lookahead.
    common: for what all processes do alike; the same object as `own` in a single process.
    """

    seed: int
    number: int
    names: tuple[str | int, ...]
    own: torch.Generator
    common: torch.Generator
    _common_names: tuple[str | int, ...]

    def search(self) -> torch.Generator:
        """A new generator for a search; all searches of an iteration get the same random numbers."""
        return stream(self.seed, *self._common_names, "search", device=self.own.device)

    def update(self, number: int) -> "Draws":
        """The random generators of one of several updates of the iteration, which all processes make alike."""
        names = (*self._common_names, "update", number)
        common = stream(self.seed, *names, device=self.own.device)
        return Draws(self.seed, self.number, names, common, common, names)


def present_ranks() -> Ranks:
    """The ranks of the default process group of torch.distributed; a single process where there is none."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return Ranks()
    return Ranks(distributed.get_rank(), distributed.get_world_size())


@contextmanager
def joined_ranks(device: str, *, timeout: float = 1800) -> Iterator[Ranks]:
    """Join the processes that torchrun has started in the default process group while the context lasts.

    Without torchrun it is a single process. The backend is gloo on every device, because what is exchanged, episodes
    and values, is in host memory.

    Args:
        device: where they compute; "cuda" is the GPU of the local rank.
        timeout: the most seconds that a process waits for another one.

    Raises:
        PgtsError: a machine has fewer GPUs than processes, and "cuda" is asked for.
    """
    if not (distributed.is_available() and distributed.is_torchelastic_launched()):
        yield Ranks()
        return
    distributed.init_process_group("gloo", timeout=timedelta(seconds=timeout))
    try:
        ranks = present_ranks()
        # Wait for all: a process that leaves while another one still connects breaks that connection.
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
    """CRC32 of all tensors in nested mappings. It detects differences, not deliberate changes."""
    if isinstance(state, Tensor):
        return zlib.crc32(state.detach().cpu().contiguous().numpy().tobytes(), start)
    if isinstance(state, Mapping):
        for name in sorted(state):
            start = checksum(state[name], start)
    return start
