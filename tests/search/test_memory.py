"""A lookahead that would not fit into memory is refused before it asks the model for what would fill it."""

import sys
from contextlib import nullcontext

import pytest
import torch
from torch import Tensor

from pgts_torch.compiled import torch_only
from pgts_torch.errors import NodeBudgetExceeded
from pgts_torch.models.base import EnumeratingModel
from pgts_torch.models.tabular import TabularModel
from pgts_torch.options import MCTS, Auto, Expectimax, Sampled
from pgts_torch.options.search import MAX_BYTES
from pgts_torch.search import expectimax, mcts, sampled
from pgts_torch.search import known as known_module
from pgts_torch.search import state_records as records_module
from pgts_torch.search import topology as topology_module
from pgts_torch.search.auto import AutoSearch
from pgts_torch.search.engine import ExpectimaxSearch, MCTSSearch, SampledSearch, Search
from pgts_torch.search.known import KnownStates
from pgts_torch.search.lookahead import Leaves, Lookahead
from pgts_torch.search.memory import Sizes, tree_nodes
from pgts_torch.search.nodes import Nodes
from pgts_torch.search.topology import Topology
from pgts_torch.seeding import stream
from pgts_torch.tabular import random_mdp
from tests.memory import peak_bytes
from tests.search.models import WatchedModel, zeros

MCTS_MODULE = sys.modules["pgts_torch.search.mcts"]  # whose name in the package is that of the function

A, K = 3, 4
GARNET = random_mdp(4000, A, branching=K, seed=5)
ROOT = torch.tensor([0])


def look_of(kind: str, model: EnumeratingModel, max_bytes: int) -> tuple[Lookahead, Topology]:
    """One search, with what it leaves behind."""
    root_B, critic = torch.arange(40), lambda state_N: torch.zeros(len(state_N), dtype=model.dtype)
    topology = Topology(model, max_bytes=max_bytes)
    ask = {"model": model, "root_B": root_B, "depth": 2, "v_leaf": critic}
    if kind.startswith("sampled"):
        share, generator = kind.removeprefix("sampled "), stream(0, "search")
        return sampled(**ask, samples=3, share=share, generator=generator, max_bytes=max_bytes), topology
    if kind.startswith("mcts"):
        A = model.num_actions
        options = {
            "mcts": {},
            "mcts, in waves": {"wave": 30},
            "mcts, fixed": {"wave": 1},
            "mcts, prior": {"prior": lambda state_N: torch.full((len(state_N), A), 1 / A)},
            "mcts, merged": {"merge": True},
            "mcts, means": {"backup": "mean"},
        }[kind]
        with torch_only() if kind == "mcts, fixed" else nullcontext():
            return mcts(**ask, simulations=30, topology=topology, **options), topology
    return expectimax(**ask, topology=topology, max_width=100 if kind == "pruned" else None), topology


def least_bytes(kind: str, model: EnumeratingModel, monkeypatch: pytest.MonkeyPatch) -> int:
    """The smallest limit under which the search is made."""
    told = [0]
    with monkeypatch.context() as patch:
        for module in (topology_module, known_module, records_module, MCTS_MODULE):
            patch.setattr(module, "check_memory", lambda needed, most, what: told.append(needed))
        look_of(kind, model, MAX_BYTES)
    return max(told)


KINDS = [
    "expectimax",
    "pruned",
    "sampled level",
    "sampled none",
    "sampled search",
    "mcts",
    "mcts, in waves",
    "mcts, fixed",
    "mcts, prior",
    "mcts, merged",
    "mcts, means",
]
TABLES = {"K = 4": (800, 3, 4), "K = 20": (200, 2, 20)}


