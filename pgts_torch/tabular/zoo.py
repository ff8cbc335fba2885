"""The MDPs of the paper and of its neighbours, each with its source.

`start` is a state, a distribution over states, or None for the uniform start distribution.
"""

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import ArrayLike

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular.mdp import TabularMDP, Transition, check_gamma, start_distribution

LEFT, RIGHT = 0, 1
Start = int | ArrayLike | None


def ladder(n: int = 5, *, gamma: float = 0.9, start: Start = 0) -> TabularMDP:
    """A chain of n states; only 'right' in the last one is rewarded, with 1.        [PGTS Ex. 1]

    Always 'left' is stationary for every depth below n - 1. J* = gamma^(n-1) / (1 - gamma) from state 0.
    """
    _check_size("n", n, 1)
    P = [
        [
            [(1.0, max(s - 1, 0), 0.0, False)],
            [(1.0, min(s + 1, n - 1), float(s == n - 1), False)],
        ]
        for s in range(n)
    ]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=("left", "right"))


def tightrope(*, gamma: float = 0.9, start: Start = 0) -> TabularMDP:
    """Four states: s0 -> s1 -> s2 by 'right', where every step earns 1; 'left' in s1 falls to s3, where every step
    costs 10.        [PGTS Ex. 3; Efroni et al. 2018]

    J* = gamma^2 / (1 - gamma) from state 0.
    """
    loop_2, loop_3 = [(1.0, 2, 1.0, False)], [(1.0, 3, -10.0, False)]
    P = [
        [[(1.0, 0, 0.0, False)], [(1.0, 1, 0.0, False)]],
        [[(1.0, 3, 0.0, False)], [(1.0, 2, 0.0, False)]],
        [loop_2, loop_2],
        [loop_3, loop_3],
    ]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=("left", "right"))


def random_mdp(
    num_states: int = 10,
    num_actions: int = 2,
    *,
    branching: int | None = None,
    reward_share: float = 1.0,
    seed: int = 0,
    gamma: float = 0.9,
    start: Start = 0,
) -> TabularMDP:
    """Random transitions and rewards.        [PGTS Ex. 2; with `branching` a Garnet, Archibald et al. 1995]

    Each (s, a) leads to `branching` distinct states, drawn uniformly, with probabilities uniform on the simplex and a
    reward uniform in [0, 1].

    Args:
        branching: successors of each (s, a); None: every state.
        reward_share: the share of (s, a) that keep their reward, drawn at random, at least one; the others earn 0.
    """
    _check_size("num_states", num_states, 1)
    _check_size("num_actions", num_actions, 1)
    K = num_states if branching is None else branching
    if not 1 <= K <= num_states:
        raise PgtsError(f"branching is {branching}; it must be between 1 and num_states = {num_states}")
    if not 0 <= reward_share <= 1:
        raise PgtsError(f"reward_share is {reward_share}; it must be in [0, 1]")
    check_gamma(gamma)
    random = numpy_stream(seed, "random_mdp")
    prob = random.exponential(size=(num_states, num_actions, K))
    prob /= prob.sum(-1, keepdims=True)
    child = _distinct(random, num_states * num_actions, num_states, K).reshape(prob.shape)
    reward = random.random((num_states, num_actions))
    # A stream of its own: MDPs of one seed have the same transitions, and where kept the same rewards, for every share.
    order = numpy_stream(seed, "sparse_random_mdp").permutation(reward.size).reshape(reward.shape)
    reward[order >= max(1, round(reward_share * reward.size))] = 0
    outcomes = Outcomes(
        torch.from_numpy(reward),
        torch.from_numpy(prob),
        torch.tensor(float(gamma), dtype=torch.float64).expand(prob.shape),
        torch.from_numpy(child),
        num_states,
    )
    return TabularMDP(outcomes, start_distribution(start, num_states))


