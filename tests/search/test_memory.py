"""A lookahead that would not fit into memory is refused before it asks the model for what would fill it."""

import pytest
import torch
from torch import Tensor

from pgts_torch.errors import NodeBudgetExceeded
from pgts_torch.experiment.sections import SearchConfig
from pgts_torch.models.tabular import TabularModel
from pgts_torch.search import expectimax, mcts, sampled
from pgts_torch.search.auto import AutoSearch
from pgts_torch.search.engine import ExpectimaxSearch, MCTSSearch, SampledSearch, Search
from pgts_torch.search.known import KnownStates, state_bytes
from pgts_torch.search.lookahead import MAX_BYTES, Leaves
from pgts_torch.search.split import Selection
from pgts_torch.search.topology import Topology, gib, table_bytes, tree_nodes
from pgts_torch.search.tree import Tree, node_bytes
from pgts_torch.seeding import stream
from pgts_torch.tabular import random_mdp
from tests.search.models import WatchedModel

A, K = 3, 4
GARNET = random_mdp(4000, A, branching=K, seed=5)
ROOT = torch.tensor([0])


def zeros(state_N):
    return torch.zeros(len(state_N), dtype=torch.float64)


def test_the_estimate_is_what_the_tables_of_outcomes_take():
    outcomes = TabularModel(GARNET).outcomes(torch.arange(7))
    columns = (outcomes.reward_NA, outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK)
    assert table_bytes(7, A, K, torch.float64) == sum(column.numel() * column.element_size() for column in columns)


@pytest.mark.fault("lookahead larger than memory")
def test_a_lookahead_is_refused_before_the_level_that_would_not_fit_is_asked_for():
    model = WatchedModel(TabularModel(GARNET))
    nodes = expectimax(TabularModel(GARNET), ROOT, depth=3, v_leaf=zeros).nodes_per_level
    shallower = expectimax(TabularModel(GARNET), ROOT, depth=2, v_leaf=zeros).model_calls
    enough = table_bytes(sum(nodes[:3]), A, K, torch.float64)
    with pytest.raises(NodeBudgetExceeded) as caught:
        expectimax(model, ROOT, depth=3, v_leaf=zeros, topology=Topology(model, max_bytes=enough))
    assert len(model.asked) * A == shallower
    asked_for = sum(nodes[:4])
    assert str(caught.value) == (
        f"the outcomes of levels 0 to 3 of the 4 of the lookahead ({asked_for} nodes, 3 actions, 4 outcomes of each: "
        f"up to {asked_for * A * K} children) would take {table_bytes(asked_for, A, K, torch.float64) / 2**30:.3g} "
        f"GiB; the limit is {enough / 2**30:.3g} GiB: set a smaller depth or max_width, fewer environments, or the "
        "search sampled with fewer samples"
    )
    model = WatchedModel(TabularModel(GARNET))
    expectimax(model, ROOT, depth=2, v_leaf=zeros, topology=Topology(model, max_bytes=enough))
    assert len(model.asked) * A == shallower


def test_the_memory_of_a_narrow_lookahead_is_that_of_a_level():
    model = TabularModel(GARNET)
    topology = Topology(model, max_bytes=table_bytes(20, A, K, torch.float64))
    expectimax(model, ROOT, depth=5, v_leaf=zeros, topology=topology, max_width=20)
    with pytest.raises(NodeBudgetExceeded, match=r"the outcomes of one level of the lookahead \(21 nodes"):
        expectimax(model, ROOT, depth=5, v_leaf=zeros, topology=topology, max_width=21)


def test_the_search_that_chooses_narrows_until_it_fits():
    search = AutoSearch(TabularModel(GARNET))
    search.topology = Topology(TabularModel(GARNET), max_bytes=table_bytes(50, A, K, torch.float64))
    look = search(ROOT, depth=5, v_leaf=zeros, generator=stream(0, "search"))
    assert max(look.nodes_per_level) > 50 > look.model_calls / A / 5
    assert float(look.pruned_BA.max()) > 0


def bytes_of(tables: object, *endings: str) -> int:
    """What a row of the tables of an object takes, by the axes in which their names end."""
    return sum(x[0].numel() * x.element_size() for name, x in vars(tables).items() if name.endswith(endings))


def test_the_estimates_of_a_tree_are_what_its_tables_take():
    model = TabularModel(GARNET)
    known = KnownStates(Topology(model), Leaves(model, 2, None, zeros), None)
    known.rows(ROOT)
    tree = Tree(known, 3, Selection("gumbel", 1.25), backup="max", merge=False, max_nodes=100, room=1)
    assert node_bytes(7, A, K, torch.float64) == 7 * bytes_of(tree, "_N", "_NA", "_NE")
    of_outcomes = table_bytes(7, A, K, torch.float64)
    assert state_bytes(7, A, K, torch.float64) - of_outcomes == 7 * bytes_of(known, "_T", "_TA", "_TE")


