"""What does a lookahead cost, and how right is it, beside the tree searches of mctx?

    python benchmarks/search.py [--quick] [--repeats 15] [--device cpu] [--json PATH]

1. The paper's 10 x 10 grid: all 100 states as roots, depth 8, v^pi of the uniform policy at the leaves. mctx searches
   the same MDP from the same roots with the same leaves and priors, jitted, 64 simulations.
2. mcts: simulations a second from 128 roots and from one, depth 8, 64 simulations each, and how right they are, beside
   the two policies of mctx.
3. New leaf values for roots that were searched before: what is saved.
4. Depth 32 and depth 64 on known states: how the time grows, and how many calls the model gets.
5. Depth 1 to 64 from one root: nodes, model calls and time with merging, and without it as far as that fits.
6. DeepSea(50): deeper and deeper from the start until another action looks best than at depth 0.
7. One sweep over 10^6 nodes, on a GPU also over 10^7: which share of the memory bandwidth it reaches.
8. The first search of a process, numba imported: where loops are compiled, and where they are found on disk.

CPU time of one thread on one core for both sides, and with --device cuda wall time with one GPU; there a tree search of
fixed shape is also held by a CUDA graph. Each time is the median of several repeats in which all forms take turns, and
a ratio is the median of theirs. Without mctx (the extra `bench`) the peer's lines are missing.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from typing import Any

import merging
import torch
from common import (
    Form,
    about,
    garnet,
    median_ratio,
    parser,
    sampled_roots,
    take_turns,
    uniform_evaluation,
    use_one_core,
    write,
)
from merging import COLD, DEPTH, WARM, searcher
from peers import POLICIES, mctx_searcher

from pgts_torch.bellman import Outcomes, sweep
from pgts_torch.models import TabularModel
from pgts_torch.options import MCTS
from pgts_torch.search import Topology, mcts
from pgts_torch.search.fixed_trees import FixedTrees
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid

SIMULATIONS, MCTS_ROOTS = 64, 128
PEER = "mctx, gumbel_muzero_policy"


def beside_mctx(repeats: int, device: str) -> dict[str, Any]:
    """Time, and error over all roots and actions against T^8 Q^pi."""
    mdp, root_B = grid(), torch.arange(100)
    evaluation = uniform_evaluation(mdp)
    truth_SA = exact.lookahead(mdp, evaluation.q_SA, DEPTH)
    cold, warm = (searcher(mdp, root_B, DEPTH, device, keep=keep) for keep in (False, True))
    values: dict[str, Form] = {COLD: lambda: cold().q_BA, WARM: lambda: warm().q_BA}
    peer = mctx_searcher(mdp, evaluation.v_S, root_B, policy="gumbel", simulations=SIMULATIONS, max_depth=DEPTH + 1)
    if peer:
        values[PEER] = peer
    errors = {name: (value().cpu() - truth_SA).abs() for name, value in values.items()}
    times = take_turns(values, repeats)
    return {
        name: {
            "milliseconds": statistics.median(times[name]),
            "max_error": float(errors[name].max()),
            "mean_error": float(errors[name].mean()),
            "peer_time_ratio": median_ratio(times[PEER], times[name]) if PEER in times else None,
        }
        for name in values
    }


def print_beside_mctx(rows: dict[str, Any]) -> None:
    print(f"Grid, 100 roots, depth {DEPTH}; mctx: {SIMULATIONS} simulations")
    print(f"{'':<28}{'ms':>10}{'max error':>14}{'mean error':>14}{'ratio':>12}")
    for name, row in rows.items():
        ratio = "" if row["peer_time_ratio"] is None else f"{row['peer_time_ratio']:.1f}"
        errors = f"{row['max_error']:>14.2g}{row['mean_error']:>14.2g}"
        print(f"{name:<28}{row['milliseconds']:>10.3f}{errors}{ratio:>12}")
    if PEER not in rows:
        print("mctx is not installed: no peer to compare with (pip install 'pgts_torch[bench]')")
    print("error: against T^8 Q^pi, over all roots and actions; for mctx the value of each")
    print("root action in its tree, a mean over simulations. ratio: mctx's time to this.")


def mcts_throughput(repeats: int, device: str) -> dict[str, Any]:
    """Milliseconds of one search of 128 distinct roots, and of 1 root: ours with known and with fresh topology, and
    mctx's; and how right they are against T^8 Q."""
    answer = {}
    # A grid of 12 x 12, because roots that are alike would be searched once by ours and again and again by mctx.
    mdps = {"Grid, 12 x 12": grid(12, traps=(14, 38)), "Garnet(200,4,5)": garnet(), "DeepSea(20)": deep_sea(20)}
    for name, mdp in mdps.items():
        for roots in (MCTS_ROOTS, 1):
            root_B, evaluation = sampled_roots(mdp, roots), uniform_evaluation(mdp)
            forms = _mcts_forms(mdp, root_B, evaluation.v_S, device)
            truth_BA = exact.lookahead(mdp, evaluation.q_SA, DEPTH)[root_B]
            right = {form: _rightness(search(), truth_BA) for form, search in forms.items()}
            times = take_turns(forms, repeats)
            answer[f"{name}, {roots} root{'s' * (roots > 1)}"] = {
                form: {"milliseconds": statistics.median(times[form]), "roots": roots}
                | right[form]
                | {
                    f"{policy}_time_ratio": median_ratio(times[f"mctx, {policy}"], times[form])
                    for policy in POLICIES
                    if f"mctx, {policy}" in times
                }
                for form in forms
            }
    return answer


