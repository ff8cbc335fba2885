"""On which small deterministic MDPs does exact Algorithm 1 go round for ever? By step size, update, weight and depth.

    python benchmarks/rounds.py [--quick]

MDPs of 2 actions and rewards in {-1, 0, 1}; only visited states move; episodes start in state 0.

Infinite steps: each visited state takes the action that T^m Q^pi prefers, and keeps its own where both are equal. All
MDPs of 2 and 3 states, up to the names of actions, from all deterministic policies; samples of larger ones.

Finite steps, m = 1, gamma 0.9: from random policies, of which a third of the states have only one action left where the
update is projected. An MDP goes round if the return has risen and fallen by more than 0.01, at least twice each, in
the last half of 400 iterations.

The roundabout: the least constant step, of those tried, at which the return goes round (docs/theory.md, Prop. 16).
"""

import argparse
import itertools
import math
from collections.abc import Iterable, Iterator

import numba
import numpy as np

from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import roundabout

ITERATIONS, FLOOR, LEAST, VISITED = 400, 12.0, 0.01, 1e-10
UPDATES, WEIGHTS = ("projected", "mirror", "softmax"), ("d", "1")
ROUNDABOUTS = ((1, 0.9), (2, 0.9), (4, 0.97), (10, 0.98))
STEPS = (0.1, 0.3, 1.0, 2.0, 5.0, 10.0, 12.0, 20.0, 50.0, 100.0, 1000.0)
compiled = numba.njit(cache=True)


@compiled
def look_ahead(child_SA: np.ndarray, reward_SA: np.ndarray, v_S: np.ndarray, gamma: float, depth: int) -> np.ndarray:
    """(T^m Q)(s, .), of Q = r + gamma v."""
    q_SA = np.empty_like(reward_SA)
    for level in range(depth + 1):
        for s in range(len(v_S)):
            for a in range(2):
                q_SA[s, a] = reward_SA[s, a] + gamma * v_S[child_SA[s, a]]
        if level < depth:
            for s in range(len(v_S)):
                v_S[s] = max(q_SA[s, 0], q_SA[s, 1])
    return q_SA


@compiled
def evaluate(
    child_SA: np.ndarray, reward_SA: np.ndarray, right_S: np.ndarray, gamma: float
) -> tuple[np.ndarray, np.ndarray]:
    """v^pi, and d^pi from state 0."""
    S = len(right_S)
    within_SS, v_S, d_S = np.eye(S), np.empty(S), np.zeros(S)
    d_S[0] = 1.0
    for s in range(S):
        v_S[s] = (1 - right_S[s]) * reward_SA[s, 0] + right_S[s] * reward_SA[s, 1]
        within_SS[s, child_SA[s, 0]] -= gamma * (1 - right_S[s])
        within_SS[s, child_SA[s, 1]] -= gamma * right_S[s]
    return np.linalg.solve(within_SS, v_S), np.linalg.solve(within_SS.T, d_S)


@compiled
def rests(child_SA: np.ndarray, reward_SA: np.ndarray, right_S: np.ndarray, gamma: float, depth: int) -> bool:
    """Whether infinite steps from a deterministic policy end: after as many as there are policies nothing moves."""
    S = len(right_S)
    for _ in range(2**S + 1):
        v_S, d_S = evaluate(child_SA, reward_SA, right_S, gamma)
        q_SA = look_ahead(child_SA, reward_SA, v_S, gamma, depth)
        moved = False
        for s in range(S):
            better = q_SA[s, 1] - q_SA[s, 0]
            if d_S[s] > VISITED and abs(better) > 1e-9 and (better > 0) != (right_S[s] == 1):
                right_S[s], moved = 1 - right_S[s], True
        if not moved:
            return True
    return False


@compiled
def never_rest(child_NSA: np.ndarray, reward_NSA: np.ndarray, gamma: float, depth: int) -> int:
    """How many MDPs go round from some deterministic policy."""
    count, S = 0, child_NSA.shape[1]
    right_S = np.empty(S)
    for n in range(len(child_NSA)):
        for policy in range(2**S):
            for s in range(S):
                right_S[s] = (policy >> s) & 1
            if not rests(child_NSA[n], reward_NSA[n], right_S, gamma, depth):
                count += 1
                break
    return count


