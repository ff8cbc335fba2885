"""The visited states that a process looks ahead from."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.draws import Draws
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import ModelWorld
from pgts_torch.options.updates import StateWeight
from pgts_torch.ranks import ALONE, Share
from pgts_torch.seeding import mix


class Roots(NamedTuple):
    """Distinct visited states, ascending, from which this process looks ahead; there may be none.

    observation_N: the observation at the first visit to each.
    weight_N: w(s), the weight in the update.   occupancy_N: the weight in the estimate of d^pi.
    visited_M: the states among which a certificate is computed: those of all processes where all number states alike,
        else of this one.   own_N: the places of `state_N` among them.
    are_all: whether they are all visited states, and not only those that were drawn.
    """

    state_N: Int[Tensor, "N"]
    observation_N: Shaped[Tensor, "N ..."]
    weight_N: Float[Tensor, "N"]
    occupancy_N: Float[Tensor, "N"]
    visited_M: Int[Tensor, "M"]
    own_N: Int[Tensor, "N"]
    are_all: bool


def roots_of(
    experience: Rollout, world: ModelWorld, state_weight: StateWeight, max_roots: int | None, draws: Draws
) -> Roots:
    """Return the distinct states visited in the episodes of this process, or those that are drawn.

    Where all processes number states alike, as in a table, those that several have visited have one row, with the
    weight of all visits, and are divided among processes by a hash of the state. So the same process looks ahead from a
    state in every iteration, and knows what follows it.

    Where the processes together have visited more than `max_roots` distinct states, so many visits are drawn
    (`weight_factors`): all processes draw the same ones.
    """
    (state_N, weight_N), (_, occupancy_N) = experience.visits(state_weight), experience.visits("occupancy")
    ranks, searched = experience.ranks, experience.whole.searched
    if ranks.size == 1 or not world.keeps_numbers:
        observation_N, are_all = experience.first_observation_N, True
        if max_roots is not None and ranks.totals("roots", len(state_N))[0] > max_roots:
            are_all = False
            factor_N = weight_factors(experience.count_N, searched, max_roots, draws.roots())
            drawn_N = factor_N > 0
            state_N, observation_N = state_N[drawn_N], observation_N[drawn_N]
            weight_N, occupancy_N = (weight_N * factor_N)[drawn_N], (occupancy_N * factor_N)[drawn_N]
        places_N = torch.arange(len(state_N), device=state_N.device)
        return Roots(state_N, observation_N, weight_N, occupancy_N, state_N, places_N, are_all)
    states, *columns = ranks.rows("visited states", state_N, weight_N, occupancy_N, experience.count_N)
    visited_M, row_V = states.unique(return_inverse=True)
    weight_M, occupancy_M, count_M = (
        torch.zeros_like(visited_M, dtype=x.dtype).index_add_(0, row_V, x) for x in columns
    )
    if state_weight == "uniform":
        weight_M = torch.ones_like(weight_M)
    are_all = True
    if max_roots is not None and len(visited_M) > max_roots:
        are_all = False
        factor_M = weight_factors(count_M, Share(ALONE, 0, searched.total), max_roots, draws.roots())
        drawn_M = factor_M > 0
        visited_M = visited_M[drawn_M]
        weight_M, occupancy_M = (weight_M * factor_M)[drawn_M], (occupancy_M * factor_M)[drawn_M]
    own_N = torch.nonzero(mix(visited_M, 0) % ranks.size == ranks.rank).flatten()
    own = visited_M[own_N]
    return Roots(own, world.observe(own), weight_M[own_N], occupancy_M[own_N], visited_M, own_N, are_all)


def weight_factors(
    count_N: Int[Tensor, "N"], share: Share, num_drawn: int, generator: torch.Generator
) -> Float[Tensor, "N"]:
    """By what the weights of states are multiplied so that visits that are drawn stand for all; 0 where none was drawn.

        factor(s) = (V / n) k(s) / c(s),        E factor(s) = 1

    where n of V visits are drawn without replacement, and k(s) of the c(s) visits to s are among them.

    Args:
        count_N: c(s) of the states of this process.
        share: which of the V visits these are.
    """
    place_n = torch.randperm(share.total, generator=generator)[:num_drawn].to(count_N.device)
    # Visits are numbered state by state: those to the first one are `share.first` and those that follow.
    end_N = share.first + count_N.cumsum(0)
    row_n = torch.searchsorted(end_N, place_n, right=True)
    is_own_n = (place_n >= share.first) & (row_n < len(count_N))
    drawn_N = torch.bincount(row_n[is_own_n], minlength=len(count_N))
    return drawn_N.double() * (share.total / num_drawn) / count_N
