"""The MDPs of the paper and of its neighbours, each with its source.

`start` is a state, a distribution over states, or None for the uniform start distribution.
"""

import math

import numpy as np
import torch
from jaxtyping import Int

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular.forms import Start, start_distribution
from pgts_torch.tabular.mdp import TabularMDP, check_gamma
from pgts_torch.tabular.transitions import Transition

LEFT_RIGHT = ("left", "right")
FOUR_WAYS = ("left", "right", "up", "down")


def ladder(n: int = 5, *, gamma: float = 0.9, start: Start = 0) -> TabularMDP:
    """A chain of n states; only 'right' in the last one is rewarded, with 1.        [PGTS Ex. 1]

    Always 'left' is stationary for every depth below n - 1. J* = gamma^(n-1) / (1 - gamma) from state 0.
    """
    check_count("n", n)
    P = [
        [[(1.0, max(s - 1, 0), 0.0, False)], [(1.0, min(s + 1, n - 1), float(s == n - 1), False)]]  # left, right
        for s in range(n)
    ]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=LEFT_RIGHT)


def tightrope(*, gamma: float = 0.9, start: Start = 0) -> TabularMDP:
    """Four states: s0 -> s1 -> s2 by 'right', where every step earns 1; 'left' in s1 falls to s3, where every step
    costs 10.        [PGTS Ex. 3; Efroni et al. 2018]

    J* = gamma^2 / (1 - gamma) from state 0.
    """
    loop_2, loop_3 = [(1.0, 2, 1.0, False)], [(1.0, 3, -10.0, False)]
    P = [
        [[(1.0, 0, 0.0, False)], [(1.0, 1, 0.0, False)]],
        [[(1.0, 3, 0.0, False)], [(1.0, 2, 0.0, False)]],
        [loop_2] * 2,
        [loop_3] * 2,
    ]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=LEFT_RIGHT)


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

    Each (s, a) leads to `branching` distinct states, sampled uniformly, with probabilities uniform on the simplex
    and a reward uniform in [0, 1].

    Args:
        branching: successors of each (s, a); None: every state.
        reward_share: the share of (s, a) that keep their reward, sampled uniformly, at least one; the others earn 0.
    """
    check_count("num_states", num_states)
    check_count("num_actions", num_actions)
    K = num_states if branching is None else branching
    if not 1 <= K <= num_states:
        raise PgtsError(f"branching is {branching}; it must be between 1 and num_states = {num_states}")
    _check_share("reward_share", reward_share)
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
    check_count("size", size)
    goal = size * size - 1 if goal is None else goal
    for name, state in [("goal", goal), *(("trap", trap) for trap in traps)]:
        if not 0 <= state < size * size:
            raise PgtsError(f"{name} {state} is not on the grid; states are 0 to {size * size - 1}")
    if goal in traps:
        raise PgtsError(f"state {goal} is both goal and trap")
    _check_share("slip", slip)
    reward = {goal: goal_reward} | dict.fromkeys(traps, trap_reward)

    def moves(s: int, intended: int) -> list[Transition]:
        row, column = divmod(s, size)
        beside = s - (column > 0), s + (column < size - 1), s - size * (row > 0), s + size * (row < size - 1)
        return [
            (slip / 4 + (1 - slip) * (a == intended), next_state, reward.get(s, 0.0), absorbing and s in reward)
            for a, next_state in enumerate(beside)
        ]

    P = [[moves(s, intended) for intended in range(4)] for s in range(size * size)]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=FOUR_WAYS, shape=(size, size))


def mirage(width: int = 10, *, delta: float = 0.05, gamma: float = 0.9, start: Start = 0) -> TabularMDP:
    """A choice that a deep lookahead hides: in state 0, 'right' leads to state 1, where every step earns 1, and 'left'
    to one of `width` states at random, where a step earns 1 - delta by 'right' and nothing by 'left'.

    J* = gamma / (1 - gamma) from state 0, by 'right' in every state. To the policy that always goes left the advantage
    of 'right' in state 0 is

        (T^m Q)(0, right) - (T^m Q)(0, left) = gamma / (1 - gamma) (1 - (1 - delta) (1 - gamma^m))

    which falls from gamma / (1 - gamma) to delta gamma / (1 - gamma), because a deeper lookahead sees how good the
    states behind 'left' could be made (docs/theory.md, Sec. 5). The more of them there are, the longer that takes.
    """
    check_count("width", width)
    if not 0 < delta < 1:
        raise PgtsError(f"delta is {delta}; it must be above 0 and below 1")
    scattered = [(1 / width, 2 + i, 0.0, False) for i in range(width)]
    P: list[list[list[Transition]]] = [[scattered, [(1.0, 1, 0.0, False)]], [[(1.0, 1, 1.0, False)]] * 2]
    P += [[[(1.0, s, 0.0, False)], [(1.0, s, 1 - delta, False)]] for s in range(2, width + 2)]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=LEFT_RIGHT)


def roundabout(depth: int = 1, *, cost: float | None = None, gamma: float = 0.9, start: Start = 0) -> TabularMDP:
    """m + 2 states on which a lookahead of m = depth goes round for ever, though a policy in sight earns 1 a step.

    In state 0 both actions cost `cost`: 'left' leads to state 1, where nothing is earned any more, 'right' to state 2.
    There 'right' stays and earns 1, and 'left' leads back to state 0 in m steps. J* = gamma / (1 - gamma) - cost from
    state 0.

    To the policy that always goes left state 2 looks good; to the one that goes right in state 0 only it looks best
    there to go back and then left. Each prefers the other in state 0, and neither changes state 2 (docs/theory.md,
    Prop. 16).

    Args:
        cost: between (1 - gamma^{m+1})^2 / ((1 - gamma) gamma^m (2 gamma^{m+1} - 1)) and (1 - gamma^m) / ((1 - gamma)
            gamma^{2m}). Default: the middle.

    Raises:
        PgtsError: there is no such cost, because gamma is too small for the depth, or it is not between the two.
    """
    m = check_count("depth", depth)
    check_gamma(gamma)
    spare = 2 * gamma ** (m + 1) - 1
    low = (1 - gamma ** (m + 1)) ** 2 / ((1 - gamma) * gamma**m * spare) if spare > 0 and gamma < 1 else math.inf
    high = (1 - gamma**m) / ((1 - gamma) * gamma ** (2 * m)) if 0 < gamma < 1 else 0.0
    if not low < high:
        raise PgtsError(f"gamma is {gamma}; with depth {m} nothing goes round there: take one nearer to 1")
    cost = (low + high) / 2 if cost is None else cost
    if not low < cost < high:
        raise PgtsError(
            f"cost is {cost}; with depth {m} and gamma {gamma} it must be above {low:.6g} and below {high:.6g}"
        )
    chain = [*range(3, m + 2), 0]
    P: list[list[list[Transition]]] = [
        [[(1.0, 1, -cost, False)], [(1.0, 2, -cost, False)]],
        [[(1.0, 1, 0.0, False)]] * 2,
        [[(1.0, chain[0], 0.0, False)], [(1.0, 2, 1.0, False)]],
        *([[(1.0, s, 0.0, False)]] * 2 for s in chain[1:]),
    ]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=LEFT_RIGHT)


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
        mapping_seed: which of the two actions is 'right' is sampled for each cell; None: action 1 everywhere.
        stochastic: going right fails with probability 1/n.
    """
    check_count("n", n)
    right_action, fails = np.ones((n, n), dtype=int), 1 / n if stochastic else 0.0
    if mapping_seed is not None:
        right_action = numpy_stream(mapping_seed, "deep_sea").integers(0, 2, size=(n, n))

    def sinks(row: int, column: int, action: int) -> list[Transition]:
        ends = row == n - 1
        below = n * (row if ends else row + 1)  # the first state of the next row; after the last one none counts
        if action != right_action[row, column]:
            return [(1.0, below + max(column - 1, 0), 0.0, ends)]
        reward = float(column == n - 1) - move_cost / n
        return [(1 - fails, below + min(column + 1, n - 1), reward, ends), (fails, below + column, reward, ends)]

    P = [[sinks(row, column, action) for action in range(2)] for row, column in np.ndindex(n, n)]
    names = LEFT_RIGHT if mapping_seed is None else ()
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=names, shape=(n, n))


