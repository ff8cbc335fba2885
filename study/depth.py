"""Does depth speed convergence? Iterations to arrive over depth, step size and start; and an MDP where depth slows."""

import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from pgts_torch.agent.build import Description
from pgts_torch.tabular import TabularMDP, exact, grid, ladder, mirage, random_mdp, tightrope
from study.claims import Claim, Finding, judge
from study.curves import ARRIVED, STARTS, arrivals, first, initial_policy, trace
from study.figure import Effort, Parameter, Report
from study.ladder import ALWAYS_LEFT
from study.random_mdp import UNIFORM

LEFT, RIGHT = 0, 1
DEPTHS = (0, 1, 2, 3, 4, 5)
MIRAGE_DEPTHS = (0, 1, 2, 5, 10, 20, 50)
MIRAGE_STEP = 0.03
MIRAGE_ITERATIONS = 150
INFINITE_DEPTH, INFINITE_STEP = 300, 1e6
"""Stand for infinity: 0.9^300 is 2e-14."""


@dataclass(frozen=True)
class Family:
    """MDPs that share a map: the median over `seeds` of them, or a single one."""

    name: str
    make: Callable[..., TabularMDP]
    init: Description
    depths: Sequence[int] = DEPTHS
    random: bool = False


def _garnet(reward_share: float) -> Callable[..., TabularMDP]:
    def make(*, seed: int, start: int | None) -> TabularMDP:
        return random_mdp(10, branching=2, reward_share=reward_share, seed=seed, start=start)

    return make


FAMILIES = (
    Family("Ladder", ladder, ALWAYS_LEFT),
    Family("Tightrope", tightrope, ALWAYS_LEFT),
    Family("Random", random_mdp, UNIFORM),
    Family("Grid", grid, UNIFORM, depths=(0, 1, 2, 3, 4, 5, 8, 18)),
    Family("Dense Garnet", _garnet(1.0), UNIFORM, random=True),
    Family("Sparse Garnet", _garnet(0.05), UNIFORM, random=True),
)


@dataclass(frozen=True)
class Scale:
    """How much is tried. grid_limit: the Grid costs most and gets fewer iterations."""

    steps: Sequence[float]
    limit: int
    grid_limit: int
    seeds: int


FULL = Scale((0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0), 1000, 400, 15)
QUICK = Scale((0.01, 0.1, 1.0, 10.0), 200, 100, 3)


@dataclass(frozen=True)
class Map:
    """Iterations to arrive, for each depth (rows) and step size (columns); None: not within the limit."""

    mdp: str
    start: str
    depths: Sequence[int]
    steps: Sequence[float]
    iterations: list[list[float | None]]
    limit: int

    def against_pg(self) -> tuple[int, int, int]:
        """In how many cells with m >= 1 that depth is faster than, as fast as, and slower than m = 0."""
        pairs = [
            (_or_infinite(row[column]), _or_infinite(self.iterations[0][column]))
            for row in self.iterations[1:]
            for column in range(len(self.steps))
        ]
        return sum(a < b for a, b in pairs), sum(a == b for a, b in pairs), sum(a > b for a, b in pairs)


def compute(effort: Effort, report: Report) -> dict[str, Any]:
    """The plain data of the part: maps, the mirage, and checked statements."""
    scale = QUICK if effort.quick else FULL
    maps = []
    for family in FAMILIES:
        report(f"depth: {family.name}")
        maps += [_map(family, start, scale) for start in STARTS]
    mirage_data = _mirage()
    return {
        "part": "depth",
        "title": "Does depth speed convergence?",
        "quick": effort.quick,
        "parameters": [asdict(parameter) for parameter in _parameters(scale)],
        "maps": [asdict(one) | dict(zip(("faster", "equal", "slower"), one.against_pg(), strict=True)) for one in maps],
        "mirage": mirage_data,
        "tightrope_advantage": _tightrope_advantage(),
        "claims": [claim.plain() for claim in _claims(maps, mirage_data)],
    }


def _map(family: Family, start: str, scale: Scale) -> Map:
    limit = scale.grid_limit if family.name == "Grid" else scale.limit
    found = []
    for kwargs in [{"seed": seed} for seed in range(scale.seeds)] if family.random else [{}]:
        mdp = family.make(start=STARTS[start], **kwargs)
        pi_SA = initial_policy(mdp, family.init)
        if exact.optimal(mdp).J - exact.evaluate(mdp, pi_SA).J > 1e-9:  # else there is nowhere to go
            found.append(arrivals(mdp, pi_SA, depths=family.depths, steps=scale.steps, limit=limit))
    iterations = [[median([one[m, step] for one in found]) for step in scale.steps] for m in family.depths]
    return Map(family.name, start, family.depths, scale.steps, iterations, limit)


def median(arrived: Sequence[int | None]) -> float | None:
    """The median; None if that run did not arrive."""
    middle = statistics.median(map(_or_infinite, arrived))
    return None if middle == float("inf") else middle


