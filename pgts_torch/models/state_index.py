"""Numbers for states that are vectors: equal rows get the same number, also where hashes collide."""

import functools
from typing import Any, Literal, final

import torch
from jaxtyping import Int, Num
from torch import Tensor

from pgts_torch.compiled import can_compile
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.seeding import mix

Merge = Literal["auto"] | bool
"""Whether equal rows get one number: True, False, or as long as it pays."""

_EMPTY = torch.iinfo(torch.int64).max
_LEAST_SLOTS = 1024
_BITS = {
    torch.float16: torch.int16,
    torch.bfloat16: torch.int16,
    torch.float32: torch.int32,
    torch.float64: torch.int64,
}

_JUDGED_AFTER = 4096
"""After how many lookups it is judged whether rows recur."""

_PAYS, _PAYS_AGAIN = 1.01, 1.05
"""How often rows must recur on average for lookups to go on, and to be resumed."""

_SAMPLE_BITS = 4
"""While lookups are given up, rows whose hash begins with so many zeros are still looked up, as a sample."""


@functools.cache
def index_loops() -> Any:
    """The module, whose import takes long because numba is imported with it."""
    from pgts_torch.models import index_kernels

    return index_kernels


def hash_rows(bits_ND: Int[Tensor, "N D"]) -> Int[Tensor, "N"]:
    """64 bits of each row: its product with a fixed vector of odd numbers, mixed (`seeding.mix`).

    Multilinear hashing (Lemire and Kaser 2014) with SplitMix64 as finaliser: one round however long the row.
    """
    if can_compile(bits_ND.device):
        hash_N = torch.empty(bits_ND.shape[0], dtype=torch.int64)
        index_loops().hash_rows(bits_ND.contiguous().numpy(), hash_N.numpy())
        return hash_N
    # Odd factors, so that no bit of a number is lost modulo 2**64.
    odd_D = mix(torch.arange(bits_ND.shape[1], device=bits_ND.device), 0) | 1
    return mix((bits_ND.long() * odd_D).sum(-1), 0)


