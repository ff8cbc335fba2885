"""Do the defaults of tables learn what they have not been chosen on?

Each problem with defaults only (gamma 0.99), at depth 16 and with an adaptive depth.
"""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pgts_torch import PGTS
from pgts_torch.tabular import exact

GAMMA, ENOUGH = 0.99, 0.95
DEPTHS: tuple[int | Literal["adaptive"], ...] = (16, "adaptive")


@dataclass(frozen=True)
class Task:
    """An environment, how many steps it gets, at which depths, and what is searched by."""

    name: str
    id: str
    kwargs: dict[str, Any]
    steps: int = 50_000
    depths: tuple[int | Literal["adaptive"], ...] = DEPTHS
    search: dict[str, Any] | Literal["auto"] = "auto"


TASKS = (
    Task("FrozenLake 4x4", "FrozenLake-v1", {}),
    Task("FrozenLake 4x4, 4 samples", "FrozenLake-v1", {}, depths=(4, 16), search={"type": "sampled", "samples": 4}),
    Task("FrozenLake 8x8", "FrozenLake8x8-v1", {}),
    Task("CliffWalking", "CliffWalking-v1", {}),
    Task("CliffWalking, slippery", "CliffWalking-v1", {"is_slippery": True}),
    Task("combination lock", "pgts/CombinationLock-v0", {}),
    Task("river swim", "pgts/RiverSwim-v0", {}),
    Task("slippery corridor", "pgts/Corridor-v0", {}),
    Task("Taxi", "Taxi-v4", {}, 200_000),
    Task("Taxi, rainy", "Taxi-v4", {"is_rainy": True}, 200_000),
)


def share(task: Task, depth: int | Literal["adaptive"], seed: int) -> float:
    """(J - J_uniform) / (J* - J_uniform) after training."""
    model = PGTS(task.id, depth=depth, gamma=GAMMA, seed=seed, env_kwargs=task.kwargs, search=task.search)
    uniform = exact.evaluate(model.mdp, model.policy_table()).J
    model.learn(task.steps)
    return (exact.evaluate(model.mdp, model.policy_table()).J - uniform) / (exact.optimal(model.mdp).J - uniform)


def shown(shares: Sequence[float]) -> str:
    """How many are enough; median and least."""
    enough = sum(value >= ENOUGH for value in shares)
    return f"{enough} of {len(shares)} ({statistics.median(shares):.3f}, {min(shares):.3f})"


def table(seeds: Sequence[int], *, short: bool, only: Sequence[str]) -> None:
    """Print the table in Markdown, row by row.

    Args:
        short: two problems at depth 16, and a fifth of the steps.
        only: those problems whose names begin so.
    """
    print(f"At least {ENOUGH:.0%} of the way from the uniform policy to J*: in how many seeds (median, least).\n")
    print("| problem | steps | depth | defaults |")
    print("|---|---|---|---|", flush=True)
    named = [task for task in TASKS if not only or task.name.startswith(tuple(only))]
    for task in named[:3] if short else named:
        for depth in task.depths[:1] if short else task.depths:
            made = replace(task, steps=task.steps // 5) if short else task
            found = shown([share(made, depth, seed) for seed in seeds])
            print(f"| {made.name} | {made.steps:,} | {depth} | {found} |", flush=True)
