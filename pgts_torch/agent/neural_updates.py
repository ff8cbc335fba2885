"""Updates of network policies: gradient steps on an objective over all actions at the visited observations.

`advantage_NA` are either the advantages of all actions, q - <pi, q>, or the estimate of `advantages.score_function`
from the action taken, A_t / pi(a_t|s_t) for it and 0 for the others, a row for each visit. With the latter,
`GradientUpdate` is A2C and `PPOUpdate` is PPO:

    sum_a pi(a|s) adv(s, a)                                     has the gradient of   log pi(a_t|s_t) A_t
    sum_a pi_old(a|s) min(rho_a adv, clip(rho_a) adv)           is                    min(rho A_t, clip(rho) A_t)
"""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgts_torch.agent.components import legal_only
from pgts_torch.agent.gradients import Forward, through_log_softmax
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.networks import Network
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.optimisers import Optimiser, minibatches
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.updates import Update
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.options.fields import limit
from pgts_torch.options.schedules import at
from pgts_torch.options.updates import PPO, Gradient
from pgts_torch.ranks import Ranks, Share
from pgts_torch.readings import Readings
from pgts_torch.search.lookahead import check_finite

_LOG_OF_ZERO = -1e4
"""In place of log pi(a|s) = -inf of an action that is not legal: its exp is 0, and 0 times it is no NaN."""


class NetworkUpdate(Update):
    """Gradient steps on the parameters of a network policy.

    now: the options, with the present values of those that are schedules.

    The batch is added to running statistics of observations after the steps, so that these start from the policy that
    collected it; only the first batch of all is added before.
    """

    policies = (NetworkPolicy,)

    def __init__(self, options: Any) -> None:
        self.options, self.state_weight = options, options.state_weight
        self.now = at(options, 0)
        self._optimiser = Optimiser(
            learning_rate=self.now.learning_rate,
            max_grad_norm=limit(options.max_grad_norm),
            method=options.optimizer,
        )

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
        network, encoder = policy.network, policy.network.trunk.encoder
        self.now = at(self.options, self.num_env_steps)
        self._optimiser.learning_rate = self.now.learning_rate
        ranks = batch.ranks
        with self._optimiser.attempt(network.tensors) as readings:
            if (legal_NA := encoder.legal(batch.observation_N)) is not None:
                batch = replace(batch, advantage_NA=legal_only(batch.advantage_NA, legal_NA, 0.0), legal_NA=legal_NA)
            _check_numbers(batch, readings)
            if fresh := encoder.fresh:
                encoder.absorb(batch.observation_N, ranks)
            weight_N = batch.weight_N.float()
            input_N = network.encode(batch.observation_N)
            old_NA, new_NA = self.move(network, input_N, replace(batch, weight_N=weight_N), generator, readings)
            readings.check(new_NA.sum(), lambda _: check_finite("probability", "the next policy", new_NA, None))
            weight_N = weight_N / ranks.sum("weights", weight_N.sum())
            found = torch.stack([weight_N @ entropy(new_NA), weight_N @ divergence(old_NA, new_NA)])
            readings.add(**dict(zip(("entropy", "kl"), ranks.sum("the next policy", found), strict=True)))
            if not fresh:
                encoder.absorb(batch.observation_N, ranks)
        return readings.means

    def state_dict(self) -> dict[str, Any]:
        return self._optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._optimiser.load_state_dict(state)

    def check(self, policy: Policy) -> None:
        super().check(policy)
        if isinstance(policy, NetworkPolicy):
            self._optimiser.check_fits(policy.network.weights)

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

    def step(
        self, made: Forward, down_NA: Float[Tensor, "N A"], ranks: Ranks, *losses: Tensor, most: float | None = None
    ) -> tuple[Tensor, Sequence[Tensor]] | None:
        """Take one step (see `Optimiser.step`) down the sum of a loss over ranks.

        Args:
            made: the pass of the rows of this process.
            down_NA: the gradient of its part of the loss in the logits.
            losses: its parts of the loss and of other numbers.
            most: if the sum of the last one is above it no step is taken; None: one is.

        Returns:
            The norm of the gradient, and the sums of `losses`; None where no step was taken.
        """
        gradients, sums = ranks.summed("the gradient of the policy", made.gradients(down_NA), *losses)
        if most is not None and float(sums[-1]) > most:
            return None
        return self._optimiser.step(made.network.weights, gradients, sums[0], "policy"), sums