@final
class StateIndex:
    """Numbers 0, 1, 2, ... for the distinct rows of all tensors seen so far, in the order of their first appearance.

    An open-addressing hash table with linear probing (Knuth, TAOCP 6.4), at most half full, that takes a whole tensor
    at once: in each round every row that is still looking visits one slot, and of those that find it empty the first
    one takes it. Rows are compared in full, so a collision of hashes costs a round and never an error. On the CPU a
    compiled loop (`index_kernels`) takes one row after another and gives the same numbers.

    Where rows do not recur lookups are a waste. With `merge` "auto" each row gets a number of its own, without a
    lookup, once a few thousand of them have recurred less than 1.01 times on average. One row in 16, chosen by its
    hash, is still looked up: when these recur, lookups are resumed, after one call that enters the rows that were
    skipped. A row that got several numbers is then known by the first one.

    count: how many rows there are.

    Args:
        num_columns: D, how many numbers a row has.
        dtype: of the rows: floating, where -0.0 equals 0.0, or an integer type.
        merge: whether equal rows get one number. False: never; every row is a new one.
    """

    def __init__(
        self,
        num_columns: int,
        *,
        dtype: torch.dtype,
        device: torch.device | str = "cpu",
        merge: Merge = "auto",
    ) -> None:
        if merge not in ("auto", True, False):
            raise PgtsError(f"merge is {merge!r}; it must be 'auto', True or False")
        self._merge = merge
        with torch.inference_mode(False):
            # _rows: the row of each number, with room for more; _bits_RD: the same memory as bits.
            # _slots: the table, numbers or _EMPTY.
            self._rows = torch.empty(0, num_columns, dtype=dtype, device=device)
        # What a float of this size has as bits where it is -0.0, and infinite; no integer has them in its stead.
        floats, bits = dtype.is_floating_point, torch.iinfo(_BITS.get(dtype, dtype))
        infinity = torch.tensor(torch.inf, dtype=dtype).view(_BITS[dtype]).item() if floats else bits.max
        self._minus_zero, self._infinity = bits.min if floats else 0, infinity
        # How many rows there were when all were dropped, and how many of them in the table.
        self._expected, self._expected_entered = 0, 0
        self.count = self._entered = 0
        self.clear()

    def __len__(self) -> int:
        return self.count

    @property
    def device(self) -> torch.device:
        return self._rows.device

    @property
    def capacity(self) -> int:
        """How many rows there is room for before memory grows."""
        return self._rows.shape[0]

    @property
    def merging(self) -> bool:
        """Whether all rows are looked up at present."""
        return self._merging

    @torch.inference_mode(False)
    def clear(self) -> None:
        """Drop all rows and free their memory. The next ones get as much at once."""
        if self.count:
            self._expected, self._expected_entered = self.count, self._entered
        self.count = self._entered = self._looked_up = self._new = 0
        self._merging = self._merge is not False
        self._hold(self._rows.new_empty(0, self._rows.shape[1]))
        self._slots = self._empty_slots(_LEAST_SLOTS)

    def rows(self, number_N: Int[Tensor, "N"]) -> Num[Tensor, "N D"]:
        """The rows with these numbers."""
        return self._rows.index_select(0, number_N)

    def number(self, row_ND: Num[Tensor, "N D"]) -> Int[Tensor, "N"]:
        """The number of each row; rows not seen before get the next ones.

        Raises:
            PgtsError: the rows have another width or dtype than was given, or one holds a NaN (naming it).
        """
        if torch.is_inference_mode_enabled():  # what is kept must be ordinary tensors
            with torch.inference_mode(False):
                return self.number(row_ND)
        row_ND, N, first = row_ND.detach(), row_ND.shape[0], self.count
        # All rows are first written behind the known ones, where they can be compared with these and each other: row i
        # is new, with the number `first + i`, unless an equal one is found.
        self._write(row_ND, first)
        if self._merge is False:
            self.count += N
            return torch.arange(first, first + N, device=self.device)
        hash_N = hash_rows(self._bits_RD[first : first + N])
        # At most half of the slots are full even if all these rows are new.
        needed = 2 * (self._entered + N if self.count else max(N, self._expected_entered))
        if needed > self._slots.shape[0]:
            self._enter(self._slots[self._slots != _EMPTY], needed)
        sample_bits = 0 if self._merging else _SAMPLE_BITS
        if can_compile(self.device):
            number_N = torch.empty(N, dtype=torch.int64)
            known, given = (self._bits_RD.numpy(), self._slots.numpy()), (hash_N.numpy(), number_N.numpy())
            new, looked_up, entered = index_loops().number(*known, *given, first, sample_bits)
        else:
            number_N, new, looked_up, entered = self._numbered(first, hash_N, sample_bits)
        self.count, self._entered = first + new, self._entered + entered
        if self._merge == "auto":
            self._judge(looked_up, entered)
        return number_N

    def _numbered(self, first: int, hash_N: Tensor, sample_bits: int) -> tuple[Tensor, int, int, int]:
        """The numbers of the rows from row `first` on, how many are new, how many are looked up: those whose hash
        begins with so many zeros; and how many of these are entered."""
        fresh_N = torch.arange(first, first + len(hash_N), device=self.device)
        looks_N = hash_N >> (64 - sample_bits) == 0 if sample_bits else torch.ones_like(fresh_N, dtype=torch.bool)
        # looking_L: the L rows that are looked up; found_L: the first row equal to each, which may be itself.
        looking_L = fresh_N[looks_N]
        found_L, slot_L = self._look_up(looking_L, hash_N[looks_N])
        new_N = torch.ones_like(looks_N)
        new_N[looks_N] = found_L == looking_L
        # New rows move together: their numbers are `first` and the next ones, and the table gets them.
        number_N = first - 1 + new_N.cumsum(0)
        own = torch.nonzero(found_L == looking_L).flatten()
        self._slots[slot_L[own]] = number_N[looking_L[own] - first]
        new = torch.nonzero(new_N).flatten()
        self._rows[first : first + len(new)] = self._rows[first + new]
        # The others take the number of what was found: an old row's own, or the one that a row of this call just got.
        at_L = (found_L - first).clamp(min=0)
        number_N[looking_L - first] = torch.where(found_L < first, found_L, number_N[at_L])
        return number_N, len(new), len(looking_L), len(own)

    def _judge(self, looked_up: int, new: int) -> None:
        """Give up lookups, or resume them, by how often the rows that were looked up have recurred."""
        self._looked_up += looked_up
        self._new += new
        # The sample of one row in 16 is judged after a sixteenth as many.
        if self._looked_up < (_JUDGED_AFTER if self._merging else _JUDGED_AFTER >> _SAMPLE_BITS):
            return
        if self._merging:
            self._merging = self._looked_up > _PAYS * self._new
        elif self._looked_up > _PAYS_AGAIN * self._new:
            self._merging = True
            # All rows so far, those that were skipped too; of equal ones the first is entered.
            self._enter(torch.arange(self.count, device=self.device), 2 * self.count)
        self._looked_up = self._new = 0

    def _write(self, row_ND: Tensor, first: int) -> None:
        """Write the rows from row `first` on, without -0.0, so that equal ones have equal bits.

        Raises:
            PgtsError: as `number`.
        """
        D, dtype = self._rows.shape[1], self._rows.dtype
        if row_ND.ndim != 2 or row_ND.shape[1] != D or row_ND.dtype != dtype:
            raise PgtsError(f"the rows are {row_ND.dtype} {tuple(row_ND.shape)}; they must be {dtype} [N, {D}]")
        self._make_room(first + row_ND.shape[0])
        if can_compile(self.device):
            given_ND = self._bits(row_ND).contiguous().numpy()
            off = index_loops().place(self._bits_RD.numpy(), given_ND, first, self._minus_zero, self._infinity)
        else:
            self._rows[first : first + row_ND.shape[0]] = row_ND + 0.0 if dtype.is_floating_point else row_ND
            # The sum is one cheap call.
            is_off = dtype.is_floating_point and bool(row_ND.sum().isnan()) and bool(row_ND.isnan().any())
            off = int(torch.nonzero(row_ND.isnan().any(-1))[0, 0]) if is_off else -1
        if off >= 0:  # such a row would be new each time
            text = f"row {off} is {row_ND[off].tolist()}; what is not a number equals nothing"
            raise NotFinite(text, what="state")

    def _bits(self, row_ND: Tensor) -> Tensor:
        return row_ND.view(_BITS[row_ND.dtype]) if row_ND.dtype in _BITS else row_ND

    def _empty_slots(self, count: int) -> Tensor:
        return torch.full((count,), _EMPTY, dtype=torch.int64, device=self.device)

    def _make_room(self, count: int) -> None:
        """Memory for so many rows, or for twice as many as before; at first for as many as are expected."""
        room = self.capacity
        if count > room:
            more = self._rows.new_empty(max(count, 2 * room or self._expected), self._rows.shape[1])
            more[: self.count] = self._rows[: self.count]
            self._hold(more)

    def _hold(self, row_RD: Tensor) -> None:
        self._rows, self._bits_RD = row_RD, self._bits(row_RD)

    def _enter(self, number_L: Tensor, num_slots: int) -> None:
        """A new table of at least so many slots, with these rows."""
        self._slots = self._empty_slots(max(_LEAST_SLOTS, 1 << (num_slots - 1).bit_length()))
        hash_L = hash_rows(self._bits_RD[number_L])
        if can_compile(self.device):
            given = self._bits_RD, self._slots, number_L, hash_L
            self._entered = index_loops().enter(*(x.numpy() for x in given))
        else:
            self._entered = int((self._look_up(number_L, hash_L)[0] == number_L).sum())

    def _look_up(self, looking_L: Tensor, hash_L: Tensor) -> tuple[Tensor, Tensor]:
        """For each of these rows the number of the first one that equals it, and its slot; rows that equal none before
        them are entered. The caller counts them."""
        last_slot = self._slots.shape[0] - 1
        found_L, at_L = torch.empty_like(looking_L), torch.empty_like(looking_L)
        # index: which of the rows are still looking. In each round they compare themselves with the row in their slot,
        # and those that differ go on to the next slot.
        index, slot_L = torch.arange(len(looking_L), device=self.device), hash_L & last_slot
        while len(looking_L):
            here_L = self._slots.index_select(0, slot_L)
            free = torch.nonzero(here_L == _EMPTY).flatten()
            if len(free):
                # Of the rows that find a slot empty the first one takes it; the others compare themselves with that.
                free_slot = slot_L[free]
                self._slots.scatter_reduce_(0, free_slot, looking_L[free], "amin")
                here_L[free] = self._slots[free_slot]
            equal_L = (self._rows.index_select(0, here_L) == self._rows.index_select(0, looking_L)).all(-1)
            equal, others = torch.nonzero(equal_L).flatten(), torch.nonzero(~equal_L).flatten()
            found_L[index[equal]], at_L[index[equal]] = here_L[equal], slot_L[equal]
            index, looking_L, slot_L = index[others], looking_L[others], (slot_L[others] + 1) & last_slot
        return found_L, at_L