@pytest.mark.fault("lookahead larger than memory")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("table", TABLES)
def test_a_search_stays_below_the_limit_and_is_refused_just_below_what_it_needs(kind, table, monkeypatch):
    S, A, K = TABLES[table]
    model = TabularModel(random_mdp(S, A, branching=K, seed=5))
    enough = least_bytes(kind, model, monkeypatch)
    peak = peak_bytes(lambda: look_of(kind, model, enough))
    assert enough / 5 < peak <= enough
    with pytest.raises(NodeBudgetExceeded, match=r"would take up to .* GiB; the limit is .* GiB: set a smaller depth"):
        look_of(kind, model, enough - 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_search_that_goes_deeper_again_and_over_other_roots_stays_below_the_limit(dtype):
    model = TabularModel(random_mdp(2000, 3, branching=3, seed=5), dtype=dtype)
    limit, made = 1_250_000, []

    def searches() -> Topology:
        topology = Topology(model, max_bytes=limit)
        for first in range(0, 300, 50):
            for depth in (1, 3):
                critic = lambda state_N: torch.zeros(len(state_N), dtype=dtype)  # noqa: E731
                try:
                    expectimax(model, torch.arange(first, first + 50), depth=depth, v_leaf=critic, topology=topology)
                    made.append(True)
                except NodeBudgetExceeded:
                    made.append(False)
        return topology

    assert limit / 3 < peak_bytes(searches) <= limit
    assert any(made)
    assert not all(made)


def test_where_the_model_does_not_say_K_it_is_counted_from_its_first_answer():
    class Silent(WatchedModel):
        def __init__(self, model: EnumeratingModel) -> None:
            super().__init__(model)
            self.num_outcomes = None

    wide = TabularModel(random_mdp(400, 2, branching=200, seed=5))
    limit = 10_000_000
    with pytest.raises(NodeBudgetExceeded, match="400 nodes, 2 actions, 200 outcomes of each"):
        expectimax(
            model := Silent(wide), torch.arange(400), depth=1, v_leaf=zeros, topology=Topology(model, max_bytes=limit)
        )
    assert model.calls == [[0]]


def test_rows_of_tables_are_what_they_take():
    model = TabularModel(GARNET)
    outcomes = model.outcomes(torch.arange(7))
    columns = (outcomes.reward_NA, outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK)
    sizes = Sizes(A, K, torch.float64)
    assert 7 * sizes.outcomes == sum(column.numel() * column.element_size() for column in columns)
    known = KnownStates(Topology(model), Leaves(model, 2, None, zeros))
    known.rows(ROOT)
    nodes = Nodes(known, 3, merge=False, revisits=False, max_nodes=100, room=1)
    assert sizes.node == bytes_of(nodes, "_N", "_NA", "_NAK")
    assert sizes.known == bytes_of(known, "_T", "_TA", "_TAK")


def bytes_of(tables: object, *endings: str) -> int:
    """What a row of the tables of an object takes, by the axes in which their names end."""
    return sum(x[0].numel() * x.element_size() for name, x in vars(tables).items() if name.endswith(endings))


@pytest.mark.fault("lookahead larger than memory")
def test_a_lookahead_is_refused_before_the_model_is_queried_for_a_level_that_would_not_fit(monkeypatch):
    model = WatchedModel(TabularModel(GARNET))
    shallower = expectimax(TabularModel(GARNET), ROOT, depth=2, v_leaf=zeros).model_calls
    topology = Topology(model, max_bytes=10**6)
    with pytest.raises(
        NodeBudgetExceeded, match=r"outcomes of level 3 of the 4 of the lookahead \(\d+ nodes, 3 actions, 4"
    ):
        expectimax(model, ROOT, depth=3, v_leaf=zeros, topology=topology)
    assert len(model.queried) * A == shallower


def test_the_automatic_search_narrows_until_it_fits():
    search = AutoSearch(TabularModel(GARNET), Auto(max_bytes=10**6))
    look = search(ROOT, depth=5, v_leaf=zeros, generator=stream(0, "search"))
    assert max(look.nodes_per_level) > 50
    assert float(look.pruned_BA.max()) > 0
    assert str(search).startswith("expectimax, ")


def test_roots_that_would_not_fit_are_refused_before_the_model_is_queried():
    model = WatchedModel(TabularModel(GARNET))
    for search in (mcts, expectimax):
        options = {"simulations": 9} if search is mcts else {}
        topology = Topology(model, max_bytes=200_000)
        with pytest.raises(NodeBudgetExceeded):
            search(model, torch.arange(500), depth=3, v_leaf=zeros, topology=topology, **options)
    assert len(model.queried) == 0


def test_a_tree_of_more_levels_than_memory_is_refused_at_once():
    with pytest.raises(NodeBudgetExceeded, match=r"the search \(0 nodes, .* would take up to 7\.45 GiB"):
        mcts(TabularModel(GARNET), ROOT, depth=10**9, v_leaf=zeros, simulations=2)


def test_samples_that_would_not_fit_are_refused_before_the_model_is_sampled(monkeypatch):
    model = TabularModel(GARNET)
    monkeypatch.setattr(TabularModel, "sample", lambda *_, **__: pytest.fail("it was drawn from"))
    with pytest.raises(NodeBudgetExceeded, match="1 nodes, 3 actions, 900000 outcomes of each"):
        sampled(model, ROOT, depth=0, v_leaf=zeros, samples=900_000, generator=stream(0, "s"), max_bytes=10**8)


@pytest.mark.parametrize(
    ("kind", "options"),
    [(AutoSearch, Auto), (ExpectimaxSearch, Expectimax), (SampledSearch, Sampled), (MCTSSearch, MCTS)],
)
def test_every_kind_of_search_has_the_limit_also_after_a_reset(kind, options):
    def refuses(search: Search, root_B: Tensor) -> bool:
        try:
            search(root_B, depth=1, v_leaf=zeros, generator=stream(0, "search"))
        except NodeBudgetExceeded:
            return True
        return False

    model = TabularModel(GARNET)
    search = kind(model, options(max_bytes=150_000))
    for _ in range(2):
        assert refuses(search, torch.arange(40))
        search.reset()
    assert not refuses(kind(model), torch.arange(40))
    assert Auto().max_bytes == MAX_BYTES


@pytest.mark.fault("lookahead of too many nodes")
def test_too_many_nodes_are_refused_with_how_many_there_may_be_at_that_depth():
    model = WatchedModel(TabularModel(GARNET))
    with pytest.raises(NodeBudgetExceeded) as caught:
        expectimax(model, ROOT, depth=30, v_leaf=zeros, max_nodes=12)
    most = 1 + sum(12.0**level * A * K for level in range(31))
    assert f"has 13 nodes on levels 0 to 1; max_nodes is 12, and levels 0 to 31 hold up to {most:.3g}: set" in str(
        caught.value
    )
    assert len(model.queried) == 1


@pytest.mark.parametrize(("children", "expansions"), [(1, 5), (2, 0), (3, 4), (12, 10)])
def test_the_nodes_of_a_tree_are_the_sum_over_its_levels(children, expansions):
    assert tree_nodes(7, children, expansions) == sum(7 * children**level for level in range(expansions + 1))


def test_the_nodes_of_a_tree_beyond_all_numbers_are_infinite():
    assert tree_nodes(1, 2, 10**30) == float("inf") > tree_nodes(1, 1, 10**30)