def grid(
    size: int = 10,
    *,
    gamma: float = 0.9,
    start: Start = 0,
    slip: float = 0.01,
    goal: int | None = None,
    traps: tuple[int, ...] = (12, 32),
    goal_reward: float = 10.0,
    trap_reward: float = -10.0,
    absorbing: bool = False,
) -> TabularMDP:
    """A size x size grid; state `size * row + column`; actions left, right, up, down.        [PGTS Ex. 4]

    An action moves one step as intended with probability 1 - slip and in a uniformly random direction with probability
    slip; a move into the wall stays. Every action in the goal earns `goal_reward`, in a trap `trap_reward`.

    Args:
        goal: default the last state (99).
        traps: the text says states 12 and 32; the paper's drawing shows 11 and 32.
        absorbing: goal and traps end the episode when they are left, instead of being ordinary states.
    """
    _check_size("size", size, 1)
    goal = size * size - 1 if goal is None else goal
    for name, state in [("goal", goal), *(("trap", trap) for trap in traps)]:
        if not 0 <= state < size * size:
            raise PgtsError(f"{name} {state} is not on the grid; states are 0 to {size * size - 1}")
    if goal in traps:
        raise PgtsError(f"state {goal} is both goal and trap")
    if not 0 <= slip <= 1:
        raise PgtsError(f"slip is {slip}; it must be in [0, 1]")
    reward = {goal: goal_reward} | dict.fromkeys(traps, trap_reward)

    P = [
        [
            [
                (slip / 4 + (1 - slip) * (a == intended), next_state, reward.get(s, 0.0), absorbing and s in reward)
                for a, next_state in enumerate(_neighbours(s, size))
            ]
            for intended in range(4)
        ]
        for s in range(size * size)
    ]
    return TabularMDP.from_transitions(
        P, gamma, start=start, action_names=("left", "right", "up", "down"), shape=(size, size)
    )


def mirage(width: int = 10, *, delta: float = 0.05, gamma: float = 0.9, start: Start = 0) -> TabularMDP:
    """A choice that a deep lookahead belittles: in state 0, 'right' leads to state 1, where every step earns 1, and
    'left' to one of `width` states at random, where a step earns 1 - delta by 'right' and nothing by 'left'.

    J* = gamma / (1 - gamma) from state 0, by 'right' in every state. To the policy that always goes left the advantage
    of 'right' in state 0 is

        (T^m Q)(0, right) - (T^m Q)(0, left) = gamma / (1 - gamma) (1 - (1 - delta) (1 - gamma^m))

    which falls from gamma / (1 - gamma) to delta gamma / (1 - gamma): what 'left' could still be made of counts more
    and more with depth (docs/theory.md, Sec. 5). The wider, the slower it is made of it.
    """
    _check_size("width", width, 1)
    if not 0 < delta < 1:
        raise PgtsError(f"delta is {delta}; it must be above 0 and below 1")
    scattered = [(1 / width, 2 + i, 0.0, False) for i in range(width)]
    P: list[list[list[Transition]]] = [[scattered, [(1.0, 1, 0.0, False)]], [[(1.0, 1, 1.0, False)]] * 2]
    for s in range(2, width + 2):
        P.append([[(1.0, s, 0.0, False)], [(1.0, s, 1 - delta, False)]])
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=("left", "right"))


def deep_sea(
    n: int = 10,
    *,
    gamma: float = 0.99,
    start: Start = 0,
    move_cost: float = 0.01,
    mapping_seed: int | None = None,
    stochastic: bool = False,
) -> TabularMDP:
    """An n x n sea; each step sinks one row, left or right; the treasure (1) lies at the bottom right.
    [Osband et al., bsuite, 2020]

    Going right costs move_cost / n, so from state 0 only the one path that goes right n times pays. The episode ends
    after n steps. As in bsuite the treasure is paid for going right in the last column, of which a start in state 0
    reaches the lowest cell only.

    Args:
        mapping_seed: which of the two actions is 'right' is drawn for each cell; None: action 1 everywhere.
        stochastic: going right fails with probability 1/n.
    """
    _check_size("n", n, 1)
    right_action = np.ones((n, n), dtype=int)
    if mapping_seed is not None:
        right_action = numpy_stream(mapping_seed, "deep_sea").integers(0, 2, size=(n, n))

    fails = 1 / n if stochastic else 0.0
    P = [
        [_sink(n, row, column, a == right_action[row, column], move_cost / n, fails) for a in range(2)]
        for row in range(n)
        for column in range(n)
    ]
    names = ("left", "right") if mapping_seed is None else ("0", "1")
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=names, shape=(n, n))


def combination_lock(
    n: int = 12, num_actions: int = 4, *, seed: int = 0, gamma: float = 0.99, start: Start = 0
) -> TabularMDP:
    """A lock of n dials: in each state one action, drawn at random, goes on to the next and every other one back to
    the first. The right action in the last state earns 1 and ends the episode.
    [Koenig and Simmons 1993, "reset state space"]

    A uniform policy opens it once in num_actions^n attempts. J* = gamma^(n-1) from state 0.
    """
    _check_size("n", n, 1)
    _check_size("num_actions", num_actions, 2)
    right_S = numpy_stream(seed, "combination_lock").integers(0, num_actions, size=n)
    P = [
        [
            [(1.0, min(s + 1, n - 1), float(s == n - 1), s == n - 1) if a == right else (1.0, 0, 0.0, False)]
            for a in range(num_actions)
        ]
        for s, right in enumerate(right_S.tolist())
    ]
    return TabularMDP.from_transitions(P, gamma, start=start)


