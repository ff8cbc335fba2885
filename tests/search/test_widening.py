"""Progressive widening over drawn actions: the same trees where it is off, the calls that it saves, and the limit."""

import itertools

import pytest
import torch

from benchmarks.linear import LinearQuadratic
from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models.base import FollowingModel
from pgts_torch.options import MCTS
from pgts_torch.search import expectimax, mcts
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.topology import Topology
from pgts_torch.search.widening import WideningTrees
from pgts_torch.seeding import stream
from tests.agent.continuous import GAMMA, drawing, gaussian, some_states

MODEL = LinearQuadratic.double_integrator(gamma=GAMMA)
LEAF = torch.eye(2).double()
"""v(s) = -|s|^2 at the leaves."""


def v_leaf(state_N):
    return MODEL.v(LEAF, MODEL.states(state_N))


class Counting(FollowingModel):
    """The integrator, with every (state, action) that it was queried for."""

    def __init__(self) -> None:
        self.model, self.asked, self.num_actions = MODEL, [], 0
        self.device, self.dtype = MODEL.device, MODEL.dtype

    @property
    def num_states(self) -> int:
        return self.model.num_states

    def states(self, state_N):
        return self.model.states(state_N)

    def sample(self, state_N, action_NX, *, key_N):
        return self.follow(state_N, action_NX)

    def follow(self, state_N, action_NX):
        self.asked += zip(state_N.tolist(), action_NX[:, 0].tolist(), strict=True)
        return self.model.follow(state_N, action_NX)


@pytest.mark.parametrize(("rule", "root"), [*itertools.product(["gumbel", "puct", "uct"], ["gumbel", "rule"])])
@pytest.mark.parametrize("widening", [6, 60])
def test_where_nodes_begin_with_all_their_actions_the_trees_are_those_without_widening(rule, root, widening):
    root_B, drawn = some_states(MODEL, 5), drawing(MODEL, gaussian(), 6)
    noise = {"generator": stream(1, "noise")} if root == "gumbel" else {}
    options = {"depth": 2, "v_leaf": v_leaf, "rule": rule, "root": root}
    if (rule, root) != ("uct", "rule"):
        options["prior"] = lambda state_N: drawn.drawn(state_N).prob_NK
    for simulations in (1, 2, 17):
        states = noise["generator"].get_state() if noise else None
        plain = mcts(drawn, root_B, simulations=simulations, wave=1, **options, **noise)
        if noise:
            noise["generator"].set_state(states)
        wide = mcts(drawn, root_B, simulations=simulations, widening=widening, **options, **noise)
        assert torch.equal(plain.q_BA, wide.q_BA)
        assert (plain.model_calls, plain.nodes_per_level) == (wide.model_calls, wide.nodes_per_level)
    assert not torch.equal(mcts(drawn, root_B, simulations=17, widening=1, **options, **noise).q_BA, plain.q_BA)


@pytest.mark.parametrize(("widening", "power"), [(1, None), (2, 0.4), (1.5, 1.0)])
def test_a_node_has_as_many_actions_as_its_visits_allow_and_the_model_is_queried_for_these_alone(widening, power):
    root_B, base = some_states(MODEL, 3), Counting()
    drawn = drawing(base, gaussian(), 16)
    options = MCTS(widening=widening, widening_power=power, wave=1)
    trees = WideningTrees(drawn, Leaves(drawn, 3, None, v_leaf), 4, options, num_roots=3, max_bytes=2**30)
    node_B = trees.add_roots(root_B)
    assert len(base.asked) == trees.model_calls == 3 * 16
    for _ in range(40):
        used_B = trees.wave(node_B, trees.split(node_B, torch.ones(3)))
        assert used_B.tolist() == [1, 1, 1]
    assert len(base.asked) == len(set(base.asked)) == trees.model_calls == sum(trees.nodes_per_level[1:])
    # A root has all of them. A node at the last level has nothing to go down to, and gets one more in each visit.
    inner_N = torch.tensor([1 <= level < 3 for level in trees._level_N[: trees.count].tolist()])
    inner_N[0] = False
    visits_N, has_N = trees.visits_N[: trees.count][inner_N], trees._has_N[: trees.count][inner_N]
    allowed_N = (widening * visits_N ** (0.5 if power is None else power) - 1e-9).ceil().clamp(max=16)
    assert int(visits_N.max()) > 4
    assert torch.equal(has_N.double(), allowed_N)


