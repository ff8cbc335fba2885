"""Whether things happen as often as a model says: a test that may be looked at after every step of a run."""

import math
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

MARGINS = 0.02, 0.0
"""By how much the probability of an event may be off before that counts: in a contradiction, and in a doubt."""

_SHARES = tuple(2.0**-n for n in range(1, 8))
"""How far towards certainty each bet goes from what the margin allows."""

_PATIENCE = 8
"""Steps wait until they are more than one in so many of those before: what the bets cost in time is soon nothing, and a
result comes at most so much later."""


@dataclass(frozen=True)
class Worst:
    """How often an outcome of a row happened, in so many steps that were seen of it, and its listed probability."""

    row: int
    outcome: int
    happened: int
    seen: int
    listed: float


@final
class Frequencies:
    """Bets against listed probabilities; how much they have won is evidence that these are wrong.

    Row r says that its outcomes k happen with probabilities p_rk. The claim that is tested, for a margin e, is that in
    every row the true probability of no event is off by more than e. A batch of steps is bet on by what was seen before
    it: in row r on the event A_r of the outcomes that were more frequent than p_r says, and only if their frequency was
    above m = p_r(A_r) + e. With stakes to be had at fair odds for the probability m, the bet on its being m + g (1 - m)
    multiplies the wealth by

        W_rg <- W_rg * (1 + g (1 - m) / m)    where A_r happens,        W_rg * (1 - g)    elsewhere,

    for each of G shares g. If the claim is true no factor has a mean above 1, given what came before, and so

        E = 1/2 mean_g prod_r W_rg  +  1/2 mean_r mean_g W_rg

    is a nonnegative supermartingale that begins at 1: P(E ever reaches 1/a) <= a, whenever anybody looks (Ville 1939;
    Waudby-Smith and Ramdas 2024). The product finds a small error that many rows share, the mean over rows a large one
    in a single row. docs/theory.md, Sec. 7.

    log_evidence: of each margin, log E.
    has_chance: whether there is a row in which no outcome is certain.

    Args:
        prob_RK: the listed probabilities. Rows in which one outcome is certain are never bet on.
    """

    def __init__(self, prob_RK: Float[Tensor, "R K"]) -> None:
        # In numpy, where operations on so few numbers cost a third of what they do in torch.
        self._prob_RK = prob_RK.numpy()
        self._is_random_R = (self._prob_RK > 0).sum(-1) > 1
        self.has_chance = bool(self._is_random_R.any())
        self._row_R = np.full(len(prob_RK), -1)
        self._waiting: list[np.ndarray] = []
        self._num_waiting = self._num_counted = 0
        # Of each row that has been seen, in the order in which they were: its number in prob_RK, how often each outcome
        # happened, and the logarithms of its wealth by margin and share.
        self._id_N = np.zeros(0, dtype=np.int64)
        self._count_NK = np.zeros((0, prob_RK.shape[1]))
        self._log_wealth_NEG = np.zeros((0, len(MARGINS), len(_SHARES)))
        self.log_evidence = (0.0,) * len(MARGINS)

    def observe(self, row_V: Int[np.ndarray, "V"], outcome_V: Int[np.ndarray, "V"]) -> None:
        """Steps of a run, in no order: a row, and which of its outcomes happened."""
        edge_V = (row_V * self._prob_RK.shape[1] + outcome_V)[self._is_random_R[row_V]]
        self._waiting.append(edge_V)
        self._num_waiting += len(edge_V)
        if self._num_waiting * _PATIENCE > self._num_counted:
            self._bet(np.concatenate(self._waiting))
            self._num_counted, self._num_waiting, self._waiting = self._num_counted + self._num_waiting, 0, []

    def _bet(self, edge_V: Int[np.ndarray, "V"]) -> None:
        """Bet on steps by what was seen before them, and count them. edge = row * K + outcome."""
        K = self._prob_RK.shape[1]
        edge_E, times_E = np.unique(edge_V, return_counts=True)
        rows, which_E = np.unique(edge_E // K, return_inverse=True)
        at = self._places(rows)
        new_UK = np.zeros((len(rows), K))
        new_UK[which_E, edge_E % K] = times_E

        # The event on which is bet: what was more frequent than listed.
        prob_UK, count_UK = self._prob_RK[rows], self._count_NK[at]
        total_U1 = count_UK.sum(-1, keepdims=True)
        event_UK = count_UK > total_U1 * prob_UK
        listed_U1 = (prob_UK * event_UK).sum(-1, keepdims=True)
        frequency_U1 = (count_UK * event_UK).sum(-1, keepdims=True) / np.maximum(total_U1, 1)
        won_U1 = (new_UK * event_UK).sum(-1, keepdims=True)
        lost_U1 = new_UK.sum(-1, keepdims=True) - won_U1

        # Wealth by margin and share; no bet (factor 1) where the frequency says nothing against the margin.
        most_UE = listed_U1 + np.array(MARGINS)
        bets_UE = (frequency_U1 > most_UE) & (most_UE < 1) & (listed_U1 > 0)
        odds_UE = np.where(bets_UE, (1 - most_UE) / np.where(bets_UE, most_UE, 1), 0)
        share_G = np.array(_SHARES)
        gain_UEG = won_U1[..., None] * np.log1p(share_G * odds_UE[..., None]) + lost_U1[..., None] * np.log1p(-share_G)
        self._log_wealth_NEG[at] += np.where(bets_UE[..., None], gain_UEG, 0)
        self._count_NK[at] = count_UK + new_UK
        self.log_evidence = self._evidence()

    def _places(self, rows: Int[np.ndarray, "U"]) -> Int[np.ndarray, "U"]:
        """Where these rows stand among those that were seen; new ones come last."""
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
        G, R = len(_SHARES), len(self._prob_RK)
        product_E = _log_sum_exp(self._log_wealth_NEG.sum(0)) - math.log(G)
        each_NE = _log_sum_exp(self._log_wealth_NEG) - math.log(G)
        unseen_E = np.full((1, len(MARGINS)), math.log(max(R - len(self._id_N), 1e-300)))
        mean_E = np.logaddexp.reduce(np.concatenate([each_NE, unseen_E]), 0) - math.log(R)
        return tuple((np.logaddexp(product_E, mean_E) - math.log(2)).tolist())

    def worst(self) -> "Worst":
        """Of the row with most evidence of its own the outcome whose frequency is furthest from what is listed."""
        n = int(_log_sum_exp(self._log_wealth_NEG).sum(-1).argmax())
        row, count_K = int(self._id_N[n]), self._count_NK[n]
        k = int(np.abs(count_K / count_K.sum() - self._prob_RK[row]).argmax())
        return Worst(row, k, int(count_K[k]), int(count_K.sum()), float(self._prob_RK[row, k]))

    def state_dict(self) -> dict[str, Any]:
        """All that was seen: tensors on the CPU."""
        waiting = np.concatenate([*self._waiting, np.zeros(0, dtype=np.int64)])
        arrays = {"rows": self._id_N, "counts": self._count_NK, "log_wealth": self._log_wealth_NEG, "waiting": waiting}
        return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` gave."""
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
