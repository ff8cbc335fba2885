"""Trees that compiled loops grow are those of torch; model and critic are called for all roots at once."""

import math
import sys

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.compiled import torch_only
from pgts_torch.errors import NotFinite
from pgts_torch.models import EnumeratingModel, TabularModel
from pgts_torch.search import Lookahead, Topology, mcts
from pgts_torch.search import forest as forest_module
from pgts_torch.seeding import stream
from pgts_torch.tabular import random_mdp
from tests.counting import Counting
from tests.search.models import Critic, InterningModel, all_states, assert_close, paths, some_v, watched, zeros
from tests.support import mdps, random_policy, rewarded

pytest.importorskip("numba")

roots = st.sampled_from(["gumbel", "rule"])
rules = st.sampled_from(["gumbel", "puct", "uct"])
forms = st.sampled_from([{}, {"backup": "mean"}, {"merge": True}])


def both(
    model: EnumeratingModel, root_B: Tensor, *, noise: int | None = None, in_waves: bool = False, **options
) -> list[Lookahead]:
    """The same search, compiled and by torch: in waves of one, or where it can in arrays of fixed shape."""

    def look() -> Lookahead:
        generator = None if noise is None else stream(noise, "noise")
        return mcts(model, root_B, wave=1, generator=generator, **options)

    with torch_only(), pytest.MonkeyPatch.context() as patch:
        if in_waves:
            patch.setattr(sys.modules["pgts_torch.search.mcts"], "_fits_arrays", lambda *_: False)
        by_torch = look()
    return [look(), by_torch]


def assert_same(compiled: Lookahead, by_torch: Lookahead, tolerance: float = 1e-12, *, merge: bool = False) -> None:
    assert_close(compiled.q_BA, by_torch.q_BA, tolerance)
    assert_close(compiled.pruned_BA, by_torch.pruned_BA, tolerance)
    assert compiled.nodes_per_level == by_torch.nodes_per_level
    # Where paths meet the compiled search may foresee a simulation that another one then makes needless.
    assert compiled.model_calls == by_torch.model_calls or (merge and compiled.model_calls > by_torch.model_calls)


@given(
    mdps(max_states=6, max_actions=5, max_outcomes=4),
    st.integers(0, 4),
    st.integers(1, 60),
    st.integers(0, 99),
    roots,
    rules,
    forms,
    st.sampled_from([1e-3, 1.0, 1e6]),
    st.booleans(),
)
def test_compiled_trees_are_those_of_torch(mdp, depth, simulations, seed, root, rule, form, scale, in_waves):
    mdp, options = rewarded(mdp, factor=scale), {"root": root, "rule": rule, "in_waves": in_waves} | form
    if root == "gumbel":
        options["noise"] = seed
    if not (root == "rule" and rule == "uct"):
        options["prior"] = Critic(random_policy(mdp, seed))
    options |= {"depth": depth, "v_leaf": Critic(scale * some_v(mdp, seed)), "simulations": simulations}
    assert_same(*both(TabularModel(mdp), all_states(mdp), **options), merge="merge" in form)


@pytest.mark.parametrize("known", [False, True])
def test_a_graph_goes_on_as_if_it_had_not_stopped_at_unknown_states(known):
    mdp = random_mdp(80, 3, branching=3, seed=2)
    model, options = TabularModel(mdp), {"depth": 4, "v_leaf": Critic(some_v(mdp, 1)), "merge": True}
    if known:
        options["topology"] = topology = Topology(model)
        topology.query(torch.arange(80))
    assert_same(*both(model, torch.tensor([3]), simulations=36, noise=1, **options), merge=True)


@pytest.mark.parametrize("merge", [False, True])
def test_more_simulations_are_another_search(merge):
    mdp = random_mdp(300, 4, branching=3)
    options = {"depth": 5, "v_leaf": Critic(some_v(mdp)), "merge": merge}
    compiled, _ = both(TabularModel(mdp), torch.arange(3), simulations=20, **options)
    _, by_torch = both(TabularModel(mdp), torch.arange(3), simulations=21, **options)
    with pytest.raises(AssertionError):
        assert_same(compiled, by_torch)


