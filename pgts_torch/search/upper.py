"""Upper bounds of v* from what a model has answered so far, without further queries."""

import math
from typing import Any, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.search.topology import Topology
from pgts_torch.tabular.exact import UNDISCOUNTED

_WORK, MOST_SWEEPS = 2**20, 256
"""About how many outcomes are swept in one call, and the most sweeps."""

_EVERY = 8
"""After so many sweeps it is checked whether they have converged."""

_EPS = torch.finfo(torch.float64).eps

_CONVERGED = 1e-12
"""In units of the largest value: a sweep that changes less ends the sweeping."""


@final
class UpperBound:
    """v_hat >= v*, over the states X that a topology has expanded.        [docs/theory.md, Prop. 6]

        v_hat = T v_hat  on X,        v_hat = w >= v*  elsewhere

    Two functions are swept at once, from where the last call left them as long as X is the same:

    - one from above, from w: every sweep of an upper bound of v* is one;
    - one from below, which comes to v_hat in about as many sweeps as the best plan has steps, however close the
    discount is to 1. It proves v_hat <= T u + beta delta / (1 - beta), with delta = max over X of T u - u, not below 0,
    and beta the largest sum_k p_k gamma_k in X (MacQueen 1966; Prop. 5).

    The bound is the smaller of the two and never rises. A call has a budget of sweeps, so it may take several calls to
    come down to v_hat; at any time it is an upper bound. A state that may stay where it is for ever, undiscounted and
    with reward 0, as one in which an episode was truncated, counts as outside X: T does not bound its value.

    Rounding is outward. A computed backup of u misses the exact one by at most (K + 4) eps (max |r| + max |u|): K
    products p gamma u with p gamma rounded, their sum and the reward. This is added to every sweep from above, and
    twice to delta. w is enlarged by the share 1,024 eps / (1 - gamma), for the sums of probabilities and the division
    that it came from.

    Args:
        highest: w, the model's `highest_value`.
        gamma: the largest discount of the model.
    """

    def __init__(self, topology: Topology, highest: float, *, gamma: float) -> None:
        self.topology = topology
        self.w = (
            highest + abs(highest) * 1024 * _EPS / (1 - min(gamma, UNDISCOUNTED)) if highest < math.inf else highest
        )
        self._taken, self._settled = 0, True
        self._state_X = torch.empty(0, dtype=torch.int64, device=topology.model.device)
        self._bound_S = torch.empty(0, dtype=torch.float64, device=topology.model.device)
        self._below_S = self._bound_S

    def tighten(self, least: int) -> int:
        """Sweep at least so often, and further as far as the budget goes, or until nothing changes; how often it swept.

        With as many sweeps as a lookahead of full width has levels, the bound at its roots is no larger than T^n w.
        """
        if self.w < math.inf:
            before = self._taken
            self._update_states()
            if not self._settled and len(self._state_X):
                entries = len(self._reward) * self._num_outcomes
                times = max(least, min(MOST_SWEEPS, _WORK // entries))
                # Where X has just grown and is too large for the budget, sweeps from below would not come far enough.
                both = self._beta < UNDISCOUNTED and (self._taken == before or times * entries <= _WORK)
                return self._sweep(times, both=both)
        return 0

    def at(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """The bound; w at states that no search has expanded."""
        return self._grown(self._bound_S)[state_N]

    def swept(self, state_N: Int[Tensor, "N"], times: int) -> Float[Tensor, "N"]:
        """T^n w, n = `times`, at states from which everything within n - 1 steps is in X: whatever else is in X."""
        u_S1 = torch.full_like(self._grown(self._bound_S), self.w).unsqueeze(-1)
        if self.w < math.inf:
            self._update_states()
            for _ in range(times if len(self._state_X) else 0):
                u_S1[self._state_X] = self._backed_up(u_S1)
        return u_S1[state_N, 0]

    def state_dict(self) -> dict[str, Any]:
        """What later bounds depend on, in the order of `topology.table.queried`, on the CPU."""
        queried = self.topology.table.queried
        return {
            "bound": self._grown(self._bound_S)[queried].cpu(),
            "below": self._grown(self._below_S)[queried].cpu(),
            "settled": self._settled,
            "current": self._taken == self.topology.table.num_queried,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave; the topology has preloaded the states."""
        if self.w < math.inf:
            self._update_states()
            queried = self.topology.table.queried
            self._bound_S[queried] = state["bound"].to(queried.device)
            self._below_S[queried] = state["below"].to(queried.device)
            self._settled = state["settled"]
            if not state["current"]:  # states were expanded since: X is to be updated once more
                self._taken = -1

    def _update_states(self) -> None:
        """Take the states that were expanded since into X. The sweeps from below start again: with more states the old
        values need not be below v_hat any more."""
        if self._taken == self.topology.table.num_queried:
            return
        self._taken, self._settled = self.topology.table.num_queried, False
        self._state_X, outcomes = _without_ends(*self.topology.table.all())
        self._num_outcomes, self._rounding = outcomes.num_outcomes, (outcomes.num_outcomes + 4) * _EPS
        self._reward, self._weight = outcomes.reward_NA.double().reshape(-1, 1), outcomes.to(dtype=torch.float64).weight
        allowed = self._reward.isfinite()
        reward, every_S1 = self._reward[allowed], torch.ones_like(self._grown(self._bound_S)).unsqueeze(-1)
        self._largest_reward = float(reward.abs().max()) if len(reward) else 0.0
        beta = (self._weight @ every_S1)[allowed]
        self._beta = (float(beta.max()) if len(beta) else 0.0) * (1 + self._rounding)
        self._bound_S, self._below_S = self._grown(self._bound_S), self._grown(self._below_S)
        if self._beta < UNDISCOUNTED and len(reward):
            self._below_S[self._state_X] = min(0.0, float(reward.min())) / (1 - self._beta)

    def _sweep(self, times: int, *, both: bool) -> int:
        """So many sweeps of both, or of the one from above, or until they have converged; how many they were."""
        u_SC = torch.stack([self._bound_S, self._below_S] if both else [self._bound_S], -1)
        old_XC = u_SC[self._state_X]
        for n in range(1, times + 1):
            new_XC = self._backed_up(u_SC)
            # From above a sweep never rises, except by rounding.
            new_XC[:, 0] = torch.minimum(new_XC[:, 0], old_XC[:, 0])
            u_SC[self._state_X] = new_XC
            # Converged where one of the two functions has stopped moving: no fall from above, or no rise from below.
            if n % _EVERY == 0 or n == times:
                change_C, size = (new_XC - old_XC).amax(0).tolist(), self._largest_reward + float(u_SC.abs().max())
                fall = float((old_XC[:, 0] - new_XC[:, 0]).max())
                self._settled = min([fall, *change_C[1:]]) <= _CONVERGED * size
                if self._settled:
                    break
            old_XC = new_XC
        self._bound_S = u_SC[:, 0]
        if both:
            self._below_S = u_SC[:, 1]
            error = self._rounding * size
            delta = max(0.0, change_C[1]) + 2 * error
            above_X = new_XC[:, 1] + error + self._beta * delta / (1 - self._beta)
            self._bound_S[self._state_X] = torch.minimum(new_XC[:, 0], above_X)
        return n

    def _backed_up(self, u_SC: Float[Tensor, "S C"]) -> Float[Tensor, "X C"]:
        """T u on X, for each of C functions; the first rounded up."""
        if u_SC.shape[1] == 1:  # a vector is half as fast again as a matrix of one column
            q = torch.addmv(self._reward[:, 0], self._weight, u_SC[:, 0])
        else:
            q = torch.addmm(self._reward, self._weight, u_SC)
        new_XC = q.view(len(self._state_X), -1, u_SC.shape[1]).amax(1)
        new_XC[:, 0] += self._rounding * (self._largest_reward + u_SC[:, 0].abs().max())
        return new_XC

    def _grown(self, value_S: Float[Tensor, "S"]) -> Float[Tensor, "more"]:
        """With w for the states that the model has met since."""
        new = self.topology.model.num_states - len(value_S)
        return torch.nn.functional.pad(value_S, (0, new), value=self.w) if new else value_S


def _without_ends(state_X: Int[Tensor, "X"], outcomes: Outcomes) -> tuple[Int[Tensor, "kept"], Outcomes]:
    """Without the states that may stay where they are for ever, undiscounted and with reward 0."""
    stays_XAK = (outcomes.child_NAK == state_X[:, None, None]) & (outcomes.discount_NAK >= UNDISCOUNTED)
    stays_XA = torch.where(stays_XAK, outcomes.prob_NAK, 0.0).sum(-1) >= UNDISCOUNTED
    ends_X = (stays_XA & (outcomes.reward_NA == 0)).any(-1)
    if not bool(ends_X.any()):
        return state_X, outcomes
    kept = torch.nonzero(~ends_X).flatten()
    return state_X[kept], outcomes.rows(kept)
