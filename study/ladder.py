"""Figure 1 of the paper: the Ladder MDP."""

import itertools

import torch

from pgts_torch.tabular import exact, ladder
from study.claims import Claim, Finding, judge
from study.curves import first, initial_policy
from study.families import diameter
from study.figure import Figure, Move, Parameter
from study.readings import Run, arrivals_text, exact_runs, from_start

ALWAYS_LEFT = {"type": "biased", "action": 0, "probability": 1.0}
NEARLY_ALWAYS_LEFT = {"type": "biased", "action": 0, "probability": 0.99}
DEPTHS = (0, 1, 2, 3, 4, 5)
STEPS = (0.1, 0.01, 1.0, 10.0)
SLOW = 0.1
"""Initial progress is what it takes to make this share of the way."""

DISCOUNTS = (0.9, 0.99)


def claims(quick: bool) -> list[Claim]:
    """What the paper says of this figure, held to exact runs."""
    runs = exact_runs(
        ladder,
        [({"gamma": gamma}, {"gamma": gamma}) for gamma in DISCOUNTS],
        init=ALWAYS_LEFT,
        depths=DEPTHS,
        steps=STEPS[:2] if quick else STEPS,
        iterations=600,
    )
    from_s0, spread = from_start(runs, "s0"), from_start(runs, "uniform")
    return [
        judge("From s0, PG and PGTS are stuck up to depth 3", "Fig. 1, caption", map(stuck_below_4, from_s0)),
        judge("From s0, depth 4 is needed for global convergence", "Sec. 3", map(arrives_from_4_on, from_s0)),
        judge("The gradient at pi_0 (always left) is 0", "Sec. 3", [gradient()]),
        judge("pi_0 is a local maximum of J", "Sec. 3", [local_maximum()]),
        judge("With a uniform start, PG finds the optimum", "Sec. 3", map(pg_arrives, spread)),
        judge("With a uniform start, PG starts slowly beside depth 4", "Sec. 3", map(slow_at_first, spread)),
        judge("With a uniform start, every m >= 1 beats PG", "Sec. 3", map(every_depth_beats_pg, spread)),
        judge("With a uniform start, each level up to m = 4 is faster", "Sec. 3", map(each_level_is_faster, spread)),
        judge("From s0, m = 5 is no faster than m = 4", "Sec. 3", map(no_gain_above_4, from_s0)),
        judge("With a uniform start, m = 5 is no faster than m = 4", "Sec. 3", map(no_gain_above_4, spread)),
        judge("The diameter of the Ladder is 4", "Sec. 3", [diameter_is_4()]),
        judge("Epsilon-greedy takes time exponential in S", "Sec. 3", [exploration_time()]),
    ]


def stuck_below_4(run: Run) -> Finding:
    moved = max(float((run.traces[m].J_K - run.traces[m].J_K[0]).abs().max()) for m in range(4))
    return Finding(run.reading, f"J moves by at most {moved:.2g}", all(run.traces[m].is_stuck for m in range(4)))


def arrives_from_4_on(run: Run) -> Finding:
    holds = all((trace.arrival is not None) == (m >= 4) for m, trace in run.traces.items())
    return Finding(run.reading, arrivals_text(run.traces), holds)


def gradient() -> Finding:
    mdp = ladder()
    evaluation = exact.evaluate(mdp, initial_policy(mdp, ALWAYS_LEFT))
    largest = float((evaluation.d_S[:, None] * evaluation.q_SA).abs().max())
    return Finding({}, f"largest |dJ/dpi| is {largest:.2g}", largest == 0)


def local_maximum() -> Finding:
    """Policies near pi_0: 'right' with a small probability everywhere."""
    mdp, near = ladder(), (0.1, 0.01, 0.001)
    J = [exact.evaluate(mdp, initial_policy(mdp, ALWAYS_LEFT | {"probability": 1 - p})).J for p in near]
    nearby = ", ".join(f"{value:.1g} (p = {p})" for p, value in zip(near, J, strict=True))
    return Finding({}, f"J(pi_0) = 0, but 'right' with probability p everywhere gives {nearby}", max(J) <= 0)


