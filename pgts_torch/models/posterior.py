"""What a table of counts leaves open: tables sampled from its posterior, and certificates that hold in most of them."""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.special import gammaln
from torch import Tensor

from pgts_torch.bellman import Outcomes, sweep
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.counts import CountsModel

_SWEEPS = 25
"""Between two looks at whether values have settled."""

_MOST_SWEEPS = 100_000

_WEIGHTS = 2.0 ** np.arange(-5, 3)
"""Weights of an outcome in Dirichlet distributions; a priori all of these are equally likely."""

_AT_A_TIME = 2**22
"""The most outcomes of the tables that are in memory together, where one table has no more."""


def sampled_tables(
    model: CountsModel, draws: int, *, unknown_worth: float, random: np.random.Generator
) -> tuple[Outcomes, Int[np.ndarray, "V"]]:
    """Tables sampled from what a model has seen, and the V states that they are of: the visited ones. State v of table
    b is b (V + 1) + v.

    Each pair has M possible outcomes, with probabilities from a symmetric Dirichlet distribution of weight b. M and b
    are sampled too, for each table, given what all pairs have shown (`_priors`): so M is 1 where visits agree, but not
    before pairs were visited again. The outcomes that were not seen are the unknown one. A pair that was never visited
    has the unknown outcome alone. State V of a table stands for all states that were never visited.

    Args:
        unknown_worth: what an unknown outcome pays, after which nothing follows.
    """
    counts, A = model.counts, model.num_actions
    visited_V, row_C = np.unique(counts.pair_C // A, return_inverse=True)
    V = len(visited_V)
    place_S = np.full(model.num_states, V)
    place_S[visited_V] = np.arange(V)
    # Of each outcome, its place among those of its pair; the last place is that of the unknown one.
    place_C = np.arange(len(counts.pair_C)) - np.repeat(np.cumsum(counts.size_P) - counts.size_P, counts.size_P)
    shape = (V + 1) * A, counts.most + 1
    weight_PK, reward_PK, discount_PK = (np.zeros(shape) for _ in range(3))
    child_PK = np.zeros(shape, dtype=np.int64)
    for table_PK, column_C in (
        (weight_PK, counts.count_C),
        (reward_PK, counts.reward_C),
        (discount_PK, counts.discount_C),
        (child_PK, place_S[counts.next_C]),
    ):
        table_PK[row_C * A + counts.pair_C % A, place_C] = column_C
    reward_PK[:, -1] = unknown_worth
    M_B, b_B = _priors(counts.count_C, counts.size_P, draws, random)
    k_P = (weight_PK > 0).sum(-1)
    weight_BPK = weight_PK + b_B[:, None, None] * (weight_PK > 0)
    weight_BPK[..., -1] = np.where(k_P > 0, b_B[:, None] * (M_B[:, None] - k_P), 1.0)
    prob_BPK = random.standard_gamma(weight_BPK)
    prob_BPK /= prob_BPK.sum(-1, keepdims=True)
    child_BPK = child_PK + (V + 1) * np.arange(draws)[:, None, None]
    columns = (prob_BPK * reward_PK).sum(-1), prob_BPK, np.broadcast_to(discount_PK, prob_BPK.shape), child_BPK
    reward, prob, discount, child = (torch.from_numpy(np.ascontiguousarray(column)) for column in columns)
    sizes = draws * (V + 1), A, counts.most + 1
    outcomes = Outcomes(reward.view(sizes[:2]), prob.view(sizes), discount.view(sizes), child.view(sizes), sizes[0])
    return outcomes, visited_V


def posterior_certificate(
    model: CountsModel,
    pi_SA: Float[Tensor, "S A"],
    start_S: Float[Tensor, "S"],
    *,
    num_starts: int | None = None,
    level: float = 0.95,
    draws: int = 100,
    generator: torch.Generator,
) -> float:
    """A bound on J* - J^pi that holds in a share `level` of the tables that what was seen leaves possible.

    It is the quantile over sampled tables of sum_s mu(s) (v*(s) - v^pi(s)), in which the unknown is worth the upper end
    of the model's value range for v*, and the lower end for v^pi. It is no proof: it rests on the prior, which is that
    of `sampled_tables`.

    Args:
        start_S: start distribution mu, or the frequencies of start states among `num_starts` episodes. Then mu is
            sampled as the probabilities of a pair are, from these episodes.
        num_starts: None: mu is known.
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
    random = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator, device=generator.device)))
    low, high = model.value_range
    at_once = max(1, _AT_A_TIME // (len(model.counts.pair_C) + 1) // (model.counts.most + 1))
    gaps = []
    for first in range(0, draws, at_once):
        count = min(at_once, draws - first)
        tables, visited_V = sampled_tables(model, count, unknown_worth=high, random=random)
        gap_BW = _gaps(tables, pi_SA[visited_V].double().cpu(), low, high).view(count, -1)
        gaps.append((gap_BW * _starts(start_S, visited_V, num_starts, count, random)).sum(-1))
    return float(torch.cat(gaps).quantile(level))


def _gaps(tables: Outcomes, pi_VA: Float[Tensor, "V A"], low: float, high: float) -> Float[Tensor, "N"]:
    """v* - v^pi in all states of the tables, where an unknown outcome pays `high`, and for v^pi `low`."""
    A = pi_VA.shape[1]
    pi_NA = torch.cat([pi_VA, pi_VA.new_full((1, A), 1 / A)]).repeat(tables.num_states // (len(pi_VA) + 1), 1)
    low_NA = tables.reward_NA - (high - low) * tables.prob_NAK[..., -1]
    followed = Outcomes(  # what follows all actions, as the outcomes of one
        (pi_NA * low_NA).sum(-1, keepdim=True),
        (pi_NA.unsqueeze(-1) * tables.prob_NAK).view(len(pi_NA), 1, -1),
        tables.discount_NAK.view(len(pi_NA), 1, -1),
        tables.child_NAK.view(len(pi_NA), 1, -1),
        tables.num_children,
    )
    return _settled(tables, high) - _settled(followed, low)


def _starts(
    start_S: Float[Tensor, "S"],
    visited_V: Int[np.ndarray, "V"],
    num_starts: int | None,
    draws: int,
    random: np.random.Generator,
) -> Float[Tensor, "B W"]:
    """The probabilities of starts in the visited states, and last in any other one."""
    prob_S = start_S.double().cpu().numpy()
    prob_W = np.append(prob_S[visited_V], 0.0)
    prob_W[-1] = max(0.0, prob_S.sum() - prob_W.sum())
    if num_starts is None:
        return torch.from_numpy(np.broadcast_to(prob_W, (draws, len(prob_W))).copy())
    count_W = (prob_W * num_starts).round()
    seen_K = count_W[count_W > 0].astype(np.int64)
    M_B, b_B = _priors(seen_K, np.array([len(seen_K)]), draws, random)
    weight_BW = count_W + b_B[:, None] * (count_W > 0)
    weight_BW[:, -1] += b_B * (M_B - len(seen_K))
    weight_BW = random.standard_gamma(weight_BW)
    return torch.from_numpy(weight_BW / weight_BW.sum(-1, keepdims=True))


def _priors(
    count_C: Int[np.ndarray, "C"], size_P: Int[np.ndarray, "P"], draws: int, random: np.random.Generator
) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B"]]:
    """The number M of possible outcomes of a pair, and the weight b of each, sampled from their posterior where k_p
    different outcomes of pair p were seen c times each, n_p times together (symmetric Dirichlet distributions):

        p(seen | M, b) = prod_p M! / (M - k_p)! Gamma(M b) / Gamma(n_p + M b) prod_c Gamma(c + b) / Gamma(b)
    """
    most = int(size_P.max(initial=1))
    M_G1 = np.unique(np.ceil(most * 2 ** (np.arange(11) / 2)))[:, None]
    b_1H = _WEIGHTS[None]
    log_GH = np.zeros_like(b_1H) - math.log(2) * np.arange(len(M_G1))[:, None]  # a priori each M is half as likely
    visits_P = np.add.reduceat(count_C, np.cumsum(size_P) - size_P) if len(size_P) else size_P
    for values, term in (
        (size_P, lambda k: gammaln(M_G1 + 1) - gammaln(M_G1 - k + 1) - k * gammaln(b_1H)),
        (visits_P, lambda n: gammaln(M_G1 * b_1H) - gammaln(n + M_G1 * b_1H)),
        (count_C, lambda c: gammaln(c + b_1H)),
    ):
        for value, times in zip(*np.unique(values, return_counts=True), strict=True):
            log_GH = log_GH + times * term(value)
    share_GH = np.exp(log_GH - log_GH.max())
    at_B = random.choice(share_GH.size, size=draws, p=share_GH.ravel() / share_GH.sum())
    return M_G1[at_B // len(_WEIGHTS), 0], _WEIGHTS[at_B % len(_WEIGHTS)]


def _settled(tables: Outcomes, bound: float) -> Float[Tensor, "N"]:
    """v* from a bound of all values on; it stays a bound of that kind, however many sweeps there are."""
    v_N = torch.full((tables.num_states,), bound, dtype=torch.float64)
    for _ in range(_MOST_SWEEPS // _SWEEPS):
        next_N = sweep(tables, v_N, _SWEEPS)
        if float((next_N - v_N).abs().max()) <= 1e-9 * float(next_N.abs().max()):
            return next_N
        v_N = next_N
    return v_N
