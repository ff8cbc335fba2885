"""What merging and remembering save: the sections of search.py on depth and on known states."""

import statistics
from collections.abc import Callable
from itertools import cycle
from typing import Any

import torch
from common import MDPS, median_ratio, milliseconds, sampled_roots, take_turns, uniform_evaluation, unmerged_nodes

from pgts_torch.models import TabularModel
from pgts_torch.search import Lookahead, Topology, expectimax
from pgts_torch.search.empirical import Empirical
from pgts_torch.seeding import sample_keys, stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, random_mdp

DEPTH = 8
UNMERGED_NODES = 1_000_000
"""The most nodes of a search without merging that is timed."""

COLD, WARM = "expectimax, fresh topology", "expectimax, known topology"


def searcher(mdp: TabularMDP, root_B: torch.Tensor, depth: int, device: str, *, keep: bool) -> Callable[[], Lookahead]:
    """A search with v^pi of the uniform policy at the leaves; `keep`: one topology for all calls, else one for each."""
    model, v_S = TabularModel(mdp, device=device), uniform_evaluation(mdp).v_S.to(device)
    topology, root_B = Topology(model) if keep else None, root_B.to(device)
    return lambda: expectimax(model, root_B, depth=depth, v_leaf=lambda state_N: v_S[state_N], topology=topology)


def new_leaf_values(repeats: int, device: str) -> dict[str, Any]:
    """The second search from the same roots, other leaf values: time against the first, and calls of the model."""
    return {name: _second_search(MDPS[name](), repeats, device) for name in ("Grid", "Taxi", "Garnet(200,4,5)")}


def _second_search(mdp: TabularMDP, repeats: int, device: str) -> dict[str, Any]:
    model, root_B = TabularModel(mdp, device=device), sampled_roots(mdp, 32).to(device)
    values = torch.rand(64, mdp.num_states, dtype=torch.float64, generator=stream(0, "leaves")).to(device)
    leaves, topology = cycle(values), Topology(model)

    def look(topology: Topology | None) -> Lookahead:
        v_S = next(leaves)
        return expectimax(model, root_B, depth=DEPTH, v_leaf=lambda state_N: v_S[state_N], topology=topology)

    calls = [look(topology).model_calls for _ in range(2)]
    times = take_turns({"first": lambda: look(None), "second": lambda: look(topology)}, repeats)
    return {
        "model_calls": calls,
        "milliseconds": {form: statistics.median(found) for form, found in times.items()},
        "ratio": median_ratio(times["first"], times["second"]),
    }


def print_new_leaf_values(rows: dict[str, Any]) -> None:
    print(f"\nNew leaf values for the same 32 roots, depth {DEPTH}")
    print(f"{'':<18}{'first ms':>12}{'second ms':>12}{'ratio':>8}{'first calls':>14}{'second calls':>14}")
    for name, row in rows.items():
        times = "".join(f"{row['milliseconds'][form]:>12.3f}" for form in ("first", "second"))
        print(f"{name:<18}{times}{row['ratio']:>8.1f}{row['model_calls'][0]:>14}{row['model_calls'][1]:>14}")


def doubled_depth(repeats: int, device: str) -> dict[str, Any]:
    """Depth 32 and 64, known states: milliseconds, their ratio, and model calls of the deeper after the shallower."""
    mdp, root_B = grid(), torch.arange(100, device=device)
    model, v_S = TabularModel(mdp, device=device), uniform_evaluation(mdp).v_S.to(device)
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


def print_doubled_depth(row: dict[str, Any]) -> None:
    print("\nTwice the depth, Grid, 100 roots, known topology")
    print(f"m = 32: {row['milliseconds']['32']:.3f} ms   m = 64: {row['milliseconds']['64']:.3f} ms", end="   ")
    print(f"ratio: {row['ratio']:.2f}   model calls: {row['model_calls_of_64_after_32']}")


