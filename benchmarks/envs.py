"""How many transitions a second do vectorised environments make, against Gymnasium's loop over single ones?

    python benchmarks/envs.py [--json PATH] [--quick]

One thread. Every figure is the median of several repeats; all forms take turns within each repeat, and the ratio is the
median of theirs, so that a busy machine slows both sides alike. Uniformly random actions are sampled beforehand;
environments are reset by `AutoresetMode.SAME_STEP` at the registered time limits.
"""

import argparse
import json
import platform
import statistics
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv

import pgts_torch

NAMES = ("Ladder", "Tightrope", "Random", "Grid", "DeepSea")
NUM_ENVS = (1, 64, 1024, 4096)
SYNC_ENVS = 64
REPEATS, QUICK_REPEATS = 9, 3
SECONDS = 0.1
"""How long one repeat lasts, about."""


class Runner:
    """One vector environment under random actions, with a number of steps that takes about SECONDS."""

    def __init__(self, envs: VectorEnv) -> None:
        action_space = envs.single_action_space
        assert isinstance(action_space, gymnasium.spaces.Discrete)
        self.envs = envs
        self.actions = np.random.default_rng(0).integers(action_space.n, size=(64, envs.num_envs))
        envs.reset(seed=0)
        self.steps = 50
        self.transitions_per_second()
        self.steps = max(50, int(SECONDS * self.transitions_per_second() / envs.num_envs))

    def transitions_per_second(self) -> float:
        begin = time.perf_counter()
        for step in range(self.steps):
            self.envs.step(self.actions[step % 64])
        return self.envs.num_envs * self.steps / (time.perf_counter() - begin)


def measure(name: str, repeats: int) -> dict[str, Any]:
    """Transitions a second of one environment: the fast form by number of environments, Gymnasium's loop at one."""
    id, mode = f"pgts/{name}-v0", AutoresetMode.SAME_STEP
    fast = {num_envs: Runner(gymnasium.make_vec(id, num_envs=num_envs, autoreset_mode=mode)) for num_envs in NUM_ENVS}
    sync = Runner(
        gymnasium.make_vec(id, num_envs=SYNC_ENVS, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode})
    )
    rounds = [
        (
            {num_envs: runner.transitions_per_second() for num_envs, runner in fast.items()},
            sync.transitions_per_second(),
        )
        for _ in range(repeats)
    ]
    return {
        "environment": id,
        "transitions_per_second": {
            num_envs: statistics.median(rates[num_envs] for rates, _ in rounds) for num_envs in NUM_ENVS
        },
        "sync_transitions_per_second": statistics.median(loop for _, loop in rounds),
        "ratio_to_sync": statistics.median(rates[SYNC_ENVS] / loop for rates, loop in rounds),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--quick", action="store_true", help="two environments, fewer repeats")
    args = parser.parse_args()
    names, repeats = (NAMES[:2], QUICK_REPEATS) if args.quick else (NAMES, REPEATS)
    torch.set_num_threads(1)
    columns = [f"{num_envs} envs" for num_envs in NUM_ENVS]
    print(f"{'transitions / s':<18}" + "".join(f"{column:>14}" for column in columns), end="")
    print(f"{f'sync, {SYNC_ENVS}':>14}{f'ratio at {SYNC_ENVS}':>14}")
    results = []
    for name in names:
        result = measure(name, repeats)
        results.append(result)
        rates = [*result["transitions_per_second"].values(), result["sync_transitions_per_second"]]
        print(f"{result['environment']:<18}" + "".join(f"{rate:>14,.0f}" for rate in rates), end="")
        print(f"{result['ratio_to_sync']:>14.1f}")
    if args.json:
        versions = {"python": platform.python_version(), "numpy": np.__version__, "gymnasium": gymnasium.__version__}
        versions["pgts_torch"] = pgts_torch.__version__
        report = {"threads": 1, "repeats": repeats, "versions": versions, "results": results}
        args.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
