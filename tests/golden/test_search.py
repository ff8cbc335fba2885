"""Searches that must stay what they are: values at the roots, nodes on each level and model calls, kept as text.

The numbers are also right (`tests/search` holds them to the exact operator); these files show a change of cost or order
that is right as well. To write them anew, after looking at what changed:

    PGTS_WRITE_GOLDEN=1 pytest tests/golden
"""

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pgts_torch.models import EnumeratingModel, TabularModel
from pgts_torch.search import Lookahead, Topology, expectimax, mcts, sampled
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact
from tests.search.models import InterningModel
from tests.search.test_expectimax import height, lattice
from tests.support import uniform_policy, zoo

FOLDER = Path(__file__).parent / "search"
WRITE = "PGTS_WRITE_GOLDEN" in os.environ

Case = tuple[EnumeratingModel, list[int], Callable[[Tensor], Tensor]]


def tabular(name: str, *roots: int) -> Case:
    """Roots in an MDP of the zoo, with v^pi of the uniform policy at the leaves."""
    mdp: TabularMDP = zoo(name)
    v_S = exact.policy_values(mdp, uniform_policy(mdp))
    return TabularModel(mdp), list(roots), lambda state_N: v_S[state_N]


def endless() -> Case:
    """A plane without an edge, whose states are numbered as they are met."""
    model = InterningModel(lattice, [(0, 0), (3, 1)], num_actions=2)
    return model, [0, 1], lambda s: torch.tensor([height(model.states[n]) for n in s.tolist()], dtype=torch.float64)


CASES: dict[str, Callable[[], Case]] = {
    "ladder": lambda: tabular("ladder", 0, 2),
    "tightrope": lambda: tabular("tightrope", 0, 1),
    "garnet": lambda: tabular("garnet", 0, 7),
    "grid": lambda: tabular("grid", 0, 45, 99),
    "deep_sea": lambda: tabular("deep_sea", 0),
    "frozen_lake": lambda: tabular("FrozenLake", 0, 14),
    "endless": endless,
}

DEPTHS = (0, 1, 4, 8)


def searched(case: Case) -> Iterator[tuple[int, list[int], Lookahead]]:
    """The same roots at growing depths, with one topology."""
    model, roots, v_leaf = case
    topology = Topology(model)
    for depth in DEPTHS:
        root_B = torch.tensor(roots)
        yield depth, roots, expectimax(model, root_B, depth=depth, v_leaf=v_leaf, topology=topology)


def others(name: str, search: Callable[..., Lookahead], *roots: int) -> Iterator[tuple[int, list[int], Lookahead]]:
    """The same question, asked of a search that draws, or sees a part."""
    model, root_B, v_leaf = tabular(name, *roots)
    for depth in DEPTHS:
        yield depth, list(roots), search(model, torch.tensor(root_B), depth=depth, v_leaf=v_leaf)


def drawn(share: str) -> Callable[..., Lookahead]:
    return lambda *args, **kwargs: sampled(
        *args, samples=2, share=share, generator=stream(0, "golden"), replicates=0, **kwargs
    )


OTHERS: dict[str, Callable[[], Iterator[tuple[int, list[int], Lookahead]]]] = {
    "grid_narrow": lambda: others("grid", partial(expectimax, max_width=6), 0, 45),
    "garnet_sampled_level": lambda: others("garnet", drawn("level"), 0, 7),
    "garnet_sampled_search": lambda: others("garnet", drawn("search"), 0, 7),
    "frozen_lake_mcts_tree": lambda: others("FrozenLake", partial(mcts, simulations=24, wave=24), 0, 14),
    "frozen_lake_mcts_one_by_one": lambda: others("FrozenLake", partial(mcts, simulations=24, wave=1), 0, 14),
    "garnet_mcts_graph": lambda: others("garnet", partial(mcts, simulations=24, merge=True), 0, 7),
}


def lines(searches: Iterator[tuple[int, list[int], Lookahead]]) -> Iterator[str]:
    for depth, roots, look in searches:
        yield f"depth {depth}"
        yield f"model_calls {look.model_calls}"
        yield f"nodes {' '.join(map(str, look.nodes_per_level))}"
        for root, q_A in zip(roots, look.q_BA.tolist(), strict=True):
            yield f"q {root} {' '.join(f'{q:.12g}' for q in q_A)}"


@pytest.mark.parametrize("name", [*CASES, *OTHERS])
def test_searches_are_what_they_were(name):
    file = FOLDER / f"{name}.txt"
    found = list(lines(searched(CASES[name]()) if name in CASES else OTHERS[name]()))
    if WRITE:
        file.write_text("\n".join(found) + "\n")
    kept = file.read_text().splitlines()
    for line, before in zip(found, kept, strict=True):
        if not line.startswith("q "):
            assert line == before
        else:
            numbers, numbers_before = ([float(word) for word in text.split()[1:]] for text in (line, before))
            assert numbers == pytest.approx(numbers_before, rel=1e-10, abs=1e-10)


def test_there_is_one_file_for_each_search():
    assert {path.stem for path in FOLDER.iterdir()} == {*CASES, *OTHERS}
