"""How network policies move: as tables do where a network is one, and as A2C and PPO where actions were sampled."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from pgts_torch.agent import saving
from pgts_torch.agent.advantages import gae, score_function
from pgts_torch.agent.gradients import Forward, through_log_softmax
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.neural_updates import GradientUpdate, NetworkUpdate, PPOUpdate
from pgts_torch.agent.optimisers import Optimiser
from pgts_torch.agent.policies import SoftmaxPolicy
from pgts_torch.agent.target_updates import CMPOUpdate, NetworkMirrorUpdate
from pgts_torch.agent.updates import MirrorUpdate, SoftmaxUpdate
from pgts_torch.errors import PgtsError
from pgts_torch.options import (
    CMPO,
    CNN,
    MLP,
    PPO,
    FixedHorizon,
    Gradient,
    Mirror,
    NetworkValues,
    Part,
    Random,
    Softmax,
    SoftmaxGradient,
)
from pgts_torch.seeding import stream
from pgts_torch.tabular import exact, random_mdp
from tests.agent.helpers import made_in, vector_env


def maker(kind: type[NetworkUpdate], options: type[Part], **given: Any) -> Callable[..., NetworkUpdate]:
    return lambda **others: kind(options(**given, **others))


UPDATES = [
    maker(GradientUpdate, Gradient),
    maker(PPOUpdate, PPO),
    maker(NetworkMirrorUpdate, Mirror),
    maker(CMPOUpdate, CMPO),
]
VECTORS = spaces.Box(-math.inf, math.inf, (3,))


def tables(seed: int = 3) -> tuple[SoftmaxPolicy, NetworkPolicy]:
    """The same policy over 6 states and 4 actions, as a table and as a network whose weights are its logits."""
    table = SoftmaxPolicy(6, 4, Softmax(init=Random()), seed=seed)
    network = NetworkPolicy(spaces.Discrete(6), 4, MLP(hidden=()))
    network.load_state_dict({"head.weight": table.logits_SA.T.float(), "head.bias": torch.zeros(4)})
    return table, network


def question(count: int = 6, actions: int = 4, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Advantages and weights of some states."""
    generator = stream(seed, "question")
    advantage_NA = torch.randn(count, actions, generator=generator, dtype=torch.float64)
    return advantage_NA, torch.rand(count, generator=generator, dtype=torch.float64) * 3


