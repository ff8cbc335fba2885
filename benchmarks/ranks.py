"""What does a second process bring, and what does it cost?

    python benchmarks/ranks.py [--json FILE] [--quick]

The first iterations of shipped configurations, with episodes of at most 50 steps, by one process and by two under
torchrun, in turns, with one thread each: milliseconds of an iteration (the median over iterations, then over repeats),
the share of it that is the critic's fit and the update, which all processes make, and model calls, of which two
processes need more where their searches meet.

It needs two cores.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import common
import torch

from pgts_torch import PGTS
from pgts_torch.agent.ranks import joined_ranks
from pgts_torch.config import load
from pgts_torch.experiment.run import build

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
NAMES = ("taxi", "cartpole", "acrobot", "mountain_car", "door_key")
WORLD_SIZES = (1, 2)
ITERATIONS, REPEATS = 5, 3
SHORT = ["--rollout.horizon.length", "50"]


def iterations(name: str, count: int) -> dict[str, float]:
    """A training of some iterations, seen by the first process."""
    torch.set_num_threads(1)
    clock = time.perf_counter
    with joined_ranks("cpu"):
        model = build(load(str(CONFIGS / f"{name}.yaml"), SHORT))
        critic, update = type(model.critic), type(model.update)
        with (
            common.timed(PGTS, "iterate", clock) as whole,
            common.timed(critic, "fit", clock) as fits,
            common.timed(update, "__call__", clock) as updates,
        ):
            for _ in range(count):
                model.iterate()
        shares = [(fit + move) / all_of_it for fit, move, all_of_it in zip(fits, updates, whole, strict=True)]
        return {
            "milliseconds": 1e3 * statistics.median(whole),
            "learning": statistics.median(shares),
            "model_calls": model.num_model_calls / model.num_env_steps,
        }


def launched(name: str, world_size: int, count: int) -> dict[str, float]:
    """What `iterations` gives in as many processes, started by torchrun."""
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        f"--nproc-per-node={world_size}",
        __file__,
        name,
        str(count),
    ]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    made = subprocess.run(command, capture_output=True, text=True, env=environment)
    if made.returncode:
        raise SystemExit(made.stderr)
    return json.loads(made.stdout)


def main() -> None:
    if "TORCHELASTIC_RUN_ID" in os.environ:
        answer = iterations(sys.argv[1], int(sys.argv[2]))
        if os.environ["RANK"] == "0":
            print(json.dumps(answer))
        return
    args = common.parser(__doc__).parse_args()
    count, repeats = (1, 1) if args.quick else (ITERATIONS, REPEATS)
    rows: dict[str, Any] = {}
    print("| configuration | 1 process, ms | 2 processes, ms | ratio | learning, of 1 | model calls a step, 1 | 2 |")
    print("|---|---|---|---|---|---|---|")
    for name in NAMES:
        turns = [[launched(name, size, count) for size in WORLD_SIZES] for _ in range(repeats)]
        one, two = ({key: statistics.median(turn[i][key] for turn in turns) for key in turns[0][0]} for i in (0, 1))
        ratio = statistics.median(turn[0]["milliseconds"] / turn[1]["milliseconds"] for turn in turns)
        rows[name] = {"one": one, "two": two, "ratio": ratio}
        print(
            f"| {name} | {one['milliseconds']:.1f} | {two['milliseconds']:.1f} | {ratio:.2f} | {one['learning']:.0%} "
            f"| {one['model_calls']:.1f} | {two['model_calls']:.1f} |",
            flush=True,
        )
    common.write(common.about(args) | {"rows": rows}, args.json)


if __name__ == "__main__":
    main()
