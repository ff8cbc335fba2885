"""A tabular MDP as a model: it enumerates and it samples."""

from dataclasses import replace
from functools import cached_property
from typing import Any, final

import gymnasium
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.models.base import EnumeratingModel, SamplingModel, Transitions
from pgts_torch.models.exact_model import CONTRADICTED, ExactModel, Happened, step_text
from pgts_torch.models.snapshots import each_of
from pgts_torch.seeding import uniform
from pgts_torch.tabular.mdp import TabularMDP
from pgts_torch.tabular.stationary import highest_value, lowest_value

_MOST_NAMED = 8
"""How many outcomes a message names."""

_CHUNK = 2**18
"""About how many probabilities are in memory at a time while outcomes are sampled."""

_ODD = [factor - 2**64 for factor in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)]
"""Odd factors, modulo 2**64, of the hash of an outcome, see `_looks`."""


@final
class TabularModel(EnumeratingModel, SamplingModel, ExactModel):
    """The transitions of a `TabularMDP`, on a device and in a floating dtype of choice.

    Args:
        dtype: float64 keeps the exact values; float32 halves the memory.
    """

    kind, is_cheap = "table", True
    table: Outcomes

    def __init__(
        self, mdp: TabularMDP, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
    ) -> None:
        self.table = mdp.outcomes.to(device, dtype)
        self.num_states = mdp.num_states
        self.num_actions, self.num_outcomes = mdp.num_actions, mdp.outcomes.num_outcomes
        self.device = self.table.device
        self.dtype = dtype
        self.highest_value, self.lowest_value = highest_value(mdp.outcomes), lowest_value(mdp.outcomes)
        self.is_certain = bool((mdp.outcomes.prob_NAK.amax(-1) == 1).all())
        self._cumulative_NAK = self.table.prob_NAK.cumsum(-1)
        self.mdp = mdp

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The rows of the table. [PGTS Sec. 2]"""
        return self.table.rows(state_N)

    def sample(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"], *, key_N: Int[Tensor, "N"]) -> Transitions:
        """One outcome of each (state, action) by inverting the distribution function; the reward is r(s, a)."""
        pieces = [each.split(max(1, _CHUNK // self.table.num_outcomes)) for each in (state_N, action_N, key_N)]
        k_N = torch.cat([self._sampled(*piece) for piece in zip(*pieces, strict=True)])
        table = self.table
        return Transitions(
            table.reward_NA[state_N, action_N],
            table.discount_NAK[state_N, action_N, k_N],
            table.child_NAK[state_N, action_N, k_N],
        )

    def _sampled(self, state_N: Tensor, action_N: Tensor, key_N: Tensor) -> Int[Tensor, "N"]:
        """Which outcome is sampled."""
        cumulative_NK = self._cumulative_NAK[state_N, action_N]
        level_N1 = uniform(key_N, self.dtype).unsqueeze(-1) * cumulative_NK[:, -1:]
        # The first k whose cumulative probability exceeds u < total always has positive probability.
        return (cumulative_NK <= level_N1).sum(-1)

    @cached_property
    def _looks_RK(self) -> Int[np.ndarray, "R K"]:
        """64 bits of each outcome of each row s * A + a by which it is told apart, 0 where it has no probability."""
        # In float64, whatever the dtype of the model: the environment's numbers are compared with these.
        outcomes, K = self.mdp.outcomes, self.table.num_outcomes
        child_SAK, discount_SAK, paid_SAK = outcomes.child_NAK, outcomes.discount_NAK, self.mdp.outcome_reward_SAK
        looks_SAK = _looks(child_SAK.numpy(), discount_SAK.numpy(), paid_SAK.numpy())
        return np.where(outcomes.prob_NAK.numpy() > 0, looks_SAK, 0).reshape(-1, K)

    def rows(self, happened: Happened) -> Int[np.ndarray, "N"]:
        """s * A + a of each step."""
        return happened.state_N * self.num_actions + happened.action_N

    def outcome_of(self, happened: Happened, *, query_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """The outcome that looks like each step, bit for bit; a reward may also be one that was rounded to float32."""
        looks_N, row_N = _looks(happened.next_state_N, happened.discount_N, happened.reward_N), self.rows(happened)
        same_NK = self._looks_RK.take(row_N, 0) == looks_N[:, None]
        first_N = same_NK.argmax(-1)
        if not (self._looks_RK.take(row_N * self._looks_RK.shape[1] + first_N) == looks_N).all():
            # Some step looks like no outcome: compare number by number, with rewards rounded to float32.
            at = happened.state_N, happened.action_N
            outcomes, discount_NK = self.mdp.outcomes, self.mdp.outcomes.discount_NAK.numpy()[at]
            with np.errstate(over="ignore"):
                paid_NK = self.mdp.outcome_reward_SAK.numpy()[at].astype(np.float32)
            rounded_NK = (outcomes.prob_NAK.numpy()[at] > 0) & (paid_NK == happened.reward_N[:, None])
            rounded_NK &= discount_NK == happened.discount_N[:, None]
            rounded_NK &= (discount_NK == 0) | (outcomes.child_NAK.numpy()[at] == happened.next_state_N[:, None])
            same_NK |= rounded_NK
            return np.where(same_NK.any(-1), same_NK.argmax(-1), CONTRADICTED)
        return first_N

    def state_text(self, state: int) -> str:
        return f"state {state}"

    def outcomes_text(self, state: int, action: int) -> str:
        """The outcomes of a row, the most probable first."""
        prob_K = self.mdp.outcomes.prob_NAK[state, action].tolist()
        likely = sorted((k for k, p in enumerate(prob_K) if p > 0), key=lambda k: -prob_K[k])
        named = [f"{self.outcome_text(state, action, k)} (probability {prob_K[k]:.4g})" for k in likely[:_MOST_NAMED]]
        return ", or ".join(named) + (f", or {len(likely) - _MOST_NAMED} others" if len(likely) > _MOST_NAMED else "")

    def outcome_text(self, state: int, action: int, k: int) -> str:
        """One outcome of a row, in a message."""
        outcomes, at = self.mdp.outcomes, (state, action, k)
        reward, discount = float(self.mdp.outcome_reward_SAK[at]), float(outcomes.discount_NAK[at])
        return step_text(reward, discount, self.state_text(int(outcomes.child_NAK[at])))

    def frequencies(self) -> Float[Tensor, "R K"]:
        """The probability of what each outcome of each row looks like, at the first that looks so; elsewhere 0."""
        looks_RK, order_RK = torch.from_numpy(self._looks_RK).sort(dim=-1, stable=True)
        # Those that look alike are neighbours now, the first one first; each takes over its position.
        is_new_RK = torch.ones_like(looks_RK, dtype=torch.bool)
        is_new_RK[:, 1:] = looks_RK[:, 1:] != looks_RK[:, :-1]
        place_RK = torch.where(is_new_RK, torch.arange(looks_RK.shape[1]), 0).cummax(-1).values
        prob_RK = self.mdp.outcomes.prob_NAK.reshape(looks_RK.shape)
        return torch.zeros_like(prob_RK).scatter_add_(-1, order_RK.gather(-1, place_RK), prob_RK.gather(-1, order_RK))


def _looks(child: np.ndarray, discount: np.ndarray, reward: np.ndarray) -> np.ndarray:
    """64 bits of (child, discount, reward); after an end (discount 0) the child does not matter. Two that differ have
    the same ones with a probability of 2**-64."""
    # + 0.0: -0 is 0.
    of_numbers = (discount + 0.0).view(np.int64) * _ODD[0] + (reward + 0.0).view(np.int64) * _ODD[1]
    return of_numbers + np.where(discount == 0, -1, child) * _ODD[2]


def tabular_truth(env: gymnasium.Env | gymnasium.vector.VectorEnv, *, gamma: float) -> TabularMDP:
    """The MDP that an environment publishes, or several that step together, as it stands: its `mdp` if it has one, else
    its table P. `published.table_of` compares it with steps.

    Args:
        gamma: discount of a P table; ours carry their own.

    Raises:
        MissingModel: the environment has neither.
    """
    base: Any = env.unwrapped
    single = each_of(base)[0]
    mdp = getattr(single.unwrapped, "mdp", None)
    if not isinstance(mdp, TabularMDP):
        return TabularMDP.from_gymnasium(single, gamma)
    # In pgts/* the reward is r(s, a), whichever outcome is sampled.
    return mdp if mdp.reward_SAK is None else replace(mdp, reward_SAK=None)
