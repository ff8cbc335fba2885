"""Does an adaptive depth find the depth that is needed, and what does it cost? What does a certificate cost?

    python benchmarks/adaptive.py [--seeds N] [--json FILE]

Ladder(9), Grid, DeepSea(20) and Taxi from rollouts: at a fixed depth that is too small, at one that is enough, and with
`search.depth: adaptive`, which is told neither. Every run stops once its certificate is below 2 % of J*. Medians over
seeds. certificate: its share of the CPU time of iterations.
"""

import argparse
import json
import statistics
import tempfile
from pathlib import Path
from typing import Any

import common

from pgts_torch import PGTS
from pgts_torch.agent.certificate import Certificates
from pgts_torch.config import load
from pgts_torch.experiment import run
from pgts_torch.experiment.summary import Summary

ROOT = Path(__file__).resolve().parent.parent
LADDER_9 = ["--env.kwargs.n", "9", "--update.step_size", "5", "--total_steps", "240000"]
TASKS: dict[str, tuple[str, list[str], float, tuple[int, int]]] = {
    "Ladder(9)": ("ladder", LADDER_9, 4.3047, (7, 8)),
    "Grid": ("grid", [], 14.715, (0, 18)),
    "DeepSea(20)": ("deep_sea", [], 0.81714, (10, 19)),
    "Taxi": ("taxi", [], 6.3289, (4, 16)),
}
"""Configuration, overrides, J*, and the two fixed depths."""


def trained(config: str, overrides: list[str], seed: int, depth: str, stop_at: float) -> tuple[Summary, float]:
    """One run to the end of its steps or to its certificate, and the certificate's share of the CPU time."""
    with tempfile.TemporaryDirectory() as folder:
        fixed = ["--seed", str(seed), "--run.dir", f"{folder}/run", "--run.tensorboard", "false"]
        search = ["--search.depth", depth, "--search.stop_at", str(stop_at)]
        given = load(str(ROOT / "configs" / f"{config}.yaml"), [*overrides, *fixed, *search])
        with (
            common.timed(PGTS, "iterate") as whole,
            common.timed(Certificates, "starts") as starts,
            common.timed(Certificates, "bound") as bounds,
        ):
            return run.train(given), (sum(starts) + sum(bounds)) / sum(whole)


def row(task: str, depth: str, seeds: int) -> dict[str, Any]:
    """Medians over seeds of one task at one depth."""
    config, overrides, optimum, _ = TASKS[task]
    runs, certificate = zip(*[trained(config, overrides, k, depth, 0.02 * optimum) for k in range(seeds)], strict=True)
    return {
        "task": task,
        "depth": depth,
        "deepest": max(summary.depth for summary in runs),
        "share": statistics.median(summary.J / summary.J_optimal for summary in runs),
        "env_steps": statistics.median(summary.env_steps for summary in runs),
        "model_calls": statistics.median(summary.model_calls for summary in runs),
        "seconds": statistics.median(summary.seconds for summary in runs),
        "certificate": statistics.median(certificate),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    print(
        f"{'task':<12}{'depth':>9}{'deepest':>9}{'J / J*':>9}{'env steps':>11}{'model calls':>13}{'seconds':>9}"
        f"{'certificate':>13}"
    )
    for task, (_, _, _, fixed) in TASKS.items():
        for depth in (*map(str, fixed), "adaptive"):
            r = row(task, depth, given.seeds)
            rows.append(r)
            print(
                f"{r['task']:<12}{r['depth']:>9}{r['deepest']:>9}{r['share']:>9.1%}{r['env_steps']:>11,.0f}"
                f"{r['model_calls']:>13,.0f}{r['seconds']:>9.1f}{r['certificate']:>13.1%}",
                flush=True,
            )
    if given.json:
        given.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
