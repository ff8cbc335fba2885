"""What does the lookahead change? Each shipped configuration, trained from rollouts as shipped and at depth 0.

    python benchmarks/results.py [--seeds N] [--json FILE]
    python benchmarks/results.py [--seeds N] --picture FILE

Prints the README's table: the exact return of the trained policy as a share of the optimum, median and range over
seeds. With --picture it draws the README's picture instead, Ladder(5) for depths 0 to 5.
"""

import argparse
import json
import statistics
import tempfile
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.figure import Figure

from pgts_torch.config import load
from pgts_torch.experiment import run
from pgts_torch.experiment.summary import Summary
from pgts_torch.experiment.tracking import read_metrics

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ("ladder", "tightrope", "random", "grid", "deep_sea")
LADDER_DEPTHS = range(6)


def trained(name: str, seed: int, depth: int | None = None) -> tuple[Summary, list[dict[str, Any]]]:
    """One run of a shipped configuration, and its metrics."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = ["--seed", str(seed), "--run.dir", f"{folder}/run", "--run.tensorboard", "false"]
        overrides += ["--log.exact_points", "1000"]
        overrides += [] if depth is None else ["--search.depth", str(depth)]
        summary = run.train(load(str(ROOT / "configs" / f"{name}.yaml"), overrides))
        return summary, read_metrics(Path(summary.run))


def row(name: str, seeds: int) -> dict[str, Any]:
    """Shares of J* at depth 0 and at the configured depth."""
    answer: dict[str, Any] = {"config": name}
    for label, depth in (("plain", 0), ("lookahead", None)):
        summaries = [trained(name, seed, depth)[0] for seed in range(seeds)]
        answer[label] = [share_of_optimum(summary) for summary in summaries]
        answer[f"{label}_seconds"] = statistics.median(summary.seconds for summary in summaries)
        answer["depth"], answer["env_steps"] = summaries[0].depth, summaries[0].env_steps
        answer["model_calls"] = max(summary.model_calls for summary in summaries)
    return answer


def share_of_optimum(summary: Summary) -> float:
    """J / J*, which a tabular environment has."""
    assert summary.J is not None
    assert summary.J_optimal is not None
    return summary.J / summary.J_optimal


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""

    def shares(values: list[float]) -> str:
        return f"{statistics.median(values):.1%} ({min(values):.1%} to {max(values):.1%})"

    lines = [
        "| configuration | environment steps | J / J*, depth 0 | depth | J / J*, this depth | model calls | seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| `configs/{r['config']}.yaml` | {r['env_steps']:,} | {shares(r['plain'])} | {r['depth']} "
        f"| {shares(r['lookahead'])} | {r['model_calls']} | {r['lookahead_seconds']:.1f} |"
        for r in rows
    ]
    return "\n".join(lines)


def ladder_picture(seeds: int) -> Figure:
    """Exact return against environment steps on Ladder(5), one colour a depth, one line a seed."""
    figure, viridis = Figure(figsize=(7, 3.6), layout="constrained"), colormaps["viridis"]
    axes = figure.subplots()
    optimum = 0.0
    for depth in LADDER_DEPTHS:
        for seed in range(seeds):
            summary, metrics = trained("ladder", seed, depth)
            metrics = [line for line in metrics if "exact/J" in line]
            optimum = summary.J_optimal or optimum
            axes.plot(
                [line["step"] for line in metrics],
                [line["exact/J"] for line in metrics],
                color=viridis(depth / max(LADDER_DEPTHS)),
                # Curves lie upon each other: the deeper ones are drawn later and thinner.
                linewidth=8 - 1.4 * depth,
                solid_capstyle="butt",
                label=f"m = {depth}" if seed == 0 else None,
            )
    axes.axhline(optimum, color="k", linestyle=":", linewidth=1, label="J*")
    axes.set(
        xlabel="environment steps", ylabel="return J of the policy", title="Ladder(5) from its lowest step, 99 % left"
    )
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    if given.picture:
        ladder_picture(given.seeds).savefig(given.picture, dpi=120)
        return
    rows = [row(name, given.seeds) for name in CONFIGS]
    if given.json:
        given.json.write_text(json.dumps(rows, indent=2) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
