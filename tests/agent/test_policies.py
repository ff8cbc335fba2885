"""Tabular policies."""

import numpy as np
import pytest
import torch

from pgts_torch.agent.policies import SimplexPolicy, SoftmaxPolicy
from pgts_torch.errors import PgtsError
from pgts_torch.options import Biased, Random, Simplex, Softmax, Uniform
from pgts_torch.seeding import stream

OPTIONS = {SoftmaxPolicy: Softmax, SimplexPolicy: Simplex}
KINDS = list(OPTIONS)


@pytest.mark.parametrize("kind", KINDS)
def test_initial_policies_are_those_documented(kind):
    np.testing.assert_allclose(kind(3, 4, OPTIONS[kind](init=Uniform())).table(), np.full((3, 4), 0.25))
    biased = kind(3, 4, OPTIONS[kind](init=Biased(action=1, probability=0.7))).table()
    np.testing.assert_allclose(biased, np.tile([0.1, 0.7, 0.1, 0.1], (3, 1)))
    drawn = kind(3, 4, OPTIONS[kind](init=Random()), seed=5).table()
    np.testing.assert_allclose(drawn.sum(-1), np.ones(3))
    assert torch.equal(drawn, kind(3, 4, OPTIONS[kind](init=Random()), seed=5).table())
    assert not torch.isclose(drawn, kind(3, 4, OPTIONS[kind](init=Random()), seed=6).table()).any()


def test_a_random_initialisation_is_uniform_on_the_simplex():
    # Uniform on the simplex of 3 actions: mean 1/3, variance 2/36 (Dirichlet(1, 1, 1)). Each of the 6 comparisons fails
    # by chance with probability below 1e-5 (4.5 standard errors, 40,000 rows).
    pi_SA = SimplexPolicy(40_000, 3, Simplex(init=Random())).table()
    assert ((pi_SA.mean(0) - 1 / 3).abs() < 4.5 * (2 / 36 / 40_000) ** 0.5).all()
    square_SA = (pi_SA - 1 / 3).square()
    assert ((square_SA.mean(0) - 2 / 36).abs() < 4.5 * square_SA.std(0) / 200).all()
    assert pi_SA.min() > 0


def test_a_softmax_policy_refuses_probability_0_and_a_simplex_policy_takes_it():
    always_left = Biased(action=0, probability=1)
    with pytest.raises(PgtsError, match=r"policy.init.probability is 1, which policy.type softmax cannot represent"):
        Softmax(init=always_left)
    policy = SimplexPolicy(5, 2, Simplex(init=always_left))
    assert torch.equal(policy.table(), torch.tensor([[1.0, 0.0]], dtype=torch.float64).repeat(5, 1))
    assert (policy.sample(torch.arange(5).repeat(1000), generator=stream(0, "test")) == 0).all()


@pytest.mark.parametrize(("action", "probability"), [(2, 0.5), (-1, 0.5), (0, 0.0), (0, 1.1), (0, float("nan"))])
def test_an_impossible_bias_is_refused(action, probability):
    with pytest.raises(PgtsError, match=r"action is|probability is"):
        SimplexPolicy(3, 2, Simplex(init=Biased(action=action, probability=probability)))


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_survive_the_round_trip_and_stay_apart(kind):
    policy, other = kind(4, 3, OPTIONS[kind](init=Random()), seed=1), kind(4, 3)
    before = policy.table()
    state = policy.state_dict()
    other.load_state_dict(state)
    assert torch.equal(other.table(), before)
    for tensor in state.values():
        tensor.fill_(1 / 3)
    assert torch.equal(policy.table(), before)
    assert torch.equal(other.table(), before)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(3, 3), (4, 2), (12,)])
def test_parameters_that_do_not_fit_are_refused(kind, shape):
    policy = kind(4, 3)
    (name,) = policy.state_dict()
    with pytest.raises(PgtsError, match=name):
        policy.load_state_dict({name: torch.zeros(shape)})
    with pytest.raises(PgtsError, match=name):
        policy.load_state_dict({})
    with pytest.raises(PgtsError, match=name):
        policy.load_state_dict({name: [[0.0] * 3] * 4})
    assert torch.equal(policy.table(), kind(4, 3).table())


@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_sampled_with_the_probabilities_of_the_policy(kind):
    # 4.5 standard errors for each of 12 cells: fails by chance with probability below 1e-4.
    policy = kind(4, 3, OPTIONS[kind](init=Random()), seed=2)
    n = 20_000
    action_N = policy.sample(torch.arange(4).repeat_interleave(n), generator=stream(0, "test"))
    share_SA = torch.nn.functional.one_hot(action_N, 3).double().view(4, n, 3).mean(1)
    pi_SA = policy.table()
    error_SA = (pi_SA * (1 - pi_SA) / n).sqrt()
    assert ((share_SA - pi_SA).abs() < 4.5 * error_SA).all()
    assert not ((share_SA - pi_SA.roll(1, 0)).abs() < 4.5 * error_SA).any()


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_given_generator_is_used(kind):
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    policy = kind(4, 3, OPTIONS[kind](init=Random()))
    first = policy.sample(torch.zeros(50, dtype=torch.int64), generator=stream(0, "test"))
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    torch.rand(1)
    assert torch.equal(first, policy.sample(torch.zeros(50, dtype=torch.int64), generator=stream(0, "test")))
    assert not torch.equal(first, policy.sample(torch.zeros(50, dtype=torch.int64), generator=stream(1, "test")))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "init", [Uniform(), Random(), Biased(action=0, probability=0.99), Biased(action=0, probability=0.3)]
)
def test_where_there_is_one_action_it_is_taken(kind, init):
    policy = kind(3, 1, OPTIONS[kind](init=init))
    assert torch.equal(policy.table(), torch.ones(3, 1, dtype=torch.float64))
    assert torch.equal(policy.sample(torch.arange(3), generator=stream(0, "test")), torch.zeros(3, dtype=torch.int64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sampled_actions_are_those_of_multinomial(dtype):
    pi_NA = torch.rand(500, 4, dtype=dtype, generator=stream(0, "rows"))
    pi_NA[::3, 1] = 0
    policy, state_N = SimplexPolicy(500, 4), torch.arange(500)
    policy.probs_SA = pi_NA / pi_NA.sum(-1, keepdim=True)
    drawn_N = policy.sample(state_N, generator=stream(1, "actions"))
    assert drawn_N.tolist() == torch.multinomial(policy.probs_SA, 1, generator=stream(1, "actions"))[:, 0].tolist()
    assert drawn_N.tolist() != policy.sample(state_N, generator=stream(2, "actions")).tolist()


def test_a_policy_whose_probabilities_are_not_finite_samples_no_action():
    policy = SoftmaxPolicy(3, 2)
    policy.logits_SA[1, 0] = torch.nan
    assert len(policy.sample(torch.tensor([0, 2]), generator=stream(0, "actions"))) == 2
    with pytest.raises(PgtsError, match=r"the policy's probabilities are \[nan, nan\]"):
        policy.sample(torch.arange(3), generator=stream(0, "actions"))