@pytest.mark.fault("lookahead larger than memory")
@pytest.mark.parametrize("merge", [False, True])
def test_a_tree_is_refused_before_the_states_that_would_not_fit_are_asked_about(merge):
    def look(simulations: int, max_bytes: int) -> WatchedModel:
        model = WatchedModel(TabularModel(GARNET))
        topology = Topology(model, max_bytes=max_bytes)
        options = {"simulations": simulations, "wave": 1, "merge": merge, "topology": topology}
        mcts(model, ROOT, depth=3, v_leaf=zeros, **options)
        return model

    states = len(set(look(12, MAX_BYTES).asked))
    levels = 8 * 5 * (1 + merge * GARNET.num_states)
    nodes = node_bytes(13, A, K, torch.float64)  # one for each simulation, and the one that is none
    enough = levels + nodes + state_bytes(states, A, K, torch.float64)
    assert len(look(12, enough).asked) == states
    with pytest.raises(NodeBudgetExceeded, match="for its nodes"):
        look(12, enough - 1)
    with pytest.raises(NodeBudgetExceeded):
        look(13, enough)


def test_roots_that_would_not_fit_are_refused_before_the_model_is_asked():
    model = WatchedModel(TabularModel(GARNET))
    topology = Topology(model, max_bytes=10_000)
    with pytest.raises(NodeBudgetExceeded) as caught:
        mcts(model, torch.arange(50), depth=3, v_leaf=zeros, simulations=9, topology=topology)
    assert len(model.asked) == 0
    needed = state_bytes(50, A, 1, torch.float64)
    assert str(caught.value) == (
        f"the search would take {gib(needed)}: 0 GiB for its nodes and {gib(needed)} for 50 states of 3 actions and 1 "
        f"outcomes of each; the limit is {gib(10_000)}: lower the simulations, ask for fewer roots or raise max_bytes"
    )


def test_a_tree_of_more_levels_than_memory_is_refused_at_once():
    with pytest.raises(NodeBudgetExceeded, match=r"would take 7\.45 GiB: 7\.45 GiB for its nodes"):
        mcts(TabularModel(GARNET), ROOT, depth=10**9, v_leaf=zeros, simulations=2)


def test_samples_that_would_not_fit_are_refused_before_one_is_drawn():
    def look(samples: int) -> int:
        knobs = {"samples": samples, "generator": stream(0, "search"), "max_bytes": table_bytes(1, A, 8, torch.float64)}
        return sampled(TabularModel(GARNET), ROOT, depth=0, v_leaf=zeros, replicates=0, **knobs).model_calls

    assert look(8) == 8 * A
    with pytest.raises(NodeBudgetExceeded, match=r"1 nodes, 3 actions, 9 outcomes of each: up to 27 children"):
        look(9)


@pytest.mark.parametrize("kind", [AutoSearch, ExpectimaxSearch, SampledSearch, MCTSSearch])
def test_every_kind_of_search_has_the_limit_also_after_it_has_forgotten(kind):
    def refuses(search: Search, root_B: Tensor) -> bool:
        try:
            search(root_B, depth=1, v_leaf=zeros, generator=stream(0, "search"))
        except NodeBudgetExceeded:
            return True
        return False

    model = TabularModel(GARNET)
    search = kind(model, max_bytes=2_000)
    for _ in range(2):
        assert refuses(search, torch.arange(40))
        search.forget()
    assert not refuses(kind(model), torch.arange(40))
    assert SearchConfig().max_bytes == MAX_BYTES


@pytest.mark.fault("lookahead of too many nodes")
def test_too_many_nodes_are_refused_with_how_many_there_may_be_at_that_depth():
    model = WatchedModel(TabularModel(GARNET))
    with pytest.raises(NodeBudgetExceeded) as caught:
        expectimax(model, ROOT, depth=30, v_leaf=zeros, max_nodes=12)
    most = 1 + sum(12.0**level * A * K for level in range(31))
    assert f"has 13 nodes on levels 0 to 1; max_nodes is 12, and levels 0 to 31 hold up to {most:.3g}: set" in str(
        caught.value
    )
    assert len(model.asked) == 1


@pytest.mark.parametrize(("children", "expansions"), [(1, 5), (2, 0), (3, 4), (12, 10)])
def test_the_nodes_of_a_tree_are_the_sum_over_its_levels(children, expansions):
    assert tree_nodes(7, children, expansions) == sum(7 * children**level for level in range(expansions + 1))


def test_the_nodes_of_a_tree_beyond_all_numbers_are_infinite():
    assert tree_nodes(1, 2, 10**30) == float("inf") > tree_nodes(1, 1, 10**30)
