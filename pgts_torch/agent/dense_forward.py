"""Outputs of small networks of dense layers by compiled loops: a few microseconds beside those of torch."""

import functools
import itertools
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

_MOST_PRODUCTS = 2**18
"""Multiplications in a product that BLAS computes in one thread."""

DenseForm = tuple[tuple[int, ...], bool]
"""How many inputs there are and how many outputs each layer has; whether tanh follows these."""


@functools.cache
def kernels() -> Any:
    """The compiled loops; numba is imported with them."""
    from pgts_torch.agent import dense_kernels

    return dense_kernels


@functools.cache
def read_form(form: DenseForm) -> tuple[np.ndarray, bool, int]:
    """A form as the loops read it, and how many rows are in a block."""
    sizes, is_tanh = form
    products = max(a * b for a, b in itertools.pairwise(sizes))
    return np.array(sizes), is_tanh, max(1, _MOST_PRODUCTS // products)


def dense_outputs(
    theta_D: Float[np.ndarray, "P"], form: DenseForm, input_NX: Float[Tensor, "N X"]
) -> Float[Tensor, "N D"]:
    """`Network.forward` of a dense network on the CPU, without gradient: the same up to rounding."""
    size_L, is_tanh, rows = read_form(form)
    out_ND = np.empty((input_NX.shape[0], form[0][-1]), np.float32)
    kernels().outputs(theta_D, size_L, is_tanh, input_NX.contiguous().numpy(), rows, out_ND)
    return torch.from_numpy(out_ND)


def dense_choices(
    theta_D: Float[np.ndarray, "P"],
    form: DenseForm,
    input_NX: Float[Tensor, "N X"],
    random_NA: Float[Tensor, "N A"],
) -> Int[Tensor, "N"] | None:
    """The action with the largest pi(a|o) / E_a, for outputs that are logits and E_a = `random_NA`; None where these
    are no numbers."""
    size_L, is_tanh, rows = read_form(form)
    action_N = np.empty(input_NX.shape[0], np.int64)
    given = input_NX.contiguous().numpy(), random_NA.numpy()
    return torch.from_numpy(action_N) if kernels().choices(theta_D, size_L, is_tanh, *given, rows, action_N) else None
