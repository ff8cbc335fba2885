"""The Bellman backup as compiled loops over states: what `bellman.backup` and `bellman.sweep` use on the CPU.

    q(n, a) = sum_k w[n, a, k] v[child[n, a, k]] + r[n, a]

`reward` has N A numbers, `weight` and `child` have N A K, all flat. Children are unsigned, because numba looks after
negative ones in every access. They are not checked: the caller has done that.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pgts_torch.compiled import jit

_AHEAD = 64
"""How many outcomes ahead a value is fetched from memory."""

_CACHE, _NEAR = 2**20, 2**17
"""Bytes of values that a cache near the processor holds, and within which values are near each other."""


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
def back_up(reward, weight, child, A, K, v, times, q):  # type: ignore[no-untyped-def]
    """v after `times` sweeps v <- max_a q; with the last of them q is written too, unless it is empty."""
    N, size = len(reward) // A, weight.dtype.type(1)
    # Values are fetched ahead where a cache near the processor does not hold them, as far as there are outcomes.
    far = max(0, N - _AHEAD // (A * K) - 1) if is_scattered(child, A * K, v) else 0
    fours, all_k, none = np.uint64(K // 4 * 4), np.uint64(K), np.uint64(0)
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)  # a signed step is looked after too
    zero, ahead = size - size, np.uint64(_AHEAD)
    old, new = v, np.empty(N, v.dtype)
    for sweep in range(times):
        i, m = none, none  # counts outcomes, and pairs of state and action
        for n in range(N):
            fetches, highest = n < far, -np.inf * size
            for _ in range(A):
                # The order of the sum is that of torch's product in float64: of four at a time, the even and the odd
                # ones by themselves; then those that are left, one after another.
                even, odd = zero, zero
                end, end_of_fours = i + all_k, i + fours
                while i < end_of_fours:
                    if fetches:
                        _fetch(old, child[i + ahead])
                        _fetch(old, child[i + one + ahead])
                        _fetch(old, child[i + two + ahead])
                        _fetch(old, child[i + three + ahead])
                    even += weight[i] * old[child[i]]
                    odd += weight[i + one] * old[child[i + one]]
                    even += weight[i + two] * old[child[i + two]]
                    odd += weight[i + three] * old[child[i + three]]
                    i += four
                total = even + odd
                while i < end:
                    if fetches:
                        _fetch(old, child[i + ahead])
                    total += weight[i] * old[child[i]]
                    i += one
                total += reward[m]
                if len(q) and sweep == times - 1:
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
