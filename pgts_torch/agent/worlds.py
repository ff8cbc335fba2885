"""Environments whose states are numbered by a table, as snapshots, or as vectors."""

from functools import cached_property
from typing import Any, final

import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import iterate
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.world import ModelWorld
from pgts_torch.models.base import EnumeratingModel, LearningModel, Model
from pgts_torch.models.dynamics import DynamicsModel
from pgts_torch.models.masks import ActionMasks, Masked
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.snapshots import each_of
from pgts_torch.models.tabular import TabularModel
from pgts_torch.models.tensor import TensorModel
from pgts_torch.models.vector_simulator import VectorSimulator
from pgts_torch.options.environment import Observed
from pgts_torch.tabular.mdp import TabularMDP


@final
class TabularWorld(ModelWorld):
    """Environments with numbered states: the observation is the state.

    Args:
        mdp: the table of the environment; None: it is not known.
        model: what a lookahead queries; default: the table.
        gamma: discount; default: that of the table.
        starts_known: whether the start distribution of the table is that of the environment; False: it was
            estimated from resets.
        env, observed, numbered, masks, device: as in `World`.
    """

    keeps_numbers = True
    shows_masks = False

    def __init__(
        self,
        env: VectorEnv,
        mdp: TabularMDP | None,
        *,
        model: Model | None = None,
        gamma: float = 1.0,
        starts_known: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(env, gamma=gamma if mdp is None else float(mdp.outcomes.discount_NAK.max()), **options)
        self.mdp, self.starts_known = mdp, starts_known
        if model is None:
            assert mdp is not None
            model = TabularModel(mdp, device=self.device)
        self.model = model
        self.start_S = mdp.start_S.to(self.device) if starts_known and mdp is not None else None

    @property
    def mdp_shape(self) -> tuple[int, int]:
        """S and A."""
        return self.model.num_states, self.num_actions

    @cached_property
    def legal_SA(self) -> Bool[Tensor, "S A"] | None:
        """The actions that a table does not forbid, with rewards of -inf; None: all are allowed."""
        model = self.model
        if not isinstance(model, EnumeratingModel) or isinstance(model, LearningModel):
            return None
        every_S = torch.arange(model.num_states, device=self.device)
        legal_SA = (model.outcomes(every_S) if model.table is None else model.table).legal_NA
        return None if legal_SA.all() else legal_SA

    def read(self, observation: Any, encoded_B: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        return encoded_B

    def numbers(self, read_N: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
        return read_N

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        return state_N

    def export(self, state_N: Int[Tensor, "N"]) -> Tensor:
        return state_N.cpu()

    def adopt(self, exported: Tensor) -> Int[Tensor, "N"]:
        return exported.to(self.device)

    def reset_numbers(self) -> None:
        """Do nothing, because states keep their numbers."""


@final
class SimulatedWorld(ModelWorld):
    """Environments that can be restored from snapshots. A state is the number of a snapshot.

    Args:
        env, observed, numbered, masks, device: as in `World`.
    """

    def __init__(self, env: SyncVectorEnv, model: SimulatorModel | VectorSimulator, **options: Any) -> None:
        super().__init__(env, gamma=model.gamma, **options)
        self.model: SimulatorModel | VectorSimulator = model

    def read(self, observation: Any, encoded_B: Tensor) -> Int[Tensor, "B"]:
        """Take a snapshot of each environment and return their numbers."""
        legal_BA = None
        if isinstance(observation, Masked):
            observation, legal_BA = observation
        each = iterate(self.env.observation_space, observation)
        return self.model.roots(each_of(self.env), each, legal_BA).to(self.device)

    def numbers(self, read_N: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
        return read_N

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The observations that the simulator made in these states: of which it keeps rows, where these are something
        else than what the environment gives."""
        kept_N = self.model.observations(state_N)
        if self.observations.as_given:
            kept_N = self.observations.rows(kept_N)
        if isinstance(self.masks, ActionMasks):
            kept_N = self.observations.with_legal(kept_N, self.model.legal(state_N))
        return torch.from_numpy(kept_N).to(self.device)

    def export(self, state_N: Int[Tensor, "N"]) -> list[Any]:
        """The snapshot and observation of each state; those of equal states are one object, which is pickled once."""
        distinct, index_N = state_N.unique(return_inverse=True)
        exported = self.model.export(distinct)
        return [exported[n] for n in index_N.tolist()]

    def adopt(self, exported: list[Any]) -> Int[Tensor, "N"]:
        return self.model.adopt(exported).to(self.device)

    def reset_numbers(self) -> None:
        """Drop all snapshots: every search adds some, and few states are met again."""
        self.model.clear()


class VectorStates(ModelWorld):
    """Environments with a model whose states are vectors. A state is the number of a vector."""

    model: TensorModel

    def numbers(self, read_N: Shaped[Tensor, "N ..."]) -> Int[Tensor, "N"]:
        return self.model.number(self.perceive(read_N))

    def export(self, state_N: Int[Tensor, "N"]) -> Tensor:
        return self.model.states(state_N).cpu()

    def adopt(self, exported: Tensor) -> Int[Tensor, "N"]:
        return self.numbers(exported.to(self.device))

    def reset_numbers(self) -> None:
        """Drop all states, because hardly any is met again."""
        self.model.clear()


@final
class DynamicsWorld(VectorStates):
    """Environments whose dynamics, `model`, are written in torch.

    Args:
        observed: what is seen of observations, where a wrapper makes something else of them.
    """

    def __init__(self, env: SyncVectorEnv, model: DynamicsModel, *, observed: Observed = Observed()) -> None:  # noqa: B008
        super().__init__(env, gamma=model.gamma, observed=observed, device=model.device)
        self.model: DynamicsModel = model

    def read(self, observation: Any, encoded_B: Tensor) -> Float[Tensor, "B D"]:
        return self.model.vectors(each_of(self.env))

    def observe(self, state_N: Int[Tensor, "N"]) -> Tensor:
        """The observations in these states, as the wrappers of the environment change them."""
        inner_NO = self.model.observe(self.model.states(state_N))
        if not self.model.transforms.observations:
            return inner_NO
        rows = [self.observations.rows(self.model.transforms.observation(row)) for row in inner_NO.cpu().numpy()]
        return torch.from_numpy(np.array(rows)).to(self.device)
