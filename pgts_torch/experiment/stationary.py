"""The data and the text behind `pgts stationary`: how many policies are in Pi^m, and how low their returns are."""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import TabularMDP, deep_sea, grid, ladder, random_mdp, stationary, stationary_sets, tightrope
from pgts_torch.tabular.mdp import start_distribution
from pgts_torch.tabular.stationary_sets import NEVER

ALL_ROWS = 30
"""Tables of more depths than this leave out depths at which Pi^m does not change."""

BAR = 40
"""The length of the longest bar in characters."""


@dataclass(frozen=True)
class DepthRow:
    """The stationary set Pi^m for m = depth.

    count: |Pi^m| among the deterministic policies.   worst_return: b^m, the lowest return in Pi^m.   lack: J* - b^m.
    value_bound, reachable_bound, closed_form_bound: upper bounds on J* - b^m that are computed without Pi^m
    (docs/theory.md, Prop. 3 and Cor. 1); infinite where they do not apply.
    """

    depth: int
    count: int
    worst_return: float
    lack: float
    value_bound: float
    reachable_bound: float
    closed_form_bound: float


@dataclass(frozen=True)
class Counts:
    """The sizes and lowest returns of the stationary sets of an MDP.

    escape_depths: by depth m, the number of policies that are in Pi^(m-1) and not in Pi^m; `NEVER`: the optimal ones.
    sufficient_depth: the smallest M with Pi^M = Pi^inf.
    depths: a row for each depth 0 .. M.
    """

    num_states: int
    num_actions: int
    num_policies: int
    J_optimal: float
    sufficient_depth: int
    escape_depths: dict[int, int]
    depths: tuple[DepthRow, ...]


def answer(what: str, **options: Any) -> Counts:
    """Return the counts of the MDP that `make` builds from the same arguments, on one thread."""
    torch.set_num_threads(1)
    return count_policies(make(what, **options))


def make(what: str, **options: Any) -> TabularMDP:
    """Build the MDP that the arguments of `pgts stationary` name.

    Args:
        what: ladder, tightrope, random, grid, deep_sea, or the path of a file that `TabularMDP.load_npz` reads.

    Raises:
        PgtsError: it has too many policies to enumerate, or an option or the file is wrong.
    """
    if options.get("start") == "uniform":
        options["start"] = None
    if what == "ladder":
        return ladder(_size(options, 5, 2, lambda n: n), **options)
    if what == "tightrope":
        return tightrope(**options)
    if what == "random":
        size = options.pop("states", 10), options.pop("actions", 2)
        stationary_sets.check_enumerable(*size)
        return random_mdp(*size, seed=options.pop("mdp_seed", 0), **options)
    if what == "grid":
        return grid(_size(options, 3, 4, lambda n: n * n), traps=options.pop("traps", ()), **options)
    if what == "deep_sea":
        return deep_sea(_size(options, 3, 2, lambda n: n * n), **options)
    mdp = TabularMDP.load_npz(what)
    return replace(mdp, start_S=start_distribution(options["start"], mdp.num_states)) if "start" in options else mdp


def count_policies(mdp: TabularMDP) -> Counts:
    """Enumerate the deterministic policies, and compute b^m and its bounds for each depth 0 .. M.

    Raises:
        PgtsError: there are too many policies, or the values of one are not finite.
    """
    sets = stationary_sets.enumerate_sets(mdp)
    M, worst_SA = sets.sufficient_depth, stationary.worst_policy(mdp)

    def row(depth: int) -> DepthRow:
        worst = sets.worst_return(depth)
        return DepthRow(
            depth,
            sets.count(depth),
            worst,
            sets.J_optimal - worst if depth < M else 0.0,
            stationary.worst_case_bound(mdp, worst_SA, depth),
            stationary.reachable_bound(mdp, depth),
            stationary.closed_form_bound(mdp, depth),
        )

    rows = tuple(row(depth) for depth in range(M + 1))
    return Counts(mdp.num_states, mdp.num_actions, len(sets.J_P), sets.J_optimal, M, sets.histogram, rows)


def to_json(counts: Counts) -> dict[str, Any]:
    """Return the counts as JSON values: infinite bounds are null, the escape depth of optimal policies is "never"."""
    answer = asdict(counts)
    answer["escape_depths"] = {_depth_name(depth): count for depth, count in counts.escape_depths.items()}
    for row in answer["depths"]:
        row |= {name: None for name, value in row.items() if value == math.inf}
    return answer


def describe(counts: Counts) -> str:
    """Return the counts as tables within 80 columns."""
    return "\n".join(_lines(counts))


def _size(options: dict[str, Any], default: int, num_actions: int, num_states: Callable[[int], int]) -> int:
    """Return the option n; PgtsError, with the largest n that is possible, if there are too many policies."""
    n = options.pop("n", default)
    try:
        stationary_sets.check_enumerable(num_states(n), num_actions)
    except PgtsError as error:
        fit = max(k for k in range(1, 21) if num_actions ** num_states(k) <= stationary_sets.MAX_POLICIES)
        raise PgtsError(f"--n {n} gives {error}, as --n {fit} does") from None
    return n


def _lines(counts: Counts) -> Iterator[str]:
    yield f"{counts.num_states} states, {counts.num_actions} actions, {counts.num_policies:,} deterministic policies"
    yield f"J* = {counts.J_optimal:.8g}"
    yield f"sufficient depth M = {counts.sufficient_depth}: all policies in Pi^{counts.sufficient_depth} are optimal"
    yield ""
    yield "depth     |Pi^m|        b^m   J* - b^m   by values    by reach  closed form"
    is_short = len(counts.depths) <= ALL_ROWS
    shown = [row for row in counts.depths if is_short or row.depth == 0 or row.depth in counts.escape_depths]
    for row in shown:
        bounds = (row.value_bound, row.reachable_bound, row.closed_form_bound)
        value, reach, closed = ("none" if math.isinf(bound) else f"{bound:.5g}" for bound in bounds)
        yield (
            f"{row.depth:>5}  {row.count:>9}  {row.worst_return:>9.5g}  {row.lack:>9.5g}  {value:>10}  {reach:>10}  "
            f"{closed:>11}"
        )
    if len(shown) < len(counts.depths):
        yield "Depths at which |Pi^m| stays the same are left out."
    yield from (
        "",
        "b^m is the least return of a policy in Pi^m. What bounds J* - b^m:",
        "  by values    Prop. 3, with the worst values of any policy",
        "  by reach     gamma and the rewards that m + 1 steps do not pass by",
        "  closed form  gamma and all rewards",
        "",
    )
    yield f"{'escapes at':>10}  {'policies':>9}"
    most = max(counts.escape_depths.values())
    for depth, count in sorted(counts.escape_depths.items(), key=lambda item: (item[0] == NEVER, item[0])):
        yield f"{_depth_name(depth):>10}  {count:>9}  {'#' * math.ceil(BAR * count / most)}"


def _depth_name(depth: int) -> str:
    return "never" if depth == NEVER else str(depth)