@final
class GradientUpdate(NetworkUpdate):
    """One step up the all-action policy gradient; with sampled advantages, A2C (Mnih et al. 2016).

        maximise  sum_s w(s) [ sum_a pi(a|s) adv(s, a) + entropy_coef H(pi(.|s)) ]

    With one-hot states, no hidden layer and plain gradient descent it is `SoftmaxUpdate`.
    """

    options: Gradient

    def __init__(self, options: Gradient = Gradient()) -> None:  # noqa: B008 - frozen
        super().__init__(options)

    def move(
        self, network: Network, input_N: Tensor, batch: Batch, generator: torch.Generator, readings: Readings
    ) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
        """Losses: policy, minus the objective without entropy, before the step; grad_norm, before clipping."""
        made, coef = Forward(network, input_N), self.now.entropy_coef
        log_NA, slope_NA = log_softmax(made.output_ND, batch.legal_NA), batch.advantage_NA.float()
        pi_NA = log_NA.exp()
        policy_loss = loss = -(batch.weight_N @ (pi_NA * slope_NA).sum(-1))
        if coef:
            # sum_a pi (adv - coef (log pi + 1)) d log pi  is the change of the objective of a state.
            loss, slope_NA = loss - coef * (batch.weight_N @ entropy(log_NA)), slope_NA - coef * (log_NA + 1)
        down_NA = -batch.weight_N[:, None] * slope_NA * pi_NA
        stepped = self.step(made, through_log_softmax(log_NA, down_NA), batch.ranks, loss, policy_loss)
        assert stepped is not None
        readings.add(policy=stepped[1][1], grad_norm=stepped[0])
        return log_NA, log_probs(network, input_N, batch.legal_NA)


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

    options: PPO

    def __init__(self, options: PPO = PPO()) -> None:  # noqa: B008 - frozen
        super().__init__(options)

    def move(
        self, network: Network, input_N: Tensor, batch: Batch, generator: torch.Generator, readings: Readings
    ) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
        """Losses: policy, minus the objective without entropy, mean over the steps; grad_norm, mean, before clipping;
        clip_fraction, the probability of actions whose rho is out of range after the steps; num_steps."""
        old_NA, advantage_NA = log_probs_before(network, input_N, batch), batch.advantage_NA.float()
        share, most = batch.ranks.share("rows", len(input_N)), self.options.target_kl
        weight_N = batch.weight_N / share.mean("weights", batch.weight_N)
        if self.options.normalize_advantage:
            advantage_NA = advantage_NA / _scale(old_NA, advantage_NA, weight_N, share)
        columns, num_steps = (input_N, old_NA, advantage_NA, weight_N), 0
        made = passes(network, columns, batch.legal_NA, share, self.options, generator)
        for forward, log_NA, count, (_, before_NA, part_NA, part_N) in made:
            gain_NA, down_NA = self.objective(log_NA, before_NA, part_NA, part_N, count)
            losses = [-mean(part_N, gain_NA.sum(-1), count)]
            if most is not None:
                losses.append(mean(part_N, divergence(before_NA, log_NA), count))
            stepped = self.step(forward, through_log_softmax(log_NA, down_NA), batch.ranks, *losses, most=most)
            if stepped is None:
                break
            readings.add(policy=stepped[1][0], grad_norm=stepped[0])
            num_steps += 1
        new_NA = log_probs(network, input_N, batch.legal_NA)
        outside_NA = ((new_NA - old_NA).exp() - 1).abs() > self.now.clip_range
        readings.add(
            clip_fraction=batch.ranks.sum("clipped", mean(weight_N, (old_NA.exp() * outside_NA).sum(-1), share.total)),
            num_steps=num_steps,
        )
        return old_NA, new_NA

    def objective(
        self,
        log_NA: Float[Tensor, "N A"],
        old_NA: Float[Tensor, "N A"],
        advantage_NA: Float[Tensor, "N A"],
        weight_N: Float[Tensor, "N"],
        count: int,
    ) -> tuple[Float[Tensor, "N A"], Float[Tensor, "N A"]]:
        """Return pi_old min(rho adv, clip(rho) adv), and the gradient of the loss, minus the objective, in log pi(a|s):

            -w(s) / count pi(a|s) ( adv(s, a) 1(not clipped) - entropy_coef (log pi(a|s) + 1) )

        with the number of rows in the minibatch, these and those of other processes.
        It is written out because autograd through these operations would cost as much as the network itself.
        """
        ratio_NA, pi_NA, before_NA = (log_NA - old_NA).exp(), log_NA.exp(), old_NA.exp()
        low, high, coef = 1 - self.now.clip_range, 1 + self.now.clip_range, self.now.entropy_coef
        if self._optimiser.compiles:
            from pgts_torch.agent import step_kernels

            gain_NA, down_NA = torch.empty_like(log_NA), torch.empty_like(log_NA)
            given = (log_NA, ratio_NA, pi_NA, before_NA, advantage_NA, weight_N)
            arrays = tuple(each.numpy() for each in given)
            step_kernels.clipped_objective(arrays, count, low, high, coef, gain_NA.numpy(), down_NA.numpy())
            return gain_NA, down_NA
        free_NA = ratio_NA * advantage_NA
        least_NA = torch.minimum(free_NA, ratio_NA.clamp(low, high) * advantage_NA)
        slope_NA = torch.where(least_NA == free_NA, advantage_NA, 0.0)
        if coef:
            slope_NA = slope_NA - coef * (log_NA + 1)
        return before_NA * least_NA, -(pi_NA * slope_NA) * (weight_N / count)[:, None]


