"""Sparse sampling: T^m Q of the sampled MDP, and how far that is from T^m Q."""

import functools
import math
from collections import defaultdict
from collections.abc import Callable, Hashable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models import SamplingModel, TabularModel, Transitions
from pgts_torch.search import Lookahead, bootstrap, expectimax, sampled
from pgts_torch.seeding import mix, stream, uniform
from pgts_torch.tabular import TabularMDP, exact, ladder, random_mdp
from tests.search.models import Critic, InterningModel, all_states, some_q, some_v, walk_the_tree, watched, zeros
from tests.support import ZOO, mdps, zoo

SHARES = ["none", "level", "search"]

Row = tuple[int, int, float, float, int]
"""state, action, reward, discount, next state."""


class Recorder(SamplingModel):
    """The samples of a tabular MDP, recorded call by call; rewards may be altered: (state, action, reward, key)."""

    def __init__(self, mdp: TabularMDP, reward: Callable[..., Tensor] = lambda s, a, r, key: r) -> None:
        self.model, self.reward = TabularModel(mdp), reward
        self.num_states, self.num_actions = mdp.num_states, mdp.num_actions
        self.device, self.dtype = self.model.device, self.model.dtype
        self.calls: list[list[Row]] = []

    def sample(self, state_N: Tensor, action_N: Tensor, *, key_N: Tensor) -> Transitions:
        outcome = self.model.sample(state_N, action_N, key_N=key_N)
        reward_N = self.reward(state_N, action_N, outcome.reward_N, key_N)
        columns = state_N, action_N, reward_N, outcome.discount_N, outcome.next_state_N
        self.calls.append(list(zip(*(column.tolist() for column in columns), strict=True)))
        return Transitions(reward_N, outcome.discount_N, outcome.next_state_N)


def look(mdp: TabularMDP, roots: Tensor, seed: int = 0, **knobs: object) -> Lookahead:
    knobs = {"samples": 4, "generator": stream(seed, "search"), "v_leaf": Critic(some_v(mdp))} | knobs
    return sampled(TabularModel(mdp), roots, **knobs)


def tied(mdp: TabularMDP, num_actions: int) -> TabularMDP:
    """The first action of an MDP, several times."""
    o = mdp.outcomes
    first = (x[:, :1].repeat(1, num_actions, 1) for x in (o.prob_NAK, o.discount_NAK, o.child_NAK))
    return TabularMDP(Outcomes(o.reward_NA[:, :1].repeat(1, num_actions), *first, o.num_children), mdp.start_S)


def copies(mdp: TabularMDP, count: int) -> TabularMDP:
    """Disjoint copies of an MDP: one search of them is so many independent searches."""
    o = mdp.outcomes
    reward, prob, discount, child = (
        x.repeat(count, *[1] * (x.ndim - 1)) for x in (o.reward_NA, o.prob_NAK, o.discount_NAK, o.child_NAK)
    )
    child += torch.arange(count).repeat_interleave(o.num_children).view(-1, 1, 1) * o.num_children
    return TabularMDP(
        Outcomes(reward, prob, discount, child, count * o.num_children), mdp.start_S.repeat(count) / count
    )


def many_looks(mdp: TabularMDP, q_SA: Tensor, count: int, **knobs: object) -> tuple[Lookahead, Callable[..., Tensor]]:
    """One search of all states of `count` copies, and what gives its answers the shape [count, S, A]."""
    several = copies(mdp, count)
    found = look(several, all_states(several), q_leaf=Critic(q_SA.repeat(count, 1)), v_leaf=None, **knobs)
    return found, lambda x_BA: x_BA.view(count, mdp.num_states, mdp.num_actions)


def errors(mdp: TabularMDP, *, searches: int, depth: int, q_SA: Tensor | None = None, **knobs: object) -> Tensor:
    """Sampled values minus T^m Q of many searches of all states, shape [searches, S, A]."""
    q_SA = some_q(mdp) if q_SA is None else q_SA
    found, shaped = many_looks(mdp, q_SA, searches, depth=depth, **{"replicates": 0} | knobs)
    return shaped(found.q_BA) - exact.lookahead(mdp, q_SA, depth)


