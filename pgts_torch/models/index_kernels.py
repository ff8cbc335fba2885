"""Loops of `StateIndex` over rows of bits, compiled: a row after another, where torch goes round by round."""

import numpy as np

from pgts_torch.compiled import allocating, inlined, jit

_ODD = np.uint64(0x9E3779B97F4A7C15)
_FACTORS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_27, _30, _31 = np.uint64(27), np.uint64(30), np.uint64(31)
"""Of SplitMix64, as in `seeding`. All numbers are unsigned: with others numba makes them floats."""

ALL_COUNT, SOME_COUNT, OFF = range(3)
"""What `survey` may say."""

_EMPTY = np.iinfo(np.int64).max
"""As in `state_index`."""


@inlined
def _mixed(key):  # type: ignore[no-untyped-def]
    """`seeding.mix` with the name 0."""
    x = key * _ODD
    x = (x ^ (x >> _30)) * _FACTORS[0]
    x = (x ^ (x >> _27)) * _FACTORS[1]
    return x ^ (x >> _31)


@jit
def survey(reward_N, discount_N, next_ND):  # type: ignore[no-untyped-def]
    """`ALL_COUNT` where these steps are as they must be, and all of their next states count; `OFF` where something
    seems to be off."""
    answer = ALL_COUNT
    for n in range(len(reward_N)):
        if not 0 <= discount_N[n] <= 1:
            return OFF
        if discount_N[n] > 0 and reward_N[n] > -np.inf:
            for d in range(next_ND.shape[1]):
                if next_ND[n, d] != next_ND[n, d]:
                    return OFF
        else:
            answer = SOME_COUNT
    return answer


@jit
def place(bits_RD, given_ND, first, minus_zero, infinity):  # type: ignore[no-untyped-def]
    """Write rows from the row `first` on, with 0 in place of the bits `minus_zero`. The first row that holds what is
    above `infinity`, and so is not a number; -1 if there is none."""
    N, D = given_ND.shape
    off = -1
    for n in range(N - 1, -1, -1):
        for d in range(D):
            bits = given_ND[n, d]
            if bits & ~minus_zero > infinity:
                off = n
            bits_RD[first + n, d] = 0 if bits == minus_zero else bits
    return off


@allocating
def hash_rows(bits_ND, hash_N):  # type: ignore[no-untyped-def]
    """As `state_index.hash_rows`."""
    D = bits_ND.shape[1]
    odd_D = np.empty(D, np.uint64)
    for d in range(D):
        odd_D[d] = _mixed(np.uint64(d)) | np.uint64(1)
    for n in range(len(bits_ND)):
        total = np.uint64(0)
        for d in range(D):
            total += np.uint64(np.int64(bits_ND[n, d])) * odd_D[d]
        hash_N[n] = np.int64(_mixed(total))


@inlined
def _slot(bits_RD, slots, n, hashed):  # type: ignore[no-untyped-def]
    """The slot of the row that equals row n, or the empty one where row n belongs."""
    last = len(slots) - 1
    slot = hashed & last
    while slots[slot] != _EMPTY:
        is_equal = True
        for d in range(bits_RD.shape[1]):
            is_equal = is_equal and bits_RD[slots[slot], d] == bits_RD[n, d]
        if is_equal:
            break
        slot = (slot + 1) & last
    return slot


@jit
def enter(bits_RD, slots, number_L, hash_L):  # type: ignore[no-untyped-def]
    """Enter these rows, of equal ones the first; how many there are."""
    entered = 0
    for i in range(len(number_L)):
        slot = _slot(bits_RD, slots, number_L[i], hash_L[i])
        if slots[slot] == _EMPTY:
            slots[slot] = number_L[i]
            entered += 1
    return entered


@jit
def number(bits_RD, slots, hash_N, number_N, first, sample_bits):  # type: ignore[no-untyped-def]
    """Number the rows from the row `first` on: those whose hash begins with so many zeros are looked up, and entered
    where they are new. New rows move together behind `first`. How many are new, are looked up, and are entered."""
    count, looked_up, entered = first, 0, 0
    for i in range(len(number_N)):
        n = first + i
        if sample_bits == 0 or hash_N[i] >> (64 - sample_bits) == 0:
            looked_up += 1
            slot = _slot(bits_RD, slots, n, hash_N[i])
            if slots[slot] != _EMPTY:
                number_N[i] = slots[slot]
                continue
            slots[slot] = count
            entered += 1
        if count < n:
            for d in range(bits_RD.shape[1]):
                bits_RD[count, d] = bits_RD[n, d]
        number_N[i] = count
        count += 1
    return count - first, looked_up, entered
