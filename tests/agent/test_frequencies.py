"""Evidence against claimed probabilities: never against true ones, soon against others, and the same in any order."""

import math

import numpy as np
import pytest
import scipy.stats
import torch

from pgts_torch.agent.frequencies import MARGINS, Frequencies
from pgts_torch.agent.model_check import ENOUGH
from tests import reliability

CLAIMED = np.array([[1 / 3, 1 / 3, 1 / 3], [0.5, 0.5, 0.0], [0.1, 0.2, 0.7], [1.0, 0.0, 0.0]])


def outcomes(random: np.random.Generator, true_RK: np.ndarray, row_V: np.ndarray) -> np.ndarray:
    cumulative_VK = true_RK.cumsum(-1)[row_V]
    return (cumulative_VK <= random.random((len(row_V), 1)) * cumulative_VK[:, -1:]).sum(-1)


def followed(true_RK: np.ndarray, *, seed: int, batches: int, batch: int) -> tuple[Frequencies, np.ndarray]:
    """A test after these batches, and log E after each of them."""
    random, test = np.random.default_rng(seed), Frequencies(torch.from_numpy(CLAIMED))
    evidence = []
    for _ in range(batches):
        row_V = random.choice(len(CLAIMED), batch, p=[0.4, 0.3, 0.2, 0.1])
        test.observe(row_V, outcomes(random, true_RK, row_V))
        evidence.append(test.log_evidence)
    return test, np.array(evidence)


def by_hand(batches: list[list[tuple[int, int]]], margin: float) -> float:
    """E of one margin, by a loop over steps and shares, every batch bet on at once."""
    count, wealth = np.zeros(CLAIMED.shape), {(r, g): 1.0 for r in range(len(CLAIMED)) for g in range(1, 8)}
    for batch in batches:
        before = count.copy()
        for row, outcome in batch:
            if (CLAIMED[row] > 0).sum() == 1:
                continue
            seen = before[row].sum()
            event = {k for k in range(3) if before[row, k] > seen * CLAIMED[row, k]}
            fair = sum(CLAIMED[row, k] for k in event) + margin
            if event and fair < 1 and sum(before[row, k] for k in event) / seen > fair:
                for g in range(1, 8):
                    wealth[row, g] *= 1 + 2.0**-g * (1 - fair) / fair if outcome in event else 1 - 2.0**-g
            count[row, outcome] += 1
    product = np.mean([math.prod(wealth[r, g] for r in range(len(CLAIMED))) for g in range(1, 8)])
    return float((product + np.mean(list(wealth.values()))) / 2)


def test_the_evidence_is_that_of_bets_made_step_by_step_in_any_order():
    random, test, batches = np.random.default_rng(1), Frequencies(torch.from_numpy(CLAIMED)), []
    true_RK = np.array([[0.6, 0.3, 0.1], [0.7, 0.3, 0.0], [0.1, 0.2, 0.7], [1.0, 0.0, 0.0]])
    for size in (5, 9, 20, 60):  # each is large enough to be bet on at once
        row_V = random.integers(len(CLAIMED), size=size)
        batches.append(list(zip(row_V.tolist(), outcomes(random, true_RK, row_V).tolist(), strict=True)))
        rows, seen = map(np.array, zip(*random.permutation(batches[-1]), strict=True))
        test.observe(rows, seen)
    assert test.log_evidence == pytest.approx([math.log(by_hand(batches, margin)) for margin in MARGINS], rel=1e-9)
    assert max(map(abs, test.log_evidence)) > 0.1


@pytest.mark.parametrize(("runs", "batches"), [(150, 12), pytest.param(2_000, 43, marks=pytest.mark.long)])
def test_true_probabilities_are_never_called_wrong_and_e_is_as_seldom_large_as_it_may_be(runs, batches):
    """Runs of 1,800 steps, in the long form of 6,450.

    If Prop. 9 holds, P(E ever reaches x) <= 1/x in a run, and each of the five counts is above its limit with a
    probability below 1e-6: the number of runs in which that happens is at most binomial.
    """
    evidence_RTM = np.stack([followed(CLAIMED, seed=seed, batches=batches, batch=150)[1] for seed in range(runs)])
    highest_RM = evidence_RTM.max(1)
    assert int((highest_RM[:, 0] >= ENOUGH).sum()) == 0
    for x in (20, 1_000):
        counts = (highest_RM >= math.log(x)).sum(0)
        assert counts.max() <= scipy.stats.binom.isf(1e-6, runs, 1 / x)
    off = followed(CLAIMED + 0.06 * np.array([[1, -1, 0]] * 3 + [[0, 0, 0]]), seed=0, batches=60, batch=600)[1]
    assert off.max(0).min() > math.log(1_000)
    if runs >= 2_000:
        reached = (highest_RM[:, 0] >= math.log(20)).sum()
        reliability.record(
            "sequential tests of true probabilities",
            runs=runs,
            stopped=0,
            runs_with_evidence_above_20=int(reached),
            expected_at_most=runs // 20,
        )


def test_e_has_a_mean_of_at_most_1():
    last_RM = np.exp([followed(CLAIMED, seed=seed, batches=12, batch=150)[1][-1] for seed in range(150)])
    assert (last_RM.mean(0) <= 1 + 4 * last_RM.std(0) / math.sqrt(len(last_RM))).all()


def test_probabilities_within_the_margin_are_never_called_wrong_though_they_are_doubted():
    true_RK = CLAIMED + 0.015 * np.array([[1, -1, 0], [1, -1, 0], [1, 0, -1], [0, 0, 0]])
    _, evidence = followed(true_RK, seed=0, batches=60, batch=5_000)
    assert evidence[:, 0].max() < 3
    assert evidence[-1, 0] < 0
    assert evidence[-1, 1] > ENOUGH


@pytest.mark.parametrize(("rows", "by", "most"), [((0, 1, 2), 0.06, 40_000), ((2,), 0.2, 20_000), ((1,), 0.45, 2_000)])
def test_probabilities_that_are_off_are_called_wrong_be_it_a_little_in_all_rows_or_much_in_one(rows, by, most):
    true_RK = CLAIMED.copy()
    true_RK[rows, 0] += by
    true_RK[rows, 1] -= np.minimum(by, true_RK[rows, 1])
    true_RK /= true_RK.sum(-1, keepdims=True)
    test, evidence = followed(true_RK, seed=0, batches=most // 200, batch=200)
    assert evidence[:, 0].max() > ENOUGH
    worst = test.worst()
    assert worst.row in rows
    assert abs(worst.happened / worst.seen - worst.claimed) > 0.02


def test_a_loaded_test_goes_on_with_the_same_bits():
    test, _ = followed(CLAIMED, seed=0, batches=7, batch=40)
    other = Frequencies(torch.from_numpy(CLAIMED))
    other.load_state_dict(test.state_dict())
    assert other.log_evidence == test.log_evidence
    for each in (test, other):
        random = np.random.default_rng(3)
        for _ in range(5):
            row_V = random.integers(len(CLAIMED), size=50)
            each.observe(row_V, outcomes(random, CLAIMED, row_V))
    assert other.log_evidence == test.log_evidence
    assert repr(other.state_dict()) == repr(test.state_dict())


def test_rows_in_which_one_outcome_is_certain_are_not_bet_on():
    test = Frequencies(torch.tensor([[1.0, 0.0]], dtype=torch.float64))
    assert not test.has_chance
