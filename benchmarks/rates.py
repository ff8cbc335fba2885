"""How many iterations and samples it takes, beside what docs/rates.md proves.

    python benchmarks/rates.py [--quick] [--picture FILE]

Exact quantities: the first iterate with 99 % of the way from the initial return to J* behind it, from the MDPs and
initial policies of `python -m study --only depth`; Garnets have 10 states, 2 actions, 2 successors, and are the median
of 15. Samples: the sup-error of `search.sampled` that 5 % of 100 searches exceed, on Garnet(200,4,5) from 4 states.
"""

import argparse
import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from common import short
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from pgts_torch.models import TabularModel
from pgts_torch.search import sampled
from pgts_torch.search.empirical import Share
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, grid, ladder, mirage, random_mdp, rates, stationary_sets, tightrope
from pgts_torch.tabular.ascent import centred, floored, normalised, projected_step

DEPTHS, WAY, LIMIT, LARGE = (0, 1, 2, 4, 8, 16), 0.99, 400, 1e9
SHARES: tuple[Share, ...] = ("none", "level", "search")
MOST_CALLS = 1e5
SAMPLES, FAILURE = (1, 2, 4, 8, 16, 32, 64), 0.05


class Start(NamedTuple):
    """MDPs of one kind, and the policy that each begins with."""

    name: str
    mdps: Callable[[int | None], list[TabularMDP]]
    is_left: bool

    def policy(self, mdp: TabularMDP) -> Float[Tensor, "S A"]:
        shape = mdp.num_states, mdp.num_actions
        if self.is_left:
            return torch.eye(shape[1], dtype=torch.float64)[:1].repeat(shape[0], 1)
        return torch.full(shape, 1 / shape[1], dtype=torch.float64)


def _garnets(share: float, count: int = 15) -> Callable[[int | None], list[TabularMDP]]:
    return lambda start: [
        random_mdp(10, branching=2, reward_share=share, seed=seed, start=start) for seed in range(count)
    ]


STARTS = (
    Start("Ladder", lambda start: [ladder(start=start)], True),
    Start("Tightrope", lambda start: [tightrope(start=start)], True),
    Start("Random", lambda start: [random_mdp(start=start)], False),
    Start("Grid", lambda start: [grid(start=start)], False),
    Start("Dense Garnet", _garnets(1.0), False),
    Start("Sparse Garnet", _garnets(0.05), False),
)


def arrival(
    mdp: TabularMDP, pi_SA: Tensor, depth: int, step_size: float, *, everywhere: bool, limit: int = LIMIT
) -> int | None:
    """The first iteration with 99 % of the way behind it: projected steps with weight 1 in all states, or with d^pi in
    visited ones."""
    J_optimal, goal = exact.optimal(mdp).J, -math.inf
    for k in range(limit + 1):
        evaluation = exact.evaluate(mdp, pi_SA)
        goal = goal if k else evaluation.J + WAY * (J_optimal - evaluation.J)
        if evaluation.J >= goal - 1e-12 * abs(goal):
            return k
        moves_S = torch.ones(mdp.num_states, dtype=torch.bool) if everywhere else evaluation.d_S > 0
        weight_S = torch.ones_like(evaluation.d_S) if everywhere else evaluation.d_S
        look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
        pi_SA = pi_SA.clone()
        pi_SA[moves_S] = projected_step(pi_SA[moves_S], look_SA[moves_S], weight_S[moves_S], step_size)
    return None


def bound(mdp: TabularMDP, pi_SA: Tensor, depth: int) -> int:
    """By when Proposition 1 has 99 % of the way behind it, with weight 1 and large steps."""
    iterations = 400 // (depth + 1) + 1
    bound_K = rates.greedy_bound(mdp, pi_SA, depth, iterations)
    lack = exact.optimal(mdp).J - exact.evaluate(mdp, pi_SA).J
    return int((bound_K <= (1 - WAY) * lack + 1e-12).nonzero()[0])


def middle(counts: Sequence[int | None]) -> str:
    found = statistics.median_high([math.inf if k is None else k for k in counts])
    return "never" if math.isinf(found) else f"{found:.0f}"


