"""What an agent acts in: copies of an environment, what a policy sees of them, and what a lookahead may ask.

A lookahead speaks of states, which are numbers; policies and critics speak of observations. A world translates.
"""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import iterate
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.observations import Observations, states_of
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import Model, promise
from pgts_torch.models.classic import ClassicModel
from pgts_torch.models.environments import draws_its_own
from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.tabular import TabularModel
from pgts_torch.tabular.mdp import TabularMDP


class World(ABC):
    """Copies of an environment whose states are numbered.

    env: the copies that experience is made in.
    num_actions: of the discrete action set.
    observation_space: of what a policy sees.
    gamma: discount of a step that names none.
    device: where observations and states live.
    noticed: whether it has been said that the environment draws from the generators of the whole process.
    model: what a lookahead may ask; None: nothing.
    mdp: the exact truth, where there is one.
    start_S: the start distribution mu over all states; None where it is known from episodes only.
    reward_range: what rewards of single steps are held to; None: nothing.
    """

    env: VectorEnv
    num_actions: int
    observation_space: spaces.Space[Any]
    gamma: float
    device: torch.device
    noticed: bool = False
    model: Model | None = None
    mdp: TabularMDP | None = None
    start_S: Float[Tensor, "S"] | None = None
    reward_range: RewardRange | None = None

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
        """Whether the copies are known to draw from no generators but their own."""
        each = self.env.envs if isinstance(self.env, SyncVectorEnv) else [self.env]
        return all(map(draws_its_own, each))

    @abstractmethod
    def encode(self, observation: Any) -> Tensor:
        """What a policy sees, from what an environment says: one observation, or rows of them.

        Raises:
            PgtsError: observations that this environment cannot make, or that are not numbers.
        """

    @abstractmethod
    def see(self, env: VectorEnv, observation: Any) -> tuple[Tensor, Shaped[Tensor, "B ..."]]:
        """What a policy sees of copies, encoded, and what the states that they are in now are told apart by.

        Args:
            observation: what the copies have just said.
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
        """The numbers of states that another process has exported. Where a world numbers anew, the numbers are the same
        in all processes that adopt the same states in the same order."""

    @abstractmethod
    def forget(self) -> bool:
        """Begin to number anew where numbers only serve one iteration; whether it was so."""


@final
class TabularWorld(World):
    """An environment with a transition table: the observation is the state.

    Args:
        env: copies of it.
        mdp: the table.
        starts_known: whether the start distribution of the table is that of the environment; False: it was
            estimated from resets.
    """

    def __init__(
        self, env: VectorEnv, mdp: TabularMDP, *, starts_known: bool = True, device: torch.device | str = "cpu"
    ) -> None:
        self.env, self.mdp = env, mdp
        self.starts_known = starts_known
        self.num_actions = mdp.num_actions
        self.observation_space = env.single_observation_space
        self.gamma = float(mdp.outcomes.discount_NAK.max())
        self.device = torch.device(device)
        self.model: TabularModel = TabularModel(mdp, device=device)
        self.start_S = mdp.start_S.to(self.device) if starts_known else None

    @property
    def mdp_shape(self) -> tuple[int, int]:
        """S and A."""
        return self.model.num_states, self.num_actions

    def encode(self, observation: Any) -> Tensor:
        """The states, int64."""
        return states_of(observation, self.model.num_states).to(self.device)

    def see(self, env: VectorEnv, observation: Any) -> tuple[Tensor, Int[Tensor, "B"]]:
        """The states, twice."""
        state_B = self.encode(observation)
        return state_B, state_B

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

    def forget(self) -> bool:
        """Nothing: a state keeps its number."""
        return False


@final
class SimulatedWorld(World):
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
        self.env, self.model = env, model
        self.num_actions, self.gamma = model.num_actions, model.gamma
        self.device = torch.device(device)
        self._seen = Observations(env, observation_key, self.device)
        self.observation_space = self._seen.space
        self._model = model

    def encode(self, observation: Any) -> Tensor:
        """Numbers, vectors or images."""
        return self._seen.encode(observation)

    def see(self, env: VectorEnv, observation: Any) -> tuple[Tensor, Int[Tensor, "B"]]:
        """The observation, and the number of a snapshot of each copy."""
        assert isinstance(env, SyncVectorEnv)
        each = list(iterate(env.observation_space, observation))
        return self.encode(observation), self._model.roots(env.envs, each).to(self.device)

    def numbers(self, read_N: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
        """These."""
        return read_N

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What the simulator showed in these states."""
        return self._seen.encode_part(self._model.observations(state_N))

    def export(self, state_N: Int[Tensor, "N"]) -> tuple[list[Any], Tensor]:
        """What the simulator knows of each distinct state; and which of these each state is."""
        distinct, index_N = state_N.unique(return_inverse=True)
        return self._model.export(distinct), index_N.cpu()

    def adopt(self, exported: tuple[list[Any], Tensor]) -> Int[Tensor, "N"]:
        """New numbers, or those of equal snapshots."""
        known, index_N = exported
        return self._model.adopt(known).to(self.device)[index_N.to(self.device)]

    def forget(self) -> bool:
        """All snapshots: their number grows with every search, and few of them return."""
        self._model.clear()
        return True


