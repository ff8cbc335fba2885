"""What does a lookahead cost, and how right is it, beside Gumbel MuZero's tree search in mctx?

    python benchmarks/search.py [--repeats 15] [--json PATH]

1. The paper's 10 x 10 grid: all 100 states as roots, depth 8, v^pi of the uniform policy at the leaves. mctx searches
   the same MDP from the same roots with the same leaves and priors, jitted, 64 simulations no deeper than 8.
2. Depth 32 and depth 64 on known states: how the time grows, and what the model is asked.
3. Depth 1 to 64 from one root: nodes and model calls with merging, beside the nodes of the tree without it.

One thread on one core for both sides. Each time is the median of several repeats in which all forms take turns, and a
ratio is the median of theirs. Without mctx (the extra `bench`) the peer's lines are missing.
"""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pgts_torch
from pgts_torch.models import TabularModel
from pgts_torch.search import Lookahead, Topology, expectimax
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, random_mdp

DEPTH = 8
SIMULATIONS = 64
SECONDS = 0.02
"""How long one repeat lasts at least: fast forms run more than once in it."""

COLD, WARM, PEER = "expectimax, fresh topology", "expectimax, known topology", "mctx, gumbel_muzero_policy"
Form = Callable[[], Any]


def take_turns(forms: dict[str, Form], repeats: int) -> dict[str, list[float]]:
    """Milliseconds of each form in each repeat; a first repeat, in which caches fill, does not count."""
    rounds = [{name: _milliseconds(form) for name, form in forms.items()} for _ in range(repeats + 1)]
    return {name: [milliseconds[name] for milliseconds in rounds[1:]] for name in forms}


def _milliseconds(form: Form) -> float:
    calls, begin, end = 0, time.perf_counter(), 0.0
    while end < begin + SECONDS:
        form()
        calls, end = calls + 1, time.perf_counter()
    return (end - begin) / calls * 1e3


def median_ratio(above: list[float], below: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(above, below, strict=True))


def uniform_evaluation(mdp: TabularMDP) -> exact.Evaluation:
    pi_SA = torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions, dtype=torch.float64)
    return exact.evaluate(mdp, pi_SA)


def searcher(mdp: TabularMDP, root_B: torch.Tensor, depth: int, *, keep: bool) -> Callable[[], Lookahead]:
    """A search with v^pi of the uniform policy at the leaves; `keep`: one topology for all calls, else one for each."""
    model, v_S = TabularModel(mdp), uniform_evaluation(mdp).v_S
    topology = Topology(model) if keep else None
    return lambda: expectimax(model, root_B, depth=depth, v_leaf=lambda state_N: v_S[state_N], topology=topology)


def mctx_searcher(mdp: TabularMDP, root_B: torch.Tensor) -> Callable[[], torch.Tensor] | None:
    """The values of the root's actions in mctx's tree, or None without mctx.

    A node is one sampled outcome of its edge, as in MuZero; its value is v^pi and its prior the uniform policy.
    """
    try:
        import jax
        import jax.numpy as jnp
        import mctx
    except ImportError:
        return None
    outcomes = mdp.outcomes
    reward_SA, child_SAK = jnp.asarray(outcomes.reward_NA.numpy()), jnp.asarray(outcomes.child_NAK.numpy())
    logits_SAK, discount_SAK = jnp.log(jnp.asarray(outcomes.prob_NAK.numpy())), jnp.asarray(outcomes.discount_NAK)
    v_S, roots = jnp.asarray(uniform_evaluation(mdp).v_S.numpy()), jnp.asarray(root_B.numpy())
    priors = jnp.zeros((len(roots), mdp.num_actions))

    def step(_: Any, key: Any, action_B: Any, state_B: Any) -> Any:
        k_B = jax.random.categorical(key, logits_SAK[state_B, action_B])
        next_B = child_SAK[state_B, action_B, k_B]
        answer = mctx.RecurrentFnOutput(
            reward=reward_SA[state_B, action_B],
            discount=discount_SAK[state_B, action_B, k_B],
            prior_logits=priors,
            value=v_S[next_B],
        )
        return answer, next_B

    @jax.jit
    def search(key: Any) -> Any:
        root = mctx.RootFnOutput(prior_logits=priors, value=v_S[roots], embedding=roots)
        answer = mctx.gumbel_muzero_policy((), key, root, step, num_simulations=SIMULATIONS, max_depth=DEPTH)
        return answer.search_tree.summary().qvalues

    key = jax.random.PRNGKey(0)
    return lambda: torch.from_numpy(np.array(search(key)))  # which waits for the answer


def beside_mctx(repeats: int) -> dict[str, Any]:
    """Time, and error over all roots and actions against T^8 Q^pi."""
    mdp, root_B = grid(), torch.arange(100)
    truth_SA = exact.lookahead(mdp, uniform_evaluation(mdp).q_SA, DEPTH)
    cold, warm = (searcher(mdp, root_B, DEPTH, keep=keep) for keep in (False, True))
    values: dict[str, Form] = {COLD: lambda: cold().q_BA, WARM: lambda: warm().q_BA}
    if peer := mctx_searcher(mdp, root_B):
        values[PEER] = peer
    errors = {name: (value() - truth_SA).abs() for name, value in values.items()}
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