def z_score(x_N: Tensor) -> float:
    """Mean over its standard error."""
    return float(x_N.mean() / (x_N.std() / math.sqrt(len(x_N))))


# What is estimated: T^m Q of the sampled outcomes


def by_hand(calls: list[list[Row]], root: int, levels: int, v_S: Tensor, num_actions: int) -> list[float]:
    """The values of a root in the MDP of the recorded samples, one call a level, states merged."""

    @functools.cache
    def q(state: int, level: int) -> list[float]:
        totals = [
            [r + (d * v(s, level + 1) if d else 0.0) for r, d, s in samples_by_level[level][state, a]] for a in actions
        ]
        return [math.fsum(of_action) / len(of_action) for of_action in totals]

    def v(state: int, level: int) -> float:
        return float(v_S[state]) if level == levels else max(q(state, level))

    actions = range(num_actions)
    samples_by_level = [defaultdict(list) for _ in range(levels)]
    for rows, table in zip(calls, samples_by_level, strict=False):
        for s, a, *rest in rows:
            table[s, a].append(rest)
    return q(root, 0)


@given(mdps(), st.integers(0, 3), st.integers(1, 4), st.integers(0, 1000))
def test_paths_of_a_level_share_samples_and_have_T_to_the_m_of_them(mdp, depth, C, seed):
    model, v_S = Recorder(mdp), some_v(mdp, seed)
    found = sampled(
        model, all_states(mdp), depth=depth, v_leaf=Critic(v_S), samples=C, generator=stream(seed), replicates=0
    )
    expected = [by_hand(model.calls, s, depth + 1, v_S, mdp.num_actions) for s in range(mdp.num_states)]
    torch.testing.assert_close(found.q_BA, torch.tensor(expected, dtype=torch.float64), rtol=1e-11, atol=1e-11)
    assert found.model_calls == sum(map(len, model.calls))


@given(mdps(), st.integers(0, 8), st.integers(1, 4), st.integers(0, 1000))
def test_with_one_set_of_samples_for_each_state_the_search_is_T_to_the_m_of_one_sampled_MDP(mdp, depth, C, seed):
    model, v_S = Recorder(mdp), some_v(mdp, seed)
    knobs = {"samples": C, "share": "search", "generator": stream(seed), "replicates": 0}
    found = sampled(model, torch.tensor([0]), depth=depth, v_leaf=Critic(v_S), **knobs)
    rows = [row for call in model.calls for row in call]
    table = torch.zeros(mdp.num_states, mdp.num_actions, mdp.num_states, dtype=torch.float64)
    reward = torch.zeros(mdp.num_states, mdp.num_actions, dtype=torch.float64)
    for s, a, r, d, child in rows:
        reward[s, a] += r / C
        table[s, a, child] += d / C
    v = v_S
    for _ in range(depth + 1):
        q_SA = reward + table @ v
        v = q_SA.amax(-1)
    torch.testing.assert_close(found.q_BA[0], q_SA[0], rtol=1e-11, atol=1e-11)
    queried = {(s, a) for s, a, *_ in rows}
    assert len(rows) == found.model_calls == C * len(queried)


@given(mdps(), st.integers(0, 2), st.integers(1, 3), st.integers(0, 1000))
def test_a_search_that_shares_nothing_is_the_tree_of_its_paths(mdp, depth, C, seed):
    model, v_S = Recorder(mdp), some_v(mdp, seed)
    knobs = {"samples": C, "share": "none", "generator": stream(seed), "replicates": 0}
    found = sampled(model, all_states(mdp), depth=depth, v_leaf=Critic(v_S), **knobs)
    below: list[float] = []
    for level, rows in reversed(list(enumerate(model.calls))):
        nodes = iter(below)
        values = [r + (d * (float(v_S[s]) if level == depth else next(nodes)) if d else 0.0) for _, _, r, d, s in rows]
        q_NA = torch.tensor(values, dtype=torch.float64).view(-1, mdp.num_actions, C).mean(-1)
        assert next(nodes, None) is None
        below = q_NA.amax(-1).tolist()
    torch.testing.assert_close(found.q_BA, q_NA, rtol=1e-11, atol=1e-11)
    assert found.model_calls == sum(map(len, model.calls))


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("name", ["ladder", "tightrope", "CliffWalking"])
def test_without_chance_any_C_and_any_share_give_T_to_the_m(name, share):
    mdp, roots = zoo(name), torch.tensor([0, 2])
    for depth, C in [(0, 1), (1, 3), (3, 2)]:
        found = look(mdp, roots, depth=depth, samples=C, share=share)
        full = expectimax(TabularModel(mdp), roots, depth=depth, v_leaf=Critic(some_v(mdp)))
        torch.testing.assert_close(found.q_BA, full.q_BA, rtol=1e-12, atol=1e-12)
        if C > 1:
            torch.testing.assert_close(found.stderr_BA, torch.zeros_like(found.q_BA), rtol=0, atol=1e-12)
            torch.testing.assert_close(found.bias_BA, torch.zeros_like(found.q_BA), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in ZOO if name != "Taxi"])
