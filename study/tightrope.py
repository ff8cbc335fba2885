"""Figure 3 of the paper: the Tightrope MDP."""

from itertools import starmap

from torch import Tensor

from pgts_torch.tabular import TabularMDP, exact, tightrope
from pgts_torch.tabular.forms import Start
from study.batch import Iterate
from study.claims import Claim, Finding, judge
from study.curves import first, initial_policy
from study.figure import Figure, Move, Parameter
from study.ladder import ALWAYS_LEFT, NEARLY_ALWAYS_LEFT
from study.readings import Run, Variants, arrivals_text, deeper, exact_runs, from_start

DEPTHS = (0, 1, 2, 3, 4, 5)
STEPS = (0.01, 0.1, 1.0)
RIGHT = 1
LEDGE = 10 / 11
"""How often s1 must go right before going there is worth it: v(s1) > 0. It does not depend on gamma."""

VARIANTS: Variants = [
    ({"gamma": 0.9, "s2 and s3": "repeat their reward"}, {"gamma": 0.9}),
    ({"gamma": 0.99, "s2 and s3": "repeat their reward"}, {"gamma": 0.99}),
    ({"gamma": 0.9, "s2 and s3": "pay once and end"}, {"gamma": 0.9, "ends": True}),
]


def rope(*, gamma: float = 0.9, ends: bool = False, start: Start = 0) -> TabularMDP:
    """The Tightrope as drawn, or with s2 and s3 as terminal states in the usual sense: they pay once, then it ends."""
    if not ends:
        return tightrope(gamma=gamma, start=start)
    P = [
        [[(1.0, 0, 0.0, False)], [(1.0, 1, 0.0, False)]],
        [[(1.0, 3, 0.0, False)], [(1.0, 2, 0.0, False)]],
        [[(1.0, 2, 1.0, True)], [(1.0, 2, 1.0, True)]],
        [[(1.0, 3, -10.0, True)], [(1.0, 3, -10.0, True)]],
    ]
    return TabularMDP.from_transitions(P, gamma, start=start, action_names=("left", "right"))


def claims(quick: bool) -> list[Claim]:
    """What the paper says of this figure, held to exact runs."""
    runs = exact_runs(
        rope,
        VARIANTS,
        init=ALWAYS_LEFT,
        depths=DEPTHS,
        steps=STEPS[:2] if quick else STEPS,
        iterations=1500,
        watch=_watch,
    )
    from_s0, spread = from_start(runs, "s0"), from_start(runs, "uniform")
    return [
        judge("'Right' in every state is optimal", "Ex. 3", map(right_is_optimal, one_each(from_s0))),
        judge("From s0, PG does not improve and stays left", "Sec. 3", map(pg_is_stuck, from_s0)),
        judge("From s0, PGTS (m >= 1) finds the optimum", "Sec. 3", starmap(pgts_arrives, deeper(from_s0))),
        judge(
            "From s0, PGTS's return first falls, then recovers", "Sec. 3", starmap(falls_and_recovers, deeper(from_s0))
        ),
        judge(
            "Uniform start: PG stays left at s0 until s1 goes right often enough", "Sec. 3", map(waits_for_s1, spread)
        ),
        judge("Uniform start: a smaller step delays that", "Sec. 3", smaller_is_later(spread)),
        judge(
            "Uniform start: PGTS moves s0 to the right from the first iteration",
            "Sec. 3",
            starmap(moves_at_once, deeper(spread)),
        ),
        judge(
            "Uniform start: PGTS's return first falls, then recovers",
            "Sec. 3",
            starmap(falls_and_recovers, deeper(spread)),
        ),
        judge("Uniform start: PG's return is monotone", "Sec. 3", map(pg_is_monotone, spread)),
        judge("Uniform start: PGTS is optimal earlier than PG", "Sec. 3", starmap(earlier_than_pg, deeper(spread))),
    ]


def _watch(iterate: Iterate) -> dict[str, Tensor]:
    return {f"right at s{s}": iterate.pi_BSA[:, s, RIGHT] for s in (0, 1)}


def one_each(runs: list[Run]) -> list[Run]:
    """One run of each variant: for statements in which no step is taken."""
    step = runs[0].reading["step size"]
    return [run for run in runs if run.reading["step size"] == step]


def right_is_optimal(run: Run) -> Finding:
    J = exact.evaluate(run.mdp, initial_policy(run.mdp, ALWAYS_LEFT | {"action": RIGHT})).J
    J_optimal = run.traces[0].J_optimal
    return Finding(
        run.without("step size"),
        f"J = {J:.6g}, J* = {J_optimal:.6g}",
        abs(J - J_optimal) < 1e-9 * max(1, abs(J_optimal)),
    )


