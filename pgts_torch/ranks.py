"""Processes that train one policy together, as torchrun starts them."""

import functools
import os
import pickle
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, NamedTuple, TypeVar, final
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor, distributed

from pgts_torch.errors import PgtsError, RankLost
from pgts_torch.exchange import Exchange

T = TypeVar("T")

_COUNT = struct.Struct("<Q")


@final
@dataclass(frozen=True)
class Ranks:
    """The `size` processes that train one policy together, as seen from process number `rank`, counted from 0.

    Each makes its part of the episodes, of the lookahead and of each gradient, and these gradients are summed. So all
    have the same policy, bit for bit, and the update is that of a single process with the whole batch. All processes
    must make the same calls of the methods that exchange something, in the same order. These raise

        PgtsError: an error of another process, or of `make`; all raise the same one, whose `rank` is that of the
            process where it happened. Or the processes are at different exchanges.
        RankLost: a process is gone.

    In a single process they exchange nothing, and return what was given, with its bits.
    """

    rank: int = 0
    size: int = 1
    exchange: Exchange | None = field(default=None, compare=False, repr=False)

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
        """This process's part of rows that all processes have; it may be empty. Parts are contiguous."""
        return x_N.tensor_split(self.size)[self.rank]

    def portion(self, total: int, weight_R: Sequence[float]) -> int:
        """This process's part of `total` items, which are divided in proportion to weights of the processes, up to
        rounding; they add up to `total`."""
        before, own, whole = sum(weight_R[: self.rank]), weight_R[self.rank], sum(weight_R)
        return round(total * (before + own) / whole) - round(total * before / whole)

    @contextmanager
    def united(self) -> Iterator[None]:
        """A context of exchanges. A PgtsError of one process that leaves it is raised in all others, by their next
        exchange; it takes the place of this process's own part in that."""
        try:
            yield
        except PgtsError as error:
            if self.exchange is not None and error.rank is None and not isinstance(error, RankLost):
                self.exchange.swap("an error", error, _joined)
            raise

    def sum(self, what: str, x: Tensor) -> Tensor:
        """The sum over ranks, in their order and in the dtype given: the same bits in all.

        Args:
            what: the name of this exchange.
            x: of the same shape and dtype in all ranks.
        """
        return self._combined(what, x, np.add)

    def least(self, what: str, x: Tensor) -> Tensor:
        """The elementwise minimum over ranks; arguments as in `sum`."""
        return self._combined(what, x, np.minimum)

    def _combined(self, what: str, x: Tensor, operation: Any) -> Tensor:
        if self.exchange is None:
            return x
        own = x.detach().cpu().contiguous().numpy()

        def combine(parts: list[Any]) -> Any:
            return functools.reduce(operation, (np.frombuffer(part, own.dtype) for part in parts))

        answer = np.frombuffer(self.exchange.swap(what, own, combine), own.dtype)
        return torch.from_numpy(answer.reshape(own.shape)).to(x.device)

    def summed(
        self, what: str, gradients: Sequence[Tensor], *numbers: Tensor
    ) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """The sums over ranks of gradients, then as one vector, and of numbers beside them: one exchange for a step."""
        if self.exchange is None:
            return gradients, numbers
        pieces = [*gradients, *numbers]
        total_D = self.sum(what, torch.cat([piece.detach().reshape(-1).to(pieces[0].dtype) for piece in pieces]))
        size = len(total_D) - len(numbers)
        return [total_D[:size]], list(total_D[size:])

    def totals(self, what: str, *numbers: float | Tensor) -> list[float]:
        """The sums of numbers over ranks, in float64."""
        if self.exchange is None:
            return [float(number) for number in numbers]
        total: list[float] = self.sum(what, torch.tensor([float(x) for x in numbers], dtype=torch.float64)).tolist()
        return total

    def each(self, what: str, *numbers: float | Tensor) -> Float[np.ndarray, "R K"]:
        """Numbers of each rank."""
        own = np.array([float(number) for number in numbers])
        if self.exchange is None:
            return own[None]
        return np.frombuffer(self.exchange.swap(what, own, _concatenated), np.float64).reshape(self.size, -1)

    def moments(self, what: str, x_ND: Float[Tensor, "N D"]) -> tuple[int, Float[Tensor, "D"], Float[Tensor, "D"]]:
        """The number of rows of all ranks, their mean, and the sum of their squared deviations from it, in float64
        (Chan, Golub and LeVeque 1983)."""
        mean_D = x_ND.mean(0)
        square_D = (x_ND - mean_D).square().sum(0)
        if self.exchange is None:
            return len(x_ND), mean_D, square_D
        counts = torch.full((1,), float(len(x_ND)), dtype=torch.float64)
        count_R, mean_RD, square_RD = self.rows(what, counts, mean_D.double()[None], square_D.double()[None])
        some_R, total = count_R > 0, count_R.sum()
        count_R1, mean_RD = count_R[some_R, None].to(mean_RD.device), mean_RD[some_R]
        mean_D = (count_R1 * mean_RD).sum(0) / total
        square_D = square_RD[some_R].sum(0) + (count_R1 * (mean_RD - mean_D).square()).sum(0)
        return int(total), mean_D, square_D

    def share(self, what: str, count: int) -> "Share":
        """This process's share of the rows of all, if it has `count`."""
        count_R = self.each(what, count)[:, 0].astype(int)
        return Share(self, int(count_R[: self.rank].sum()), int(count_R.sum()))

    def rows(self, what: str, *columns: Shaped[Tensor, "N ..."]) -> list[Shaped[Tensor, "M ..."]]:
        """The rows of all ranks, those of rank 0 first; they may have different numbers of them. Those of this process
        keep their gradient: in a loss of all rows it is the part of this process, and the sum over ranks is the whole.

        Args:
            columns: with the same number of rows.
        """
        if self.exchange is None:
            return list(columns)
        arrays = [column.detach().cpu().contiguous().numpy() for column in columns]
        sent = b"".join([_COUNT.pack(len(arrays[0])), *(array.tobytes() for array in arrays)])
        answer, at, found = self.exchange.swap(what, sent, _concatenated), 0, list[list[Tensor]]()
        for _ in range(self.size):
            (count,), at = _COUNT.unpack_from(answer, at), at + _COUNT.size
            found.append([])
            for like, column in zip(arrays, columns, strict=True):
                shape = count, *like.shape[1:]
                numbers = int(np.prod(shape))
                rows = np.frombuffer(answer, like.dtype, numbers, at).reshape(shape)
                found[-1].append(torch.from_numpy(rows).to(column.device))
                at += numbers * like.itemsize
        found[self.rank] = list(columns)
        return [torch.cat(parts) for parts in zip(*found, strict=True)]

    def gather(self, what: str, make: Callable[[], T]) -> list[T]:
        """The results of `make` in all processes, in the order of ranks. They are pickled: for what is rare.

        Args:
            what: the name of this exchange.
            make: returns something that pickles, its tensors on the CPU.
        """
        if self.exchange is None:
            return [make()]
        try:
            sent: Any = pickle.dumps(make())
        except PgtsError as error:
            if error.rank is not None:  # the others have it already
                raise
            sent = error
        answer = self.exchange.swap(what, sent, _joined)
        return [pickle.loads(each) for each in pickle.loads(answer)]

    def total(self, count: int, policy: Callable[[], Mapping[str, Any]]) -> int:
        """The sum of `count` over all ranks; PgtsError if their policies, of which `policy` is the state, differ."""
        if self.exchange is None:
            return count
        count_R, policy_R = self.each("policies", count, checksum(policy())).T
        if len(np.unique(policy_R)) > 1:
            raise PgtsError("the ranks have different policies: do they run on different hardware or versions?")
        return int(count_R.sum())

    def together(self, what: str, make: Callable[[], T]) -> T:
        """The result of `make` in this process, if it fails in none. It need not pickle."""
        made: list[T] = []
        self.gather(what, lambda: made.append(make()))
        return made[0]

    def first(self, what: str, make: Callable[[], T]) -> T:
        """The result of `make` in rank 0; no other rank calls it."""
        results: list[Any] = self.gather(what, lambda: make() if self.leads else None)
        return results[0]


