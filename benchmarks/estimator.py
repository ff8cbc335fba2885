"""How right are root values after so many model calls, and after so much time?

    python benchmarks/estimator.py [--quick] [--device cpu] [--json PATH] [--picture PATH]

Every search estimates T^m Q^pi at the same 16 states (on DeepSea the 20 of the diagonal), v^pi of the uniform policy at
its leaves, with a growing budget: outcomes C sampled of each action, nodes W kept at each level, simulations. Budgets
end where a search is exact, took more than half a second or would have more than a million nodes. --quick: two depths,
no mctx.

error: mean of |q - T^m Q| over roots and actions, as a share of the range of T^m Q over them.
right: share of roots at which the action with the highest value has the highest T^m Q.
calls: model calls of a search from one root alone, the mean over every eighth. A call of ours is one (state,
    action) whose outcomes are enumerated, or one sampled outcome of it. A call of mctx is one simulation: one sampled
    outcome of one (state, action), the only one that this edge of its tree ever has.
ms: time of one search from all roots together, by the number of roots. No search knows anything from earlier ones.
unmerged: what enumerating all outcomes costs without merging, counted: a node for each path. Its values are exact.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from common import (
    MDPS,
    about,
    milliseconds,
    parser,
    sampled_roots,
    short,
    uniform_evaluation,
    unmerged_nodes,
    use_one_core,
    write,
)
from peers import POLICIES, mctx_searcher

from pgts_torch.errors import NodeBudgetExceeded
from pgts_torch.models import TabularModel
from pgts_torch.search import Lookahead, expectimax, mcts, sampled
from pgts_torch.search.empirical import Share
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact

DEPTHS = (2, 4, 8, 16)
ROOTS = 16
TREE, FULL_TREE = "sampled, none", "expectimax, unmerged"
SHARES: tuple[Share, ...] = ("none", "level", "search")
SAMPLES = (1, 2, 4, 8, 16, 64, 256)
WIDTHS = (4, 16, 64, 256)
SIMULATIONS = (16, 64, 256, 1024)
MAX_NODES = 1_000_000
TARGETS = (0.1, 0.01)
EXACT = 1e-5
"""Errors below this count as none: mctx computes in float32."""


@dataclass(frozen=True)
class Task:
    """T^m Q^pi at some states of an MDP."""

    mdp: TabularMDP
    model: TabularModel
    root_B: torch.Tensor
    v_S: torch.Tensor
    depth: int
    truth_BA: torch.Tensor

    @property
    def range(self) -> float:
        return float(self.truth_BA.max() - self.truth_BA.min())

    def score(self, q_BA: torch.Tensor) -> dict[str, float]:
        """The error, and the share of roots with a right first choice."""
        q_BA = q_BA.double().cpu()
        chosen_B = self.truth_BA.gather(1, q_BA.argmax(-1, keepdim=True)).squeeze(1)
        right_B = chosen_B >= self.truth_BA.amax(-1) - 1e-9 * self.range
        error = float((q_BA - self.truth_BA).abs().mean()) / self.range
        return {"error": error, "right": float(right_B.double().mean())}


def task(name: str, depth: int, device: str) -> Task:
    mdp = MDPS[name]()
    evaluation = uniform_evaluation(mdp)
    diagonal = name.startswith("DeepSea")
    root_B = torch.arange(mdp.shape[0]) * (mdp.shape[0] + 1) if diagonal else sampled_roots(mdp, ROOTS)
    truth_BA = exact.lookahead(mdp, evaluation.q_SA, depth)[root_B]
    model = TabularModel(mdp, device=device)
    return Task(mdp, model, root_B.to(device), evaluation.v_S.to(device), depth, truth_BA)


Search = Callable[[torch.Tensor], Lookahead]


def our_searches(task: Task) -> dict[str, Iterator[tuple[int, Search]]]:
    """Methods, each with its budgets in growing order and the search from given roots."""

    def leaf(state_N: torch.Tensor) -> torch.Tensor:
        return task.v_S[state_N]

    common: dict[str, Any] = {"depth": task.depth, "v_leaf": leaf, "max_nodes": MAX_NODES}

    def wide(root_B: torch.Tensor, budget: int | None) -> Lookahead:
        return expectimax(task.model, root_B, max_width=budget, **common)

    def from_samples(root_B: torch.Tensor, budget: int, share: Share) -> Lookahead:
        generator = stream(0, "estimator", budget)
        return sampled(task.model, root_B, samples=budget, share=share, generator=generator, replicates=0, **common)

    def grown(root_B: torch.Tensor, budget: int, merge: bool) -> Lookahead:
        generator = stream(0, "estimator", budget)
        return mcts(task.model, root_B, simulations=budget, merge=merge, generator=generator, **common)

    def budgets(search: Callable[..., Lookahead], values: Sequence[Any], **knobs: Any) -> Iterator[tuple[Any, Search]]:
        return ((value, partial(search, budget=value, **knobs)) for value in values)

    return {
        "expectimax": budgets(wide, (None,)),
        "expectimax, max_width": budgets(wide, WIDTHS),
        **{f"sampled, {share}": budgets(from_samples, SAMPLES, share=share) for share in SHARES},
        "mcts, tree": budgets(grown, SIMULATIONS, merge=False),
        "mcts, merged": budgets(grown, SIMULATIONS, merge=True),
    }


def measured(task: Task, seconds: float, peers: bool) -> dict[str, list[dict[str, Any]]]:
    """Error, calls and time of each method with each budget."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, budgets in our_searches(task).items():
        rows[name] = []
        for budget, search in budgets:
            try:
                rows[name].append({"budget": budget} | _ours(task, search))
            except NodeBudgetExceeded:
                break
            if rows[name][-1]["error"] < EXACT or rows[name][-1]["ms"] * len(task.root_B) > seconds * 1e3:
                break
    rows[FULL_TREE] = [_full_tree(task)]
    for policy in POLICIES if peers else ():
        rows[f"mctx, {policy}_muzero" if policy == "gumbel" else "mctx, muzero"] = list(_peer(task, policy))
    return {name: found for name, found in rows.items() if found or not name.startswith("mctx")}


