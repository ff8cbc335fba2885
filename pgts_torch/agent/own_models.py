"""Worlds whose model was not written for the environment: one that is learned from its steps, or the caller's own.

Their states are what is observed: numbers or vectors; those of images are vectors that represent them.
"""

from typing import Any, Literal, final

import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from gymnasium.vector import VectorEnv
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.components import image_shape, num_combinations, with_legal, with_mask
from pgts_torch.agent.latent import LatentModel
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.agent.worlds import TabularWorld, VectorStates
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.base import Model
from pgts_torch.models.counts import CountsModel
from pgts_torch.models.ensemble import EnsembleModel
from pgts_torch.models.masks import ActionMasks
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.tabular import TabularModel
from pgts_torch.models.tensor import TensorModel
from pgts_torch.options.environment import Observed
from pgts_torch.options.models import Counts, Ensemble, Latent
from pgts_torch.options.own import OwnModel
from pgts_torch.trust import made_by

_MOST_STATES = 2**20
"""Combinations of several numbers are counted up to so many."""


@final
class VectorWorld(VectorStates):
    """Environments whose observations are vectors, or are represented as vectors, which are the states of a model.

    Args:
        model: its states are observations, or what it makes of them.
    """

    def __init__(self, env: VectorEnv, model: TensorModel, *, gamma: float, **options: Any) -> None:
        super().__init__(env, gamma=gamma, **options)
        self.model: TensorModel = model
        self._shows_legal = model.forbids or isinstance(self.masks, ActionMasks)
        if self._shows_legal and not isinstance(self.masks, ActionMasks):
            self.legal_of = lambda row_ND: model.legal(row_ND.to(model.state_dtype))
            self.observation_space = self.perceived_space = with_mask(self.observation_space, self.num_actions)
        if isinstance(model, LatentModel):
            self.perceive, self.perceived_space = model.represent, model.space

    def read(self, observation: Any, encoded_B: Tensor) -> Float[Tensor, "B ..."]:
        """The observations, because they are the states, or these are made of them."""
        states_B = encoded_B[..., : -self.num_actions] if self._shows_legal else encoded_B
        return states_B.to(self.model.state_dtype)

    def observe(self, state_N: Int[Tensor, "N"]) -> Shaped[Tensor, "N D"]:
        """The states, because policies take them."""
        state_ND = self.model.states(state_N)
        return with_legal(state_ND, self.model.legal(state_ND)) if self._shows_legal else state_ND


def learned_world(
    env: VectorEnv,
    options: Counts | Ensemble | Latent,
    *,
    gamma: float,
    observed: Observed,
    action_repeat: int,
    capacity: int,
    seed: int,
    masks: ActionMasks | Literal["off"] | None,
    device: torch.device,
) -> ModelWorld:
    """Return the environments with a model that has learned nothing yet.

    Raises:
        MissingModel: it does not learn from such observations.
    """
    shared: dict[str, Any] = {"gamma": gamma, "observed": observed, "masks": masks, "device": device}
    world = World(env, **shared)
    space = world.observation_space
    if (kind := _learned_by(space)) is not type(options):
        needed = {Counts: "numbers", Ensemble: "vectors of numbers", Latent: "images"}[type(options)]
        way_out = "make them such by a wrapper" if kind is None else f"take {kind().type!r}"
        raise MissingModel(
            f"model is {options.type!r}, which learns from {needed}; observations of {env_name(env)} are {space}: "
            f"{way_out}"
        )
    if isinstance(options, Counts):
        if action_repeat > 1:
            raise PgtsError(f"action_repeat is {action_repeat}; in a table it must be 1")
        num_states = num_combinations(space)
        assert num_states is not None
        table = CountsModel(num_states, world.num_actions, gamma=gamma, options=options, device=device)
        return TabularWorld(env, None, model=table, numbered=True, **shared)
    given: dict[str, Any] = {
        "gamma": gamma,
        "options": options,
        "capacity": capacity,
        "seed": seed,
        "device": device,
        "action_repeat": action_repeat,
    }
    assert isinstance(space, spaces.Box)
    if isinstance(options, Latent):
        model: TensorModel = LatentModel(space, world.num_actions, **given)
    else:
        model = EnsembleModel(space.shape[0], world.num_actions, action_size=world.action_size or 0, **given)
    return VectorWorld(env, model, **shared)


def _learned_by(space: Space[Any]) -> type[Counts | Ensemble | Latent] | None:
    """Which model learns from such observations; None: no model does."""
    count = num_combinations(space)
    if isinstance(space, spaces.Discrete) or (count is not None and count <= _MOST_STATES):
        return Counts
    if not isinstance(space, spaces.Box):
        return None
    return Ensemble if len(space.shape) == 1 else Latent if image_shape(space) is not None else None


def own_model(options: OwnModel) -> Model:
    """Return the model that a class or function of the caller's own makes.

    Raises:
        PgtsError: its module cannot be imported, or has no such name, or what it makes is no model.
    """
    assert options.make is not None
    made = made_by("model.make is", options.make, **options.arguments)
    if not isinstance(made, Model):
        raise PgtsError(f"model.make is {options.make}, which made {made!r}; it must be a pgts_torch.models.Model")
    return made


def world_of(
    env: VectorEnv,
    *,
    model: Model,
    gamma: float,
    observed: Observed,
    masks: ActionMasks | Literal["off"] | None,
    device: torch.device,
) -> ModelWorld:
    """Return the environments with a model of the caller's own, whose states are observations.

    Raises:
        PgtsError: the model does not fit the environments.
    """
    shared: dict[str, Any] = {"gamma": gamma, "observed": observed, "masks": masks, "device": device}
    world = World(env, **shared | {"masks": None})
    space, name = world.observation_space, type(model).__name__
    if model.num_actions != world.num_actions:
        raise PgtsError(f"{name} has {model.num_actions} actions; {env_name(env)} has {world.num_actions}")
    if torch.empty(0, device=model.device).device != torch.empty(0, device=device).device:
        raise PgtsError(f"{name} is on the device {model.device}; the training is on {device}")
    if isinstance(space, spaces.Discrete) and not isinstance(model, TensorModel):
        if model.num_states != space.n:
            raise PgtsError(f"{name} has {model.num_states} states; {env_name(env)} has {space.n}")
        mdp = model.mdp if isinstance(model, TabularModel) else None
        return TabularWorld(env, mdp, model=model, **shared)
    if isinstance(space, spaces.Box) and isinstance(model, TensorModel):
        if space.shape != (model.state_size,):
            raise PgtsError(
                f"states of {name} have {model.state_size} numbers; observations of {env_name(env)} have the shape "
                f"{space.shape}: both must be the same vectors"
            )
        return VectorWorld(env, model, **shared)
    raise PgtsError(
        f"{name} does not fit {env_name(env)}, whose observations are {space}: numbered observations need a model over "
        "their numbers, vectors a TensorModel over such vectors"
    )
