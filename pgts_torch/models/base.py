"""What a lookahead may query a model for. A signature names the smallest ability that it needs.

A state is an integer below `num_states`. A model whose states are something else (snapshots, vectors) gives them
numbers as it meets them, equal states the same one, so that a search can merge them.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Num, Shaped
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.models.replay import ReplayBuffer
from pgts_torch.models.rewards import RewardRange
from pgts_torch.ranks import ALONE, Ranks


@dataclass(frozen=True, eq=False)
class Transitions:
    """One sampled outcome for each of N pairs (state, action).

    reward_N: in reward units.   discount_N: in [0, 1], 0 after a terminal outcome.   next_state_N: states of the model.
    trusted_N: whether the model knows enough of what follows for imagined episodes to go on; None: it always does.
    """

    reward_N: Float[Tensor, "N"]
    discount_N: Float[Tensor, "N"]
    next_state_N: Int[Tensor, "N"]
    trusted_N: Bool[Tensor, "N"] | None = None


class Experience(NamedTuple):
    """N steps of an environment in observations, in the order in which they happened, for a model to learn from.

    reward_N: in reward units.   discount_N: in [0, 1], 0 where the episode terminated.
    follows_N: whether the next row is another step of the same episode.
    ranks: the processes that have the other steps, from which a model is to learn as well; all must learn the same.
    """

    observation_N: Shaped[Tensor, "N ..."]
    action_N: Num[Tensor, "N ..."]
    reward_N: Float[Tensor, "N"]
    discount_N: Float[Tensor, "N"]
    next_observation_N: Shaped[Tensor, "N ..."]
    follows_N: Bool[Tensor, "N"]
    ranks: Ranks = ALONE

    def of_all(self) -> "Experience":
        """The steps of all processes, those of the first one first."""
        columns: dict[str, Any] = dict(zip(self._fields, self.ranks.rows("steps", *self[:-1]), strict=False))
        return self._replace(**columns)


class Model(ABC):
    """A finite action set over numbered states.

    exact: whether it claims to be the environment, as a table, dynamics or a simulator do, and a learned model does
        not: each step of the environment is compared with it, and a bound from it is called proved.
    highest_value: an upper bound of v* in every state; infinite where none is known.
    lowest_value: a lower bound of v^pi, of every policy in every state; -infinite where none is known.
    reward_range: between which numbers its rewards must be; None: any.
    action_repeat: how often an action is taken in one outcome.
    is_certain: whether it is known that no action has more than one outcome.
    options: what it was made from; None for a model of the caller's own class.
    generation: how often the model has changed, so that what was remembered of it is no longer true: it has learned,
        or has been cleared, after which states have other numbers.
    """

    num_states: int
    num_actions: int
    exact: bool = False
    highest_value: float = math.inf
    lowest_value: float = -math.inf
    reward_range: RewardRange | None = None
    action_repeat: int = 1
    is_certain: bool = False
    options: Any = None
    generation: int = 0
    device: torch.device
    dtype: torch.dtype


class LearningModel(Model):
    """A model that learns from the steps of an environment. It is never called exact.

    replay: the steps that it keeps, whose column "state" has states in the form that `ModelWorld.adopt` takes; None: it
        keeps none.
    learns_after_episodes: whether steps are learned as soon as an episode is over, else after a fixed number of them.
    """

    replay: ReplayBuffer | None = None
    learns_after_episodes: bool = False

    def is_news(self, observation_B: Shaped[Tensor, "B ..."], action_B: Num[Tensor, "B ..."]) -> bool:
        """Whether learning from these steps, which are to be learned later, would change much: then they are learned at
        once, also in the middle of an episode."""
        return False

    @abstractmethod
    def learn(self, experience: Experience, *, generator: torch.Generator) -> dict[str, float]:
        """Learn from steps that were not learned from before; `generation` moves. Return losses and errors, by name."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return what was learned and seen, as tensors on the CPU and plain values."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned; PgtsError if it does not fit."""


class FallibleModel(Model):
    """A model that says by how much a step in it may differ from one in the environment."""

    @abstractmethod
    def step_error(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"] | None:
        """e(s, a) of states that it was queried for, finite and in reward units, at least 0:

            |r'(s, a) + sum_k p'_k gamma'_k v(s'_k) - (r(s, a) + sum_k p_k gamma_k v(s_k))| <= e(s, a)

        where ' marks the model, for all v with values in a range of which the model says what it is: so e is a bound
        whatever v is, in proportion to the width of the range. A subclass says whether e is a bound, with which
        probability, or an estimate. None: it does not know.
        """


class EnumeratingModel(Model):
    """A model that enumerates all outcomes of a state.

    num_outcomes: K; None: it is not known before the first query.
    samples_outcomes: whether it samples the outcomes that it enumerates, and remembers them.
    answers_singly: whether what it answers is the same, bit for bit, however states are split into queries.
    table: the outcomes of all states, for good, where it keeps such a table; searches then read it without a copy.
    """

    num_outcomes: int | None = None
    samples_outcomes: bool = False
    answers_singly: bool = False
    table: Outcomes | None = None

    @abstractmethod
    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """What may follow each state under every action; children are states of this model."""


class SamplingModel(Model):
    """A model that samples one outcome of a state and an action."""

    @abstractmethod
    def sample(
        self, state_N: Int[Tensor, "N"], action_N: Num[Tensor, "N ..."], *, key_N: Int[Tensor, "N"]
    ) -> Transitions:
        """One outcome of each (state, action): a function of state, action and key (`seeding.mix`) and of nothing else.

        So the randomness is that of the search, which cannot foresee what an environment will do, and finds the same
        outcome however its batch is split or ordered.
        """


class FollowingModel(SamplingModel):
    """A model in which an action has one outcome. Actions may be vectors, [N, X], which are no numbers to enumerate:
    its `num_actions` is 0 then."""

    @abstractmethod
    def follow(self, state_N: Int[Tensor, "N"], action_N: Num[Tensor, "N ..."]) -> Transitions:
        """The one outcome of each (state, action)."""