def entropy(log_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N"]:
    """H(pi(.|s)) in nats, from log pi."""
    return -(log_NA.exp() * log_NA).sum(-1)


def divergence(log_p_NA: Float[Tensor, "N A"], log_q_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N"]:
    """KL(p(.|s) || q(.|s)) in nats, from log p and log q."""
    return (log_p_NA.exp() * (log_p_NA - log_q_NA)).sum(-1)


def log_probs_before(network: Network, input_N: Float[Tensor, "N ..."], batch: Batch) -> Float[Tensor, "N A"]:
    """log pi of the policy that the batch is of, from which the update starts."""
    before = batch.policy.network if isinstance(batch.policy, NetworkPolicy) else network
    return log_probs(before, input_N, batch.legal_NA)


@torch.no_grad()
def log_probs(
    network: Network, input_N: Float[Tensor, "N ..."], legal_NA: Bool[Tensor, "N A"] | None
) -> Float[Tensor, "N A"]:
    """log pi, without gradient."""
    return log_softmax(network(input_N), legal_NA)


def log_softmax(logit_NA: Float[Tensor, "N A"], legal_NA: Bool[Tensor, "N A"] | None) -> Float[Tensor, "N A"]:
    """log pi over the legal actions; that of the others is finite, and its exp is 0."""
    return legal_only(legal_only(logit_NA, legal_NA).log_softmax(-1), legal_NA, _LOG_OF_ZERO)


def passes(
    network: Network,
    columns: Sequence[Tensor],
    legal_NA: Bool[Tensor, "N A"] | None,
    share: Share,
    options: Any,
    generator: torch.Generator,
) -> Iterator[tuple[Forward, Float[Tensor, "N A"], int, tuple[Tensor, ...]]]:
    """Yield minibatches of the columns, the first of which are inputs: their pass through the current network and log
    pi, without gradient; how many rows the minibatch has in all processes; and those of this one.

    Args:
        options: of an update, which say how many there are.
    """
    rows = columns if legal_NA is None else [*columns, legal_NA]
    for _ in range(options.num_epochs):
        for count, part in minibatches(rows, options.minibatch_size, share, generator=generator):
            made = Forward(network, part[0])
            log_NA = log_softmax(made.output_ND, None if legal_NA is None else part[-1])
            yield made, log_NA, count, part[: len(columns)]


def mean(weight_N: Float[Tensor, "N"], value_N: Float[Tensor, "N"], count: int) -> Float[Tensor, ""]:
    """The part of these rows in mean_n w_n value_n over `count` rows."""
    return weight_N @ value_N / count


def _scale(
    old_NA: Float[Tensor, "N A"], advantage_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"], share: Share
) -> Float[Tensor, ""]:
    size_N = (old_NA.exp() * advantage_NA.abs()).sum(-1)
    return share.ranks.sum("advantages", mean(weight_N, size_N.square(), share.total)).sqrt() + 1e-8


def _check_numbers(batch: Batch, readings: Readings) -> None:
    advantage_NA, weight_N = batch.advantage_NA, batch.weight_N
    total = batch.ranks.sum("weights of rows", weight_N.sum())
    is_weight = (total > 0) & (weight_N >= 0).all()
    readings.check(advantage_NA.sum(), lambda _: _refuse_off("advantage", "advantage_NA", advantage_NA))
    readings.check(torch.where(is_weight, total, torch.nan), lambda _: _refuse_weights(weight_N))


def _refuse_off(what: str, name: str, value: Tensor) -> None:
    off = torch.nonzero(~value.isfinite())
    if len(off):
        raise NotFinite(f"{name}{off[0].tolist()} is {float(value[tuple(off[0])])}; it must be finite", what=what)


def _refuse_weights(weight_N: Tensor) -> None:
    _refuse_off("weight", "weight_N", weight_N)
    if not float(weight_N.sum()) > 0 or float(weight_N.min()) < 0:
        raise PgtsError(f"weight_N is {weight_N.tolist()[:8]}; weights are at least 0, and one must be positive")
