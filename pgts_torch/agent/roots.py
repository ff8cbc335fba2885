"""The visited states that a process looks ahead from."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import ModelWorld
from pgts_torch.options.updates import StateWeight
from pgts_torch.seeding import mix


class Roots(NamedTuple):
    """Distinct visited states, ascending, from which this process looks ahead; there may be none.

    observation_N: the observation at the first visit to each.
    weight_N: w(s), the weight in the update.   occupancy_N: the weight in the estimate of d^pi.
    visited_M: the visited states among which a certificate is computed: those of all processes where all number states
        alike, else of this one.   own_N: the places of `state_N` among them.
    """

    state_N: Int[Tensor, "N"]
    observation_N: Shaped[Tensor, "N ..."]
    weight_N: Float[Tensor, "N"]
    occupancy_N: Float[Tensor, "N"]
    visited_M: Int[Tensor, "M"]
    own_N: Int[Tensor, "N"]


def roots_of(experience: Rollout, world: ModelWorld, state_weight: StateWeight) -> Roots:
    """Return the distinct states visited in the episodes of this process.

    Where all processes number states alike, as in a table, those that several have visited have one row, with the
    weight of all visits, and are divided among processes by a hash of the state. So the same process looks ahead from a
    state in every iteration, and knows what follows it.
    """
    (state_N, weight_N), (_, occupancy_N) = experience.visits(state_weight), experience.visits("occupancy")
    ranks = experience.ranks
    if ranks.size == 1 or not world.keeps_numbers:
        places_N = torch.arange(len(state_N), device=state_N.device)
        return Roots(state_N, experience.first_observation_N, weight_N, occupancy_N, state_N, places_N)
    states, *weights = ranks.rows("visited states", state_N, weight_N, occupancy_N)
    visited_M, row_V = states.unique(return_inverse=True)
    weight_M, occupancy_M = (torch.zeros_like(visited_M, dtype=x.dtype).index_add_(0, row_V, x) for x in weights)
    if state_weight == "uniform":
        weight_M = torch.ones_like(weight_M)
    own_N = torch.nonzero(mix(visited_M, 0) % ranks.size == ranks.rank).flatten()
    own = visited_M[own_N]
    return Roots(own, world.observe(own), weight_M[own_N], occupancy_M[own_N], visited_M, own_N)