@pytest.mark.parametrize("share", SHARES)
def test_where_all_levels_are_enumerated_the_search_is_expectimax(name, share):
    mdp = zoo(name)
    found = look(mdp, all_states(mdp), depth=3, samples=[None, None], share=share)
    full = expectimax(TabularModel(mdp), all_states(mdp), depth=3, v_leaf=Critic(some_v(mdp)))
    assert torch.equal(found.q_BA, full.q_BA)
    assert not found.stderr_BA.any()
    assert (found.model_calls, found.nodes_per_level) == (full.model_calls, full.nodes_per_level)


@pytest.mark.parametrize("share", ["none", "level"])
def test_enumerating_a_level_removes_its_noise_and_no_other(share):
    mdp = tied(zoo("garnet"), 1)
    listed_below = errors(mdp, searches=30, depth=2, samples=[3, None], share=share)
    listed_above = errors(mdp, searches=30, depth=2, samples=[None, 3], share=share)
    neither = errors(mdp, searches=30, depth=2, samples=3, share=share)
    for some in (listed_below, listed_above):
        assert 0.01 < some.var() < 0.9 * neither.var()
    found = look(mdp, all_states(mdp), depth=2, q_leaf=Critic(some_q(mdp)), v_leaf=None, samples=[None, 3], share=share)
    assert float(found.stderr_BA.mean() / listed_above.std(0).mean()) == pytest.approx(1, abs=0.3)


def test_the_first_number_is_for_the_roots_and_the_last_for_all_deeper_levels():
    mdp = TabularMDP.from_transitions([[[(1.0, 0, 1.0, False)]]], 0.5)
    for samples, calls in [
        (3, 12),
        ([3], 12),
        ([2, 5], 17),
        ([2, None], 5),
        ([None, None, 7], 16),
        ([1, 2, 3, 4, 9], 10),
    ]:
        assert look(mdp, torch.tensor([0]), depth=3, samples=samples).model_calls == calls


# Cost


def two_states() -> TabularMDP:
    """Action 0 leads to state 0, action 1 to state 1."""
    row = [[(1.0, 0, 0.0, False)], [(1.0, 1, 1.0, False)]]
    return TabularMDP.from_transitions([row, row], 0.9)


@pytest.mark.parametrize(
    ("share", "calls", "nodes"),
    [
        ("none", 6 * (1 + 6 + 36), (1, 6, 36, 216)),
        ("level", 6 * (1 + 2 + 2), (1, 2, 2, 2)),
        ("search", 6 * 2, (1, 2, 2, 2)),
    ],
)
def test_the_work_of_three_levels_with_three_samples_of_two_actions(share, calls, nodes):
    found = look(two_states(), torch.tensor([0, 0]), depth=2, samples=3, share=share)
    assert (found.model_calls, found.nodes_per_level, found.critic_calls) == (calls, nodes, 1)


@given(mdps(), st.integers(0, 2), st.integers(1, 2), st.integers(0, 100))
def test_the_more_is_shared_the_fewer_calls(mdp, depth, C, seed):
    none, level, search = (
        look(mdp, all_states(mdp), seed, depth=depth, samples=C, share=share, replicates=0).model_calls
        for share in SHARES
    )
    full = expectimax(TabularModel(mdp), all_states(mdp), depth=depth, v_leaf=Critic(some_v(mdp))).model_calls
    assert search <= level <= none
    assert search <= C * full


