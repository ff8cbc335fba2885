"""Gradient steps of small networks of dense layers by compiled loops: a few microseconds beside those of torch."""

import math
from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from pgts_torch.agent.dense_forward import kernels, read_form
from pgts_torch.agent.networks import Network
from pgts_torch.agent.optimisers import Optimiser, refuse
from pgts_torch.ranks import Ranks

_NO_ACTIONS_N, _NOTHING_NA = np.zeros(0, np.int64), np.zeros((0, 0), np.float32)


@final
class DenseSteps:
    """Steps of an `Optimiser` on the weights of a network.

    Args:
        clip: the range of ratios outside which an objective is clipped, and the weight of entropy in it.
    """

    def __init__(self, network: Network, optimiser: Optimiser, clip: tuple[float, float, float]) -> None:
        self._network, self._optimiser, self._clip, self._kernels = network, optimiser, clip, kernels()
        *self._form, self._rows = read_form(network.dense_form)
        self._found_E = np.empty(network.num_weights + 2, np.float32)  # the gradient, the loss and a divergence

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
        theta_D = self._network.theta_D
        self._kernels.gradient(theta_D, *self._form, form, given, count, self._clip, self._rows, self._found_E)
        if ranks.size > 1:
            self._found_E[:] = ranks.sum(f"the gradient of {of}", torch.from_numpy(self._found_E)).numpy()
        loss, divergence = self._found_E[-2:].tolist()
        if most is not None and divergence > most:
            return None
        first_D, second_D, longest, *rates = self._optimiser.next_step(torch.from_numpy(theta_D))
        norm, size = self._kernels.descend(
            theta_D, self._found_E[:-2], first_D.numpy(), second_D.numpy(), longest, *rates
        )
        for what, number, where in (
            ("loss", loss, f"the {name} loss"),
            ("gradient", norm, f"the gradient of the {name} loss"),
            ("gradient", size, f"the step down the {name} loss"),
        ):
            if not math.isfinite(number):
                refuse(what, where, number)
        return norm, loss


def _arrays(part: Sequence[Tensor]) -> list[np.ndarray]:
    return [np.ascontiguousarray(column.numpy()) for column in part]


def dense_steps(
    network: Network, optimiser: Optimiser, clip: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> DenseSteps | None:
    """What takes steps by compiled loops where these save time, in many steps of a small network on the CPU; else
    None."""
    return DenseSteps(network, optimiser, clip) if compiles(network, optimiser) else None


def compiles(network: Network, optimiser: Optimiser) -> bool:
    """Whether the next step of this optimiser on a network is one of `DenseSteps`."""
    return network.is_dense and optimiser.compiles_all_of(network.num_weights, network.weights[0])


def compile_as_steps(network: Network, optimiser: Optimiser) -> None:
    """Compute outputs of a network by compiled loops as long as its steps are taken by such."""
    network.loops = lambda: compiles(network, optimiser)
