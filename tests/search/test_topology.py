"""For what a search queries its model, how many nodes it has, and what it remembers."""

import contextlib
import time
import weakref

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch import compiled
from pgts_torch.bellman import Outcomes
from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models import EnumeratingModel, TabularModel
from pgts_torch.search import Lookahead, Topology, expectimax, mcts
from pgts_torch.search.outcome_table import OutcomeTable
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, ladder, random_mdp
from tests.memory import peak_bytes
from tests.search.models import Critic, InterningModel, WatchedModel, paths, some_q, some_v, watched, zeros
from tests.support import mdps, zoo


def nodes_per_level(mdp: TabularMDP, root: int, expansions: int) -> list[int]:
    look = expectimax(
        TabularModel(mdp), torch.tensor([root]), depth=expansions, q_leaf=lambda s: zeros(s)[:, None] + zeros_of(mdp)
    )
    assert look.nodes == sum(look.nodes_per_level)
    return list(look.nodes_per_level)


def zeros_of(mdp: TabularMDP) -> Tensor:
    return torch.zeros(mdp.num_actions, dtype=torch.float64)


# Merging, by counts against closed forms


def test_a_tree_whose_paths_never_meet_has_A_times_K_to_the_level_nodes():
    model = InterningModel(paths, [()], num_actions=2)
    look = expectimax(model, torch.tensor([0]), depth=5, v_leaf=zeros)
    assert look.nodes_per_level == tuple(4**level for level in range(7))
    assert look.model_calls == 2 * sum(4**level for level in range(6))


def test_a_ladder_has_one_node_more_at_each_level_until_it_ends():
    assert nodes_per_level(ladder(6), 0, 10) == [min(level + 1, 6) for level in range(11)]


def test_a_grid_has_a_triangle_of_nodes_below_its_corner():
    triangle = [sum(row + column <= level for row in range(7) for column in range(7)) for level in range(20)]
    assert nodes_per_level(grid(7, traps=()), 0, 19) == triangle


def test_a_deep_sea_has_as_many_nodes_at_each_level_as_its_row_has_cells_within_reach():
    n = 7
    rows = [row + 1 for row in range(n)]
    assert nodes_per_level(deep_sea(n), 0, 9) == [*rows, *[sum(rows)] * 3]


def test_a_deep_sea_of_50_is_queried_once_for_each_cell_within_reach():
    m, model = 50, watched(deep_sea(50))
    look = expectimax(model, torch.tensor([0]), depth=m, v_leaf=zeros)
    assert look.model_calls == m * (m + 1)
    assert sorted(model.queried) == [50 * row + column for row in range(m) for column in range(row + 1)]


# Queries


@given(mdps(max_states=8), st.data())
def test_in_however_many_searches_no_state_is_queried_twice_and_each_is_T_to_the_m(mdp, data):
    model = watched(mdp)
    topology, q_SA = Topology(model), some_q(mdp)
    roots = st.lists(st.integers(0, mdp.num_states - 1), min_size=1, max_size=3)
    reported = 0
    for root_list, depth in data.draw(st.lists(st.tuples(roots, st.integers(0, 7)), min_size=1, max_size=14)):
        root_B = torch.tensor(root_list)
        look = expectimax(model, root_B, depth=depth, q_leaf=Critic(q_SA), topology=topology)
        fresh = expectimax(TabularModel(mdp), root_B, depth=depth, q_leaf=Critic(q_SA))
        assert torch.equal(look.q_BA, fresh.q_BA)
        assert look.nodes_per_level == fresh.nodes_per_level
        torch.testing.assert_close(look.q_BA, exact.lookahead(mdp, q_SA, depth)[root_B], rtol=1e-11, atol=1e-11)
        reported += look.model_calls
    assert len(model.queried) == len(set(model.queried))
    assert reported == topology.table.model_calls == mdp.num_actions * len(model.queried)


def test_without_a_topology_each_search_queries_the_model_again():
    model = watched(ladder(4))
    first, second = (expectimax(model, torch.tensor([0]), depth=9, v_leaf=zeros) for _ in range(2))
    assert first.model_calls == second.model_calls == 8
    assert sorted(model.queried) == [0, 0, 1, 1, 2, 2, 3, 3]


