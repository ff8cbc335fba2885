"""Lookahead of bounded width: exact where nothing is pruned, and off by no more than it says where something is."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup
from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.search import Lookahead, Topology, expectimax, pruned
from pgts_torch.tabular import TabularMDP, deep_sea, exact, ladder, random_mdp
from tests.search.models import Critic, InterningModel, assert_close, paths, some_q, some_v, watched, zeros
from tests.support import ZOO, mdps, uniform_policy, zoo


def q_above(mdp: TabularMDP, v_S: Tensor) -> Tensor:
    return backup(mdp.outcomes, v_S)


def worst_error(mdp: TabularMDP, v_S: Tensor, expansions: int) -> float:
    """max over states and 1 <= j <= expansions of |v - T^j v|: what a pruned state may hide."""
    error, deeper_S = 0.0, v_S
    for _ in range(expansions):
        deeper_S = q_above(mdp, deeper_S).amax(-1)
        error = max(error, float((deeper_S - v_S).abs().max()))
    return error


# Wide enough


@pytest.mark.parametrize("name", [name for name in ZOO if name != "Taxi"])
def test_a_width_that_prunes_nothing_gives_the_full_lookahead(name):
    mdp, model = zoo(name), TabularModel(zoo(name))
    roots = torch.tensor([0, mdp.num_states // 2, 0])
    for depth in (0, 1, 2, 5):
        for leaf in ({"v_leaf": Critic(some_v(mdp))}, {"q_leaf": Critic(some_q(mdp))}):
            full = expectimax(model, roots, depth=depth, **leaf)
            wide = expectimax(model, roots, depth=depth, max_width=mdp.num_states, **leaf)
            assert_close(wide.q_BA, full.q_BA)
            assert not wide.pruned_BA.any()
            assert wide.q_BA.dtype == wide.pruned_BA.dtype == wide.stderr_BA.dtype
            assert wide.pruned_BA.shape == wide.stderr_BA.shape == full.q_BA.shape


def test_a_width_that_prunes_gives_other_values():
    mdp = zoo("garnet")
    full = expectimax(TabularModel(mdp), torch.tensor([3]), depth=3, v_leaf=Critic(some_v(mdp)))
    narrow = expectimax(TabularModel(mdp), torch.tensor([3]), depth=3, v_leaf=Critic(some_v(mdp)), max_width=2)
    assert float((narrow.q_BA - full.q_BA).abs().max()) > 0.1
    assert bool((narrow.pruned_BA > 0).all())


# Never wider


@given(mdps(max_states=8), st.integers(0, 5), st.integers(1, 4), st.data())
def test_no_level_below_the_roots_expands_more_states_than_its_width(mdp, depth, width, data):
    roots = torch.tensor(data.draw(st.lists(st.integers(0, mdp.num_states - 1), min_size=1, max_size=4)))
    model = watched(mdp)
    look = expectimax(model, roots, depth=depth, v_leaf=Critic(some_v(mdp)), max_width=width)
    first, *below = model.calls
    assert sorted(first) == sorted(set(roots.tolist()))
    assert all(len(call) <= width for call in below)
    assert len(model.queried) == len(set(model.queried))
    assert look.model_calls == mdp.num_actions * len(model.queried)


# As far off as it says


@given(mdps(max_states=8), st.integers(0, 5), st.integers(1, 4), st.integers(0, 100), st.data())
def test_the_error_is_at_most_what_is_pruned_times_the_error_of_the_critic(mdp, depth, width, seed, data):
    roots = torch.tensor(data.draw(st.lists(st.integers(0, mdp.num_states - 1), min_size=1, max_size=4)))
    v_S, q_SA, model = some_v(mdp, seed), some_q(mdp, seed), TabularModel(mdp)
    by_v = expectimax(model, roots, depth=depth, v_leaf=Critic(v_S), max_width=width)
    by_q = expectimax(model, roots, depth=depth, q_leaf=Critic(q_SA), max_width=width)
    for look, values_S, expansions, q_above_SA in (
        (by_v, v_S, depth + 1, q_above(mdp, v_S)),
        (by_q, q_SA.amax(-1), depth, q_SA),
    ):
        error_BA = (look.q_BA - exact.lookahead(mdp, q_above_SA, depth)[roots]).abs()
        assert bool((error_BA <= look.pruned_BA * worst_error(mdp, values_S, expansions) + 1e-10).all())
        assert bool(((look.pruned_BA >= 0) & (look.pruned_BA <= 1 + 1e-12)).all())


def test_what_is_pruned_can_all_be_wrong():
    """Two states of which one is pruned: its error arrives at the root with the weight that is reported."""
    root, kept, other = 0, 1, 2
    mdp = TabularMDP.from_transitions(
        [
            [[(0.25, kept, 0.0, False), (0.75, other, 0.0, False)]],
            [[(1.0, kept, 1.0, False)]],
            [[(1.0, other, 1.0, False)]],
        ],
        0.5,
    )
    look = expectimax(TabularModel(mdp), torch.tensor([root]), depth=1, v_leaf=zeros, max_width=1)
    truth = exact.lookahead(mdp, mdp.outcomes.reward_NA, 1)[root]
    assert look.pruned_BA.item() == 0.125
    assert (truth - look.q_BA[0]).item() == 0.125


# Perfect critics


@pytest.mark.parametrize("name", [name for name in ZOO if name != "Taxi"])
def test_with_the_perfect_critic_one_state_a_level_is_enough(name):
    mdp = zoo(name)
    optimum = exact.optimal(mdp)
    roots = torch.arange(0, mdp.num_states, 1 + mdp.num_states // 8)
    for leaf in ({"v_leaf": Critic(optimum.v_S)}, {"q_leaf": Critic(optimum.q_SA)}):
        look = expectimax(TabularModel(mdp), roots, depth=5, max_width=1, **leaf)
        assert_close(look.q_BA, optimum.q_SA[roots], tolerance=1e-9)


def test_with_an_imperfect_critic_one_state_a_level_is_not_enough():
    mdp = zoo("grid")
    v_S = exact.optimal(mdp).v_S + some_v(mdp)
    look = expectimax(TabularModel(mdp), torch.tensor([0]), depth=5, max_width=1, v_leaf=Critic(v_S))
    truth = exact.lookahead(mdp, q_above(mdp, v_S), 5)[0]
    assert float((look.q_BA[0] - truth).abs().max()) > 0.1


# What is kept


def treasure(critic: Tensor, width: int | None) -> float:
    """What the best action of the first of 20 rows promises; only one path of 2 ** 20 leads to the treasure."""
    model = TabularModel(deep_sea(20))
    look = expectimax(model, torch.tensor([0]), depth=19, v_leaf=Critic(critic), max_width=width)
    return float(look.q_BA.max())


def test_in_a_deep_sea_a_good_critic_needs_width_1_and_a_constant_one_the_whole_level():
    mdp = deep_sea(20)
    found = float(exact.optimal(mdp).v_S[0])
    of_uniform = exact.policy_values(mdp, uniform_policy(mdp))
    nothing = torch.zeros(400, dtype=torch.float64)
    assert treasure(of_uniform, 1) == pytest.approx(found, rel=1e-9)
    assert treasure(nothing, 20) == treasure(nothing, None) == pytest.approx(found, rel=1e-9)
    assert treasure(nothing, 19) == 0  # to go right costs something
    misled = -(torch.arange(400) % 20).double()
    assert treasure(misled, 19) < found / 2


def fork(p: float, v: tuple[float, float]) -> Lookahead:
    """One root, one action, two states that earn 1 for ever, of which one is expanded: the first has probability p."""
    followers = [(p, 1, 0.0, False), (1 - p, 2, 0.0, False)]
    mdp = TabularMDP.from_transitions([[followers], [[(1.0, 1, 1.0, False)]], [[(1.0, 2, 1.0, False)]]], 0.5)
    critic = Critic(torch.tensor([0.0, *v], dtype=torch.float64))
    return expectimax(TabularModel(mdp), torch.tensor([0]), depth=1, v_leaf=critic, max_width=1)


def test_states_of_higher_reach_or_higher_value_are_kept_and_of_equal_ones_the_first():
    assert fork(0.25, (1.0, 1.0)).q_BA.item() == 0.125 * 1 + 0.375 * 1.5
    assert fork(0.75, (1.0, 1.0)).q_BA.item() == 0.375 * 1.5 + 0.125 * 1
    assert fork(0.5, (0.0, 0.5)).q_BA.item() == 0.25 * 0 + 0.25 * 1.25
    assert fork(0.5, (0.0, 0.0)).q_BA.item() == 0.25 * 1 + 0.25 * 0
    assert fork(0.5, (0.5, 0.5)).pruned_BA.item() == 0.25


def mean_error(mdp: TabularMDP, v_S: Tensor, width: int, roots: Tensor, depth: int = 4) -> float:
    look = expectimax(TabularModel(mdp), roots, depth=depth, v_leaf=Critic(v_S), max_width=width)
    best_B = exact.lookahead(mdp, q_above(mdp, v_S), depth)[roots].amax(-1)
    return float((look.q_BA.amax(-1) - best_B).abs().mean())


def test_a_reversed_order_of_the_states_that_are_kept_is_worse(monkeypatch):
    mdp = random_mdp(200, 4, branching=5)
    v_S = exact.policy_values(mdp, uniform_policy(mdp))
    roots = torch.arange(0, 200, 20)
    ours = mean_error(mdp, v_S, 16, roots)
    keep = pruned.highest
    monkeypatch.setattr(pruned, "highest", lambda priority_N, reach_N, count: keep(-priority_N, reach_N, count))
    assert mean_error(mdp, v_S, 16, roots) > 1.2 * ours


def test_neither_the_zero_nor_the_unit_of_rewards_changes_what_is_kept():
    mdp, v_S = zoo("grid"), some_v(zoo("grid"))
    scaled = TabularMDP.from_dense(*dense(mdp, times=1e6), 0.9)
    roots, of = torch.tensor([14, 3]), {"depth": 5, "max_width": 4}
    look = expectimax(TabularModel(mdp), roots, v_leaf=Critic(v_S), **of)
    larger = expectimax(TabularModel(scaled), roots, v_leaf=Critic(1e6 * v_S), **of)
    assert_close(larger.q_BA / 1e6, look.q_BA, tolerance=1e-9)
    assert_close(larger.pruned_BA, look.pruned_BA)


def dense(mdp: TabularMDP, times: float) -> tuple[Tensor, Tensor]:
    """Transition probabilities [S, A, S] and rewards so many times as large."""
    prob = torch.zeros(mdp.num_states, mdp.num_actions, mdp.num_states, dtype=torch.float64)
    prob.scatter_add_(2, mdp.outcomes.child_NAK, mdp.outcomes.prob_NAK)
    return prob, mdp.outcomes.reward_NA * times


# Cost


def test_the_critic_is_called_once_for_each_level_and_the_topology_remembers_the_outcomes():
    model, topology = watched(zoo("garnet")), None
    topology = Topology(model)
    critic = Critic(some_v(zoo("garnet")))
    first = expectimax(model, torch.tensor([3]), depth=4, v_leaf=critic, max_width=3, topology=topology)
    assert first.critic_calls == len(critic.calls) == 5
    assert all(states == sorted(set(states)) for states in critic.calls)
    again = expectimax(model, torch.tensor([3]), depth=4, v_leaf=critic, max_width=3, topology=topology)
    assert (first.model_calls > 0, again.model_calls) == (True, 0)
    assert torch.equal(again.q_BA, first.q_BA)
    full = expectimax(model, torch.tensor([3]), depth=4, v_leaf=critic, topology=topology)
    assert_close(full.q_BA, expectimax(TabularModel(zoo("garnet")), torch.tensor([3]), depth=4, v_leaf=critic).q_BA)


def test_a_tree_of_bounded_width_grows_no_longer_and_its_nodes_are_counted_against_the_budget():
    def look(max_nodes: int) -> Lookahead:
        model = InterningModel(paths, [()], num_actions=2)
        return expectimax(model, torch.tensor([0]), depth=20, v_leaf=zeros, max_width=3, max_nodes=max_nodes)

    nodes = look(1_000).nodes_per_level
    assert nodes == (1, 4, *[12] * 20)
    assert look(sum(nodes)).model_calls == 2 * (1 + 3 * 20)
    with pytest.raises(NodeBudgetExceeded, match=r"max_nodes is 244: .*max_width"):
        look(sum(nodes) - 1)


# Numbers


def test_terminal_outcomes_and_actions_that_are_not_allowed_need_no_node():
    inf = math.inf
    outcomes = Outcomes(
        torch.tensor([[1.0, -inf], [2.0, 3.0], [5.0, -inf]], dtype=torch.float64),
        torch.ones(3, 2, 1, dtype=torch.float64),
        torch.tensor([[[0.5], [0.5]], [[0.0], [0.5]], [[0.0], [0.5]]], dtype=torch.float64),
        torch.tensor([[[1], [2]], [[2], [1]], [[2], [0]]]),
        3,
    )

    class Three(TabularModel):
        def __init__(self) -> None:
            super().__init__(ladder(3))

        def outcomes(self, state_N: Tensor) -> Outcomes:
            return outcomes.rows(state_N)

    roots = torch.arange(3)
    for depth in (0, 1, 4):
        full = expectimax(Three(), roots, depth=depth, v_leaf=zeros)
        narrow = expectimax(Three(), roots, depth=depth, v_leaf=zeros, max_width=1)
        assert torch.equal(narrow.q_BA, full.q_BA)  # each level has one state that counts
        assert narrow.q_BA[0, 1] == narrow.q_BA[2, 1] == -inf
        assert not narrow.pruned_BA.any()
    assert narrow.nodes_per_level == (3, 1, 1, 1, 1, 1)
    ends = expectimax(Three(), torch.tensor([2]), depth=3, v_leaf=zeros, max_width=1)
    assert (ends.q_BA.tolist(), ends.nodes_per_level, ends.critic_calls) == ([[5.0, -inf]], (1, 0, 0, 0, 0), 0)


def test_nothing_is_pruned_behind_an_action_that_is_not_allowed():
    half = torch.full((3, 2, 2), 0.5, dtype=torch.float64)
    reward_NA = torch.tensor([[0.0, -math.inf], [0.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    child_NAK = torch.tensor([[[1, 2]] * 2, [[1, 1]] * 2, [[2, 2]] * 2])

    class Three(TabularModel):
        def outcomes(self, state_N: Tensor) -> Outcomes:
            return Outcomes(reward_NA, half, half, child_NAK, 3).rows(state_N)

    critic = Critic(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    look = expectimax(Three(ladder(3)), torch.tensor([0]), depth=1, v_leaf=critic, max_width=1)
    assert look.pruned_BA.tolist() == [[0.25, 0.0]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depth_0_and_gamma_0_and_one_state_need_no_width(dtype):
    one = TabularMDP.from_transitions([[[(1.0, 0, 1.0, False)]]], 0.5)
    still = random_mdp(6, 3, gamma=0.0)
    q_SA = some_q(still)
    at_0 = expectimax(TabularModel(still, dtype=dtype), torch.arange(6), depth=0, q_leaf=Critic(q_SA), max_width=1)
    assert torch.equal(at_0.q_BA, q_SA.to(dtype))
    deep = expectimax(TabularModel(still, dtype=dtype), torch.arange(6), depth=4, q_leaf=Critic(q_SA), max_width=1)
    assert torch.equal(deep.q_BA, still.outcomes.reward_NA.to(dtype))
    series = expectimax(TabularModel(one, dtype=dtype), torch.tensor([0]), depth=9, v_leaf=zeros, max_width=1)
    assert series.q_BA.item() == pytest.approx(2 - 0.5**9, rel=1e-6)
    for look in (at_0, deep, series):
        assert look.q_BA.dtype == dtype
        assert not look.pruned_BA.any()


@pytest.mark.parametrize("largest", [1e300, 1.7e308])
def test_enormous_values_pass_without_becoming_nan(largest):
    mdp = zoo("garnet")
    v_S = largest * some_v(mdp).sign()
    look = expectimax(TabularModel(mdp), torch.arange(9), depth=4, v_leaf=Critic(v_S), max_width=3)
    assert bool(look.q_BA.isfinite().all())
    assert bool(((look.pruned_BA > 0) & (look.pruned_BA <= 1)).all())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_critic_value_that_is_not_finite_is_refused_above_the_last_level_too(bad):
    v_S = some_v(ladder(9))
    v_S[2] = bad
    model, root = TabularModel(ladder(9)), torch.tensor([1])
    with pytest.raises(PgtsError, match=f"value of state 2 is {bad}"):
        expectimax(model, root, depth=4, v_leaf=Critic(v_S), max_width=2)


@pytest.mark.parametrize("width", [0, -1, 1.0, True, "4"])
@pytest.mark.usefixtures("unchecked_shapes")
def test_a_width_that_is_no_count_is_refused_and_named(width):
    with pytest.raises(PgtsError, match="max_width is"):
        expectimax(TabularModel(ladder()), torch.tensor([0]), depth=2, v_leaf=zeros, max_width=width)


def test_a_topology_of_a_pruned_search_in_inference_mode_can_be_used_outside():
    mdp, model = zoo("grid"), TabularModel(zoo("grid"))
    topology, v_S = Topology(model), some_v(mdp).requires_grad_()
    with torch.inference_mode():
        expectimax(model, torch.tensor([0]), depth=4, v_leaf=zeros, topology=topology, max_width=2)
    look = expectimax(model, torch.tensor([0, 44]), depth=4, v_leaf=Critic(v_S), topology=topology, max_width=2)
    assert not look.q_BA.requires_grad
    assert not look.pruned_BA.requires_grad
    assert not look.q_BA.is_inference()


def test_levels_that_no_path_reaches_hold_no_nodes():
    ended = Outcomes(*(torch.zeros(2, 1), torch.ones(2, 1, 1), torch.zeros(2, 1, 1)), torch.zeros(2, 1, 1).long(), 2)
    model = TabularModel(TabularMDP(ended.to(dtype=torch.float64), torch.tensor([0.5, 0.5], dtype=torch.float64)))
    look = expectimax(model, torch.tensor([1]), depth=3, v_leaf=zeros, max_width=1)
    assert look.nodes_per_level == (1, 0, 0, 0, 0)
