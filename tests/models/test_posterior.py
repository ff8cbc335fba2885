"""Certificates from data: they hold as often as they say, and say something."""

import numpy as np
import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.models import CountsModel
from pgts_torch.models.posterior import posterior_certificate, sampled_tables
from pgts_torch.options import Counts
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, random_mdp
from tests.models.test_counts import every_pair, learned, steps
from tests.support import random_policy, uniform_policy, zoo


def greedy(mdp: TabularMDP, model: CountsModel) -> torch.Tensor:
    """The policy that is optimal in what the model has seen."""
    outcomes = model.outcomes(torch.arange(mdp.num_states))
    return exact.optimal(TabularMDP(outcomes, mdp.start_S)).pi_SA


def gap_and_certificate(seed: int, n: int, level: float, strength: float) -> tuple[float, float]:
    mdp = random_mdp(6, 2, branching=2, gamma=0.9, seed=seed)
    model = learned(mdp, steps(mdp, every_pair(mdp, n), seed))
    pi_SA = greedy(mdp, model)
    given = {"strength": strength, "draws": 50, "generator": stream(seed, "draws")}
    found = posterior_certificate(model, pi_SA, mdp.start_S, level=level, **given)
    return exact.optimal(mdp).J - exact.evaluate(mdp, pi_SA).J, found


def test_a_certificate_of_95_percent_holds_in_at_least_91_percent_of_200_mdps_and_says_more_with_more_samples():
    few, many = (np.array([gap_and_certificate(seed, n, 0.95, 0.05) for seed in range(200)]) for n in (10, 100))
    for gap, certificate in (few.T, many.T):
        # what 95 % allows with an error probability of 1 %
        assert np.mean(certificate >= gap - 1e-9) >= 0.91
    assert 0 < many[:, 1].mean() < few[:, 1].mean() / 4


def test_a_quantile_of_5_percent_without_the_unknown_would_hold_too_seldom():
    gap, certificate = np.array([gap_and_certificate(seed, 10, 0.05, 1e-9) for seed in range(200)]).T
    assert np.mean(certificate >= gap - 1e-9) < 0.91


def test_where_everything_is_certain_and_seen_the_certificate_is_the_gap():
    mdp = zoo("combination_lock")
    model = learned(mdp, steps(mdp, every_pair(mdp)), gamma=0.99)
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


def test_sampled_tables_have_the_means_of_the_posterior():
    mdp = zoo("FrozenLake")
    model = learned(mdp, steps(mdp, every_pair(mdp, 6)), gamma=0.99)
    tables = sampled_tables(model, 4000, strength=1.0, unknown_worth=1.0, generator=stream(0, "draws"))
    pair, draws = 6 * 4 + 1, tables.prob_NAK.view(4000, 64, 4)[:, 6 * 4 + 1]
    count_K = model.counts.count_C[model.counts.pair_C == pair]
    weight_K = torch.zeros(4, dtype=torch.float64)
    weight_K[: len(count_K)], weight_K[-1] = torch.from_numpy(count_K), 2.0
    # 6 visits and 2 for the unknown: a deviation of at most 0.17 of each; outside of 5 with a probability below 1e-6
    torch.testing.assert_close(draws.mean(0), weight_K / 8, rtol=0, atol=5 * 0.17 / 4000**0.5)
    assert draws.std(0)[weight_K > 0].min() > 0.05


@pytest.mark.parametrize("given", [{"level": 1.0}, {"draws": 0}, {"pi_SA": torch.ones(2, 1), "start_S": torch.ones(2)}])
def test_what_no_certificate_can_be_made_of_is_refused(given):
    model = CountsModel(3, 2, gamma=0.9)
    arguments = {"pi_SA": torch.full((3, 2), 0.5), "start_S": torch.ones(3) / 3, "generator": stream(0, "draws")}
    with pytest.raises(PgtsError, match=next(iter(given))):
        posterior_certificate(model, **(arguments | given))