def combination_lock(
    n: int = 12, num_actions: int = 4, *, seed: int = 0, gamma: float = 0.99, start: Start = 0
) -> TabularMDP:
    """A lock of n dials: in each state one action, sampled uniformly, goes on to the next and every other one back to
    the first. The right action in the last state earns 1 and ends the episode.
    [Koenig and Simmons 1993, "reset state space"]

    A uniform policy opens it once in num_actions^n attempts. J* = gamma^(n-1) from state 0.
    """
    check_count("n", n)
    check_count("num_actions", num_actions, least=2)
    right_S = numpy_stream(seed, "combination_lock").integers(0, num_actions, size=n)
    back = (1.0, 0, 0.0, False)
    onward = [(1.0, min(s + 1, n - 1), float(s == n - 1), s == n - 1) for s in range(n)]
    P = [[[onward[s] if a == right_S[s] else back] for a in range(num_actions)] for s in range(n)]
    return TabularMDP.from_transitions(P, gamma, start=start)


def river_swim(n: int = 12, *, gamma: float = 0.99, start: Start = 0) -> TabularMDP:
    """A chain against the current: 'left' goes one state left, 'right' goes right with 0.3, stays with 0.6 and drifts
    left with 0.1. 'Left' earns 0.005 in the first state, 'right' 1 in the last.
    [transitions: Strehl and Littman 2008; rewards: Osband, Russo and Van Roy 2013]

    In the first state 'right' stays with 0.7; in the last it stays with 0.3 and drifts left with 0.7. Both papers have
    6 states; starts and rewards of the first, and the current of the second, are others.
    """
    check_count("n", n, least=2)
    P: list[list[list[Transition]]] = []
    for s in range(n):
        left, right = max(s - 1, 0), min(s + 1, n - 1)
        drift, stay, swim = (0.0, 0.7, 0.3) if s == 0 else (0.7, 0.3, 0.0) if s == n - 1 else (0.1, 0.6, 0.3)
        reward = float(s == n - 1)
        swims = [(drift, left, reward, False), (stay, s, reward, False), (swim, right, reward, False)]
        P.append([[(1.0, left, 0.005 * (s == 0), False)], swims])
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=LEFT_RIGHT)


