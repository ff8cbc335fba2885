"""Figure 4 of the paper: the Grid MDP."""

from collections.abc import Mapping, Sequence
from itertools import chain, product, starmap
from typing import Any

from torch import Tensor

from pgts_torch.tabular import exact, grid, stationary
from study.batch import Batch, Iterate
from study.claims import Claim, Finding, Reading, judge
from study.curves import Trace, arrivals, cells, first, initial_policy
from study.figure import Figure, Move, Parameter
from study.random_mdp import UNIFORM
from study.readings import Run, Variants, arrivals_text, deeper, exact_runs, from_start, similar

DEPTHS = (0, 1, 2, 3, 4, 5, 8, 18)
CHECKED = (0, 1, 4, 18)
"""The depths of the statements; m = 1 is the slowest that the paper says succeeds."""

STEP = 0.1
GAMMA = 0.9
LARGER_STEPS = (1.0, 10.0)
STAYS = 0.9
"""PG stays at the start if it spends more than this share of its (discounted) time there."""

AVOIDS = 0.1
"""Traps are avoided once the time in them has fallen to this share of what pi_0 spends there."""

REACHES = 0.5
"""The goal is found once the time in it is this share of the optimal policy's."""

PATIENCE = 20_000
"""How many iterations PG from s0 gets before we say that it stays there for good."""

TRAPS = {"s12 and s32 (text)": (12, 32), "s11 and s32 (drawing)": (11, 32)}
ABSORBING = {"ordinary states": False, "end the episode": True}
SLIPS = {"one of 4 directions": 0.01, "one of the 3 others": 0.01 * 4 / 3}
"""With probability 0.01 a random direction, the intended one included or not. `grid` spreads its slip over all 4."""

ITERATIONS = {False: 200, True: 1000}
"""By whether goal and traps end the episode: that makes the goal worth less and learning slower."""


def claims(quick: bool) -> list[Claim]:
    """What the paper says of this figure, held to exact runs."""
    runs = list(chain.from_iterable(map(_runs, _variants(quick))))
    from_s0, spread = from_start(runs, "s0"), from_start(runs, "uniform")
    larger = _runs(_variants(quick)[0], steps=LARGER_STEPS, starts=("s0",))
    return [
        judge("Uniform start: PG and PGTS perform similarly", "Sec. 3", all_similar(spread)),
        judge("From s0, PG first learns to avoid the traps", "Sec. 3", map(pg_avoids_traps, from_s0)),
        judge("From s0, PG ends up staying at s0", "Sec. 3", [pg_stays(run) for run in from_s0 + larger]),
        judge("From s0, PG stays at s0 for good", "Sec. 3", [for_good()]),
        judge("Where PG stays is a local optimum", "Sec. 3", [local_optimum(from_s0[0])]),
        judge("From s0, PGTS with m >= 1 reaches the goal", "Sec. 3", starmap(reaches, deeper(from_s0))),
        judge(
            "From s0, PGTS avoids the traps first, then finds the goal",
            "Sec. 3",
            starmap(traps_before_goal, deeper(from_s0)),
        ),
    ]


def _variants(quick: bool) -> Variants:
    """All readings of traps, goal and slip; the quick version tries one change at a time, and no absorbing goal."""
    named = product(TRAPS.items(), ABSORBING.items(), SLIPS.items())
    variants: list[tuple[Reading, Mapping[str, Any]]] = []
    for (traps_name, traps), (absorbing_name, absorbing), (slip_name, slip) in named:
        reading = {"traps": traps_name, "goal and traps": absorbing_name, "slip to": slip_name}
        variants.append((reading, {"traps": traps, "absorbing": absorbing, "slip": slip}))
    first_reading = variants[0][0]
    if not quick:
        return variants
    changes = [sum(reading[name] != first_reading[name] for name in reading) for reading, _ in variants]
    few = [variant for variant, changed in zip(variants, changes, strict=True) if changed <= 1]
    return [variant for variant in few if not variant[1]["absorbing"]]


def _runs(
    variant: tuple[Reading, Mapping[str, Any]],
    steps: Sequence[float] = (STEP,),
    starts: Sequence[str] = ("s0", "uniform"),
) -> list[Run]:
    traps = list(variant[1]["traps"])

    def watch(iterate: Iterate) -> dict[str, Tensor]:
        goal = iterate.d_BS.shape[1] - 1
        return {"start": iterate.d_BS[:, 0], "traps": iterate.d_BS[:, traps].sum(-1), "goal": iterate.d_BS[:, goal]}

    return exact_runs(
        grid,
        [variant],
        init=UNIFORM,
        depths=CHECKED,
        steps=steps,
        iterations=ITERATIONS[variant[1]["absorbing"]],
        watch=watch,
        starts=starts,
    )


