"""Updates of network policies toward a target policy that is computed from the advantages of all actions."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgts_torch.agent import objectives
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.networks import Network
from pgts_torch.agent.neural_updates import NetworkUpdate
from pgts_torch.options.updates import CMPO, Mirror
from pgts_torch.ranks import ALONE, Ranks
from pgts_torch.readings import Readings


class TargetUpdate(NetworkUpdate):
    """A fit of the network to a target policy.

        minimise  mean_s w(s) KL(target(.|s) || pi(.|s)),    target(a|s) = pi_old(a|s) exp(step(s, a)) / Z

    over minibatches, with weights scaled to a mean of 1. It needs the advantages of all actions, because an estimate
    from one action is biased in the exponent.
    """

    options: Any
    form = "targets"

    @abstractmethod
    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        """Return step(s, a)."""

    def move(
        self, network: Network, input_N: Tensor, batch: Batch, generator: torch.Generator, readings: Readings
    ) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
        """Losses: policy, mean_s w(s) KL(target || pi) after the steps; grad_norm, mean over the steps, unclipped.

        Where step(s, a) is 0 everywhere no gradient step is taken, because Adam would turn rounding errors into one.
        """
        old_NA, exponent_NA = objectives.log_probs_before(network, input_N, batch), self.exponent(batch)
        if batch.ranks.totals("rows that move", exponent_NA.any()) == [0]:
            readings.add(policy=0.0, grad_norm=0.0)
            return old_NA, old_NA
        target_NA = objectives.log_softmax(old_NA + exponent_NA, batch.legal_NA)
        share = batch.ranks.share("rows", len(input_N))
        weight_N = batch.weight_N / share.mean("weights", batch.weight_N)
        columns = input_N, target_NA, weight_N
        parts = objectives.passes(objectives.with_legal(columns, batch.legal_NA), share, self.options, generator)
        for norm, _ in self.descend(network, parts, batch):
            readings.add(grad_norm=norm)
        new_NA = objectives.log_probs(network, input_N, batch.legal_NA)
        after = objectives.mean(weight_N, objectives.divergence(target_NA, new_NA), share.total)
        readings.add(policy=batch.ranks.sum("the loss of the policy", after))
        return old_NA, new_NA

    def objective(
        self, log_NA: Float[Tensor, "N A"], part: Sequence[Tensor], count: int
    ) -> tuple[Float[Tensor, "N A"], list[Tensor]]:
        target_NA, weight_N = part
        # Of KL(target || pi) in log pi it is -target, and so in the logits pi - target.
        down_NA = -(weight_N * (1 / count))[:, None] * target_NA.exp()
        return down_NA, [objectives.mean(weight_N, objectives.divergence(target_NA, log_NA), count)]


@final
class NetworkMirrorUpdate(TargetUpdate):
    """The mirror step, step(s, a) = adv(s, a) / temperature (Tomar et al. 2022; Protopapas and Barakat 2024).

    For a network that can represent any policy, the minimum is the step of `MirrorUpdate` in reward units (normalize
    "none", floor "never") with step_size * w(s) = 1 / temperature.

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

    The default with a lookahead. The step does not depend on the scale of rewards; a factor of 2^k changes no bit of
    the policy. The scale is a mean of absolute values, not a root mean square, so that a few states with very large
    advantages do not make the steps of all others negligible.
    """

    options: CMPO = CMPO()

    def exponent(self, batch: Batch) -> Float[Tensor, "N A"]:
        scale = advantage_scale(batch.advantage_NA, batch.weight_N, batch.ranks, batch.legal_NA).clamp(min=batch.noise)
        step_NA = batch.advantage_NA / scale / self.options.temperature
        # if all actions have the same advantage, scale is 0
        return torch.where(scale == 0, 0.0, step_NA.clamp(-self.now.clip, self.now.clip)).float()


def advantage_scale(
    advantage_NA: Float[Tensor, "N A"],
    weight_N: Float[Tensor, "N"],
    ranks: Ranks = ALONE,
    legal_NA: Bool[Tensor, "N A"] | None = None,
) -> Float[Tensor, ""]:
    """mean_s w(s) mean_a |adv(s, a) - mean_b adv(s, b)|, over the rows of all ranks and the legal actions: the mean
    size of advantages, in reward units."""
    if legal_NA is None:
        size_N = (advantage_NA - advantage_NA.mean(-1, keepdim=True)).abs().mean(-1).double()
    else:
        share_NA = legal_NA / legal_NA.sum(-1, keepdim=True)
        mean_N1 = (share_NA * advantage_NA).sum(-1, keepdim=True)
        size_N = (share_NA * (advantage_NA - mean_N1).abs()).sum(-1).double()
    total = ranks.sum("weights of advantages", weight_N.double().sum())
    return ranks.sum("the size of advantages", (weight_N.double() / total) @ size_N)
