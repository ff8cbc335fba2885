"""A finite set of actions in each state, drawn from a proposal, over a model whose actions are vectors."""

from collections.abc import Callable
from typing import NamedTuple, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import EnumeratingModel, FollowingModel, Transitions


class Drawn(NamedTuple):
    """K actions drawn in each of N states.

    action_NKX: the actions.
    prob_NK: the probabilities of the policy over them, its self-normalised importance weights (Owen 2013, Sec. 9.2)

        pi_hat(a_k|s) = w_k / sum_j w_j,    w_k = pi(a_k|s) / beta(a_k|s)

    for the density beta that they were drawn from: sum_k pi_hat(a_k|s) f(a_k) estimates E_pi f.
    """

    action_NKX: Float[Tensor, "N K X"]
    prob_NK: Float[Tensor, "N K"]


Proposal = Callable[[Tensor], Drawn]
"""Draws actions in states [N]: in each of them a function of the state alone."""


@final
class DrawnActions(EnumeratingModel):
    """K actions in each state, as numbers 0 to K - 1, so that any search over numbered actions runs on them (Hubert et
    al. 2021). Until the next `redraw` a state has the same ones, wherever a search meets it.

    Its operator T_K takes the maximum over the K drawn actions of a state. It is at most that over all actions, so T_K
    q <= T q, and the difference vanishes as K grows where the proposal has a density everywhere: the best of K misses
    the best of all by O(K^-2/X) where q is smooth around its maximum. Errors of the critic act the other way: the
    maximum of K noisy values is too high on average. Since actions are drawn before their values are seen, sum_k pi_hat
    q has neither bias, but that of self-normalised weights, O(1/K).

    Args:
        base: what follows vectors.
        num_actions: K.
    """

    num_outcomes = 1

    def __init__(self, base: FollowingModel, num_actions: int) -> None:
        self.base, self.num_actions = base, num_actions
        self.device, self.dtype, self.action_repeat = base.device, base.dtype, base.action_repeat
        self.is_certain, self.lowest_value = base.is_certain, base.lowest_value
        self._propose: Proposal | None = None
        self._redrawn = 0

    @property
    def num_states(self) -> int:  # type: ignore[override]
        return self.base.num_states

    @property
    def generation(self) -> int:  # type: ignore[override]
        return self.base.generation + self._redrawn

    def redraw(self, propose: Proposal) -> None:
        """Draw other actions from here on, by this proposal."""
        self._propose = propose
        self._redrawn += 1

    def drawn(self, state_N: Int[Tensor, "N"]) -> Drawn:
        """The actions of these states; PgtsError before the first `redraw`."""
        if self._propose is None:
            raise PgtsError("no actions are drawn yet: iterate first")
        return self._propose(state_N)

    def follow(self, state_N: Int[Tensor, "N"], number_N: Int[Tensor, "N"]) -> Transitions:
        """The one outcome of one of the drawn actions of each state, for which alone the base is queried."""
        row_N = torch.arange(len(state_N), device=state_N.device)
        return self.base.follow(state_N, self.drawn(state_N).action_NKX[row_N, number_N])

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The one outcome of each drawn action, K of them in each state."""
        N, A = len(state_N), self.num_actions
        action_NX = self.drawn(state_N).action_NKX.flatten(0, 1)
        made = self.base.follow(state_N.repeat_interleave(A), action_NX)
        certain_NA1 = torch.ones(N, A, 1, dtype=self.dtype, device=self.device)
        discount_NA1, child_NA1 = made.discount_N.view(N, A, 1), made.next_state_N.view(N, A, 1)
        return Outcomes(made.reward_N.view(N, A), certain_NA1, discount_NA1, child_NA1, self.num_states)
