"""The zoo as Gymnasium environments, one environment or thousands."""

from pgts_torch.envs.tabular import TabularEnv
from pgts_torch.envs.vector import TabularVectorEnv

__all__ = ["TabularEnv", "TabularVectorEnv"]
