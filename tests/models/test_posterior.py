"""Certificates from data: they hold as often as they say, and say something."""

import math

import numpy as np
import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.models import CountsModel
from pgts_torch.models.posterior import posterior_certificate, sampled_tables
from pgts_torch.options import Counts
from pgts_torch.seeding import numpy_stream, stream
from pgts_torch.tabular import TabularMDP, exact, random_mdp
from tests.models.test_counts import every_pair, learned, steps
from tests.support import random_policy, rewarded, uniform_policy, zoo


def greedy(mdp: TabularMDP, model: CountsModel) -> torch.Tensor:
    """The policy that is optimal in what the model has seen."""
    outcomes = model.outcomes(torch.arange(mdp.num_states))
    return exact.optimal(TabularMDP(outcomes, mdp.start_S)).pi_SA


def gap_and_certificate(seed: int, n: int, level: float) -> tuple[float, float]:
    mdp = random_mdp(6, 2, branching=2, gamma=0.9, seed=seed)
    model = learned(mdp, steps(mdp, every_pair(mdp, n), seed))
    pi_SA = greedy(mdp, model)
    found = posterior_certificate(model, pi_SA, mdp.start_S, level=level, draws=50, generator=stream(seed, "draws"))
    return exact.optimal(mdp).J - exact.evaluate(mdp, pi_SA).J, found


def test_a_certificate_of_95_percent_holds_in_at_least_91_percent_of_200_mdps_and_says_more_with_more_samples():
    few, many = (np.array([gap_and_certificate(seed, n, 0.95) for seed in range(200)]) for n in (10, 100))
    for gap, certificate in (few.T, many.T):
        # what 95 % allows with an error probability of 1 %
        assert np.mean(certificate >= gap - 1e-9) >= 0.91
    assert 0 < many[:, 1].mean() < few[:, 1].mean() / 4


def test_a_quantile_of_5_percent_would_hold_too_seldom():
    gap, certificate = np.array([gap_and_certificate(seed, 10, 0.05) for seed in range(200)]).T
    assert np.mean(certificate >= gap - 1e-9) < 0.91


def test_where_everything_is_certain_and_seen_the_certificate_is_the_gap():
    mdp = zoo("combination_lock")
    model = learned(mdp, steps(mdp, every_pair(mdp, 100)), gamma=0.99)
    pi_SA = random_policy(mdp)
    gap = exact.optimal(mdp).J - exact.evaluate(mdp, pi_SA).J
    assert gap > 0.1
    found = posterior_certificate(model, pi_SA, mdp.start_S, generator=stream(0, "draws"))
    assert found == pytest.approx(gap, rel=1e-5)


def test_where_nothing_was_seen_the_certificate_is_the_range_of_values():
    mdp = zoo("garnet")
    model = CountsModel(mdp.num_states, mdp.num_actions, gamma=0.9, options=Counts(value_range=[-3.0, 8.0]))
    found = posterior_certificate(model, uniform_policy(mdp), mdp.start_S, generator=stream(0, "draws"))
    assert found == pytest.approx(11.0)


def test_where_starts_are_known_from_episodes_only_the_certificate_covers_starts_that_were_not_seen():
    mdp = zoo("combination_lock")
    model = learned(mdp, steps(mdp, every_pair(mdp, 1000)), gamma=0.99)
    pi_SA = random_policy(mdp)
    gap_S = exact.optimal(mdp).v_S - exact.evaluate(mdp, pi_SA).v_S
    start_S = torch.zeros(mdp.num_states)
    start_S[:2] = 0.5
    given = {"generator": stream(0, "draws"), "draws": 2000}
    known, many, few = (posterior_certificate(model, pi_SA, start_S, num_starts=n, **given) for n in (None, 10**6, 4))
    assert known == pytest.approx(float(gap_S[:2].mean()), rel=1e-5)
    assert many == pytest.approx(known, rel=0.01)
    low, high = model.value_range
    assert known + 0.05 * (high - low) < few < high - low


