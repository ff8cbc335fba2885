"""The defaults of networks: CartPole, Acrobot and a sparse puzzle seen as an image."""

import statistics
from collections.abc import Iterator
from dataclasses import dataclass

import key_and_door

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import evaluate

MOST_STEPS = 50_000
EVERY = 4_000
"""Environment steps between looks at the policy; the last look is where an iteration more might pass the most."""

EPISODES = 100
"""Fresh episodes that a policy must stand which seemed to be good enough in a look of 20."""


@dataclass(frozen=True)
class Task:
    """An environment, the mean return of greedy episodes that counts as learned, and in how many of ten seeds."""

    env_id: str
    target: float
    wanted: int


TASKS = (Task("CartPole-v1", 475, 10), Task("Acrobot-v1", -100, 10), Task(key_and_door.ID, 0.95, 8))


@dataclass(frozen=True)
class Outcome:
    """The return of greedy episodes at the end, and after how many steps it was reached (None: it was not)."""

    value: float
    steps: int | None


def trained(task: Task, seed: int, most_steps: int) -> Outcome:
    """Train until the target is reached in a look and then in fresh episodes, or the steps are used up."""
    model = PGTS(task.env_id, seed=seed)
    looks = range(EVERY, most_steps - EVERY + 1, EVERY)
    for total in looks:
        model.learn(total)
        if evaluate(model, episodes=20, seed=seed).episodic_return.mean < task.target and total < looks[-1]:
            continue
        value = evaluate(model, episodes=EPISODES, seed=10_000 + seed).episodic_return.mean
        if value >= task.target:
            return Outcome(value, model.num_env_steps)
    return Outcome(value, None)


def row(task: Task, outcomes: list[Outcome]) -> str:
    steps = [each.steps for each in outcomes if each.steps is not None]
    needed = f"{statistics.median(steps):,.0f} ({min(steps):,} to {max(steps):,})" if steps else "-"
    values = [each.value for each in outcomes]
    return (
        f"| {task.env_id} | {len(steps)} of {len(outcomes)} | {needed} "
        f"| {statistics.median(values):.4g} ({min(values):.4g} to {max(values):.4g}) |"
    )


def lines(seeds: list[int], *, short: bool, only: list[str]) -> Iterator[str]:
    yield "| environment | learned | steps: median (range) | greedy return: median (range) |"
    yield "|---|---|---|---|"
    most = 2 * EVERY if short else MOST_STEPS
    for task in TASKS:
        if not only or task.env_id.startswith(tuple(only)):
            yield row(task, [trained(task, seed, most) for seed in seeds])


def table(seeds: list[int], *, short: bool, only: list[str]) -> None:
    """Print the table, a line as soon as it is known. Short: few steps. Only: see `defaults_tables`."""
    for line in lines(seeds, short=short, only=only):
        print(line, flush=True)