def _ours(task: Task, search: Search) -> dict[str, Any]:
    begin = time.perf_counter()
    look = search(task.root_B)
    first = (time.perf_counter() - begin) * 1e3
    alone = [search(root_1).model_calls for root_1 in task.root_B[::8].split(1)]
    return task.score(look.q_BA) | {
        "calls": statistics.mean(alone),
        "calls_together": look.model_calls / len(task.root_B),
        "nodes": look.nodes,
        # A second run would tell little more of a long one.
        "ms": (first if first > 100 else milliseconds(lambda: search(task.root_B))) / len(task.root_B),
    }


def _full_tree(task: Task) -> dict[str, Any]:
    """What listing all outcomes of every path costs; v at the leaves asks for the outcomes of m + 1 levels."""
    nodes = [unmerged_nodes(task.mdp, int(root), task.depth) for root in task.root_B[::8]]
    return {
        "budget": None,
        "error": 0.0,
        "right": 1.0,
        "calls": task.mdp.num_actions * statistics.mean(nodes),
        "nodes": statistics.mean(nodes),
        "ms": None,
    }


def _peer(task: Task, policy: Any) -> Iterator[dict[str, Any]]:
    for simulations in SIMULATIONS:
        search = mctx_searcher(
            task.mdp, task.v_S, task.root_B, policy=policy, simulations=simulations, max_depth=task.depth + 1
        )
        if search is None:
            return
        score = task.score(search())  # which also compiles
        ms = milliseconds(search) / len(task.root_B)
        yield score | {"budget": simulations, "calls": simulations, "calls_together": simulations, "ms": ms}


def cheapest(rows: list[dict[str, Any]], error: float) -> dict[str, Any] | None:
    """The row with the fewest calls whose error is at most so large."""
    return min((row for row in rows if row["error"] <= error), key=lambda row: row["calls"], default=None)


