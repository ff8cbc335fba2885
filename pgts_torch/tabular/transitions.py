"""Lists of transitions, as in the P tables of Gymnasium's toy-text environments, as one table of outcomes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError
from pgts_torch.tabular.forms import EXACT, STORED, Start, start_distribution

LARGEST_VALUE = torch.finfo(torch.float64).max / 8
"""Beyond this size a value, or a difference of two, may be infinite."""

Transition = tuple[float, int, float, bool]
"""(probability, next state, reward, terminated)"""

Transitions = Mapping[int, Mapping[int, Sequence[Transition]]] | Sequence[Sequence[Sequence[Transition]]]
"""P[s][a]: what may follow state s and action a. Where a mapping P[s] lacks an action, it is not allowed there."""

_Row = tuple[float, dict[tuple[int, bool, float], float]]
"""Expected reward of (s, a), and the probability of each (next state, terminated, reward) that it may lead to."""


def outcomes_of(
    P: Transitions, gamma: float, start: Start
) -> tuple[Outcomes, Float[Tensor, "S"], Float[Tensor, "S A K"] | None]:
    """The outcomes, the start distribution, and the reward of each outcome where those of one (s, a) differ."""
    S = len(P)
    A = max((_num_actions(P[s]) for s in range(S)), default=0)
    if A == 0:
        raise PgtsError("P is empty; it must hold at least one state and one action")
    start_S = start_distribution(start, S)
    rows = [[_merged(P, s, a, S, A) for a in range(A)] for s in range(S)]
    for s in _terminal_states(rows, start_S):
        rows[s] = [(0.0, {(s, True, 0.0): 1.0})] * A
    K = max(len(successors) for row in rows for _, successors in row)
    mean = np.array([[expected_reward for expected_reward, _ in row] for row in rows])
    reward = mean[:, :, None].repeat(K, axis=2)
    prob, discount = np.zeros((S, A, K)), np.zeros((S, A, K))
    child = np.arange(S)[:, None, None].repeat(A, axis=1).repeat(K, axis=2)  # padding leads to the state itself
    for s, a in np.ndindex(S, A):
        for k, ((next_state, terminated, paid), p) in enumerate(rows[s][a][1].items()):
            prob[s, a, k], child[s, a, k], reward[s, a, k] = p, next_state, paid
            discount[s, a, k] = 0.0 if terminated else gamma
    reward_SA, prob_SAK, discount_SAK, child_SAK = map(torch.from_numpy, (mean, prob, discount, child))
    outcomes = Outcomes(reward_SA, prob_SAK, discount_SAK, child_SAK, S)
    return outcomes, start_S, torch.from_numpy(reward) if (reward != mean[:, :, None]).any() else None


def _num_actions(row: Any) -> int:
    return 1 + max(row, default=-1) if isinstance(row, Mapping) else len(row)


def _merged(P: Transitions, s: int, a: int, S: int, A: int) -> _Row:
    """P[s][a] with equal transitions added up and impossible ones left out."""
    if isinstance(P[s], Mapping):
        if a not in P[s]:
            return -math.inf, {(s, True, -math.inf): 1.0}
    elif len(P[s]) != A:
        most = next(t for t in range(S) if _num_actions(P[t]) == A)
        raise PgtsError(f"P[{s}] has {len(P[s])} actions; P[{most}] has {A}")
    successors = dict[tuple[int, bool, float], float]()
    # Counted from the first reward, so that equal rewards have exactly this mean.
    expected_reward = first_reward = float(P[s][a][0][2]) if len(P[s][a]) else 0.0
    for p, next_state, reward, terminated in P[s][a]:
        if not 0 <= next_state < S:
            raise PgtsError(f"P[{s}][{a}] leads to state {next_state}; states are 0 to {S - 1}")
        if p < 0 or not np.isfinite(p):
            raise PgtsError(f"P[{s}][{a}] has probability {p}; probabilities are finite and at least 0")
        reward = float(reward)  # a float32 would turn the largest value into infinity
        if not abs(reward) <= LARGEST_VALUE:
            raise PgtsError(f"P[{s}][{a}] has reward {reward}; rewards must be finite, at most {LARGEST_VALUE:.2g}")
        if p > 0:
            key = (int(next_state), bool(terminated), reward)
            successors[key] = successors.get(key, 0.0) + float(p)
            expected_reward += float(p) * (reward - first_reward)
    if not successors:
        raise PgtsError(f"P[{s}][{a}] has no outcome with positive probability")
    total = sum(successors.values())
    if EXACT < abs(total - 1) <= STORED:  # as `forms.normalised` does
        expected_reward = first_reward + (expected_reward - first_reward) / total
        successors = {key: p / total for key, p in successors.items()}
    return expected_reward, successors


def _terminal_states(rows: list[list[_Row]], start_S: Tensor) -> set[int]:
    """States entered by terminated transitions only, as far as the start distribution reaches them."""
    frontier = torch.nonzero(start_S).flatten().tolist()
    alive, ended = set(frontier), set[int]()
    while frontier:
        for expected_reward, successors in rows[frontier.pop()]:
            if expected_reward == -math.inf:
                continue
            for next_state, terminated, _ in successors:
                if terminated:
                    ended.add(next_state)
                elif next_state not in alive:
                    alive.add(next_state)
                    frontier.append(next_state)
    return ended - alive
