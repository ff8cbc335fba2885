"""What does a second process bring, and what does it cost?

    python benchmarks/ranks.py [--json FILE] [--quick]

Iterations of shipped configurations, with episodes of at most 50 steps, by one process and by two, in turns, with one
thread each, but for the first ones, in which code is compiled, until gradient steps are. Speed is the time of one
process divided by that of two, by the clock on the wall and in CPU time of the slower one: the latter is what a machine
would show on which nothing else runs and no process waits for another. Beside it stand the exchanges of an iteration
and the kilobytes that a process puts into them.

It needs two cores.
"""

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
import torch

from pgts_torch.config import load
from pgts_torch.experiment.run import build
from pgts_torch.ranks import present_ranks

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
SHORT = ["--rollout.horizon.length", "50"]
NAMES = {
    "taxi": SHORT,
    "cartpole": SHORT,
    "acrobot": SHORT,
    "mountain_car": SHORT,
    "door_key": SHORT,
    "learned/cartpole": ["--rollout.num_envs", "2", "--rollout.horizon", "{type: steps, length: 50, first: 250}"],
}
WORLD_SIZES = (1, 2)
ITERATIONS, REPEATS, WARM = 5, 3, 5


def iterations(name: str, count: int, changes: list[str]) -> dict[str, float]:
    """A training of some iterations: medians over them, of all processes together.

    learning_ms: the part of critic and update in the CPU time of the slower process.
    """
    torch.set_num_threads(1)
    ranks = present_ranks()
    model = build(load(str(CONFIGS / f"{name}.yaml"), [*NAMES[name], *changes]))
    rows, exchange = [], ranks.exchange
    with common.timed(type(model.critic), "fit") as fits, common.timed(type(model.update), "__call__") as updates:
        for number in range(WARM + count):
            before = (0, 0) if exchange is None else (exchange.num_calls, exchange.num_bytes)
            learned, wall, cpu = len(fits), time.perf_counter(), time.process_time()
            model.iterate()
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            after = (0, 0) if exchange is None else (exchange.num_calls, exchange.num_bytes)
            slower, learning = ranks.each("CPU time", cpu, sum(fits[learned:]) + sum(updates[learned:])).max(0)
            if number >= WARM:
                figures = wall, float(slower), float(learning)
                rows.append((*(1e3 * x for x in figures), after[0] - before[0], (after[1] - before[1]) / 1e3))
    columns = [statistics.median(column) for column in zip(*rows, strict=True)]
    return dict(zip(("wall_ms", "cpu_ms", "learning_ms", "exchanges", "kilobytes"), columns, strict=True))


def measured(name: str, world_size: int, count: int, changes: Sequence[str] = ()) -> dict[str, float]:
    """What `iterations` gives in as many processes.

    Args:
        changes: of the configuration, as on the command line.
    """
    found: dict[str, float] = common.on_ranks(world_size, lambda: iterations(name, count, list(changes)))[0]
    return found


def main() -> None:
    args = common.parser(__doc__).parse_args()
    count, repeats = (1, 1) if args.quick else (ITERATIONS, REPEATS)
    rows: dict[str, Any] = {}
    print("| configuration | CPU, 1, ms | CPU, 2 | speed | wall, 1, ms | wall, 2 | speed | exchanges | kB |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in NAMES:
        turns = [[measured(name, size, count) for size in WORLD_SIZES] for _ in range(repeats)]
        one, two = ({key: statistics.median(turn[i][key] for turn in turns) for key in turns[0][0]} for i in (0, 1))
        cpu, wall = (
            common.median_ratio([turn[0][key] for turn in turns], [turn[1][key] for turn in turns])
            for key in ("cpu_ms", "wall_ms")
        )
        rows[name] = {"one": one, "two": two, "cpu": cpu, "wall": wall}
        print(
            f"| {name} | {one['cpu_ms']:.0f} | {two['cpu_ms']:.0f} | {cpu:.2f} | {one['wall_ms']:.0f} "
            f"| {two['wall_ms']:.0f} | {wall:.2f} | {two['exchanges']:.0f} | {two['kilobytes']:.0f} |",
            flush=True,
        )
    common.write(common.about(args) | {"rows": rows}, args.json)


if __name__ == "__main__":
    main()
