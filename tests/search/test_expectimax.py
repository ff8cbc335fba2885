"""Lookahead values: the same numbers as the exact operator and as the tree that walks every path."""

import math

import gymnasium
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.bellman import backup, sweep
from pgts_torch.errors import PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.search import Lookahead, Topology, expectimax
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, grid, ladder
from tests.counting import Counting
from tests.search.models import (
    Critic,
    InterningModel,
    all_states,
    assert_close,
    q_of,
    some_q,
    some_v,
    walk_the_tree,
    zeros,
)
from tests.support import ZOO, mdps, random_policy, tree_lookahead, zoo

DEPTHS = range(11)


def differs(a: Tensor, b: Tensor, least: float = 1e-6) -> bool:
    return bool((a - b).abs().max() > least)


def few_states(mdp: TabularMDP, count: int = 8) -> list[int]:
    """Every state of a small MDP, some of a large one."""
    return list(range(0, mdp.num_states, math.ceil(mdp.num_states / count)))


def walkable_depth(mdp: TabularMDP, most_paths: int = 4_000) -> int:
    """The largest depth for which walking the tree from every state stays fast."""
    wide = mdp.num_actions * mdp.outcomes.num_outcomes
    return int(math.log(max(1, most_paths / (mdp.num_states * mdp.num_actions))) / math.log(max(wide, 2)))


def test_a_compiled_search_over_known_states_takes_no_operation_but_the_critics():
    pytest.importorskip("numba")
    mdp, root_B = grid(), torch.arange(100)
    model, v_S = TabularModel(mdp), some_v(mdp)
    topology = Topology(model)

    def search() -> Counting:
        with Counting() as counts:
            expectimax(model, root_B, depth=8, v_leaf=lambda state_N: v_S[state_N], topology=topology)
        return counts

    assert search().num_operations > 10
    known = search()
    assert known.operations == {"index": 1}
    assert known.reads == {"numpy": 2}  # the roots, and the critic's values


# The same as the exact operator, at every state, action and depth


@pytest.mark.parametrize("name", ZOO)
def test_all_states_at_once_and_each_alone_have_T_to_the_m_of_any_q_and_v(name):
    mdp, model = zoo(name), TabularModel(zoo(name))
    topology, q_SA, v_S = Topology(model), some_q(mdp), some_v(mdp)
    of_q = [exact.lookahead(mdp, q_SA, depth) for depth in DEPTHS]
    of_v = [exact.lookahead(mdp, q_of(mdp, v_S), depth) for depth in DEPTHS]
    for roots in [all_states(mdp), *(torch.tensor([s]) for s in few_states(mdp))]:
        for depth in DEPTHS:
            by_q = expectimax(model, roots, depth=depth, q_leaf=Critic(q_SA), topology=topology)
            by_v = expectimax(model, roots, depth=depth, v_leaf=Critic(v_S), topology=topology)
            assert_close(by_q.q_BA, of_q[depth][roots])
            assert_close(by_v.q_BA, of_v[depth][roots])


@pytest.mark.parametrize("name", [name for name in ZOO if name != "Taxi"])
def test_the_search_agrees_with_the_tree_that_walks_every_path(name):
    mdp, model = zoo(name), TabularModel(zoo(name))
    q_SA, v_S = some_q(mdp), some_v(mdp)
    q_of_v = q_of(mdp, v_S)
    for depth in range(walkable_depth(mdp) + 1):
        by_q = expectimax(model, all_states(mdp), depth=depth, q_leaf=Critic(q_SA))
        by_v = expectimax(model, all_states(mdp), depth=depth, v_leaf=Critic(v_S))
        assert_close(by_q.q_BA, tree_lookahead(mdp, q_SA, depth))
        assert_close(by_v.q_BA, tree_lookahead(mdp, q_of_v, depth))


@pytest.mark.parametrize("name", [name for name in ZOO if name != "Taxi"])
def test_another_depth_gives_other_values(name):
    mdp, model = zoo(name), TabularModel(zoo(name))
    v_S = some_v(mdp)
    q_SA = q_of(mdp, v_S)
    for depth in range(3):
        look = expectimax(model, all_states(mdp), depth=depth, v_leaf=Critic(v_S)).q_BA
        assert differs(look, exact.lookahead(mdp, q_SA, depth + 1))
        assert depth == 0 or differs(look, exact.lookahead(mdp, q_SA, depth - 1))


def test_v_and_Q_of_a_policy_give_the_same_lookahead():
    mdp = zoo("garnet")
    evaluation = exact.evaluate(mdp, random_policy(mdp))
    roots, model = torch.tensor([3, 17]), TabularModel(mdp)
    for depth in range(6):
        by_q = expectimax(model, roots, depth=depth, q_leaf=Critic(evaluation.q_SA))
        by_v = expectimax(model, roots, depth=depth, v_leaf=Critic(evaluation.v_S))
        assert_close(by_q.q_BA, by_v.q_BA)