def test_states_that_were_never_visited_take_no_room():
    few, many = (CountsModel(n, 2, gamma=0.9, options=Counts(value_range=[0.0, 2.0])) for n in (5, 10**6))
    mdp = random_mdp(4, 2, branching=2, gamma=0.9)
    for model in (few, many):
        model.learn(steps(mdp, every_pair(mdp, 5)), generator=stream(0, "learn"))
    found = [
        posterior_certificate(
            model,
            torch.full((model.num_states, 2), 0.5),
            torch.eye(1, model.num_states)[0],
            generator=stream(0, "draws"),
        )
        for model in (few, many)
    ]
    assert found[0] == found[1]
    tables, visited = sampled_tables(many, 3, unknown_worth=1.0, random=numpy_stream(0, "draws"))
    assert (tables.num_states, len(visited)) == (3 * 5, 4)


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_certificates_have_the_unit_of_rewards(factor):
    found = []
    for scale in (1.0, factor):
        mdp = rewarded(random_mdp(5, 2, branching=2, gamma=0.9), factor=scale)
        options = Counts(value_range=[0.0, 10.0 * scale])
        model = CountsModel(mdp.num_states, mdp.num_actions, gamma=0.9, options=options)
        model.learn(steps(mdp, every_pair(mdp, 20)), generator=stream(0, "learn"))
        given = {"num_starts": 3, "generator": stream(0, "draws")}
        found.append(posterior_certificate(model, uniform_policy(mdp), mdp.start_S, **given))
    assert found[1] == pytest.approx(factor * found[0], rel=1e-9)


def posterior_mean(seen: list[list[int]], pair: list[int]) -> list[float]:
    """The mean probabilities of the outcomes that a pair has had, by summing over the posterior of M and b."""
    most, total, means = max(map(len, seen)), 0.0, [0.0] * len(pair)
    for i, M in enumerate(sorted({math.ceil(most * 2 ** (j / 2)) for j in range(11)})):
        for b in (2.0**j for j in range(-5, 3)):
            log = -i * math.log(2)
            for c in seen:
                log += math.lgamma(M + 1) - math.lgamma(M - len(c) + 1) + math.lgamma(M * b)
                log += sum(math.lgamma(x + b) - math.lgamma(b) for x in c) - math.lgamma(sum(c) + M * b)
            share = math.exp(log)
            total += share
            means = [mean + share * (x + b) / (sum(pair) + M * b) for mean, x in zip(means, pair, strict=True)]
    return [mean / total for mean in means]


def test_sampled_tables_have_the_means_of_the_posterior():
    mdp = random_mdp(3, 2, branching=3, gamma=0.9)
    model = learned(mdp, steps(mdp, every_pair(mdp, 4)))
    tables, visited = sampled_tables(model, 20_000, unknown_worth=1.0, random=numpy_stream(0, "draws"))
    assert visited.tolist() == [0, 1, 2]
    counts = model.counts
    seen = [counts.count_C[counts.pair_C == pair].tolist() for pair in range(6)]
    assert len(set(map(tuple, seen))) > 2
    for pair, count in enumerate(seen):
        draws = tables.prob_NAK.view(20_000, 4 * 2, -1)[:, pair]
        expected = torch.tensor([*posterior_mean(seen, count), 0, 0, 0], dtype=torch.float64)[: draws.shape[1]]
        expected[-1] = 1 - expected[: len(count)].sum()
        # a deviation of at most 0.5 each; outside of 5 with a probability below 1e-6
        torch.testing.assert_close(draws.mean(0), expected, rtol=0, atol=5 * 0.5 / 20_000**0.5)


def test_before_pairs_were_visited_again_nothing_says_that_the_table_is_certain():
    mdp = zoo("combination_lock")
    unknown = []
    for visits in (1, 3, 100):
        model = learned(mdp, steps(mdp, every_pair(mdp, visits)), gamma=0.99)
        tables, visited = sampled_tables(model, 1000, unknown_worth=1.0, random=numpy_stream(0, "draws"))
        rows = tables.prob_NAK.view(1000, len(visited) + 1, mdp.num_actions, -1)[:, :-1]
        assert rows.shape[-1] == 2
        unknown.append(float((rows[..., -1] > 0).any(-1).any(-1).double().mean()))
    assert 0.4 < unknown[0] < 0.6  # a priori one outcome, or more, are equally likely
    assert unknown[0] > unknown[1] > 5 * unknown[2]
    assert unknown[2] < 0.03


@pytest.mark.parametrize("given", [{"level": 1.0}, {"draws": 0}, {"pi_SA": torch.ones(2, 1), "start_S": torch.ones(2)}])
def test_what_no_certificate_can_be_made_of_is_refused(given):
    model = CountsModel(3, 2, gamma=0.9)
    arguments = {"pi_SA": torch.full((3, 2), 0.5), "start_S": torch.ones(3) / 3, "generator": stream(0, "draws")}
    with pytest.raises(PgtsError, match=next(iter(given))):
        posterior_certificate(model, **(arguments | given))
