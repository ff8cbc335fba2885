"""How network policies move toward a target policy that the advantages of all actions name."""

from abc import abstractmethod
from typing import Any, final

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.networks import Network
from pgts_torch.agent.neural_updates import Batch, Move, NetworkUpdate, divergence, log_probs, mean, passes
from pgts_torch.options.updates import CMPO, Mirror


class TargetUpdate(NetworkUpdate):
    """A step of the policy's probabilities, projected onto the network by KL.

        minimise  mean_s w(s) KL(target(.|s) || pi(.|s)),    target(a|s) = pi_old(a|s) exp(step(s, a)) / Z

    over minibatches, the weights scaled to a mean of 1. The advantages must be of all actions: in the exponent, an
    estimate from one action is not unbiased.
    """

    options: Any

    @abstractmethod
    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        """step(s, a)."""

    def move(self, network: Network, batch: Batch, generator: torch.Generator) -> Move:
        """policy: mean_s w(s) KL(target || pi) after the steps; grad_norm: mean over the steps, before clipping.

        No step is taken where all actions are alike in all states: Adam would make one of the rounding."""
        old_NA, exponent_NA = log_probs(network, batch.input_N), self.exponent(batch)
        if not bool(exponent_NA.any()):
            return Move(old_NA, old_NA, {"policy": 0.0, "grad_norm": 0.0})
        target_NA = (old_NA + exponent_NA).log_softmax(-1)
        weight_N = batch.weight_N / batch.weight_N.mean()
        columns, norms = (batch.input_N, target_NA, weight_N), []
        made = passes(network, columns, self.options.num_epochs, self.options.minibatch_size, generator)
        for log_NA, (_, part_NA, part_N) in made:
            norms.append(self.step(network, mean(part_N, divergence(part_NA, log_NA))))
        new_NA = log_probs(network, batch.input_N)
        after = float(mean(weight_N, divergence(target_NA, new_NA)))
        return Move(old_NA, new_NA, {"policy": after, "grad_norm": sum(norms) / len(norms)})


@final
class NetworkMirrorUpdate(TargetUpdate):
    """The mirror step, step(s, a) = adv(s, a) / temperature (Tomar et al. 2022; Protopapas and Barakat 2024).

    A network that can be any policy ends where `MirrorUpdate` in reward units (normalize "none", floor None) with
    step_size * w(s) = 1 / temperature does.

    Args:
        options: those of networks.
    """

    def __init__(self, options: Mirror = Mirror()) -> None:  # noqa: B008 - frozen
        super().__init__(options.filled("networks"))

    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        return batch.advantage_NA.float() / self.options.temperature


@final
class CMPOUpdate(TargetUpdate):
    """Clipped MPO, step(s, a) = clip(adv(s, a) / (temperature scale), -clip, clip) (Hessel et al. 2021, Sec. 4).

        scale = mean_s w(s) mean_a |adv(s, a) - mean_b adv(s, b)|, and at least the noise

    The default for lookaheads: how far an action moves depends on how much better it is than usual, never on the scale
    of rewards, of which a factor of 2^k leaves every bit as it is. The scale is a mean and no root of a mean square:
    few states in which all depends on the action do not silence the many in which it matters a little.
    """

    def __init__(self, options: CMPO = CMPO()) -> None:  # noqa: B008 - frozen
        super().__init__(options)

    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        scale = max(advantage_scale(batch.advantage_NA, batch.weight_N), batch.noise)
        if scale == 0:  # all actions are alike
            return torch.zeros_like(batch.advantage_NA, dtype=torch.float32)
        return (
            (batch.advantage_NA / scale / self.options.temperature).clamp(-self.options.clip, self.options.clip).float()
        )


def advantage_scale(advantage_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"]) -> float:
    """mean_s w(s) mean_a |adv(s, a) - mean_b adv(s, b)|: how far apart the actions of a state are, in reward units."""
    apart_N = (advantage_NA - advantage_NA.mean(-1, keepdim=True)).abs().mean(-1).double()
    share_N = weight_N.double() / weight_N.double().sum()
    return float(share_N @ apart_N)