def test_with_enough_simulations_it_is_the_lookahead_over_all_drawn_actions():
    root_B, drawn = some_states(MODEL, 3), drawing(MODEL, gaussian(), 5)
    wide = expectimax(drawn, root_B, depth=2, v_leaf=v_leaf)
    some, all_of_them = (
        mcts(drawn, root_B, depth=2, v_leaf=v_leaf, simulations=count, widening=1) for count in (30, 200)
    )
    assert torch.allclose(all_of_them.q_BA, wide.q_BA, rtol=1e-12)
    assert all_of_them.model_calls == wide.model_calls
    assert not all_of_them.pruned_BA.any()
    # Before that it is a maximum over some of them, and says of which values it has no bound.
    assert some.pruned_BA.isinf().any()
    done_BA = some.pruned_BA == 0
    assert torch.allclose(some.q_BA[done_BA], wide.q_BA[done_BA], rtol=1e-12)


def regret(look, drawn, root_B, depth: int) -> float:
    """By how much the best action of a lookahead is below the best force of all in T^m q, in closed form."""
    P_DD = LEAF
    for _ in range(depth):
        P_DD = MODEL.improved(P_DD)
    best_NX = drawn.drawn(root_B).action_NKX[torch.arange(len(root_B)), look.q_BA.argmax(1)]
    state_ND = MODEL.states(root_B)
    return float((MODEL.v(MODEL.improved(P_DD), state_ND) - MODEL.q(P_DD, state_ND, best_NX)).mean())


def test_in_the_limit_of_actions_and_simulations_it_finds_the_best_force_of_the_closed_form():
    root_B = some_states(MODEL, 20)
    found = []
    for count, simulations in ((4, 20), (32, 1100)):
        drawn = drawing(MODEL, gaussian(), count, scale=3.0)
        look = mcts(drawn, root_B, depth=1, v_leaf=v_leaf, simulations=simulations, widening=1)
        found.append(regret(look, drawn, root_B, 1))
    assert found[1] < found[0] / 20
    assert found[1] < 0.02


def test_with_as_many_calls_it_finds_better_actions_than_a_lookahead_of_full_width_over_fewer():
    root_B = some_states(MODEL, 40)
    few, many = drawing(MODEL, gaussian(), 6), drawing(MODEL, gaussian(), 16)
    full = expectimax(few, root_B, depth=2, v_leaf=v_leaf)
    wide = mcts(many, root_B, depth=2, v_leaf=v_leaf, simulations=242, widening=1)
    assert wide.model_calls <= full.model_calls == 40 * (6 + 36 + 216)
    assert regret(wide, many, root_B, 2) < 0.7 * regret(full, few, root_B, 2)


def test_widening_is_of_drawn_actions_and_of_trees_that_grow_one_simulation_after_another():
    grid = LinearQuadratic.double_integrator(gamma=GAMMA, action_AX=torch.linspace(-1, 1, 3)[:, None])
    root_B = some_states(grid, 2)
    with pytest.raises(PgtsError, match="LinearQuadratic are numbered"):
        mcts(grid, root_B, depth=1, v_leaf=lambda s: s.double(), simulations=4, widening=1)
    for others in ({"wave": 8}, {"backup": "mean"}, {"merge": True}, {"samples": 4}):
        with pytest.raises(PgtsError, match=f"search.widening is 2.0, which needs search.{next(iter(others))}"):
            MCTS(widening=2, **others)
    with pytest.raises(PgtsError, match=r"widening_power is 0\.3, which only search\.widening uses"):
        MCTS(widening_power=0.3)
    assert MCTS().merges
    assert not MCTS(widening=1).merges


def test_trees_that_would_not_fit_are_refused_before_the_model_is_queried():
    base, root_B = Counting(), some_states(MODEL, 4)
    drawn = drawing(base, gaussian(), 16)
    with pytest.raises(NodeBudgetExceeded, match="max_nodes"):
        mcts(drawn, root_B, depth=2, v_leaf=v_leaf, simulations=50, widening=1, max_nodes=100)
    base.asked.clear()
    small = Topology(drawn, max_bytes=10_000)
    with pytest.raises(NodeBudgetExceeded, match="max_bytes"):
        mcts(drawn, root_B, depth=2, v_leaf=v_leaf, simulations=50, widening=1, topology=small)
    assert not base.asked
