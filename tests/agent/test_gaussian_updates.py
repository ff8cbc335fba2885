"""Updates of Gaussian policies against closed forms and autograd."""

import math

import pytest
import torch

from benchmarks.linear import LinearQuadratic
from pgts_torch.agent.gaussian import Normals
from pgts_torch.agent.gaussian_updates import GaussianGradientUpdate, GaussianPPOUpdate, MPOUpdate
from pgts_torch.agent.iteration import Batch
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.drawn_actions import Drawn
from pgts_torch.options import MPO, PPO, Gradient
from pgts_torch.seeding import stream
from tests.agent.continuous import GAMMA, drawing, gaussian, some_states

MODEL = LinearQuadratic.double_integrator(gamma=GAMMA)


def batch(policy, *, count: int = 6, states: int = 8, advantage=None, scale: float = 1.0) -> Batch:
    """Drawn actions with random advantages, or those of a function of the actions, that have the mean 0."""
    state_N = some_states(MODEL, states, seed=3)
    drawn = drawing(MODEL, policy, count).drawn(state_N)
    generator = torch.Generator().manual_seed(5)
    q_NK = torch.randn(states, count, generator=generator).double() if advantage is None else advantage(drawn)
    q_NK = scale * q_NK.double()
    advantage_NK = q_NK - (drawn.prob_NK.double() * q_NK).sum(-1, keepdim=True)
    weight_N = torch.rand(states, generator=generator).double() + 0.1
    return Batch(MODEL.states(state_N).float(), advantage_NK, weight_N, drawn=drawn)


def after(update, policy, given: Batch) -> list[torch.Tensor]:
    update(policy, given, generator=stream(0, "update"))
    return [weight.detach().clone() for weight in policy.network.weights]


def by_autograd(policy, given: Batch, objective) -> list[torch.Tensor]:
    """The gradient of an objective of the policy, by torch's distributions."""
    mean_NX, y_NX = policy.network(policy.network.encode(given.observation_N)).chunk(2, -1)
    least, first = policy.options.min_std, policy.options.std
    std_NX = least + (first - least) * torch.nn.functional.softplus(y_NX) / math.log(2)
    normal = torch.distributions.Independent(torch.distributions.Normal(mean_NX[:, None], std_NX[:, None]), 1)
    value = objective(normal.log_prob(given.drawn.action_NKX), normal.entropy()[:, 0])
    return list(torch.autograd.grad(value, policy.network.weights))


def stepped(update, given_policy=None, **options) -> tuple[list[torch.Tensor], list[torch.Tensor], object]:
    policy = gaussian(2, std=0.8)
    given = batch(policy)
    before = [weight.detach().clone() for weight in policy.network.weights]
    made = update(learning_rate=0.5, optimizer="sgd", max_grad_norm="never", **options)
    now = after(made, policy, given)
    steps = [(new - old) / 0.5 for new, old in zip(now, before, strict=True)]
    for weight, old in zip(policy.network.weights, before, strict=True):
        weight.data = old
    return steps, given, policy