def _mcts_forms(mdp: TabularMDP, root_B: torch.Tensor, v_S: torch.Tensor, device: str) -> dict[str, Form]:
    """Searches that return the values of the root's actions."""
    forms: dict[str, Form] = {}
    ways: dict[str, dict[str, Any]] = {"tree": {}, "waves": {"wave": SIMULATIONS}, "merged": {"merge": True}}
    for way, options in ways.items():
        for keep in (True, False) if way == "tree" else (True,):
            form = f"mcts, {way}, {'known' if keep else 'fresh'}"
            forms[form] = _mcts(mdp, root_B, v_S, device, keep=keep, **options)
    if device.startswith("cuda"):
        forms["mcts, a CUDA graph"] = _captured(mdp, root_B.to(device), v_S.to(device))
    for policy in POLICIES:
        peer = mctx_searcher(mdp, v_S, root_B, policy=policy, simulations=SIMULATIONS, max_depth=DEPTH + 1)
        if peer:
            forms[f"mctx, {policy}"] = peer
    return forms


def _rightness(q_BA: torch.Tensor, truth_BA: torch.Tensor) -> dict[str, float]:
    """The mean error, and the share of roots whose best action is right."""
    error_BA, best_B1 = (q_BA.cpu() - truth_BA).abs(), q_BA.cpu().argmax(1, keepdim=True)
    right_B = truth_BA.gather(1, best_B1).squeeze(1) >= truth_BA.amax(1) - 1e-9
    return {"mean_error": float(error_BA.mean()), "right": float(right_B.double().mean())}


def _mcts(
    mdp: TabularMDP, root_B: torch.Tensor, v_S: torch.Tensor, device: str, *, keep: bool, **options: Any
) -> Callable[[], torch.Tensor]:
    model, generator = TabularModel(mdp, device=device), stream(0, "mcts", device=device)
    topology, root_B, v_S = Topology(model) if keep else None, root_B.to(device), v_S.to(device)
    options |= {"topology": topology, "generator": generator, "v_leaf": lambda state_N: v_S[state_N]}
    return lambda: mcts(model, root_B, depth=DEPTH, simulations=SIMULATIONS, **options).q_BA


