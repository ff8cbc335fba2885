"""A tabular MDP as a model, and the MDP behind an environment."""

import gymnasium
import numpy as np
import pytest
import scipy.stats
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import MissingModel
from pgts_torch.models import TabularModel, Transitions, tabular
from pgts_torch.models.tabular import tabular_truth
from pgts_torch.seeding import sample_keys, stream
from pgts_torch.tabular import TabularMDP, grid, ladder
from tests.support import ZOO, outcomes_of, zoo

DRAWS = 2_000
FALSE_ALARM = 1e-6
"""Probability with which a right model fails a test of frequencies, had its seed not been fixed."""


def every_pair(mdp: TabularMDP, times: int = 1) -> tuple[Tensor, Tensor]:
    pairs = torch.cartesian_prod(torch.arange(mdp.num_states), torch.arange(mdp.num_actions))
    return tuple(pairs.repeat_interleave(times, dim=0).T)


def p_value(mdp: TabularMDP, sampled: Transitions, times: int) -> float:
    """Pearson's chi-square of all pairs (s, a) together: how likely so large a deviation from the table is."""
    statistic, freedom = 0.0, 0
    A = mdp.num_actions
    outcome = list(zip(sampled.next_state_N.tolist(), sampled.discount_N.tolist(), strict=True))
    for pair in range(mdp.num_states * A):
        expected = outcomes_of(mdp, *divmod(pair, A))
        seen = outcome[pair * times : (pair + 1) * times]
        if not set(seen) <= set(expected):
            return 0.0
        statistic += sum((seen.count(key) - times * p) ** 2 / (times * p) for key, p in expected.items())
        freedom += len(expected) - 1
    return float(scipy.stats.chi2.sf(statistic, freedom)) if freedom else 1.0


def keys(count: int, seed: int) -> Tensor:
    return sample_keys(count, generator=stream(seed, "keys"))


def sample(mdp: TabularMDP, times: int, dtype: torch.dtype = torch.float64) -> Transitions:
    state_N, action_N = every_pair(mdp, times)
    return TabularModel(mdp, dtype=dtype).sample(state_N, action_N, key_N=keys(len(state_N), 1))


