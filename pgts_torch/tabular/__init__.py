"""The exact world: tabular MDPs in float64 and everything that theory says of them."""

from pgts_torch.tabular import ascent, exact, foresight, rates, stationary, stationary_sets
from pgts_torch.tabular.mdp import TabularMDP
from pgts_torch.tabular.zoo import (
    combination_lock,
    corridor,
    deep_sea,
    grid,
    ladder,
    mirage,
    random_mdp,
    river_swim,
    roundabout,
    tightrope,
)

__all__ = [
    "TabularMDP",
    "ascent",
    "combination_lock",
    "corridor",
    "deep_sea",
    "exact",
    "foresight",
    "grid",
    "ladder",
    "mirage",
    "random_mdp",
    "rates",
    "river_swim",
    "roundabout",
    "stationary",
    "stationary_sets",
    "tightrope",
]