def _captured(mdp: TabularMDP, root_B: torch.Tensor, v_S: torch.Tensor) -> Callable[[], torch.Tensor]:
    """The search one simulation after another, without noise, as a CUDA graph."""
    model = TabularModel(mdp, device=root_B.device)
    prior_SA = torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions).to(v_S)
    outcomes, options = (
        model.outcomes(torch.arange(mdp.num_states, device=root_B.device)),
        MCTS(simulations=SIMULATIONS),
    )
    trees = FixedTrees(outcomes, v_S, prior_SA, DEPTH + 1, options, num_roots=len(root_B), num_nodes=SIMULATIONS)
    preference_BA = prior_SA[root_B].log()
    trees.search(root_B, preference_BA)  # what is made once is not captured
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        q_BA, _ = trees.search(root_B, preference_BA)

    def search() -> torch.Tensor:
        assert trees is not None  # the graph works in its memory, and in that of the preferences
        assert preference_BA is not None
        graph.replay()
        return q_BA

    return search


def print_mcts_throughput(table: dict[str, Any]) -> None:
    print(f"\nmcts: simulations a second, depth {DEPTH}, {SIMULATIONS} simulations each")
    print(f"{'':<28}{'':<22}{'ms':>9}{'sims / s':>12}{'to muzero':>11}{'to gumbel':>11}{'error':>9}{'right':>7}")
    for name, rows in table.items():
        for form, row in rows.items():
            rate = row["roots"] * SIMULATIONS / row["milliseconds"] * 1e3
            ratios = (f"{row[key]:.2f}" if (key := f"{p}_time_ratio") in row else "" for p in POLICIES)
            print(
                f"{name:<28}{form:<22}{row['milliseconds']:>9.3f}{rate:>12,.0f}"
                + "".join(f"{r:>11}" for r in ratios)
                + f"{row['mean_error']:>9.2g}{row['right']:>7.0%}"
            )
    print("to muzero, to gumbel: mctx's time with that policy to this time; above 1, ours is faster. error: the mean")
    print("against T^8 Q^pi over roots and actions. right: roots whose best action is the best by T^8 Q^pi.")


