"""How soon is an environment solved, against the algorithms that people use today?

    python benchmarks/tasks.py [--seeds N] [--tasks taxi,cartpole] [--methods pgts,ppo] [--jobs N]
                               [--runs FILE] [--json FILE] [--picture FILE]

Each shipped configuration against PPO, A2C and DQN of stable-baselines3, with the tuned settings of its zoo where it
has some (`task_rivals.py`). All are evaluated alike, by greedy episodes in fresh environments, at 500 environment steps
and then at each 1.25 times as many. A run ends when its budget of environment steps is spent, or at the third
evaluation in a row that reaches the stated return; it is said to have reached it at the first of these three. Seconds
are CPU seconds without the evaluations.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from records import Key, Record, benchmark

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.config import load
from pgts_torch.experiment import run as experiment
from pgts_torch.experiment.statistics import bootstrap_interval, interquartile_mean

ROOT = Path(__file__).resolve().parent.parent
RUNS = Path("runs/learning/tasks.jsonl")
METHODS = {"pgts": "PGTS", "ppo": "PPO", "a2c": "A2C", "dqn": "DQN"}
FIRST_LOOK, GROWTH, IN_A_ROW = 500, 1.25, 3


@dataclass(frozen=True)
class Task:
    """The return that is to be reached, the budget of environment steps, episodes of an evaluation, and the environment
    steps before the first one."""

    reach: float
    budget: int
    episodes: int
    first_look: int = FIRST_LOOK


TASKS = {
    "frozen_lake_8x8": Task(0.75, 60_000, 100),
    "cliff_walking": Task(-13, 30_000, 1),
    "taxi": Task(7.0, 200_000, 50),
    "cartpole": Task(475, 100_000, 20),
    "acrobot": Task(-100, 100_000, 20),
    "mountain_car": Task(-115, 120_000, 20),
    "door_key": Task(0.9, 100_000, 20),
    "lunar_lander": Task(100, 100_000, 20, first_look=5_000),
}


class Watch:
    """Evaluates a training now and then, and says when it has come to its end."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.curve: list[tuple[int, float]] = []
        self.reached: dict[str, float] | None = None
        self._next, self._row = float(task.first_look), list[dict[str, float]]()
        self._started, self._evaluating = time.process_time(), 0.0

    def __call__(self, env_steps: int, model_calls: int, evaluate: Callable[[], float]) -> bool:
        """Whether the training goes on."""
        if env_steps < self._next and env_steps < self.task.budget:
            return True
        while self._next <= env_steps:
            self._next *= GROWTH
        cost = {"env_steps": env_steps, "model_calls": model_calls, "seconds": self.seconds}
        begun = time.process_time()
        score = evaluate()
        self._evaluating += time.process_time() - begun
        self.curve.append((env_steps, score))
        self._row = [*self._row, cost] if score >= self.task.reach else []
        if len(self._row) == IN_A_ROW:
            self.reached = self._row[0]
        return self.reached is None and env_steps < self.task.budget

    @property
    def seconds(self) -> float:
        return time.process_time() - self._started - self._evaluating

    def record(self) -> Record:
        return {"reached": self.reached, "last": self.curve[-1][1], "seconds": self.seconds, "curve": self.curve}


def run(key: Key) -> Record:
    """One method on one task with one seed."""
    task = TASKS[key["task"]]
    config = load(str(ROOT / "configs" / f"{key['task']}.yaml"), ["--seed", str(key["seed"])])
    if key["method"] == "pgts":
        return train(experiment.build(config), task, lambda model: mean_return(model, task, key["seed"]))
    import task_rivals

    watch, gamma = Watch(task), config.env.gamma
    assert gamma is not None, "these configurations say it"
    options = {"seed": key["seed"], "gamma": gamma, "watch": watch, "budget": task.budget}
    inside = config.env.kwargs.get("env", config.env.id)
    task_rivals.train(key["method"], inside, task.episodes, **options)
    return watch.record()


