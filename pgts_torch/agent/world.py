"""What an agent acts in: copies of an environment, what a policy sees of them, and what a lookahead may ask.

A lookahead speaks of states, which are numbers; policies and critics speak of observations. A world translates.
"""

from abc import ABC, abstractmethod
from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import iterate
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.base import Model
from pgts_torch.models.classic import ClassicModel, dynamics_of
from pgts_torch.models.environments import base_actions, changing_wrapper, register
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.snapshots import adapter_for
from pgts_torch.models.tabular import TabularModel, tabular_truth
from pgts_torch.tabular.mdp import TabularMDP

DEFAULT_GAMMA = 0.99
"""Discount of an environment that carries none."""


class World(ABC):
    """Copies of an environment whose states are numbered.

    env: the copies that experience is made in.
    num_actions: of the discrete action set.
    observation_space: of what a policy sees.
    gamma: discount of a step that names none.
    device: where observations and states live.
    model: what a lookahead may ask; None: nothing.
    mdp: the exact truth, where there is one.
    """

    env: VectorEnv
    num_actions: int
    observation_space: spaces.Space[Any]
    gamma: float
    device: torch.device
    model: Model | None = None
    mdp: TabularMDP | None = None

    @abstractmethod
    def encode(self, observation: Any) -> Tensor:
        """What a policy sees, from what an environment says: one observation, or rows of them.

        Raises:
            PgtsError: observations that this environment cannot make, or that are not numbers.
        """

    @abstractmethod
    def number(self, env: VectorEnv, observation: Any) -> Int[Tensor, "B"]:
        """The state that each copy is in now; `observation` is what they have just said."""

    @abstractmethod
    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What a policy sees of numbered states."""

    @abstractmethod
    def forget(self) -> bool:
        """Begin to number anew where numbers only serve one iteration; whether it was so."""


@final
class TabularWorld(World):
    """An environment with a transition table: the observation is the state.

    Args:
        env: copies of it.
        mdp: the table.
    """

    def __init__(self, env: VectorEnv, mdp: TabularMDP, *, device: torch.device | str = "cpu") -> None:
        self.env, self.mdp = env, mdp
        self.num_actions = mdp.num_actions
        self.observation_space = env.single_observation_space
        self.gamma = float(mdp.outcomes.discount_NAK.max())
        self.device = torch.device(device)
        self.model: TabularModel = TabularModel(mdp, device=device)

    @property
    def mdp_shape(self) -> tuple[int, int]:
        """S and A."""
        return self.model.num_states, self.num_actions

    def encode(self, observation: Any) -> Tensor:
        """The states, int64."""
        return _states(observation, self.model.num_states).to(self.device)

    def number(self, env: VectorEnv, observation: Any) -> Int[Tensor, "B"]:
        """The observation."""
        return self.encode(observation)

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The state."""
        return state_N

    def forget(self) -> bool:
        """Nothing: a state keeps its number."""
        return False


