"""A tabular MDP as a model: it enumerates and it samples."""

from dataclasses import replace
from typing import Any, final

import gymnasium
import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.models.base import EnumeratingModel, SamplingModel, Transitions
from pgts_torch.seeding import uniform
from pgts_torch.tabular.mdp import TabularMDP
from pgts_torch.tabular.stationary import highest_value, lowest_value


@final
class TabularModel(EnumeratingModel, SamplingModel):
    """The transitions of a `TabularMDP`, on a device and in a floating dtype of choice.

    Args:
        mdp: the MDP.
        device: where the tables lie.
        dtype: float64 keeps the exact values; float32 halves the memory.
    """

    exact = True

    def __init__(
        self, mdp: TabularMDP, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
    ) -> None:
        self.table = mdp.outcomes.to(device, dtype)
        self.num_states = mdp.num_states
        self.num_actions = mdp.num_actions
        self.device = self.table.device
        self.dtype = dtype
        self.highest_value, self.lowest_value = highest_value(mdp.outcomes), lowest_value(mdp.outcomes)
        self._cumulative_NAK = self.table.prob_NAK.cumsum(-1)

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The rows of the table. [PGTS Sec. 2]"""
        return self.table.rows(state_N)

    def sample(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"], *, key_N: Int[Tensor, "N"]) -> Transitions:
        """One outcome of each (state, action) by inverting the distribution function; the reward is r(s, a)."""
        cumulative_NK = self._cumulative_NAK[state_N, action_N]
        level_N1 = uniform(key_N, self.dtype).unsqueeze(-1) * cumulative_NK[:, -1:]
        # The first k whose cumulative probability exceeds u < total always has positive probability.
        k_N1 = (cumulative_NK <= level_N1).sum(-1, keepdim=True)
        return Transitions(
            self.table.reward_NA[state_N, action_N],
            self.table.discount_NAK[state_N, action_N].gather(-1, k_N1).squeeze(-1),
            self.table.child_NAK[state_N, action_N].gather(-1, k_N1).squeeze(-1),
        )


def tabular_truth(env: gymnasium.Env | gymnasium.vector.VectorEnv, *, gamma: float) -> TabularMDP:
    """The MDP behind an environment or its copies: its `mdp` if it is one of ours, else its `P` table.

    Args:
        gamma: discount of a P table; ours carry their own.

    Raises:
        MissingModel: the environment has neither.
    """
    base: Any = env.unwrapped
    single: Any = base.envs[0] if isinstance(base, gymnasium.vector.SyncVectorEnv) else base
    mdp = getattr(single.unwrapped, "mdp", None)
    if not isinstance(mdp, TabularMDP):
        return TabularMDP.from_gymnasium(single, gamma)
    # Ours pay r(s, a), whichever outcome is drawn.
    return mdp if mdp.reward_SAK is None else replace(mdp, reward_SAK=None)
