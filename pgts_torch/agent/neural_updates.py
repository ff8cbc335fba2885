"""Updates of network policies: gradient steps on an objective over all actions at the visited observations.

`advantage_NA` are either the advantages of all actions, q - <pi, q>, or the estimate of `advantages.score_function`
from the action taken, A_t / pi(a_t|s_t) for it and 0 for the others, a row for each visit. With the latter,
`GradientUpdate` is A2C and `PPOUpdate` is PPO:

    sum_a pi(a|s) adv(s, a)                                     has the gradient of   log pi(a_t|s_t) A_t
    sum_a pi_old(a|s) min(rho_a adv, clip(rho_a) adv)           is                    min(rho A_t, clip(rho) A_t)
"""

import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgts_torch.agent import objectives
from pgts_torch.agent.components import legal_only
from pgts_torch.agent.dense_steps import dense_steps
from pgts_torch.agent.gradients import Forward, through_log_softmax
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.networks import Network
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.stepped import SteppedUpdate
from pgts_torch.options.updates import PPO, Gradient
from pgts_torch.ranks import Ranks
from pgts_torch.readings import Readings
from pgts_torch.search.lookahead import check_finite


class NetworkUpdate(SteppedUpdate):
    """Gradient steps on the parameters of a network policy.

    form: what its objective is for `DenseSteps.policy`.

    The batch is added to running statistics of observations after the steps, so that these start from the policy that
    collected it; only the first batch of all is added before.
    """

    policies = (NetworkPolicy,)
    form: str

    def __call__(self, policy: Policy, batch: Batch, *, generator: torch.Generator) -> dict[str, float]:
        """Take the gradient steps.

        Returns:
            The losses and diagnostics of the update, with entropy: the mean entropy of the new pi in nats, and kl: the
            mean KL(pi_old || pi).

        Raises:
            NotFinite: an advantage, a weight, a loss, a gradient or the next policy is not finite. Policy and optimiser
                are as before.
            PgtsError: all weights are 0.
        """
        assert isinstance(policy, NetworkPolicy)
        network, encoder = policy.network, policy.network.encoder
        self._follow_schedules()
        ranks = batch.ranks
        with self._optimiser.attempt(network.tensors) as readings:
            if (legal_NA := encoder.legal(batch.observation_N)) is not None:
                batch = replace(batch, advantage_NA=legal_only(batch.advantage_NA, legal_NA, 0.0), legal_NA=legal_NA)
            objectives.check_numbers(batch, readings)
            if fresh := encoder.fresh:
                encoder.absorb(batch.observation_N, ranks)
            weight_N = batch.weight_N.float()
            input_N = network.encode(batch.observation_N)
            old_NA, new_NA = self.move(network, input_N, replace(batch, weight_N=weight_N), generator, readings)
            readings.check(new_NA.sum(), lambda _: check_finite("probability", "the next policy", new_NA, None))
            weight_N = weight_N / ranks.sum("weights", weight_N.sum())
            entropy_N, kl_N = objectives.entropy(new_NA), objectives.divergence(old_NA, new_NA)
            found = torch.stack([weight_N @ entropy_N, weight_N @ kl_N])
            readings.add(**dict(zip(("entropy", "kl"), ranks.sum("the next policy", found), strict=True)))
            if not fresh:
                encoder.absorb(batch.observation_N, ranks)
        return readings.means

    @abstractmethod
    def move(
        self, network: Network, input_N: Tensor, batch: Batch, generator: torch.Generator, readings: Readings
    ) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
        """Take the gradient steps of this kind of update, and add losses and diagnostics to the readings.

        Args:
            input_N: the encoded observations of the batch, as all its rows those of this process.

        Returns:
            log pi before and after the steps, without gradient.
        """

    @abstractmethod
    def objective(
        self, log_NA: Float[Tensor, "N A"], part: Sequence[Tensor], count: int
    ) -> tuple[Float[Tensor, "N A"], list[Tensor]]:
        """Return the gradient of the loss in log pi(a|s), and these rows' parts of the loss and of KL(pi_old || pi).

        Args:
            part: the columns of a minibatch but for its inputs, as `DenseSteps.policy` takes them.
            count: its rows, these and those of other processes.
        """

    def descend(
        self,
        network: Network,
        parts: Iterable[tuple[int, Sequence[Tensor]]],
        batch: Batch,
        *,
        clip: tuple[float, float, float] = (0.0, 0.0, 0.0),
        most: float | None = None,
    ) -> Iterator[tuple[Tensor | float, Tensor | float]]:
        """Take a step for each minibatch. Yield the norm of the gradient and the loss.

        Args:
            parts: how many rows the minibatch has in all processes, and those of this one (`with_legal`).
            clip: the range of ratios, and the weight of entropy.
            most: steps end once KL(pi_old || pi) is above it.
        """
        has_mask = batch.legal_NA is not None
        steps = None if has_mask else dense_steps(network, self._optimiser, clip)
        for count, part in parts:
            stepped: tuple[Tensor | float, Tensor | float] | None
            if steps is None:
                rows, legal_NA = (part[:-1], part[-1]) if has_mask else (part, None)
                stepped = self._step(network, count, rows, legal_NA, batch.ranks, most)
            else:
                stepped = steps.policy(self.form, count, part, batch.ranks, most)
            if stepped is None:
                return
            yield stepped

    def _step(
        self,
        network: Network,
        count: int,
        part: Sequence[Tensor],
        legal_NA: Bool[Tensor, "N A"] | None,
        ranks: Ranks,
        most: float | None,
    ) -> tuple[Tensor, Tensor] | None:
        made = Forward(network, part[0])
        log_NA = objectives.log_softmax(made.output_ND, legal_NA)
        down_NA, losses = self.objective(log_NA, part[1:], count)
        own = made.gradients(through_log_softmax(log_NA, down_NA))
        gradients, sums = ranks.summed("the gradient of the policy", own, *losses)
        if most is not None and float(sums[1]) > most:
            return None
        return self._optimiser.step(network.weights, gradients, sums[0], "policy"), sums[0]


