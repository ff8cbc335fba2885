"""Rollouts: episodes of a policy, in an environment or in a model of it, and how many several processes have made."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Num, Shaped
from torch import Tensor

from pgts_torch.models.base import Experience
from pgts_torch.options.updates import StateWeight
from pgts_torch.ranks import ALONE, Ranks, Share

COLUMNS = ("action_TB", "reward_TB", "discount_TB", "alive_TB", "weight_TB", "survival_TB")
"""The fields of `Rollout` with a row for each step."""


class Totals(NamedTuple):
    """How much all processes have made together.

    visits: how many visits there are, and which of them are those of this process.
    searched: the same for the visits that a lookahead starts from.
    """

    visits: Share
    searched: Share
    episodes: int


@dataclass(frozen=True, eq=False)
class Rollout:
    """B episodes of at most T steps. After the end of an episode its rows are padding and `alive_TB` is False.

    observation_UB: the observations before each of the T steps and after the last: U = T + 1.
    reward_TB: in reward units.   discount_TB: of the transition itself, 0 where it terminated.
    weight_TB: the weight of a visit in the occupancy: the product of the discounts before it (fixed horizon) or 1
        (geometric horizon); 0 where the episode is over.
    survival_TB: the factor from one weight to the next: weight_{t+1} = weight_t * survival_t.
    state_UB: the states of these observations, which a lookahead may start from; None where there is no model.
    begins_B: whether an episode begins in the first row, where episodes go on from one rollout to the next; None: each
        does.
    searched_TB: the visits that a lookahead starts from; None: all.
    finished: the undiscounted return and the length of each episode that ended, where episodes go on from one rollout
        to the next; None: all begin in this one.
    totals: what this rollout is a part of, where several processes have made episodes of the same policy; the weights
        of visits are those in the whole. None: it is the whole.
    """

    observation_UB: Shaped[Tensor, "U B ..."]
    action_TB: Num[Tensor, "T B ..."]
    reward_TB: Float[Tensor, "T B"]
    discount_TB: Float[Tensor, "T B"]
    alive_TB: Bool[Tensor, "T B"]
    weight_TB: Float[Tensor, "T B"]
    survival_TB: Float[Tensor, "T B"]
    state_UB: Int[Tensor, "U B"] | None = None
    begins_B: Bool[Tensor, "B"] | None = None
    searched_TB: Bool[Tensor, "T B"] | None = None
    finished: tuple[tuple[float, int], ...] | None = None
    totals: Totals | None = None

    @property
    def ranks(self) -> Ranks:
        """The processes that have the other episodes."""
        return self.share.ranks

    @property
    def share(self) -> Share:
        """The visits of this rollout among those of all processes."""
        return self.whole.visits

    @cached_property
    def whole(self) -> Totals:
        """How much all processes have made together."""
        if self.totals is not None:
            return self.totals
        return Totals(Share(ALONE, 0, self.num_steps), Share(ALONE, 0, self._num_searched), self.num_episodes)

    def shared(self, ranks: Ranks) -> "Rollout":
        """The same rollout as the part of one of several processes, which must all call this.

        Raises:
            PgtsError, RankLost: as `Ranks`.
        """
        if ranks.size == 1:
            return self
        own = self.num_steps, self._num_searched, self.num_episodes
        steps_R, searched_R, episodes_R = ranks.each("episodes", *own).astype(int).T
        visits, searched = (
            Share(ranks, int(count_R[: ranks.rank].sum()), int(count_R.sum())) for count_R in (steps_R, searched_R)
        )
        return replace(self, totals=Totals(visits, searched, int(episodes_R.sum())))

    @cached_property
    def observation_V(self) -> Shaped[Tensor, "V ..."]:
        """The observation of each of the V = `num_steps` visits, in the order of `alive_TB`."""
        return self.of_visits(self.observation_UB[:-1])

    def of_visits(self, column_TB: Shaped[Tensor, "T B ..."]) -> Shaped[Tensor, "V ..."]:
        """The rows of the visits, in the order of `alive_TB`."""
        rows = column_TB.flatten(0, 1)
        return rows if self._has_no_padding else rows.index_select(0, self._visit_V)

    @property
    def _has_no_padding(self) -> bool:
        return self.num_steps == self.alive_TB.numel()

    # Positions are found once, because a GPU is waited for each time that a mask is an index.

    @cached_property
    def _visit_V(self) -> Int[Tensor, "V"]:
        return torch.nonzero(self.alive_TB.flatten()).squeeze(1)

    @cached_property
    def _needed_M(self) -> Int[Tensor, "M"]:
        """Where the observations of visits and of ends are: a visit at t has its own in row t and the one after it in
        row t + 1."""
        return torch.nonzero(torch.cat([self.alive_TB[:1], self.alive_TB]).flatten()).squeeze(1)

    @property
    def state_TB(self) -> Int[Tensor, "T B"]:
        """The states before each step. Only with a model."""
        assert self.state_UB is not None
        return self.state_UB[:-1]

    @property
    def start_state_N(self) -> Int[Tensor, "N"]:
        """The states in which episodes begin in this rollout. Only with a model."""
        return self.state_TB[0] if self.begins_B is None else self.state_TB[0][self.begins_B]

    @property
    def next_state_TB(self) -> Int[Tensor, "T B"]:
        """The states after each step. Only with a model."""
        assert self.state_UB is not None
        return self.state_UB[1:]

    @cached_property
    def num_steps(self) -> int:
        """The number of steps, without padding."""
        return int(self.alive_TB.sum())

    @property
    def num_episodes(self) -> int:
        return self.alive_TB.shape[1]

    @property
    def follows_TB(self) -> Bool[Tensor, "T B"]:
        """Whether the next row is another step of the same episode."""
        return torch.cat([self.alive_TB[1:], torch.zeros_like(self.alive_TB[:1])])

    def steps(self) -> Experience:
        """All steps, those of the first episode first."""
        alive_BT = self.alive_TB.T

        def rows(column_TB: Tensor) -> Tensor:
            return column_TB.transpose(0, 1)[alive_BT]

        before_N, after_N = rows(self.observation_UB[:-1]), rows(self.observation_UB[1:])
        action_N, reward_N, discount_N = rows(self.action_TB), rows(self.reward_TB), rows(self.discount_TB)
        return Experience(before_N, action_N, reward_N, discount_N, after_N, rows(self.follows_TB), self.ranks)

    def values(self, v: Callable[[Tensor], Tensor]) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B"]]:
        """Return v(s_t) and v(s_{t+1}); they have no meaning where the episode is over.

        Args:
            v: returns the values of observations; called once, with each visit and each end of an episode.
        """
        observation_N = self.observation_UB.flatten(0, 1)
        if self._has_no_padding:
            v_N = v(observation_N).to(self.reward_TB)
        else:
            v_M = v(observation_N.index_select(0, self._needed_M)).to(self.reward_TB)
            v_N = v_M.new_zeros(len(observation_N)).index_copy_(0, self._needed_M, v_M)
        v_UB = v_N.view(-1, self.num_episodes)
        return v_UB[:-1], v_UB[1:]

    def returns(self) -> Float[Tensor, "B"]:
        """The weighted sum of rewards of each episode: an estimate of J^pi, unbiased for the geometric horizon."""
        return (self.weight_TB * self.reward_TB).sum(0)

    def visits(self, state_weight: StateWeight) -> tuple[Int[Tensor, "N"], Float[Tensor, "N"]]:
        """Return the distinct visited states that a lookahead starts from, ascending, and the weight w(s) of each. A
        state that several processes have visited has a row in each, and its weight there is that of the visits there.

        occupancy:  mean over episodes of sum_t weight_t 1(s_t = s), an estimate of d^pi(s)    [PGTS Sec. 2]
        visits:     fraction of all visits that are to s
        uniform:    1
        """
        states, row_V = self._distinct
        if state_weight == "uniform":
            return states, torch.ones(len(states), dtype=self.weight_TB.dtype, device=states.device)
        weight_V = self.visit_weight(state_weight)[self._searched_V]
        weight_V = weight_V * (self.share.total / self.whole.searched.total)  # they stand for all visits
        # the sum of the weights of all visits to a state
        weight_N = torch.zeros(len(states), dtype=weight_V.dtype, device=states.device)
        return states, weight_N.index_add_(0, row_V, weight_V)

    @property
    def count_N(self) -> Int[Tensor, "N"]:
        """How many of the visits that a lookahead starts from are to each distinct state, in the order of `visits`."""
        states, row_V = self._distinct
        return torch.bincount(row_V, minlength=len(states))

    @property
    def first_observation_N(self) -> Shaped[Tensor, "N ..."]:
        """The observation at the first visit to each distinct state, in the order of `visits`."""
        states, row_V = self._distinct
        # the smallest index of a visit to each state
        visit_V = torch.arange(len(row_V), device=row_V.device)
        first_N = torch.full_like(states, len(row_V)).scatter_reduce_(0, row_V, visit_V, "amin")
        return self.observation_V[self._searched_V][first_N]

    @property
    def _searched_V(self) -> Any:
        """Which of the visits a lookahead starts from, as an index."""
        return slice(None) if self.searched_TB is None else self.of_visits(self.searched_TB)

    @property
    def _num_searched(self) -> int:
        return self.num_steps if self.searched_TB is None else int(self.searched_TB[self.alive_TB].sum())

    @cached_property
    def _distinct(self) -> tuple[Int[Tensor, "N"], Int[Tensor, "V"]]:
        """The distinct visited states, ascending, and the index among them of the state of each visit."""
        return self.of_visits(self.state_TB)[self._searched_V].unique(return_inverse=True)

    def visit_weight(self, state_weight: StateWeight) -> Float[Tensor, "V"]:
        """The weight that each visit adds to w(s), in the order of `alive_TB`; with "uniform" it is 1."""
        weight_V = self.of_visits(self.weight_TB)
        if state_weight == "occupancy":
            return weight_V / self.whole.episodes
        return torch.full_like(weight_V, 1 / self.share.total if state_weight == "visits" else 1.0)