def test_a_lookahead_as_deep_as_the_ladder_is_long_finds_the_reward_and_a_shallower_one_does_not():
    n, model = 7, TabularModel(ladder(7))
    root = torch.tensor([0])
    for depth in range(10):
        look = expectimax(model, root, depth=depth, v_leaf=zeros)
        assert bool((look.q_BA > 0).any()) == (depth >= n - 1)


@pytest.mark.parametrize("depth", [63, 64, 400])
def test_depths_far_beyond_the_closed_set_give_T_to_the_m(depth):
    mdp = grid(6, traps=(8,))
    q_SA = some_q(mdp)
    look = expectimax(TabularModel(mdp), torch.tensor([14]), depth=depth, q_leaf=Critic(q_SA))
    assert_close(look.q_BA[0], exact.lookahead(mdp, q_SA, depth)[14])


@given(mdps(), st.integers(0, 6), st.integers(0, 100), st.data())
def test_any_roots_of_any_mdp_have_T_to_the_m(mdp, depth, seed, data):
    roots = torch.tensor(data.draw(st.lists(st.integers(0, mdp.num_states - 1), min_size=1, max_size=6)))
    q_SA, v_S, model = some_q(mdp, seed), some_v(mdp, seed), TabularModel(mdp)
    by_q = expectimax(model, roots, depth=depth, q_leaf=Critic(q_SA))
    by_v = expectimax(model, roots, depth=depth, v_leaf=Critic(v_S))
    assert_close(by_q.q_BA, exact.lookahead(mdp, q_SA, depth)[roots])
    assert_close(by_v.q_BA, exact.lookahead(mdp, q_of(mdp, v_S), depth)[roots])
    if depth <= 2:
        assert_close(by_q.q_BA, tree_lookahead(mdp, q_SA, depth)[roots])


@given(mdps(), st.integers(0, 50), st.integers(0, 100))
def test_a_sweep_is_so_many_backups(mdp, times, seed):
    v_S = some_v(mdp, seed)
    expected = before = v_S.clone()
    for _ in range(times):
        expected = backup(mdp.outcomes, expected).amax(-1)
    assert_close(sweep(mdp.outcomes, v_S, times), expected, tolerance=1e-13)
    assert torch.equal(v_S, before)


# Roots


@given(mdps(), st.integers(0, 5), st.integers(0, 100))
def test_the_order_and_the_batches_of_the_roots_change_nothing(mdp, depth, seed):
    roots = torch.randint(mdp.num_states, (7,), generator=stream(seed, "roots"))
    order = torch.randperm(7, generator=stream(seed, "order"))
    model, critic = TabularModel(mdp), Critic(some_v(mdp))

    def look(root_B: Tensor) -> Tensor:
        return expectimax(model, root_B, depth=depth, v_leaf=critic).q_BA

    together = look(roots)
    assert_close(look(roots[order]), together[order])
    assert_close(torch.cat([look(roots[:3]), look(roots[3:])]), together)


def test_a_repeated_root_is_searched_once():
    mdp = zoo("grid")
    model, critic = TabularModel(mdp), Critic(some_v(mdp))
    once = expectimax(model, torch.tensor([55, 3]), depth=3, v_leaf=critic)
    twice = expectimax(model, torch.tensor([3, 55, 3, 3, 55]), depth=3, v_leaf=critic)
    assert torch.equal(twice.q_BA, once.q_BA[[1, 0, 1, 1, 0]])
    assert twice.nodes_per_level == once.nodes_per_level
    assert twice.model_calls == once.model_calls


# States that are numbered as they are met


def lattice(state: tuple[int, int], action: int) -> tuple[float, list[tuple[float, float, tuple[int, int]]]]:
    """A drunkard in the plane, without an edge. Where x is odd he may slip or fall asleep, elsewhere he may not."""
    x, y = state
    reward = math.sin(3 * x + y) - 0.1 * action
    ahead = (x + 1, y) if action else (x, y + 1)
    if x % 2 == 0:
        return reward, [(1.0, 0.9, ahead)]
    return reward, [(0.5, 0.9, ahead), (0.25, 0.8, (x - 1, y)), (0.125, 0.7, ahead), (0.125, 0.0, (-99, -99))]


def height(state: tuple[int, int]) -> float:
    return math.cos(state[0]) + 0.3 * state[1]


