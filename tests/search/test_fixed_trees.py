"""Trees in arrays of fixed shape: those of the compiled loops, by the same operations whatever the numbers are."""

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.compiled import torch_only
from pgts_torch.errors import NodeBudgetExceeded, NotFinite
from pgts_torch.models import TabularModel
from pgts_torch.options import MCTS
from pgts_torch.search import Lookahead, Topology, mcts
from pgts_torch.search.fixed_trees import FixedTrees
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, ladder, random_mdp
from tests.counting import Counting
from tests.search.models import all_states, assert_close, some_v
from tests.support import random_policy


def masked(mdp: TabularMDP) -> TabularMDP:
    """The same, but of each state only 1 to A actions are allowed."""
    S, A = mdp.outcomes.reward_NA.shape
    count_S1 = 1 + torch.arange(S)[:, None] % A
    place_SA = torch.rand(S, A, generator=stream(0, "allowed")).argsort(1).argsort(1)
    reward_SA = mdp.outcomes.reward_NA.masked_fill(place_SA >= count_S1, -math.inf)
    return replace(mdp, outcomes=replace(mdp.outcomes, reward_NA=reward_SA))


MDPS = {
    "random": random_mdp(40, 4, branching=3, seed=3),
    "one action": random_mdp(20, 1, branching=4, seed=3),
    "five actions": random_mdp(20, 5, branching=2, seed=4),
    "deep sea": deep_sea(5),
    "ladder": ladder(6),
    "grid": grid(),
    "five actions, some of them allowed": masked(random_mdp(40, 5, branching=2, seed=4)),
    "nine actions, some of them allowed": masked(random_mdp(30, 9, branching=1, seed=5)),
}
KINDS = {
    "halving": {},
    "halving, puct": {"rule": "puct", "exploration": 2.0},
    "the rule at the root": {"root": "rule"},
    "uct": {"root": "rule", "rule": "uct"},
}


def look(mdp: TabularMDP, *, dtype: torch.dtype = torch.float64, noise: bool = False, **options) -> Lookahead:
    v_S = some_v(mdp).to(dtype)
    generator = stream(5, "noise") if noise else None
    model = TabularModel(mdp, dtype=dtype)
    given = {"depth": 4, "v_leaf": lambda s: v_S[s], "simulations": 30, "wave": 1, "generator": generator} | options
    return mcts(model, all_states(mdp), **given)


@pytest.mark.parametrize("simulations", [1, 2, 30])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", MDPS)
def test_they_are_the_trees_of_the_compiled_loops_bit_for_bit(name, kind, simulations):
    pytest.importorskip("numba")
    mdp, options = MDPS[name], KINDS[kind] | {"simulations": simulations, "noise": kind.startswith("halving")}
    if kind != "uct":
        prior_SA = random_policy(mdp, 1)
        options["prior"] = lambda state_N: prior_SA[state_N]
    compiled = look(mdp, **options)
    with torch_only():
        fixed = look(mdp, **options)
    assert torch.equal(fixed.q_BA, compiled.q_BA)
    assert torch.equal(fixed.pruned_BA, compiled.pruned_BA)
    assert fixed.nodes_per_level == compiled.nodes_per_level
    assert fixed.model_calls == compiled.model_calls


def test_enough_simulations_give_T_to_the_m_and_fewer_do_not():
    mdp = MDPS["random"]
    with torch_only():
        full, few = (look(mdp, depth=2, simulations=count) for count in (200, 9))
    q_SA = mdp.outcomes.reward_NA + mdp.outcomes.expected(some_v(mdp))
    assert_close(full.q_BA, exact.lookahead(mdp, q_SA, 2))
    assert not full.pruned_BA.any()
    assert (few.q_BA - full.q_BA).abs().max() > 0.1


def grown(outcomes: Outcomes, roots: int, seed: int, legal: list[int] | None = None) -> tuple[Counting, Tensor]:
    """The operations of a whole search with new values, and what it finds."""
    generator, (S, A) = stream(seed, "values"), outcomes.reward_NA.shape
    value_S = torch.randn(S, dtype=torch.float64, generator=generator)
    prior_SA = torch.rand(S, A, dtype=torch.float64, generator=generator) + 0.1
    state_B = torch.randperm(S, generator=generator)[:roots]
    with Counting() as counts:
        shape = {"num_roots": roots, "num_nodes": 20, "legal": legal}
        trees = FixedTrees(outcomes, value_S, prior_SA, 4, MCTS(simulations=20), **shape)
        q_BA, _ = trees.search(state_B, prior_SA[state_B].log())
    return counts, q_BA