def pg_is_stuck(run: Run) -> Finding:
    right = float(run.traces[0].watched["right at s0"].max())
    text = f"J stays {float(run.traces[0].J_K[0]):.3g}, 'right' at s0 has probability {right:.2g}"
    return Finding(run.reading, text, run.traces[0].is_stuck and right == 0)


def pgts_arrives(run: Run, m: int) -> Finding:
    return Finding({**run.reading, "m": m}, arrivals_text({m: run.traces[m]}), run.traces[m].arrival is not None)


def falls_and_recovers(run: Run, m: int) -> Finding:
    J_K = run.traces[m].J_K
    text = f"J from {float(J_K[0]):.3g} down to {float(J_K.min()):.3g} and up to {float(J_K[-1]):.3g} (m = {m})"
    return Finding({**run.reading, "m": m}, text, run.traces[m].dips and run.traces[m].arrival is not None)


def waits_for_s1(run: Run) -> Finding:
    watched = run.traces[0].watched
    ledge, moved = first(watched["right at s1"] > LEDGE), first(watched["right at s0"] > 0)
    text = f"s1 passes {LEDGE:.3g} in iteration {ledge}, s0 starts to move in iteration {moved}"
    # The policy that moves in iteration k + 1 is the one that was evaluated in iteration k.
    return Finding(run.reading, text, ledge is not None and moved == ledge + 1)


def smaller_is_later(runs: list[Run]) -> list[Finding]:
    found = []
    for variant in one_each(runs):
        reading = variant.without("step size")
        same = [run for run in runs if reading.items() <= run.reading.items()]
        by_step = sorted(same, key=lambda run: float(run.reading["step size"]))
        passed = {run.reading["step size"]: first(run.traces[0].watched["right at s1"] > LEDGE) for run in by_step}
        text = "s1 passes 10/11 in iteration " + ", ".join(f"{k} (step {step})" for step, k in passed.items())
        times = [k for k in passed.values() if k is not None]
        holds = len(times) == len(passed) and times == sorted(times, reverse=True) and times[0] > times[-1]
        found.append(Finding(reading, text, holds))
    return found


def moves_at_once(run: Run, m: int) -> Finding:
    right = float(run.traces[m].watched["right at s0"][1])
    return Finding({**run.reading, "m": m}, f"pi_1(right|s0) = {right:.3g} (m = {m})", right > 0)


def pg_is_monotone(run: Run) -> Finding:
    pg = run.traces[0]
    return Finding(run.reading, f"largest fall in one iteration {pg.largest_fall:.2g}", pg.is_monotone)


def earlier_than_pg(run: Run, m: int) -> Finding:
    pair = {0: run.traces[0], m: run.traces[m]}
    return Finding({**run.reading, "m": m}, arrivals_text(pair), pair[m].arrives_before(pair[0]))


FIGURE = Figure(
    name="tightrope",
    title="Figure 3: Tightrope",
    env_id="pgts/Tightrope-v0",
    make=tightrope,
    depths=DEPTHS,
    moves={"projected": Move(ALWAYS_LEFT, STEPS[0]), "softmax": Move(NEARLY_ALWAYS_LEFT, 0.3)},
    iterations={"s0": 80, "uniform": 80},
    sampled_iterations={"s0": 60, "uniform": 60},
    sampled_depths=(0, 1, 2, 5),
    quick_depths=(1,),
    # A table learned from rollouts knows nothing of s2 and s3 before they are visited, which they never are from s0.
    critic={"type": "rollout", "samples": 2, "horizon": {"type": "fixed", "length": 40}},
    parameters=[
        Parameter("states, actions, rewards", "as drawn: s2 and s3 repeat their reward", "paper, Ex. 3"),
        Parameter(
            "s2 and s3",
            "also as states that pay once and end",
            "paper: terminal in the text, repeating their reward in the drawing",
        ),
        Parameter("start", "s0, or uniform", "paper, Sec. 3"),
        Parameter("initial policy", "always left", "paper, Ex. 3"),
        Parameter("initial policy, softmax", "left with probability 0.99", "ours: a softmax policy has no zeros"),
        Parameter("gamma", "0.9 (also 0.99)", "not stated"),
        Parameter("step size, projected", "0.01 (also 0.1, 1)", "not stated ('small')"),
        Parameter("step size, softmax", "0.3", "ours"),
        Parameter("iterations", "80, 60 from samples", "not stated"),
    ],
    claims=claims,
)
