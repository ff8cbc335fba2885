"""Clipped MPO: its target, and that only the shape of advantages counts, never their scale."""

import pytest
import torch
from gymnasium import spaces

from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.target_updates import CMPOUpdate, advantage_scale
from pgts_torch.options import CMPO, MLP
from pgts_torch.seeding import stream


def policy(num_states: int = 4, num_actions: int = 3) -> NetworkPolicy:
    made = NetworkPolicy(spaces.Discrete(num_states), num_actions, MLP(hidden=()))
    generator = stream(0, "logits")
    weight_AS = torch.randn(num_actions, num_states, generator=generator)
    made.load_state_dict({"head.weight": weight_AS, "head.bias": torch.zeros(num_actions)})
    return made


def question(num_states: int = 4, num_actions: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    generator = stream(0, "question")
    advantage_NA = torch.randn(num_states, num_actions, generator=generator, dtype=torch.float64)
    return advantage_NA, torch.rand(num_states, generator=generator, dtype=torch.float64) + 0.1


def after(advantage_NA: torch.Tensor, weight_N: torch.Tensor, noise: float = 0.0, **options) -> torch.Tensor:
    """The probabilities after one update."""
    made, states = policy(), torch.arange(4)
    CMPOUpdate(CMPO(**options))(made, Batch(states, advantage_NA, weight_N, noise), generator=stream(0, "update"))
    return made.probs(states)


def test_the_scale_is_the_usual_difference_between_actions():
    advantage_NA, weight_N = question()
    rows = zip(advantage_NA.tolist(), weight_N.tolist(), strict=True)
    by_hand = sum(w * sum(abs(x - sum(row) / 3) for x in row) / 3 for row, w in rows) / float(weight_N.sum())
    assert float(advantage_scale(advantage_NA, weight_N)) == pytest.approx(by_hand, rel=1e-12)


def test_a_network_that_can_be_any_policy_ends_at_the_clipped_target():
    advantage_NA, weight_N = question()
    scale = advantage_scale(advantage_NA, weight_N)
    exponent_NA = (advantage_NA / scale).clamp(-0.5, 0.5)
    assert (exponent_NA.abs() == 0.5).any()
    assert (exponent_NA.abs() < 0.5).any()
    target_NA = (policy().probs(torch.arange(4)).log() + exponent_NA).softmax(-1)
    options = {"learning_rate": 0.05, "num_epochs": 600, "max_grad_norm": "never"}
    found_NA = after(advantage_NA, weight_N, clip=0.5, temperature=1.0, **options)
    assert (found_NA - target_NA).abs().max() < 1e-3
    unclipped_NA = after(advantage_NA, weight_N, clip=10.0, temperature=1.0, **options)
    assert (unclipped_NA - target_NA).abs().max() > 1e-2


@pytest.mark.parametrize("power", [-900, -60, -1, 1, 60, 900])
def test_a_factor_of_a_power_of_two_leaves_every_bit(power):
    advantage_NA, weight_N = question()
    assert torch.equal(after(advantage_NA * 2.0**power, weight_N), after(advantage_NA, weight_N))
    assert not torch.equal(after(advantage_NA * 3, weight_N * torch.arange(4)), after(advantage_NA, weight_N))


def test_advantages_below_the_noise_make_small_steps_and_equal_ones_none():
    advantage_NA, weight_N = question()
    before_NA = policy().probs(torch.arange(4))
    assert torch.equal(after(torch.zeros(4, 3, dtype=torch.float64), weight_N), before_NA)
    options = {"learning_rate": 0.01, "num_epochs": 300}
    moves = [
        float((after(advantage_NA, weight_N, noise, **options) - before_NA).abs().max()) for noise in (0.0, 100.0, 1e6)
    ]
    assert moves[0] > 10 * moves[1] > 10 * moves[2]
