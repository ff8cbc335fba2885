"""Worlds whose model was not written for the environment: one that is learned from its steps, or the caller's own.

Their states are what is observed: numbers or vectors; those of images are vectors that represent them.
"""

import importlib
from typing import Any, final

import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.latent import LatentModel
from pgts_torch.agent.world import ModelWorld, TabularWorld, VectorStates, World
from pgts_torch.errors import MissingModel, PgtsError, failure
from pgts_torch.models.base import Model
from pgts_torch.models.counts import CountsModel
from pgts_torch.models.ensemble import EnsembleModel
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.tabular import TabularModel
from pgts_torch.models.tensor import TensorModel
from pgts_torch.options.models import Counts, Ensemble, Latent, OwnModel


@final
class VectorWorld(VectorStates):
    """Environments whose observations are vectors, which are the states of a model.

    Args:
        env: the environments.
        model: its states are observations.
        observation_key: the entry of dictionary observations that is used.
    """

    def __init__(
        self, env: VectorEnv, model: TensorModel, *, gamma: float, observation_key: str | None, device: torch.device
    ) -> None:
        super().__init__(env, gamma=gamma, observation_key=observation_key, device=device)
        self.model: TensorModel = model

    def read(self, observation: Any, encoded_B: Tensor) -> Float[Tensor, "B D"]:
        """The observations, because they are the states."""
        return encoded_B.to(self.model.state_dtype)

    def observe(self, state_N: Int[Tensor, "N"]) -> Shaped[Tensor, "N D"]:
        """The states, because they are the observations."""
        return self.model.states(state_N)


@final
class LatentWorld(ModelWorld):
    """Environments whose observations are images, which a model represents as vectors: its states, which policies and
    critics take.

    Args:
        env: the environments.
        model: represents and steps.
        observation_key: the entry of dictionary observations that is used.
    """

    def __init__(
        self, env: VectorEnv, model: LatentModel, *, gamma: float, observation_key: str | None, device: torch.device
    ) -> None:
        super().__init__(env, gamma=gamma, observation_key=observation_key, device=device)
        self.model: LatentModel = model
        self.perceive, self.perceived_space = model.represent, spaces.Box(-torch.inf, torch.inf, (model.state_size,))

    def read(self, observation: Any, encoded_B: Tensor) -> Float[Tensor, "B D"]:
        """The vectors that represent the images."""
        return self.model.represent(encoded_B)

    def numbers(self, read_N: Float[Tensor, "N D"]) -> Int[Tensor, "N"]:
        return self.model.number(read_N)

    def observe(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N D"]:
        """The states, because policies and critics take these."""
        return self.model.states(state_N)

    def export(self, state_N: Int[Tensor, "N"]) -> Tensor:
        return self.model.states(state_N).cpu()

    def adopt(self, exported: Tensor) -> Int[Tensor, "N"]:
        """The numbers of vectors, or of images that a replay has kept."""
        vectors_ND = exported.to(self.device) if exported.ndim == 2 else self.model.represent(exported)
        return self.model.number(vectors_ND)

    def reset_numbers(self) -> None:
        """Drop all states, because hardly any is met again."""
        self.model.clear()


def learned_world(
    env: VectorEnv,
    options: Counts | Ensemble | Latent,
    *,
    gamma: float,
    observation_key: str | None,
    action_repeat: int,
    capacity: int,
    seed: int,
    device: torch.device,
) -> ModelWorld:
    """Return the environments with a model that has learned nothing yet.

    Args:
        capacity: the number of steps that the model keeps.
        seed: of its initial weights.

    Raises:
        MissingModel: it does not learn from such observations.
    """
    world = World(env, gamma=gamma, observation_key=observation_key, device=device)
    space = world.observation_space
    if isinstance(options, Counts):
        if not isinstance(space, spaces.Discrete):
            raise MissingModel(
                f"model is 'counts', which needs numbered states; observations of {env_name(env)} are {space}: take "
                "'ensemble' if they are vectors, 'latent' if they are images"
            )
        if action_repeat > 1:
            raise PgtsError(f"action_repeat is {action_repeat}; in a table it must be 1")
        table = CountsModel(int(space.n), world.num_actions, gamma=gamma, options=options, device=device)
        return TabularWorld(env, None, model=table, gamma=gamma, observation_key=observation_key, device=device)
    given: dict[str, Any] = {
        "gamma": gamma,
        "options": options,
        "capacity": capacity,
        "seed": seed,
        "device": device,
        "action_repeat": action_repeat,
    }
    shared: dict[str, Any] = {"gamma": gamma, "observation_key": observation_key, "device": device}
    axes = len(space.shape) if isinstance(space, spaces.Box) else 0
    if axes != (needed := 3 if isinstance(options, Latent) else 1):
        kind = {1: "vectors of numbers", 3: "images (height, width, channels)"}[needed]
        other = {0: "take 'counts'", 1: "take 'ensemble'", 3: "take 'latent'"}.get(axes, "make them such by a wrapper")
        raise MissingModel(
            f"model is {options.type!r}, which learns from {kind}; observations of {env_name(env)} are {space}: {other}"
        )
    assert isinstance(space, spaces.Box)
    if isinstance(options, Latent):
        return LatentWorld(env, LatentModel(space, world.num_actions, **given), **shared)
    return VectorWorld(env, EnsembleModel(space.shape[0], world.num_actions, **given), **shared)


def own_model(options: OwnModel) -> Model:
    """Return the model that a class or function of the caller's own makes.

    Raises:
        PgtsError: its module cannot be imported, or has no such name, or what it makes is no model.
    """
    assert options.make is not None
    module, _, name = options.make.partition(":")
    try:
        made = getattr(importlib.import_module(module), name)(**options.arguments)
    except BaseException as error:
        raise failure(f"model.make is {options.make}, which cannot be made", error) from error
    if not isinstance(made, Model):
        raise PgtsError(f"model.make is {options.make}, which made {made!r}; it must be a pgts_torch.models.Model")
    return made


def world_of(
    env: VectorEnv, model: Model, *, gamma: float, observation_key: str | None, device: torch.device
) -> ModelWorld:
    """Return the environments with a model of the caller's own, whose states are observations.

    Raises:
        PgtsError: the model does not fit the environments.
    """
    world = World(env, gamma=gamma, observation_key=observation_key, device=device)
    space, name = world.observation_space, type(model).__name__
    if model.num_actions != world.num_actions:
        raise PgtsError(f"{name} has {model.num_actions} actions; {env_name(env)} has {world.num_actions}")
    if torch.empty(0, device=model.device).device != torch.empty(0, device=device).device:
        raise PgtsError(f"{name} is on the device {model.device}; the training is on {device}")
    if isinstance(space, spaces.Discrete) and not isinstance(model, TensorModel):
        if model.num_states != space.n:
            raise PgtsError(f"{name} has {model.num_states} states; {env_name(env)} has {space.n}")
        mdp = model.mdp if isinstance(model, TabularModel) else None
        return TabularWorld(env, mdp, model=model, gamma=gamma, observation_key=observation_key, device=device)
    if isinstance(space, spaces.Box) and isinstance(model, TensorModel):
        if space.shape != (model.state_size,):
            raise PgtsError(
                f"states of {name} have {model.state_size} numbers; observations of {env_name(env)} have the shape "
                f"{space.shape}: both must be the same vectors"
            )
        return VectorWorld(env, model, gamma=gamma, observation_key=observation_key, device=device)
    raise PgtsError(
        f"{name} does not fit {env_name(env)}, whose observations are {space}: numbered observations need a model over "
        "their numbers, vectors a TensorModel over such vectors"
    )
