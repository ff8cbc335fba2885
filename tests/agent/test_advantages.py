"""Advantages of a lookahead: none on the average of the policy, whatever constant or scale the rewards have."""

import math

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.seeding import stream
from pgts_torch.tabular import random_mdp
from pgts_torch.tabular.ascent import centred
from tests.agent.helpers import vector_env
from tests.support import rewarded

UPDATES = {"softmax": "mirror", "simplex": "projected", "mlp": "ppo"}


def values(seed: int = 0):
    """Values and a policy of five states and three actions."""
    generator = stream(seed, "centred")
    q_NA = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    return q_NA, torch.rand(5, 3, generator=generator, dtype=torch.float64).softmax(-1)


def test_the_policy_has_no_advantage_over_itself():
    q_NA, pi_NA = values()
    advantage_NA = centred(q_NA, pi_NA)
    assert float((pi_NA * advantage_NA).sum(-1).abs().max()) < 1e-15
    torch.testing.assert_close(advantage_NA, q_NA - (pi_NA * q_NA).sum(-1, keepdim=True))


def test_actions_of_equal_values_have_no_advantage_at_all():
    _, pi_NA = values()
    q_NA = torch.tensor([0.1, 1e9 / 3, -7.3, 1e-300, 0.0], dtype=torch.float64)[:, None].expand(5, 3)
    assert not centred(q_NA, pi_NA).any()
    assert (q_NA - (pi_NA * q_NA).sum(-1, keepdim=True)).any()  # what a subtraction alone would leave


@pytest.mark.parametrize("power", [-40, -3, 5, 60])
def test_a_power_of_two_scales_advantages_to_the_last_bit(power):
    q_NA, pi_NA = values(1)
    assert torch.equal(centred(math.ldexp(1.0, power) * q_NA, pi_NA), math.ldexp(1.0, power) * centred(q_NA, pi_NA))


def test_what_rounding_explains_is_no_advantage():
    q_NA, pi_NA = values()
    advantage_NA = centred(q_NA, pi_NA)
    bound = float(advantage_NA.abs().median())
    kept_NA = centred(q_NA, pi_NA, rounding=bound)
    assert torch.equal(kept_NA, advantage_NA.where(advantage_NA.abs() > bound, 0.0))
    assert 0 < int((kept_NA == 0).sum()) < kept_NA.numel()


def test_an_action_that_is_not_allowed_does_not_spoil_the_others():
    q_NA = torch.tensor([[1.0, -math.inf, 3.0]], dtype=torch.float64)
    pi_NA = torch.tensor([[0.5, 0.0, 0.5]], dtype=torch.float64)
    assert centred(q_NA, pi_NA).tolist() == [[-1.0, -math.inf, 1.0]]


@pytest.mark.parametrize("depth", [0, 1, 5])
def test_lookahead_advantages_are_centred_at_every_depth(depth):
    iteration = PGTS("pgts/Grid-v0", depth=depth, num_envs=4, seed=3).iterate()
    assert float((iteration.pi_NA * iteration.advantage_NA).sum(-1).abs().max()) < 1e-12
    assert float(iteration.advantage_NA.abs().max()) > 1e-3


@pytest.mark.parametrize("policy", UPDATES)
@pytest.mark.parametrize("depth", [0, 3])
def test_a_constant_added_to_all_rewards_of_a_continuing_task_moves_no_policy(policy, depth):
    mdp = random_mdp(6, 3, seed=2)

    def trained(constant: float) -> torch.Tensor:
        env = vector_env(rewarded(mdp, constant=constant), 4)
        options = {"policy": policy, "critic": "exact", "update": UPDATES[policy]}
        model = PGTS(env, depth=depth, horizon={"type": "fixed", "length": 10}, **options)
        for _ in range(4):
            model.iterate()
        return model.policy_table()

    torch.testing.assert_close(trained(10.0), trained(0.0), atol=1e-4, rtol=0)
    assert (trained(0.0) - 1 / 3).abs().max() > 0.01
