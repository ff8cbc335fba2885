"""What a lookahead proves: an upper bound on what is missing to the optimum."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.ranks import Ranks
from pgts_torch.agent.rollout import Rollout
from pgts_torch.models.base import Model
from pgts_torch.search.engine import Search


def certificate(
    search: Search,
    model: Model,
    experience: Rollout,
    state_N: Int[Tensor, "N"],
    v_N: Float[Tensor, "N"],
    *,
    expansions: int,
    generator: torch.Generator,
    ranks: Ranks,
) -> float:
    """An upper bound on J* - J^pi, true as far as v is right at the start states.        [docs/theory.md, Prop. 5]

        J* - J^pi <= mean over starts of (T^n w)(s) - v(s),        w the highest value that there can be

    Args:
        search, model: that can make T^n w, and what it asks.
        experience: whose starts are meant.
        state_N, v_N: the visited states, ascending, and v^pi there.
        expansions: n. With as many as the lookahead of the iteration has, a process alone asks the model nothing new.
        generator: of the search.
        ranks: each of which looks from its part of the start states.

    Returns:
        The bound, at least 0, in reward units; infinite where the model knows no largest value, or the search proves
        nothing.
    """
    every_start, every_count = experience.state_TB[0].unique(return_counts=True)
    starts, count_N = ranks.part(every_start), ranks.part(every_count)
    highest = torch.tensor(model.highest_value, dtype=torch.float64, device=v_N.device)

    def missing() -> float:
        """Of the starts of this rank, their share of the mean."""
        if not search.keeps_bounds:
            return math.inf
        upper_N = highest.expand(len(starts))
        if expansions and len(starts) and bool(highest.isfinite()):
            look = search(starts, depth=expansions - 1, generator=generator, v_leaf=lambda s: highest.expand(len(s)))
            upper_N = look.q_BA.amax(-1)
        missing_N = upper_N - v_N[torch.searchsorted(state_N, starts)]
        return float(missing_N @ count_N.double() / experience.num_episodes)

    return max(0.0, sum(ranks.gather("certificate", missing)))