def test_the_critic_is_called_once_for_distinct_states_of_the_model():
    mdp = zoo("garnet")
    for share in SHARES:
        critic = Critic(some_v(mdp))
        look(mdp, torch.tensor([3, 17]), depth=2, share=share, v_leaf=critic)
        (called,) = critic.calls
        assert len(called) == len(set(called)) <= mdp.num_states


def test_depth_0_needs_no_model_calls_with_q_and_one_level_with_v():
    mdp = zoo("garnet")
    q_SA, roots = some_q(mdp), torch.tensor([5, 2, 5])
    found = look(mdp, roots, depth=0, q_leaf=Critic(q_SA), v_leaf=None)
    assert torch.equal(found.q_BA, q_SA[roots])
    assert not found.stderr_BA.any()
    assert found.model_calls == 0
    assert look(mdp, roots, depth=0).model_calls == 2 * 3 * 4


def test_a_tree_larger_than_the_budget_is_refused():
    mdp = two_states()
    with pytest.raises(NodeBudgetExceeded, match="43 nodes"):
        look(mdp, torch.tensor([0]), depth=5, samples=3, share="none", max_nodes=42)
    look(mdp, torch.tensor([0]), depth=5, samples=3, share="level", max_nodes=42)


# Randomness


def answers(found: Lookahead) -> list[Tensor]:
    return [found.q_BA, found.stderr_BA, found.bias_BA]


def equal(these: list[Tensor], those: list[Tensor]) -> bool:
    return all(map(torch.equal, these, those))


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("depth", [0, 2, 5])
def test_splitting_or_permuting_the_roots_changes_no_bit(share, depth):
    mdp = zoo("garnet")
    depth = min(depth, 2) if share == "none" else depth
    roots = torch.randint(mdp.num_states, (9,), generator=stream(0, "roots"))
    order = torch.randperm(9, generator=stream(0, "order"))
    knobs = {"depth": depth, "share": share, "samples": 3, "replicates": 8}
    together = answers(look(mdp, roots, **knobs))
    assert equal(answers(look(mdp, roots[order], **knobs)), [x[order] for x in together])
    parts = [answers(look(mdp, part, **knobs)) for part in roots.split([1, 5, 3])]
    assert equal([torch.cat(x) for x in zip(*parts, strict=True)], together)


@pytest.mark.parametrize("share", SHARES)
def test_the_bootstrap_in_chunks_is_the_same_bit_for_bit(share, monkeypatch):
    mdp = zoo("garnet")
    whole = answers(look(mdp, torch.tensor([3, 4]), depth=1, share=share))
    monkeypatch.setattr(bootstrap, "CHUNK", 1)
    assert equal(answers(look(mdp, torch.tensor([3, 4]), depth=1, share=share)), whole)


@pytest.mark.parametrize("share", SHARES)
def test_the_samples_depend_on_the_generator_alone(share):
    mdp, generator = zoo("garnet"), stream(1, "search")
    before = torch.get_rng_state()
    first = look(mdp, all_states(mdp), depth=1, share=share, generator=generator).q_BA
    second = look(mdp, all_states(mdp), depth=1, share=share, generator=generator).q_BA
    again = look(mdp, all_states(mdp), 1, depth=1, share=share).q_BA
    assert torch.equal(first, again)
    assert not torch.equal(first, second)
    assert torch.equal(torch.get_rng_state(), before)


def coin() -> TabularMDP:
    """One state; what follows is worth more or less."""
    return TabularMDP(
        Outcomes(
            torch.zeros(1, 1, dtype=torch.float64),
            torch.full((1, 1, 2), 0.5, dtype=torch.float64),
            torch.tensor([[[0.9, 0.5]]], dtype=torch.float64),
            torch.zeros(1, 1, 2, dtype=torch.int64),
            1,
        ),
        torch.ones(1, dtype=torch.float64),
    )


