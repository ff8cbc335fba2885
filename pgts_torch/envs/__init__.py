"""The zoo as Gymnasium environments, one environment or thousands; and environments that are retraced."""

from pgts_torch.envs.retraced import Retraced
from pgts_torch.envs.tabular import TabularEnv
from pgts_torch.envs.vector import TabularVectorEnv

__all__ = ["Retraced", "TabularEnv", "TabularVectorEnv"]