def against_the_trees(methods: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Calls without merging by calls with it: outcomes enumerated, and sampled, at each error of the tree of samples.

    The sampled tree is compared with `expectimax` and with the cheapest of the searches that sample and merge.
    """
    full, tree = methods["expectimax"][0]["calls"], methods[FULL_TREE][0]["calls"]
    from_samples = []
    for row in methods[TREE]:
        error = max(row["error"], EXACT)
        rows = [found for share in SHARES[1:] if (found := cheapest(methods[f"sampled, {share}"], error))]
        merged = min((found["calls"] for found in rows), default=None)
        from_samples.append(
            {
                "error": row["error"],
                "tree_calls": row["calls"],
                "merged_calls": merged,
                "ratio": row["calls"] / merged if merged else None,
                "ratio_to_expectimax": row["calls"] / full,
            }
        )
    return {"expectimax_calls": full, "unmerged_calls": tree, "ratio": tree / full, "from_samples": from_samples}


# The bias of a maximum over samples


def sampling_bias(device: str, quick: bool) -> dict[str, Any]:
    """Bias, RMSE and coverage of the intervals of `sampled`, Garnet, m = 4, over roots, actions and searches."""
    at = task("Garnet(200,4,5)", 4, device)
    truth_BA = at.truth_BA[:4].to(device)
    rows, searches = [], 4 if quick else 16
    for share in SHARES:
        for C in (1, 2, 4, 8, 16, 32)[: 4 if quick else 6]:
            looks = []
            for seed in range(searches):
                try:
                    looks.append(
                        sampled(
                            at.model,
                            at.root_B[:4],
                            depth=4,
                            v_leaf=lambda state_N: at.v_S[state_N],
                            samples=C,
                            share=share,
                            generator=stream(seed, "bias"),
                            max_nodes=MAX_NODES,
                        )
                    )
                except NodeBudgetExceeded:
                    break
            if not looks:
                break
            rows.append({"share": share, "C": C} | _bias(looks, truth_BA))
    low, high = float(truth_BA.min()), float(truth_BA.max())
    return {"roots": len(truth_BA), "searches": searches, "low": low, "high": high, "rows": rows}


def _bias(looks: list[Lookahead], truth_BA: torch.Tensor) -> dict[str, Any]:
    off = torch.stack([look.q_BA - truth_BA for look in looks])
    stderr = torch.stack([look.stderr_BA for look in looks])
    bias = torch.stack([torch.zeros_like(look.q_BA) if look.bias_BA is None else look.bias_BA for look in looks])
    bounds = [look.interval() for look in looks]
    held = torch.stack([(low <= truth_BA) & (truth_BA <= high) for low, high in bounds])
    answer = {
        "calls": statistics.mean(look.model_calls for look in looks) / len(truth_BA),
        "bias": float(off.mean()),
        "rmse": float(off.square().mean().sqrt()),
    }
    if stderr.isnan().any():
        return answer
    return answer | {
        "bias_estimated": float(bias.mean()),
        "rmse_corrected": float((off - bias).square().mean().sqrt()),
        "stderr": float(stderr.square().mean().sqrt()),
        "coverage_uncorrected": float((off.abs() <= 1.96 * stderr).double().mean()),
        "coverage": float(held.double().mean()),
    }


# Output


def print_task(name: str, depths: dict[int, Any]) -> None:
    methods = list(next(iter(depths.values()))["methods"])
    head = f"{'':<22}" + "".join(f"{f'm = {m}':>19}" for m in depths)
    print(f"\n{name}: best error reached, calls per root, right decisions\n{head}")
    for method in methods:
        print(f"{method:<22}" + "".join(f"{_best(depths[m]['methods'].get(method)):>19}" for m in depths))
    for target in TARGETS:
        print(f"{name}: calls and ms per root to an error of {target:.0%}\n{head}")
        for method in methods:
            print(f"{method:<22}" + "".join(f"{_to(depths[m]['methods'].get(method), target):>19}" for m in depths))
    sys.stdout.flush()


def print_summary(report: dict[str, Any]) -> None:
    print("\nModel calls per root without merging, by those with it; the same error")
    print(f"{'':<17}{'':>3}{'outcomes enumerated: exact':>28}  {'outcomes sampled, to the error of the tree':>44}")
    columns = ("tree", "merged", "ratio", "error", "tree", "merged", "ratio", "exact")
    print(f"{'':<17}{'m':>3}" + "".join(f"{column:>{10 if k else 8}}" for k, column in enumerate(columns)))
    for name, depths in report["tasks"].items():
        for m, at in depths.items():
            row = at["against_the_trees"]
            enumerated = [short(row[key]) for key in ("unmerged_calls", "expectimax_calls", "ratio")]
            from_samples = ["-"] * 5
            if row["from_samples"]:
                last = min(row["from_samples"], key=lambda found: found["error"])
                numbers = [last[key] for key in ("tree_calls", "merged_calls", "ratio", "ratio_to_expectimax")]
                error = f"{last['error']:.1e}" if last["error"] > EXACT else "0"
                from_samples = [error] + [short(number) if number else "-" for number in numbers]
            cells = "".join(f"{cell:>{10 if k else 8}}" for k, cell in enumerate(enumerated + from_samples))
            print(f"{name:<17}{m:>3}{cells}")
    print("sampled: at the smallest error of the unmerged tree of samples within a million nodes, and the")
    print("cheapest sampled search with merging that is as right; exact: ratio to expectimax, error 0.")

    if any(method.startswith("mctx") for method in next(iter(report["tasks"].values()))[DEPTHS[0]]["methods"]):
        print_beside_mctx(report["tasks"])
    print_bias(report["sampling_bias"])


def print_beside_mctx(tasks: dict[str, Any]) -> None:
    print("\nExact, where mctx after 1024 simulations is not")
    print(f"{'':<17}{'m':>3}{'our calls':>11}{'our ms':>9}   {'mctx: smaller error':<22}{'right':>7}{'ms':>9}")
    for name, depths in tasks.items():
        for m, at in depths.items():
            ours = at["methods"]["expectimax"]
            peers = [rows[-1] for method, rows in at["methods"].items() if method.startswith("mctx")]
            if ours and peers and ours[0]["error"] < EXACT:
                peer = min(peers, key=lambda row: row["error"])
                mine = f"{short(ours[0]['calls']):>11}{ours[0]['ms']:>9.2f}"
                print(f"{name:<17}{m:>3}{mine}   {peer['error']:<22.1e}{peer['right']:>7.0%}{peer['ms']:>9.2f}")


def print_bias(found: dict[str, Any]) -> None:
    low, high, searches = found["low"], found["high"], found["searches"]
    print(
        f"\nsampled on Garnet(200,4,5), m = 4, {searches} searches; in reward units. T^m Q is {low:.2f} to {high:.2f}"
    )
    columns = ("C", "calls", "bias", "estimated", "rmse", "corrected", "stderr", "q -+", "interval")
    print(f"{'share':<10}" + "".join(f"{column:>10}" for column in columns))
    for row in found["rows"]:
        cells = [str(row["C"]), short(row["calls"])]
        cells += [_number(row.get(key)) for key in ("bias", "bias_estimated", "rmse", "rmse_corrected", "stderr")]
        cells += [f"{row[key]:.0%}" if key in row else "-" for key in ("coverage_uncorrected", "coverage")]
        print(f"{row['share']:<10}" + "".join(f"{cell:>10}" for cell in cells))
    print("corrected: the estimated bias subtracted. q -+: truth in q -+ 1.96 stderr. interval: in interval(0.95).")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _best(rows: list[dict[str, Any]] | None) -> str:
    if not rows:
        return "-"
    best = min(rows, key=lambda row: (row["error"] if row["error"] > EXACT else 0.0, row["calls"]))
    error = f"{best['error']:.1e}" if best["error"] > EXACT else "0"
    return f"{error} {short(best['calls']):>5} {best['right']:>4.0%}"


def _to(rows: list[dict[str, Any]] | None, target: float) -> str:
    found = cheapest(rows or [], target)
    if found is None:
        return "-"
    return f"{short(found['calls'])} {'-' if found['ms'] is None else short(found['ms']):>6}"


def picture(report: dict[str, Any], path: Path) -> None:
    """Error against calls, one panel for each MDP and depth."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    tasks = report["tasks"]
    depths = list(next(iter(tasks.values())))
    figure = Figure(figsize=(2.6 * len(depths) + 0.6, 2.1 * len(tasks) + 0.9), layout="constrained")
    axes = figure.subplots(len(tasks), len(depths), sharex=True, sharey=True, squeeze=False)
    colors, floor, handles = colormaps["tab10"], EXACT / 3, {}
    for (name, at_depths), line in zip(tasks.items(), axes, strict=True):
        for at, panel in zip(at_depths.values(), line, strict=True):
            for k, (method, rows) in enumerate(at["methods"].items()):
                rows = sorted(rows, key=lambda row: row["calls"])
                calls, errors = [r["calls"] for r in rows], [max(r["error"], floor) for r in rows]
                style = {"linestyle": "--" if method.startswith("mctx") else "-", "marker": "o" if k else "*"}
                size = {"markersize": 3 if k else 11, "linewidth": 1.2, "zorder": 2 if k else 3}
                handles[method] = panel.plot(calls, errors, color=colors(k), **style, **size)[0]
            panel.set(xscale="log", yscale="log", xlim=(5, 2e6))
            panel.minorticks_off()
            panel.grid(alpha=0.3)
        line[0].set_ylabel(f"{name}\nerror", fontsize=9)
    for m, top, bottom in zip(depths, axes[0], axes[-1], strict=True):
        top.set_title(f"m = {m}", fontsize=10)
        bottom.set_xlabel("model calls per root", fontsize=9)
    axes[0][0].set_yticks([1, 1e-1, 1e-2, 1e-3, 1e-4, floor], ["1", "0.1", "0.01", "$10^{-3}$", "$10^{-4}$", "exact"])
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=1 + len(depths), fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--picture", type=Path, help="where to draw error against calls")
    args = options.parse_args()
    use_one_core()
    depths = DEPTHS[:2] if args.quick else DEPTHS
    seconds = 0.1 if args.quick else 0.5
    tasks: dict[str, Any] = {}
    for name in MDPS:
        tasks[name] = {}
        for depth in depths:
            methods = measured(task(name, depth, args.device), seconds, peers=not args.quick)
            tasks[name][depth] = {"methods": methods, "against_the_trees": against_the_trees(methods)}
        print_task(name, tasks[name])
    report = about(args) | {"tasks": tasks, "sampling_bias": sampling_bias(args.device, args.quick)}
    print_summary(report)
    write(report, args.json)
    if args.picture:
        picture(report, args.picture)


if __name__ == "__main__":
    main()
