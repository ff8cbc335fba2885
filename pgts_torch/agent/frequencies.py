"""A sequential test of the probabilities that a model claims; it is valid after every step of a run."""

import math
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

MARGINS = 0.02, 0.0
"""The error of a claimed probability that is tolerated: for a contradiction, and for a warning."""

_STAKES = tuple(2.0**-n for n in range(1, 8))
"""The fractions g of the wealth that are staked, one bet for each."""

_PATIENCE = 8
"""Steps are collected until they are more than 1/8 of those counted before: betting then costs next to no time, and
evidence is late by at most that fraction of the steps."""


@dataclass(frozen=True)
class Worst:
    """The outcome of a row whose frequency contradicts its claimed probability most.

    happened: how often it happened, in `seen` steps of that row.
    claimed: its probability in the model.
    """

    row: int
    outcome: int
    happened: int
    seen: int
    claimed: float


@final
class Frequencies:
    """Tests claimed probabilities by betting against them; the wealth won is evidence that they are wrong.

    Row r has outcomes k with claimed probabilities p_rk. The hypothesis, for a margin e: in every row the claim about
    each event is within e of its true probability. Each batch of steps is bet on using earlier steps only: in row r on
    the event A_r of the outcomes that were more frequent than claimed, and only if their frequency was above m =
    p_r(A_r) + e. At odds that are fair for the probability m, staking a fraction g of the wealth W_rg changes it to

        W_rg <- W_rg * (1 + g (1 - m) / m)    where A_r happens,        W_rg * (1 - g)    elsewhere,

    for each of G fractions g. Under the hypothesis no factor has a conditional mean above 1, and so

        E = 1/2 mean_g prod_r W_rg  +  1/2 mean_r mean_g W_rg

    is a nonnegative supermartingale that begins at 1: P(E ever reaches 1/a) <= a, however often it is looked at (Ville
    1939; Waudby-Smith and Ramdas 2024; docs/theory.md, Sec. 7). The product detects a small error common to many rows,
    the mean over rows a large one in a single row.

    log_evidence: log E, for each margin.   has_chance: whether there is a row with several possible outcomes.

    Args:
        prob_RK: the claimed probabilities. Rows with a single possible outcome are not tested.
    """

    def __init__(self, prob_RK: Float[Tensor, "R K"]) -> None:
        # numpy, because operations on so few numbers cost a third of what they do in torch
        self._prob_RK = prob_RK.numpy()
        self._is_random_R = (self._prob_RK > 0).sum(-1) > 1
        self.has_chance = bool(self._is_random_R.any())
        self._row_R = np.full(len(prob_RK), -1)
        self._waiting: list[np.ndarray] = []
        self._num_waiting = self._num_counted = 0
        # One entry for each row seen so far, in the order of first steps: its index in prob_RK, the count of each
        # outcome, and log wealth by margin (E) and stake (G).
        self._id_N = np.zeros(0, dtype=np.int64)
        self._count_NK = np.zeros((0, prob_RK.shape[1]))
        self._log_wealth_NEG = np.zeros((0, len(MARGINS), len(_STAKES)))
        self.log_evidence = (0.0,) * len(MARGINS)

    def observe(self, row_V: Int[np.ndarray, "V"], outcome_V: Int[np.ndarray, "V"]) -> None:
        """Add steps of a run, in any order: the row of each, and which of its outcomes happened."""
        edge_V = (row_V * self._prob_RK.shape[1] + outcome_V)[self._is_random_R[row_V]]
        self._waiting.append(edge_V)
        self._num_waiting += len(edge_V)
        if self._num_waiting * _PATIENCE > self._num_counted:
            self._bet(np.concatenate(self._waiting))
            self._num_counted, self._num_waiting, self._waiting = self._num_counted + self._num_waiting, 0, []

    def _bet(self, edge_V: Int[np.ndarray, "V"]) -> None:
        """Bet on steps by the counts before them, then count them. edge = row * K + outcome."""
        K = self._prob_RK.shape[1]
        edge_E, times_E = np.unique(edge_V, return_counts=True)
        rows, which_E = np.unique(edge_E // K, return_inverse=True)
        at = self._places(rows)
        new_UK = np.zeros((len(rows), K))
        new_UK[which_E, edge_E % K] = times_E

        # The event A_r of each row: the outcomes that were more frequent than claimed.
        prob_UK, count_UK = self._prob_RK[rows], self._count_NK[at]
        total_U1 = count_UK.sum(-1, keepdims=True)
        event_UK = count_UK > total_U1 * prob_UK
        claimed_U1 = (prob_UK * event_UK).sum(-1, keepdims=True)
        frequency_U1 = (count_UK * event_UK).sum(-1, keepdims=True) / np.maximum(total_U1, 1)
        won_U1 = (new_UK * event_UK).sum(-1, keepdims=True)
        lost_U1 = new_UK.sum(-1, keepdims=True) - won_U1

        # Wealth by margin and stake; no bet (factor 1) where the frequency is within the margin.
        most_UE = claimed_U1 + np.array(MARGINS)
        bets_UE = (frequency_U1 > most_UE) & (most_UE < 1) & (claimed_U1 > 0)
        odds_UE = np.where(bets_UE, (1 - most_UE) / np.where(bets_UE, most_UE, 1), 0)
        stake_G = np.array(_STAKES)
        gain_UEG = won_U1[..., None] * np.log1p(stake_G * odds_UE[..., None]) + lost_U1[..., None] * np.log1p(-stake_G)
        self._log_wealth_NEG[at] += np.where(bets_UE[..., None], gain_UEG, 0)
        self._count_NK[at] = count_UK + new_UK
        self.log_evidence = self._evidence()

    def _places(self, rows: Int[np.ndarray, "U"]) -> Int[np.ndarray, "U"]:
        """The positions of these rows in the arrays of rows seen; new rows are appended."""
        new = rows[self._row_R[rows] < 0]
        if len(new):
            self._row_R[new] = len(self._id_N) + np.arange(len(new))
            self._id_N = np.concatenate([self._id_N, new])
            self._count_NK, self._log_wealth_NEG = (
                np.concatenate([known, np.zeros((len(new), *known.shape[1:]))])
                for known in (self._count_NK, self._log_wealth_NEG)
            )
        return self._row_R[rows]

    def _evidence(self) -> tuple[float, ...]:
        """log E of each margin. Rows that were never seen have wealth 1."""
        G, R = len(_STAKES), len(self._prob_RK)
        product_E = _log_sum_exp(self._log_wealth_NEG.sum(0)) - math.log(G)
        each_NE = _log_sum_exp(self._log_wealth_NEG) - math.log(G)
        unseen_E = np.full((1, len(MARGINS)), math.log(max(R - len(self._id_N), 1e-300)))
        mean_E = np.logaddexp.reduce(np.concatenate([each_NE, unseen_E]), 0) - math.log(R)
        return tuple((np.logaddexp(product_E, mean_E) - math.log(2)).tolist())

    def worst(self) -> "Worst":
        """In the row with the most evidence, the outcome whose frequency is furthest from its claimed probability."""
        n = int(_log_sum_exp(self._log_wealth_NEG).sum(-1).argmax())
        row, count_K = int(self._id_N[n]), self._count_NK[n]
        k = int(np.abs(count_K / count_K.sum() - self._prob_RK[row]).argmax())
        return Worst(row, k, int(count_K[k]), int(count_K.sum()), float(self._prob_RK[row, k]))

    def state_dict(self) -> dict[str, Any]:
        """Return the counts, the wealth and the steps not yet bet on: tensors on the CPU."""
        waiting = np.concatenate([*self._waiting, np.zeros(0, dtype=np.int64)])
        arrays = {"rows": self._id_N, "counts": self._count_NK, "log_wealth": self._log_wealth_NEG, "waiting": waiting}
        return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned."""
        self._id_N, self._count_NK, self._log_wealth_NEG, waiting = (
            state[name].numpy().copy() for name in ("rows", "counts", "log_wealth", "waiting")
        )
        self._row_R[:] = -1
        self._row_R[self._id_N] = np.arange(len(self._id_N))
        self._waiting = [waiting]
        self._num_waiting, self._num_counted = len(waiting), int(self._count_NK.sum())
        if len(self._id_N):
            self.log_evidence = self._evidence()


def _log_sum_exp(x_XG: np.ndarray) -> np.ndarray:
    """log sum_g exp(x_g)."""
    return np.logaddexp.reduce(x_XG, -1)
