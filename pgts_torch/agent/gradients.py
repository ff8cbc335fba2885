"""Gradients of networks of dense layers, written out: the operations of autograd in its order, so with its bits, for
half the time where layers are small."""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pgts_torch.agent.networks import Network


@final
class Forward:
    """A pass of a batch through a network, which remembers what its gradient needs.

    Networks with other layers than dense ones, tanh and relu leave the gradient to autograd.

    network: it.   output_ND: its outputs, without gradient.
    """

    def __init__(self, network: Network, input_N: Float[Tensor, "N ..."]) -> None:
        self.network, self._graph_ND, self._values = network, None, [input_N]
        if network.is_dense:
            with torch.no_grad():
                for function in network.functions:
                    self._values.append(function(self._values[-1]))
            self.output_ND = self._values[-1]
        else:
            self._graph_ND = network(input_N)
            self.output_ND = self._graph_ND.detach()

    @torch.no_grad()
    def gradients(self, gradient_ND: Float[Tensor, "N D"]) -> list[Tensor]:
        """The gradient of a loss in each weight of the network, from that in its outputs."""
        if self._graph_ND is not None:
            if not len(self.output_ND):
                return [torch.zeros_like(weight) for weight in self.network.weights]
            unused = {"materialize_grads": True}
            return list(torch.autograd.grad(self._graph_ND, self.network.weights, gradient_ND, **unused))
        found: list[Tensor] = []
        layers, down_NX = self.network.layers, gradient_ND
        for k in reversed(range(len(layers))):
            layer, before_NX, after_NX = layers[k], self._values[k], self._values[k + 1]
            if isinstance(layer, nn.Linear):
                found += (down_NX.sum(0), down_NX.t() @ before_NX)
                # Nobody asks for the gradient in the inputs of the network.
                down_NX = down_NX @ layer.weight if k else down_NX
            elif isinstance(layer, nn.Tanh):
                down_NX = torch.ops.aten.tanh_backward(down_NX, after_NX)
            else:
                down_NX = torch.ops.aten.threshold_backward(down_NX, after_NX, 0)
        return found[::-1]


def through_log_softmax(log_NA: Float[Tensor, "N A"], gradient_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N A"]:
    """The gradient of a loss in logits, from that in their log_softmax:  g_a - pi_a sum_b g_b."""
    down_NA: Tensor = torch.ops.aten._log_softmax_backward_data(gradient_NA, log_NA, -1, log_NA.dtype)
    return down_NA
