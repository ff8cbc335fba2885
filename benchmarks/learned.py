"""What is learned from `env.step` alone: how soon is an environment solved with a learned model?

    python benchmarks/learned.py [--seeds N] [--tasks cartpole,taxi] [--methods learned,ppo] [--jobs N]
                                 [--runs FILE] [--json FILE] [--picture FILE]

    learned     PGTS with a model that is learned from steps: configs/learned/*.yaml
    given       the same with the given model: --model given --replay.type uniform
    pgts        today's configurations with the given model, without replay: configs/*.yaml
    ppo ...     of stable-baselines3, with the tuned settings of its zoo where it has some (`task_rivals.py`)
    r-max ...   on numbered states only, without a policy gradient (`learned_rivals.py`); Q-learning is told the largest
                optimal value, at which all of its values start

As in `tasks.py`, a return is reached at the first of three evaluations in a row that have it, from 500 environment
steps on and then at each 1.25 times as many; a method that learns in iterations is evaluated after the next of them.
On vectors evaluations are 20 greedy episodes. On numbered states they are exact: the discounted return J of the greedy
policy, which must be within 1 % of the optimum; they begin at 100 steps. Seconds are CPU seconds without evaluations.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import tasks
import torch
from matplotlib.figure import Figure
from records import Key, Record, benchmark
from tasks import ROOT, Task, Watch, mean_return

from pgts_torch.config import Config, load
from pgts_torch.experiment import run as experiment
from pgts_torch.options import Counts, FixedHorizon
from pgts_torch.tabular import TabularMDP, exact

RUNS = Path("runs/learning/learned.jsonl")
METHODS = {
    "learned": "learned model",
    "given": "given model, replay",
    "pgts": "given model, as shipped",
    "ppo": "PPO",
    "a2c": "A2C",
    "dqn": "DQN",
    "r-max": "R-max",
    "psrl": "posterior sampling",
    "q-learning": "Q-learning",
}
TABULAR = ("r-max", "psrl", "q-learning")
VECTORS = {name: tasks.TASKS[name] for name in ("cartpole", "acrobot", "mountain_car")}
TABLES = {
    "cliff_walking": 20_000,
    "deep_sea": 20_000,
    "deep_sea_50": 60_000,
    "frozen_lake_4x4": 30_000,
    "frozen_lake_8x8": 60_000,
    "taxi": 60_000,
}
"""Environment steps at most."""
WITH_REPLAY = 30_000
"""Environment steps at most of methods that learn from replay, where one step takes milliseconds."""
STEP_SIZE, EPSILON = 0.1, 0.1
"""Of Q-learning."""


def applies(key: Key) -> bool:
    """Whether there is such a run: on LunarLander no model is given, and DeepSea with 50 rows has no configuration that
    looks far enough without replay."""
    if key["method"] in TABULAR:
        return key["task"] in TABLES
    if key["task"] == "deep_sea_50" and key["method"] == "pgts":
        return False
    return key["task"] != "lunar_lander" or key["method"] not in ("given", "pgts")


def configured(task: str, method: str, seed: int) -> Config:
    """The configuration of a method of ours; of the others, the one that says what the environment is. deep_sea_50 is
    that of deep_sea with 50 rows."""
    size = []
    if task == "deep_sea_50":
        task, size = "deep_sea", ["--env.kwargs.n", "50", "--rollout.horizon.length", "50"]
    folder = "configs/learned" if method in ("learned", "given") else "configs"
    given = ["--model", "given", "--replay.type", "uniform"] if method == "given" else []
    return load(str(ROOT / folder / f"{task}.yaml"), ["--seed", str(seed), *given, *size])


@cache
def mdp(task: str) -> TabularMDP:
    """The truth, which no method is shown that learns from steps."""
    return experiment.build(configured(task, "pgts", 0)).mdp


@cache
def optimum(task: str) -> tuple[float, float]:
    """J*, and the largest optimal value of a state."""
    best = exact.optimal(mdp(task))
    return float(best.J), float(best.v_S.max())


def task_of(name: str) -> Task:
    if name in VECTORS:
        return VECTORS[name]
    J, _ = optimum(name)
    return Task(J - 0.01 * abs(J), TABLES[name], episodes=1, first_look=100)


def greedy_J(task: str, action_S: np.ndarray) -> float:
    """J of the policy that takes these actions."""
    table = mdp(task)
    pi_SA = torch.nn.functional.one_hot(torch.as_tensor(action_S).long(), table.num_actions).double()
    return float(exact.evaluate(table, pi_SA).J)


def run(key: Key) -> Record:
    """One method on one task with one seed."""
    name, method, seed = key["task"], key["method"], key["seed"]
    task, config = task_of(name), configured(name, method, seed)

    def predicted_J(model: Any) -> float:
        answer = model.predict(np.arange(mdp(name).num_states), deterministic=True)
        return greedy_J(name, answer[0] if isinstance(answer, tuple) else answer)

    if method in ("learned", "given", "pgts"):
        if name in VECTORS and method != "pgts":
            task = replace(task, budget=min(task.budget, WITH_REPLAY))
        score: Callable[[Any], float] = predicted_J if name in TABLES else lambda model: mean_return(model, task, seed)
        return tasks.train(experiment.build(config), task, score)
    watch, gamma = Watch(task), config.env.gamma
    assert gamma is not None, "these configurations say it"
    if method in TABULAR:
        _learn_table(name, method, config, lambda steps, greedy: watch(steps, 0, lambda: greedy_J(name, greedy())))
        return watch.record()
    import task_rivals

    task_rivals.train(
        method,
        config.env.id,
        task.episodes,
        seed=seed,
        gamma=gamma,
        watch=watch,
        budget=task.budget,
        judge=predicted_J if name in TABLES else None,
        env_kwargs=config.env.kwargs,
    )
    return watch.record()


def _learn_table(name: str, method: str, config: Config, watch: Callable[..., bool]) -> None:
    from learned_rivals import planned, q_learning

    env = gymnasium.make(config.env.id, **config.env.kwargs)
    learn = {
        "r-max": partial(planned, options=Counts(optimism="rmax")),
        "psrl": partial(planned, options=Counts(optimism="posterior")),
        "q-learning": partial(q_learning, step_size=STEP_SIZE, epsilon=EPSILON, initial=optimum(name)[1]),
    }[method]
    horizon = config.rollout.horizon
    assert isinstance(horizon, FixedHorizon), "these configurations say it"
    learn(env, watch, gamma=config.env.gamma, budget=TABLES[name], horizon=horizon.length, seed=config.seed)


def table(records: list[Record]) -> str:
    """In Markdown."""
    return tasks.table(records, {name: task_of(name) for name in (*VECTORS, *TABLES)}, METHODS)


def picture(records: list[Record]) -> Figure:
    """Return against environment steps, where PPO is stuck or does not stay."""
    methods = {"ppo": "PPO", "pgts": "PGTS, given model", "learned": "PGTS, learned model"}
    shown = {name: task_of(name) for name in ("deep_sea", "taxi", "mountain_car")}
    return tasks.picture(records, shape=(1, 3), tasks=shown, methods=methods)


def main(arguments: list[str] | None = None) -> None:
    names = (*VECTORS, *TABLES)
    benchmark(__doc__, arguments, "task", names, tuple(METHODS), RUNS, run, table, picture, applies)


if __name__ == "__main__":
    main()
