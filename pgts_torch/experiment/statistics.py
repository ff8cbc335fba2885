"""Scores of runs, summed up as recommended for few runs (Agarwal et al., Deep RL at the Edge of the Statistical
Precipice, 2021): interquartile means, probabilities of improvement, and their stratified bootstrap intervals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

CONFIDENCE = 0.95
RESAMPLES = 1000

Scores = Float[np.ndarray, "*X _"]
"""Of the runs in one environment, the stratum that they are resampled in."""


@dataclass(frozen=True)
class Mean:
    """A mean over runs with the ends of its 95 % bootstrap interval; None where no environment has two runs."""

    mean: float
    low: float | None
    high: float | None


def interquartile_mean(*strata: Scores) -> Float[np.ndarray, "*X"]:
    """The mean over the runs of all strata without the lowest and the highest quarter of them, rounded down."""
    score_XR = np.concatenate(strata, axis=-1)
    num_runs = score_XR.shape[-1]
    cut = num_runs // 4
    return np.asarray(np.sort(score_XR, axis=-1)[..., cut : num_runs - cut].mean(axis=-1))


def probability_of_improvement(*strata: Scores) -> Float[np.ndarray, "*X"]:
    """P(a run of x scores higher than a run of y) + P(equal) / 2, the mean over environments.

    Args:
        strata: x and y of the first environment, x and y of the second one, and so on.
    """
    each = []
    for x_XR, y_XR in zip(strata[::2], strata[1::2], strict=True):
        x_XRR, y_XRR = x_XR[..., :, None], y_XR[..., None, :]
        each.append(((x_XRR > y_XRR) + 0.5 * (x_XRR == y_XRR)).mean(axis=(-2, -1)))
    return np.asarray(np.mean(each, axis=0))


def bootstrap_interval(
    *strata: Scores,
    statistic: Callable[..., np.ndarray] = interquartile_mean,
    random: np.random.Generator | None = None,
    resamples: int = RESAMPLES,
) -> Float[np.ndarray, "2 *X"]:
    """The ends of the middle 95 % of a statistic of resampled runs (Efron 1979), each stratum resampled by itself.

    Args:
        strata: the arguments of the statistic.
        random: None: a fixed seed, so that the same runs have the same interval.
    """
    random = np.random.default_rng(0) if random is None else random
    drawn = []
    for score_XR in strata:
        num_runs = score_XR.shape[-1]
        drawn.append(score_XR[..., random.integers(num_runs, size=(resamples, num_runs))])
    tail = (1 - CONFIDENCE) / 2
    return np.quantile(statistic(*drawn), [tail, 1 - tail], axis=-1)


def estimate(strata: Sequence[Scores], *, statistic: Callable[..., np.ndarray] = interquartile_mean) -> Mean:
    """A statistic of the scores of runs, with its interval."""
    mean = float(statistic(*strata))
    if max(score_R.shape[-1] for score_R in strata) < 2:
        return Mean(mean, None, None)
    low, high = bootstrap_interval(*strata, statistic=statistic).tolist()
    return Mean(mean, low, high)
