"""Loops over states for `Forest`: which ones simulations may reach, whose values are missing, and their noise."""

import math

import numpy as np

from pgts_torch.compiled import inlined, jit
from pgts_torch.search.tree_records import NEW, WANTED

_TINY = float(np.finfo(np.float64).tiny)

_ODD = np.uint64(0x9E3779B97F4A7C15)
_FACTORS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_27, _30, _31, _11 = np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(11)
"""Of SplitMix64, as in `seeding`. All numbers are unsigned: with others numba makes them floats."""


@inlined
def _avalanche(x):  # type: ignore[no-untyped-def]
    """As in `seeding`."""
    x = (x ^ (x >> _30)) * _FACTORS[0]
    x = (x ^ (x >> _27)) * _FACTORS[1]
    return x ^ (x >> _31)


@jit
def add_noise(key, state_B, noise_BA):  # type: ignore[no-untyped-def]
    """Add standard Gumbel noise, the same for equal keys, states and actions: `seeding.uniform` of `seeding.mix`."""
    for b in range(len(state_B)):
        of_state = _avalanche(key * _ODD + np.uint64(state_B[b]))
        for a in range(noise_BA.shape[1]):
            bits = _avalanche(_avalanche(of_state * _ODD + np.uint64(a)) + _ODD) >> _11
            noise_BA[b, a] -= math.log(-math.log(max(float(bits) * 2.0**-53, _TINY)))


@inlined
def _has_weight(reward, prob, discount, r, a, k):  # type: ignore[no-untyped-def]
    """As `outcome_table.has_weight`, of one outcome."""
    return prob[r, a, k] > 0 and discount[r, a, k] > 0 and reward[r, a] > -np.inf


@inlined
def _reach(reward, prob, discount, child, table_row, state, wanted, count, levels):  # type: ignore[no-untyped-def]
    """Add the states that follow the first `count` wanted ones within so many levels, as far as their outcomes are
    known and there is room; how many are wanted now."""
    A, K = prob.shape[1:]
    first, last = 0, count
    for _ in range(levels):
        for i in range(first, last):
            r = table_row[wanted[i]]
            for a in range(A):
                for k in range(K):
                    s = child[r, a, k]
                    if not _has_weight(reward, prob, discount, r, a, k) or state[s].row != NEW or table_row[s] < 0:
                        continue
                    if count == len(wanted):
                        return count
                    state[s].row = WANTED
                    wanted[count] = s
                    count += 1
        first, last = last, count
        if first == last:
            break
    return count


@jit
def children(reward, prob, discount, child, table_row, state, state_N, child_C):  # type: ignore[no-untyped-def]
    """List the children of these states of which the critic's values are not known, each once, ascending; how many
    there are."""
    A, K = prob.shape[1:]
    count = 0
    for i in range(len(state_N)):
        r = table_row[state_N[i]]
        for a in range(A):
            for k in range(K):
                s = child[r, a, k]
                if _has_weight(reward, prob, discount, r, a, k) and math.isnan(state[s].v):
                    state[s].v = np.inf
                    child_C[count] = s
                    count += 1
    child_C[:count].sort()
    return count


@jit
def has_rows(table_row, state_N):  # type: ignore[no-untyped-def]
    """Whether all these states have a row in the table of outcomes."""
    missing = 0
    for s in state_N:
        missing += table_row[s] < 0
    return missing == 0


@jit
def begin(reward, prob, discount, child, table_row, state, root_B, levels, wanted):  # type: ignore[no-untyped-def]
    """Forget what is known of states; want the roots, and as many as there is room for of what follows them within so
    many levels. How many are wanted; they are listed in `wanted`, ascending."""
    for s in range(len(state)):
        state[s].v, state[s].row = math.nan, NEW
    for b in range(len(root_B)):
        state[root_B[b]].row = WANTED
        wanted[b] = root_B[b]
    count = _reach(reward, prob, discount, child, table_row, state, wanted, len(root_B), levels)
    wanted[:count].sort()
    return count


@jit
def learn(state, child_C, v_C, state_N, row, step):  # type: ignore[no-untyped-def]
    """Write the critic's values of children, and the rows of priors: row, row + step, row + 2 step, ..."""
    for i in range(len(child_C)):
        state[child_C[i]].v = v_C[i]
    for i in range(len(state_N)):
        state[state_N[i]].row = row + i * step