def bandwidth(repeats: int, device: str, num_nodes: int) -> list[dict[str, Any]]:
    """One sweep over many nodes, 4 actions, 5 outcomes, and a copy of as many bytes.

    The bytes of a sweep are what it must move at least: each weight, index, reward and value once, before and after.
    """
    A, K = 4, 5
    generator = stream(0, "bandwidth")
    random_NAK = torch.randint(num_nodes, (num_nodes, A, K), generator=generator)
    offset_NAK = torch.randint(-1000, 1001, (num_nodes, A, K), generator=generator)
    near_NAK = (torch.arange(num_nodes)[:, None, None] + offset_NAK) % num_nodes
    rows = []
    for children, child_NAK in (("anywhere", random_NAK), ("within 1000", near_NAK)):
        for dtype in (torch.float64, torch.float32):
            size = dtype.itemsize
            prob_NAK = torch.full((num_nodes, A, K), 1 / K, dtype=dtype, device=device)
            discount = torch.tensor(0.9, dtype=dtype, device=device).expand(prob_NAK.shape)
            reward_NA = torch.rand(num_nodes, A, generator=generator).to(device, dtype)
            outcomes = Outcomes(reward_NA, prob_NAK, discount, child_NAK.to(device), num_nodes)
            v_N = torch.rand(num_nodes, generator=generator).to(device, dtype)
            moved = num_nodes * (A * K * (size + 4) + A * size + 2 * size)
            source = torch.zeros(moved // 16, dtype=torch.float64, device=device)
            target = torch.empty_like(source)
            forms: dict[str, Form] = {
                "sweep": partial(sweep, outcomes, v_N, 1),
                "copy": partial(target.copy_, source),
            }
            times = take_turns(forms, repeats)
            rows.append(
                {
                    "children": children,
                    "dtype": str(dtype).removeprefix("torch."),
                    "nodes": num_nodes,
                    "bytes": moved,
                    "sweep_milliseconds": statistics.median(times["sweep"]),
                    "copy_milliseconds": statistics.median(times["copy"]),
                    "share": median_ratio(times["copy"], times["sweep"]),
                }
            )
    return rows


def print_bandwidth(rows: list[dict[str, Any]]) -> None:
    print("\nOne sweep, 4 actions, 5 outcomes, beside a copy")
    print(f"{'nodes':<8}{'children':<14}{'dtype':<10}{'sweep ms':>10}{'MB':>8}{'GB/s':>8}{'copy GB/s':>12}{'share':>8}")
    for row in rows:
        rates = [row["bytes"] / row[f"{form}_milliseconds"] / 1e6 for form in ("sweep", "copy")]
        time = f"{row['sweep_milliseconds']:>10.2f}{row['bytes'] / 1e6:>8.0f}"
        print(
            f"{row['nodes']:<8.0e}{row['children']:<14}{row['dtype']:<10}{time}{rates[0]:>8.1f}{rates[1]:>12.1f}{row['share']:>8.0%}"
        )
    print("MB: what a sweep must move at least. share: time of a copy that moves as much to this.")


FIRST = """
import time, torch, numba
from pgts_torch.models import TabularModel
from pgts_torch.search import expectimax, mcts
from pgts_torch.tabular import grid
model, v_S = TabularModel(grid()), torch.zeros(100, dtype=torch.float64)
begin = time.process_time()
{search}(model, torch.arange(100), depth=8, v_leaf=lambda state_N: v_S[state_N]{options})
print(time.process_time() - begin)
"""


def first_searches() -> dict[str, list[float]]:
    """CPU seconds of the first search of a process that compiles, and of the next process."""
    kinds = {
        "expectimax": ("expectimax", ""),
        "mcts, tree": ("mcts", ", simulations=64"),
        "mcts, merged": ("mcts", ", simulations=64, merge=True"),
    }
    answer = {}
    for kind, (search, options) in kinds.items():
        with tempfile.TemporaryDirectory() as folder:
            command = sys.executable, "-c", FIRST.format(search=search, options=options)
            given: dict[str, Any] = {"env": os.environ | {"NUMBA_CACHE_DIR": folder}, "text": True}
            answer[kind] = [float(subprocess.check_output(command, **given)) for _ in range(2)]
    return answer


def print_first_searches(rows: dict[str, list[float]]) -> None:
    print(f"\n{'The first search of a process':<32}{'compiles, s':>12}{'from disk, s':>14}")
    for kind, (compiles, reads) in rows.items():
        print(f"{kind:<32}{compiles:>12.2f}{reads:>14.2f}")


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--repeats", type=int, help="turns that each form takes; default 15")
    args = options.parse_args()
    repeats = args.repeats if args.repeats is not None else 3 if args.quick else 15
    if repeats < 1:
        options.error(f"argument --repeats: {repeats} is not at least 1")
    use_one_core(args.device)
    few, device, n = max(3, repeats // 3), args.device, 20 if args.quick else 50
    report: dict[str, Any] = about(args) | {"repeats": repeats}
    report["beside_mctx"] = beside_mctx(repeats, device)
    print_beside_mctx(report["beside_mctx"])
    report["mcts_throughput"] = mcts_throughput(few, device)
    print_mcts_throughput(report["mcts_throughput"])
    report["new_leaf_values"] = merging.new_leaf_values(repeats, device)
    merging.print_new_leaf_values(report["new_leaf_values"])
    report["doubled_depth"] = merging.doubled_depth(repeats, device)
    merging.print_doubled_depth(report["doubled_depth"])
    report["cost_against_depth"] = merging.cost_against_depth(few, device)
    merging.print_cost_against_depth(report["cost_against_depth"])
    report["decision_in_deep_sea"] = merging.decision_in_deep_sea(n, device)
    merging.print_decision_in_deep_sea(n, report["decision_in_deep_sea"])
    sizes = (10**5,) if args.quick else (10**6, 10**7) if device.startswith("cuda") else (10**6,)
    report["bandwidth"] = [row for num_nodes in sizes for row in bandwidth(few, device, num_nodes)]
    print_bandwidth(report["bandwidth"])
    if device == "cpu":
        report["first_searches"] = first_searches()
        print_first_searches(report["first_searches"])
    write(report, args.json)


if __name__ == "__main__":
    main()
