"""Steps of Adam as compiled loops: `Optimiser` uses them for small networks on the CPU, where calls of torch take
longer than the numbers.

Every number is rounded as torch rounds it, so no bit depends on whether they are used (on processors where torch rounds
as here). Square roots are left to torch, which does not round all of them to the nearest number.
"""

from typing import Any

import numpy as np
from numba.extending import intrinsic

from pgts_torch.compiled import jit


@intrinsic
def _fused(context: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, rounded once, as in torch's vectors."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, a, a), code


@jit
def move_moments(gradient_D, norm, longest, first_D, second_D, first_rate, second_keep, second_rate):  # type: ignore[no-untyped-def]
    """Shorten a gradient of this norm to `longest`, and move the moments toward it and toward its square."""
    number, share = gradient_D.dtype.type, longest / np.float64(norm[()])
    scale, first_rate = number(1.0 if share > 1 else share), number(first_rate)
    second_keep, second_rate = number(second_keep), number(second_rate)
    for d in range(len(gradient_D)):
        gradient = gradient_D[d] * scale
        first_D[d] = _fused(first_rate, gradient - first_D[d], first_D[d])
        second_D[d] = _fused(second_rate * gradient, gradient, second_D[d] * second_keep)


@jit
def steps(first_D, root_D, epsilon, rate, total):  # type: ignore[no-untyped-def]
    """Write rate first / (root + epsilon) in place of the roots, and their sum as `total`."""
    number = first_D.dtype.type
    epsilon, rate, added = number(epsilon), number(rate), number(0)
    for d in range(len(first_D)):
        root_D[d] = first_D[d] / (root_D[d] + epsilon) * rate
        added += root_D[d]
    total[()] = added
