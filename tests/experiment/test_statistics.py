"""What is said of the scores of runs: held to SciPy, to brute force, and to how often the truth is covered."""

import itertools

import numpy as np
import pytest
import scipy.stats

from pgts_torch.experiment.statistics import (
    Mean,
    bootstrap_interval,
    estimate,
    interquartile_mean,
    probability_of_improvement,
)


def test_the_interquartile_mean_is_that_of_scipy():
    generator = np.random.default_rng(0)
    for count in (1, 2, 3, 4, 5, 8, 10, 13):
        score_R = generator.normal(size=count)
        assert interquartile_mean(score_R) == pytest.approx(scipy.stats.trim_mean(score_R, 0.25))
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 1e9])) == 1.5


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    # 400 experiments of 20 runs: between 330 and 395 covers unless p is below 0.87 or above 0.98 (error below 1e-3).
    generator = np.random.default_rng(1)
    intervals = [bootstrap_interval(generator.normal(3.0, 2.0, size=20)) for _ in range(400)]
    assert 330 <= sum(low <= 3.0 <= high for low, high in intervals) <= 395
    assert bootstrap_interval(np.array([1.0, 1.0])).tolist() == [1.0, 1.0]


def test_intervals_of_many_points_are_those_of_each():
    score_XR = np.random.default_rng(3).normal(size=(4, 7))
    each = np.stack([bootstrap_interval(score_R) for score_R in score_XR], axis=-1)
    np.testing.assert_array_equal(bootstrap_interval(score_XR), each)


def test_the_interval_shrinks_with_the_root_of_the_number_of_runs():
    def width(count: int) -> float:
        low, high = bootstrap_interval(np.random.default_rng(2).normal(size=count))
        return float(high - low)

    assert width(1600) == pytest.approx(width(100) / 4, rel=0.25)


def test_the_interval_over_environments_is_that_of_scipys_stratified_bootstrap():
    random = np.random.default_rng(4)
    strata = random.normal(0.0, 1.0, size=8), random.normal(5.0, 3.0, size=12), random.normal(-2.0, 0.1, size=5)
    peer = scipy.stats.bootstrap(
        strata,
        lambda *drawn, axis: scipy.stats.trim_mean(np.concatenate(drawn, axis=axis), 0.25, axis=axis),
        method="percentile",
        n_resamples=20_000,
    ).confidence_interval
    low, high = bootstrap_interval(*strata, resamples=20_000)
    width = peer.high - peer.low
    assert (low, high) == pytest.approx((peer.low, peer.high), abs=0.03 * width)
    pooled = bootstrap_interval(np.concatenate(strata), resamples=20_000)
    assert pooled[1] - pooled[0] > 1.3 * width  # which does not know how far environments are apart


def test_the_probability_of_improvement_is_that_of_mann_and_whitney_and_the_mean_over_environments():
    random = np.random.default_rng(5)
    x_R, y_R = random.integers(0, 6, size=9).astype(float), random.integers(0, 5, size=7).astype(float)
    brute = np.mean([(x > y) + (x == y) / 2 for x, y in itertools.product(x_R, y_R)])
    found = float(probability_of_improvement(x_R, y_R))
    assert found == pytest.approx(brute)
    assert found == pytest.approx(scipy.stats.mannwhitneyu(x_R, y_R).statistic / 63)
    assert probability_of_improvement(x_R, y_R, np.ones(2), np.zeros(3)) == pytest.approx((found + 1) / 2)
    assert probability_of_improvement(np.ones(2), np.ones(3)) == 0.5
    assert probability_of_improvement(1e6 * x_R, 1e6 * y_R) == pytest.approx(found)


def test_a_single_run_of_each_environment_has_no_interval_and_two_of_one_have():
    assert estimate([np.array([3.0]), np.array([5.0])]) == Mean(4.0, None, None)
    some = estimate([np.array([3.0, 7.0]), np.array([5.0])])
    assert some.low is not None
    assert some.low < some.mean < some.high