@pytest.mark.parametrize(("share", "sets"), [("none", [1, 24, 576]), ("level", [1, 1, 1]), ("search", [1])])
def test_each_node_has_samples_of_its_own(share, sets):
    # 24 tosses: two of all 601 nodes have the same samples with probability 0.011.
    model = Recorder(coin())
    knobs = {"samples": 24, "share": share, "generator": stream(0), "replicates": 0}
    sampled(model, torch.tensor([0, 0]), depth=2, v_leaf=zeros, **knobs)
    samples_by_level = [
        torch.tensor([d for *_, d, _ in rows], dtype=torch.float64).view(-1, 24) for rows in model.calls
    ]
    assert list(map(len, samples_by_level)) == sets
    assert len(torch.cat(samples_by_level).unique(dim=0)) == sum(sets)


def test_an_enumerated_and_a_sampled_search_take_one_key_each():
    mdp = zoo("garnet")
    states = []
    for samples in (None, 5):
        generator = stream(1, "search")
        look(mdp, torch.tensor([0]), depth=2, samples=[samples], generator=generator)
        states.append(generator.get_state())
    assert torch.equal(*states)
    assert not torch.equal(states[0], stream(1, "search").get_state())


# How far it is from T^m Q


@pytest.mark.parametrize("share", SHARES)
def test_one_action_is_estimated_without_bias(share):
    # A false alarm has probability 0.001: |z| < 3.3. The mean over states is one number for each search.
    mdp = tied(random_mdp(20, 2, branching=4, seed=1), 1)
    assert abs(z_score(errors(mdp, searches=150, depth=2, samples=2, share=share).mean((1, 2)))) < 3.3


@pytest.mark.parametrize("share", SHARES)
def test_without_a_maximum_over_samples_every_value_is_unbiased(share):
    # 40 means of 150 searches; one beyond 4.5 standard errors has probability below 0.001.
    mdp = random_mdp(20, 2, branching=4, seed=1)
    off = errors(mdp, searches=150, depth=1, samples=4, share=share)
    assert float((off.mean(0) / (off.std(0) / math.sqrt(150))).abs().max()) < 4.5


@pytest.mark.parametrize("share", SHARES)
def test_tied_actions_are_overestimated_and_less_so_with_more_samples(share):
    # Each z is beyond 6: false alarms have probability below 1e-8.
    mdp = tied(random_mdp(20, 2, branching=4, seed=1), 3)
    few, more = (errors(mdp, searches=60, depth=2, samples=C, share=share).mean((1, 2)) for C in (2, 8))
    assert z_score(few) > 6
    assert z_score(more) > 6
    assert z_score(few - 1.4 * more) > 6


@pytest.mark.parametrize("share", ["level", "search"])
def test_the_error_falls_as_one_over_the_root_of_C(share):
    mdp, numbers = random_mdp(20, 2, branching=4, seed=1), [8, 32, 128]
    rmse = [float(errors(mdp, searches=30, depth=2, samples=C, share=share).pow(2).mean().sqrt()) for C in numbers]
    x = torch.tensor(numbers, dtype=torch.float64).log()
    y = torch.tensor(rmse, dtype=torch.float64).log()
    slope = float(((x - x.mean()) * y).sum() / ((x - x.mean()) ** 2).sum())
    assert -0.6 < slope < -0.4


def covered(mdp: TabularMDP, confidence: float, *, depth: int, searches: int, **knobs: object) -> tuple[Tensor, Tensor]:
    """Which share of the values of each search lies inside its interval: of T^m Q, and of the mean of the searches."""
    q_SA = some_q(mdp)
    found, shaped = many_looks(mdp, q_SA, searches, depth=depth, **knobs)
    low, high = map(shaped, found.interval(confidence))
    mean = (low + high).mean(0) / 2
    of_truth, of_mean = (
        ((low <= value) & (value <= high)).double().mean((1, 2)) for value in (exact.lookahead(mdp, q_SA, depth), mean)
    )
    return of_truth, of_mean


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.95])
@pytest.mark.parametrize("share", ["level", "search"])
def test_intervals_hold_the_truth_as_often_as_they_say(confidence, share):
    # 3.3 standard errors over searches, a false alarm in 1000, and 0.02 for the finite C and R of the bootstrap.
    mdp = random_mdp(20, 2, branching=4, seed=1)
    for inside in covered(mdp, confidence, depth=2, searches=30, samples=32, share=share):
        tolerance = 0.02 + 3.3 * float(inside.std()) / math.sqrt(len(inside))
        assert tolerance < 0.09
        assert float(inside.mean()) == pytest.approx(confidence, abs=tolerance)