def cost_against_depth(repeats: int, device: str) -> dict[str, list[dict[str, Any]]]:
    """Nodes, model calls and milliseconds of one search from one root, with merging and without."""
    mdps = {
        "grid(10), root 0": grid(),
        "deep_sea(64), root 0": deep_sea(64),
        "random_mdp(1000, 4, branching=3), root 0": random_mdp(1000, 4, branching=3),
    }
    table = {}
    for name, mdp in mdps.items():
        rows = []
        for depth in (1, 2, 4, 8, 16, 32, 64):
            forms = {keep: searcher(mdp, torch.tensor([0]), depth, device, keep=keep) for keep in (False, True)}
            look = forms[False]()
            times = take_turns({WARM: forms[True], COLD: forms[False]}, repeats)
            nodes = unmerged_nodes(mdp, 0, depth + 1)
            row = {
                "depth": depth,
                "unmerged_nodes": nodes,
                "nodes": look.nodes,
                "model_calls": look.model_calls,
                "unmerged_milliseconds": None,
                "cold_milliseconds": statistics.median(times[COLD]),
                "warm_milliseconds": statistics.median(times[WARM]),
            }
            if nodes <= UNMERGED_NODES:
                unmerged = unmerged_searcher(mdp, 0, depth, device)
                q_BA = unmerged().q_BA
                torch.testing.assert_close(q_BA, look.q_BA)
                row["unmerged_milliseconds"] = statistics.median(milliseconds(unmerged) for _ in range(3))
            rows.append(row)
        table[name] = rows
    return table


def unmerged_searcher(mdp: TabularMDP, root: int, depth: int, device: str) -> Callable[[], Lookahead]:
    """The same search in a model whose states are paths: no two of them meet."""
    model, v_S = TabularModel(mdp, device=device), uniform_evaluation(mdp).v_S.to(device)
    root_B, key = torch.tensor([root], device=device), sample_keys(1, generator=stream(0, "unmerged", device=device))

    def search() -> Lookahead:
        paths = Empirical(model, root_B, samples=[None] * (depth + 1), share="none", key=key)
        return expectimax(paths, paths.root_B, depth=depth, v_leaf=lambda path_N: v_S[paths.state_N[path_N]])

    return search


def print_cost_against_depth(table: dict[str, list[dict[str, Any]]]) -> None:
    for name, rows in table.items():
        print(f"\n{name}")
        columns = ("unmerged nodes", "unmerged ms", "nodes", "model calls", "cold ms", "warm ms")
        print(f"{'m':>4}" + "".join(f"{column:>15}" for column in columns))
        for row in rows:
            counts = f"{row['nodes']:>15}{row['model_calls']:>15}"
            times = f"{row['cold_milliseconds']:>15.3f}{row['warm_milliseconds']:>15.3f}"
            unmerged = "-" if row["unmerged_milliseconds"] is None else f"{row['unmerged_milliseconds']:.3f}"
            print(f"{row['depth']:>4}{row['unmerged_nodes']:>15.4g}{unmerged:>15}{counts}{times}")


def decision_in_deep_sea(n: int, device: str) -> dict[str, Any]:
    """Depth by depth from the start, one topology, until another action looks best than at depth 0.

    The depth that is enough, by the exact solver: the smallest m with an optimal action best in T^m Q^pi.
    """
    mdp = deep_sea(n)
    left_SA = torch.zeros(mdp.num_states, 2, dtype=torch.float64)
    left_SA[:, 0] = 1
    optimal_action = int(exact.optimal(mdp).q_SA[0].argmax())
    answer = {}
    policies = {"uniform": uniform_evaluation(mdp).q_SA, "always left": exact.evaluate(mdp, left_SA).q_SA}
    for name, q_SA in policies.items():
        model, q_leaf = TabularModel(mdp, device=device), q_SA.to(device)
        topology, root_B = Topology(model), torch.tensor([0], device=device)
        first: int | None = None
        for depth in range(2 * n):
            look = expectimax(model, root_B, depth=depth, q_leaf=q_leaf.__getitem__, topology=topology)
            action = int(look.q_BA[0].argmax())
            first = action if first is None else first
            if action != first:
                break
        enough, truth_SA = 0, q_SA
        while int(truth_SA[0].argmax()) != optimal_action:
            truth_SA, enough = exact.bellman(mdp, truth_SA), enough + 1
        answer[name] = {
            "depth": depth,
            "enough": enough,
            "right": action == optimal_action,
            "model_calls": topology.table.model_calls,
            "bound": depth * (depth + 1),
        }
    return answer


def print_decision_in_deep_sea(n: int, rows: dict[str, Any]) -> None:
    print(f"\nDeepSea({n}) from the start: deeper until the best action changes")
    columns = ("m found", "m enough", "right", "model calls", "m (m + 1)")
    print(f"{'Q^pi of':<14}" + "".join(f"{column:>13}" for column in columns))
    for name, row in rows.items():
        right = "yes" if row["right"] else "no"
        counts = f"{row['model_calls']:>13}{row['bound']:>13}"
        print(f"{name:<14}{row['depth']:>13}{row['enough']:>13}{right:>13}{counts}")