def test_operations_depend_neither_on_the_number_of_roots_nor_on_numbers_and_nothing_is_read():
    one, many, other = (
        grown(random_mdp(40, 4, branching=3, seed=seed).outcomes, roots, seed)
        for roots, seed in ((1, 3), (40, 3), (7, 4))
    )
    # Everything ends after one step: there is nothing to do after the first simulation.
    outcomes = MDPS["random"].outcomes
    ended = grown(replace(outcomes, discount_NAK=torch.zeros_like(outcomes.discount_NAK)), 7, 5)
    for counts, _ in (one, many, other, ended):
        assert counts.reads == Counter()
        assert counts.operations == one[0].operations
    assert not torch.equal(other[1], many[1][:7])
    # Where some actions are not allowed, whichever they are at these roots.
    forbidding = [
        grown(MDPS["nine actions, some of them allowed"].outcomes, roots, seed, [*range(1, 10)])
        for roots, seed in ((1, 3), (30, 4))
    ]
    assert [counts.reads for counts, _ in forbidding] == [Counter()] * 2
    assert forbidding[0][0].operations == forbidding[1][0].operations


def test_searches_in_waves_read_and_so_does_one_that_looks_whether_it_is_over(monkeypatch):
    with torch_only(), Counting() as counts:
        look(MDPS["random"], simulations=64, wave=None)
    with torch_only(), Counting() as one_by_one:
        look(MDPS["random"], simulations=64)
    with torch_only(), Counting() as fewer:
        look(MDPS["random"], simulations=9)
    assert counts.num_reads > 2 * one_by_one.num_reads
    assert one_by_one.reads == fewer.reads
    # What docs/architecture.md says of the price.
    assert 8 < one_by_one.num_operations / counts.num_operations < 15
    wave = FixedTrees._wave

    def looking(self: FixedTrees, action_BW: Tensor, count_B: Tensor, levels: int) -> None:
        if count_B.any():
            wave(self, action_BW, count_B, levels)

    monkeypatch.setattr(FixedTrees, "_wave", looking)
    assert grown(MDPS["random"].outcomes, 4, 3)[0].num_reads > 0


def test_a_search_can_be_repeated_in_the_same_arrays():
    mdp, options = MDPS["random"], MCTS(simulations=20)
    prior_SA, states = random_policy(mdp, 1), (torch.arange(4), torch.arange(10, 14), torch.arange(4))
    trees = FixedTrees(mdp.outcomes, some_v(mdp), prior_SA, 4, options, num_roots=4, num_nodes=20)
    first, other, again = (trees.search(state_B, prior_SA[state_B].log()) for state_B in states)
    assert torch.equal(first[0], again[0])
    assert torch.equal(first[1], again[1])
    assert not torch.equal(first[0], other[0])


def test_float32_is_searched_in_float64():
    compiled = look(MDPS["random"], dtype=torch.float32)
    with torch_only():
        fixed = look(MDPS["random"], dtype=torch.float32)
    assert fixed.q_BA.dtype == fixed.pruned_BA.dtype == torch.float32
    assert_close(fixed.q_BA, compiled.q_BA, 1e-6)


def test_levels_beyond_the_simulations_cost_nothing_and_no_more_nodes_than_allowed_are_made():
    with torch_only():
        deep, deeper = (look(MDPS["ladder"], depth=depth, simulations=5) for depth in (20, 10_000))
        assert torch.equal(deep.q_BA, deeper.q_BA)
        with pytest.raises(NodeBudgetExceeded, match="max_nodes is 40"):
            look(MDPS["random"], max_nodes=40)


def test_values_that_are_not_finite_are_refused_before_a_tree_grows():
    mdp = MDPS["random"]
    v_S = some_v(mdp)
    v_S[7] = math.nan
    with torch_only(), pytest.raises(NotFinite, match="the critic's value of state 7 is nan"):
        mcts(TabularModel(mdp), torch.tensor([3]), depth=4, v_leaf=lambda s: v_S[s], simulations=9, wave=1)


def test_states_that_were_expanded_count_as_queried_once():
    mdp, model = MDPS["random"], TabularModel(MDPS["random"])
    topology, v_S = Topology(model), some_v(mdp)
    options = {"depth": 4, "v_leaf": lambda s: v_S[s], "simulations": 30, "wave": 1, "topology": topology}
    with torch_only():
        first, again = (mcts(model, torch.arange(3), **options) for _ in range(2))
    assert first.model_calls == topology.table.num_queried * 4 > 0
    assert again.model_calls == 0
