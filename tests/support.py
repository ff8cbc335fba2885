"""MDPs, policies and slow oracles that several test folders share."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import (
    TabularMDP,
    combination_lock,
    corridor,
    deep_sea,
    grid,
    ladder,
    random_mdp,
    river_swim,
    tightrope,
)

ZOO: dict[str, Callable[[], TabularMDP]] = {
    "ladder": lambda: ladder(5),
    "ladder, uniform start": lambda: ladder(5, start=None),
    "tightrope": tightrope,
    "random, dense": random_mdp,
    "garnet": lambda: random_mdp(30, 3, branching=4, seed=1, start=None),
    "grid": grid,
    "grid, absorbing": lambda: grid(5, traps=(12,), absorbing=True),
    "deep_sea": lambda: deep_sea(6, mapping_seed=3, stochastic=True),
    "combination_lock": lambda: combination_lock(4, 3),
    "river_swim": river_swim,
    "corridor": corridor,
    "FrozenLake": lambda: TabularMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"), 0.99),
    "CliffWalking": lambda: TabularMDP.from_gymnasium(gymnasium.make("CliffWalking-v1"), 0.95),
    "Taxi": lambda: TabularMDP.from_gymnasium(gymnasium.make("Taxi-v4"), 0.9),
}
"""Every kind of tabular MDP that the library knows, by name; `zoo(name)` makes it."""


@functools.cache
def zoo(name: str) -> TabularMDP:
    return ZOO[name]()


def rewarded(mdp: TabularMDP, *, factor: float = 1.0, constant: float = 0.0) -> TabularMDP:
    """The MDP with other rewards."""
    outcomes = replace(mdp.outcomes, reward_NA=factor * mdp.outcomes.reward_NA + constant)
    reward_SAK = None if mdp.reward_SAK is None else factor * mdp.reward_SAK + constant
    return replace(mdp, outcomes=outcomes, reward_SAK=reward_SAK)


def random_policy(mdp: TabularMDP, seed: int = 0) -> Tensor:
    """Rows sampled uniformly from the simplex."""
    random = numpy_stream(seed, "random_policy")
    return torch.from_numpy(random.dirichlet(np.ones(mdp.num_actions), size=mdp.num_states))


def uniform_policy(mdp: TabularMDP) -> Tensor:
    return torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions, dtype=torch.float64)


def always(mdp: TabularMDP, action: int) -> Tensor:
    """The policy that takes one action in every state."""
    return torch.eye(mdp.num_actions, dtype=torch.float64)[action].repeat(mdp.num_states, 1)


def right_with(*probabilities: float) -> Tensor:
    """The policy pi_{a_0 a_1 ...} of the paper's tables: 'right' in state s with probability a_s."""
    right_S = torch.tensor(probabilities, dtype=torch.float64)
    return torch.stack([1 - right_S, right_S], -1)


@st.composite
def mdps(draw: st.DrawFn, max_states: int = 5, max_actions: int = 3, max_outcomes: int = 3) -> TabularMDP:
    """Garnets whose outcomes end, repeat a successor and carry each a discount of their own, at most 0.95."""
    S = draw(st.integers(1, max_states))
    A = draw(st.integers(1, max_actions))
    K = draw(st.integers(1, max_outcomes))
    random = numpy_stream(draw(st.integers(0, 10**6)), "mdps")
    ends = random.random((S, A, K)) < 0.2
    outcomes = Outcomes(
        torch.from_numpy(random.normal(size=(S, A))),
        torch.from_numpy(random.dirichlet(np.ones(K), size=(S, A))),
        torch.from_numpy(np.where(ends, 0.0, random.uniform(0.3, 0.95, size=(S, A, K)))),
        torch.from_numpy(random.integers(0, S, size=(S, A, K))),
        S,
    )
    return TabularMDP(outcomes, torch.from_numpy(random.dirichlet(np.ones(S))))


@st.composite
def mdps_with_policy(draw: st.DrawFn, **limits: int) -> tuple[TabularMDP, Tensor]:
    mdp = draw(mdps(**limits))
    return mdp, random_policy(mdp, seed=draw(st.integers(0, 10**6)))


def outcomes_of(mdp: TabularMDP, s: int, a: int) -> dict[tuple[int, float], float]:
    """Probability of each (next state, discount) that may follow (s, a)."""
    outcomes, answer = mdp.outcomes, dict[tuple[int, float], float]()
    for k in range(outcomes.num_outcomes):
        p = float(outcomes.prob_NAK[s, a, k])
        key = int(outcomes.child_NAK[s, a, k]), float(outcomes.discount_NAK[s, a, k])
        if p > 0:
            answer[key] = answer.get(key, 0.0) + p
    return answer


def weights(mdp: TabularMDP) -> np.ndarray:
    """sum_k p_k gamma_k of each (s, a, s'), by a plain loop: gamma P where the discount is one number."""
    dense = np.zeros((mdp.num_states, mdp.num_actions, mdp.num_states))
    for s, a in np.ndindex(mdp.num_states, mdp.num_actions):
        for (child, discount), p in outcomes_of(mdp, s, a).items():
            dense[s, a, child] += p * discount
    return dense


def tree_lookahead(mdp: TabularMDP, q_SA: Tensor, depth: int) -> Tensor:
    """T^m Q by walking every path of the tree: exponential, and too simple to be wrong."""

    def value(s: int, a: int, m: int) -> float:
        if m == 0:
            return float(q_SA[s, a])
        return float(mdp.outcomes.reward_NA[s, a]) + sum(
            p * discount * max(value(child, b, m - 1) for b in range(mdp.num_actions))
            for (child, discount), p in followers[s][a].items()
        )

    followers = [[outcomes_of(mdp, s, a) for a in range(mdp.num_actions)] for s in range(mdp.num_states)]
    table = [[value(s, a, depth) for a in range(mdp.num_actions)] for s in range(mdp.num_states)]
    return torch.tensor(table, dtype=torch.float64)


def same_values(first: Any, second: Any) -> bool:
    """Whether nested plain values and tensors are alike in every bit; NaN is like NaN."""
    if isinstance(first, Tensor):
        return torch.equal(first, second) and first.dtype == second.dtype
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same_values(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(same_values, first, second))
    return first == second or (first != first and second != second)
