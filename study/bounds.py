"""What a policy lacks, and the bound on it that a run could state, over a training and over the depth.

The bounds are those of docs/theory.md: Prop. 12, with the true values behind the horizon and with what the range of
rewards says of them, and Prop. 13, with errors of critic, baseline and model.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.build import Description
from pgts_torch.bellman import sweep
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, ascent, exact, grid, ladder, random_mdp, stationary, tightrope
from study.curves import initial_policy
from study.figure import Effort, Parameter, Report
from study.ladder import ALWAYS_LEFT
from study.random_mdp import UNIFORM

DEPTHS = (*range(17), 20, 24, 28, 32, 40, 48, 56, 64)
SHOWN = (0, 4, 16, 64)
CRITIC, BASELINE, MODEL = 0.05, 0.01, 0.001
"""By how much the values of the leaves, those of the start states and a step of the model are off: in units of the
range of values, of which the largest return is one end, and of rewards."""


@dataclass(frozen=True)
class Setting:
    """A training whose policies are bounded, by projected updates at a depth m."""

    name: str
    mdp: TabularMDP
    init: Description
    depth: int
    step_size: float
    iterations: Sequence[int]


@dataclass(frozen=True)
class Bounds:
    """Bounds on J* - J of one policy for each depth: true, with the true values behind the horizon; known, with the
    range of values instead; measured, with that and with errors."""

    iteration: int
    lacks: float
    true: list[float]
    known: list[float]
    measured: list[float]


def settings(*, quick: bool) -> tuple[Setting, ...]:
    short, long = (0, 5, 20), (0, 1, 2, 3, 5, 8, 12, 18, 25, 35, 50, 70, 100, 140)
    iterations = short if quick else long
    return (
        Setting("Ladder", ladder(), ALWAYS_LEFT, 4, 0.1, iterations),
        Setting("Tightrope", tightrope(), ALWAYS_LEFT, 1, 0.1, iterations),
        Setting("Random", random_mdp(), UNIFORM, 4, 0.3, iterations),
        Setting("Grid", grid(), UNIFORM, 4, 0.1, iterations),
    )


def compute(effort: Effort, report: Report) -> dict[str, Any]:
    """The plain data of the part."""
    found = {}
    for setting in settings(quick=effort.quick):
        report(f"bounds: {setting.name}")
        rows = trained(setting)
        last = rows[-1]
        best = {name: DEPTHS[_least(getattr(last, name))] for name in ("true", "known", "measured")}
        found[setting.name] = {"rows": [asdict(row) for row in rows], "best": best, "training_depth": setting.depth}
    return {
        "part": "bounds",
        "title": "What is lacking, and what a run can say of it",
        "quick": effort.quick,
        "depths": list(DEPTHS),
        "shown": list(SHOWN),
        "mdps": found,
        "parameters": [asdict(parameter) for parameter in _parameters()],
        "claims": [],
    }


def trained(setting: Setting) -> list[Bounds]:
    """The bounds of the policies after some iterations."""
    mdp, rows, before = setting.mdp, [], 0
    pi_SA = initial_policy(mdp, setting.init)
    for k in setting.iterations:
        ascended = ascent.ascend(mdp, pi_SA, depth=setting.depth, step_size=setting.step_size, iterations=k - before)
        pi_SA, before = ascended.pi_SA, k
        rows.append(bounded(mdp, pi_SA, k))
    return rows


def bounded(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], iteration: int) -> Bounds:
    """The bounds of a policy at all depths."""
    v_S, optimum = exact.policy_values(mdp, pi_SA), exact.optimal(mdp)
    lack_S = (optimum.v_S - v_S).clamp(min=0)
    return Bounds(
        iteration,
        max(optimum.J - float(mdp.start_S @ v_S), 0.0),
        [stationary.gap_bound(mdp, pi_SA, m, lack_S=lack_S) for m in DEPTHS],
        [stationary.gap_bound(mdp, pi_SA, m) for m in DEPTHS],
        [measured(mdp, v_S, m) for m in DEPTHS],
    )


def measured(mdp: TabularMDP, v_S: Float[Tensor, "S"], depth: int) -> float:
    """mu^T (V' - v' + e_v + E) by a lookahead in a wrong model, from a wrong critic, beside a wrong baseline."""
    w, reward_SA = stationary.highest_value(mdp.outcomes), mdp.outcomes.reward_NA
    scale, step = w - stationary.lowest_value(mdp.outcomes), MODEL * float(reward_SA.max() - reward_SA.min())
    random = numpy_stream(0, "bounds")
    leaf_S, baseline_S = (
        v_S + size * scale * torch.from_numpy(random.choice([-1.0, 1.0], len(v_S))) for size in (CRITIC, BASELINE)
    )
    off_SA = step * torch.from_numpy(random.choice([-1.0, 1.0], reward_SA.shape))
    wrong = replace(mdp.outcomes, reward_NA=reward_SA + off_SA)
    errors = replace(mdp.outcomes, reward_NA=torch.full_like(reward_SA, step))
    seen_S = sweep(wrong, leaf_S, depth + 1) - baseline_S + BASELINE * scale
    return float(mdp.start_S @ (seen_S + sweep(errors, (w - leaf_S).clamp(min=0), depth + 1)))


def _least(bounds: Sequence[float]) -> int:
    """The first place of the least bound, up to rounding."""
    least = min(bounds)
    return next(n for n, bound in enumerate(bounds) if bound <= least + 1e-9 * max(1.0, math.fabs(least)))


def _parameters() -> list[Parameter]:
    return [
        Parameter(
            "start, initial policies", "s0; always left on Ladder and Tightrope, else uniform", "as in the figures"
        ),
        Parameter("trainings", "projected, exact; depth 4 (Tightrope 1), step size 0.1 (Random 0.3)", "ours"),
        Parameter("critic and baseline", f"off by {CRITIC:g} and {BASELINE:g} of the range of values", "ours"),
        Parameter("model", f"each reward off by {MODEL:g} of the range of rewards", "ours"),
    ]
