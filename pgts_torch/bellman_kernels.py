"""The Bellman backup as compiled loops over states: what `bellman.backup` and `bellman.sweep` use on the CPU.

    q(n, a) = sum_k w[n, a, k] v[child[n, a, k]] + r[n, a]

`reward` has N A numbers, `weight` and `child` have N A K, all flat. Children are unsigned, because numba looks after
negative ones in every access. They are not checked: the caller has done that.
"""

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pgts_torch.compiled import allocating, jit

_AHEAD = 64
"""How many outcomes ahead a value is fetched from memory."""

_READ_AHEAD = 512
"""How many outcomes ahead their weights and children are."""

_CACHE, _NEAR, _LINE = 2**20, 2**17, 64
"""Bytes that a cache near the processor holds, within which values are near each other, and that it reads at once."""


@intrinsic
def _fetch(context: Any, values: Any, index: Any) -> Any:
    """Ask the processor for values[index], which is read soon."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.bitcast(builder.gep(array.data, [arguments[1]]), ir.IntType(8).as_pointer())
        int32 = ir.IntType(32)
        function = ir.FunctionType(ir.VoidType(), [place.type, int32, int32, int32])
        # For reading (0), to be kept in all caches (3), data (1).
        builder.call(
            builder.module.declare_intrinsic("llvm.prefetch", [place.type], function),
            [place, int32(0), int32(3), int32(1)],
        )
        return context.get_dummy_value()

    return types.void(values, index), code


@jit
def is_scattered(child, outcomes, v):  # type: ignore[no-untyped-def]
    """Whether most of 64 neighbouring states have children far from each other, and no cache holds all values."""
    if v.nbytes <= _CACHE:
        return False
    N, balance = len(child) // outcomes, 0
    for k in range(1, 65):
        n = k * (N - 1) // 64
        one, other = np.int64(child[n * outcomes]), np.int64(child[max(n - 1, 0) * outcomes])
        balance += 1 if abs(one - other) * v.itemsize > _NEAR else -1
    return balance > 0


@jit
def is_finite(v):  # type: ignore[no-untyped-def]
    """Whether all values are."""
    off = 0
    for x in v:
        off += not math.isfinite(x)
    return off == 0


@allocating
def back_up(reward, weight, child, A, K, v, times, q):  # type: ignore[no-untyped-def]
    """v after `times` sweeps v <- max_a q; with the last of them q is written too, unless it is empty."""
    N, size = len(reward) // A, weight.dtype.type(1)
    # What caches near the processor do not hold is fetched ahead, as far as there are outcomes: the table, which is
    # read in order, and where they are scattered also the values.
    far = max(0, N - _AHEAD // (A * K) - 1) if weight.nbytes + child.nbytes > _CACHE else 0
    scattered = far > 0 and is_scattered(child, A * K, v)
    fours, rest, outcomes, none = np.uint64(K // 4 * 4), np.uint64(K % 4), np.uint64(A * K), np.uint64(0)
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)  # a signed step is looked after too
    line, child_line = np.uint64(_LINE // weight.itemsize), np.uint64(_LINE // child.itemsize)
    lines, child_lines = (outcomes + line - one) // line, (outcomes + child_line - one) // child_line
    zero, ahead, read_ahead = size - size, np.uint64(_AHEAD), np.uint64(_READ_AHEAD)
    old, new = v, np.empty(N, v.dtype)
    for sweep in range(times):
        writes = len(q) > 0 and sweep == times - 1
        i, m = none, none  # counts outcomes, and pairs of state and action
        for n in range(N):
            if n < far:
                _fetch(reward, m + line)
                for j in range(lines):
                    _fetch(weight, i + read_ahead + j * line)
                for j in range(child_lines):
                    _fetch(child, i + read_ahead + j * child_line)
                if scattered:
                    for j in range(i + ahead, i + ahead + outcomes):
                        _fetch(old, child[j])
            highest = -np.inf * size
            for _ in range(A):
                # The order of the sum is that of torch's product in float64: of four at a time, the even and the odd
                # ones by themselves; then those that are left, one after another.
                total = zero
                if fours > none:
                    even, odd, end_of_fours = zero, zero, i + fours
                    while i < end_of_fours:
                        even += weight[i] * old[child[i]]
                        odd += weight[i + one] * old[child[i + one]]
                        even += weight[i + two] * old[child[i + two]]
                        odd += weight[i + three] * old[child[i + three]]
                        i += four
                    total = even + odd
                if rest > none:  # a loop would cost twice as much
                    total += weight[i] * old[child[i]]
                    if rest > one:
                        total += weight[i + one] * old[child[i + one]]
                        if rest > two:
                            total += weight[i + two] * old[child[i + two]]
                    i += rest
                total += reward[m]
                if writes:
                    q[m] = total
                m += one
                if total > highest or total != total:  # what is not a number stays
                    highest = total
            new[n] = highest
        # The values that were given stay as they are; afterwards two buffers take turns.
        if sweep == 0:
            old, new = new, np.empty(N if times > 1 else 0, v.dtype)
        else:
            old, new = new, old
    return old
