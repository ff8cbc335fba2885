"""Who finds the treasure in bsuite's DeepSea, and could one have known?

    python benchmarks/deep_sea.py [--seeds N] [--sizes 10,20] [--methods pgts-16,ppo] [--jobs N]
                                  [--runs FILE] [--json FILE] [--picture FILE]

All 21 sizes by bsuite's rules: the actions of each cell are mapped at random, each move to the right costs 0.01 / N,
and there are 10,000 episodes. A run has solved its size, and ends, once 20 % of all its episodes so far have found the
treasure. Everyone sees which cell it is in and plays 100 episodes at a time; PPO and A2C are those of
stable-baselines3 (`deep_sea_rivals.py` says with what settings), and are given what the lookahead asks of its model as
further episodes.

Beside it stands a prediction from the exact world: Algorithm 1 without noise, in which a cell is visited once that is
more likely than not, and worth nothing to the critic before that.
"""

import time
from functools import cache
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from records import Key, Record, benchmark

from pgts_torch import PGTS
from pgts_torch.bellman import backup
from pgts_torch.experiment.statistics import bootstrap_interval, interquartile_mean
from pgts_torch.tabular import TabularMDP, deep_sea, exact
from pgts_torch.tabular.ascent import softmax_step

SIZES = tuple(range(10, 51, 2))
EPISODES, BATCH, ENOUGH = 10_000, 100, 0.2
GAMMA, STEP_SIZE = 0.99, 10.0
DEPTHS = (0, 4, 8, 16, 32, 48)
UPDATES = {
    "pgts": {"type": "softmax", "step_size": STEP_SIZE, "state_weight": "occupancy"},
    "h-pmd": {
        "type": "mirror",
        "step_size": STEP_SIZE,
        "state_weight": "uniform",
        "normalize": "none",
        "floor": 12.0,
    },
}
METHODS = ("ppo", "a2c", *(f"pgts-{m}" for m in DEPTHS), "h-pmd-16", "pgts-adaptive")
NAMES = {"ppo": "PPO", "a2c": "A2C", "pgts-0": "policy gradient, m = 0", "pgts-adaptive": "PGTS, adaptive m"}
RUNS = Path("runs/learning/deep_sea.jsonl")


def run(key: Key) -> Record:
    """One method on one size with one seed."""
    method, size, seed = key["method"], key["size"], key["seed"]
    started = time.process_time()
    if method in ("ppo", "a2c"):
        from deep_sea_rivals import deep_sea_run

        # A batch of 100 episodes more is more than the N (N + 1) calls of any lookahead.
        record = deep_sea_run(method, size, seed, gamma=GAMMA, num_envs=BATCH, episodes=EPISODES + BATCH, enough=ENOUGH)
    else:
        record = tree_search_run(method, size, seed)
    return {**record, "seconds": time.process_time() - started}


def tree_search_run(method: str, size: int, seed: int) -> Record:
    """A softmax table trained by Algorithm 1, or by h-PMD: the same search, with its update and weight."""
    family, _, depth = method.rpartition("-")
    model = PGTS(
        "pgts/DeepSea-v0",
        depth="adaptive" if depth == "adaptive" else int(depth),
        num_envs=BATCH,
        gamma=GAMMA,
        seed=seed,
        critic={
            "type": "tabular",
            "target": "v",
            "method": {"type": "td_lambda", "lambda": 0.9},
            "step_size": 0.5,
            "initial": 0.0,
        },
        update=UPDATES[family],
        horizon={"type": "fixed", "length": size},
        env_kwargs={"n": size, "start": 0, "mapping_seed": seed},
    )
    found = episodes = deepest = 0
    while episodes < EPISODES and found <= ENOUGH * episodes:
        iteration = model.iterate()
        episodes += BATCH
        found += int(((iteration.experience.reward_TB * iteration.experience.alive_TB).sum(0) > 0.5).sum())
        deepest = max(deepest, iteration.depth)
    return {
        "solved": found > ENOUGH * episodes,
        "episodes": episodes,
        "env_steps": model.num_env_steps,
        "model_calls": model.num_model_calls,
        "deepest": deepest,
    }


