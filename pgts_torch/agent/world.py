"""The environments that an agent acts in, their observations as tensors, and their states as a model numbers them.

Searches take states, which are integers; policies and critics take observations. A `ModelWorld` translates.
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal, Self

import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from gymnasium.vector import VectorEnv
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.components import with_legal
from pgts_torch.agent.observations import Observations
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import Model
from pgts_torch.models.masks import ActionMasks
from pgts_torch.models.provenance import draws_its_own
from pgts_torch.models.replay import Column
from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.snapshots import each_of
from pgts_torch.options.environment import Observed
from pgts_torch.tabular.mdp import TabularMDP


class World:
    """Environments and their observations as tensors: all that is needed for rollouts without a lookahead.

    num_actions: A; 0 where actions are vectors.   action_size: X, the size of these; None where actions are numbers.
    observation_space: of what `encode` returns.
    perceive: makes what policies and critics take of what `encode` returns, in `perceived_space`: the same, unless a
        model represents observations as vectors.
    warned: whether the warning was given that the environments use the random generators of the whole process.
    legal_of: finds the legal actions by the rows of observations; None: masks say them, or all are legal.
    model: what a lookahead may query; None: there is no model.
    mdp: the exact MDP, where it is known.
    start_S: the start distribution mu over all states; None where it is known from episodes only.
    reward_range: the bounds that rewards of single steps are checked against; None: they are not checked.
    shows_masks: whether what `encode` returns has the legal actions; else policies know them by the state.
    masks: how action masks are read, so that observations are `Masked`; "off": they are not, if there are any; None:
        there are none.

    Args:
        env: the environments, with numbered actions, or vectors (`Squashed`).
        gamma: discount of a step that names none.
        numbered: whether the combinations of several numbers are numbered, so that observations are Discrete.
        device: where observations and states are.
    """

    perceive: Callable[[Tensor], Tensor]
    perceived_space: Space[Any]
    warned: bool = False
    shows_masks: bool = True
    legal_of: Callable[[Tensor], Tensor] | None = None
    model: Model | None = None
    mdp: TabularMDP | None = None
    start_S: Float[Tensor, "S"] | None = None
    reward_range: RewardRange | None = None

    def __init__(
        self,
        env: VectorEnv,
        *,
        gamma: float,
        observed: Observed = Observed(),  # noqa: B008 - frozen
        numbered: bool = False,
        masks: ActionMasks | Literal["off"] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.env, self.gamma, self.masks, self.device = env, gamma, masks, torch.device(device)
        space = env.single_action_space
        self.num_actions = int(space.n) if isinstance(space, spaces.Discrete) else 0
        self.action_size = None if self.num_actions else math.prod(space.shape or ())
        masked = self.num_actions if isinstance(masks, ActionMasks) and self.shows_masks else None
        self.observations = Observations(env, observed, self.device, numbered=numbered, masked=masked)
        self.observation_space = self.perceived_space = self.observations.space
        self.perceive = lambda encoded_N: encoded_N

    def encode(self, observation: Any) -> Tensor:
        """Return one observation of an environment, or rows of them, as the tensor that a policy takes; PgtsError
        unless they are finite and in its observation space."""
        rows = self.observations.encode(observation)
        if self.legal_of is None:
            return rows
        row_ND = rows.reshape(-1, rows.shape[-1])
        made_ND = with_legal(row_ND, self.legal_of(row_ND))
        return made_ND.view(*rows.shape[:-1], made_ND.shape[-1])

    def of(self, env: VectorEnv) -> "World":
        """A world without a model for other environments of the same kind; warnings are not repeated in it."""
        seen, shared = self.observations, {"masks": self.masks, "device": self.device}
        kind = World if self.shows_masks else _StateWorld
        world = kind(env, gamma=self.gamma, observed=seen.options, numbered=seen.numbered, **shared)  # type: ignore[arg-type]
        world.warned, world.perceive, world.perceived_space = True, self.perceive, self.perceived_space
        world.legal_of = self.legal_of
        return world

    def beside(self, env: VectorEnv) -> Self:
        """This world, with its model, for other environments of the same kind, which step one by one."""
        other = copy.copy(self)
        other.env = env
        return other

    def promise(self, reward_range: RewardRange) -> None:
        """Check rewards of episodes, table and model against a range, and bound values by it.

        Raises:
            ModelMismatch: the table has a reward outside of it.
            PgtsError: the model repeats actions, so that its rewards are sums of several.
        """
        if self.model is not None and self.model.action_repeat > 1:
            raise PgtsError(
                f"reward_range is given and action_repeat is {self.model.action_repeat}: it does not bound values "
                "where actions are repeated; leave one of the two out"
            )
        if self.mdp is not None:
            happens_SAK = self.mdp.outcomes.prob_NAK > 0
            reward_range.check(self.mdp.outcome_reward_SAK[happens_SAK])
        self.reward_range = reward_range
        if (model := self.model) is not None:
            low, high = reward_range.values(self.gamma)
            model.reward_range = reward_range
            model.lowest_value, model.highest_value = max(model.lowest_value, low), min(model.highest_value, high)

    @cached_property
    def draws_its_own(self) -> bool:
        """Whether the environments are known to use random generators of their own only."""
        return all(map(draws_its_own, each_of(self.env)))


class _StateWorld(World):
    """Environments whose observations are states, by which policies know the legal actions."""

    shows_masks = False


class ModelWorld(World, ABC):
    """Environments with a model that numbers their states, so that a lookahead can start from any of them.

    model: what the lookahead queries.
    keeps_numbers: whether a state keeps its number from one iteration to the next.
    """

    model: Model
    keeps_numbers: bool = False

    @abstractmethod
    def read(self, observation: Any, encoded_B: Tensor) -> Shaped[Tensor, "B ..."]:
        """Return the current state of each environment, in the form that `numbers` takes.

        Args:
            observation: the latest observation of the environments.
            encoded_B: the same, as returned by `encode`.
        """

    @abstractmethod
    def numbers(self, read_N: Shaped[Tensor, "N ..."]) -> Int[Tensor, "N"]:
        """Return the numbers of states that `read` has returned. Many at once cost little more than a few."""

    @abstractmethod
    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """Return the observations of numbered states, as a policy takes them."""

    @abstractmethod
    def export(self, state_N: Int[Tensor, "N"]) -> Column:
        """Return a description of each of these states that pickles, for `adopt` later or in another process."""

    @abstractmethod
    def adopt(self, exported: Any) -> Int[Tensor, "N"]:
        """Return the numbers of states that were exported. After `reset_numbers` they are the same in
        all processes that adopt the same states in the same order."""

    @abstractmethod
    def reset_numbers(self) -> None:
        """Number states from 0 again, unless they keep their numbers."""