def corridor(
    width: int = 3, length: int = 25, *, slip: float = 0.2, gamma: float = 0.99, start: Start = None
) -> TabularMDP:
    """A slippery corridor without walls: a step off its long sides leads back to the start. Reaching the last column
    earns 1 and ends the episode. State `length * row + column`; actions left, right, up, down.

    An action moves one cell as intended with probability 1 - slip, and to either side at right angles with slip / 2
    each, as on the ice of Gymnasium's FrozenLake; the long sides are the cliff of its CliffWalking, without the cost. A
    step against the end of the first column stays.

    Args:
        start: default the middle of the first column.
    """
    check_count("width", width)
    check_count("length", length, least=2)
    _check_share("slip", slip)
    home = length * (width // 2)
    moves = ((0, -1), (0, 1), (-1, 0), (1, 0))

    def after(row: int, column: int, move: tuple[int, int]) -> tuple[int, float, bool]:
        row, column = row + move[0], max(column + move[1], 0)
        if not 0 <= row < width:
            return home, 0.0, False
        return length * row + min(column, length - 1), float(column >= length - 1), column >= length - 1

    def slides(row: int, column: int, action: int) -> list[Transition]:
        sideways = moves[2:] if action < 2 else moves[:2]
        shares = [(1 - slip, moves[action]), *((slip / 2, side) for side in sideways)]
        return [(share, *after(row, column, move)) for share, move in shares]

    P = [[slides(row, column, action) for action in range(4)] for row, column in np.ndindex(width, length)]
    start = home if start is None else start
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=FOUR_WAYS, shape=(width, length))


def _distinct(random: np.random.Generator, rows: int, high: int, count: int) -> Int[np.ndarray, "rows count"]:
    """`count` distinct integers below `high` in each row, every set equally likely (Floyd's algorithm by rows)."""
    chosen = np.empty((rows, count), dtype=np.int64)
    for k, top in enumerate(range(high - count, high)):
        sampled = random.integers(0, top + 1, size=rows)
        taken = (chosen[:, :k] == sampled[:, None]).any(-1)
        chosen[:, k] = np.where(taken, top, sampled)
    return chosen


def _check_share(name: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise PgtsError(f"{name} is {value}; it must be in [0, 1]")
