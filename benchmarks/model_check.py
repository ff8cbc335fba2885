"""What does it cost to hold an environment to its model, how often is it wrong, and how soon is it right?

    python benchmarks/model_check.py [--json FILE] [--quick]

Cost: the share of the CPU time of training that `ModelCheck` takes, and the calls that it makes beside the lookahead's.
False alarms: short runs in true tables, the most evidence that any of them ever had, and the mean of E at their end,
which cannot be above 1 but for chance. Power: steps until probabilities that are off stop a training, by how much they
are off and where: FrozenLake under the uniform policy, in iterations of 1,600 steps.
"""

import math
import statistics
import time
from typing import Any

import common
import gymnasium
import numpy as np
import torch
from throughput import SIMULATED

from pgts_torch import PGTS
from pgts_torch.agent.frequencies import Frequencies
from pgts_torch.agent.model_check import ENOUGH, ModelCheck
from pgts_torch.models import TabularModel
from pgts_torch.tabular import TabularMDP

PROBLEMS: dict[str, dict[str, Any]] = {
    "FrozenLake-v1": {},
    "Taxi-v4": {},
    "CartPole-v1": {"depth": 2},
    "SimulatedCartPole-v0": {"depth": 2},
    "SimulatedCartPole-v0, repeated": {"depth": 1, "action_repeat": 2},
}
ITERATIONS, RUNS, BATCH, MOST = 60, 2_000, 1_600, 3_000_000
EFFECTS = (0.03, 0.05, 0.1, 0.47)


def cost(name: str, options: dict[str, Any], iterations: int) -> dict[str, float]:
    """Share of the CPU time of iterations after the first ten, and model calls of the check and of the lookahead."""
    model, spent, whole = PGTS(name.partition(",")[0], seed=0, **options), 0.0, 0.0
    call = ModelCheck.__call__
    for k in range(10 + iterations):
        checked = 0.0

        def timed(self: ModelCheck, *args: Any) -> None:
            nonlocal checked
            begin = time.thread_time()
            call(self, *args)
            checked += time.thread_time() - begin

        ModelCheck.__call__ = timed  # type: ignore[method-assign, assignment]
        begin = time.thread_time()
        model.iterate()
        if k >= 10:
            whole, spent = whole + time.thread_time() - begin, spent + checked
        ModelCheck.__call__ = call  # type: ignore[method-assign]
    calls = float(model.model_check.model_calls)
    return {"share": spent / whole, "check_calls": calls, "lookahead_calls": float(model.num_model_calls)}


def lake() -> tuple[np.ndarray, np.ndarray]:
    """The probabilities in the table of FrozenLake, and how often each row is visited under the uniform policy."""
    mdp = TabularMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"), 0.99)
    prob_RK = TabularModel(mdp).frequencies().numpy()
    visits_S = np.array([40, 24, 17, 11, 22, 0, 10, 0, 13, 9, 7, 0, 0, 4, 3, 0], dtype=float)  # roughly its occupancy
    visits_R = np.repeat(visits_S, mdp.num_actions) * ((prob_RK > 0).sum(-1) > 1)
    return prob_RK, visits_R / visits_R.sum()


def run(claimed_RK: np.ndarray, true_RK: np.ndarray, visits_R: np.ndarray, seed: int, steps: int, batch: int) -> Any:
    """The steps until a contradiction, or None; the most log E that there was, and E at the end."""
    random, test = np.random.default_rng(seed), Frequencies(torch.from_numpy(claimed_RK))
    cumulative_RK, most = true_RK.cumsum(-1), 0.0
    for step in range(batch, steps + batch, batch):
        row_V = random.choice(len(visits_R), batch, p=visits_R)
        level_V1 = random.random((batch, 1)) * cumulative_RK[row_V, -1:]
        test.observe(row_V, (cumulative_RK[row_V] <= level_V1).sum(-1))
        most = max(most, *test.log_evidence)
        if test.log_evidence[0] >= ENOUGH:
            return step, most, [math.exp(min(700, x)) for x in test.log_evidence]
    return None, most, [math.exp(min(700, x)) for x in test.log_evidence]


def shifted(prob_RK: np.ndarray, by: float, rows: np.ndarray) -> np.ndarray:
    """The first outcome of these rows more probable by so much, the others alike less."""
    true_RK = prob_RK.copy()
    for row in rows:
        first, *others = np.flatnonzero(prob_RK[row])
        moved = min(by, 1 - prob_RK[row, first])
        true_RK[row, first] += moved
        true_RK[row, others] -= moved * prob_RK[row, others] / prob_RK[row, others].sum()
    return true_RK


def main(arguments: list[str] | None = None) -> None:
    args = common.parser(__doc__).parse_args(arguments)
    common.use_one_core()
    for name, env in SIMULATED.items():
        gymnasium.register(name, entry_point=env)
    report: dict[str, Any] = {"about": common.about(args), "cost": {}, "power": {}}
    print(f"{'share of training':34}{'share':>8}{'its calls':>11}{'lookahead':>11}")
    for name, options in PROBLEMS.items():
        table = name in ("FrozenLake-v1", "Taxi-v4")
        found = cost(name, options, (20 if args.quick else 300) if table else (2 if args.quick else 10))
        report["cost"][name] = found
        print(f"{name:34}{found['share']:8.2%}{found['check_calls']:11.0f}{found['lookahead_calls']:11.0f}", flush=True)
    prob_RK, visits_R = lake()
    runs = [run(prob_RK, prob_RK, visits_R, seed, 6_400, 320) for seed in range(100 if args.quick else RUNS)]
    ends = np.array([end for *_, end in runs])
    report["false alarms"] = {
        "runs": len(runs),
        "stops": sum(step is not None for step, *_ in runs),
        "most": max(most for _, most, _ in runs),
        "mean": ends.mean(0).tolist(),
        "standard error": (ends.std(0) / math.sqrt(len(ends))).tolist(),
    }
    print(
        "\nfalse alarms, {runs} runs of 6,400 steps: {stops} stops; the most log E {most:.1f}, of {enough:.1f} needed; "
        "mean E {mean} +- {standard error}".format(**report["false alarms"], enough=ENOUGH)
    )
    everywhere, busiest = np.flatnonzero(visits_R), np.array([visits_R.argmax()])
    print(f"\n{'steps until a stop, median of 5':34}{'all rows':>12}{'one row':>12}")
    for by in EFFECTS[1:] if args.quick else EFFECTS:
        report["power"][by] = {}
        for where, rows in (("all rows", everywhere), ("one row", busiest)):
            most = 300_000 if args.quick else MOST
            steps = [run(prob_RK, shifted(prob_RK, by, rows), visits_R, k, most, BATCH)[0] for k in range(5)]
            report["power"][by][where] = statistics.median(math.inf if n is None else n for n in steps)
        row = report["power"][by]
        print(f"{f'off by {by:.0%}':34}{row['all rows']:12,.0f}{row['one row']:12,.0f}", flush=True)
    common.write(report, args.json)


if __name__ == "__main__":
    main()