def sampled(policy: NetworkPolicy, count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Observations, the actions taken there, and what they were worth."""
    generator = stream(seed, "sampled")
    observation_ND = torch.randn(count, 3, generator=generator)
    action_N = policy.sample(observation_ND, generator=generator)
    return observation_ND, action_N, torch.randn(count, generator=generator, dtype=torch.float64)


def moved(policy: NetworkPolicy, update: NetworkUpdate, *args: Tensor, seed: int = 0) -> dict[str, Tensor]:
    """By how much each parameter moves."""
    before = policy.state_dict()
    update(policy, Batch(*args), generator=stream(seed, "update"))
    return {name: value - before[name] for name, value in policy.state_dict().items()}


def log_probs(policy: NetworkPolicy, observation_N: Tensor) -> Tensor:
    return policy.network(policy.network.encode(observation_N)).log_softmax(-1)


def test_one_gradient_step_of_a_one_hot_network_is_the_tabular_softmax_update():
    (table, network), (q_NA, weight_N) = tables(), question(3)
    states, generator = torch.tensor([5, 0, 3]), stream(0, "update")
    v_N1 = (table.probs(states) * q_NA).sum(-1, keepdim=True)
    step = moved(
        network,
        GradientUpdate(Gradient(learning_rate=0.3, optimizer="sgd", max_grad_norm="never")),
        states,
        q_NA,
        weight_N,
    )
    before_SA = table.logits_SA.clone()
    SoftmaxUpdate(SoftmaxGradient(step_size=0.3))(table, Batch(states, q_NA - v_N1, weight_N), generator=generator)
    torch.testing.assert_close(step["head.weight"].T, (table.logits_SA - before_SA).float(), atol=1e-6, rtol=1e-4)
    assert step["head.weight"].abs().max() > 0.01
    assert not step["head.weight"].T[[1, 2, 4]].any()


def test_many_mirror_steps_of_a_one_hot_network_approach_the_tabular_mirror_update():
    (table, network), (q_NA, weight_N) = tables(), question()
    states, generator = torch.arange(6), stream(0, "update")
    before_SA = table.table()
    in_reward_units = MirrorUpdate(Mirror(step_size=1 / 0.7, normalize="none", floor="never"))
    in_reward_units(table, Batch(states, q_NA, torch.ones(6, dtype=torch.float64)), generator=generator)
    update = NetworkMirrorUpdate(Mirror(temperature=0.7, learning_rate=0.05, num_epochs=600, max_grad_norm="never"))
    # The weights say which states matter when a network cannot have them all; this one can.
    losses = update(network, Batch(states, q_NA, weight_N), generator=generator)
    assert losses["policy"] < 1e-6
    torch.testing.assert_close(network.probs(states).double(), table.table(), atol=1e-3, rtol=0)
    assert (table.table() - before_SA).abs().max() > 0.1


def test_with_sampled_advantages_the_gradient_update_steps_along_the_gradient_of_a2c():
    policy = NetworkPolicy(VECTORS, 4, seed=1)
    observation_ND, action_N, advantage_N = sampled(policy, 40)
    loss = -(log_probs(policy, observation_ND).gather(-1, action_N[:, None]).squeeze(-1) * advantage_N).mean()
    gradients = torch.autograd.grad(loss, list(policy.network.parameters()))
    advantage_NA = score_function(action_N, advantage_N, policy.probs(observation_ND))
    weight_N = torch.full((40,), 1 / 40, dtype=torch.float64)
    update = GradientUpdate(Gradient(learning_rate=0.5, optimizer="sgd", max_grad_norm="never"))
    steps = moved(policy, update, observation_ND, advantage_NA, weight_N)
    for step, gradient in zip(steps.values(), gradients, strict=True):
        torch.testing.assert_close(step, -0.5 * gradient, atol=1e-6, rtol=1e-3)
    assert max(float(step.abs().max()) for step in steps.values()) > 0.01


def test_with_sampled_advantages_the_clipped_objective_is_that_of_ppo(monkeypatch):
    # One state; the actions 0, 1, 0, 1 were taken with probability 1/2 each, and now have 0.7 and 0.3: rho is 1.4, 0.6.
    # min(rho A, clip(rho, 0.8, 1.2) A) by hand: 1.2 * 1 (clipped), 0.6 * 2, 1.4 * -1, 0.8 * -3 (clipped).
    policy = NetworkPolicy(spaces.Discrete(1), 2, MLP(hidden=()))
    policy.load_state_dict({"head.weight": torch.zeros(2, 1), "head.bias": torch.zeros(2)})
    states, action_N = torch.zeros(4, dtype=torch.int64), torch.tensor([0, 1, 0, 1])
    advantage_N = torch.tensor([1.0, 2.0, -1.0, -3.0], dtype=torch.float64)
    advantage_NA = score_function(action_N, advantage_N, policy.probs(states))
    seen = []

    def step(optimiser, parameters, gradients, loss, name):
        """The first step takes the policy to 0.7 and 0.3; the second is looked at."""
        seen.append((float(loss), gradients[1]))
        policy.network.head.bias.data.copy_(torch.tensor([0.7, 0.3]).log())
        return 0.0

    monkeypatch.setattr(Optimiser, "step", step)
    update = PPOUpdate(PPO(num_epochs=2, minibatch_size=4, clip_range=0.2, normalize_advantage=False))
    losses = update(policy, Batch(states, advantage_NA, torch.full((4,), 0.25)), generator=stream(0, "update"))
    assert seen[0][0] == pytest.approx(-(1 + 2 - 1 - 3) / 4)
    assert seen[1][0] == pytest.approx(-(1.2 + 1.2 - 1.4 - 2.4) / 4)
    # Only unclipped terms push: d(rho A) = rho A (onehot - pi), for A = 2 at action 1 and A = -1 at action 0.
    push = 1.2 * torch.tensor([-0.7, 0.7]) - 1.4 * torch.tensor([0.3, -0.3])
    torch.testing.assert_close(seen[1][1], -push / 4)
    assert losses["num_steps"] == 2
    assert losses["clip_fraction"] == pytest.approx(1.0)
    assert losses["policy"] == pytest.approx((seen[0][0] + seen[1][0]) / 2)


def test_the_clip_fraction_is_the_old_probability_of_actions_whose_ratio_is_out_of_range(
    monkeypatch,
):
    # Two states of weight 1 and 3, three actions of old probability 0.5, 0.25, 0.25. By hand: in the first state rho
    # is 0.7, 1.3, 1.3, all out of the range 0.8 to 1.2; in the second 0.8995, 1, 1.201: the last one, 0.25.
    policy = NetworkPolicy(spaces.Discrete(2), 3, MLP(hidden=()))
    old_NA = torch.tensor([[0.5, 0.25, 0.25]]).repeat(2, 1)
    new_NA = old_NA * torch.tensor([[0.7, 1.3, 1.3], [0.8995, 1.0, 1.201]])
    policy.load_state_dict({"head.weight": old_NA.log().T, "head.bias": torch.zeros(3)})

    def step(optimiser, parameters, gradients, loss, name):
        policy.network.head.weight.data.copy_(new_NA.log().T)
        return 0.0

    monkeypatch.setattr(Optimiser, "step", step)
    update = PPOUpdate(PPO(num_epochs=1, minibatch_size=2, clip_range=0.2))
    advantage_NA = torch.tensor([[1.0, -1.0, -1.0], [1.0, 0.0, -2.0]], dtype=torch.float64)
    weight_N = torch.tensor([1.0, 3.0], dtype=torch.float64)
    losses = update(policy, Batch(torch.arange(2), advantage_NA, weight_N), generator=stream(0, "update"))
    assert losses["clip_fraction"] == pytest.approx((1 * 1.0 + 3 * 0.25) / 4)


@pytest.mark.parametrize("entropy_coef", [0.0, 0.3])
def test_the_gradient_of_the_clipped_objective_is_that_of_autograd(entropy_coef):
    generator = stream(0, "objective")
    logits_NA, old_NA, advantage_NA = (torch.randn(50, 4, generator=generator) for _ in range(3))
    old_NA, weight_N = (logits_NA + 0.3 * old_NA).log_softmax(-1), torch.rand(50, generator=generator)
    logits_NA.requires_grad_()
    log_NA = logits_NA.log_softmax(-1)
    ratio_NA = (log_NA - old_NA).exp()
    gain_NA = torch.minimum(ratio_NA * advantage_NA, ratio_NA.clamp(0.8, 1.2) * advantage_NA)
    objective_N = (old_NA.exp() * gain_NA).sum(-1) - entropy_coef * (log_NA.exp() * log_NA).sum(-1)
    expected_NA = torch.autograd.grad(-(weight_N * objective_N).mean(), logits_NA, retain_graph=True)[0]
    update = PPOUpdate(PPO(clip_range=0.2, entropy_coef=entropy_coef))
    down_NA, (loss,) = update.objective(log_NA.detach(), (old_NA, advantage_NA, weight_N), len(weight_N))
    expected = -(weight_N * (old_NA.exp() * gain_NA).sum(-1)).mean()
    torch.testing.assert_close(loss, expected.detach())
    down_NA = torch.autograd.grad(log_NA, logits_NA, down_NA)[0]
    torch.testing.assert_close(down_NA, expected_NA, atol=1e-6, rtol=1e-4)
    assert 0.1 < (gain_NA != ratio_NA * advantage_NA).float().mean() < 0.6


def test_the_first_step_of_ppo_follows_the_policy_gradient():
    policy, same = (NetworkPolicy(VECTORS, 4, seed=1) for _ in range(2))
    observation_ND, _, _ = sampled(policy, 40)
    advantage_NA, weight_N = question(40)
    options = {"learning_rate": 0.1, "optimizer": "sgd", "max_grad_norm": "never", "entropy_coef": 0.3}
    ppo = PPOUpdate(PPO(num_epochs=1, minibatch_size=40, normalize_advantage=False, **options))
    steps = moved(policy, ppo, observation_ND, advantage_NA, weight_N)
    expected = moved(same, GradientUpdate(Gradient(**options)), observation_ND, advantage_NA, weight_N / weight_N.sum())
    for name, step in steps.items():
        torch.testing.assert_close(step, expected[name], atol=1e-6, rtol=1e-3)


def test_ppo_takes_as_many_steps_as_its_minibatches_and_stops_when_the_policy_has_moved_far_enough():
    counts, divergences = [], []
    for target_kl in (None, 0.02):
        policy = NetworkPolicy(VECTORS, 4, seed=1)
        observation_ND, _, _ = sampled(policy, 70)
        update = PPOUpdate(PPO(learning_rate=0.01, num_epochs=4, minibatch_size=32, target_kl=target_kl))
        losses = update(policy, Batch(observation_ND, *question(70)), generator=stream(0, "update"))
        counts.append(losses["num_steps"])
        divergences.append(losses["kl"])
    assert counts[0] == 4 * 3
    assert 1 <= counts[1] < counts[0]
    assert divergences[1] == pytest.approx(0.02, rel=0.5)


def test_normalised_advantages_move_a_policy_alike_whatever_the_unit_of_reward():
    steps = []
    for unit in (1.0, 1e3):
        policy = NetworkPolicy(VECTORS, 4, seed=1)
        observation_ND, _, _ = sampled(policy, 40)
        advantage_NA, weight_N = question(40)
        update = PPOUpdate(PPO(optimizer="sgd", max_grad_norm="never", learning_rate=0.1))
        steps.append(moved(policy, update, observation_ND, unit * advantage_NA, weight_N))
    for name, step in steps[0].items():
        torch.testing.assert_close(step, steps[1][name], atol=1e-5, rtol=1e-3)
    assert steps[0]["head.bias"].abs().max() > 0.01


@pytest.mark.parametrize("update", [UPDATES[0], maker(PPOUpdate, PPO, num_epochs=1)])
def test_an_entropy_bonus_alone_makes_a_policy_uniform(update):
    _, policy = tables()
    states, nothing = torch.arange(6), torch.zeros(6, 4, dtype=torch.float64)
    bonus = update(learning_rate=0.1, entropy_coef=0.1)
    for _ in range(150):
        losses = bonus(policy, Batch(states, nothing, torch.ones(6)), generator=stream(0, "update"))
    assert losses["entropy"] == pytest.approx(math.log(4), abs=1e-3)
    before = policy.state_dict()
    update(learning_rate=0.1)(policy, Batch(states, nothing, torch.ones(6)), generator=stream(0, "update"))
    torch.testing.assert_close(policy.state_dict(), before, atol=1e-6, rtol=0)


@pytest.mark.parametrize("update", UPDATES)
def test_an_update_moves_toward_the_better_action(update):
    policy = NetworkPolicy(VECTORS, 3, seed=1)
    observation_ND = torch.randn(1, 3, generator=stream(0, "x"))
    before_NA = policy.probs(observation_ND)
    advantage_NA = torch.tensor([[-0.5, 1.0, -0.5]], dtype=torch.float64)
    losses = update()(policy, Batch(observation_ND, advantage_NA, torch.ones(1)), generator=stream(0, "update"))
    assert policy.probs(observation_ND)[0, 1] > before_NA[0, 1]
    assert losses["kl"] > 0
    assert all(isinstance(value, float | int) for value in losses.values())


@pytest.mark.parametrize("update", UPDATES)
def test_the_same_seed_gives_the_same_bits_and_another_order_others(update):
    def trained(seed: int) -> dict[str, Tensor]:
        policy, each = NetworkPolicy(VECTORS, 4, seed=1), update(learning_rate=0.01)
        for k in range(3):
            observation_ND, _, _ = sampled(policy, 100, seed=k)
            each(policy, Batch(observation_ND, *question(100, seed=k)), generator=stream(seed, "update"))
        return policy.state_dict()

    first, second, other = trained(0), trained(0), trained(1)
    assert all(torch.equal(value, second[name]) for name, value in first.items())
    assert (update is UPDATES[0]) == all(torch.equal(value, other[name]) for name, value in first.items())


@pytest.mark.parametrize("update", UPDATES)
def test_a_saved_update_goes_on_as_the_first_would_have(update, tmp_path):
    policy, resumed = (NetworkPolicy(VECTORS, 4, seed=1) for _ in range(2))
    observation_ND, _, _ = sampled(policy, 50)
    first, second, forgetful = update(), update(), update()
    second.load_state_dict(first.state_dict())
    first(policy, Batch(observation_ND, *question(50)), generator=stream(0, "update"))
    saving.write(tmp_path / "state", {"policy": policy.state_dict(), "update": first.state_dict()})
    state = saving.read(tmp_path / "state")
    second.load_state_dict(state["update"])
    steps = []
    for each in (second, forgetful):
        resumed.load_state_dict(state["policy"])
        steps.append(moved(resumed, each, observation_ND, *question(50, seed=1), seed=1))
    expected = moved(policy, first, observation_ND, *question(50, seed=1), seed=1)
    assert all(torch.equal(steps[0][name], value) for name, value in expected.items())
    assert not torch.equal(steps[1]["head.weight"], expected["head.weight"])


def test_a_state_that_does_not_fit_an_optimiser_is_refused():
    policy, update = NetworkPolicy(VECTORS, 4), GradientUpdate()
    observation_ND, _, _ = sampled(policy, 5)
    update(policy, Batch(observation_ND, *question(5)), generator=stream(0, "update"))
    state = update.state_dict()
    for wrong in [{"first_D": state["first_D"]}, state | {"num_steps": 0}, state | {"second_D": torch.zeros(3)}]:
        with pytest.raises(PgtsError, match=r"cannot load|second_D is torch.float32 of shape \(3,\)"):
            update.load_state_dict(wrong)
    with pytest.raises(PgtsError, match="sgd cannot load"):
        GradientUpdate(Gradient(optimizer="sgd")).load_state_dict(state)
    update.load_state_dict({"num_steps": 1, "first_D": torch.zeros(3), "second_D": torch.zeros(3)})
    with pytest.raises(PgtsError, match="has moments of 3 parameters"):
        update(policy, Batch(observation_ND, *question(5)), generator=stream(0, "update"))


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_number_that_is_not_finite_changes_nothing_and_is_named(update, value):
    policy = NetworkPolicy(VECTORS, 4)
    observation_ND, _, _ = sampled(policy, 5)
    advantage_NA, weight_N = question(5)
    before, generator = policy.state_dict(), stream(0, "update")
    wrong_NA, wrong_N, wrong_ND = advantage_NA.clone(), weight_N.clone(), observation_ND.clone()
    wrong_NA[3, 1] = wrong_N[2] = wrong_ND[1, 1] = value
    with pytest.raises(PgtsError, match=rf"advantage_NA\[3, 1\] is {value}"):
        update()(policy, Batch(observation_ND, wrong_NA, weight_N), generator=generator)
    with pytest.raises(PgtsError, match=rf"weight_N\[2\] is {value}"):
        update()(policy, Batch(observation_ND, advantage_NA, wrong_N), generator=generator)
    with pytest.raises(PgtsError, match="one must be positive"):
        update()(policy, Batch(observation_ND, advantage_NA, 0 * weight_N), generator=generator)
    if math.isnan(value):
        with pytest.raises(PgtsError, match="the policy loss is nan"):
            update()(policy, Batch(wrong_ND, advantage_NA, weight_N), generator=generator)
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


@pytest.mark.parametrize("entropy_coef", [0.0, 0.3])
def test_a_policy_gradient_is_that_of_autograd(entropy_coef):
    generator, options = stream(1, "step"), MLP(hidden=(7,))
    policy, same = (NetworkPolicy(spaces.Box(-9, 9, (4,)), 3, options) for _ in range(2))
    observation_ND = torch.randn(20, 4, generator=generator)
    advantage_NA = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    weight_N = torch.rand(20, generator=generator, dtype=torch.float64)
    given = Gradient(learning_rate=0.5, optimizer="sgd", max_grad_norm="never", entropy_coef=entropy_coef)
    before = [weight.detach().clone() for weight in same.network.weights]
    GradientUpdate(given)(policy, Batch(observation_ND, advantage_NA, weight_N), generator=generator)
    pi_NA = same.network(observation_ND).softmax(-1)
    gain_N = (pi_NA * (advantage_NA - entropy_coef * pi_NA.log())).sum(-1)
    pulls = torch.autograd.grad((weight_N * gain_N).sum(), same.network.weights)
    for moved, start, pull in zip(policy.network.weights, before, pulls, strict=True):
        torch.testing.assert_close(moved, start + 0.5 * pull)
        assert not torch.allclose(moved, start, atol=1e-4)


@pytest.mark.parametrize(
    "options", [MLP(hidden=()), MLP(), MLP(hidden=(7, 5), activation="relu"), CNN(), MLP(layer_norm=True)]
)
def test_gradients_that_are_written_out_have_the_bits_of_autograd(options):
    shape = (7, 7, 3) if isinstance(options, CNN) else (4,)
    policy = NetworkPolicy(spaces.Box(-9, 9, shape), 3, options)
    generator = stream(0, "gradients")
    network, input_N = policy.network, policy.network.encode(torch.randn((40, *shape), generator=generator))
    down_NA = torch.randn((40, 3), generator=generator)
    made, logits_NA = Forward(network, input_N), network(input_N)
    log_NA = logits_NA.log_softmax(-1)
    expected = torch.autograd.grad(log_NA, network.weights, down_NA)
    found = made.gradients(through_log_softmax(made.output_ND.log_softmax(-1), down_NA))
    assert torch.equal(made.output_ND, logits_NA)
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    assert [piece.shape for piece in found] == [weight.shape for weight in network.weights]
    assert not torch.equal(Forward(network, input_N).gradients(down_NA)[0], expected[0])


def test_statistics_of_observations_change_after_the_steps_but_for_the_first_batch():
    policy = NetworkPolicy(VECTORS, 4, MLP(normalize=True))
    observation_ND, _, _ = sampled(policy, 50)
    encoder, update = policy.network.trunk.encoder, GradientUpdate(Gradient(learning_rate=1e-12))
    for k, (count, divergence) in enumerate([(50, False), (100, True)]):
        losses = update(policy, Batch(observation_ND * 10**k, *question(50)), generator=stream(0, "update"))
        assert float(encoder.norm.count) == count
        assert losses["kl"] == pytest.approx(0, abs=1e-6), divergence


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    "update", [GradientUpdate(Gradient(learning_rate=0.05)), PPOUpdate(PPO(learning_rate=0.01, num_epochs=4))]
)
def test_a_policy_and_a_critic_learn_from_sampled_actions_alone(update):
    mdp = random_mdp(6, 2, gamma=0.7, start=None)
    policy = NetworkPolicy(spaces.Discrete(6), 2, MLP(hidden=(16,)))
    critic = NetworkCritic(
        spaces.Discrete(6), 2, NetworkValues(network=MLP(hidden=(16,)), learning_rate=0.01, num_epochs=4)
    )
    env, states, returns = vector_env(mdp, 16), torch.arange(6), []
    for k in range(20):
        generator = stream(k, "learning")
        returns.append(exact.evaluate(mdp, policy.probs(states)).J)
        made = made_in(env, policy, FixedHorizon(length=16), gamma=math.nan, seed=k)
        v_TB, next_v_TB = (critic.v(s.reshape(-1)).view(s.shape).double() for s in (made.state_TB, made.next_state_TB))
        advantage_V = gae(made, v_TB, next_v_TB, 0.95)[made.alive_TB]
        states_V, actions_V = made.state_TB[made.alive_TB], made.action_TB[made.alive_TB]
        advantage_VA = score_function(actions_V, advantage_V, policy.probs(states_V))
        critic.fit(policy, made, generator=generator)
        update(policy, Batch(states_V, advantage_VA, made.visit_weight("visits")), generator=generator)
    missing = exact.optimal(mdp).J - returns[0]
    assert returns[-1] - returns[0] > 0.9 * missing > 0.4


def test_an_update_of_networks_refuses_a_table():
    with pytest.raises(PgtsError, match="PPOUpdate updates a NetworkPolicy, not a SoftmaxPolicy"):
        PPOUpdate().check(SoftmaxPolicy(2, 2))