def pg_arrives(run: Run) -> Finding:
    return Finding(run.reading, arrivals_text({0: run.traces[0]}), run.traces[0].arrival is not None)


def slow_at_first(run: Run) -> Finding:
    k = {m: first(run.traces[m].progress_K >= SLOW) for m in (0, 4)}
    assert k[0] is not None and k[4] is not None, "both arrive with a uniform start"  # noqa: PT018
    return Finding(run.reading, f"{SLOW:.0%} of the way after {k[0]} (m = 0), {k[4]} (m = 4)", k[0] > k[4])


def every_depth_beats_pg(run: Run) -> Finding:
    holds = all(run.traces[m].arrives_before(run.traces[0]) for m in DEPTHS[1:])
    return Finding(run.reading, arrivals_text(run.traces), holds)


def each_level_is_faster(run: Run) -> Finding:
    holds = all(run.traces[m].arrives_before(run.traces[m - 1]) for m in range(1, 5))
    return Finding(run.reading, arrivals_text({m: run.traces[m] for m in range(5)}), holds)


def no_gain_above_4(run: Run) -> Finding:
    pair = {m: run.traces[m] for m in (4, 5)}
    return Finding(run.reading, arrivals_text(pair), not pair[5].arrives_before(pair[4]))


def diameter_is_4() -> Finding:
    found = diameter(ladder())
    return Finding({}, f"the longest shortest path takes {found} steps", found == 4)


def exploration_time() -> Finding:
    """Steps that 'left', but a random action with probability 0.1, needs on average from s0 to the top."""
    sizes, epsilon = range(3, 10), 0.1
    steps = []
    for n in sizes:
        up = initial_policy(ladder(n), ALWAYS_LEFT | {"probability": 1 - epsilon / 2})[0, 1]
        # h(s) = 1 + up h(s + 1) + (1 - up) h(s - 1), with h(top) = 0
        steps.append(float(hitting_times(n, float(up))[0]))
    ratios = [late / early for early, late in itertools.pairwise(steps)]
    text = f"mean time to the top grows by a factor {min(ratios):.3g} or more with each state"
    return Finding({}, text + f", to {steps[-1]:.2g} steps for S = {sizes[-1]}", min(ratios) > 2)


def hitting_times(n: int, up: float) -> torch.Tensor:
    below_top = torch.zeros(n - 1, n - 1, dtype=torch.float64)
    for s in range(n - 1):
        below_top[s, max(s - 1, 0)] += 1 - up
        if s + 1 < n - 1:
            below_top[s, s + 1] += up
    return torch.linalg.solve(torch.eye(n - 1, dtype=torch.float64) - below_top, torch.ones(n - 1).double())


FIGURE = Figure(
    name="ladder",
    title="Figure 1: Ladder",
    env_id="pgts/Ladder-v0",
    make=ladder,
    depths=DEPTHS,
    moves={"projected": Move(ALWAYS_LEFT, STEPS[0]), "softmax": Move(NEARLY_ALWAYS_LEFT, 10.0)},
    iterations={"s0": 30, "uniform": 60},
    sampled_iterations={"s0": 30, "uniform": 60},
    sampled_depths=DEPTHS,
    quick_depths=(0, 4),
    parameters=[
        Parameter("states, actions, rewards", "as drawn", "paper, Ex. 1"),
        Parameter("start", "s0, or uniform", "paper, Sec. 3"),
        Parameter("initial policy", "always left", "paper, Ex. 1"),
        Parameter("initial policy, softmax", "left with probability 0.99", "ours: a softmax policy has no zeros"),
        Parameter("gamma", "0.9 (also 0.99)", "not stated"),
        Parameter("step size, projected", "0.1 (also 0.01, 1, 10)", "not stated"),
        Parameter("step size, softmax", "10", "ours"),
        Parameter("iterations", "30 from s0, 60 from a uniform start", "not stated"),
    ],
    claims=claims,
)
