"""Figure 2 of the paper: a random MDP, and what the paper says there of every MDP."""

from collections.abc import Callable, Mapping
from typing import Any

from pgts_torch.tabular import TabularMDP, grid, ladder, random_mdp, tightrope
from study.claims import Claim, Finding, Reading, judge
from study.figure import Figure, Move, Parameter
from study.ladder import ALWAYS_LEFT
from study.readings import Run, exact_runs, largest_gap, similar

UNIFORM = {"type": "uniform"}
DEPTHS = (0, 1, 2, 3, 4, 5)
STEPS = (0.3, 0.1, 3.0)
ALMOST = 0.01
"""PG is called almost as good if it ends within this share of that way."""

LARGE_STEPS = (0.1, 1.0, 10.0, 1e3, 1e6)

ZOO: dict[str, tuple[Callable[..., TabularMDP], Mapping[str, Any]]] = {
    "Ladder": (ladder, ALWAYS_LEFT),
    "Tightrope": (tightrope, ALWAYS_LEFT),
    "Random": (random_mdp, UNIFORM),
    "Grid": (grid, UNIFORM),
}
"""The MDPs of the paper with their initial policies."""


def claims(quick: bool) -> list[Claim]:
    """What the paper says of this figure, held to exact runs."""
    seeds = range(2 if quick else 10)
    runs = [
        run
        for init, name in ((UNIFORM, "uniform"), (ALWAYS_LEFT, "always action 0"))
        for run in exact_runs(
            random_mdp,
            [({"initial policy": name, "MDP seed": seed}, {"seed": seed}) for seed in seeds],
            init=init,
            depths=DEPTHS,
            steps=STEPS,
            iterations=300,
        )
    ]
    return [
        judge("PG and PGTS of any depth perform similarly", "Fig. 2, caption", all_similar(runs)),
        judge("PG ends almost as high as PGTS of any depth", "Sec. 3", ends_alike(runs)),
        judge("Every state can follow every state under any action", "Sec. 3", _every_state_follows()),
        judge("PG's return is monotone for any step size, on each of the four MDPs", "Sec. 3", _pg_is_monotone(quick)),
        judge("For m >= 1 that is lost on some of the four MDPs", "Sec. 3", _depth_is_not_monotone(quick)),
    ]


def _worst_over_seeds(runs: list[Run], measure: Callable[[Run], float]) -> dict[tuple[Any, ...], tuple[float, Run]]:
    """The run with the largest measure among the sampled MDPs, for each of the other readings."""
    worst: dict[tuple[Any, ...], tuple[float, Run]] = {}
    for run in runs:
        key = (run.start, run.reading["initial policy"], run.reading["step size"])
        value = measure(run)
        if key not in worst or value > worst[key][0]:
            worst[key] = value, run
    return worst


def all_similar(runs: list[Run]) -> list[Finding]:
    worst = _worst_over_seeds(runs, lambda run: largest_gap(run.traces)).values()
    return [finding for _, run in worst for finding in similar(_without_seed(run), run.traces)]


def ends_alike(runs: list[Run]) -> list[Finding]:
    def shortfall(run: Run) -> float:
        last = {m: float(trace.progress_K[-1]) for m, trace in run.traces.items()}
        return max(last.values()) - last[0]

    return [
        Finding(_without_seed(run), f"PG ends at most {value:.2%} of the way below the best depth", value <= ALMOST)
        for value, run in _worst_over_seeds(runs, shortfall).values()
    ]


def _without_seed(run: Run) -> Reading:
    return {"start": run.start, **run.without("MDP seed")}


def _every_state_follows() -> list[Finding]:
    found = []
    for branching, name in ((None, "to every state"), (3, "to 3 of 10 states")):
        mdp = random_mdp(branching=branching)
        prob = mdp.outcomes.weight.to_dense()
        share = float((prob > 0).double().mean())
        text = f"P(s'|s, a) > 0 for {share:.0%} of all (s, a, s')"
        found.append(Finding({"kernel leading": name}, text, share == 1))
    return found


def _step_runs(depths: tuple[int, ...], quick: bool) -> list[tuple[str, Run]]:
    """Short runs with moderate and with very large steps on the four MDPs, each with its name."""
    found = []
    for name, (make, init) in ZOO.items():
        iterations = 30 if name == "Grid" and quick else 100
        runs = exact_runs(make, [({}, {})], init=init, depths=depths, steps=LARGE_STEPS, iterations=iterations)
        found += [(name, run) for run in runs]
    return found


def _pg_is_monotone(quick: bool) -> list[Finding]:
    found = []
    for name, run in _step_runs((0,), quick):
        pg, reading = run.traces[0], {"MDP": name, "start": run.start, **run.reading}
        found.append(Finding(reading, f"{name}: largest fall in one iteration {pg.largest_fall:.2g}", pg.is_monotone))
    return found


def _depth_is_not_monotone(quick: bool) -> list[Finding]:
    """One finding: the statement says that there are such MDPs."""
    depths = (1, 4)
    falls: dict[str, float] = {}
    for name, run in _step_runs(depths, quick):
        worst = max(0.0 if one.is_monotone else one.largest_fall for one in run.traces.values())
        falls[name] = max(falls.get(name, 0.0), worst)
    text = "largest fall in one iteration: " + ", ".join(f"{fall:.2g} ({name})" for name, fall in falls.items())
    return [Finding({}, text, any(falls.values()))]


FIGURE = Figure(
    name="random",
    title="Figure 2: Random MDP",
    env_id="pgts/Random-v0",
    make=random_mdp,
    depths=DEPTHS,
    moves={"projected": Move(UNIFORM, STEPS[0]), "softmax": Move(UNIFORM, 1.0)},
    iterations={"s0": 50, "uniform": 50},
    sampled_iterations={"s0": 50, "uniform": 50},
    sampled_depths=DEPTHS,
    quick_depths=(0, 5),
    parameters=[
        Parameter("states, actions, gamma", "10, 2, 0.9", "paper, Fig. 2"),
        Parameter("transition kernel", "each P(.|s, a) uniform on the simplex (also 3 successors)", "not stated"),
        Parameter("rewards", "uniform in [0, 1]", "not stated"),
        Parameter("MDP seed", "0; statements are checked on the worst of several", "ours"),
        Parameter("start", "s0, or uniform", "not stated"),
        Parameter("initial policy", "uniform (also always action 0)", "not stated"),
        Parameter("step size, projected", "0.3 (also 0.1, 3)", "not stated"),
        Parameter("step size, softmax", "1", "ours"),
        Parameter("iterations", "50", "not stated"),
    ],
    claims=claims,
)
