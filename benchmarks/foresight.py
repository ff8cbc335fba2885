"""Which trainings will get there, and in how many iterations? First foreseen in the exact world, then run.

    python benchmarks/foresight.py predict [--out FILE]
    python benchmarks/foresight.py run [--predictions FILE] [--seeds N] [--worlds N] [--jobs N] [--runs FILE]
                                       [--picture FILE]

100 random MDPs, each with an update, a step size, a state weight and an initial policy of its own, at five depths.
`predict` writes in which iteration `tabular.foresight.foresee` has 90 % of the way from the initial return to J* behind
it, or that it does not within 60. It knows tables and settings, and has made no run. `run` trains PGTS on them from
rollouts with a learned critic and holds the outcomes to that file. Beside it are predictions that should be worse:

    exact        Algorithm 1 with exact values of states and all of them visited, as if rollouts hid nothing
    wrong step   the foreseen one, but with a step size three times too large
    wrong depth  the foreseen one, but that of m = 0 at all depths
    majority     whatever is more frequent

The MDPs: 6 to 20 states, 2 or 3 actions, 1 or 2 successors, 2 to 10 % of all actions rewarded, gamma 0.8 to 0.95; in
seven of ten action 0 leads back to the start from most states and earns a little. The initial policy prefers action 0.
"""

import argparse
import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from records import Key, Record, measure
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.options.updates import Mirror, Projected, SoftmaxGradient
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, exact, random_mdp
from pgts_torch.tabular.foresight import foresee

HERE = Path(__file__).parent
PREDICTIONS, RUNS = HERE / "foresight.csv", Path("runs/foresight.jsonl")
DEPTHS = (0, 1, 2, 4, 8)
WORLDS, ENVS, LENGTH, ITERATIONS, ARRIVED = 100, 16, 30, 60, 0.9
STEP_SIZES = {"projected": (0.1, 3.0), "softmax": (1.0, 30.0), "mirror": (0.3, 10.0), "default": (0.3, 3.0)}
"""Updates, each with the range of its step sizes: `mirror` in reward units, and as it is by default."""


class World(NamedTuple):
    """A training that is to be foreseen, but for its depth and seed."""

    mdp: TabularMDP
    kind: str
    step_size: float
    weight: str
    probability: float

    @property
    def pi_SA(self) -> Float[Tensor, "S A"]:
        """The initial policy: action 0 with the given probability."""
        S, A = self.mdp.num_states, self.mdp.num_actions
        pi_SA = torch.full((S, A), (1 - self.probability) / (A - 1), dtype=torch.float64)
        pi_SA[:, 0] = self.probability
        return pi_SA

    @property
    def update(self) -> dict[str, Any]:
        """The update as an argument of PGTS."""
        options = {"type": self.kind, "step_size": self.step_size, "state_weight": self.weight}
        if self.kind == "mirror":
            return options | {"normalize": "none"}
        return options | {"type": "mirror"} if self.kind == "default" else options

    def arrival(self, J_K: Iterable[float]) -> int | None:
        """The first iteration with 90 % of the way from the initial return to J* behind it; None: there is none."""
        J_0, J_optimal = exact.evaluate(self.mdp, self.pi_SA).J, exact.optimal(self.mdp).J
        return next((k for k, J in enumerate(J_K) if J >= J_0 + ARRIVED * (J_optimal - J_0)), None)


def world(*names: str | int) -> World:
    """One that the initial policy does not solve already, by the names of its random stream."""
    random = numpy_stream(0, "foresight", *names)
    while True:
        mdp, kind = _mdp(random), str(random.choice(list(STEP_SIZES)))
        low, high = STEP_SIZES[kind]
        step_size = float(f"{low * (high / low) ** random.random():.2g}")
        weight = str(random.choice(["occupancy", "uniform"]))
        probability = float(random.choice([0.6, 0.9, 0.99, 1.0] if kind == "projected" else [0.6, 0.9, 0.99]))
        found = World(mdp, kind, step_size, weight, probability)
        J_optimal = exact.optimal(mdp).J
        if J_optimal - exact.evaluate(mdp, found.pi_SA).J > 0.1 * J_optimal > 0:
            return found


