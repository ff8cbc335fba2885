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


@inlined
def _add_noise(key, state_B, noise_BA):  # type: ignore[no-untyped-def]
    """Add standard Gumbel noise, the same for equal keys, states and actions: `seeding.uniform` of `seeding.mix`."""
    for b in range(len(state_B)):
        of_state = _avalanche(np.uint64(key) * _ODD + np.uint64(state_B[b]))
        for a in range(noise_BA.shape[1]):
            bits = _avalanche(_avalanche(of_state * _ODD + np.uint64(a)) + _ODD) >> _11
            noise_BA[b, a] -= math.log(-math.log(max(float(bits) * 2.0**-53, _TINY)))


@inlined
def _has_weight(reward, prob, discount, r, a, k):  # type: ignore[no-untyped-def]
    """As `outcome_table.has_weight`, of one outcome."""
    return prob[r, a, k] > 0 and discount[r, a, k] > 0 and reward[r, a] > -np.inf


@jit
def reach(reward, prob, discount, child, table_row, state, wanted, count, levels, child_C):  # type: ignore[no-untyped-def]
    """Add to the first `count` wanted states those that follow within so many levels, as far as outcomes are known and
    there is room; how many are wanted now. And list the children of all of them of which the critic's values are not
    known, each once; how many there are."""
    first, last, listed = 0, count, 0
    for level in range(levels + 1):
        for i in range(first, last):
            r = table_row[wanted[i]]
            for a in range(prob.shape[1]):
                if reward[r, a] == -np.inf:
                    continue
                for k in range(prob.shape[2]):
                    if not (prob[r, a, k] > 0 and discount[r, a, k] > 0):
                        continue
                    s = child[r, a, k]
                    if math.isnan(state[s].v):
                        state[s].v = np.inf
                        child_C[listed] = s
                        listed += 1
                    if level < levels and count < len(wanted) and state[s].row == NEW and table_row[s] >= 0:
                        state[s].row = WANTED
                        wanted[count] = s
                        count += 1
        first, last = last, count
    return count, listed


@jit
def begin(  # type: ignore[no-untyped-def]
    reward, prob, discount, child, table_row, state, root_B, levels, wanted, child_C, slot, turn, valued_L,
    preference, prior, noisy, key,
):  # fmt: skip
    """Forget the search before. Want the roots, and as many as there is room for of what follows them within so many
    levels, as far as their outcomes are known. Return how many are wanted, which are listed in `wanted`, and of how
    many children the critic is to say the values, which are listed in `child_C`; or -1 where a root has no row.

    Args:
        preference: becomes log prior, plus noise by the key if there is to be noise.
    """
    B = len(root_B)
    for b in range(B):
        if not 0 <= root_B[b] < len(table_row) or table_row[root_B[b]] < 0:
            return -1, 0
    for s in range(len(state)):
        state[s].v, state[s].row = math.nan, NEW
    for b in range(B):
        state[root_B[b]].row = WANTED
        wanted[b] = root_B[b]
    for w in range(len(slot)):
        slot[w].root = -1
    turn[:] = 0
    valued_L[:] = 0
    valued_L[0] = valued_L[-1] = B
    preference[:] = prior
    if noisy:
        _add_noise(key[0], root_B, preference)
    return reach(reward, prob, discount, child, table_row, state, wanted, B, levels, child_C)


@jit
def learn(state, child_C, v_C, state_N, row, step):  # type: ignore[no-untyped-def]
    """Write the critic's values of children, and the rows of priors: row, row + step, row + 2 step, ... False, and
    nothing is written, where a value is not finite."""
    for v in v_C:
        if not math.isfinite(v):
            return False
    for i in range(len(child_C)):
        state[child_C[i]].v = v_C[i]
    for i in range(len(state_N)):
        state[state_N[i]].row = row + i * step
    return True


@inlined
def is_known(reward, prob, discount, child, table_row, state, rules, s):  # type: ignore[no-untyped-def]
    """Whether a state can be expanded. Where all have one prior this may be found out here: if its outcomes are in the
    table, and its children have values."""
    if state[s].row >= 0:
        return True
    if not rules.uniform or state[s].row == WANTED or table_row[s] < 0:
        return False
    r = table_row[s]
    for a in range(prob.shape[1]):
        for k in range(prob.shape[2]):
            if _has_weight(reward, prob, discount, r, a, k) and math.isnan(state[child[r, a, k]].v):
                return False
    state[s].row = 0
    return True