@final
class DynamicsWorld(World):
    """An environment whose dynamics are written in torch: the states are its vectors, read from each copy.

    Args:
        env: copies of it, each an environment of its own.
        model: its dynamics.
        observation_key: which part of dictionary observations a policy sees, which only wrappers make of vectors.
    """

    def __init__(self, env: SyncVectorEnv, model: ClassicModel, *, observation_key: str | None = None) -> None:
        self.env, self.model = env, model
        self.num_actions, self.gamma, self.device = model.num_actions, model.gamma, model.device
        self._seen = Observations(env, observation_key, self.device)
        self.observation_space = self._seen.space
        self._model = model

    def encode(self, observation: Any) -> Tensor:
        """Vectors, float32."""
        return self._seen.encode(observation)

    def see(self, env: VectorEnv, observation: Any) -> tuple[Tensor, Float[Tensor, "B D"]]:
        """The observation, and the vector of each copy."""
        assert isinstance(env, SyncVectorEnv)
        return self.encode(observation), self._model.vectors(env.envs)

    def numbers(self, read_N: Float[Tensor, "N D"]) -> Int[Tensor, "N"]:
        """Equal vectors have one number."""
        return self._model.number(read_N)

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What the environment shows in these states, through its wrappers."""
        inner_NO = self._model.observe(self._model.states(state_N))
        if not self._model.transforms.observations:
            return inner_NO
        rows = [self._seen.part(self._model.transforms.observation(row)) for row in inner_NO.cpu().numpy()]
        return self._seen.encode_part(np.array(rows, self._seen.space.dtype))

    def export(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The vectors."""
        return self._model.states(state_N).cpu()

    def adopt(self, exported: Tensor) -> Int[Tensor, "N"]:
        """New numbers, or those of equal vectors."""
        return self.numbers(exported.to(self.device))

    def forget(self) -> bool:
        """All states: hardly one of them returns."""
        self._model.clear()
        return True


@final
class PlainWorld(World):
    """An environment of which nothing is known but what it shows: each visit is a state of its own, and there is no
    lookahead beyond the critic.

    Args:
        env: copies of it.
        gamma: discount.
        observation_key: which part of dictionary observations a policy sees.
    """

    def __init__(
        self,
        env: VectorEnv,
        *,
        gamma: float,
        observation_key: str | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.env, self.gamma = env, gamma
        self.device = torch.device(device)
        self.num_actions = int(env.single_action_space.n)  # type: ignore[attr-defined]  # checked before
        self._seen = Observations(env, observation_key, self.device)
        self.observation_space = self._seen.space
        self._shown: list[Tensor] = []
        self._count = 0

    def encode(self, observation: Any) -> Tensor:
        """Numbers, vectors or images."""
        return self._seen.encode(observation)

    def see(self, env: VectorEnv, observation: Any) -> tuple[Tensor, Tensor]:
        """The observation, twice."""
        observation_B = self.encode(observation)
        return observation_B, observation_B

    def numbers(self, read_N: Tensor) -> Int[Tensor, "N"]:
        """The next numbers."""
        self._shown.append(read_N)
        first, self._count = self._count, self._count + len(read_N)
        return torch.arange(first, self._count, device=self.device)

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What was shown in these states."""
        if len(self._shown) > 1:
            self._shown = [torch.cat(self._shown)]
        return self._shown[0][state_N]

    def export(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The observations."""
        return self.observe(state_N).cpu()

    def adopt(self, exported: Tensor) -> Int[Tensor, "N"]:
        """The next numbers."""
        return self.numbers(exported.to(self.device))

    def forget(self) -> bool:
        """What was shown before."""
        self._shown, self._count = [], 0
        return True
