"""A lookahead that would not fit into memory is refused before it asks the model for what would fill it."""

import pytest
import torch

from pgts_torch.errors import NodeBudgetExceeded
from pgts_torch.models.tabular import TabularModel
from pgts_torch.search import expectimax
from pgts_torch.search.auto import AutoSearch
from pgts_torch.search.topology import Topology, table_bytes, tree_nodes
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
        "search sampled"
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
