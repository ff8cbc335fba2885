"""How many processes pay? A model of what an iteration costs, measured, beside what processes really take.

    python benchmarks/scaling.py [--json FILE] [--quick]

The CPU time of the slowest process, which is rank 0, in one iteration by R processes that share the work of one:

    T(R) = fixed + divided / R + steps (start + rows / R) + exchanges (call + link (R - 1)) + bytes (R - 1) byte

Nothing in it is fitted to several processes but how many exchanges and bytes there are. Of one process: `divided` is
twice what half as many environments save, without learning; a gradient step of half as many rows tells what of it does
not depend on rows. Exchanges are timed by themselves, over sockets as in training: small ones by 2 and 4 processes, a
large one by 2. Then the model says what 2, 3 and 4 processes take, which is measured too; and how much faster 8, 64 and
512 would be with as many environments each, whose minibatches are larger, or more, and with messages along a tree.

CPU time leaves out what a process waits for others, and networks between machines: speeds are upper bounds.
"""

import functools
import statistics
import time
from typing import Any, NamedTuple

import common
import numpy as np
import ranks

from pgts_torch.config import load
from pgts_torch.options import NetworkValues
from pgts_torch.ranks import present_ranks

NAMES = ("taxi", "cartpole", "mountain_car", "door_key")
MEASURED, PREDICTED = (2, 3, 4), (8, 64, 512)
MESSAGES = (1_000, 1_000_000)
ROUNDS = 200


class Costs(NamedTuple):
    """What an iteration of one process is made of, in milliseconds; and what several exchange, in numbers and kB."""

    fixed: float
    divided: float
    start: float
    rows: float
    exchanges: float
    kilobytes: float


class Links(NamedTuple):
    """What an exchange takes of rank 0, in milliseconds: a call, a link to each other rank, and a kB to and from it."""

    call: float
    link: float
    kilobyte: float

    def star(self, costs: Costs, size: int) -> float:
        """All exchanges of an iteration, where rank 0 is linked to every other one."""
        others = size - 1
        each = self.call + self.link * others
        return costs.exchanges * each + costs.kilobytes * self.kilobyte * others if others else 0.0

    def tree(self, costs: Costs, size: int) -> float:
        """The same where ranks are linked as a binary tree: a rank has two links below it, and its answer waits for
        all levels."""
        levels = max(size - 1, 0).bit_length()
        return (
            2 * levels * (costs.exchanges * self.link + costs.kilobytes * self.kilobyte) + costs.exchanges * self.call
        )


def predicted(costs: Costs, links: Links, size: int) -> float:
    """An iteration of as many ranks that share the work of one."""
    return costs.fixed + costs.start + (costs.divided + costs.rows) / size + links.star(costs, size)