def doubled_depth(repeats: int) -> dict[str, Any]:
    """Depth 32 and 64, known states: milliseconds, their ratio, and model calls of the deeper after the shallower."""
    mdp, root_B = grid(), torch.arange(100)
    model, v_S = TabularModel(mdp), uniform_evaluation(mdp).v_S
    topology = Topology(model)

    def look(depth: int) -> Lookahead:
        return expectimax(model, root_B, depth=depth, v_leaf=lambda state_N: v_S[state_N], topology=topology)

    calls = {depth: look(depth).model_calls for depth in (32, 64)}
    times = take_turns({"32": lambda: look(32), "64": lambda: look(64)}, repeats)
    return {
        "milliseconds": {depth: statistics.median(values) for depth, values in times.items()},
        "ratio": median_ratio(times["64"], times["32"]),
        "model_calls_of_64_after_32": calls[64],
    }


def cost_against_depth(repeats: int) -> dict[str, list[dict[str, float]]]:
    """Nodes, model calls and milliseconds of one search from one root, and the nodes of the tree without merging."""
    mdps = {
        "grid(10), root 0": grid(),
        "deep_sea(64), root 0": deep_sea(64),
        "random_mdp(1000, 4, branching=3), root 0": random_mdp(1000, 4, branching=3),
    }
    table = {}
    for name, mdp in mdps.items():
        rows = []
        for depth in (1, 2, 4, 8, 16, 32, 64):
            forms = {keep: searcher(mdp, torch.tensor([0]), depth, keep=keep) for keep in (False, True)}
            look = forms[False]()
            times = take_turns({WARM: forms[True], COLD: forms[False]}, repeats)
            rows.append(
                {
                    "depth": depth,
                    "unmerged_nodes": unmerged_nodes(mdp, 0, depth + 1),
                    "nodes": look.nodes,
                    "model_calls": look.model_calls,
                    "cold_milliseconds": statistics.median(times[COLD]),
                    "warm_milliseconds": statistics.median(times[WARM]),
                }
            )
        table[name] = rows
    return table


def unmerged_nodes(mdp: TabularMDP, root: int, expansions: int) -> float:
    """Nodes of the tree in which every path is its own: 1 + the number of outcomes with weight, level by level."""
    outcomes = mdp.outcomes
    counts_NAK = (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0)
    row_N = torch.arange(mdp.num_states)[:, None, None].expand_as(counts_NAK)[counts_NAK]
    child_N = outcomes.child_NAK[counts_NAK]
    paths_S = torch.nn.functional.one_hot(torch.tensor(root), mdp.num_states).double()
    nodes = 1.0
    for _ in range(expansions):
        paths_S = torch.zeros_like(paths_S).index_add_(0, child_N, paths_S[row_N])
        nodes += float(paths_S.sum())
    return nodes


def print_report(report: dict[str, Any]) -> None:
    print(f"Grid, 100 roots, depth {DEPTH}; mctx: {SIMULATIONS} simulations")
    print(f"{'':<28}{'ms':>10}{'max error':>14}{'mean error':>14}{'ratio':>12}")
    for name, row in report["beside_mctx"].items():
        ratio = "" if row["peer_time_ratio"] is None else f"{row['peer_time_ratio']:.1f}"
        errors = f"{row['max_error']:>14.2g}{row['mean_error']:>14.2g}"
        print(f"{name:<28}{row['milliseconds']:>10.3f}{errors}{ratio:>12}")
    if PEER not in report["beside_mctx"]:
        print("mctx is not installed: no peer to compare with (pip install 'pgts_torch[bench]')")
    print("error: against T^8 Q^pi, over all roots and actions; for mctx the value of each")
    print("root action in its tree, a mean over simulations. ratio: mctx's time to this.")

    row = report["doubled_depth"]
    print("\nTwice the depth, Grid, 100 roots, known topology")
    print(f"m = 32: {row['milliseconds']['32']:.3f} ms   m = 64: {row['milliseconds']['64']:.3f} ms", end="   ")
    print(f"ratio: {row['ratio']:.2f}   model calls: {row['model_calls_of_64_after_32']}")

    for name, rows in report["cost_against_depth"].items():
        print(f"\n{name}")
        print(f"{'m':>4}{'unmerged nodes':>18}{'nodes':>12}{'model calls':>14}{'cold ms':>12}{'warm ms':>12}")
        for row in rows:
            counts = f"{row['unmerged_nodes']:>18.4g}{row['nodes']:>12}{row['model_calls']:>14}"
            times = f"{row['cold_milliseconds']:>12.3f}{row['warm_milliseconds']:>12.3f}"
            print(f"{row['depth']:>4}{counts}{times}")


def use_one_core() -> None:
    """One thread of one core for torch and, if it is imported later, for XLA."""
    torch.set_num_threads(1)
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["JAX_PLATFORMS"] = "cpu"
    if sys.platform == "linux":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15, help="turns that each form takes")
    parser.add_argument("--json", type=Path, help="where to write the figures")
    args = parser.parse_args()
    if args.repeats < 1:
        parser.error(f"argument --repeats: {args.repeats} is not at least 1")
    use_one_core()
    report: dict[str, Any] = {
        "threads": 1,
        "repeats": args.repeats,
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "pgts_torch": pgts_torch.__version__,
        },
        "beside_mctx": beside_mctx(args.repeats),
        "doubled_depth": doubled_depth(args.repeats),
        "cost_against_depth": cost_against_depth(max(3, args.repeats // 3)),
    }
    print_report(report)
    if args.json:
        args.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
