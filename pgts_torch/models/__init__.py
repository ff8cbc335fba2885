"""Models of environments: what a lookahead may ask."""

from pgts_torch.models.actions import with_torques
from pgts_torch.models.base import EnumeratingModel, FallibleModel, SamplingModel, Transitions
from pgts_torch.models.classic import Acrobot, CartPole, MountainCar, Pendulum
from pgts_torch.models.counts import CountsModel
from pgts_torch.models.fidelity import check_model
from pgts_torch.models.posterior import posterior_certificate
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.state_index import StateIndex
from pgts_torch.models.tabular import TabularModel
from pgts_torch.models.tensor import TensorModel

__all__ = [
    "Acrobot",
    "CartPole",
    "CountsModel",
    "EnumeratingModel",
    "FallibleModel",
    "MountainCar",
    "Pendulum",
    "SamplingModel",
    "SimulatorModel",
    "StateIndex",
    "TabularModel",
    "TensorModel",
    "Transitions",
    "check_model",
    "posterior_certificate",
    "with_torques",
]
