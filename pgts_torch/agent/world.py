"""What an agent acts in: environments, what a policy sees of them, and the states that a lookahead may start from.

A lookahead speaks of states, which are numbers; policies and critics speak of observations. A `ModelWorld` translates.
"""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any, final

import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import iterate
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.observations import Observations
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import Model, promise
from pgts_torch.models.classic import ClassicModel
from pgts_torch.models.environments import draws_its_own
from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.tabular import TabularModel
from pgts_torch.tabular.mdp import TabularMDP


class World:
    """Environments to act in, and what a policy sees of them. This is all that experience without a lookahead needs.

    num_actions: of the discrete action set.
    observation_space: of what a policy sees.
    noticed: whether it has been said that the environment draws from the generators of the whole process.
    model: what a lookahead may ask; None: nothing.
    mdp: the exact truth, where there is one.
    start_S: the start distribution mu over all states; None where it is known from episodes only.
    reward_range: what rewards of single steps are held to; None: nothing.

    Args:
        env: the environments, with discrete actions.
        gamma: discount of a step that names none.
        observation_key: which part of dictionary observations a policy sees.
        device: where observations and states live.
    """

    noticed: bool = False
    model: Model | None = None
    mdp: TabularMDP | None = None
    start_S: Float[Tensor, "S"] | None = None
    reward_range: RewardRange | None = None

    def __init__(
        self,
        env: VectorEnv,
        *,
        gamma: float,
        observation_key: str | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.env, self.gamma, self.device = env, gamma, torch.device(device)
        self.num_actions = int(env.single_action_space.n)  # type: ignore[attr-defined]  # checked before
        self.observations = Observations(env, observation_key, self.device)
        self.observation_space = self.observations.space

    def encode(self, observation: Any) -> Tensor:
        """What a policy sees, from what an environment says: one observation, or rows of them.

        Raises:
            PgtsError: observations that this environment cannot make, or that are not numbers.
        """
        return self.observations.encode(observation)

    def of(self, env: VectorEnv) -> "World":
        """Other environments of the same kind, to act in only; what training says of them is not said once more."""
        world = World(env, gamma=self.gamma, observation_key=self.observations.key, device=self.device)
        world.noticed = True
        return world

    def promise(self, reward_range: RewardRange) -> None:
        """Hold episodes, table and model to a range of rewards.

        Raises:
            ModelMismatch: the table has others.
            PgtsError: the model repeats actions, whose rewards are sums of several, and whose values bound nothing.
        """
        if self.model is not None and self.model.action_repeat > 1:
            raise PgtsError(
                f"reward_range is given and action_repeat is {self.model.action_repeat}: no bound of values "
                "follows where actions are repeated; leave one of the two out"
            )
        if self.mdp is not None:
            happens_SAK = self.mdp.outcomes.prob_NAK > 0
            reward_range.check(self.mdp.outcome_reward_SAK[happens_SAK])
        self.reward_range = reward_range
        if self.model is not None:
            promise(self.model, reward_range, gamma=self.gamma)

    @cached_property
    def draws_its_own(self) -> bool:
        """Whether the environments are known to draw from no generators but their own."""
        each = self.env.envs if isinstance(self.env, SyncVectorEnv) else [self.env]
        return all(map(draws_its_own, each))


class ModelWorld(World, ABC):
    """Environments whose states a model knows, by number: a lookahead may start wherever they are.

    model: what the lookahead asks.
    keeps_numbers: whether a state keeps its number from one iteration to the next.
    """

    model: Model
    keeps_numbers: bool = False

    @abstractmethod
    def read(self, observation: Any, encoded_B: Tensor) -> Shaped[Tensor, "B ..."]:
        """What the states that the environments are in now are told apart by.

        Args:
            observation: what they have just said.
            encoded_B: the same, as a policy sees it.
        """

    @abstractmethod
    def numbers(self, read_N: Shaped[Tensor, "N ..."]) -> Int[Tensor, "N"]:
        """The numbers of states that were read. Many at once cost little more than a few."""

    @abstractmethod
    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What a policy sees of numbered states."""

    @abstractmethod
    def export(self, state_N: Int[Tensor, "N"]) -> Any:
        """What another process needs to know these states; it pickles."""

    @abstractmethod
    def adopt(self, exported: Any) -> Int[Tensor, "N"]:
        """The numbers of states that another process has exported. After `reset_numbers` they are the same in all
        processes that adopt the same states in the same order."""

    @abstractmethod
    def reset_numbers(self) -> None:
        """Number states from 0 on, as those of a new iteration, unless they keep their numbers."""


@final
class TabularWorld(ModelWorld):
    """An environment with a transition table: the observation is the state.

    Args:
        env: copies of it.
        mdp: the table.
        starts_known: whether the start distribution of the table is that of the environment; False: it was
            estimated from resets.
    """

    keeps_numbers = True

    def __init__(
        self, env: VectorEnv, mdp: TabularMDP, *, starts_known: bool = True, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__(env, gamma=float(mdp.outcomes.discount_NAK.max()), device=device)
        self.mdp, self.starts_known = mdp, starts_known
        self.model: TabularModel = TabularModel(mdp, device=device)
        self.start_S = mdp.start_S.to(self.device) if starts_known else None

    @property
    def mdp_shape(self) -> tuple[int, int]:
        """S and A."""
        return self.model.num_states, self.num_actions

    def read(self, observation: Any, encoded_B: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """The observations, which are the states."""
        return encoded_B

    def numbers(self, read_N: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
        """The observations."""
        return read_N

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The state."""
        return state_N

    def export(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The states."""
        return state_N.cpu()

    def adopt(self, exported: Tensor) -> Int[Tensor, "N"]:
        """These."""
        return exported.to(self.device)

    def reset_numbers(self) -> None:
        """A state keeps its number."""


@final
class SimulatedWorld(ModelWorld):
    """An environment that can be restored from snapshots: these are the states.

    Args:
        env: copies of it, each an environment of its own.
        model: a simulator of the same environment.
        observation_key: which part of dictionary observations a policy sees.
    """

    def __init__(
        self,
        env: SyncVectorEnv,
        model: SimulatorModel,
        *,
        observation_key: str | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(env, gamma=model.gamma, observation_key=observation_key, device=device)
        self.model: SimulatorModel = model
        self._envs = env.envs

    def read(self, observation: Any, encoded_B: Tensor) -> Int[Tensor, "B"]:
        """The number of a snapshot of each environment."""
        return self.model.roots(self._envs, iterate(self.env.observation_space, observation)).to(self.device)

    def numbers(self, read_N: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
        """These."""
        return read_N

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What the simulator showed in these states."""
        return self.observations.encode_part(self.model.observations(state_N))

    def export(self, state_N: Int[Tensor, "N"]) -> tuple[list[Any], Tensor]:
        """What the simulator knows of each distinct state; and which of these each state is."""
        distinct, index_N = state_N.unique(return_inverse=True)
        return self.model.export(distinct), index_N.cpu()

    def adopt(self, exported: tuple[list[Any], Tensor]) -> Int[Tensor, "N"]:
        """New numbers, or those of equal snapshots."""
        known, index_N = exported
        return self.model.adopt(known).to(self.device)[index_N.to(self.device)]

    def reset_numbers(self) -> None:
        """All snapshots are dropped: there are more with every search, and few of them return."""
        self.model.clear()


@final
class DynamicsWorld(ModelWorld):
    """An environment whose dynamics are written in torch: the states are its vectors, read from each copy.

    Args:
        env: copies of it, each an environment of its own.
        model: its dynamics.
        observation_key: which part of dictionary observations a policy sees, which only wrappers make of vectors.
    """

    def __init__(self, env: SyncVectorEnv, model: ClassicModel, *, observation_key: str | None = None) -> None:
        super().__init__(env, gamma=model.gamma, observation_key=observation_key, device=model.device)
        self.model: ClassicModel = model
        self._envs = env.envs

    def read(self, observation: Any, encoded_B: Tensor) -> Float[Tensor, "B D"]:
        """The vector of each environment."""
        return self.model.vectors(self._envs)

    def numbers(self, read_N: Float[Tensor, "N D"]) -> Int[Tensor, "N"]:
        """Equal vectors have one number."""
        return self.model.number(read_N)

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What the environment shows in these states, through its wrappers."""
        inner_NO = self.model.observe(self.model.states(state_N))
        if not self.model.transforms.observations:
            return inner_NO
        rows = [self.observations.part(self.model.transforms.observation(row)) for row in inner_NO.cpu().numpy()]
        return self.observations.encode_part(np.array(rows, self.observations.space.dtype))

    def export(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The vectors."""
        return self.model.states(state_N).cpu()

    def adopt(self, exported: Tensor) -> Int[Tensor, "N"]:
        """New numbers, or those of equal vectors."""
        return self.numbers(exported.to(self.device))

    def reset_numbers(self) -> None:
        """All states are dropped: hardly one of them returns."""
        self.model.clear()
