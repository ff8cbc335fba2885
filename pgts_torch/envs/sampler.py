"""Sampling outcomes and start states of a tabular MDP, for one environment or many at once."""

from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from pgts_torch.errors import PgtsError
from pgts_torch.tabular.mdp import TabularMDP


@final
class OutcomeSampler:
    """The tables of an MDP as numpy arrays, laid out for sampling by inversion of the distribution function.

        the outcome of u is the k with F(k - 1) <= u < F(k),   F(k) = p_0 + .. + p_k,   u uniform in [0, 1)

    An outcome with probability 0, and so a padded one, is an empty interval that no u falls into. F is 1 from the last
    possible outcome on, so that a row which sums to a little less than 1 has no gap at its end.

    Pairs (s, a) and outcomes are named by their position in the flattened tables: `pair = s * A + a`, and an outcome
    indexes `reward_SAK`, `child_SAK` and `discount_SAK` by `take`. K is padded to a power of two. `legal_SA` are the
    actions that are allowed; None: all are.
    """

    def __init__(self, mdp: TabularMDP) -> None:
        outcomes = mdp.outcomes
        self.num_actions = mdp.num_actions
        self.width = 1 << (outcomes.num_outcomes - 1).bit_length()
        self.reward_SAK = _pad(mdp.outcome_reward_SAK.numpy(), self.width, 0.0)
        self.discount_SAK = _pad(outcomes.discount_NAK.numpy(), self.width, 0.0)
        self.child_SAK = _pad(outcomes.child_NAK.numpy(), self.width, 0)
        self.cumulative_SAK = _pad(_distribution_function(outcomes.prob_NAK.numpy()), self.width, 1.0)
        self.legal_SA = None if outcomes.legal_NA.all() else outcomes.legal_NA.numpy()
        self.start_cumulative_S = _distribution_function(mdp.start_S.numpy())

    def outcomes(self, random: np.random.Generator, pair_B: Int[np.ndarray, "B"]) -> Int[np.ndarray, "B"]:
        """The position of one sampled outcome for each pair, by bisection: log2(K) rounds for all together.

        No number of `random` is used where K is 1.
        """
        outcome_B = pair_B * self.width
        if self.width == 1:
            return outcome_B
        uniform_B = random.random(len(pair_B))
        half = self.width // 2
        while (
            half
        ):  # the outcome is among the 2 * half from outcome_B on: it moves up if the first half ends at or below u
            outcome_B += half * (self.cumulative_SAK.take(outcome_B + (half - 1)) <= uniform_B)
            half //= 2
        return outcome_B

    def masks(self, state: Any) -> dict[str, np.ndarray]:
        """What `info` says of the actions that are allowed in a state, or in each of several; nothing if all are."""
        return {} if self.legal_SA is None else {"action_mask": self.legal_SA[state].astype(np.int8)}

    def check_legal(self, state_B: Int[np.ndarray, "B"], action_B: Int[np.ndarray, "B"]) -> None:
        """PgtsError where one of these actions is not allowed."""
        if self.legal_SA is not None and not (legal_B := self.legal_SA[state_B, action_B]).all():
            b = int(legal_B.argmin())
            raise PgtsError(f"action {action_B[b]} is not allowed in state {state_B[b]}")

    def starts(self, random: np.random.Generator, count: int) -> Int[np.ndarray, "count"]:
        """`count` states sampled from the start distribution."""
        return np.searchsorted(self.start_cumulative_S, random.random(count), side="right")


def _distribution_function(prob: Float[np.ndarray, "*rows K"]) -> Float[np.ndarray, "*rows K"]:
    """F(k), at most 1, and exactly 1 from the last possible outcome on."""
    cumulative = prob.cumsum(-1).clip(max=1.0)
    possible_later = (prob[..., ::-1] > 0).cumsum(-1)[..., ::-1] > (prob > 0)
    return np.where(possible_later, cumulative, 1.0)


def _pad(table_SAK: np.ndarray, width: int, value: float) -> np.ndarray:
    """The table with `width` outcomes, contiguous."""
    missing = width - table_SAK.shape[-1]
    return np.pad(table_SAK, ((0, 0), (0, 0), (0, missing)), constant_values=value)