def test_intervals_miss_the_truth_among_tied_actions_but_not_their_own_mean():
    mdp = tied(random_mdp(20, 2, branching=4, seed=1), 6)
    of_truth, of_mean = covered(mdp, 0.95, depth=3, searches=30, samples=16)
    assert float(of_truth.mean()) < 0.8
    assert float(of_mean.mean()) > 0.9


def test_the_estimated_bias_is_most_of_the_true_one_and_about_half_among_exact_ties():
    mdp = random_mdp(20, 3, branching=4, seed=1)
    for case, least, most in [(mdp, 0.6, 1.5), (tied(mdp, 3), 0.3, 0.6)]:
        q_SA = exact.optimal(case).q_SA
        found, shaped = many_looks(case, q_SA, 100, depth=4, samples=8)
        there_is = shaped(found.q_BA) - exact.lookahead(case, q_SA, 4)
        assert z_score(there_is.mean((1, 2))) > 4
        assert least < float(found.bias_BA.mean() / there_is.mean()) < most


def noisy(s: Tensor, a: Tensor, r: Tensor, key: Tensor) -> Tensor:
    return r + 4 * uniform(mix(key, 1)) - 2


def said_and_true_variance(**knobs: object) -> float:
    """Mean squared standard error over the variance of many searches, with rewards that vary."""
    mdp, count = tied(random_mdp(4, 1, branching=3, seed=1), 1), 300
    several = copies(mdp, count)
    critic = Critic(some_q(mdp).repeat(count, 1) / 10)
    found = sampled(Recorder(several, noisy), all_states(several), depth=2, q_leaf=critic, generator=stream(0), **knobs)
    return float(found.stderr_BA.pow(2).mean() / found.q_BA.view(count, -1).var(0).mean())


@pytest.mark.parametrize("share", SHARES)
def test_the_standard_error_is_the_deviation_of_the_searches_also_where_rewards_vary(share):
    assert said_and_true_variance(share=share, samples=10) == pytest.approx(1, abs=0.2)


def test_the_standard_error_is_right_where_levels_have_C_of_their_own():
    assert said_and_true_variance(samples=[8, 40]) == pytest.approx(1, abs=0.15)
    assert said_and_true_variance(samples=[40, 8]) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("share", SHARES)
def test_the_standard_error_of_few_samples_is_too_large_rather_than_too_small(share):
    assert 1 < said_and_true_variance(share=share, samples=2) < 2.5


def test_on_a_frozen_lake_values_of_few_samples_are_too_high():
    mdp = zoo("FrozenLake")
    best = exact.optimal(mdp)

    def excess(C: int) -> Tensor:
        return errors(mdp, searches=100, depth=4, q_SA=best.q_SA, samples=C)[:, 0].amax(-1)

    clairvoyant, few, many = (excess(C) for C in (1, 8, 64))
    # Differences of 100 searches each, beyond 4 standard errors: false alarms have probability below 1e-4.
    assert z_score(clairvoyant - few) > 4
    assert z_score(few - many) > 4
    assert float(clairvoyant.mean()) > 0.05
    assert float(many.mean()) < 0.01


# Edges


def test_one_sample_and_no_replicates_leave_the_error_unknown():
    mdp = zoo("garnet")
    for knobs in ({"samples": 1}, {"samples": [4, 1]}, {"replicates": 0}):
        found = look(mdp, torch.tensor([0]), depth=2, **knobs)
        assert bool(found.stderr_BA.isnan().all() and found.bias_BA.isnan().all() and found.q_BA.isfinite().all())


