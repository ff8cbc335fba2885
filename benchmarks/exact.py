"""How long does one Bellman sweep of a large MDP take, against QuantEcon's `DiscreteDP` on the same MDP?

    python benchmarks/exact.py [--json PATH]

A Garnet with 4 actions and 5 successors, one thread. The two sides take turns in each repeat; figures are medians, and
the ratio is the median of theirs, so that a busy machine slows both alike: below 1, ours is faster. Both sides are
given the same values, maximise over actions and go one step back; their results are compared. Peak memory is that of a
process of its own which makes the largest MDP and sweeps it once. Without QuantEcon (the extra "bench") its columns
stay empty.
"""

# ruff: noqa: E402  (threads are counted when numpy, torch and numba are loaded)

import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import importlib.metadata
import importlib.util
import json
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch

from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, random_mdp

SIZES = (10**4, 10**5, 10**6)
ACTIONS, SUCCESSORS, GAMMA = 4, 5, 0.9
REPEATS = {10**4: 101, 10**5: 41, 10**6: 15}
SOLVE_SIZES = (10**4, 10**5)
"""Sizes at which the optimum is computed too."""
TOLERANCE, SOLVE_REPEATS = 5e-10, 9


def garnet(num_states: int) -> TabularMDP:
    return random_mdp(num_states, ACTIONS, branching=SUCCESSORS, gamma=GAMMA, start=None)


def quantecon_mdp(mdp: TabularMDP) -> Any:
    """The same MDP as QuantEcon's sparse list of state-action pairs."""
    from quantecon.markov import DiscreteDP

    S, A, K = mdp.outcomes.child_NAK.shape
    P = scipy.sparse.csr_matrix(
        (
            mdp.outcomes.prob_NAK.reshape(-1).numpy(),
            mdp.outcomes.child_NAK.reshape(-1).numpy().astype(np.int32),
            np.arange(S * A + 1, dtype=np.int32) * K,
        ),
        shape=(S * A, S),
    )
    rewards = mdp.outcomes.reward_NA.reshape(-1).numpy()
    return DiscreteDP(rewards, P, GAMMA, np.repeat(np.arange(S), A), np.tile(np.arange(A), S))


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def sweep(num_states: int, with_peer: bool) -> dict[str, Any]:
    """One application of T: ours from q to T q, QuantEcon's from v to max_a (r + gamma P v), with max_a q = v."""
    mdp = garnet(num_states)
    q_SA = torch.rand(num_states, ACTIONS, dtype=torch.float64, generator=stream(0, "benchmark"))
    v = q_SA.amax(-1).numpy()
    sides: list[Callable[[], Any]] = [lambda: exact.bellman(mdp, q_SA)]
    if with_peer:
        model = quantecon_mdp(mdp)
        sides.append(lambda: model.bellman_operator(v))
    results = [work() for work in sides]  # also compiles, and makes the sparse matrix
    for values in results[1:]:
        np.testing.assert_allclose(values, results[0].amax(-1).numpy(), rtol=1e-12)
    rounds = [[seconds(work) for work in sides] for _ in range(REPEATS[num_states])]
    answer = {"states": num_states, "sweep_s": statistics.median(times[0] for times in rounds)}
    if with_peer:
        answer["quantecon_sweep_s"] = statistics.median(times[1] for times in rounds)
        answer["ratio"] = statistics.median(times[0] / times[1] for times in rounds)
    return answer


def solve(num_states: int, with_peer: bool) -> dict[str, Any]:
    """Evaluation of the uniform policy, the optimum to rounding (`optimal_s`), and the optimum with the values within
    5e-10, which is what QuantEcon's modified policy iteration promises for epsilon 1e-9 (`within_s`)."""
    mdp = garnet(num_states)
    uniform_SA = torch.full((num_states, ACTIONS), 1 / ACTIONS, dtype=torch.float64)
    sides: dict[str, Callable[[], Any]] = {
        "evaluate_s": lambda: exact.evaluate(mdp, uniform_SA),
        "optimal_s": lambda: exact.optimal(mdp),
        "within_s": lambda: exact.optimal(mdp, TOLERANCE),
    }
    if with_peer:
        model = quantecon_mdp(mdp)
        sides["quantecon_optimal_s"] = lambda: model.solve(method="modified_policy_iteration", epsilon=2 * TOLERANCE)
    results = {name: work() for name, work in sides.items()}  # also compiles
    error = float((results["within_s"].v_S - results["optimal_s"].v_S).abs().max())
    assert error <= TOLERANCE, f"the error is {error}"
    rounds = [{name: seconds(work) for name, work in sides.items()} for _ in range(SOLVE_REPEATS)]
    answer = {name: statistics.median(times[name] for times in rounds) for name in sides}
    if with_peer:
        ratios = [times["within_s"] / times["quantecon_optimal_s"] for times in rounds]
        answer["within_ratio"] = statistics.median(ratios)
    return answer


def peak_memory_bytes() -> int:
    """Peak resident memory of a fresh process that makes the largest MDP and sweeps it once."""
    command = [sys.executable, __file__, "--measure-memory"]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure_memory() -> None:
    mdp = garnet(SIZES[-1])
    exact.bellman(mdp, torch.zeros(SIZES[-1], ACTIONS, dtype=torch.float64))
    unit = 1 if sys.platform == "darwin" else 1024
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit)


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("pgts_torch", "torch", "numpy", "scipy", "quantecon", "numba"):
        if importlib.util.find_spec(package):
            try:
                found[package] = importlib.metadata.version(package)
            except importlib.metadata.PackageNotFoundError:
                found[package] = "from source"
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--measure-memory", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.measure_memory:
        measure_memory()
        return
    with_peer = importlib.util.find_spec("quantecon") is not None
    if not with_peer:
        print('QuantEcon is not installed (pip install "pgts_torch[bench]"): only our own figures')
    memory = peak_memory_bytes()
    peers = {"quantecon_sweep_s": "peer_s", "quantecon_optimal_s": "peer_s", "within_ratio": "ratio"}
    columns = ["sweep_s", "quantecon_sweep_s", "ratio", "evaluate_s", "optimal_s"]
    columns += ["within_s", "quantecon_optimal_s", "within_ratio"]
    print(f"{'states':>9}" + "".join(f"{peers.get(column, column):>11}" for column in columns))
    results = []
    for num_states in SIZES:
        result = sweep(num_states, with_peer) | (solve(num_states, with_peer) if num_states in SOLVE_SIZES else {})
        results.append(result)
        cells = (f"{result[column]:>11.5f}" if column in result else f"{'-':>11}" for column in columns)
        print(f"{num_states:>9}" + "".join(cells), flush=True)
    print(f"peak resident memory with {SIZES[-1]} states: {memory / 1e9:.2f} GB")
    if args.json:
        report = {
            "threads": 1,
            "actions": ACTIONS,
            "successors": SUCCESSORS,
            "gamma": GAMMA,
            "versions": versions(),
            "peak_memory_bytes": memory,
            "results": results,
        }
        args.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