def train(model: PGTS, task: Task, score: Callable[[PGTS], float]) -> Record:
    """A training that is evaluated by `score` now and then."""
    watch = Watch(task)
    model.learn(
        task.budget,
        callback=lambda model, _: watch(model.num_env_steps, model.num_model_calls, lambda: score(model)),
    )
    return watch.record()


def mean_return(model: PGTS, task: Task, seed: int) -> float:
    """Of greedy episodes."""
    return evaluate(model, episodes=task.episodes, deterministic=True, seed=seed).episodic_return.mean


def row(task: str, reach: float, method: str, records: list[Record]) -> str:
    """A row of the table: how many seeds reached the return, after how much, and where all of them ended."""

    def interval(values: list[float], form: str) -> str:
        value_R = np.array(values, dtype=float)
        low, high = bootstrap_interval(value_R)
        return f"{interquartile_mean(value_R):{form}} ({low:{form}} to {high:{form}})"

    reached = [r["reached"] for r in records if r["reached"] is not None]
    costs = {name: sorted(r[name] for r in reached) for name in ("env_steps", "model_calls", "seconds")}
    most = len(reached) > len(records) / 2
    missing = len(records) - len(reached)
    median = {name: np.median([*values, *[np.inf] * missing]) if most else None for name, values in costs.items()}
    steps, calls, seconds = (
        "-" if value is None or np.isinf(value) else f"{value:,.{digits}f}"
        for value, digits in zip(median.values(), (0, 0, 1), strict=True)
    )
    return (
        f"| {task} | {reach:.4g} | {method} | {len(reached)} of {len(records)} | {steps} | {calls} "
        f"| {seconds} | {interval([r['last'] for r in records], '.4g')} |"
    )


def table(records: list[Record], tasks: Mapping[str, Task] = TASKS, methods: Mapping[str, str] = METHODS) -> str:
    """In Markdown.

    Args:
        methods: what each is called.
    """
    lines = [
        "| task | return | method | seeds that reached it | env steps | model calls | CPU s | return at the end |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for task in tasks:
        for method, name in methods.items():
            mine = [r for r in records if r["task"] == task and r["method"] == method]
            lines += [row(task, tasks[task].reach, name, mine)] if mine else []
    return "\n".join(lines)


def picture(
    records: list[Record],
    *,
    shape: tuple[int, int] = (2, 4),
    tasks: Mapping[str, Task] = TASKS,
    methods: Mapping[str, str] = METHODS,
) -> Figure:
    """The return of greedy episodes against environment steps, for each task; a line is a median over seeds.

    Args:
        shape: rows and columns of panels.
        methods: what each is called.
    """
    rows, columns = shape
    seen = [task for task in tasks if any(r["task"] == task for r in records)]
    figure = Figure(figsize=(3 * columns, 2.7 * rows), layout="constrained")
    panels = figure.subplots(rows, columns).flatten()
    for axes, task in zip(panels, seen, strict=False):
        for method, name in methods.items():
            mine = [r for r in records if r["task"] == task and r["method"] == method]
            if not mine:
                continue
            x = np.geomspace(tasks[task].first_look, tasks[task].budget, 100)
            # A run that has ended early stays where it was.
            y = [np.interp(x, *np.array(r["curve"], dtype=float).T) for r in mine]
            axes.plot(x, np.median(y, axis=0), label=name)
        axes.axhline(tasks[task].reach, color="k", linestyle=":", linewidth=1)
        axes.set(title=task, xscale="log")
        if axes.get_ylim()[0] < -1000:  # whoever never falls off the cliff and never arrives
            axes.set_yscale("symlog", linthresh=10)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(methods))
    for axes in panels[len(seen) :]:
        axes.remove()
    figure.supxlabel("environment steps")
    figure.supylabel("return of greedy episodes")
    return figure


def main(arguments: list[str] | None = None) -> None:
    benchmark(__doc__, arguments, "task", tuple(TASKS), tuple(METHODS), RUNS, run, table, picture)


if __name__ == "__main__":
    main()