def print_large_steps() -> None:
    print("Large steps from s0: iterations with weight 1 in all states (bound of Prop. 1), with d^pi in visited ones")
    print(f"{'':<15}" + "".join(f"{f'm = {m}':>20}" for m in DEPTHS))
    for start in STARTS:
        cells = []
        for m in DEPTHS:
            # Garnets whose initial policy is optimal are left out, as in the study.
            mdps = [
                mdp for mdp in start.mdps(0) if exact.optimal(mdp).J - exact.evaluate(mdp, start.policy(mdp)).J > 1e-9
            ]
            free = middle([arrival(mdp, start.policy(mdp), m, LARGE, everywhere=True) for mdp in mdps])
            most = middle([bound(mdp, start.policy(mdp), m) for mdp in mdps])
            visited = middle([arrival(mdp, start.policy(mdp), m, LARGE, everywhere=False, limit=50) for mdp in mdps])
            cells.append(f"{free} ({most}), {visited}")
        print(f"{start.name:<15}" + "".join(f"{cell:>20}" for cell in cells), flush=True)


def print_deep_enough() -> None:
    print("\nFinite steps at visited states, d^pi, from s0, two levels below the certain depth: iterations (Prop. 4)")
    print(f"{'':<15}{'sufficient':>12}{'certain':>9}" + "".join(f"{f'step {eta:g}':>18}" for eta in (1.0, 10.0, 100.0)))
    for start in STARTS[:4]:
        mdp = start.mdps(0)[0]
        pi_SA, certain = start.policy(mdp), rates.certain_depth(mdp)
        fits = mdp.num_actions**mdp.num_states <= stationary_sets.MAX_POLICIES
        enough = str(stationary_sets.enumerate_sets(mdp).sufficient_depth) if fits else "-"
        cells = []
        for eta in (1.0, 10.0, 100.0):
            most = rates.iteration_bound(mdp, pi_SA, depth=certain + 2, step_size=eta)
            found = arrival(mdp, pi_SA, certain + 2, eta, everywhere=False, limit=int(min(most, 1000)))
            cells.append(f"{'-' if found is None else found} ({short(most) if math.isfinite(most) else 'none'})")
        print(f"{start.name:<15}{enough:>12}{certain:>9}" + "".join(f"{cell:>18}" for cell in cells), flush=True)
    print("(bound); none: an optimal policy has a choice somewhere, so the bound does not apply")


def print_mirage() -> None:
    mdp, depths = mirage(), (0, 1, 2, 5, 10, 20, 50, 100)
    start = Start("mirage", lambda _: [mdp], True)
    pi_SA, best = start.policy(mdp), exact.optimal(mdp)
    q_SA, gap = exact.evaluate(mdp, pi_SA).q_SA, float(best.v_S[0] - best.q_SA[0, 0])
    print("\nWhere depth slows: mirage, state 0 (Prop. 5)")
    print(f"{'m':<34}" + "".join(f"{m:>8}" for m in depths))
    spreads = [float(exact.lookahead(mdp, q_SA, m)[0].diff().abs()) for m in depths]
    rows = {
        "spread of T^m Q": [f"{x:.3f}" for x in spreads],
        "spread at m = 0 by spread": [f"{spreads[0] / x:.1f}" for x in spreads],
        "projected, d^pi, step 0.03": [middle([arrival(mdp, pi_SA, m, 0.03, everywhere=False)]) for m in depths],
        "mirror as by default": [middle([_default_arrival(mdp, m)]) for m in depths],
    }
    for name, cells in rows.items():
        print(f"{name:<34}" + "".join(f"{cell:>8}" for cell in cells))
    print(f"No depth is slower than m = 0 by more than spread / action gap = {spreads[0] / gap:.1f} times.")


