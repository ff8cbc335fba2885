"""Models of environments: what a lookahead may ask."""

from pgts_torch.models.base import EnumeratingModel, SamplingModel, Transitions
from pgts_torch.models.tabular import TabularModel

__all__ = ["EnumeratingModel", "SamplingModel", "TabularModel", "Transitions"]
