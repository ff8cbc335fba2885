"""What a table of counts leaves open: tables sampled from its posterior, and certificates that hold in most of them."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.bellman import Outcomes, sweep
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.counts import CountsModel

_SWEEPS = 25
"""Between two looks at whether values have settled."""

_MOST_SWEEPS = 100_000


def sampled_tables(
    model: CountsModel, draws: int, *, strength: float, unknown_worth: float, generator: torch.Generator
) -> Outcomes:
    """Tables of the S states of a model, sampled from what it has seen; state s of table b is b S + s.

    The probabilities of a pair are Dirichlet distributed, with the count of each outcome and strength (K - 1) for the
    unknown one, K as in `Counts.optimism`. A pair that was never visited has the unknown outcome alone.

    Args:
        unknown_worth: what an unknown outcome pays, after which nothing follows.
    """
    counts, (S, A) = model.counts, (model.num_states, model.num_actions)
    # Of each outcome, its place among those of its pair; the last place is that of the unknown one.
    place_C = np.arange(len(counts.pair_C)) - np.repeat(np.cumsum(counts.size_P) - counts.size_P, counts.size_P)
    shape = S * A, counts.most + 1
    weight_PK, reward_PK, discount_PK = (np.zeros(shape) for _ in range(3))
    child_PK = np.zeros(shape, dtype=np.int64)
    for table_PK, column_C in (
        (weight_PK, counts.count_C),
        (reward_PK, counts.reward_C),
        (discount_PK, counts.discount_C),
        (child_PK, counts.next_C),
    ):
        table_PK[counts.pair_C, place_C] = column_C
    weight_PK[:, -1] = np.where(weight_PK.any(-1), strength * (counts.most - 1), 1.0)
    reward_PK[:, -1] = unknown_worth
    random = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator, device=generator.device)))
    prob_BPK = random.standard_gamma(np.broadcast_to(weight_PK, (draws, *shape)))
    prob_BPK /= prob_BPK.sum(-1, keepdims=True)
    child_BPK = child_PK + S * np.arange(draws)[:, None, None]
    columns = (prob_BPK * reward_PK).sum(-1), prob_BPK, np.broadcast_to(discount_PK, prob_BPK.shape), child_BPK
    reward, prob, discount, child = (torch.from_numpy(np.ascontiguousarray(column)) for column in columns)
    sizes = draws * S, A, counts.most + 1
    return Outcomes(reward.view(sizes[:2]), prob.view(sizes), discount.view(sizes), child.view(sizes), draws * S)


def posterior_certificate(
    model: CountsModel,
    pi_SA: Float[Tensor, "S A"],
    start_S: Float[Tensor, "S"],
    *,
    level: float = 0.95,
    draws: int = 100,
    strength: float = 0.05,
    generator: torch.Generator,
) -> float:
    """A bound on J* - J^pi that holds in a share `level` of the tables that what was seen leaves possible.

    It is the quantile over sampled tables of sum_s mu(s) (v*(s) - v^pi(s)), in which the unknown is worth the upper end
    of the model's value range for v*, and the lower end for v^pi. It is no proof: it rests on the prior, which is that
    of `sampled_tables`.

    Args:
        pi_SA: pi(a|s).
        start_S: start distribution mu.
        strength: of the unknown outcome.
    """
    S, A = model.num_states, model.num_actions
    check_count("draws", draws)
    if not 0 < level < 1:
        raise PgtsError(f"level is {level}; it must be above 0 and below 1")
    if pi_SA.shape != (S, A) or start_S.shape != (S,):
        raise PgtsError(
            f"pi_SA has shape {tuple(pi_SA.shape)} and start_S {tuple(start_S.shape)}; the model has {S} states and "
            f"{A} actions"
        )
    low, high = model.value_range
    tables = sampled_tables(model, draws, strength=strength, unknown_worth=high, generator=generator)
    pi_NA = pi_SA.double().repeat(draws, 1)
    low_NA = tables.reward_NA - (high - low) * tables.prob_NAK[..., -1]
    followed = Outcomes(  # what follows all actions, as the outcomes of one
        (pi_NA * low_NA).sum(-1, keepdim=True),
        (pi_NA.unsqueeze(-1) * tables.prob_NAK).view(len(pi_NA), 1, -1),
        tables.discount_NAK.view(len(pi_NA), 1, -1),
        tables.child_NAK.view(len(pi_NA), 1, -1),
        tables.num_children,
    )
    best_N, reached_N = _settled(tables, high), _settled(followed, low)
    return float(((best_N - reached_N).view(draws, S) @ start_S.double()).quantile(level))


def _settled(tables: Outcomes, bound: float) -> Float[Tensor, "N"]:
    """v* from a bound of all values on; it stays a bound of that kind, however many sweeps there are."""
    v_N = torch.full((tables.num_states,), bound, dtype=torch.float64)
    for _ in range(_MOST_SWEEPS // _SWEEPS):
        next_N = sweep(tables, v_N, _SWEEPS)
        if float((next_N - v_N).abs().max()) <= 1e-9 * float(next_N.abs().max()):
            return next_N
        v_N = next_N
    return v_N
