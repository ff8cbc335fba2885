"""How deep is deep enough in random MDPs, by size, connections, rewards and discount."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse.csgraph

from pgts_torch.tabular import TabularMDP, random_mdp, stationary_sets


@dataclass(frozen=True)
class FamilyRow:
    """One random MDP: how it was sampled, how it is connected, and what its stationary policies are like.

    diameter: the largest finite shortest path between two states, in steps.
    sufficient_depth: the smallest M with Pi^M = Pi^inf.
    worst_return: b^0.
    """

    branching: int
    reward_share: float
    gamma: float
    num_states: int
    seed: int
    diameter: int
    sufficient_depth: int
    worst_return: float
    J_optimal: float


def family_study(
    *,
    branchings: Sequence[int] = (1, 2, 3),
    reward_shares: Sequence[float] = (0.05, 0.2, 1.0),
    gammas: Sequence[float] = (0.5, 0.9, 0.99),
    sizes: Sequence[int] = (5, 7, 9),
    seeds: Iterable[int] = range(20),
) -> list[FamilyRow]:
    """One row for each random MDP of two actions that starts in state 0.

    The same seed gives the same transitions for all gammas and reward shares, and the same rewards for all gammas.
    """
    rows = []
    for seed, branching, size, share, gamma in itertools.product(seeds, branchings, sizes, reward_shares, gammas):
        mdp = random_mdp(size, branching=branching, reward_share=share, gamma=gamma, seed=seed)
        sets = stationary_sets.enumerate_sets(mdp)
        found = diameter(mdp), sets.sufficient_depth, sets.worst_return(0), sets.J_optimal
        rows.append(FamilyRow(branching, share, gamma, size, seed, *found))
    return rows


def diameter(mdp: TabularMDP) -> int:
    """The largest finite shortest path between two states, in steps with positive probability and discount."""
    weight_SAS = mdp.outcomes.weight.to_dense().view(mdp.num_states, mdp.num_actions, -1)
    steps = scipy.sparse.csgraph.shortest_path((weight_SAS > 0).any(1).numpy(), unweighted=True)
    return int(steps[np.isfinite(steps)].max())
