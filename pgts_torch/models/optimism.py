"""How probable outcomes are by what was counted, those that were seen and the unknown one, and what that is worth."""

import numpy as np
import torch
from jaxtyping import Float

from pgts_torch.models.outcome_counts import OutcomeCounts
from pgts_torch.models.rewards import value_range
from pgts_torch.options.models import Counts

Probabilities = tuple[Float[np.ndarray, "C"], Float[np.ndarray, "C"]]
"""Of each outcome, and of the unknown outcome of its pair."""


def reward_limits(counts: OutcomeCounts, gamma: float) -> tuple[float, float]:
    """The lowest and the highest value that the rewards seen allow, as `CountsModel` says."""
    reward_C, ends_C = counts.reward_C, counts.discount_C == 0
    last_C, other_C = reward_C[ends_C], reward_C[~ends_C]
    low, high = value_range((other_C.min(initial=0), other_C.max(initial=0)), gamma)
    low, high = min(low, last_C.min(initial=0)), max(high, last_C.max(initial=0))
    if high == 0 and not (len(reward_C) and reward_C.max() < 0):
        high = np.abs(reward_C).max(initial=0) / (1 - gamma) or 1.0
    return float(low), float(high)


def lasting_worth(counts: OutcomeCounts, gamma: float) -> float:
    """What the largest reward seen that ends nothing is worth for ever."""
    return float(counts.reward_C[counts.discount_C > 0].max(initial=0)) / (1 - gamma)


def extra_visits(options: Counts, counts: OutcomeCounts) -> float:
    """c of `Counts.optimism`."""
    assert options.strength is not None
    return options.strength * (counts.most - 1 or 1 / (1 + counts.num_repeated))


def probabilities(options: Counts, counts: OutcomeCounts) -> Probabilities:
    """Those that follow from the counts alone, where optimism is not posterior."""
    visits_C = counts.summed(counts.count_C)
    if options.optimism == "none":
        unknown_C = np.zeros(len(visits_C))
    else:
        c = extra_visits(options, counts)
        unknown_C = {
            "rmax": (visits_C <= c).astype(np.float64),
            "bonus": np.minimum(1, c / np.sqrt(visits_C)),
            "prior": c / (visits_C + c),
        }[options.optimism]
    sizes_C = np.repeat(counts.size_P, counts.size_P)
    return (1 - unknown_C) * ((counts.count_C + 1) / (visits_C + sizes_C)), unknown_C


def sampled_probabilities(options: Counts, counts: OutcomeCounts, generator: torch.Generator) -> Probabilities:
    """From the Dirichlet distribution with the count of each outcome and 1, and c for the unknown one."""
    seed = torch.randint(2**62, (1,), generator=generator, device=generator.device)
    random = np.random.default_rng(int(seed))
    gamma_C = random.standard_gamma(counts.count_C + 1)
    unknown_C = random.standard_gamma(extra_visits(options, counts), len(counts.size_P)).repeat(counts.size_P)
    total_C = counts.summed(gamma_C) + unknown_C
    return gamma_C / total_C, unknown_C / total_C
