"""What updates of networks compute of the rows of a batch."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgts_torch.agent.components import legal_only
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.networks import Network
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.optimisers import minibatches
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.ranks import Share
from pgts_torch.readings import Readings

_LOG_OF_ZERO = -1e4
"""In place of log pi(a|s) = -inf of an action that is not legal: its exp is 0, and 0 times it is no NaN."""


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


def log_probs(
    network: Network, input_N: Float[Tensor, "N ..."], legal_NA: Bool[Tensor, "N A"] | None
) -> Float[Tensor, "N A"]:
    """log pi, without gradient."""
    return log_softmax(network.plain(input_N), legal_NA)


def log_softmax(logit_NA: Float[Tensor, "N A"], legal_NA: Bool[Tensor, "N A"] | None) -> Float[Tensor, "N A"]:
    """log pi over the legal actions; that of the others is finite, and its exp is 0."""
    return legal_only(legal_only(logit_NA, legal_NA).log_softmax(-1), legal_NA, _LOG_OF_ZERO)


def with_legal(columns: Sequence[Tensor], legal_NA: Bool[Tensor, "N A"] | None) -> Sequence[Tensor]:
    """The columns, and after them the legal actions where not all are."""
    return columns if legal_NA is None else [*columns, legal_NA]


def passes(
    columns: Sequence[Tensor], share: Share, options: Any, generator: torch.Generator
) -> Iterator[tuple[int, tuple[Tensor, ...]]]:
    """Yield the minibatches of all passes over the columns, as `minibatches`.

    Args:
        options: of an update, which say how many there are.
    """
    for _ in range(options.num_epochs):
        yield from minibatches(columns, options.minibatch_size, share, generator=generator)


def mean(weight_N: Float[Tensor, "N"], value_N: Float[Tensor, "N"], count: int) -> Float[Tensor, ""]:
    """The part of these rows in mean_n w_n value_n over `count` rows."""
    return weight_N @ value_N / count


def in_own_units(
    advantage_NA: Float[Tensor, "N A"], pi_NA: Float[Tensor, "N A"], weight_N: Float[Tensor, "N"], share: Share
) -> Float[Tensor, "N A"]:
    """adv(s, a) / sqrt( mean_s w(s) (sum_a pi(a|s) |adv(s, a)|)^2 ): advantages of mean size 1, or 0 where all are."""
    size_N = (pi_NA * advantage_NA.abs()).sum(-1)
    size = share.ranks.sum("advantages", mean(weight_N, size_N.square(), share.total)).sqrt()
    return torch.where(size == 0, 0.0, advantage_NA / size)


def check_numbers(batch: Batch, readings: Readings) -> None:
    """Advantages and weights: NotFinite unless they are finite, PgtsError unless a weight is positive, when read."""
    advantage_NA, weight_N = batch.advantage_NA, batch.weight_N
    total, off = batch.ranks.sum("weights of rows", weight_N.sum()), (weight_N < 0).sum()
    readings.check(advantage_NA.sum(), lambda _: _refuse_off("advantage", "advantage_NA", advantage_NA))
    readings.check(total, lambda _: _refuse_weights(weight_N), is_good=lambda total: 0 < total < math.inf)
    readings.check(off, lambda _: _refuse_weights(weight_N), is_good=lambda off: off == 0)


def _refuse_off(what: str, name: str, value: Tensor) -> None:
    off = torch.nonzero(~value.isfinite())
    if len(off):
        raise NotFinite(f"{name}{off[0].tolist()} is {float(value[tuple(off[0])])}; it must be finite", what=what)


def _refuse_weights(weight_N: Tensor) -> None:
    _refuse_off("weight", "weight_N", weight_N)
    if not float(weight_N.sum()) > 0 or float(weight_N.min()) < 0:
        raise PgtsError(f"weight_N is {weight_N.tolist()[:8]}; weights are at least 0, and one must be positive")