def forked(state: int, action: int) -> tuple[float, list[tuple[float, float, int]]]:
    """The further down, the more outcomes; action 2 is allowed in multiples of 3 only, and 9 is the end."""
    if action == 2 and state % 3:
        return -math.inf, [(1.0, 0.9, 10**9)]
    K = 1 + state % 7
    following = [(1 / K, 0.9 if state + k != 8 else 0.0, state + action + k + 1) for k in range(K)]
    return math.sin(7.0 * state + action), following


@pytest.mark.parametrize("form", [{}, {"backup": "mean"}, {"merge": True}])
@pytest.mark.parametrize("root", ["gumbel", "rule"])
def test_a_model_that_meets_states_and_outcomes_as_it_goes_is_searched_alike(root, form, monkeypatch):
    monkeypatch.setattr(forest_module, "_ROOM", 20)  # a graph has room for a few nodes at first

    def leaf(model: InterningModel) -> Critic:
        return lambda state_N: torch.tensor([math.cos(model.states[s]) for s in state_N.tolist()]).double()

    looks = []
    for compiled in (True, False):
        model = InterningModel(forked, [0, 1], num_actions=3)
        options = {"depth": 3, "v_leaf": leaf(model), "simulations": 60, "root": root} | form
        looks.append(both(model, torch.tensor([0, 1]), **options)[not compiled])
    assert_same(*looks, merge="merge" in form)
    assert looks[0].nodes_per_level[-1] > 0


@pytest.mark.parametrize("merge", [False, True])
def test_float32_is_searched_in_float64(merge):
    mdp = random_mdp(50, 4, branching=3, seed=3)
    v_S = some_v(mdp).float()
    options = {"depth": 4, "v_leaf": lambda s: v_S[s], "simulations": 50, "merge": merge}
    compiled, by_torch = both(TabularModel(mdp, dtype=torch.float32), all_states(mdp), **options)
    assert compiled.q_BA.dtype == compiled.pruned_BA.dtype == torch.float32
    assert_close(compiled.q_BA, by_torch.q_BA, 1e-5)


@pytest.mark.parametrize("merge", [False, True])
def test_model_and_critic_are_called_once_a_wave_for_all_roots(merge):
    """No two paths meet, so every simulation comes to a state that is unknown."""
    model, simulations = InterningModel(paths, [(i,) for i in range(10)], num_actions=2), 21
    model.num_outcomes = 2
    calls, queried = [], model.outcomes
    model.outcomes = lambda state_N: calls.append(len(state_N)) or queried(state_N)
    look = mcts(model, torch.arange(10), depth=6, v_leaf=zeros, simulations=simulations, merge=merge)
    # The roots, and then waves of one simulation of each of the two actions of each root.
    assert calls == [10] + [20] * 10
    assert look.critic_calls == len(calls)
    assert sum(calls) == 10 * simulations == look.model_calls / 2


def test_where_the_outcomes_are_known_the_critic_is_called_once():
    mdp, model = random_mdp(60, 3, branching=3), watched(random_mdp(60, 3, branching=3))
    topology, critic = Topology(model), Critic(some_v(mdp))
    options = {"depth": 5, "v_leaf": critic, "simulations": 30, "topology": topology}
    fresh = mcts(model, torch.arange(4), **options)
    called, queries = len(critic.calls), len(model.calls)
    known = mcts(model, torch.arange(4), **options)
    assert called > 2
    assert len(critic.calls) == called + 1
    assert len(model.calls) == queries
    assert torch.equal(known.q_BA, fresh.q_BA)
    # No more states than the simulations could have expanded, and their children, are valued.
    few = mcts(model, torch.tensor([0]), **(options | {"simulations": 2}))
    assert few.critic_calls <= 2
    assert sum(map(len, critic.calls[-few.critic_calls :])) <= 3 * 9


