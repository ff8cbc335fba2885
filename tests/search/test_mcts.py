"""Tree search: exact once the tree is complete, an honest bound before, and the same tree as one by one."""

import math
from collections.abc import Iterator

import gymnasium
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.compiled import torch_only
from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.search import Topology, expectimax
from pgts_torch.search.mcts import mcts
from pgts_torch.search.split import Selection, apportion
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, ladder, random_mdp
from tests.search.models import (
    Critic,
    InterningModel,
    all_states,
    assert_close,
    q_of,
    some_q,
    some_v,
    walk_the_tree,
    watched,
    zeros,
)
from tests.search.slow_tree import SlowTree
from tests.support import mdps, random_policy, uniform_policy, weights, zoo

ENOUGH = 300
"""More simulations than a complete tree of the small examples takes."""


def states_of(mdp: TabularMDP, seed: int, count: int = 5) -> Tensor:
    return torch.randint(mdp.num_states, (count,), generator=stream(seed, "roots"))


@pytest.fixture(scope="module", params=["compiled", "torch"], autouse=True)
def path(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each test is one of both ways to the same search."""
    if request.param == "compiled":
        pytest.importorskip("numba")
        yield "compiled"
    else:
        with torch_only():
            yield "torch"


roots = st.sampled_from(["gumbel", "rule"])
rules = st.sampled_from(["gumbel", "puct", "uct"])
waves = st.sampled_from([None, 1, 3])
forms = st.sampled_from([{}, {"backup": "mean"}, {"merge": True}])


# A complete tree is the exact lookahead


@given(mdps(max_actions=2, max_outcomes=2), st.integers(0, 2), st.integers(0, 99), roots, rules, st.booleans(), waves)
def test_enough_simulations_give_T_to_the_m(mdp, depth, seed, root, rule, merge, wave):
    options = {"root": root, "rule": rule, "merge": merge, "simulations": 100, "wave": wave}
    model = TabularModel(mdp)
    q_SA, v_S = some_q(mdp, seed), some_v(mdp, seed)
    by_q = mcts(model, all_states(mdp), depth=depth + 1, q_leaf=Critic(q_SA), **options)
    by_v = mcts(model, all_states(mdp), depth=depth, v_leaf=Critic(v_S), **options)
    assert_close(by_q.q_BA, exact.lookahead(mdp, q_SA, depth + 1))
    assert_close(by_v.q_BA, exact.lookahead(mdp, q_of(mdp, v_S), depth))
    for look in (by_q, by_v):
        assert bool((look.pruned_BA == 0).all())
        assert bool((look.stderr_BA == 0).all())


@pytest.mark.parametrize("name", ["ladder", "tightrope", "garnet", "deep_sea", "FrozenLake"])
@pytest.mark.parametrize("merge", [False, True])
def test_enough_simulations_are_exact_on_the_zoo_and_one_is_not(name, merge):
    mdp = zoo(name)
    root, v_S = torch.tensor([0]), some_v(mdp)

    def look(simulations: int) -> Tensor:
        return mcts(
            TabularModel(mdp), root, depth=2, v_leaf=Critic(v_S), simulations=simulations, merge=merge, root="rule"
        ).q_BA

    assert_close(look(ENOUGH), exact.lookahead(mdp, q_of(mdp, v_S), 2)[root])
    assert not torch.allclose(look(1), look(ENOUGH)) or name == "tightrope"


@given(mdps(), st.integers(0, 3), st.integers(0, 99), roots)
def test_complete_graphs_equal_complete_trees_and_query_the_model_no_more(mdp, depth, seed, root):
    critic, options = Critic(some_v(mdp, seed)), {"depth": depth, "root": root}
    graph = mcts(TabularModel(mdp), all_states(mdp), v_leaf=critic, simulations=200, merge=True, **options)
    full = expectimax(TabularModel(mdp), all_states(mdp), depth=depth, v_leaf=critic)
    assert bool((graph.pruned_BA == 0).all())
    assert_close(graph.q_BA, full.q_BA)
    assert graph.model_calls == full.model_calls
    if depth <= 1:
        tree = mcts(TabularModel(mdp), all_states(mdp), v_leaf=critic, simulations=200, **options)
        assert_close(tree.q_BA, graph.q_BA)
        assert graph.model_calls <= tree.model_calls
        assert all(g <= t for g, t in zip(graph.nodes_per_level, tree.nodes_per_level, strict=True))


def test_a_graph_is_complete_when_a_tree_of_as_many_simulations_is_not():
    mdp = zoo("grid")
    critic, truth = Critic(some_v(mdp)), exact.lookahead(mdp, q_of(mdp, some_v(mdp)), 4)[:3]

    def error(merge: bool) -> float:
        options = {"depth": 4, "v_leaf": critic, "simulations": 150, "merge": merge}
        return float((mcts(TabularModel(mdp), torch.arange(3), **options).q_BA - truth).abs().max())

    assert error(True) < 1e-11
    assert error(False) > 1e-3


# Before that


@given(mdps(), st.integers(0, 4), st.integers(1, 40), st.integers(0, 99), roots, st.booleans(), waves)
def test_the_error_is_at_most_the_pruned_mass_times_the_error_of_the_critic(
    mdp, depth, simulations, seed, root, merge, wave
):
    v_S = some_v(mdp, seed)
    of_depth = [v_S, *(exact.lookahead(mdp, q_of(mdp, v_S), j).amax(-1) for j in range(depth + 1))]
    off = max(float((v_S - v_j).abs().max()) for v_j in of_depth)
    look = mcts(
        TabularModel(mdp),
        all_states(mdp),
        depth=depth,
        v_leaf=Critic(v_S),
        simulations=simulations,
        root=root,
        merge=merge,
        wave=wave,
    )
    error_BA = (look.q_BA - exact.lookahead(mdp, q_of(mdp, v_S), depth)).abs()
    assert bool((error_BA <= look.pruned_BA * off + 1e-11).all())
    assert bool((look.pruned_BA >= 0).all())
    assert bool((look.pruned_BA <= 1 + 1e-12).all())


def test_the_pruned_mass_of_one_simulation_is_that_of_outcomes_with_weight():
    mdp = random_mdp(20, 3, branching=3)
    look = mcts(TabularModel(mdp), all_states(mdp), depth=2, v_leaf=zeros, simulations=1)
    assert_close(look.pruned_BA, torch.from_numpy(weights(mdp).sum(-1)))
    assert_close(look.q_BA, mdp.outcomes.reward_NA)
    bottom = mcts(TabularModel(mdp), all_states(mdp), depth=0, v_leaf=zeros, simulations=1)
    assert bool((bottom.pruned_BA == 0).all())


@pytest.mark.parametrize("root", ["gumbel", "rule"])
def test_the_error_does_not_grow_with_simulations(root):
    errors = []
    for simulations in (1, 4, 16, 64, 256):
        off = []
        for seed in range(3):
            mdp = random_mdp(20, 2, branching=2, seed=seed)
            evaluation = exact.evaluate(mdp, uniform_policy(mdp))
            options = {"depth": 6, "v_leaf": Critic(evaluation.v_S), "simulations": simulations, "root": root}
            look = mcts(TabularModel(mdp), all_states(mdp), **options)
            off.append((look.q_BA.amax(-1) - exact.lookahead(mdp, evaluation.q_SA, 6).amax(-1)).abs())
        errors.append(float(torch.cat(off).median()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < errors[0] / 3


# Independence of the batch


@given(mdps(), st.integers(0, 4), st.integers(1, 40), st.integers(0, 99), roots, rules, waves)
def test_splitting_and_permuting_the_roots_changes_no_bit(mdp, depth, simulations, seed, root, rule, wave):
    root_B, order = states_of(mdp, seed, 7), torch.randperm(7, generator=stream(seed, "order"))
    critic = Critic(some_v(mdp, seed))

    def look(root_B: Tensor) -> Tensor:
        generator = stream(seed, "gumbel") if root == "gumbel" else None
        options = {"simulations": simulations, "root": root, "rule": rule, "generator": generator, "wave": wave}
        return mcts(TabularModel(mdp), root_B, depth=depth, v_leaf=critic, **options).q_BA

    together = look(root_B)
    assert torch.equal(look(root_B[order]), together[order])
    assert torch.equal(torch.cat([look(root_B[:3]), look(root_B[3:])]), together)


def test_the_noise_changes_a_search_and_takes_one_number_of_the_generator_whatever_the_batch():
    mdp = random_mdp(50, 4, branching=3)
    options = {"depth": 5, "v_leaf": Critic(some_v(mdp)), "simulations": 9}

    def look(seed: int | None) -> Tensor:
        generator = None if seed is None else stream(seed, "noise")
        return mcts(TabularModel(mdp), all_states(mdp), generator=generator, **options).q_BA

    assert torch.equal(look(0), look(0))
    assert torch.equal(look(None), look(None))
    assert not torch.equal(look(0), look(1))
    few, many = stream(0, "noise"), stream(0, "noise")
    mcts(TabularModel(mdp), torch.tensor([3]), generator=few, **options)
    mcts(TabularModel(mdp), all_states(mdp), generator=many, **options)
    assert torch.equal(few.get_state(), many.get_state())


# Waves


@given(
    mdps(max_states=6),
    st.integers(0, 4),
    st.integers(1, 50),
    st.integers(0, 99),
    roots,
    rules,
    forms,
)
def test_waves_of_one_are_one_simulation_after_another(mdp, depth, simulations, seed, root, rule, form):
    v_S, prior_SA = some_v(mdp, seed), random_policy(mdp, seed)
    uses_prior = not (root == "rule" and rule == "uct")
    look = mcts(
        TabularModel(mdp),
        all_states(mdp),
        depth=depth,
        v_leaf=Critic(v_S),
        simulations=simulations,
        root=root,
        rule=rule,
        wave=1,
        prior=Critic(prior_SA) if uses_prior else None,
        **form,
    )
    states = range(mdp.num_states)
    slow = SlowTree(mdp, states, depth + 1, v_S, prior_SA, root=root, rule=rule, **form).search(simulations)
    assert_close(look.q_BA, torch.tensor(slow.root_values(), dtype=torch.float64))
    assert list(look.nodes_per_level) == slow.nodes_per_level()


@given(st.integers(1, 6), st.integers(0, 30), st.integers(0, 999), st.booleans())
def test_units_go_one_by_one_to_the_largest_deficit_that_has_room(K, budget, seed, limited):
    generator = stream(seed, "deficits")
    deficit_K = (8 * torch.rand(K, dtype=torch.float64, generator=generator)).round(decimals=1) - 3
    most_K = torch.randint(1, 9, (K,), generator=generator).double() if limited else torch.full((K,), math.inf)
    deficit_K[1:][torch.rand(K - 1, generator=generator) < 0.3] = -math.inf
    given_K, lack_K = [0.0] * K, [round(d * 2**20) if math.isfinite(d) else d for d in deficit_K.tolist()]
    for _ in range(budget):
        free = [k for k in range(K) if given_K[k] < most_K[k] and lack_K[k] > -math.inf]
        if free:
            k = max(free, key=lambda k: (lack_K[k], -k))
            given_K[k] += 1
            lack_K[k] -= 2**20
    budget_1, most_1K = torch.tensor([budget], dtype=torch.float64), most_K.double()[None] if limited else None
    assert apportion(deficit_K[None], budget_1, most_1K)[0].tolist() == given_K


def test_large_waves_err_little_more_than_waves_of_one(path):
    mdp = random_mdp(100, 3, branching=3, seed=4)
    evaluation = exact.evaluate(mdp, uniform_policy(mdp))
    truth = exact.lookahead(mdp, evaluation.q_SA, 6).amax(-1)

    def error(wave: int | None, simulations: int = 120) -> float:
        options = {"depth": 6, "v_leaf": Critic(evaluation.v_S), "simulations": simulations, "wave": wave}
        return float((mcts(TabularModel(mdp), all_states(mdp), **options).q_BA.amax(-1) - truth).abs().mean())

    assert error(60) < 1.3 * error(1)
    assert error(60) != error(1)
    assert error(60, simulations=1) > 1.3 * error(1)
    assert (error(None) == error(1)) == (path == "compiled")


# What a search costs


def test_a_deep_sea_has_the_nodes_of_a_binary_tree_and_the_model_calls_of_its_cells():
    model = watched(deep_sea(6))
    critic = Critic(some_v(deep_sea(6)))
    look = mcts(model, torch.tensor([0]), depth=2, v_leaf=critic, simulations=100)
    assert look.nodes_per_level == (1, 2, 4, 8)
    assert look.model_calls == (1 + 2 + 3) * 2 == len(model.queried) * 2
    assert look.critic_calls == len(critic.calls)
    graph = mcts(model, torch.tensor([0]), depth=2, v_leaf=critic, simulations=100, merge=True)
    assert graph.nodes_per_level == (1, 2, 3, 4)


@given(st.integers(1, 40), st.integers(0, 4), roots, rules, waves)
def test_every_simulation_expands_one_node_until_there_is_none_left(simulations, depth, root, rule, wave):
    options = {"simulations": simulations, "root": root, "rule": rule, "wave": wave}
    look = mcts(TabularModel(deep_sea(9)), torch.tensor([0]), depth=depth, v_leaf=zeros, **options)
    assert look.nodes == 1 + 2 * min(simulations, 2 ** (depth + 1) - 1)


def test_repeated_roots_are_searched_once():
    mdp = zoo("grid")
    options = {"depth": 4, "v_leaf": Critic(some_v(mdp)), "simulations": 20}
    once = mcts(TabularModel(mdp), torch.tensor([3, 55]), **options)
    twice = mcts(TabularModel(mdp), torch.tensor([55, 3, 3, 55]), **options)
    assert torch.equal(twice.q_BA, once.q_BA[[1, 0, 0, 1]])
    assert twice.nodes_per_level == once.nodes_per_level


def test_a_topology_that_knows_the_states_saves_all_model_calls():
    mdp, model = zoo("garnet"), TabularModel(zoo("garnet"))
    topology, options = Topology(model), {"depth": 5, "v_leaf": zeros, "simulations": 30}
    first = mcts(model, all_states(mdp), topology=topology, **options)
    again = mcts(model, all_states(mdp), topology=topology, **options)
    assert first.model_calls > 0 == again.model_calls
    assert torch.equal(first.q_BA, again.q_BA)
    with pytest.raises(PgtsError, match="another model"):
        mcts(TabularModel(mdp), all_states(mdp), topology=topology, **options)


# Averaging backups


def test_averages_are_off_where_the_maximum_is_exact():
    mdp = random_mdp(20, 3, branching=2, seed=2)
    v_S = exact.evaluate(mdp, uniform_policy(mdp)).v_S
    truth = exact.lookahead(mdp, q_of(mdp, v_S), 3)

    def error(backup: str) -> float:
        options = {"depth": 3, "v_leaf": Critic(v_S), "simulations": ENOUGH, "backup": backup, "merge": False}
        look = mcts(TabularModel(mdp), all_states(mdp), **options)
        assert bool(torch.isinf(look.pruned_BA).all()) == (backup == "mean")
        return float((look.q_BA - truth).abs().max())

    assert error("max") < 1e-11
    assert error("mean") > 1e-3


# Corners


def test_depth_0_with_q_is_q():
    mdp, q_SA = zoo("garnet"), some_q(zoo("garnet"))
    look = mcts(TabularModel(mdp), torch.tensor([4, 2]), depth=0, q_leaf=Critic(q_SA), simulations=10)
    assert torch.equal(look.q_BA, q_SA[[4, 2]])
    assert (look.model_calls, look.critic_calls, look.nodes_per_level) == (0, 1, (2,))


@pytest.mark.parametrize("merge", [False, True])
@pytest.mark.parametrize("backup", ["max", "mean"])
def test_a_root_from_which_everything_ends_has_its_reward_alone(merge, backup):
    if merge and backup == "mean":
        return
    frozen = TabularMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"), 0.99)
    options = {"depth": 4, "simulations": 20, "merge": merge, "backup": backup}
    look = mcts(TabularModel(frozen), torch.tensor([5]), v_leaf=lambda s: zeros(s) + math.nan, **options)
    assert torch.equal(look.q_BA, torch.zeros(1, 4, dtype=torch.float64))
    assert look.critic_calls == 0


def gated(state: int, action: int) -> tuple[float, list[tuple[float, float, int]]]:
    """A walk on the numbers in which action 2 is allowed in multiples of 3 only."""
    if action == 2 and state % 3:
        return -math.inf, [(1.0, 0.9, 999)]
    return math.sin(state + action), [(0.5, 0.9, state + action + 1), (0.5, 0.8, state + 2)]


@pytest.mark.parametrize("root", ["gumbel", "rule"])
@pytest.mark.parametrize("backup", ["max", "mean"])
def test_actions_that_are_not_allowed_are_never_taken(root, backup):
    model = InterningModel(gated, [0, 1], num_actions=3)

    def v_leaf(state_N: Tensor) -> Tensor:
        assert 999 not in [model.states[s] for s in state_N.tolist()]
        return torch.tensor([float(model.states[s] % 5) for s in state_N.tolist()], dtype=torch.float64)

    options = {"depth": 2, "v_leaf": v_leaf, "simulations": 300, "root": root, "backup": backup}
    look = mcts(model, torch.tensor([0, 1]), **options)
    expected = [walk_the_tree(gated, s, 2, lambda s: float(s % 5), 3) for s in (0, 1)]
    assert look.q_BA[1, 2] == -math.inf
    assert bool(torch.isfinite(look.q_BA.flatten()[:5]).all())
    if backup == "max":
        assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("merge", [False, True])
def test_states_numbered_as_they_are_met_with_differing_K_have_the_values_of_the_tree(merge):
    def fans_out(x: int, action: int) -> tuple[float, list[tuple[float, float, int]]]:
        wide = 1 + x % 4
        return math.cos(x + action), [(1 / wide, 0.9, 2 * x + action + k + 1) for k in range(wide)]

    model = InterningModel(fans_out, [0, 3], num_actions=2)

    def v_leaf(state_N: Tensor) -> Tensor:
        return torch.tensor([math.sin(model.states[s]) for s in state_N.tolist()], dtype=torch.float64)

    look = mcts(model, torch.tensor([0, 1]), depth=2, v_leaf=v_leaf, simulations=200, merge=merge)
    expected = [walk_the_tree(fans_out, s, 2, math.sin, 2) for s in (0, 3)]
    assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64))


# Mistakes of the caller


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"simulations": 0}, "simulations is 0"),
        ({"root": "best"}, "root is 'best'"),
        ({"rule": "ucb"}, "rule is 'ucb'"),
        ({"backup": "sum"}, "backup is 'sum'"),
        ({"exploration": 1.0}, "exploration is 1"),
        ({"wave": True}, "wave is true"),
        ({"merge": True, "backup": "mean"}, "merge is true"),
        ({"root": "rule", "generator": torch.Generator()}, "only root='gumbel'"),
        ({"root": "rule", "rule": "uct", "prior": zeros}, "prior is policy"),
        ({"prior": lambda s: torch.ones(len(s), 2)}, r"prior of state 0 is \[1\.0, 1\.0\]"),
        ({"prior": zeros}, r"prior has shape \(1,\); for 1 states it must be \(1, 2\)"),
        ({"max_nodes": 4}, "max_nodes is 4"),
    ],
)
def test_options_that_make_no_sense_are_refused_and_named(wrong, message):
    options = {"depth": 4, "v_leaf": zeros, "simulations": 9} | wrong
    with pytest.raises(PgtsError, match=message) as caught:
        mcts(TabularModel(ladder(5)), torch.tensor([0]), **options)
    assert isinstance(caught.value, NodeBudgetExceeded) == ("max_nodes" in wrong)


@pytest.mark.parametrize("merge", [False, True])
def test_the_roots_count_among_the_nodes_from_the_start(merge):
    model, knobs = TabularModel(random_mdp(50, 3, branching=4, seed=1)), {"depth": 3, "v_leaf": zeros, "merge": merge}
    nodes = mcts(model, torch.tensor([0, 7]), simulations=1, **knobs).nodes
    assert mcts(model, torch.tensor([0, 7]), simulations=1, max_nodes=nodes, **knobs).nodes == nodes
    with pytest.raises(NodeBudgetExceeded, match=f"max_nodes is {nodes - 1}"):
        mcts(model, torch.tensor([0, 7]), simulations=1, max_nodes=nodes - 1, **knobs)


@pytest.mark.parametrize("rule", ["puct", "uct"])
def test_rules_with_exploration_split_the_whole_budget_also_where_it_ends_in_a_fraction(rule):
    """In a graph it may: paths that meet share what was used below."""
    budget_N, zero_NA = torch.tensor([0.25, 3.5, 2.0], dtype=torch.float64), torch.zeros(3, 2, dtype=torch.float64)
    given_NA = Selection(rule, 1.25).split(
        budget_N, q_NA=zero_NA, visits_NA=zero_NA, prior_NA=zero_NA + 0.5, exhausted_NA=zero_NA, most_NA=None
    )
    torch.testing.assert_close(given_NA.sum(1), budget_N)


@pytest.mark.parametrize("rule", ["puct", "uct"])
@given(st.integers(1, 5), st.integers(1, 20), st.integers(0, 999))
def test_rules_with_exploration_select_one_by_one_and_never_an_exhausted_or_full_action(rule, A, budget, seed):
    generator = stream(seed, "selection")
    q_A, prior_A = (torch.rand(A, dtype=torch.float64, generator=generator) for _ in range(2))
    visits_A, most_A = (torch.randint(0, 6, (A,), generator=generator).double() for _ in range(2))
    exhausted_A = torch.zeros(A, dtype=torch.float64).masked_fill_(torch.rand(A, generator=generator) < 0.3, -math.inf)
    given_A = visits_A.clone()
    worth_A = (q_A - q_A.max()) / (q_A.max() - q_A.min()).clamp_min(1e-12)
    for _ in range(budget):
        open_A = (exhausted_A == 0) & (given_A < visits_A + most_A)
        if not open_A.any():
            break
        total = given_A.sum()
        bonus_A = (
            prior_A * (1 + total).sqrt() / (1 + given_A)
            if rule == "puct"
            else ((1 + total).log() / (1 + given_A)).sqrt()
        )
        given_A[torch.where(open_A, worth_A + 1.25 * bonus_A, -math.inf).argmax()] += 1
    given_NA = {"q_NA": q_A, "visits_NA": visits_A, "prior_NA": prior_A, "exhausted_NA": exhausted_A, "most_NA": most_A}
    split_NA = Selection(rule, 1.25).split(
        torch.tensor([budget]).double(), **{name: x[None] for name, x in given_NA.items()}
    )
    assert split_NA[0].tolist() == (given_A - visits_A).tolist()