def test_the_same_roots_again_and_other_known_states_need_no_queries():
    model = watched(zoo("grid"))
    topology = Topology(model)
    first = expectimax(model, torch.tensor([0, 99]), depth=9, v_leaf=zeros, topology=topology)
    assert first.model_calls == 4 * 100
    calls = len(model.calls)
    for roots in ([0, 99], [99, 0], [50], [7, 31, 31]):
        assert expectimax(model, torch.tensor(roots), depth=7, v_leaf=zeros, topology=topology).model_calls == 0
    assert len(model.calls) == calls


def test_a_deeper_lookahead_queries_only_new_states():
    model = watched(ladder(9))
    topology, root = Topology(model), torch.tensor([0])
    calls = [expectimax(model, root, depth=m, v_leaf=zeros, topology=topology).model_calls for m in (2, 1, 4, 2, 20)]
    assert calls == [2 * 3, 0, 2 * 2, 0, 2 * 4]


def test_doubling_the_depth_on_a_closed_set_needs_no_queries():
    model = watched(grid())
    topology = Topology(model)
    looks = [
        expectimax(model, torch.tensor([0]), depth=m, v_leaf=zeros, topology=topology).model_calls for m in (32, 64)
    ]
    assert looks == [4 * 100, 0]


def test_depth_0_needs_no_queries_with_q_and_those_of_the_roots_with_v():
    mdp = zoo("garnet")
    for leaf, queried in [({"q_leaf": Critic(some_q(mdp))}, []), ({"v_leaf": Critic(some_v(mdp))}, [4, 21])]:
        model = watched(mdp)
        expectimax(model, torch.tensor([21, 4, 21]), depth=0, **leaf)
        assert model.queried == queried


@pytest.mark.parametrize("depth", [0, 1, 5, 40])
def test_the_critic_is_called_once_for_distinct_states(depth):
    mdp = zoo("garnet")
    for critic, name in [(Critic(some_q(mdp)), "q_leaf"), (Critic(some_v(mdp)), "v_leaf")]:
        look = expectimax(TabularModel(mdp), torch.tensor([0, 5, 0]), depth=depth, **{name: critic})
        assert len(critic.calls) == look.critic_calls == 1
        assert len(critic.calls[0]) == len(set(critic.calls[0])) == look.nodes_per_level[-1]


@pytest.mark.parametrize("ends", [True, False])
def test_what_follows_a_terminal_outcome_alone_is_no_node(ends):
    mdp = TabularMDP.from_transitions(
        [
            [[(0.5, 1, 1.0, False), (0.5, 2, 5.0, ends)]],
            [[(1.0, 0, 2.0, False)]],
            [[(1.0, 2, 0.0, True)]],
        ],
        0.9,
    )
    met = set[int]()
    for depth in range(6):
        model, critic = watched(mdp), Critic(some_v(mdp))
        expectimax(model, torch.tensor([0]), depth=depth, v_leaf=critic)
        met.update(critic.calls[0], model.queried)
    assert (2 in met) == (not ends)


# Memory


def test_a_topology_serves_one_model():
    mdp = ladder()
    with pytest.raises(PgtsError, match="topology belongs to another model"):
        expectimax(TabularModel(mdp), torch.tensor([0]), depth=1, v_leaf=zeros, topology=Topology(TabularModel(mdp)))


def test_two_batches_of_roots_that_take_turns_do_not_disturb_each_other():
    mdp = zoo("grid")
    model, q_SA = TabularModel(mdp), some_q(mdp)
    topology = Topology(model)
    expected = [exact.lookahead(mdp, q_SA, depth) for depth in range(25)]
    for depth in [1, 4, 2, 20, 3, 24, 0]:
        for roots in ([0], [45, 54]):
            look = expectimax(model, torch.tensor(roots), depth=depth, q_leaf=Critic(q_SA), topology=topology)
            torch.testing.assert_close(look.q_BA, expected[depth][roots], rtol=1e-11, atol=1e-11)


def test_levels_of_the_oldest_batch_of_roots_are_dropped():
    mdp = zoo("garnet")
    model, q_SA = watched(mdp), some_q(mdp)
    topology = Topology(model)
    expected = exact.lookahead(mdp, q_SA, 4)
    oldest = weakref.ref(topology.levels(torch.tensor([0]), 4, max_nodes=1000))
    assert oldest() is not None
    for root in [*range(30), *range(30)]:
        look = expectimax(model, torch.tensor([root]), depth=4, q_leaf=Critic(q_SA), topology=topology)
        torch.testing.assert_close(look.q_BA[0], expected[root], rtol=1e-11, atol=1e-11)
    assert oldest() is None
    assert len(model.queried) == len(set(model.queried))