def _mdp(random: np.random.Generator) -> TabularMDP:
    S, A, branching = (int(random.integers(*ends)) for ends in ((6, 21), (2, 4), (1, 3)))
    share, gamma = float(random.choice([0.02, 0.05, 0.1])), float(random.choice([0.8, 0.9, 0.95]))
    seed = int(random.integers(10**6))
    mdp = random_mdp(S, A, branching=branching, reward_share=share, gamma=gamma, seed=seed)
    if random.random() >= 0.7:
        return mdp
    back_S = torch.from_numpy(random.random(S) < 0.8)
    reward_SA, child_SAK = mdp.outcomes.reward_NA.clone(), mdp.outcomes.child_NAK.clone()
    child_SAK[back_S, 0] = 0
    reward_SA[back_S, 0] = 0.05 * float(random.random())
    return replace(mdp, outcomes=replace(mdp.outcomes, reward_NA=reward_SA, child_NAK=child_SAK), reward_SAK=None)


PREDICTORS: dict[str, dict[str, Any]] = {
    "foreseen": {},
    "exact": {"num_envs": 10**9, "trace": 1.0, "critic_step_size": 1.0},
    "wrong step": {"factor": 3.0},
}


def predicted(world: World, depth: int, *, factor: float = 1.0, **knobs: Any) -> int | None:
    """In which iteration the training is to arrive."""
    kinds: dict[str, type[Projected | SoftmaxGradient | Mirror]] = {"projected": Projected, "softmax": SoftmaxGradient}
    options = world.update | {"step_size": factor * world.step_size}
    update = kinds.get(world.kind, Mirror).model_validate(options)
    settings: dict[str, Any] = {"num_envs": ENVS, "length": LENGTH} | knobs
    run = foresee(world.mdp, world.pi_SA, depth=depth, iterations=ITERATIONS, update=update, **settings)
    return world.arrival(run.J_K.tolist())


def trained(world: World, depth: int, seed: int) -> int | None:
    """In which iteration a training from rollouts arrives."""
    model = PGTS(
        TabularVectorEnv(world.mdp, ENVS, autoreset_mode="Disabled"),
        depth=depth,
        seed=seed,
        horizon={"type": "fixed", "length": LENGTH},
        policy={
            "type": "simplex" if world.kind == "projected" else "softmax",
            "init": {"type": "biased", "action": 0, "probability": world.probability},
        },
        update=world.update,
    )

    def returns() -> Iterable[float]:
        yield exact.evaluate(world.mdp, model.policy_table()).J
        for _ in range(ITERATIONS):
            model.iterate()
            yield exact.evaluate(world.mdp, model.policy_table()).J

    return world.arrival(returns())


def run(key: Key) -> Record:
    """One training."""
    return dict(key) | {"arrival": trained(world("blind", key["world"]), key["depth"], key["seed"])}


Predictions = dict[tuple[int, int], dict[str, int | None]]


