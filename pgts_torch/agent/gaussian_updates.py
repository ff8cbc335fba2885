"""Updates of Gaussian policies, from actions that were drawn and their advantages.

`drawn` has K actions a_k of each state and the probabilities pi_hat of the policy over them (`Drawn`). With sampled
advantages K = 1, the action taken, with probability 1: then `GaussianGradientUpdate` is A2C and `GaussianPPOUpdate`
is PPO.
"""

import itertools
import math
from abc import abstractmethod
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.gaussian import GaussianPolicy, Normals
from pgts_torch.agent.gradients import Forward
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.objectives import check_numbers, in_own_units, mean
from pgts_torch.agent.optimisers import minibatches
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.stepped import SteppedUpdate
from pgts_torch.agent.target_updates import advantage_scale
from pgts_torch.options.updates import MPO, PPO, Gradient
from pgts_torch.readings import Readings
from pgts_torch.search.lookahead import check_finite

_LEAST = 1e-6
"""A variance, in that of the policy, below which there is none."""

_HALVINGS, _WIDEST = 40, 1e6
"""How often an interval of temperatures is halved, from this factor below the scale of advantages to it above."""


class GaussianUpdate(SteppedUpdate):
    """Gradient steps on the parameters of a Gaussian policy. Statistics of observations are treated as by
    `NetworkUpdate`.
    """

    policies = (GaussianPolicy,)

    def __call__(self, policy: Policy, batch: Batch, *, generator: torch.Generator) -> dict[str, float]:
        """Take the gradient steps.

        Returns:
            The losses and diagnostics of the update, with entropy: the mean entropy of the new pi in nats; kl: the mean
            KL(pi_old || pi); std: the mean standard deviation.

        Raises:
            NotFinite: an advantage, a weight, a loss, a gradient or the next policy is not finite. Policy and optimiser
                are as before.
            PgtsError: all weights are 0.
        """
        assert isinstance(policy, GaussianPolicy)
        assert batch.drawn is not None
        network, encoder, ranks = policy.network, policy.network.trunk.encoder, batch.ranks
        self._follow_schedules()
        with self._optimiser.attempt(network.tensors) as readings:
            check_numbers(batch, readings)
            if fresh := encoder.fresh:
                encoder.absorb(batch.observation_N, ranks)
            input_N = network.encode(batch.observation_N)
            before = batch.policy if isinstance(batch.policy, GaussianPolicy) else policy
            with torch.no_grad():
                old = before.read(before.network(input_N))
            self._descend(policy, input_N, old, batch, generator, readings)
            with torch.no_grad():
                new = policy.read(network(input_N))
            readings.check(new.entropy().sum(), lambda _: check_finite("probability", "the next policy", new[1], None))
            weight_N = batch.weight_N.float()
            share_N = weight_N / ranks.sum("weights", weight_N.sum())
            numbers = [new.entropy(), old.divergence(new), new.std_NX.mean(-1)]
            found_3 = ranks.sum("the next policy", torch.stack([share_N @ number_N for number_N in numbers]))
            readings.add(**dict(zip(("entropy", "kl", "std"), found_3, strict=True)))
            if not fresh:
                encoder.absorb(batch.observation_N, ranks)
        return readings.means

    def _descend(
        self,
        policy: GaussianPolicy,
        input_N: Tensor,
        old: Normals,
        batch: Batch,
        generator: torch.Generator,
        readings: Readings,
    ) -> None:
        """Take a step for each minibatch, until the policy has moved as far from the old one as the options allow."""
        network, ranks = policy.network, batch.ranks
        share = ranks.share("rows", len(input_N))
        weight_N = batch.weight_N.float()
        weight_N = weight_N / share.mean("weights", weight_N)
        columns = input_N, *old, weight_N, *self.aims(old, batch, weight_N)
        most = getattr(self.options, "target_kl", None)
        num_epochs, size = self._passes(share.total)
        passes = (minibatches(columns, size, share, generator=generator) for _ in range(num_epochs))
        for count, (rows_N, mean_NX, std_NX, scaled_N, *aims) in itertools.chain.from_iterable(passes):
            made = Forward(network, rows_N)
            now, was = policy.read(made.output_ND), Normals(mean_NX, std_NX)
            if most is not None:
                own = mean(scaled_N, was.divergence(now), count)
                if float(ranks.sum("the divergence", own)) > most:
                    return
            loss_N, down_mean_NX, down_log_std_NX = self.loss(now, was, *aims)
            down_N1 = (scaled_N * (1 / count))[:, None]
            down_ND = policy.through(made.output_ND, down_N1 * down_mean_NX, down_N1 * down_log_std_NX)
            found = made.gradients(down_ND), mean(scaled_N, loss_N, count)
            gradients, (loss,) = ranks.summed("the gradient of the policy", *found)
            readings.add(policy=loss, grad_norm=self._optimiser.step(network.weights, gradients, loss, "policy"))

    def _passes(self, rows: int) -> tuple[int, int]:
        """How many passes over how large minibatches."""
        return self.options.num_epochs, self.options.minibatch_size

    @abstractmethod
    def aims(self, old: Normals, batch: Batch, weight_N: Float[Tensor, "N"]) -> tuple[Tensor, ...]:
        """What `loss` needs of each row, from the policy that the batch is of and weights with a mean of 1."""

    @abstractmethod
    def loss(
        self, now: Normals, old: Normals, *aims: Tensor
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N X"], Float[Tensor, "N X"]]:
        """The loss of each row, and its gradient in mean and log std of the present policy."""


@final
class MPOUpdate(GaussianUpdate):
    """Weighted regression within a trust region (MPO; Abdolmaleki et al. 2018a, 2018b), over drawn actions.

    The improved policy over them is, with a temperature eta that is found as the root of a decreasing function,

        q_k ~ pi_hat_k exp(adv_k / eta),        mean_s w(s) KL(q || pi_hat) = kl

    Its moments, as differences to those of pi_hat, so that what is due to the draw alone cancels, are

        mean' = mean + std x,    x = sum_k (q_k - pi_hat_k) z_k,    z_k = (a_k - mean) / std
        std'^2 = std^2 V(q) / V(pi_hat),    V(w) = [sum_k w_k z_k^2 - (sum_k w_k z_k)^2] / (1 - sum_k w_k^2)

    V is a variance with Bessel's correction for weights, without which advantages that have nothing to do with actions
    would narrow the policy in each iteration. It is taken around the new mean: around the old one a mean that keeps
    moving would be taken for spread and widen the policy without end. Each moves no farther than a divergence allows: x
    is shortened to x^2 / 2 <= kl_mean, and |log std' - log std| of each entry is at most sqrt(kl_std). The network is
    fitted to both:

        minimise  mean_s w(s) sum_x [ (mean' - mean_theta)^2 / (2 std^2) + log std_theta + std'^2 / (2 std_theta^2) ]

    The step does not depend on the scale of rewards. Where all advantages are 0 there is none.
    """

    options: MPO = MPO()

    def aims(self, old: Normals, batch: Batch, weight_N: Float[Tensor, "N"]) -> tuple[Tensor, ...]:
        assert batch.drawn is not None
        q_NK, prob_NK = self.improved(batch, weight_N), batch.drawn.prob_NK
        z_NKX = old.standardised(batch.drawn.action_NKX)
        shift_NX = ((q_NK - prob_NK)[..., None] * z_NKX).sum(1)
        spread_NX = (_variance(q_NK, z_NKX) + _LEAST) / (_variance(prob_NK, z_NKX) + _LEAST)
        length_N1 = shift_NX.square().sum(-1, keepdim=True)
        shift_NX = shift_NX * (2 * self.options.kl_mean / length_N1).sqrt().clamp(max=1)  # inf where it is 0
        most = math.sqrt(self.options.kl_std)
        log_ratio_NX = (spread_NX.log() / 2).clamp(-most, most)
        return old.mean_NX + old.std_NX * shift_NX, old.std_NX * log_ratio_NX.exp()

    def improved(self, batch: Batch, weight_N: Float[Tensor, "N"]) -> Float[Tensor, "N K"]:
        """q over the drawn actions; pi_hat where all advantages are 0."""
        assert batch.drawn is not None
        prob_NK, log_NK = batch.drawn.prob_NK, batch.drawn.prob_NK.log()
        advantage_NK, share_N = batch.advantage_NA.double(), weight_N.double()
        scale = advantage_scale(batch.advantage_NA, batch.weight_N, batch.ranks)
        low, high = scale / _WIDEST, scale * _WIDEST
        total = batch.ranks.sum("weights of rows", share_N.sum())

        def improved(eta: Tensor) -> Tensor:
            return torch.log_softmax(log_NK.double() + advantage_NK / eta, -1)

        for _ in range(_HALVINGS):
            eta = (low * high).sqrt()
            q_NK = improved(eta)
            divergence_N = torch.where(prob_NK > 0, q_NK.exp() * (q_NK - log_NK), 0.0).sum(-1)
            too_far = batch.ranks.sum("the divergence", share_N @ divergence_N) / total > self.options.kl
            low, high = torch.where(too_far, eta, low), torch.where(too_far, high, eta)
        return torch.where(scale > 0, improved(high).exp(), prob_NK.double()).to(prob_NK.dtype)

    def loss(
        self, now: Normals, old: Normals, *aims: Tensor
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N X"], Float[Tensor, "N X"]]:
        mean_NX, std_NX = aims
        off_NX, square_NX = (now.mean_NX - mean_NX) / old.std_NX, (std_NX / now.std_NX).square()
        loss_NX = off_NX.square() / 2 + square_NX / 2 - (std_NX / now.std_NX).log() - 0.5
        return loss_NX.sum(-1), off_NX / old.std_NX, 1 - square_NX


@final
class GaussianGradientUpdate(GaussianUpdate):
    """One step up the gradient over all drawn actions.

        maximise  sum_s w(s) [ sum_k pi_hat_k log pi(a_k|s) adv_k + entropy_coef H(pi(.|s)) ]

    At the policy that drew them its gradient is an estimate of that of E_pi adv.
    """

    options: Gradient = Gradient()

    def _passes(self, rows: int) -> tuple[int, int]:
        return 1, rows

    def aims(self, old: Normals, batch: Batch, weight_N: Float[Tensor, "N"]) -> tuple[Tensor, ...]:
        drawn = batch.drawn
        assert drawn is not None
        # A sum with weights as they are given, where the loss is a mean with weights whose mean is 1.
        factor = batch.ranks.sum("weights", batch.weight_N.float().sum())
        gain_NK = factor * drawn.prob_NK * batch.advantage_NA.float()
        return drawn.action_NKX, gain_NK, factor.expand(len(weight_N))

    def loss(
        self, now: Normals, old: Normals, *aims: Tensor
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N X"], Float[Tensor, "N X"]]:
        action_NKX, gain_NK, factor_N = aims
        coef = self.now.entropy_coef
        loss_N = -(gain_NK * now.log_density(action_NKX)).sum(-1) - coef * factor_N * now.entropy()
        mean_NX, log_std_NX = _slopes(now, action_NKX, gain_NK)
        return loss_N, -mean_NX, -log_std_NX - coef * factor_N[:, None]


@final
class GaussianPPOUpdate(GaussianUpdate):
    """Many small steps up an objective that is clipped where a density has changed enough (Schulman et al. 2017).

        maximise  mean_s w(s) [ sum_k pi_hat_k min(rho_k adv_k, clip(rho_k, 1 - clip_range, 1 + clip_range) adv_k)
                                + entropy_coef H(pi(.|s)) ],        rho_k = pi(a_k|s) / pi_old(a_k|s)

    `normalize_advantage` and `target_kl` are those of `PPOUpdate`.
    """

    options: PPO = PPO()

    def aims(self, old: Normals, batch: Batch, weight_N: Float[Tensor, "N"]) -> tuple[Tensor, ...]:
        drawn, advantage_NK = batch.drawn, batch.advantage_NA.float()
        assert drawn is not None
        if self.options.normalize_advantage:
            share = batch.ranks.share("rows", len(weight_N))
            advantage_NK = in_own_units(advantage_NK, drawn.prob_NK, weight_N, share)
        return drawn.action_NKX, drawn.prob_NK, advantage_NK, old.log_density(drawn.action_NKX)

    def loss(
        self, now: Normals, old: Normals, *aims: Tensor
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N X"], Float[Tensor, "N X"]]:
        action_NKX, prob_NK, advantage_NK, before_NK = aims
        low, high, coef = 1 - self.now.clip_range, 1 + self.now.clip_range, self.now.entropy_coef
        ratio_NK = (now.log_density(action_NKX) - before_NK).exp()
        free_NK = ratio_NK * advantage_NK
        least_NK = torch.minimum(free_NK, ratio_NK.clamp(low, high) * advantage_NK)
        gain_NK = prob_NK * torch.where(least_NK == free_NK, free_NK, 0.0)
        mean_NX, log_std_NX = _slopes(now, action_NKX, gain_NK)
        loss_N = -(prob_NK * least_NK).sum(-1)
        return loss_N, -mean_NX, -log_std_NX - coef


def _slopes(
    now: Normals, action_NKX: Float[Tensor, "N K X"], gain_NK: Float[Tensor, "N K"]
) -> tuple[Float[Tensor, "N X"], Float[Tensor, "N X"]]:
    """sum_k gain_k times the gradient of log pi(a_k|s) in mean and log std."""
    z_NKX = now.standardised(action_NKX)
    weighted_NKX = gain_NK[..., None] * z_NKX
    return weighted_NKX.sum(1) / now.std_NX, (weighted_NKX * z_NKX - gain_NK[..., None]).sum(1)


def _variance(weight_NK: Float[Tensor, "N K"], z_NKX: Float[Tensor, "N K X"]) -> Float[Tensor, "N X"]:
    """V(w); 0 where one draw has all the weight."""
    mean_N1X = (weight_NK[..., None] * z_NKX).sum(1, keepdim=True)
    square_NX = (weight_NK[..., None] * (z_NKX - mean_N1X).square()).sum(1)
    return square_NX / (1 - weight_NK.square().sum(1, keepdim=True)).clamp(min=_LEAST)