def test_states_numbered_as_they_are_met_with_differing_K_have_the_values_of_the_tree():
    starts = [(0, 0), (1, 5), (2, 2)]
    model = InterningModel(lattice, starts, num_actions=2)
    topology = Topology(model)

    def v_leaf(state_N: Tensor) -> Tensor:
        return torch.tensor([height(model.states[s]) for s in state_N.tolist()], dtype=torch.float64)

    for depth in [0, 3, 1, 5]:
        look = expectimax(model, torch.arange(3), depth=depth, v_leaf=v_leaf, topology=topology)
        expected = [walk_the_tree(lattice, start, depth, height, 2) for start in starts]
        assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64))
    assert model.num_states > 30

    # Roots that did not exist when the topology was made, and a depth at which K grows and shrinks.
    roots = torch.tensor([model.number[1, 6], model.number[4, 2], model.number[0, 1]])
    look = expectimax(model, roots, depth=4, v_leaf=v_leaf, topology=topology)
    expected = [walk_the_tree(lattice, model.states[s], 4, height, 2) for s in roots.tolist()]
    assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64))


def test_a_state_may_have_more_outcomes_than_all_before_it():
    def corridor(x: int, action: int) -> tuple[float, list[tuple[float, float, int]]]:
        if x == 3:
            return 0.5, [(0.5, 0.9, 4), (0.25, 0.8, 5), (0.25, 0.7, 0)]
        return float(action), [(1.0, 0.9, x + 1)]

    model = InterningModel(corridor, [0], num_actions=2)
    look = expectimax(model, torch.tensor([0]), depth=7, v_leaf=zeros)
    expected = walk_the_tree(corridor, 0, 7, lambda _: 0.0, 2)
    assert_close(look.q_BA[0], torch.tensor(expected, dtype=torch.float64))


# Numbers


def test_a_float32_model_gives_float32_whatever_the_dtype_of_the_critic():
    mdp = zoo("grid")
    v_S, model = exact.policy_values(mdp, random_policy(mdp)), TabularModel(mdp, dtype=torch.float32)
    expected = exact.lookahead(mdp, q_of(mdp, v_S), 8)
    for table in (v_S, v_S.float()):
        look = expectimax(model, all_states(mdp), depth=8, v_leaf=Critic(table))
        assert look.q_BA.dtype == torch.float32
        assert_close(look.q_BA.double(), expected, tolerance=1e-5)
        assert differs(look.q_BA.double(), expected, least=1e-9)


def test_finite_values_with_an_infinite_sum_are_accepted():
    v_S = torch.full((4,), 1.5e308, dtype=torch.float64)
    assert math.isinf(v_S.sum())
    look = expectimax(TabularModel(ladder(4, gamma=1.0)), torch.arange(4), depth=5, v_leaf=Critic(v_S))
    assert torch.equal(look.q_BA, torch.full((4, 2), 1.5e308, dtype=torch.float64))


def test_a_root_from_which_everything_ends_has_its_reward_alone():
    frozen = TabularMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"), 0.99)
    hole, model = torch.tensor([5]), TabularModel(frozen)
    for depth in (0, 1, 7):
        look = expectimax(model, hole, depth=depth, v_leaf=lambda s: zeros(s) + 1e9)
        assert torch.equal(look.q_BA, torch.zeros(1, 4, dtype=torch.float64))


# Gradients


@pytest.mark.parametrize("depth", [0, 1, 9])
def test_lookahead_values_carry_no_gradient_and_no_graph_is_built(depth):
    mdp = zoo("ladder")
    q_table, v_table = some_q(mdp).requires_grad_(), some_v(mdp).requires_grad_()
    enabled = []

    def look(**leaf: object) -> Lookahead:
        return expectimax(TabularModel(mdp), all_states(mdp), depth=depth, **leaf)

    def q_leaf(state_N: Tensor) -> Tensor:
        enabled.append(torch.is_grad_enabled())
        return q_table[state_N] * 2

    ready = q_table * 2  # made outside, with its graph; in the order of the states
    assert ready.requires_grad
    assert not look(q_leaf=q_leaf).q_BA.requires_grad
    assert not look(q_leaf=lambda _: ready).q_BA.requires_grad
    assert not look(v_leaf=lambda s: v_table[s]).q_BA.requires_grad
    assert enabled == [False]
    assert torch.is_grad_enabled()


def test_a_topology_of_a_search_in_inference_mode_can_be_used_outside():
    mdp, model = zoo("grid"), TabularModel(zoo("grid"))
    topology, critic = Topology(model), Critic(some_v(mdp))
    with torch.inference_mode():
        expectimax(model, torch.tensor([0]), depth=2, v_leaf=critic, topology=topology)
    look = expectimax(model, torch.tensor([0, 44]), depth=6, v_leaf=critic, topology=topology)
    assert_close(look.q_BA, exact.lookahead(mdp, q_of(mdp, critic.table), 6)[[0, 44]])
    assert not look.q_BA.is_inference()