def test_trees_that_take_turns_in_a_few_slots_are_the_same(monkeypatch):
    calls = []

    def look() -> Lookahead:
        model = InterningModel(paths, [(i,) for i in range(20)], num_actions=2)
        calls.append(0)

        def v(state_N: Tensor) -> Tensor:
            calls[-1] += 1
            return torch.tensor([math.sin(sum(map(hash, model.states[s]))) for s in state_N.tolist()]).double()

        return mcts(model, torch.arange(20), depth=5, v_leaf=v, simulations=30)

    at_once = look()
    monkeypatch.setattr(forest_module, "_ROOM", 7 * 30 * 4)
    in_turns = look()
    assert torch.equal(in_turns.q_BA, at_once.q_BA)
    assert torch.equal(in_turns.pruned_BA, at_once.pruned_BA)
    assert in_turns.nodes_per_level == at_once.nodes_per_level
    assert calls[1] > 2 * calls[0]


@pytest.mark.parametrize("merge", [False, True])
def test_a_search_over_known_states_takes_no_operation_but_the_noise_and_the_critics(merge):
    mdp = random_mdp(60, 3, branching=3)
    model, v_S = TabularModel(mdp), some_v(mdp)
    topology, generator = Topology(model), stream(0, "noise")

    def search() -> Counting:
        options = {"depth": 5, "simulations": 30, "merge": merge, "topology": topology, "generator": generator}
        with Counting() as counts:
            mcts(model, torch.tensor([7]), v_leaf=lambda state_N: v_S[state_N], **options)
        return counts

    assert search().num_operations > 4
    search()
    known = search()
    assert known.operations == {"random_": 1, "index": 1}
    assert known.reads == {"numpy": 2}  # the root, and the critic's values


@pytest.mark.parametrize("form", [{}, {"merge": True}, {"backup": "mean"}, {"prior": True}])
def test_what_a_search_has_left_for_the_next_one_changes_nothing_there(form):
    mdp = random_mdp(80, 3, branching=3, seed=2)
    model, options = TabularModel(mdp), {"depth": 4, "simulations": 40} | form
    if "prior" in form:
        options["prior"] = Critic(random_policy(mdp, 1))
    topology, calls = Topology(model), []

    def search(roots: list[int], seed: int, topology: Topology | None, bad: float = 0.0, **more) -> Lookahead:
        v_S = some_v(mdp, seed)
        v_S[::2] += bad
        return mcts(
            model, torch.tensor(roots), v_leaf=lambda s: v_S[s], topology=topology, generator=stream(seed, "n"),
            **options | more,
        )  # fmt: skip

    def within(state_N: Tensor) -> Tensor:  # a critic that searches by itself
        calls.append(search([5], 1, topology))
        return some_v(mdp, 3)[state_N]

    cases = [([3], 0), ([4], 1), ([4, 70, 9], 2), ([4, 70, 9], 3), ([3], 1), ([3], 1, 1)]
    for roots, seed, *fewer in cases:
        more = {"simulations": 39} if fewer else {}
        with pytest.raises(NotFinite, match="the critic's value of state"):
            search(roots, seed, topology, bad=math.nan, **more)
        for _ in range(2):
            look, fresh = search(roots, seed, topology, **more), search(roots, seed, None, **more)
            assert torch.equal(look.q_BA, fresh.q_BA)
            assert torch.equal(look.pruned_BA, fresh.pruned_BA)
            assert look.nodes_per_level == fresh.nodes_per_level
    first = look.q_BA.clone()
    searching = mcts(model, torch.tensor([5]), v_leaf=within, topology=topology, **options)
    assert torch.equal(searching.q_BA, mcts(model, torch.tensor([5]), v_leaf=Critic(some_v(mdp, 3)), **options).q_BA)
    assert all(torch.equal(inner.q_BA, search([5], 1, None).q_BA) for inner in calls)
    assert torch.equal(look.q_BA, first)  # results are the caller's


def test_what_is_kept_for_the_next_search_is_little_and_counts_as_memory():
    mdp = random_mdp(80, 3, branching=3, seed=2)
    topology, options = Topology(TabularModel(mdp)), {"depth": 4, "v_leaf": zeros}
    before = topology.bytes(0)
    mcts(topology.model, torch.arange(80), simulations=60, topology=topology, **options)
    assert topology.forest is None
    mcts(topology.model, torch.arange(2), simulations=60, topology=topology, **options)
    assert topology.forest is not None
    assert topology.bytes(0) > before + topology.forest.num_bytes > before + 10_000
    assert topology.fresh().forest is None