ALONE = Ranks()
"""A single process."""


@final
class Share(NamedTuple):
    """The rows that a process has of a batch, whose rows are numbered in the order of ranks.

    first: the number of its first row.   total: the number of rows of all.
    """

    ranks: Ranks
    first: int
    total: int

    def mean(self, what: str, x_N: Float[Tensor, "N"]) -> Float[Tensor, ""]:
        """The mean over the rows of all; `what` names the exchange."""
        return x_N.mean() if self.ranks.exchange is None else self.ranks.sum(what, x_N.sum()) / self.total


def _concatenated(parts: Sequence[Any]) -> bytearray:
    return bytearray().join(parts)


def _joined(parts: Sequence[Any]) -> bytes:
    return pickle.dumps([bytes(part) for part in parts])


_EXCHANGES: WeakKeyDictionary[Any, Exchange] = WeakKeyDictionary()
"""The sockets of each process group of torch.distributed."""


def present_ranks() -> Ranks:
    """The ranks of the default process group of torch.distributed; a single process where there is none. All must call
    it, the first time."""
    if not (distributed.is_available() and distributed.is_initialized()) or distributed.get_world_size() == 1:
        return Ranks()
    group = distributed.group.WORLD
    if group not in _EXCHANGES:
        _EXCHANGES[group] = Exchange.of_group(group)
    return Ranks(distributed.get_rank(), distributed.get_world_size(), _EXCHANGES[group])


@contextmanager
def joined_ranks(device: str, *, timeout: float = 1800) -> Iterator[Ranks]:
    """Join the processes that torchrun has started in the default process group while the context lasts.

    Without torchrun it is a single process. The backend is gloo on every device, because what is exchanged is in host
    memory, and the processes only meet by it (`Exchange`).

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
    ranks = Ranks()
    try:
        ranks = present_ranks()
        # Wait for all: a process that leaves while another one still connects breaks that connection.
        ranks.gather("a device", _take_gpu if device == "cuda" else lambda: None)
        yield ranks
    finally:
        if ranks.exchange is not None:
            ranks.exchange.close()
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