@pytest.mark.parametrize("share", SHARES)
def test_actions_that_are_not_allowed_stay_so_and_are_not_followed(share):
    def some_forbidden(s: Tensor, a: Tensor, r: Tensor, key: Tensor) -> Tensor:
        return r.masked_fill((a + s) % 3 == 1, -math.inf)

    mdp = zoo("garnet")
    model = Recorder(mdp, some_forbidden)
    knobs = {"depth": 2, "v_leaf": Critic(some_v(mdp)), "samples": 4, "share": share, "generator": stream(0)}
    found = sampled(model, all_states(mdp), **knobs)
    forbidden = (torch.arange(3) + all_states(mdp).unsqueeze(-1)) % 3 == 1
    assert bool((found.q_BA[forbidden] == -math.inf).all())
    assert not found.stderr_BA[forbidden].any()
    assert bool(found.q_BA[~forbidden].isfinite().all() and (found.stderr_BA[~forbidden] > 0).any())
    low, high = found.interval()
    assert bool((low[forbidden] == -math.inf).all() and (high[forbidden] == -math.inf).all())
    if share != "level":
        return
    children = [s for _, _, r, d, s in model.calls[0] if d > 0 and r > -math.inf]
    followed = {s for s, *_ in model.calls[1]}
    assert followed == set(children)


@pytest.mark.parametrize("share", SHARES)
def test_terminal_and_undiscounted_children_need_neither_node_nor_value(share):
    ends = TabularMDP.from_transitions([[[(0.5, 0, 1.0, True), (0.5, 1, 3.0, True)]], [[(1.0, 1, 0.0, False)]]], 0.9)
    for mdp in (ends, random_mdp(2, 1, gamma=0.0)):
        critic = Critic(torch.full((2,), 1e9, dtype=torch.float64))
        found = look(mdp, torch.tensor([0]), depth=4, share=share, v_leaf=critic)
        assert float(found.q_BA) == pytest.approx(float(mdp.outcomes.reward_NA[0, 0]), rel=1e-12)
        assert found.model_calls == 4
        if share != "search":
            assert (found.nodes_per_level, found.critic_calls) == ((1, 0, 0, 0, 0, 0), 0)


@pytest.mark.parametrize("share", SHARES)
def test_a_search_far_beyond_the_end_of_all_paths_is_within_the_budget_of_the_paths(share):
    mdp = TabularMDP.from_transitions([[[(1.0, 1, 1.0, False)]] * 2, [[(1.0, 0, 2.0, True)]] * 2], 0.5)
    knobs = {"depth": 90, "samples": 2, "share": share, "max_nodes": 200}
    found = look(mdp, torch.tensor([0]), v_leaf=lambda s: zeros(s) + 1e9, **knobs)
    torch.testing.assert_close(found.q_BA, torch.tensor([[2.0, 2.0]], dtype=torch.float64))


def test_enormous_values_have_a_finite_standard_error():
    mdp = TabularMDP.from_transitions([[[(0.5, 0, 1e307, False), (0.5, 0, -1e307, True)]]], 0.5)
    found = look(mdp, torch.tensor([0]), depth=3, samples=6, v_leaf=lambda s: zeros(s) + 1e308)
    assert bool(found.q_BA.isfinite() and found.stderr_BA.isfinite() and found.bias_BA.isfinite())
    assert float(found.stderr_BA) > 1e305


def test_a_float32_model_gives_float32():
    mdp = zoo("garnet")
    for share in SHARES:
        knobs = {"v_leaf": Critic(some_v(mdp)), "samples": 3, "share": share, "generator": stream(0)}
        found = sampled(TabularModel(mdp, dtype=torch.float32), all_states(mdp), depth=2, **knobs)
        assert all(x.dtype == torch.float32 and bool(x.isfinite().all()) for x in answers(found))


class Walker(InterningModel, SamplingModel):
    """A plane without an edge, without chance, whose states are numbered as they are met."""

    def __init__(self) -> None:
        super().__init__(self.go, [(0, 0), (4, 1)], num_actions=2)

    @staticmethod
    def go(state: Hashable, action: int) -> tuple[float, list[tuple[float, float, Hashable]]]:
        x, y = state
        return math.sin(3 * x + y) - 0.1 * action, [(1.0, 0.9, (x + 1, y) if action else (x, y + 1))]

    def sample(self, state_N: Tensor, action_N: Tensor, *, key_N: Tensor) -> Transitions:
        steps = [self.go(self.states[s], a) for s, a in zip(state_N.tolist(), action_N.tolist(), strict=True)]
        reward = torch.tensor([r for r, _ in steps], dtype=torch.float64)
        child = torch.tensor([self.intern(state) for _, [(_, _, state)] in steps])
        return Transitions(reward, torch.full_like(reward, 0.9), child)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("samples", [2, [2, None], [None, 2]])