def test_the_search_does_not_write_into_the_values_of_the_critic():
    mdp = zoo("tightrope")
    q_SA, v_S = some_q(mdp), some_v(mdp)
    for depth in (0, 5):
        expectimax(TabularModel(mdp), all_states(mdp), depth=depth, q_leaf=lambda _: q_SA).q_BA.zero_()
        expectimax(TabularModel(mdp), all_states(mdp), depth=depth, v_leaf=lambda _: v_S).q_BA.zero_()
    assert torch.equal(q_SA, some_q(mdp))
    assert torch.equal(v_S, some_v(mdp))


# Mistakes of the caller


@pytest.mark.parametrize("depth", [-1, 1.0, True, math.inf, math.nan, None, "4"])
def test_a_depth_that_is_no_count_is_refused_and_named(depth):
    with pytest.raises(PgtsError, match=r"depth is .*whole number"):
        expectimax(TabularModel(ladder()), torch.tensor([0]), depth=depth, v_leaf=zeros)


@pytest.mark.parametrize(
    ("roots", "message"),
    [
        (torch.tensor([], dtype=torch.int64), r"root_B has shape \(0,\); .*at least one state"),
        (torch.tensor(3), r"root_B has shape \(\)"),
        (torch.tensor([[0, 1]]), r"root_B has shape \(1, 2\)"),
        (torch.tensor([0, 4, 5]), r"root_B\[2\] is 5; states are 0 to 4"),
        (torch.tensor([0, -1]), r"root_B\[1\] is -1"),
        (torch.tensor([0, 0], dtype=torch.int32), r"root_B is torch\.int32; states are int64"),
        (torch.tensor([0.0]), r"root_B is torch\.float32"),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_roots_that_are_no_states_are_refused_and_named(roots, message):
    model = TabularModel(ladder(5))
    topology = Topology(model)
    for _ in range(2):
        with pytest.raises(PgtsError, match=message):
            expectimax(model, roots, depth=2, v_leaf=zeros, topology=topology)
    assert topology.table.model_calls == 0
    # The bytes of known roots do not open the door to roots of another kind.
    for known in ([0], [0, 1], [0, 0]):
        expectimax(model, torch.tensor(known), depth=2, v_leaf=zeros, topology=topology)
    with pytest.raises(PgtsError, match=message):
        expectimax(model, roots, depth=2, v_leaf=zeros, topology=topology)


@pytest.mark.parametrize("shape", [(), (4,), (5, 1), (5, 2, 1)])
def test_leaf_values_of_a_wrong_shape_are_refused(shape):
    with pytest.raises(PgtsError, match=r"values have shape .*; of 5 leaves: \(5,\)"):
        expectimax(TabularModel(ladder(5)), torch.arange(5), depth=3, v_leaf=lambda _: torch.zeros(shape))
    with pytest.raises(PgtsError, match=r"values have shape .*; of 5 leaves: \(5, 2\)"):
        expectimax(TabularModel(ladder(5)), torch.arange(5), depth=3, q_leaf=lambda _: torch.zeros(shape))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("depth", [0, 2])
def test_a_leaf_value_that_is_not_finite_is_refused_and_its_state_is_named(bad, depth):
    mdp = ladder(5)
    v_S, q_SA = some_v(mdp), some_q(mdp)
    v_S[3] = q_SA[3] = bad
    model, roots = TabularModel(mdp), torch.tensor([3, 2])
    with pytest.raises(PgtsError, match=rf"value of state 3 is {bad}; it must be finite"):
        expectimax(model, roots, depth=depth, v_leaf=Critic(v_S))
    with pytest.raises(PgtsError, match=rf"value of state 3 is \[.*, {bad}\]; it must be finite"):
        expectimax(model, roots, depth=depth, q_leaf=Critic(q_SA))
    expectimax(model, torch.tensor([0]), depth=0, q_leaf=Critic(q_SA))  # where nobody looks, nobody minds


def test_infinities_that_cancel_are_refused_too():
    v_S = torch.tensor([math.inf, 0.0, -math.inf])
    with pytest.raises(PgtsError, match="value of state 0 is inf"):
        expectimax(TabularModel(ladder(3)), torch.arange(3), depth=1, v_leaf=Critic(v_S))


def test_a_leaf_value_too_large_for_the_dtype_of_the_model_is_refused():
    model = TabularModel(ladder(3), dtype=torch.float32)
    with pytest.raises(PgtsError, match="value of state 0 is inf"):
        expectimax(model, torch.arange(3), depth=1, v_leaf=lambda s: zeros(s) + 1e300)


def test_the_result_shares_no_memory_with_the_values_of_the_critic():
    model, q_SA = TabularModel(zoo("garnet")), some_q(zoo("garnet"))
    for root_B in (all_states(zoo("garnet")), torch.tensor([3, 3, 1])):
        look = expectimax(model, root_B, depth=0, q_leaf=lambda state_N: q_SA[: len(state_N)])
        assert look.q_BA.untyped_storage().data_ptr() != q_SA.untyped_storage().data_ptr()