@final
class GradientUpdate(NetworkUpdate):
    """One step up the all-action policy gradient; with sampled advantages, A2C (Mnih et al. 2016).

        maximise  sum_s w(s) [ sum_a pi(a|s) adv(s, a) + entropy_coef H(pi(.|s)) ]

    With one-hot states, no hidden layer and plain gradient descent it is `SoftmaxUpdate`.
    """

    options: Gradient = Gradient()
    form = "free"

    def move(
        self, network: Network, input_N: Tensor, batch: Batch, generator: torch.Generator, readings: Readings
    ) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
        """Losses: policy, minus the objective without entropy, before the step; grad_norm, before clipping."""
        old_NA = torch.empty(batch.advantage_NA.shape, dtype=input_N.dtype, device=input_N.device)
        rows = objectives.with_legal([input_N, old_NA, batch.advantage_NA.float(), batch.weight_N], batch.legal_NA)
        for norm, loss in self.descend(network, [(1, rows)], batch, clip=(0.0, math.inf, self.now.entropy_coef)):
            readings.add(policy=loss, grad_norm=norm)
        return old_NA, objectives.log_probs(network, input_N, batch.legal_NA)

    def objective(
        self, log_NA: Float[Tensor, "N A"], part: Sequence[Tensor], count: int
    ) -> tuple[Float[Tensor, "N A"], list[Tensor]]:
        (old_NA, slope_NA, weight_N), coef, pi_NA = part, self.now.entropy_coef, log_NA.exp()
        old_NA.copy_(log_NA)
        loss = -(weight_N @ (pi_NA * slope_NA).sum(-1))
        if coef:
            # sum_a pi (adv - coef (log pi + 1)) d log pi  is the change of the objective of a state.
            slope_NA = slope_NA - coef * (log_NA + 1)
        return -weight_N[:, None] * slope_NA * pi_NA, [loss]


