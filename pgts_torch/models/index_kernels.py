"""Loops of `StateIndex` over rows of bits, compiled: a row after another, where torch goes round by round."""

import numpy as np

from pgts_torch.compiled import inlined, jit

_ODD = np.uint64(0x9E3779B97F4A7C15)
_FACTORS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_27, _30, _31 = np.uint64(27), np.uint64(30), np.uint64(31)
"""Of SplitMix64, as in `seeding`. All numbers are unsigned: with others numba makes them floats."""

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
def number(bits_RD, slots, first, hash_N, looks_N, number_N):  # type: ignore[no-untyped-def]
    """Number the rows from the row `first` on: those that `looks_N` marks (all if it is empty) are looked up, and
    entered where they are new. New rows move together behind `first`. How many are new, and how many are entered."""
    count, entered, all_look = first, 0, len(looks_N) == 0
    for i in range(len(number_N)):
        n = first + i
        if all_look or looks_N[i]:
            slot = _slot(bits_RD, slots, n, hash_N[i])
            if slots[slot] != _EMPTY:
                number_N[i] = slots[slot]
                continue
            slots[slot] = count
            entered += 1
        for d in range(bits_RD.shape[1]):
            bits_RD[count, d] = bits_RD[n, d]
        number_N[i] = count
        count += 1
    return count - first, entered