def test_the_gradient_step_is_that_of_the_objective_over_drawn_actions():
    steps, given, policy = stepped(lambda **o: GaussianGradientUpdate(Gradient(entropy_coef=0.3, **o)))
    gain_NK = given.drawn.prob_NK * given.advantage_NA.float()

    def objective(log_NK, entropy_N):
        return given.weight_N.float() @ ((gain_NK * log_NK).sum(-1) + 0.3 * entropy_N)

    for step, truth in zip(steps, by_autograd(policy, given, objective), strict=True):
        assert torch.allclose(step, truth, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("normalize", [False, True])
def test_the_first_step_of_ppo_is_that_of_its_objective(normalize):
    options = {"entropy_coef": 0.2, "normalize_advantage": normalize, "num_epochs": 1}
    steps, given, policy = stepped(lambda **o: GaussianPPOUpdate(PPO(**options, **o)))
    weight_N, prob_NK, advantage_NK = given.weight_N.float(), given.drawn.prob_NK, given.advantage_NA.float()
    weight_N = weight_N / weight_N.mean()
    if normalize:
        advantage_NK = advantage_NK / (weight_N * (prob_NK * advantage_NK.abs()).sum(-1).square()).mean().sqrt()

    def objective(log_NK, entropy_N):
        ratio_NK = (log_NK - log_NK.detach()).exp()
        return (weight_N * ((prob_NK * ratio_NK * advantage_NK).sum(-1) + 0.2 * entropy_N)).mean()

    for step, truth in zip(steps, by_autograd(policy, given, objective), strict=True):
        assert torch.allclose(step, truth, rtol=1e-3, atol=1e-5)


def test_ppo_leaves_an_action_alone_whose_density_has_changed_enough():
    update, policy = GaussianPPOUpdate(PPO()), gaussian()
    given = batch(policy, count=1, advantage=lambda drawn: torch.ones(8, 1))
    old = policy.normals(given.observation_N)
    closer = Normals(given.drawn.action_NKX[:, 0], old.std_NX)
    aims = given.drawn.action_NKX, torch.ones(8, 1), torch.ones(8, 1), old.log_density(given.drawn.action_NKX)
    far = (given.drawn.action_NKX[:, 0] - old.mean_NX).abs().squeeze(1) > old.std_NX.squeeze(1)
    assert far.any()
    wider = Normals(closer.mean_NX + 0.1, old.std_NX)
    assert (update.loss(wider, old, *aims)[1][far] == 0).all()
    assert (update.loss(old, old, *aims)[1] != 0).all()


def test_steps_of_ppo_end_where_the_policy_has_moved_far_enough():
    def found(target_kl: float | None) -> tuple[int, list[torch.Tensor]]:
        update, policy = GaussianPPOUpdate(PPO(target_kl=target_kl, num_epochs=20, learning_rate=0.02)), gaussian()
        weights = after(update, policy, batch(policy))
        return update._optimiser.num_steps, weights

    (all_steps, free), (few, _), (bound, far) = (found(target_kl) for target_kl in (None, 0.01, 1e9))
    assert 1 <= few < all_steps == bound == 20
    assert all(map(torch.equal, free, far))


def test_with_quadratic_advantages_the_improved_policy_has_the_moments_of_the_normal_distribution_that_it_is():
    policy = gaussian()
    aim, curve, kl = 0.7, 0.9, 0.05
    quadratic = lambda drawn: -curve * (drawn.action_NKX[..., 0] - aim) ** 2  # noqa: E731
    given = batch(policy, count=4000, states=1, advantage=quadratic)
    old = policy.normals(given.observation_N)
    mean, std = float(old.mean_NX.double()), float(old.std_NX.double())

    def improved(eta: float) -> tuple[float, float, float]:
        """Mean, deviation and divergence of N(mean, std^2) exp(adv / eta), normalised."""
        precision = std**-2 + 2 * curve / eta
        there, ratio = (mean * std**-2 + 2 * curve * aim / eta) / precision, precision**-0.5 / std
        return there, ratio * std, 0.5 * (ratio**2 + ((there - mean) / std) ** 2 - 1) - math.log(ratio)

    low, high = 1e-3, 1e3
    for _ in range(80):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if improved(middle)[2] > kl else (low, middle)
    there, deviation, _ = improved(high)
    mean_NX, std_NX = MPOUpdate(MPO(kl=kl, kl_mean=9.0, kl_std=9.0)).aims(old, given, torch.ones(1))
    assert float(mean_NX) == pytest.approx(there, abs=2e-3)
    assert float(std_NX) == pytest.approx(deviation, abs=2e-3)
    bounded = MPOUpdate(MPO(kl=kl, kl_mean=1e-4, kl_std=1e-6)).aims(old, given, torch.ones(1))
    assert abs(float(bounded[0]) - mean) / std == pytest.approx(math.sqrt(2e-4), rel=1e-3)
    assert abs(math.log(float(bounded[1]) / std)) == pytest.approx(1e-3, rel=1e-2)


def ratios(given: Batch, **options) -> torch.Tensor:
    """std' / std of each row, with nothing that holds it."""
    old = gaussian().normals(given.observation_N)
    weight_N = (given.weight_N / given.weight_N.mean()).float()
    return MPOUpdate(MPO(kl_std=9.0, **options)).aims(old, given, weight_N)[1] / old.std_NX


def test_a_mean_that_moves_is_not_taken_for_spread():
    given = batch(gaussian(), count=2000, advantage=lambda drawn: drawn.action_NKX[..., 0])
    old = gaussian().normals(given.observation_N)
    moved_NX = (MPOUpdate(MPO(kl_mean=9.0)).aims(old, given, torch.ones(8))[0] - old.mean_NX) / old.std_NX
    assert float(moved_NX.min()) > 0.4  # around the old mean the spread would be larger by 1.08 and more
    assert torch.allclose(ratios(given), torch.ones(8, 1), atol=0.01)


@pytest.mark.parametrize("count", [4, 16])
def test_advantages_that_are_noise_make_the_policy_neither_wider_nor_narrower(count):
    given = batch(gaussian(), count=count, states=4000)
    moved_NX = ratios(given, kl=0.5).log().clamp(-0.1, 0.1)
    # The standard error is 0.0016.
    assert float(moved_NX.mean()) == pytest.approx(0, abs=0.007)
    # Without the correction the policy narrows.
    drawn, z_NKX = given.drawn, gaussian().normals(given.observation_N).standardised(given.drawn.action_NKX)
    q_NK = MPOUpdate(MPO(kl=0.5)).improved(given, (given.weight_N / given.weight_N.mean()).float())

    def spread(weight_NK):
        mean_NX = (weight_NK[..., None] * z_NKX).sum(1)
        return (weight_NK[..., None] * z_NKX.square()).sum(1) - mean_NX.square()

    uncorrected_NX = (spread(q_NK) / spread(drawn.prob_NK)).log() / 2
    assert float(uncorrected_NX.clamp(-0.1, 0.1).mean()) < -0.02


def test_a_policy_whose_mean_keeps_moving_stays_as_wide_as_it_was():
    policy = gaussian(spread=0.01)
    start = batch(policy).observation_N
    first = policy.normals(start)
    for _ in range(25):
        given = batch(policy, count=16, advantage=lambda drawn: drawn.action_NKX[..., 0])
        MPOUpdate(MPO(learning_rate=0.02, num_epochs=5))(policy, given, generator=stream(0, "update"))
    now = policy.normals(start)
    assert float((now.mean_NX - first.mean_NX).mean()) > 2
    assert float((now.std_NX / first.std_NX).mean()) < 1.5  # around the old mean up to 1.1^25 = 10.8


def test_the_divergence_of_the_improved_policy_is_the_one_that_was_asked_for():
    given = batch(gaussian(), states=30)
    weight_N = given.weight_N / given.weight_N.mean()
    prob_NK = given.drawn.prob_NK
    for kl in (0.01, 0.2):
        q_NK = MPOUpdate(MPO(kl=kl)).improved(given, weight_N.float())
        divergence_N = (q_NK * (q_NK / prob_NK).log()).sum(-1)
        assert float((weight_N * divergence_N).mean()) == pytest.approx(kl, rel=1e-3)


@pytest.mark.parametrize("power", [-20, 20])
def test_the_scale_of_rewards_changes_no_bit_of_the_regression(power):
    one, other = (
        after(MPOUpdate(), policy, batch(policy, scale=scale))
        for policy, scale in ((gaussian(), 1.0), (gaussian(), 2.0**power))
    )
    assert all(map(torch.equal, one, other))


def test_where_all_advantages_are_0_the_regression_aims_at_the_policy_itself():
    policy = gaussian()
    given = batch(policy, advantage=lambda drawn: torch.zeros(8, 6))
    old = policy.normals(given.observation_N)
    aims = MPOUpdate().aims(old, given, torch.ones(8))
    assert all(map(torch.equal, aims, old))
    before = [weight.detach().clone() for weight in policy.network.weights]
    for new, weight in zip(after(MPOUpdate(), policy, given), before, strict=True):
        assert torch.allclose(new, weight, atol=1e-6)


def test_the_regression_takes_a_policy_to_the_best_action():
    policy, best = gaussian(spread=0.01), 0.5
    for _ in range(30):
        given = batch(policy, count=16, advantage=lambda drawn: -(drawn.action_NKX[..., 0] - best).abs())
        MPOUpdate(MPO(learning_rate=0.02, num_epochs=5))(policy, given, generator=stream(0, "update"))
    now = policy.normals(given.observation_N)
    assert float((now.mean_NX - best).abs().max()) < 0.1
    assert float(now.std_NX.mean()) < 0.5


def test_what_is_not_finite_changes_nothing_and_densities_have_no_probabilities():
    policy = gaussian()
    given = batch(policy, advantage=lambda drawn: torch.full((8, 6), math.inf))
    before = [weight.detach().clone() for weight in policy.network.weights]
    with pytest.raises(NotFinite):
        MPOUpdate()(policy, given, generator=stream(0, "update"))
    assert all(map(torch.equal, before, policy.network.weights))
    with pytest.raises(PgtsError, match="density"):
        policy.probs(given.observation_N)


def test_one_drawn_action_with_probability_1_is_a_batch_of_sampled_advantages():
    policy = gaussian()
    given = batch(policy, count=1, advantage=lambda drawn: torch.zeros(8, 1))
    taken = Drawn(given.drawn.action_NKX, torch.ones(8, 1))
    assert torch.equal(given.drawn.prob_NK, taken.prob_NK)