def test_states_that_are_numbered_while_the_search_goes_on_reach_the_critic_as_they_are(share, samples):
    if share == "search" and samples != 2:
        return
    model = Walker()

    def height(state: Hashable) -> float:
        return math.cos(state[0]) + 0.3 * state[1]

    def v_leaf(state_N: Tensor) -> Tensor:
        return torch.tensor([height(model.states[s]) for s in state_N.tolist()], dtype=torch.float64)

    found = sampled(
        model, torch.tensor([1, 0]), depth=4, v_leaf=v_leaf, samples=samples, share=share, generator=stream(0)
    )
    expected = [walk_the_tree(Walker.go, start, 4, height, 2) for start in [(4, 1), (0, 0)]]
    torch.testing.assert_close(found.q_BA, torch.tensor(expected, dtype=torch.float64))


# Mistakes of the caller


@pytest.mark.parametrize("samples", [0, -1, [4, 0], 2.0, [True], [None, 1.5]])
@pytest.mark.usefixtures("unchecked_shapes")
def test_a_C_that_is_no_count_is_refused_and_named(samples):
    with pytest.raises(PgtsError, match="samples is"):
        look(ladder(), torch.tensor([0]), depth=1, samples=samples)


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"samples": []}, "samples is a list"),
        ({"share": "all"}, "share is 'all'"),
        ({"share": "search", "samples": [3, 4]}, r"samples is \[3, 4\]; with share='search' a state has one C"),
        ({"share": "search", "samples": [None, 4]}, "one C at all levels"),
        ({"replicates": 1}, "replicates is 1; it must be 0 or at least 2"),
        ({"replicates": -2}, "replicates is -2"),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_other_mistakes_are_refused_and_named(knobs, message):
    with pytest.raises(PgtsError, match=message):
        look(ladder(), torch.tensor([0]), **{"depth": 1} | knobs)


def test_a_leaf_value_that_is_no_number_is_named_by_the_state_of_the_model():
    mdp = zoo("garnet")
    v_S = some_v(mdp)
    v_S[23] = math.nan
    for share in SHARES:
        with pytest.raises(PgtsError, match="value of state 23 is nan"):
            look(mdp, torch.tensor([29, 23]), depth=2, samples=9, share=share, v_leaf=Critic(v_S))


def test_a_reward_that_is_no_number_is_named_by_the_state_of_the_model():
    mdp = zoo("garnet")
    model = Recorder(mdp, lambda s, a, r, key: r.masked_fill(s == 23, math.nan))
    for share in SHARES:
        with pytest.raises(PgtsError, match="rewards in state 23 are"):
            sampled(model, torch.tensor([29, 23]), depth=1, v_leaf=zeros, samples=2, share=share, generator=stream(0))


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_model_that_cannot_enumerate_or_sample_is_refused():
    with pytest.raises(PgtsError, match="Recorder cannot enumerate outcomes"):
        sampled(Recorder(ladder()), torch.tensor([0]), depth=1, v_leaf=zeros, samples=[3, None], generator=stream(0))
    with pytest.raises(PgtsError, match="WatchedModel cannot sample outcomes"):
        sampled(watched(ladder()), torch.tensor([0]), depth=1, v_leaf=zeros, samples=[3, None], generator=stream(0))


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.5, 2.0, math.nan])
def test_a_confidence_that_is_no_probability_is_refused(confidence):
    with pytest.raises(PgtsError, match="confidence is"):
        look(ladder(), torch.tensor([0]), depth=1).interval(confidence)


@pytest.mark.parametrize("share", ["none", "level", "search"])
def test_inference_mode_changes_no_sample(share):
    def found() -> Lookahead:
        knobs = {"samples": 3, "share": share, "generator": stream(0, "inference")}
        return sampled(TabularModel(ladder(5)), torch.tensor([0, 1]), depth=3, v_leaf=zeros, **knobs)

    outside = found()
    with torch.inference_mode():
        inside = found()
    assert torch.equal(inside.q_BA, outside.q_BA)
    assert torch.equal(inside.stderr_BA, outside.stderr_BA)