@compiled
def rounds(
    child_SA: np.ndarray,
    reward_SA: np.ndarray,
    right_S: np.ndarray,
    gamma: float,
    depth: int,
    step: float,
    update: int,
    is_weighted: bool,
) -> bool:
    """Whether the return still rises and falls in the second half; `right_S` is moved."""
    turns, edge, direction = 0, 0.0, 0
    for k in range(ITERATIONS):
        v_S, d_S = evaluate(child_SA, reward_SA, right_S, gamma)
        J = v_S[0]
        # `edge` is the best return of a rise so far, or the worst of a fall, from which a turn is measured.
        if k == ITERATIONS // 2:
            edge = J
        elif k > ITERATIONS // 2:
            if direction * (J - edge) > 0:
                edge = J
            elif abs(J - edge) > LEAST:
                turns, edge, direction = turns + 1, J, 1 if J > edge else -1
        q_SA = look_ahead(child_SA, reward_SA, v_S, gamma, depth)
        moved = 0.0
        for s in range(len(right_S)):
            if d_S[s] <= VISITED:
                continue
            before = right_S[s]
            by = step * (d_S[s] if is_weighted else 1.0) * (q_SA[s, 1] - q_SA[s, 0])
            if update == 0:
                right_S[s] = min(max(before + by / 2, 0.0), 1.0)
            else:
                if update == 2:
                    by *= 2 * before * (1 - before)
                logit = min(max(math.log(before / (1 - before)) + by, -FLOOR), FLOOR)
                right_S[s] = 1 / (1 + math.exp(-logit))
            moved = max(moved, abs(right_S[s] - before))
        if moved < 1e-9:
            return False
    return turns >= 4


Tables = Iterator[tuple[np.ndarray, np.ndarray]]


def all_tables(S: int) -> Tables:
    """Next states and rewards of all MDPs of S states."""
    states = list(itertools.combinations_with_replacement(itertools.product(range(S), (-1, 0, 1)), 2))
    table = np.array(list(itertools.product(states, repeat=S)))
    yield np.ascontiguousarray(table[..., 0]), np.ascontiguousarray(table[..., 1].astype(float))


def sampled_tables(S: int, count: int) -> Tables:
    random = numpy_stream(0, "rounds", S)
    yield random.integers(0, S, size=(count, S, 2)), random.integers(-1, 2, size=(count, S, 2)).astype(float)


def policies(S: int, update: int, count: int) -> Iterable[np.ndarray]:
    random = numpy_stream(1, "rounds", S, update)
    right_NS = random.random((count, S))
    return np.where(random.random((count, S)) < 1 / 3, right_NS.round(), right_NS) if update == 0 else right_NS


def least_step(depth: int, gamma: float, update: int, *, is_weighted: bool) -> float | None:
    """The least of `STEPS` at which the return goes round on the roundabout, from two policies."""
    outcomes = roundabout(depth, gamma=gamma).outcomes
    child_SA, reward_SA = outcomes.child_NAK[..., 0].numpy().copy(), outcomes.reward_NA.numpy()
    for step, right in itertools.product(STEPS, (0.0 if update == 0 else 0.001, 0.5)):
        if rounds(child_SA, reward_SA, np.full(depth + 2, right), gamma, depth, step, update, is_weighted):
            return step
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer MDPs")
    quick = parser.parse_args().quick
    print("infinite steps, from all deterministic policies\nstates  depth  gamma     MDPs  go round")
    for S, depth, gamma in itertools.product((2, 3, 4, 5), (0, 1, 2, 3), (0.9, 0.99)):
        if quick and S == 3:
            continue
        [(child, reward)] = all_tables(S) if S < 4 else sampled_tables(S, 200 if quick else 20_000)
        print(f"{S:6} {depth:6} {gamma:6} {len(child):8} {never_rest(child, reward, gamma, depth):9}", flush=True)
    print("\nfinite steps\nupdate     weight   step  states     MDPs  go round")
    for update, weight, step, S in itertools.product(range(3), WEIGHTS, (0.1, 1.0, 10.0, 100.0), (4, 5)):
        [(child, reward)] = sampled_tables(S, 20 if quick else 2_000)
        starts = policies(S, update, len(child))
        count = sum(
            rounds(*table, right_S, 0.9, 1, step, update, weight == "d")
            for *table, right_S in zip(child, reward, starts, strict=True)
        )
        print(f"{UPDATES[update]:10} {weight:6} {step:6g} {S:7} {len(child):8} {count:9}", flush=True)
    print("\nthe roundabout, least step\nupdate     weight   depth  gamma     step")
    for (depth, gamma), update, weight in itertools.product(ROUNDABOUTS, range(3), WEIGHTS):
        found = least_step(depth, gamma, update, is_weighted=weight == "d")
        least = "none" if found is None else f"{found:g}"
        print(f"{UPDATES[update]:10} {weight:6} {depth:7} {gamma:6} {least:>8}", flush=True)


if __name__ == "__main__":
    main()