def predict(path: Path) -> None:
    """Write all predictions, a row for each MDP and depth; an empty cell: it does not arrive."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["world", "depth", *PREDICTORS])
        for number in range(WORLDS):
            for depth in DEPTHS:
                found = [predicted(world("blind", number), depth, **knobs) for knobs in PREDICTORS.values()]
                rows.writerow([number, depth, *("" if k is None else k for k in found)])
            file.flush()


def read(path: Path) -> Predictions:
    with path.open(encoding="utf-8") as file:
        return {
            (int(row["world"]), int(row["depth"])): {name: int(row[name]) if row[name] else None for name in PREDICTORS}
            for row in csv.DictReader(file)
        }


def verdict(records: Sequence[Record], predictions: Predictions) -> str:
    """How often each prediction was right, where, and by how much it missed the iteration."""
    worlds = {number: world("blind", number) for number in {r["world"] for r in records}}
    arrived = [r["arrival"] is not None for r in records]
    lines = [f"{sum(arrived)} of {len(records)} runs arrive within {ITERATIONS} iterations", ""]
    lines.append(f"{'prediction':<14}{'right':>12}{'share':>8}   iterations of those that arrive as foreseen")
    said = {name: [predictions[r["world"], r["depth"]][name] for r in records] for name in PREDICTORS}
    said["wrong depth"] = [predictions[r["world"], 0]["foreseen"] for r in records]
    for name, foreseen in said.items():
        pairs = list(zip(foreseen, (r["arrival"] for r in records), strict=True))
        hits = sum((k is None) == (true is None) for k, true in pairs)
        off = np.array([true / k for k, true in pairs if k and true])
        near = [f"{(np.abs(np.log(off)) <= np.log(1 + share)).mean():.0%}" for share in (0.1, 0.25)]
        lines.append(
            f"{name:<14}{f'{hits} of {len(pairs)}':>12}{hits / len(pairs):>8.1%}   median run / foreseen "
            f"{np.median(off):.2f}, within 10 %: {near[0]}, 25 %: {near[1]}"
        )
    most = max(sum(arrived), len(arrived) - sum(arrived))
    lines.append(f"{'majority':<14}{f'{most} of {len(arrived)}':>12}{most / len(arrived):>8.1%}")
    lines += ["", "foreseen, by"]
    groups: dict[str, Callable[[Record], Any]] = {
        "depth": lambda r: r["depth"],
        "update": lambda r: worlds[r["world"]].kind,
        "weight": lambda r: worlds[r["world"]].weight,
        "action 0": lambda r: worlds[r["world"]].probability,
    }
    for title, key in groups.items():
        cells = []
        for value in sorted({key(r) for r in records}):
            mine = [r for r in records if key(r) == value]
            cells.append(f"{value}: {sum(_is_hit(r, predictions) for r in mine)} of {len(mine)}")
        lines.append(f"  {title:<10}" + ", ".join(cells))
    missed = [r for r in records if not _is_hit(r, predictions)]
    lines += ["", f"missed: {len(missed)} runs, {len({(r['world'], r['depth']) for r in missed})} pairs (MDP, depth)"]
    for r in missed:
        one, k = worlds[r["world"]], predictions[r["world"], r["depth"]]["foreseen"]
        what = f"foreseen {k or 'never'}, came {r['arrival'] or 'never'}"
        lines.append(
            f"  {r['world']:>3} m = {r['depth']} seed {r['seed']}: {what:<30} {one.kind}, {one.weight}, "
            f"step {one.step_size:g}, action 0 with {one.probability:g}"
        )
    return "\n".join(lines)


def _is_hit(record: Record, predictions: Predictions) -> bool:
    return (predictions[record["world"], record["depth"]]["foreseen"] is None) == (record["arrival"] is None)


def picture(records: Sequence[Record], predictions: Predictions) -> Figure:
    """Measured against foreseen iterations; runs that do not arrive beyond the limit."""
    figure, beyond = Figure(figsize=(5.2, 4.8), layout="constrained"), ITERATIONS * 1.35
    panel = figure.subplots()
    random = np.random.default_rng(0)  # so that equal pairs are seen beside each other
    for depth in DEPTHS:
        pairs = [(predictions[r["world"], depth]["foreseen"], r["arrival"]) for r in records if r["depth"] == depth]
        x, y = (
            np.array([beyond if k is None else k for k in column], dtype=float) for column in zip(*pairs, strict=True)
        )
        spread = np.exp(0.04 * random.standard_normal((2, len(x))))
        panel.scatter(x * spread[0], y * spread[1], s=12, alpha=0.6, label=f"m = {depth}")
    panel.plot([1, ITERATIONS], [1, ITERATIONS], color="k", linewidth=1)
    for line in (panel.axhline, panel.axvline):
        line(ITERATIONS * 1.1, color="k", linestyle=":", linewidth=1)
    ticks, labels = [1, 3, 10, 30, beyond], ["1", "3", "10", "30", "never"]
    panel.set(xscale="log", yscale="log", xlabel="foreseen iteration", ylabel="iteration of the run")
    panel.set_xticks(ticks, labels)
    panel.set_yticks(ticks, labels)
    panel.minorticks_off()
    panel.legend()
    return figure


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="part", required=True)
    parts.add_parser("predict").add_argument("--out", type=Path, default=PREDICTIONS)
    runs = parts.add_parser("run")
    runs.add_argument("--predictions", type=Path, default=PREDICTIONS)
    runs.add_argument("--seeds", type=int, default=2)
    runs.add_argument("--worlds", type=int, default=WORLDS)
    runs.add_argument("--jobs", type=int, default=1, help="runs at a time, each in one thread; 0: none")
    runs.add_argument("--runs", type=Path, default=RUNS, help="finished runs, kept and not made again")
    runs.add_argument("--picture", type=Path)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if given.part == "predict":
        predict(given.out)
        return
    keys = [
        {"world": number, "depth": depth, "seed": seed}
        for seed in range(given.seeds)
        for number in range(given.worlds)
        for depth in DEPTHS
    ]
    records, predictions = measure(keys, run, path=given.runs, jobs=given.jobs), read(given.predictions)
    if given.picture:
        picture(records, predictions).savefig(given.picture, dpi=120)
    print(verdict(records, predictions))


if __name__ == "__main__":
    main()