def test_levels_of_a_batch_of_roots_that_is_used_again_are_kept():
    model = TabularModel(zoo("garnet"))
    topology, root = Topology(model), torch.tensor([0])
    levels = topology.levels(root, 3, max_nodes=1000)
    for other in range(1, 30):
        topology.levels(torch.tensor([other]), 3, max_nodes=1000)
        assert topology.levels(root, 3, max_nodes=1000) is levels


# The budget


@pytest.mark.fault("lookahead of too many nodes")
def test_a_lookahead_beyond_its_budget_is_refused_before_the_model_is_queried_for_the_level_that_breaks_it():
    model = WatchedModel(InterningModel(paths, [()], num_actions=2))
    topology, root = Topology(model), torch.tensor([0])

    def look(max_nodes: int) -> int:
        return expectimax(model, root, depth=3, v_leaf=zeros, topology=topology, max_nodes=max_nodes).model_calls

    with pytest.raises(NodeBudgetExceeded, match=r"has 21 nodes on levels 0 to 2; max_nodes is 20"):
        look(20)
    assert len(model.queried) == 1 + 4
    with pytest.raises(NodeBudgetExceeded, match="has 85 nodes"):
        look(84)
    assert len(model.queried) == 1 + 4 + 16
    # The leaves count as well, and nobody asks the model about them.
    with pytest.raises(NodeBudgetExceeded, match="has 341 nodes"):
        look(340)
    assert len(model.queried) == 1 + 4 + 16 + 64
    assert look(341) == 0
    assert len(model.queried) == len(set(model.queried)) == 1 + 4 + 16 + 64


def test_the_budget_of_a_closed_set_is_one_node_for_each_state_and_level():
    model, root = TabularModel(ladder(5)), torch.tensor([0])
    nodes = 1 + 2 + 3 + 4 + 5 * 7
    assert expectimax(model, root, depth=9, v_leaf=zeros, max_nodes=nodes).nodes == nodes
    with pytest.raises(NodeBudgetExceeded, match=f"has {nodes} nodes"):
        expectimax(model, root, depth=9, v_leaf=zeros, max_nodes=nodes - 1)


def test_an_absurd_depth_on_a_closed_set_is_refused_at_once():
    model, started = watched(ladder(5)), time.process_time()
    for depth in (10**9, 10**30):
        with pytest.raises(NodeBudgetExceeded, match=f"has {5 * (depth - 3) + 15} nodes"):
            expectimax(model, torch.arange(1), depth=depth, v_leaf=zeros, topology=Topology(model))
    assert time.process_time() - started < 5  # the sweeps alone would take an hour
    assert len(model.queried) == 2 * 5


def test_more_distinct_roots_than_the_budget_are_refused_before_a_query():
    model = watched(ladder(5))
    with pytest.raises(NodeBudgetExceeded, match="has 5 nodes"):
        expectimax(model, torch.arange(5), depth=3, v_leaf=zeros, max_nodes=4)
    assert model.queried == []


# Models that break their word


class Liar(EnumeratingModel):
    """A ladder with its answer changed."""

    def __init__(self, change: str) -> None:
        self.model, self.change = TabularModel(ladder(5)), change
        self.num_states, self.num_actions, self.num_outcomes = 5, 2, 1
        self.device, self.dtype = self.model.device, self.model.dtype

    def outcomes(self, state_N: Tensor) -> Outcomes:
        answer = self.model.outcomes(state_N)
        if self.change == "rows":
            return answer.rows(torch.tensor([0]))
        answer.child_NAK[-1, 1, 0] = {"far": 5, "negative": -1, "none": 4}[self.change]
        return answer


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("rows", r"model returned outcomes of \(1, 2\) states and actions; they must be of \(3, 2\)"),
        ("far", "child of outcome 0 of state 4 and action 1 is 5; states are 0 to 4"),
        ("negative", "child of outcome 0 of state 4 and action 1 is -1"),
    ],
)
def test_an_answer_that_cannot_be_true_is_refused_and_named(change, message):
    with pytest.raises(PgtsError, match=message):
        expectimax(Liar(change), torch.tensor([0, 2, 4]), depth=2, v_leaf=zeros)
    expectimax(Liar("none"), torch.tensor([0, 2, 4]), depth=2, v_leaf=zeros)


