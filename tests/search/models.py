"""Models and critics that keep a record of their queries, the slow oracle of the search, and what its tests share."""

import math
from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.models import EnumeratingModel, TabularModel
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP
from tests.support import weights

Step = Callable[[Hashable, int], tuple[float, Sequence[tuple[float, float, Hashable]]]]
"""(state, action) to the expected reward and the outcomes (probability, discount, next state)."""


class WatchedModel(EnumeratingModel):
    """Another model, with the states of its queries, call by call."""

    def __init__(self, model: EnumeratingModel) -> None:
        self.model = model
        self.num_actions, self.device, self.dtype = model.num_actions, model.device, model.dtype
        self.num_outcomes = model.num_outcomes
        self.calls: list[list[int]] = []

    @property
    def num_states(self) -> int:
        return self.model.num_states

    @property
    def queried(self) -> list[int]:
        """The states of all queries, in order, with repetition."""
        return [state for call in self.calls for state in call]

    def outcomes(self, state_N: Tensor) -> Outcomes:
        self.calls.append(state_N.tolist())
        return self.model.outcomes(state_N)


class InterningModel(EnumeratingModel):
    """States that are anything hashable, numbered as they are met; K is the most outcomes among those of a query."""

    def __init__(self, step: Step, starts: Sequence[Hashable], *, num_actions: int) -> None:
        self.step = step
        self.states = list(starts)
        self.number = {state: n for n, state in enumerate(starts)}
        self.num_actions = num_actions
        self.device, self.dtype = torch.device("cpu"), torch.float64

    @property
    def num_states(self) -> int:
        return len(self.states)

    def intern(self, state: Hashable) -> int:
        if state not in self.number:
            self.number[state] = len(self.states)
            self.states.append(state)
        return self.number[state]

    def outcomes(self, state_N: Tensor) -> Outcomes:
        queried = [self.states[s] for s in state_N.tolist()]
        rows = [[self.step(state, a) for a in range(self.num_actions)] for state in queried]
        K = max(len(followers) for row in rows for _, followers in row)
        prob, discount = torch.zeros(2, len(queried), self.num_actions, K, dtype=torch.float64)
        child = torch.zeros(len(queried), self.num_actions, K, dtype=torch.int64)
        for n, row in enumerate(rows):
            for a, (_, followers) in enumerate(row):
                for k, (p, gamma, state) in enumerate(followers):
                    prob[n, a, k], discount[n, a, k], child[n, a, k] = p, gamma, self.intern(state)
        reward = torch.tensor([[r for r, _ in row] for row in rows], dtype=torch.float64)
        return Outcomes(reward, prob, discount, child, self.num_states)


class Masked(EnumeratingModel):
    """An MDP in which some actions of some states are not allowed; what follows them is a state that nobody may see.

    Args:
        allowed_SA: which actions are.
        keeps_table: whether searches may read the table in place.
    """

    def __init__(self, mdp: TabularMDP, allowed_SA: Tensor, *, keeps_table: bool = False) -> None:
        S, off_SA1 = mdp.num_states, ~allowed_SA.unsqueeze(-1)
        self.num_actions, self.num_states, self.num_outcomes = mdp.num_actions, S + 1, mdp.outcomes.num_outcomes
        self.device, self.dtype = torch.device("cpu"), torch.float64
        reward, prob, discount, child = (
            torch.cat([x, x[:1]])
            for x in (
                mdp.outcomes.reward_NA.masked_fill(~allowed_SA, -torch.inf),
                mdp.outcomes.prob_NAK.where(~off_SA1, 0.7),
                mdp.outcomes.discount_NAK.where(~off_SA1, 0.9),
                mdp.outcomes.child_NAK.where(~off_SA1, S),
            )
        )
        self.outcomes_of_all = Outcomes(reward, prob, discount, child, S + 1)
        self.keeps_table = keeps_table

    @property
    def table(self) -> Outcomes | None:
        return self.outcomes_of_all if self.keeps_table else None

    def outcomes(self, state_N: Tensor) -> Outcomes:
        assert int(state_N.max()) < self.num_states - 1
        return self.outcomes_of_all.rows(state_N)


class Critic:
    """The rows of a table, with the states of its calls, call by call."""

    def __init__(self, table: Tensor) -> None:
        self.table = table
        self.calls: list[list[int]] = []

    def __call__(self, state_N: Tensor) -> Tensor:
        self.calls.append(state_N.tolist())
        return self.table[state_N]


def watched(mdp: TabularMDP) -> WatchedModel:
    return WatchedModel(TabularModel(mdp))


def some_q(mdp: TabularMDP, seed: int = 0) -> Tensor:
    """Leaf values that are nobody's Q."""
    generator = stream(seed, "some_q")
    return 10 * torch.randn(mdp.num_states, mdp.num_actions, dtype=torch.float64, generator=generator)


def some_v(mdp: TabularMDP, seed: int = 0) -> Tensor:
    return 10 * torch.randn(mdp.num_states, dtype=torch.float64, generator=stream(seed, "some_v"))


def zeros(state_N: Tensor) -> Tensor:
    """The critic that knows nothing of v."""
    return torch.zeros(len(state_N), dtype=torch.float64)


def paths(state: tuple[int, ...], action: int) -> tuple[float, list[tuple[float, float, tuple[int, ...]]]]:
    """Two actions with two outcomes each; a state is the path that led there, so that no two paths meet."""
    return float(sum(state)), [(0.5, 0.9, (*state, 2 * action)), (0.5, 0.9, (*state, 2 * action + 1))]


def assert_close(actual: Tensor, expected: Tensor, tolerance: float = 1e-11) -> None:
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def q_of(mdp: TabularMDP, v_S: Tensor) -> Tensor:
    """r + gamma P v by a dense product."""
    return mdp.outcomes.reward_NA + torch.from_numpy(weights(mdp) @ v_S.numpy())


def all_states(mdp: TabularMDP) -> Tensor:
    return torch.arange(mdp.num_states)


def walk_the_tree(
    step: Step, state: Hashable, depth: int, v: Callable[[Hashable], float], num_actions: int
) -> list[float]:
    """(T^m Q)(s, .) for Q = r + gamma P v by walking every path."""

    def q(state: Hashable, a: int, m: int) -> float:
        reward, followers = step(state, a)
        if reward == -math.inf:
            return reward
        return reward + sum(p * gamma * (value(child, m) if gamma else 0.0) for p, gamma, child in followers)

    def value(state: Hashable, m: int) -> float:
        return v(state) if m == 0 else max(q(state, a, m - 1) for a in range(num_actions))

    return [q(state, a, depth) for a in range(num_actions)]