@final
class PPOUpdate(NetworkUpdate):
    """Many small steps up an objective that is clipped where pi has changed enough (Schulman et al. 2017).

        maximise  mean_s w(s) [ sum_a pi_old(a|s) min(rho_a adv, clip(rho_a, 1 - clip_range, 1 + clip_range) adv)
                                + entropy_coef H(pi(.|s)) ],        rho_a = pi(a|s) / pi_old(a|s)

    over minibatches, with weights scaled to a mean of 1. `normalize_advantage` divides by the square root of
    mean_s w(s) (sum_a pi_old(a|s) |adv(s, a)|)^2; for sampled advantages that is their root mean square. No mean is
    subtracted, because it is 0 under pi. The steps end once the mean KL(pi_old || pi) of a minibatch exceeds
    `target_kl`.
    """

    options: PPO = PPO()
    form = "clipped"

    def move(
        self, network: Network, input_N: Tensor, batch: Batch, generator: torch.Generator, readings: Readings
    ) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
        """Losses: policy, minus the objective without entropy, mean over the steps; grad_norm, mean, before clipping;
        clip_fraction, the probability of actions whose rho is out of range after the steps; num_steps."""
        old_NA, advantage_NA = objectives.log_probs_before(network, input_N, batch), batch.advantage_NA.float()
        share = batch.ranks.share("rows", len(input_N))
        weight_N = batch.weight_N / share.mean("weights", batch.weight_N)
        if self.options.normalize_advantage:
            advantage_NA = objectives.in_own_units(advantage_NA, old_NA.exp(), weight_N, share)
        columns, num_steps, clip = [input_N, old_NA, advantage_NA, weight_N], 0, self.now.clip_range
        parts = objectives.passes(objectives.with_legal(columns, batch.legal_NA), share, self.options, generator)
        clips = 1 - clip, 1 + clip, self.now.entropy_coef
        for norm, loss in self.descend(network, parts, batch, clip=clips, most=self.options.target_kl):
            readings.add(policy=loss, grad_norm=norm)
            num_steps += 1
        new_NA = objectives.log_probs(network, input_N, batch.legal_NA)
        outside_NA = ((new_NA - old_NA).exp() - 1).abs() > self.now.clip_range
        clipped = objectives.mean(weight_N, (old_NA.exp() * outside_NA).sum(-1), share.total)
        readings.add(clip_fraction=batch.ranks.sum("clipped", clipped), num_steps=num_steps)
        return old_NA, new_NA

    def objective(
        self, log_NA: Float[Tensor, "N A"], part: Sequence[Tensor], count: int
    ) -> tuple[Float[Tensor, "N A"], list[Tensor]]:
        """The gradient is that of minus the objective:

            -w(s) / count pi(a|s) ( adv(s, a) 1(not clipped) - entropy_coef (log pi(a|s) + 1) )

        It is written out because autograd through these operations would cost as much as the network itself.
        """
        old_NA, advantage_NA, weight_N = part
        ratio_NA, pi_NA = (log_NA - old_NA).exp(), log_NA.exp()
        low, high, coef = 1 - self.now.clip_range, 1 + self.now.clip_range, self.now.entropy_coef
        free_NA = ratio_NA * advantage_NA
        least_NA = torch.minimum(free_NA, ratio_NA.clamp(low, high) * advantage_NA)
        slope_NA = torch.where(least_NA == free_NA, advantage_NA, 0.0)
        if coef:
            slope_NA = slope_NA - coef * (log_NA + 1)
        losses = [-objectives.mean(weight_N, (old_NA.exp() * least_NA).sum(-1), count)]
        if self.options.target_kl is not None:
            losses.append(objectives.mean(weight_N, objectives.divergence(old_NA, log_NA), count))
        return -(pi_NA * slope_NA) * (weight_N / count)[:, None], losses