class Fainting(WatchedModel):
    """A model that fails once."""

    def outcomes(self, state_N: Tensor) -> Outcomes:
        if len(self.calls) == 2:
            self.calls.append([])
            raise ConnectionError("the model is out of reach")
        return super().outcomes(state_N)


def test_a_search_that_failed_in_its_model_can_be_repeated():
    mdp = zoo("grid")
    model, q_SA, root = Fainting(TabularModel(mdp)), some_q(mdp), torch.tensor([44])
    topology = Topology(model)
    with pytest.raises(ConnectionError):
        expectimax(model, root, depth=6, q_leaf=Critic(q_SA), topology=topology)
    look = expectimax(model, root, depth=6, q_leaf=Critic(q_SA), topology=topology)
    torch.testing.assert_close(look.q_BA[0], exact.lookahead(mdp, q_SA, 6)[44], rtol=1e-11, atol=1e-11)
    assert len(model.queried) == len(set(model.queried))


# Levels over the table of the model, by compiled loops, and as torch finds them


def searches_of(mdp: TabularMDP, dtype: torch.dtype, root_B: Tensor) -> list[Lookahead]:
    """Deeper and deeper, from the same roots and from others, over one topology; some of bounded width."""
    model = TabularModel(mdp, dtype=dtype)
    topology, v_S = Topology(model), torch.randn(mdp.num_states, generator=stream(0, "v")).to(dtype)
    return [
        expectimax(model, roots, depth=depth, v_leaf=lambda n: v_S[n], topology=topology, max_width=width)
        for depth in (0, 1, 3, 9)
        for roots in (root_B, root_B[:1])
        for width in (None, 4, None)
    ]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    "mdp",
    [
        grid(),
        deep_sea(20),
        random_mdp(300, 3, branching=2, seed=1),
        random_mdp(80, 4, branching=5, seed=2),
        random_mdp(4000, 2, branching=1, seed=3),
    ],
    ids=["closed roots", "ends", "garnet", "wide garnet", "many states, certain"],
)
def test_levels_read_from_the_table_of_the_model_are_those_of_its_answers(mdp, dtype):
    pytest.importorskip("numba")
    root_B = torch.tensor([5, 0, 5, 17])
    found = searches_of(mdp, dtype, root_B)
    with compiled.torch_only():
        expected = searches_of(mdp, dtype, root_B)
    for got, wanted in zip(found, expected, strict=True):
        assert got.nodes_per_level == wanted.nodes_per_level
        assert (got.model_calls, got.critic_calls) == (wanted.model_calls, wanted.critic_calls)
        tolerance = 1e-12 if dtype == torch.float64 else 1e-5
        torch.testing.assert_close(got.q_BA, wanted.q_BA, rtol=tolerance, atol=tolerance)
        torch.testing.assert_close(got.pruned_BA, wanted.pruned_BA, rtol=tolerance, atol=tolerance)
    assert len({look.nodes for look in found}) > 3


def test_what_was_read_in_the_table_of_the_model_counts_as_queried_and_is_copied_where_rows_are_needed():
    mdp = random_mdp(200, 3, branching=2, seed=1)
    model = TabularModel(mdp)
    topology = Topology(model)
    calls = expectimax(model, torch.tensor([0]), depth=2, v_leaf=zeros, topology=topology).model_calls
    queried = topology.table.queried
    assert topology.table.num_queried == len(queried) == calls / 3
    state_R, outcomes = topology.table.all()
    assert torch.equal(state_R.sort().values, queried)
    rows = mdp.outcomes.rows(state_R)
    for name in ("reward_NA", "prob_NAK", "discount_NAK", "child_NAK"):
        assert torch.equal(getattr(outcomes, name), getattr(rows, name))
    assert mcts(model, torch.tensor([0]), depth=2, v_leaf=zeros, simulations=8, topology=topology).model_calls == 0
    assert topology.table.model_calls == calls