class _Seen:
    """What a policy sees of an environment whose observations are numbers, vectors or images.

    Args:
        space: of the environment's observations.
        key: which part of dictionary observations is meant.

    Raises:
        PgtsError: dictionary observations without a key, a key that they do not have, or another kind of space.
    """

    def __init__(self, space: spaces.Space[Any], key: str | None, device: torch.device) -> None:
        if isinstance(space, spaces.Dict):
            known = ", ".join(map(str, space.keys()))
            if key is None:
                raise PgtsError(f"observations are dictionaries of {known}: say which part a policy sees")
            if key not in space.spaces:
                raise PgtsError(f"observations have no part {key!r}; they have {known}")
            space = space[key]
        elif key is not None:
            raise PgtsError(f"observations are {space}; they have no part {key!r}")
        if not isinstance(space, spaces.Discrete | spaces.Box):
            raise PgtsError(f"observations are {space}; a policy sees numbers, vectors or images")
        self.space, self.key, self.device = space, key, device

    def part(self, observation: Any) -> Any:
        """The part of an observation that is meant."""
        return observation if self.key is None else observation[self.key]

    def encode(self, observation: Any) -> Tensor:
        return self.encode_part(self.part(observation))

    def encode_part(self, part: Any) -> Tensor:
        if isinstance(self.space, spaces.Discrete):
            return _states(part, int(self.space.n)).to(self.device)
        array = np.asarray(part)
        if array.shape[-len(self.space.shape) :] != self.space.shape:
            raise PgtsError(f"an observation has shape {array.shape}; its space is {self.space}")
        tensor = torch.from_numpy(np.array(array)).to(self.device)
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise PgtsError(f"an observation is not finite: {array[~np.isfinite(array)][:3].tolist()}")
        return tensor


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
        self._seen = _Seen(env.single_observation_space, observation_key, self.device)
        self.observation_space = self._seen.space
        self._model = model

    def encode(self, observation: Any) -> Tensor:
        """Numbers, vectors or images."""
        return self._seen.encode(observation)

    def number(self, env: VectorEnv, observation: Any) -> Int[Tensor, "B"]:
        """The number of a snapshot of each copy."""
        assert isinstance(env, SyncVectorEnv)
        each = list(iterate(env.observation_space, observation))
        return self._model.roots(env.envs, each).to(self.device)

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What the simulator showed in these states."""
        return self._seen.encode_part(self._model.observations(state_N))

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
        observation_key: refused, for such environments show vectors.
    """

    def __init__(self, env: SyncVectorEnv, model: ClassicModel, *, observation_key: str | None = None) -> None:
        self.env, self.model = env, model
        self.num_actions, self.gamma, self.device = model.num_actions, model.gamma, model.device
        self._seen = _Seen(env.single_observation_space, observation_key, self.device)
        self.observation_space = self._seen.space
        self._model = model

    def encode(self, observation: Any) -> Tensor:
        """Vectors, float32."""
        return self._seen.encode(observation)

    def number(self, env: VectorEnv, observation: Any) -> Int[Tensor, "B"]:
        """The number of the state of each copy."""
        assert isinstance(env, SyncVectorEnv)
        return self._model.roots(env.envs)

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What the environment shows in these states."""
        return self._model.observe(self._model.states(state_N))

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
        self._seen = _Seen(env.single_observation_space, observation_key, self.device)
        self.observation_space = self._seen.space
        self._shown: list[Tensor] = []
        self._count = 0

    def encode(self, observation: Any) -> Tensor:
        """Numbers, vectors or images."""
        return self._seen.encode(observation)

    def number(self, env: VectorEnv, observation: Any) -> Int[Tensor, "B"]:
        """The next numbers."""
        encoded_B = self.encode(observation)
        self._shown.append(encoded_B)
        first, self._count = self._count, self._count + len(encoded_B)
        return torch.arange(first, self._count, device=self.device)

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """What was shown in these states."""
        if len(self._shown) > 1:
            self._shown = [torch.cat(self._shown)]
        return self._shown[0][state_N]

    def forget(self) -> bool:
        """What was shown before."""
        self._shown, self._count = [], 0
        return True


def make_world(
    env: str | VectorEnv,
    *,
    num_envs: int,
    gamma: float | None,
    observation_key: str | None,
    plain: bool,
    action_repeat: int = 1,
    device: torch.device | str,
    **kwargs: Any,
) -> World:
    """The world of an environment: what can be asked about it decides.

    A transition table makes it tabular; else its dynamics are asked if they are known in torch (`models.classic`); else
    snapshots make it simulated. It is plain where no model is needed.

    Args:
        env: a Gymnasium id, of which `num_envs` copies are made with `kwargs`, or copies.
        gamma: discount; None: the environment's own (pgts/*), else 0.99.
        observation_key: which part of dictionary observations a policy sees.
        plain: whether a world without a model will do: then snapshots are not taken.
        action_repeat: how often an action is taken in one outcome of the model (`TensorModel`).

    Raises:
        PgtsError: the environment does not exist, or is none that an agent can act in; or actions are to be repeated
            in a table, or where there is no model.
        MissingModel: it has no model, and needs one.
    """
    copies = make_vector_env(env, num_envs, gamma=gamma, **kwargs) if isinstance(env, str) else env
    check_vector_env(copies)
    discount = DEFAULT_GAMMA if gamma is None else gamma
    wrapper = changing_wrapper(copies.envs[0]) if isinstance(copies, SyncVectorEnv) else ""
    if wrapper and not plain:
        raise MissingModel(
            f"{env_name(copies)} is wrapped in {wrapper}, which may change what a step gives, and a model only knows "
            "the environment inside: leave it out, or make it part of an environment with get_state and set_state"
        )
    if observation_key is None and not wrapper and isinstance(copies.single_observation_space, spaces.Discrete):
        try:
            truth = tabular_truth(copies, gamma=discount)
        except MissingModel:
            if not isinstance(copies, SyncVectorEnv):
                raise
        else:
            _check_single(action_repeat, "in a table")
            return TabularWorld(copies, truth, device=device)
    if plain:
        _check_single(action_repeat, "without a model")
        return PlainWorld(copies, gamma=discount, observation_key=observation_key, device=device)
    if not isinstance(copies, SyncVectorEnv):
        raise MissingModel(f"{env_name(copies)} steps its copies together; a simulator needs a SyncVectorEnv of them")
    if (dynamics := dynamics_of(copies.envs[0])) is not None:
        vectors = dynamics(copies.envs[0], gamma=discount, action_repeat=action_repeat, device=device)
        return DynamicsWorld(copies, vectors, observation_key=observation_key)
    adapter = adapter_for(copies.envs[0])
    model = SimulatorModel(
        copies.env_fns[0],
        gamma=discount,
        actions=base_actions(copies.envs[0]),
        action_repeat=action_repeat,
        adapter=adapter,
        observe=None if observation_key is None else lambda observation: observation[observation_key],
        device=device,
    )
    return SimulatedWorld(copies, model, observation_key=observation_key, device=device)


def _check_single(action_repeat: int, where: str) -> None:
    if action_repeat != 1:
        raise PgtsError(f"action_repeat is {action_repeat}; {where} it must be 1")


def make_vector_env(env_id: str, num_envs: int, *, gamma: float | None, **kwargs: Any) -> VectorEnv:
    """Copies of a registered environment that reset by mask, without its time limit: the horizon is ours.

    Args:
        gamma: handed to environments that carry a discount of their own (pgts/*), if given.

    Raises:
        PgtsError: Gymnasium knows no such environment or cannot make it.
    """
    if num_envs < 1:
        raise PgtsError(f"num_envs is {num_envs}; it must be at least 1")
    register(env_id)
    options: dict[str, Any] = {"max_episode_steps": -1, **kwargs}
    try:
        if gymnasium.spec(env_id).namespace == "pgts":
            options |= {} if gamma is None else {"gamma": gamma}
            options |= {"vectorization_mode": "vector_entry_point", "autoreset_mode": AutoresetMode.DISABLED}
        else:
            options |= {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": AutoresetMode.DISABLED}}
        return gymnasium.make_vec(env_id, num_envs=num_envs, **options)
    except (gymnasium.error.Error, ImportError, LookupError, TypeError) as error:
        raise PgtsError(f"{env_id} cannot be made: {error}") from error


def check_vector_env(env: VectorEnv) -> None:
    """PgtsError unless rollouts can be made in this environment: discrete actions, reset by mask."""
    if not isinstance(env, VectorEnv):
        raise PgtsError(f"the environment is {env!r}; it must be a Gymnasium id or a VectorEnv")
    space = env.single_action_space
    if not isinstance(space, spaces.Discrete) or space.start != 0:
        raise PgtsError(f"the actions of {env_name(env)} are {space}; they must be Discrete(n) counted from 0")
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.DISABLED:
        raise PgtsError(f"the environment resets by {mode}; make it with autoreset_mode=AutoresetMode.DISABLED")


def _states(observation: Any, num_states: int) -> Int[Tensor, "..."]:
    """Observations that are numbers below `num_states`."""
    state = np.asarray(observation)
    if not np.issubdtype(state.dtype, np.integer):
        raise PgtsError(f"observation is of {state.dtype}; states are integers")
    off = state[(state < 0) | (state >= num_states)]
    if off.size:
        raise PgtsError(f"state {off.flat[0]} does not exist; states are 0 to {num_states - 1}")
    return torch.from_numpy(np.array(state, dtype=np.int64))


def env_name(env: VectorEnv) -> str:
    """What an error calls an environment."""
    return env.spec.id if env.spec is not None else repr(env)