@cache
def predicted(size: int, depth: int) -> bool:
    """Whether Algorithm 1 without noise solves this size."""
    mdp = deep_sea(size, gamma=GAMMA)
    outcomes, diagonal = mdp.outcomes, torch.arange(size) * (size + 1)
    discount_S = GAMMA ** (torch.arange(size * size) // size)
    pi_SA = torch.full((size * size, 2), 0.5, dtype=torch.float64)
    known_S = torch.zeros(size * size, dtype=torch.bool)
    found = 0.0
    for iteration in range(1, EPISODES // BATCH + 1):
        reach_S = _reach(mdp, pi_SA, size)
        visited_S = 1 - (1 - reach_S.clamp(max=1)) ** BATCH >= 0.5
        known_S |= visited_S
        found += float(pi_SA[diagonal, 1].prod())
        if found > ENOUGH * iteration:
            return True
        v_S = torch.zeros(size * size, dtype=torch.float64)
        for _ in range(size):  # from the last row up
            v_S = known_S * (pi_SA * backup(outcomes, v_S)).sum(-1)
        look_SA = exact.lookahead(mdp, backup(outcomes, v_S), depth)
        moved_SA = softmax_step(pi_SA, look_SA, discount_S * reach_S, STEP_SIZE)
        pi_SA = torch.where(visited_S[:, None], moved_SA, pi_SA)
    return False


def _reach(mdp: TabularMDP, pi_SA: torch.Tensor, size: int) -> torch.Tensor:
    """How probable it is that an episode comes through each cell."""
    weight_SAK = pi_SA[:, :, None] * mdp.outcomes.prob_NAK * (mdp.outcomes.discount_NAK > 0)
    reach_S = mdp.start_S
    for _ in range(size):  # from the first row down
        flow_SAK = reach_S[:, None, None] * weight_SAK
        reach_S = mdp.start_S.index_add(0, mdp.outcomes.child_NAK.flatten(), flow_SAK.flatten())
    return reach_S


def least_depth(size: int) -> int:
    """The smallest m that is predicted to solve this size; deeper ones are taken to do so too."""
    low, high = -1, size - 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if predicted(size, middle) else (middle, high)
    return high


def label(method: str) -> str:
    family, _, depth = method.rpartition("-")
    if family == "h-pmd":
        return f"h-PMD, h = {int(depth) + 1}"
    return NAMES.get(method, f"PGTS, m = {depth}")


def table(records: list[Record], sizes: list[int]) -> str:
    """A row for each method, in Markdown; seeds that have not been through all sizes do not count."""
    lines = [
        f"| method | seeds | sizes solved, of {len(sizes)} | 95 % interval | largest solved by all | episodes "
        "| env steps | model calls | CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for method in dict.fromkeys(r["method"] for r in records):
        mine = [r for r in records if r["method"] == method]
        seeds = [seed for seed in {r["seed"] for r in mine} if sum(r["seed"] == seed for r in mine) == len(sizes)]
        mine = [r for r in mine if r["seed"] in seeds]
        if not mine:
            continue
        count_R = np.array([sum(_solved(r) for r in mine if r["seed"] == seed) for seed in seeds], dtype=float)
        low, high = bootstrap_interval(count_R)
        always = [n for n in sizes if all(_solved(r) for r in mine if r["size"] == n)]
        median = {
            name: np.median([r[name] for r in mine]) for name in ("episodes", "env_steps", "model_calls", "seconds")
        }
        lines.append(
            f"| {label(method)} | {len(seeds)} | {interquartile_mean(count_R):.1f} | {low:.1f} to {high:.1f} "
            f"| {max(always, default='none')} | {median['episodes']:,.0f} | {median['env_steps']:,.0f} "
            f"| {median['model_calls']:,.0f} | {median['seconds']:.1f} |"
        )
    return "\n".join(lines)


def soonest(records: list[Record], sizes: list[int]) -> str:
    """After how many episodes the adaptive depth solves each size, medians over seeds."""
    each = {n: [r["episodes"] for r in records if r["method"] == "pgts-adaptive" and r["size"] == n] for n in sizes}
    return f"{label('pgts-adaptive')}, N:episodes  " + " ".join(f"{n}:{np.median(e):.0f}" for n, e in each.items() if e)


def verdict(records: list[Record], sizes: list[int]) -> str:
    """How often the prediction was right, for the fixed depths."""
    fixed = [r for r in records if r["method"].startswith("pgts-") and r["method"] != "pgts-adaptive"]
    wrong = [r for r in fixed if _solved(r) != (depth_of(r) >= least_depth(r["size"]))]
    least = " ".join(f"{n}:{least_depth(n)}" for n in sizes)
    missed = sorted({(r["size"], depth_of(r)) for r in wrong})
    return (
        f"predicted least depth, N:m  {least}\n"
        f"right in {len(fixed) - len(wrong)} of {len(fixed)} runs; wrong at (N, m) = {missed or 'none'}"
    )


def depth_of(record: Record) -> int:
    return int(record["method"].rpartition("-")[2])


def _solved(record: Record) -> bool:
    return bool(record["solved"]) and record["episodes"] <= EPISODES


def picture(records: list[Record]) -> Figure:
    """Left: which (N, m) were solved, under the prediction. Right: after how many steps, for every method."""
    sizes, figure = _sizes(records), Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for depth in DEPTHS:
        mine = [r for r in records if r["method"] == f"pgts-{depth}"]
        share = [np.mean([float(_solved(r)) for r in mine if r["size"] == n] or [np.nan]) for n in sizes]
        dots = left.scatter(sizes, [depth] * len(sizes), c=share, cmap="RdYlBu", vmin=0, vmax=1, s=42, edgecolors="k")
    left.step(
        sizes, [least_depth(n) for n in sizes], where="mid", color="k", label="exact world: deep enough from here"
    )
    figure.colorbar(dots, ax=left, label="share of seeds that solved it")
    left.set(xlabel="size N", ylabel="depth m", title="Solved with a fixed depth, and predicted", ylim=(-2, 56))
    left.legend(loc="upper left")
    shown = ("ppo", "a2c", "pgts-0", "pgts-16", "pgts-adaptive")
    for place, method in enumerate(m for m in shown if any(r["method"] == m for r in records)):
        mine = [r for r in records if r["method"] == method]
        steps = [
            np.median([r["episodes"] if _solved(r) else np.inf for r in mine if r["size"] == n] or [np.nan])
            for n in sizes
        ]
        [line] = right.plot(sizes, steps, "o-", markersize=4, label=label(method))
        failed = [n for n, episodes in zip(sizes, steps, strict=True) if np.isinf(episodes)]
        height = EPISODES * 1.35 * 1.35**place
        right.plot(failed, [height] * len(failed), "x", markersize=5, color=line.get_color())
    right.axhline(EPISODES, color="k", linestyle=":", linewidth=1)
    right.set(xlabel="size N", ylabel="episodes until solved", yscale="log", title="Median over seeds (x: not solved)")
    right.legend(loc="lower right")
    return figure


def describe(records: list[Record]) -> str:
    sizes = _sizes(records)
    return f"{table(records, sizes)}\n\n{soonest(records, sizes)}\n{verdict(records, sizes)}"


def _sizes(records: list[Record]) -> list[int]:
    return sorted({r["size"] for r in records})


def main(arguments: list[str] | None = None) -> None:
    benchmark(__doc__, arguments, "size", SIZES, METHODS, RUNS, run, describe, picture)


if __name__ == "__main__":
    main()