def costs_of(name: str, count: int) -> tuple[Costs, float]:
    """The costs of a configuration, and what an iteration of one process takes."""
    options = load(str(ranks.CONFIGS / f"{name}.yaml"))
    assert options.rollout.num_envs is not None
    half = ["--rollout.num_envs", str(options.rollout.num_envs // 2)]
    whole, fewer = (ranks.measured(name, 1, count, changes) for changes in ([], half))
    two = ranks.measured(name, 2, count)
    others = [run["cpu_ms"] - run["learning_ms"] for run in (whole, fewer)]
    divided = min(max(2 * (others[0] - others[1]), 0.0), others[0])
    start, rows = whole["learning_ms"], 0.0
    if isinstance(options.critic, NetworkValues):
        # As many steps of half the rows, twice: what they take more than the steps of all rows does not depend on rows.
        size = str(options.critic.minibatch_size // 2)
        small = ["--update.minibatch_size", size, "--critic.minibatch_size", size]
        twice = ranks.measured(name, 1, count, small)["learning_ms"]
        start = min(max(twice - whole["learning_ms"], 0.0), whole["learning_ms"])
        rows = whole["learning_ms"] - start
    exchanges = two["exchanges"], two["kilobytes"]
    return Costs(others[0] - divided, divided, start, rows, *exchanges), whole["cpu_ms"]


def exchanged(size: int, num_bytes: int) -> float:
    """Milliseconds of CPU time of rank 0 for an exchange of a vector of so many bytes."""

    def work() -> float:
        exchange, own, times = present_ranks().exchange, np.ones(num_bytes // 4, dtype=np.float32), []
        assert exchange is not None
        for _ in range(ROUNDS if num_bytes < 10**5 else ROUNDS // 10):
            begun = time.process_time()
            exchange.swap("a vector", own, summed)
            times.append(time.process_time() - begun)
        return 1e3 * statistics.median(times)

    first: float = common.on_ranks(size, work)[0]
    return first


def summed(parts: list[Any]) -> Any:
    """As `Ranks.sum` does."""
    return functools.reduce(np.add, (np.frombuffer(part, np.float32) for part in parts))


def links_of() -> Links:
    small, large = MESSAGES
    two, four, many = exchanged(2, small), exchanged(4, small), exchanged(2, large)
    link = max((four - two) / 2, 0.0)
    return Links(max(two - link, 0.0), link, max(many - two, 0.0) / ((large - small) / 1e3))


def grown(costs: Costs, links: Links, size: int, *, more_steps: bool = False, tree: bool = False) -> float:
    """An iteration of as many ranks with as much work each, whose minibatches grow with them, or become more."""
    steps = size if more_steps else 1
    messages = links.tree(costs, size) if tree else links.star(costs, size)
    return costs.fixed + costs.divided + costs.rows + steps * (costs.start + messages)


def tree_pays(costs: Costs, links: Links) -> int:
    """The least power of two of ranks whose messages take less as a tree."""
    return next(size for size in (2**k for k in range(1, 40)) if links.tree(costs, size) < links.star(costs, size))


def main() -> None:
    args = common.parser(__doc__).parse_args()
    names, sizes, count = (NAMES[:2], MEASURED[:1], 2) if args.quick else (NAMES, MEASURED, ranks.ITERATIONS)
    links = links_of()
    print(
        f"An exchange takes rank 0 {1e3 * links.call:.0f} us, {1e3 * links.link:.0f} us for each other rank and "
        f"{1e6 * links.kilobyte:.0f} ns for each of its kB.\n"
    )
    report: dict[str, Any] = {"links": links._asdict(), "rows": {}}
    print("| configuration | ms | divided | rows of steps | start of steps | fixed | exchanges | kB |")
    print("|---" * 8 + "|")
    found: dict[str, tuple[Costs, float]] = {}
    for name in names:
        found[name] = costs, whole = costs_of(name, count)
        parts = costs.divided, costs.rows, costs.start, costs.fixed
        shares = " | ".join(f"{100 * part / whole:.0f} %" for part in parts)
        print(f"| {name} | {whole:.0f} | {shares} | {costs.exchanges:.0f} | {costs.kilobytes:.0f} |", flush=True)
    print("\n| the same work | " + " | ".join(f"{size}: model | measured" for size in sizes) + " | limit |")
    print("|---" * (2 * len(sizes) + 2) + "|")
    for name, (costs, whole) in found.items():
        cells, speeds = [], {}
        for size in sizes:
            took = ranks.measured(name, size, count)["cpu_ms"]
            speeds[size] = {"model": whole / predicted(costs, links, size), "measured": whole / took}
            cells += [f"{speeds[size]['model']:.2f}", f"{speeds[size]['measured']:.2f}"]
        cells.append(f"{whole / (costs.fixed + costs.start):.1f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
        report["rows"][name] = costs._asdict() | {"one": whole, "speeds": speeds}
    print(
        "\n| as much work each | "
        + " | ".join(f"{size} | more steps | tree" for size in PREDICTED)
        + " | tree pays from |"
    )
    print("|---" * (3 * len(PREDICTED) + 2) + "|")
    for name, (costs, whole) in found.items():
        cells = []
        for size in PREDICTED:
            for form in ({}, {"more_steps": True}, {"tree": True}):
                cells.append(f"{size * whole / grown(costs, links, size, **form):.1f}")
        print(f"| {name} | " + " | ".join(cells) + f" | {tree_pays(costs, links)} |")
    common.write(common.about(args) | report, args.json)


if __name__ == "__main__":
    main()
