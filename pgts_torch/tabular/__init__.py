"""The exact world: tabular MDPs in float64 and everything that theory says of them."""

from pgts_torch.tabular import ascent, exact, stationary
from pgts_torch.tabular.mdp import TabularMDP
from pgts_torch.tabular.zoo import deep_sea, grid, ladder, mirage, random_mdp, tightrope

__all__ = [
    "TabularMDP",
    "ascent",
    "deep_sea",
    "exact",
    "grid",
    "ladder",
    "mirage",
    "random_mdp",
    "stationary",
    "tightrope",
]
