"""Actions that are not allowed: never taken, nothing below them queried, without prior, and worth -inf."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.compiled import torch_only
from pgts_torch.errors import PgtsError
from pgts_torch.models import EnumeratingModel
from pgts_torch.search import Lookahead, expectimax, mcts
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, random_mdp
from tests.search.models import InterningModel, Masked, all_states, assert_close, some_v, zeros
from tests.search.slow_tree import SlowTree
from tests.support import mdps, random_policy

Search = Callable[[EnumeratingModel, Tensor, int, Callable[[Tensor], Tensor]], Lookahead]


def some_mask(mdp: TabularMDP, seed: int) -> Tensor:
    """Any actions, at least one in each state."""
    generator = stream(seed, "mask")
    allowed_SA = torch.rand(mdp.num_states, mdp.num_actions, generator=generator) < 0.5
    one_S = torch.randint(mdp.num_actions, (mdp.num_states,), generator=generator)
    return allowed_SA.scatter_(1, one_S.unsqueeze(1), True)


def brute_force(model: Masked, v_S: Tensor, depth: int) -> Tensor:
    """(T^m Q)(s, .) state by state and outcome by outcome, over the actions that are allowed."""
    table, v, q = model.outcomes_of_all, v_S.tolist(), []
    reward, prob, discount, child = (
        x.tolist() for x in (table.reward_NA, table.prob_NAK, table.discount_NAK, table.child_NAK)
    )
    for _ in range(depth + 1):
        q = [[-math.inf] * model.num_actions for _ in v]
        for s in range(len(v)):
            for a in [a for a, r in enumerate(reward[s]) if r > -math.inf]:
                edges = zip(prob[s][a], discount[s][a], child[s][a], strict=True)
                q[s][a] = reward[s][a] + sum(p * gamma * v[k] for p, gamma, k in edges if p > 0 and gamma > 0)
        v = [max(q_A) for q_A in q]
    return torch.tensor(q[:-1], dtype=torch.float64)


def tree_search(**options) -> Search:
    return lambda model, root_B, depth, v_leaf: mcts(
        model, root_B, depth=depth, v_leaf=v_leaf, simulations=400, **options
    )


SEARCHES: dict[str, Search] = {
    "expectimax": lambda model, root_B, depth, v: expectimax(model, root_B, depth=depth, v_leaf=v),
    "pruned": lambda model, root_B, depth, v: expectimax(model, root_B, depth=depth, v_leaf=v, max_width=99),
    "tree": tree_search(),
    "tree by puct": tree_search(root="rule", rule="puct"),
    "merged": tree_search(merge=True),
    "merged by uct": tree_search(merge=True, root="rule", rule="uct"),
    "waves": tree_search(wave=7),
}


@pytest.mark.parametrize("search", SEARCHES.values(), ids=SEARCHES)
@pytest.mark.parametrize("keeps_table", [False, True])
@given(mdps(max_states=4, max_actions=3, max_outcomes=2), st.integers(0, 2), st.integers(0, 99))
def test_complete_searches_are_those_over_allowed_actions(search, keeps_table, mdp, depth, seed):
    model, v_S = Masked(mdp, some_mask(mdp, seed), keeps_table=keeps_table), some_v(mdp, seed)

    def v_leaf(state_N: Tensor) -> Tensor:
        assert int(state_N.max()) < mdp.num_states  # nothing below an action that is not allowed is valued
        return v_S[state_N]

    look = search(model, all_states(mdp), depth, v_leaf)
    assert_close(look.q_BA, brute_force(model, torch.cat([v_S, v_S[:1]]), depth))
    assert bool((look.pruned_BA == 0).all())


def test_another_mask_has_other_values():
    mdp = random_mdp(20, 3, branching=2, seed=1)
    truths = [brute_force(Masked(mdp, some_mask(mdp, seed)), some_v(mdp)[[*range(20), 0]], 2) for seed in (0, 1)]
    look = expectimax(Masked(mdp, some_mask(mdp, 0)), all_states(mdp), depth=2, v_leaf=lambda s: some_v(mdp)[s])
    assert_close(look.q_BA, truths[0])
    both = truths[0].isfinite() & truths[1].isfinite()
    assert float((truths[0] - truths[1])[both].abs().max()) > 0.1


@pytest.mark.parametrize("compiled", [True, False])
@given(
    mdps(max_states=6, max_actions=6),
    st.integers(0, 4),
    st.integers(1, 50),
    st.integers(0, 99),
    st.sampled_from(["gumbel", "rule"]),
    st.sampled_from(["gumbel", "puct", "uct"]),
    st.sampled_from([{}, {"backup": "mean"}, {"merge": True}]),
    st.booleans(),
)
def test_searches_under_way_are_those_node_by_node(compiled, mdp, depth, simulations, seed, root, rule, form, uniform):
    """Sequential halving has as many rounds as the actions that are allowed need."""
    model, v_S, prior_SA = Masked(mdp, some_mask(mdp, seed)), some_v(mdp, seed), random_policy(mdp, seed)
    options = {"root": root, "rule": rule} | form
    if uniform or (root, rule) == ("rule", "uct"):
        prior_SA = torch.full_like(prior_SA, 1 / mdp.num_actions)
    else:
        options["prior"] = prior_SA.__getitem__

    def look() -> Lookahead:
        v_leaf = v_S.__getitem__
        return mcts(model, all_states(mdp), depth=depth, v_leaf=v_leaf, simulations=simulations, wave=1, **options)

    if compiled:
        pytest.importorskip("numba")
        found = look()
    else:
        with torch_only():
            found = look()
    slow = SlowTree(model, range(mdp.num_states), depth + 1, v_S, prior_SA, root=root, rule=rule, **form)
    slow.search(simulations)
    assert_close(found.q_BA, torch.tensor(slow.root_values(), dtype=torch.float64))
    assert list(found.nodes_per_level) == slow.nodes_per_level()


def walled(state: int, action: int) -> tuple[float, list[tuple[float, float, int]]]:
    """A walk on the numbers, which has no way on in 5."""
    return -math.inf if state == 5 else 1.0, [(1.0, 0.9, state + action + 1)]


@pytest.mark.parametrize("options", [{}, {"merge": True}, {"wave": 5}])
def test_a_state_without_an_allowed_action_is_an_error_that_names_it(options):
    model = InterningModel(walled, [0], num_actions=2)
    with pytest.raises(PgtsError, match=r"rewards in state \d+ are \[-inf, -inf\]; .* one action must be"):
        mcts(model, torch.tensor([0]), depth=9, v_leaf=zeros, simulations=400, **options)
    with pytest.raises(PgtsError, match="one action must be"):
        expectimax(InterningModel(walled, [0], num_actions=2), torch.tensor([0]), depth=9, v_leaf=zeros)


@pytest.mark.parametrize("options", [{}, {"merge": True}, {"wave": 5}])
def test_a_prior_of_forbidden_actions_alone_is_an_error(options):
    mdp = random_mdp(5, 3, branching=2)
    allowed_SA = torch.ones(5, 3, dtype=torch.bool)
    allowed_SA[2, 0] = False
    prior_SA = torch.tensor([1.0, 0, 0]).double().expand(5, 3)
    with pytest.raises(
        PgtsError, match=r"the prior of state 2 is \[1.0, 0.0, 0.0\]; one of its allowed actions, \[1, 2\]"
    ):
        mcts(
            Masked(mdp, allowed_SA), torch.arange(5), depth=2, v_leaf=zeros, simulations=9,
            prior=prior_SA.__getitem__, **options,
        )  # fmt: skip
