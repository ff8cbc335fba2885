"""Intervals of sampled values hold the truth as often as they say, also where few samples agree."""

import math

import numpy as np
import pytest
import torch

from pgts_torch.bellman import Outcomes, backup
from pgts_torch.models import TabularModel
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.search.sampled import sampled
from pgts_torch.seeding import numpy_stream, stream
from pgts_torch.tabular import TabularMDP, ladder


def bernoulli(count: int, seed: int = 0, *, least: float = 0.0, most: float = 1.0) -> tuple[TabularMDP, torch.Tensor]:
    """States with one action that leads to a prize of 1 with a probability of their own, or to nothing; v of all."""
    p_S = numpy_stream(seed, "bernoulli").uniform(least, most, count)
    prob_SAK = torch.from_numpy(np.stack([p_S, 1 - p_S], -1)).unsqueeze(1)
    child_SAK = torch.tensor([count, count + 1]).expand(count, 1, 2)
    ends = Outcomes(
        torch.zeros(count + 2, 1, dtype=torch.float64),
        torch.cat([prob_SAK, torch.tensor([[[1.0, 0.0]]], dtype=torch.float64).expand(2, 1, 2)]),
        torch.full((count + 2, 1, 2), 0.9, dtype=torch.float64),
        torch.cat([child_SAK, torch.full((2, 1, 2), count + 1)]),
        count + 2,
    )
    v_S = torch.zeros(count + 2, dtype=torch.float64)
    v_S[count] = 1.0
    return TabularMDP(ends, torch.full((count + 2,), 1 / (count + 2), dtype=torch.float64)), v_S


def looked(mdp: TabularMDP, v_S: torch.Tensor, samples: int, *, known: bool = True, seed: int = 0) -> Lookahead:
    model = TabularModel(mdp)
    model.lowest_value, model.highest_value = (0.0, 1.0) if known else (-math.inf, math.inf)
    root_B = torch.arange(mdp.num_states - 2)
    return sampled(model, root_B, depth=0, v_leaf=lambda s: v_S[s], samples=samples, generator=stream(seed, "look"))


@pytest.mark.parametrize("chances", [(0.0, 1.0), (0.02, 0.1)])
@pytest.mark.parametrize("C", [2, 4, 8, 16])
def test_intervals_of_one_level_hold_the_truth_and_normal_ones_do_not(C, chances):
    mdp, v_S = bernoulli(2_000, least=chances[0], most=chances[1])
    truth_BA = backup(mdp.outcomes, v_S)[:-2]
    look = looked(mdp, v_S, C)
    low, high = look.interval(0.95)
    # 2,000 independent values: at 95 % fewer than 93.5 % are held with a probability of 0.002.
    assert float(((low <= truth_BA) & (truth_BA <= high)).double().mean()) > 0.935
    normal = 1.96 * look.stderr_BA
    if C < 16 or chances[1] < 1:
        assert float(((look.q_BA - truth_BA).abs() <= normal).double().mean()) < 0.9


@pytest.mark.parametrize("confidence", [0.5, 0.95])
def test_where_all_samples_agree_the_interval_comes_from_the_range_of_values(confidence):
    mdp, v_S = bernoulli(200)
    look = looked(mdp, v_S, 4)
    low, high = look.interval(confidence)
    share = 1 - (1 - confidence) ** (1 / 3)
    nothing, all_of_it = look.q_BA == 0, look.q_BA == 0.9
    assert bool(nothing.any() and all_of_it.any())
    assert bool((low[nothing] == 0).all())
    torch.testing.assert_close(high[nothing], torch.full_like(high[nothing], share))
    torch.testing.assert_close(low[all_of_it], torch.full_like(low[all_of_it], 0.9 * (1 - share)))
    torch.testing.assert_close(high[all_of_it], torch.full_like(high[all_of_it], 0.9 + share * 0.1))


def test_without_a_range_samples_that_agree_bound_nothing():
    mdp, v_S = bernoulli(200)
    look = looked(mdp, v_S, 4, known=False)
    low, high = look.interval()
    agree = look.stderr_BA == 0
    assert bool((low[agree] == -math.inf).all() and (high[agree] == math.inf).all())
    assert bool(low[~agree].isfinite().all() and high[~agree].isfinite().all())


def test_where_every_action_has_one_outcome_the_interval_is_a_point():
    model = TabularModel(ladder())
    assert model.is_certain
    assert not TabularModel(bernoulli(3)[0]).is_certain
    look = sampled(model, torch.arange(5), depth=2, v_leaf=lambda s: s.double(), samples=3, generator=stream(0))
    for bound in look.interval():
        torch.testing.assert_close(bound, look.q_BA)


def test_a_value_outside_the_range_widens_it():
    mdp, v_S = bernoulli(50, least=0.999, most=0.9999)
    low, high = looked(mdp, 10 * v_S, 2).interval()  # a critic that says 10 where 1 is the most
    torch.testing.assert_close(high, torch.full_like(high, 9.0))
    torch.testing.assert_close(low, torch.full_like(low, 9.0 * 0.05))