@pytest.mark.parametrize("name", ZOO)
def test_the_outcomes_of_queried_states_are_the_rows_of_the_table_in_their_order(name):
    mdp = zoo(name)
    queried = torch.tensor([mdp.num_states - 1, 0, mdp.num_states // 2, 0])
    answer = TabularModel(mdp).outcomes(queried)
    assert torch.equal(answer.reward_NA, mdp.outcomes.reward_NA[queried])
    assert torch.equal(answer.prob_NAK, mdp.outcomes.prob_NAK[queried])
    assert torch.equal(answer.discount_NAK, mdp.outcomes.discount_NAK[queried])
    assert torch.equal(answer.child_NAK, mdp.outcomes.child_NAK[queried])
    assert answer.num_children == mdp.num_states


@pytest.mark.parametrize("name", ["ladder", "garnet", "grid, absorbing", "deep_sea", "FrozenLake"])
def test_sampled_outcomes_have_the_frequencies_of_the_table(name):
    assert p_value(zoo(name), sample(zoo(name), DRAWS), DRAWS) > FALSE_ALARM


def test_frequencies_tell_one_table_from_another_with_the_same_successors():
    slippery, more_slippery = (grid(4, slip=slip, traps=()) for slip in (0.10, 0.13))
    sampled = sample(slippery, DRAWS)
    assert p_value(slippery, sampled, DRAWS) > FALSE_ALARM
    assert p_value(more_slippery, sampled, DRAWS) < FALSE_ALARM


def padded(prob: list[float]) -> TabularMDP:
    """One state; outcome k has discount k / 10, by which it is recognised."""
    K = len(prob)
    outcomes = Outcomes(
        torch.zeros(1, 1, dtype=torch.float64),
        torch.tensor([[prob]], dtype=torch.float64),
        torch.arange(K, dtype=torch.float64)[None, None] / 10,
        torch.zeros(1, 1, K, dtype=torch.int64),
        1,
    )
    return TabularMDP(outcomes, torch.ones(1, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "prob", [[0.0, 0.5, 0.0, 0.5, 0.0], [1.0, 0.0], [0.0, 1.0], [1 / 3, 1 / 3, 0.0, 1 / 3 - 5e-10, 0.0, 0.0]]
)
def test_outcomes_with_probability_0_are_never_sampled_wherever_they_stand(prob, dtype):
    sampled = sample(padded(prob), 20_000, dtype)
    assert set((sampled.discount_N * 10).round().int().tolist()) == {k for k, p in enumerate(prob) if p > 0}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("uniform", "outcome"), [(lambda eps: 0.0, 1), (lambda eps: 1 - eps / 2, 4)])
def test_even_the_least_and_the_largest_number_below_1_give_a_possible_outcome(uniform, outcome, dtype, monkeypatch):
    number = uniform(torch.finfo(dtype).eps)
    monkeypatch.setattr(tabular, "uniform", lambda key_N, dtype: torch.full(key_N.shape, number, dtype=dtype))
    sampled = sample(padded([0.0, 0.1, 0.1, 0.1, 0.7 - 9e-10, 0.0, 0.0]), 1, dtype)
    assert sampled.discount_N.item() == pytest.approx(outcome / 10)


def test_a_terminal_outcome_has_discount_0_and_the_others_keep_theirs():
    mdp = zoo("grid, absorbing")
    sampled = sample(mdp, 20)
    state_N, _ = every_pair(mdp, 20)
    ends_N = (state_N == 12) | (state_N == 24)
    assert bool((sampled.discount_N[ends_N] == 0).all())
    assert bool((sampled.discount_N[~ends_N] == 0.9).all())
    assert 0 < int(ends_N.sum()) < len(ends_N)


def test_the_reward_is_that_of_the_state_and_the_action_whatever_follows():
    mdp = zoo("FrozenLake")
    state_N, action_N = every_pair(mdp, 5)
    sampled = TabularModel(mdp).sample(state_N, action_N, key_N=keys(len(state_N), 0))
    assert torch.equal(sampled.reward_N, mdp.outcomes.reward_NA[state_N, action_N])
    assert bool((sampled.reward_N > 0).any())


def test_an_outcome_is_a_function_of_state_action_and_key_alone():
    model, (state_N, action_N) = TabularModel(zoo("garnet")), every_pair(zoo("garnet"))
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    key_N, order_N = keys(len(state_N), 0), torch.randperm(len(state_N), generator=stream(0, "order"))
    sampled_N = model.sample(state_N, action_N, key_N=key_N).next_state_N
    reordered_N = model.sample(state_N[order_N], action_N[order_N], key_N=key_N[order_N]).next_state_N
    assert torch.equal(reordered_N, sampled_N[order_N])
    assert not torch.equal(model.sample(state_N, action_N, key_N=keys(len(state_N), 1)).next_state_N, sampled_N)
    assert torch.equal(torch.get_rng_state(), torch_before)
    assert np.array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_answers_are_in_the_dtype_of_the_model_with_the_same_frequencies(dtype):
    mdp = grid(4, slip=0.2, traps=(), absorbing=True)
    model, sampled = TabularModel(mdp, dtype=dtype), sample(mdp, DRAWS, dtype)
    answer = model.outcomes(torch.tensor([3]))
    for tensor in (answer.reward_NA, answer.prob_NAK, answer.discount_NAK, sampled.reward_N, sampled.discount_N):
        assert tensor.dtype == model.dtype == dtype
    exact_discount_N = sampled.discount_N.double().round(decimals=6)
    rounded = Transitions(sampled.reward_N.double(), exact_discount_N, sampled.next_state_N)
    assert p_value(mdp, rounded, DRAWS) > FALSE_ALARM


# The MDP behind an environment


def same(a: TabularMDP, b: TabularMDP) -> bool:
    return all(
        torch.equal(x, y)
        for x, y in [
            (a.outcomes.reward_NA, b.outcomes.reward_NA),
            (a.outcomes.prob_NAK, b.outcomes.prob_NAK),
            (a.outcomes.discount_NAK, b.outcomes.discount_NAK),
            (a.outcomes.child_NAK, b.outcomes.child_NAK),
            (a.start_S, b.start_S),
        ]
    )


@pytest.mark.parametrize("id", ["FrozenLake-v1", "CliffWalking-v1", "Taxi-v4"])
def test_the_mdp_of_an_environment_with_a_P_table_is_that_table_with_the_given_discount(id):
    env = gymnasium.make(id)
    truth = tabular_truth(env, gamma=0.7)
    assert same(truth, TabularMDP.from_gymnasium(env, 0.7))
    assert not same(truth, TabularMDP.from_gymnasium(env, 0.8))
    envs = gymnasium.make_vec(id, num_envs=2, vectorization_mode="sync")
    assert same(tabular_truth(envs, gamma=0.7), truth)
    assert same(tabular_truth(RecordEpisodeStatistics(envs), gamma=0.7), truth)
    envs.close()


def test_the_mdp_of_an_environment_of_pgts_is_its_own_with_its_own_discount():
    env = gymnasium.make("pgts/Ladder-v0", n=4, gamma=0.8)
    envs = gymnasium.make_vec("pgts/Ladder-v0", num_envs=3, n=4, gamma=0.8)
    sync = gymnasium.make_vec("pgts/Ladder-v0", num_envs=2, vectorization_mode="sync", n=4, gamma=0.8)
    for environment in (env, envs, sync, RecordEpisodeStatistics(envs)):
        assert same(tabular_truth(environment, gamma=0.5), ladder(4, gamma=0.8))
    assert not same(tabular_truth(env, gamma=0.8), ladder(4, gamma=0.5))
    sync.close()


@pytest.mark.parametrize("envs", [None, 2])
def test_an_environment_without_a_table_is_refused_and_named(envs):
    if envs is None:
        env = gymnasium.make("CartPole-v1")
    else:
        env = gymnasium.make_vec("CartPole-v1", num_envs=envs, vectorization_mode="sync")
    with pytest.raises(MissingModel, match=r"CartPole.* has no transition table: env\.unwrapped\.P is missing"):
        tabular_truth(env, gamma=0.9)
    env.close()