def all_similar(runs: list[Run]) -> list[Finding]:
    return [finding for run in runs for finding in similar(run.without("step size"), run.traces)]


def pg_avoids_traps(run: Run) -> Finding:
    avoided, pg = _avoids(run.traces[0]), run.traces[0]
    assert avoided is not None, "PG avoids traps in every reading"
    text = (
        f"time in traps falls to {AVOIDS:.0%} in iteration {avoided}, J from {pg.J_K[0]:.3g} to {pg.J_K[avoided]:.3g}"
    )
    return Finding(run.without("step size"), text, bool(pg.J_K[avoided] > pg.J_K[0]))


def pg_stays(run: Run) -> Finding:
    d_K = run.traces[0].watched["start"]
    share, last = float(d_K[-1]) * (1 - GAMMA), len(d_K) - 1  # occupancies sum to 1 / (1 - gamma)
    text = f"after {last} iterations it spends {share:.0%} of its time at s0, J = {float(run.traces[0].J_K[-1]):.3g}"
    return Finding({"step size": run.reading["step size"], **run.without("step size")}, text, share > STAYS)


def for_good() -> Finding:
    mdp = grid()
    arrival = arrivals(mdp, initial_policy(mdp, UNIFORM), depths=[0], steps=[STEP], limit=PATIENCE)[0, STEP]
    text = (
        f"it never arrives at J* within {PATIENCE} iterations"
        if arrival is None
        else f"in iteration {arrival} it arrives at J*"
    )
    return Finding({}, text, arrival is None)


def local_optimum(run: Run) -> Finding:
    """By slips every state is visited, and there only optimal policies are stationary; here is the gap itself."""
    batch, after = Batch(run.mdp), cells([(0, STEP)], initial_policy(run.mdp, UNIFORM))
    for _ in range(len(run.traces[0].J_K) - 1):
        _, after = batch.advance(after)
    gap, visited = float(stationary.gap(run.mdp, after.pi_BSA[0], 0).max()), exact.support(run.mdp, after.pi_BSA[0])
    text = f"it visits {int(visited.sum())} of {len(visited)} states, and its largest gap g_0 there is {gap:.3g}, not 0"
    return Finding({}, text, gap <= stationary.TOLERANCE)


def reaches(run: Run, m: int) -> Finding:
    return Finding(
        {**run.without("step size"), "m": m}, arrivals_text({m: run.traces[m]}), run.traces[m].arrival is not None
    )


def traps_before_goal(run: Run, m: int) -> Finding:
    avoided = _avoids(run.traces[m])
    d_K, optimum = run.traces[m].watched["goal"], exact.optimal(run.mdp)
    goal = first(d_K >= REACHES * exact.occupancy(run.mdp, optimum.pi_SA)[-1])
    text = f"traps avoided in iteration {avoided}, goal found in iteration {goal} (m = {m})"
    return Finding(
        {**run.without("step size"), "m": m}, text, avoided is not None and goal is not None and avoided < goal
    )


def _avoids(trace: Trace) -> int | None:
    d_K = trace.watched["traps"]
    return first(d_K <= AVOIDS * d_K[0])


FIGURE = Figure(
    name="grid",
    title="Figure 4: Grid",
    env_id="pgts/Grid-v0",
    make=grid,
    depths=DEPTHS,
    moves={"projected": Move(UNIFORM, STEP), "softmax": Move(UNIFORM, 1.0)},
    iterations={"s0": 160, "uniform": 60},
    sampled_iterations={"s0": 120, "uniform": 40},
    sampled_depths=(0, 1, 4, 8, 18),
    quick_depths=(18,),
    gamma=GAMMA,
    num_envs=64,
    parameters=[
        Parameter("grid, goal, rewards, slip probability", "10 x 10, s99, +10 and -10, 0.01", "paper, Ex. 4"),
        Parameter(
            "traps", "s12 and s32 (also s11 and s32)", "paper: s12 and s32 in the text, s11 and s32 in the drawing"
        ),
        Parameter("a random one-step transition", "in one of 4 directions (also of the 3 others)", "not stated"),
        Parameter("goal and traps", "ordinary states, paid in each step (also ending the episode)", "not stated"),
        Parameter("a step into the wall", "stays", "not stated"),
        Parameter("start", "s0, or uniform", "paper, Sec. 3"),
        Parameter("initial policy", "uniform", "paper, Ex. 4"),
        Parameter("gamma", "0.9", "not stated"),
        Parameter("step size, projected", "0.1 (PG also 1, 10)", "paper, Sec. 3"),
        Parameter("step size, softmax", "1", "ours"),
        Parameter("iterations", "160 from s0, 60 from a uniform start; 120 and 40 from samples", "not stated"),
    ],
    claims=claims,
)
