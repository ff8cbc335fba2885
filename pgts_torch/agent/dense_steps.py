"""Gradient steps of small networks of dense layers by compiled loops, and their outputs: a few microseconds each
beside those of torch."""

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.networks import Network
from pgts_torch.agent.optimisers import Optimiser, refuse
from pgts_torch.ranks import Ranks

_MOST_PRODUCTS = 2**18
"""Multiplications in a product that BLAS computes in one thread."""

_NO_ACTIONS_N, _NOTHING_NA = np.zeros(0, np.int64), np.zeros((0, 0), np.float32)


@final
class DenseSteps:
    """Steps of an `Optimiser` on a copy of the weights, which `write` puts into the network.

    Args:
        clip: the range of ratios outside which an objective is clipped, and the weight of entropy in it.
    """

    def __init__(self, network: Network, optimiser: Optimiser, clip: tuple[float, float, float]) -> None:
        self._network, self._optimiser, self._clip = network, optimiser, clip
        self._kernels, self._theta_D = _kernels(), _theta(network)
        *self._form, self._rows = _form(*network.dense_form)
        # the gradient, the loss and a divergence
        self._found_E = np.zeros(len(self._theta_D) + 2, np.float32)

    def values(self, count: int, part: Sequence[Tensor], ranks: Ranks) -> tuple[float, float]:
        """Take a step down sum_n (value of the action - y)^2 / count. Return the norm of the gradient and the loss.

        Args:
            count: the rows of the minibatch in all processes.
            part: inputs, actions and y of those of this process.
        """
        input_NX, action_N, y_N = _arrays(part)
        given = input_NX, _NOTHING_NA, _NOTHING_NA, y_N, action_N
        stepped = self._step(self._kernels.VALUES, given, count, "value", "values", ranks, None)
        assert stepped is not None
        return stepped

    def policy(
        self, form: str, count: int, part: Sequence[Tensor], ranks: Ranks, most: float | None
    ) -> tuple[float, float] | None:
        """Take a step down the objective of a policy. Return as `values`; None where no step was taken.

        Args:
            form: "clipped": inputs, log pi before, advantages and weights. "free": the same, but log pi is that of the
                network, which is written into its column. "targets": inputs, the log of a target policy, weights.
            most: if KL(pi_old || pi) is above it no step is taken.
        """
        input_NX, *columns, weight_N = _arrays(part)
        given = input_NX, columns[0], columns[-1], weight_N, _NO_ACTIONS_N
        number = {"clipped": self._kernels.CLIPPED, "free": self._kernels.FREE, "targets": self._kernels.TARGETS}[form]
        return self._step(number, given, count, "policy", "the policy", ranks, most)

    def _step(
        self, form: int, given: tuple[Any, ...], count: int, name: str, of: str, ranks: Ranks, most: float | None
    ) -> tuple[float, float] | None:
        shape = self._theta_D, *self._form
        self._kernels.gradient(*shape, form, given, count, self._clip, self._rows, self._found_E)
        if ranks.size > 1:
            self._found_E[:] = ranks.sum(f"the gradient of {of}", torch.from_numpy(self._found_E)).numpy()
        loss, divergence = self._found_E[-2:].tolist()
        if most is not None and divergence > most:
            return None
        first_D, second_D, longest, *rates = self._optimiser.next_step(torch.from_numpy(self._theta_D))
        norm, size = self._kernels.descend(
            self._theta_D, self._found_E[:-2], first_D.numpy(), second_D.numpy(), longest, *rates
        )
        for what, number, where in (
            ("loss", loss, f"the {name} loss"),
            ("gradient", norm, f"the gradient of the {name} loss"),
            ("gradient", size, f"the step down the {name} loss"),
        ):
            if not math.isfinite(number):
                refuse(what, where, number)
        return norm, loss

    def write(self) -> None:
        """Put the weights into the network."""
        weights = list[Tensor](self._network.weights)
        pieces = torch.from_numpy(self._theta_D).split([weight.numel() for weight in weights])
        with torch.no_grad():
            torch._foreach_copy_(
                weights, [piece.view_as(weight) for piece, weight in zip(pieces, weights, strict=True)]
            )


def dense_outputs(network: Network, observation_N: Tensor) -> Float[Tensor, "N D"]:
    """`Network.outputs` of a dense network on the CPU by a compiled loop: the same up to rounding."""
    return network.outputs(observation_N, lambda input_NX: _outputs(network, input_NX))


def _outputs(network: Network, input_NX: Tensor) -> Tensor:
    size_L, is_tanh, rows = _form(*network.dense_form)
    out_ND = torch.empty(input_NX.shape[0], network.dense_form[0][-1], dtype=torch.float32)
    given, found = input_NX.contiguous().numpy(), out_ND.numpy()
    _kernels().outputs(_theta(network), size_L, is_tanh, given, rows, found)
    return out_ND


def _kernels() -> Any:
    from pgts_torch.agent import dense_kernels  # numba is imported with it

    return dense_kernels


@functools.cache
def _form(sizes: tuple[int, ...], is_tanh: bool) -> tuple[np.ndarray, bool, int]:
    """`Network.dense_form` as the loops read it, and how many rows are in a block."""
    products = max(a * b for a, b in itertools.pairwise(sizes))
    return np.array(sizes), is_tanh, max(1, _MOST_PRODUCTS // products)


def _theta(network: Network) -> np.ndarray:
    """A copy of all weights."""
    return torch.cat([weight.detach().view(-1) for weight in network.weights]).numpy()


def _arrays(part: Sequence[Tensor]) -> list[np.ndarray]:
    return [np.ascontiguousarray(column.numpy()) for column in part]


@contextmanager
def dense_steps(
    network: Network, optimiser: Optimiser, clip: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Iterator[DenseSteps | None]:
    """Within it steps are taken by compiled loops where these save time, in many steps of a small network on the
    CPU; else it is None. The network has them at the end."""
    if not (network.is_dense and optimiser.compiles_all_of(network.weights)):
        yield None
        return
    steps = DenseSteps(network, optimiser, clip)
    try:
        yield steps
    finally:
        steps.write()