def _or_infinite(arrived: float | None) -> float:
    return float("inf") if arrived is None else arrived


def _mirage() -> dict[str, Any]:
    """Curves from 'always left' and the advantage of 'right' in state 0, as it is and as the formula says."""
    mdp = mirage()
    pi_SA = initial_policy(mdp, ALWAYS_LEFT)
    traces = trace(mdp, pi_SA, depths=MIRAGE_DEPTHS, steps=[MIRAGE_STEP], iterations=MIRAGE_ITERATIONS)
    q_SA, gamma, delta = exact.evaluate(mdp, pi_SA).q_SA, 0.9, 0.05
    return {
        "step_size": MIRAGE_STEP,
        "J_optimal": exact.optimal(mdp).J,
        "exact": {str(m): [float(f"{J:.6g}") for J in traces[m, MIRAGE_STEP].J_K.tolist()] for m in MIRAGE_DEPTHS},
        "arrival": {str(m): traces[m, MIRAGE_STEP].arrival for m in MIRAGE_DEPTHS},
        "advantage": {str(m): _advantage(mdp, q_SA, m) for m in MIRAGE_DEPTHS},
        "formula": {str(m): gamma / (1 - gamma) * (1 - (1 - delta) * (1 - gamma**m)) for m in MIRAGE_DEPTHS},
    }


def _tightrope_advantage() -> dict[str, float]:
    """(T^m Q)(s0, right) - (T^m Q)(s0, left) of the policy that is right in s1 and still left in s0."""
    mdp = tightrope()
    pi_SA = initial_policy(mdp, ALWAYS_LEFT)
    pi_SA[1] = torch.tensor([0.0, 1.0])
    q_SA = exact.evaluate(mdp, pi_SA).q_SA
    return {str(m): _advantage(mdp, q_SA, m) for m in DEPTHS}


def _advantage(mdp: TabularMDP, q_SA: torch.Tensor, m: int) -> float:
    look_SA = exact.lookahead(mdp, q_SA, m)
    return float(look_SA[0, RIGHT] - look_SA[0, LEFT])


def _claims(maps: Sequence[Map], mirage_data: Mapping[str, Any]) -> list[Claim]:
    return [
        judge("Depth m >= 1 converges in fewer iterations than PG", "Sec. 1; Sec. 4, question 2", map(faster, maps)),
        judge("More depth never takes more iterations", "Sec. 4, question 2", [never_slower(mirage_data)]),
        judge("With infinite depth and step size, S iterations suffice", "Sec. 4, question 2", in_S_iterations()),
    ]


def faster(one: Map) -> Finding:
    faster, equal, slower = one.against_pg()
    text = f"{one.mdp} from {one.start}: faster in {faster}, equal in {equal}, slower in {slower} cells"
    return Finding({"MDP": one.mdp, "start": one.start}, text, faster > 0 and slower == 0)


def never_slower(data: Mapping[str, Any]) -> Finding:
    arrived = {m: _or_infinite(k) for m, k in data["arrival"].items()}
    text = "on the mirage MDP, arrival (iteration): " + ", ".join(
        f"{k} for m = {m}" for m, k in arrived.items() if m in ("0", "5", "50")
    )
    times = list(arrived.values())
    return Finding({}, text, all(late <= early for early, late in itertools.pairwise(times)))


def in_S_iterations() -> list[Finding]:
    found = []
    for family in FAMILIES:
        if family.random:
            continue
        for start in STARTS:
            mdp = family.make(start=STARTS[start])
            pi_SA, setting = initial_policy(mdp, family.init), (INFINITE_DEPTH, INFINITE_STEP)
            run = trace(mdp, pi_SA, depths=setting[:1], steps=setting[1:], iterations=mdp.num_states)[setting]
            k = first(run.J_K >= run.J_optimal - 1e-6 * max(1.0, abs(run.J_optimal)))
            text = f"{family.name}: J* reached in iteration {'never' if k is None else k}, S = {mdp.num_states}"
            found.append(Finding({"MDP": family.name, "start": start}, text, k is not None))
    return found


def _parameters(scale: Scale) -> list[Parameter]:
    return [
        Parameter("arrival", f"J^pi_0 + {ARRIVED:.0%} of J* - J^pi_0", "ours"),
        Parameter("update", "projected, exact quantities", "paper, Alg. 1"),
        Parameter("initial policies", "always left on Ladder, Tightrope and mirage; else uniform", "as in the figures"),
        Parameter("step sizes", ", ".join(f"{step:g}" for step in scale.steps), "ours"),
        Parameter("limit", f"{scale.limit} iterations, Grid {scale.grid_limit}", "ours"),
        Parameter(
            "Garnets",
            f"{scale.seeds} MDPs of 10 states, 2 actions, 2 successors, with all rewards (dense) or 1 in 20 (sparse); "
            "median; those in which the initial policy is optimal are left out",
            "ours",
        ),
        Parameter("mirage", f"width 10, delta 0.05, gamma 0.9, from s0, step size {MIRAGE_STEP}", "ours"),
    ]