def _default_arrival(mdp: TabularMDP, depth: int) -> int | None:
    """Exact mirror steps of size 1 with weight 1 in units of the root mean square, from 99 % left."""
    pi_SA, J_optimal, goal = torch.full((mdp.num_states, mdp.num_actions), 0.01).double(), exact.optimal(mdp).J, 0.0
    pi_SA[:, 0] = 1 - 0.01 * (mdp.num_actions - 1)
    for k in range(LIMIT):
        evaluation = exact.evaluate(mdp, pi_SA)
        goal = goal if k else evaluation.J + WAY * (J_optimal - evaluation.J)
        if evaluation.J >= goal:
            return k
        advantage_SA = centred(exact.lookahead(mdp, evaluation.q_SA, depth), pi_SA)
        pi_SA = floored(pi_SA.log(), normalised(advantage_SA, pi_SA), 12.0).softmax(-1)
    return None


class Errors(NamedTuple):
    """Sup-errors that 5 % of the searches exceed, what is proved, and the calls; by C."""

    measured: list[float]
    proved: list[float]
    calls: list[float]


def sample_errors(depth: int, share: Share, searches: int) -> Errors:
    mdp = random_mdp(200, 4, branching=5)
    pi_SA = torch.full((200, 4), 0.25, dtype=torch.float64)
    evaluation, roots = exact.evaluate(mdp, pi_SA), [0, 50, 100, 150]
    truth_BA, model = exact.lookahead(mdp, evaluation.q_SA, depth)[roots], TabularModel(mdp)
    found = Errors([], [], [])
    for C in SAMPLES:
        proof = rates.sample_bound(mdp, evaluation.v_S, roots, depth=depth, samples=C, failure=FAILURE, share=share)
        if proof.model_calls > MOST_CALLS:
            break
        looks = [
            sampled(
                model,
                torch.tensor(roots),
                depth=depth,
                v_leaf=lambda state_N: evaluation.v_S[state_N],
                samples=C,
                share=share,
                generator=stream(seed, "rates"),
                replicates=0,
            )
            for seed in range(searches)
        ]
        off_R = torch.stack([(look.q_BA - truth_BA).abs().max() for look in looks])
        found.measured.append(float(off_R.quantile(1 - FAILURE)))
        found.proved.append(proof.error)
        found.calls.append(statistics.mean(look.model_calls for look in looks))
    return found


def print_samples(searches: int) -> dict[tuple[int, Share], Errors]:
    print("\nSup-error of sampled lookaheads that 5 % exceed (bound of Prop. 7), by C samples of each state and action")
    print(f"{'m':<4}{'share':<8}" + "".join(f"{f'C = {C}':>15}" for C in SAMPLES) + f"{'calls, C = 4':>14}")
    found = {}
    for depth in (0, 2, 4):
        for share in SHARES:
            one = found[depth, share] = sample_errors(depth, share, searches)
            cells = [f"{off:.3f} ({most:.2f})" for off, most in zip(one.measured, one.proved, strict=True)]
            cells += ["-"] * (len(SAMPLES) - len(cells))
            calls = short(one.calls[2]) if len(one.calls) > 2 else "-"
            print(f"{depth:<4}{share:<8}" + "".join(f"{cell:>15}" for cell in cells) + f"{calls:>14}", flush=True)
    return found


def picture(found: dict[tuple[int, Share], Errors]) -> Figure:
    """Error against model calls, measured and proved."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for panel, depth in zip(figure.subplots(1, 3, sharey=True), (0, 2, 4), strict=True):
        for k, share in enumerate(SHARES):
            one = found[depth, share]
            panel.plot(one.calls, one.measured, f"C{k}o-", markersize=3, label=f"{share}, measured")
            panel.plot(one.calls, one.proved, f"C{k}--", linewidth=1, label=f"{share}, proved")
        panel.set(xscale="log", yscale="log", xlabel="model calls, 4 roots", title=f"m = {depth}")
    figure.axes[0].set_ylabel("sup-error, exceeded by 5 %")
    figure.axes[0].legend(fontsize=7, loc="upper right")  # above the errors of m = 0 there is room
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="10 searches")
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    print_large_steps()
    print_deep_enough()
    print_mirage()
    found = print_samples(10 if given.quick else 100)
    if given.picture:
        picture(found).savefig(given.picture, dpi=120)


if __name__ == "__main__":
    main()