def test_a_search_that_reads_the_table_of_the_model_keeps_less_than_half_of_what_answers_take():
    pytest.importorskip("numba")
    model, root_B = TabularModel(random_mdp(5000, 4, branching=5, seed=1)), torch.arange(100)
    search = lambda: expectimax(model, root_B, depth=4, v_leaf=zeros, topology=Topology(model))  # noqa: E731
    nodes = search().nodes
    with compiled.torch_only():
        copies = peak_bytes(search)
    assert peak_bytes(search) <= min(250 * nodes, copies / 2)


# Answers, checked and written


class Answering(EnumeratingModel):
    """Gives prepared answers, whatever is asked; its number of outcomes varies."""

    num_states, num_actions, device = 50, 3, torch.device("cpu")

    def __init__(self, answers: list[Outcomes]) -> None:
        self.answers, self.dtype = answers, answers[0].dtype

    def outcomes(self, state_N: Tensor) -> Outcomes:
        return self.answers.pop(0)


def answer_of(K: int, *, dtype: torch.dtype = torch.float64, seed: int = 0, **changed: float) -> Outcomes:
    """Five states; `changed` puts a number at the last state, its first action and the last of its outcomes."""
    generator, shape = stream(seed, "answer"), (5, 3, K)
    prob_NAK = torch.rand(shape, generator=generator, dtype=torch.float64)
    prob_NAK /= prob_NAK.sum(-1, keepdim=True)
    reward_NA = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    reward_NA[2, 1] = -torch.inf
    prob_NAK[2, 1] = 0.25  # what is not allowed need not sum to 1
    discount = torch.tensor(0.9, dtype=dtype).expand(shape).clone()
    child_NAK = torch.randint(50, shape, generator=generator)
    answer = Outcomes(reward_NA.to(dtype), prob_NAK.to(dtype), discount, child_NAK, 50)
    for name, value in changed.items():
        x = getattr(answer, name)
        x[(4, 0, -1)[: x.ndim]] = value
    return answer


def table_of(answers: list[Outcomes]) -> OutcomeTable:
    table = OutcomeTable(Answering(answers))
    for first in range(0, 5 * len(answers), 5):
        table.query(torch.arange(first, first + 5))
    return table


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_and_torch_write_the_same_table_however_many_outcomes_an_answer_has(dtype):
    pytest.importorskip("numba")
    answers = [answer_of(K, dtype=dtype, seed=i) for i, K in enumerate((2, 1, 4, 3, 4, 1))]
    columns = "reward_RA", "prob_RAK", "discount_RAK", "child_RAK", "row_S"
    with compiled.torch_only():
        plain = table_of(list(answers))
    table = table_of(list(answers))
    assert all(torch.equal(getattr(table, name)[:30], getattr(plain, name)[:30]) for name in columns)
    assert torch.equal(table.row_S, plain.row_S)
    assert table.count == plain.count == 30
    assert not torch.equal(table.reward_RA[:5], table.reward_RA[5:10])


@pytest.mark.parametrize(
    "changed",
    [
        {"reward_NA": torch.nan},
        {"reward_NA": torch.inf},
        {"reward_NA": -torch.inf},
        {"prob_NAK": -0.25},
        {"prob_NAK": 0.6},
        {"prob_NAK": torch.nan},
        {"discount_NAK": 1.5},
        {"discount_NAK": -0.5},
        {"discount_NAK": torch.nan},
        {"child_NAK": 50},
        {"child_NAK": -1},
    ],
)
def test_compiled_and_torch_refuse_the_same_answers_in_the_same_words_and_keep_nothing_of_them(changed):
    pytest.importorskip("numba")
    wrong, said = answer_of(2, **changed), []
    if changed == {"reward_NA": -torch.inf}:
        wrong.reward_NA[4] = -torch.inf
    for context in (compiled.torch_only(), contextlib.nullcontext()):
        with context:
            table = OutcomeTable(Answering([wrong, answer_of(1)]))
            with pytest.raises(PgtsError) as refused:
                table.query(torch.arange(5))
            said.append(str(refused.value))
            assert table.count == 0
            assert len(table.missing(torch.arange(50))) == 50
            table.query(torch.arange(5))
            assert not table.prob_RAK[:5, :, 1:].any()
    assert said[0] == said[1]
    assert "state 4" in said[0]