def river_swim(n: int = 12, *, gamma: float = 0.99, start: Start = 0) -> TabularMDP:
    """A chain against the current: 'left' goes one state left, 'right' goes right with 0.3, stays with 0.6 and drifts
    left with 0.1. 'Left' earns 0.005 in the first state, 'right' 1 in the last.
    [transitions: Strehl and Littman 2008; rewards: Osband, Russo and Van Roy 2013]

    In the first state 'right' stays with 0.7; in the last it stays with 0.3 and drifts left with 0.7. Both papers have
    6 states. Strehl and Littman start in the second or third and pay 5 and, where 'right' stays in the last state,
    10,000; the current of Osband et al. is weaker (0.35, 0.6 and 0.05).
    """
    _check_size("n", n, 2)
    P: list[list[list[Transition]]] = []
    for s in range(n):
        left, right = max(s - 1, 0), min(s + 1, n - 1)
        drift, stay, swim = (0.0, 0.7, 0.3) if s == 0 else (0.7, 0.3, 0.0) if s == n - 1 else (0.1, 0.6, 0.3)
        reward = float(s == n - 1)
        swims = [(drift, left, reward, False), (stay, s, reward, False), (swim, right, reward, False)]
        P.append([[(1.0, left, 0.005 * (s == 0), False)], swims])
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=("left", "right"))


def corridor(
    width: int = 3, length: int = 25, *, slip: float = 0.2, gamma: float = 0.99, start: Start | None = None
) -> TabularMDP:
    """A slippery corridor without walls: whoever steps off its long sides is back at the start. Reaching the last
    column earns 1 and ends the episode. State `length * row + column`; actions left, right, up, down.

    An action moves one cell as intended with probability 1 - slip, and to either side at right angles with slip / 2
    each, as on the ice of Gymnasium's FrozenLake; the long sides are the cliff of its CliffWalking, without the cost. A
    step against the end of the first column stays. The length is what a lookahead must see or what must be learned
    column by column.

    Args:
        start: default the middle of the first column.
    """
    _check_size("width", width, 1)
    _check_size("length", length, 2)
    if not 0 <= slip <= 1:
        raise PgtsError(f"slip is {slip}; it must be in [0, 1]")
    home = length * (width // 2)
    moves = ((0, -1), (0, 1), (-1, 0), (1, 0))

    def after(row: int, column: int, move: tuple[int, int]) -> tuple[int, float, bool]:
        row, column = row + move[0], max(column + move[1], 0)
        if not 0 <= row < width:
            return home, 0.0, False
        return length * row + min(column, length - 1), float(column >= length - 1), column >= length - 1

    P: list[list[list[Transition]]] = []
    for row in range(width):
        for column in range(length):
            P.append([])
            for intended, move in enumerate(moves):
                sideways = moves[2:] if intended < 2 else moves[:2]
                shares = [(1 - slip, move), *((slip / 2, side) for side in sideways)]
                P[-1].append([(share, *after(row, column, step)) for share, step in shares])
    names = ("left", "right", "up", "down")
    start = home if start is None else start
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=names, shape=(width, length))


def _sink(n: int, row: int, column: int, goes_right: bool, cost: float, fails: float) -> list[Transition]:
    """What may follow in one cell of the deep sea."""
    ends = row == n - 1
    first = n * (row if ends else row + 1)
    if not goes_right:
        return [(1.0, first + max(column - 1, 0), 0.0, ends)]
    reward = float(column == n - 1) - cost
    return [(1 - fails, first + min(column + 1, n - 1), reward, ends), (fails, first + column, reward, ends)]


def _neighbours(s: int, size: int) -> tuple[int, int, int, int]:
    """The states left, right, above and below; the state itself where there is a wall."""
    row, column = divmod(s, size)
    return (
        s - (column > 0),
        s + (column < size - 1),
        s - size * (row > 0),
        s + size * (row < size - 1),
    )


def _distinct(random: np.random.Generator, rows: int, high: int, count: int) -> Int[np.ndarray, "rows count"]:
    """`count` distinct integers below `high` in each row, every set equally likely (Floyd's algorithm by rows)."""
    chosen = np.empty((rows, count), dtype=np.int64)
    for k, top in enumerate(range(high - count, high)):
        drawn = random.integers(0, top + 1, size=rows)
        taken = (chosen[:, :k] == drawn[:, None]).any(-1)
        chosen[:, k] = np.where(taken, top, drawn)
    return chosen


def _check_size(name: str, value: int, least: int) -> None:
    if value < least:
        raise PgtsError(f"{name} is {value}; it must be at least {least}")
