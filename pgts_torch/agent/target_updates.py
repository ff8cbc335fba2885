"""How network policies move toward a target policy that the advantages of all actions name."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.networks import Network
from pgts_torch.agent.neural_updates import Batch, Move, NetworkUpdate, divergence, log_probs, mean, passes
from pgts_torch.agent.optimisers import check_count, check_positive


@dataclass(eq=False, kw_only=True)
class TargetUpdate(NetworkUpdate):
    """A step of the policy's probabilities, projected onto the network by KL.

        minimise  mean_s w(s) KL(target(.|s) || pi(.|s)),    target(a|s) = pi_old(a|s) exp(step(s, a)) / Z

    over minibatches, the weights scaled to a mean of 1. The advantages must be of all actions: in the exponent, an
    estimate from one action is not unbiased.

    Args:
        num_epochs, minibatch_size: passes over the batch, and observations in each step.
    """

    num_epochs: int = 10
    minibatch_size: int = 64

    @abstractmethod
    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        """step(s, a)."""

    def move(self, network: Network, batch: Batch, generator: torch.Generator) -> Move:
        """policy: mean_s w(s) KL(target || pi) after the steps; grad_norm: mean over the steps, before clipping."""
        old_NA = log_probs(network, batch.input_N)
        target_NA = (old_NA + self.exponent(batch)).log_softmax(-1)
        weight_N = batch.weight_N / batch.weight_N.mean()
        columns, norms = (batch.input_N, target_NA, weight_N), []
        made = passes(network, columns, self.num_epochs, self.minibatch_size, generator)
        for log_NA, (_, part_NA, part_N) in made:
            norms.append(self.step(network, mean(part_N, divergence(part_NA, log_NA))))
        new_NA = log_probs(network, batch.input_N)
        after = float(mean(weight_N, divergence(target_NA, new_NA)))
        return Move(old_NA, new_NA, {"policy": after, "grad_norm": sum(norms) / len(norms)})


@final
@dataclass(eq=False, kw_only=True)
class NetworkMirrorUpdate(TargetUpdate):
    """The mirror step, step(s, a) = adv(s, a) / temperature (Tomar et al. 2022; Protopapas and Barakat 2024).

    A network that can be any policy ends where `MirrorUpdate` with step_size * w(s) = 1 / temperature does.

    Args:
        temperature: in reward units; small ones make long steps.
    """

    temperature: float = 1.0

    def check_options(self) -> None:
        check_positive("temperature", self.temperature)
        check_count("num_epochs", self.num_epochs)
        check_count("minibatch_size", self.minibatch_size)

    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        return batch.advantage_NA.float() / self.temperature


@final
@dataclass(eq=False, kw_only=True)
class CMPOUpdate(TargetUpdate):
    """Clipped MPO, step(s, a) = clip(adv(s, a) / scale, -clip, clip) (Hessel et al. 2021, Sec. 4).

        scale^2 = mean_s w(s) mean_a (adv(s, a) - mean_b adv(s, b))^2, and at least noise^2

    The default for lookaheads: an action that is better by the usual difference gains one unit of log pi, whatever the
    scale of rewards. All rewards times 2^k leave every bit as it is.

    Args:
        clip: above 0; the most that an action gains or loses in log pi, before Z.
    """

    learning_rate: float = 1e-3
    clip: float = 1.0

    def check_options(self) -> None:
        check_positive("clip", self.clip)
        check_count("num_epochs", self.num_epochs)
        check_count("minibatch_size", self.minibatch_size)

    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        scale = max(advantage_scale(batch.advantage_NA, batch.weight_N), batch.noise)
        if scale == 0:  # all actions are alike
            return torch.zeros_like(batch.advantage_NA, dtype=torch.float32)
        return (batch.advantage_NA / scale).clamp(-self.clip, self.clip).float()


def advantage_scale(advantage_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"]) -> float:
    """How far apart the actions of a state are: the root of mean_s w(s) mean_a (adv(s, a) - mean_b adv(s, b))^2.

    Times 2^k, bit for bit, where the advantages are; what all actions of a state have in common does not count. Squares
    are taken of shares of the largest, so that they neither overflow nor vanish.
    """
    apart_NA = (advantage_NA - advantage_NA.mean(-1, keepdim=True)).double()
    largest = float(apart_NA.abs().max())
    if largest == 0:
        return 0.0
    share_N = weight_N.double() / weight_N.double().sum()
    return largest * math.sqrt(float(share_N @ (apart_NA / largest).square().mean(-1)))
