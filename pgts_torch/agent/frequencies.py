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
        self._prob_RK = prob_RK
        self._is_random_R = ((prob_RK > 0).sum(-1) > 1).numpy()
        self.has_chance = bool(self._is_random_R.any())
        self._row_R = torch.full((len(prob_RK),), -1, dtype=torch.int64)
        self._waiting: list[np.ndarray] = []
        self._num_waiting = self._num_counted = 0
        # Of each row that has been seen, in the order in which they were: its number in prob_RK, how often each outcome
        # happened, and the logarithms of its wealth by margin and share.
        self.id_N = torch.zeros(0, dtype=torch.int64)
        self.count_NK = torch.zeros(0, prob_RK.shape[1], dtype=torch.float64)
        self.log_wealth_NEG = torch.zeros(0, len(MARGINS), len(_SHARES), dtype=torch.float64)
        self.log_evidence = (0.0,) * len(MARGINS)

    def observe(self, row_V: Int[np.ndarray, "V"], outcome_V: Int[np.ndarray, "V"]) -> None:
        """Steps of a run, in no order: a row, and which of its outcomes happened."""
        edge_V = (row_V * self._prob_RK.shape[1] + outcome_V)[self._is_random_R[row_V]]
        self._waiting.append(edge_V)
        self._num_waiting += len(edge_V)
        if self._num_waiting * _PATIENCE > self._num_counted:
            self._bet(torch.from_numpy(np.concatenate(self._waiting)))
            self._num_counted, self._num_waiting, self._waiting = self._num_counted + self._num_waiting, 0, []

    def _bet(self, edge_V: Int[Tensor, "V"]) -> None:
        """Bet on steps by what was seen before them, and count them. edge = row * K + outcome."""
        K = self._prob_RK.shape[1]
        edge_E, times_E = edge_V.unique(return_counts=True)
        rows, which_E = edge_E.div(K, rounding_mode="floor").unique(return_inverse=True)
        at = self._places(rows)
        new_UK = torch.zeros(len(rows), K, dtype=torch.float64)
        new_UK[which_E, edge_E % K] = times_E.double()

        # The event on which is bet: what was more frequent than listed.
        prob_UK, count_UK = self._prob_RK[rows], self.count_NK[at]
        total_U1 = count_UK.sum(-1, keepdim=True)
        event_UK = count_UK > total_U1 * prob_UK
        listed_U1 = (prob_UK * event_UK).sum(-1, keepdim=True)
        frequency_U1 = (count_UK * event_UK).sum(-1, keepdim=True) / total_U1.clamp(min=1)
        won_U1 = (new_UK * event_UK).sum(-1, keepdim=True)
        lost_U1 = new_UK.sum(-1, keepdim=True) - won_U1

        # Wealth by margin and share; no bet (factor 1) where the frequency says nothing against the margin.
        margin_E, share_G = torch.tensor(MARGINS, dtype=torch.float64), torch.tensor(_SHARES, dtype=torch.float64)
        most_UE = listed_U1 + margin_E
        bets_UE1 = ((frequency_U1 > most_UE) & (most_UE < 1) & (listed_U1 > 0)).unsqueeze(-1)
        odds_UE1 = ((1 - most_UE) / most_UE).unsqueeze(-1)
        gain_UEG = won_U1.unsqueeze(-1) * (share_G * odds_UE1).log1p() + lost_U1.unsqueeze(-1) * (-share_G).log1p()
        self.log_wealth_NEG[at] += torch.where(bets_UE1, gain_UEG, 0.0)
        self.count_NK[at] = count_UK + new_UK
        self.log_evidence = self._evidence()

    def _places(self, rows: Int[Tensor, "U"]) -> Int[Tensor, "U"]:
        """Where these rows stand among those that were seen; new ones come last."""
        new = rows[self._row_R[rows] < 0]
        if len(new):
            self._row_R[new] = len(self.id_N) + torch.arange(len(new))
            self.id_N = torch.cat([self.id_N, new])
            for name in ("count_NK", "log_wealth_NEG"):
                known = getattr(self, name)
                setattr(self, name, torch.cat([known, known.new_zeros(len(new), *known.shape[1:])]))
        return self._row_R[rows]

    def _evidence(self) -> tuple[float, ...]:
        """log E of each margin. Rows that were never seen have wealth 1."""
        G, R = len(_SHARES), len(self._prob_RK)
        product_E = self.log_wealth_NEG.sum(0).logsumexp(-1) - math.log(G)
        unseen_1E = torch.full((1, len(MARGINS)), math.log(max(R - len(self.id_N), 1e-300)), dtype=torch.float64)
        each_NE = self.log_wealth_NEG.logsumexp(-1) - math.log(G)
        mean_E = torch.cat([each_NE, unseen_1E]).logsumexp(0) - math.log(R)
        return tuple((torch.logaddexp(product_E, mean_E) - math.log(2)).tolist())

    def worst(self) -> "Worst":
        """Of the row with most evidence of its own the outcome whose frequency is furthest from what is listed."""
        n = int(self.log_wealth_NEG.logsumexp(-1).sum(-1).argmax())
        row, count_K = int(self.id_N[n]), self.count_NK[n]
        k = int((count_K / count_K.sum() - self._prob_RK[row]).abs().argmax())
        return Worst(row, k, int(count_K[k]), int(count_K.sum()), float(self._prob_RK[row, k]))

    def state_dict(self) -> dict[str, Any]:
        """All that was seen."""
        waiting = torch.from_numpy(np.concatenate([*self._waiting, np.zeros(0, dtype=np.int64)]))
        return {
            "rows": self.id_N.clone(),
            "counts": self.count_NK.clone(),
            "log_wealth": self.log_wealth_NEG.clone(),
            "waiting": waiting,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` gave."""
        self.id_N, self.count_NK = state["rows"].clone(), state["counts"].clone()
        self.log_wealth_NEG = state["log_wealth"].clone()
        self._row_R.fill_(-1)
        self._row_R[self.id_N] = torch.arange(len(self.id_N))
        self._waiting = [state["waiting"].numpy()]
        self._num_waiting, self._num_counted = len(state["waiting"]), int(self.count_NK.sum())
        if len(self.id_N):
            self.log_evidence = self._evidence()
