"""Gradient steps: those of torch, without a read by the host, and taken back where a number is not finite."""

import copy
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from pgts_torch.agent.gradients import Forward
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.neural_updates import GradientUpdate, NetworkUpdate, PPOUpdate
from pgts_torch.agent.optimisers import Optimiser, Undo
from pgts_torch.agent.target_updates import CMPOUpdate, NetworkMirrorUpdate
from pgts_torch.compiled import torch_only
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.options import CMPO, MLP, PPO, FixedHorizon, Gradient, Mirror, NetworkValues
from pgts_torch.seeding import stream
from pgts_torch.tabular import random_mdp
from tests.agent.helpers import experience
from tests.counting import Counting

VECTORS = spaces.Box(-math.inf, math.inf, (3,))


def test_adam_is_that_of_torch_and_gradients_are_clipped_as_torch_does():
    ours, theirs = ([torch.nn.Parameter(torch.ones(2, 3)), torch.nn.Parameter(torch.ones(4))] for _ in range(2))
    optimiser, adam = Optimiser(learning_rate=0.01, max_grad_norm=0.5), torch.optim.Adam(theirs, lr=0.01)
    clipped = set()
    for k in range(20):
        pull = torch.randn(10, generator=stream(k, "pull")) * (0.01 if k % 3 == 0 else 1)
        losses = [sum((p.reshape(-1) * pull[-p.numel() :]).square().sum() for p in each) for each in (ours, theirs)]
        adam.zero_grad()
        losses[1].backward()
        norm = float(torch.nn.utils.clip_grad_norm_(theirs, 0.5))
        adam.step()
        gradients = torch.autograd.grad(losses[0], ours)
        with optimiser.attempt(ours):
            assert float(optimiser.step(ours, gradients, losses[0], "test")) == pytest.approx(norm, rel=1e-5)
        clipped.add(norm > 0.5)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)
    assert (ours[0] - 1).abs().max() > 0.1
    assert clipped == {False, True}


@pytest.mark.parametrize("size", [0.0, 0.3, 0.7, 1e15])
def test_a_gradient_that_is_short_enough_keeps_every_bit_and_a_longer_one_its_direction(size):
    parameter = torch.nn.Parameter(torch.zeros(3))
    gradient_D = size * torch.tensor([0.6, 0.0, -0.8])
    optimiser = Optimiser(learning_rate=1.0, max_grad_norm=0.5, method="sgd")
    with optimiser.attempt([parameter]):
        norm = float(optimiser.step([parameter], [gradient_D], torch.zeros(()), "test"))
    expected_D = gradient_D if norm <= 0.5 else gradient_D * (0.5 / norm)
    assert torch.equal(-parameter.detach(), expected_D)


@pytest.mark.parametrize("method", ["adam", "sgd"])
@pytest.mark.parametrize("max_grad_norm", [None, 0.5])
def test_a_step_reads_nothing_back_and_an_attempt_reads_once(method, max_grad_norm):
    parameters = [torch.nn.Parameter(torch.ones(2, 3)), torch.nn.Parameter(torch.ones(4))]
    optimiser = Optimiser(learning_rate=0.1, max_grad_norm=max_grad_norm, method=method)
    counted = []
    for num_steps in (1, 5):
        with torch_only(), Counting() as whole, optimiser.attempt(parameters) as readings, Counting() as steps:
            for _ in range(num_steps):
                loss = torch.ones(())
                readings.add(norm=optimiser.step(parameters, parameters, loss, "test"), loss=loss)
        assert steps.num_reads == 0
        assert whole.reads == {"tolist": 1}
        counted.append(steps.num_operations)
    assert counted[1] <= 5 * counted[0]


def reads(make: Callable[..., NetworkUpdate], observations: int = 70, **options: Any) -> tuple[int, int]:
    """How often the host reads in an update, and in how many steps."""
    policy, generator = NetworkPolicy(VECTORS, 4, MLP(hidden=(8,)), seed=1), stream(0, "reads")
    observation_ND = torch.randn(observations, 3, generator=generator)
    advantage_NA = torch.randn(observations, 4, generator=generator, dtype=torch.float64)
    batch = Batch(observation_ND, advantage_NA, torch.ones(observations, dtype=torch.float64))
    update = make(learning_rate=0.01, **options)
    with torch_only(), Counting() as counts:
        update(policy, batch, generator=generator)
    return counts.num_reads, len(update.state_dict()) and update.state_dict()["num_steps"]


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda **options: PPOUpdate(PPO(**options)), 1),
        # these look once whether there is anything to learn
        (lambda **options: NetworkMirrorUpdate(Mirror(**options)), 2),
        (lambda **options: CMPOUpdate(CMPO(**options)), 2),
    ],
)
def test_an_update_reads_as_often_for_many_steps_as_for_one(make, expected, monkeypatch):
    one, many = reads(make, num_epochs=1, minibatch_size=70), reads(make, num_epochs=4, minibatch_size=32)
    assert (one, many) == ((expected, 1), (expected, 12))
    step = Optimiser.step
    monkeypatch.setattr(Optimiser, "step", lambda *args: torch.tensor(float(step(*args))))
    assert reads(make, num_epochs=4, minibatch_size=32) == (expected + 12, 12)


def test_one_step_of_the_policy_gradient_reads_once():
    assert reads(lambda **options: GradientUpdate(Gradient(**options))) == (1, 1)


def test_a_limit_on_the_divergence_costs_a_read_for_each_minibatch():
    count, steps = reads(lambda **options: PPOUpdate(PPO(target_kl=1e6, num_epochs=4, minibatch_size=32, **options)))
    assert (count, steps) == (1 + 12, 12)


def fitted(options: NetworkValues) -> tuple[NetworkCritic, int]:
    """A critic after two fits, and how often the host has read numbers in the second one."""
    mdp = random_mdp(6, 2, gamma=0.7, start=None)
    pi_SA = torch.full((6, 2), 0.5)
    critic = NetworkCritic(spaces.Discrete(6), 2, options)
    policy = NetworkPolicy(spaces.Discrete(6), 2)
    rollouts = [experience(mdp, pi_SA, FixedHorizon(length=16), episodes=4, seed=seed) for seed in range(2)]
    critic.fit(policy, rollouts[0], generator=stream(0, "critic"))
    rollouts[1].observation_V  # noqa: B018 - made once, by a mask
    with torch_only(), Counting() as counts:
        critic.fit(policy, rollouts[1], generator=stream(1, "critic"))
    return critic, counts.num_reads


@pytest.mark.parametrize("fresh_targets", [False, True])
def test_a_fit_of_a_critic_reads_as_often_whatever_its_minibatches_and_only_to_make_targets(fresh_targets):
    def count(**more: Any) -> int:
        options = {"network": MLP(hidden=(8,)), "fresh_targets": fresh_targets} | more
        return fitted(NetworkValues(**options))[1]

    once = count(num_epochs=1, minibatch_size=64)
    assert count(num_epochs=1, minibatch_size=8) == once
    often = count(num_epochs=5, minibatch_size=64)
    assert count(num_epochs=5, minibatch_size=8) == often
    # Two tensors are copied to host memory, where targets are added up, each by `cpu` and `numpy`.
    assert often - once == (4 * 2 if fresh_targets else 0)


def spoiled(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """Make the gradient of one step infinite, counted from 0."""
    plain, calls = Forward.gradients, iter(range(100))

    def wrapped(made: Forward, down_ND: Tensor) -> list[Tensor]:
        first, *others = plain(made, down_ND)
        return [first * (math.inf if next(calls) == at else 1.0), *others]

    monkeypatch.setattr(Forward, "gradients", wrapped)


@pytest.mark.fault("gradient that is not finite")
@pytest.mark.parametrize("target_period", [None, 1])
@pytest.mark.parametrize("at", [0, 2])
def test_a_critic_is_as_before_a_fit_in_which_a_gradient_is_not_finite_and_the_gradient_is_named(
    target_period, at, monkeypatch
):
    lagging = {} if target_period is None else {"target_period": target_period, "fresh_targets": False}
    critic, _ = fitted(NetworkValues(network=MLP(hidden=(8,)), num_epochs=3, **lagging))
    before = copy.deepcopy(critic.state_dict())
    made = experience(
        random_mdp(6, 2, gamma=0.7, start=None), torch.full((6, 2), 0.5), FixedHorizon(length=9), episodes=4
    )
    policy = NetworkPolicy(spaces.Discrete(6), 2)
    with monkeypatch.context() as patch:
        spoiled(patch, at)
        with pytest.raises(NotFinite, match=r"the gradient of the value loss is (nan|inf); no parameter") as caught:
            critic.fit(policy, made, generator=stream(2, "critic"))
    assert caught.value.what == "gradient"
    same(critic.state_dict(), before)
    critic.fit(policy, made, generator=stream(2, "critic"))
    assert critic.state_dict()["mean"] != before["mean"]


def same(one: Any, other: Any) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize("steps", [0, 3])
def test_weights_and_optimiser_are_put_back_bit_for_bit_in_memory_that_is_made_once(steps, monkeypatch):
    policy, undo = NetworkPolicy(spaces.Discrete(3), 2), Undo()
    optimiser = Optimiser(learning_rate=0.1, max_grad_norm=1)
    weights = policy.network.weights

    def move() -> None:
        gradients = [torch.ones_like(weight) for weight in weights]
        optimiser.step(weights, gradients, torch.zeros(()), "test")

    for _ in range(steps):
        move()
    before = copy.deepcopy((policy.state_dict(), optimiser.state_dict()))
    made = []
    real = torch.empty_like
    monkeypatch.setattr(torch, "empty_like", lambda *args, **kwargs: made.append(None) or real(*args, **kwargs))
    for _ in range(3):
        undo.keep(policy.network.tensors, optimiser)
        move()
        assert not torch.equal(policy.state_dict()["head.bias"], before[0]["head.bias"])
        undo.restore(optimiser)
        same((policy.state_dict(), optimiser.state_dict()), before)
    assert len(made) == len(policy.network.tensors) + (2 if steps else 0)


def test_of_several_numbers_that_are_not_finite_the_earliest_is_named_and_nothing_is_changed():
    parameter = torch.nn.Parameter(torch.tensor([0.0, 1.0]))
    optimiser = Optimiser(learning_rate=0.1, max_grad_norm=None)

    def attempt(*steps: tuple[float, float]) -> None:
        with optimiser.attempt([parameter]):
            for loss, gradient in steps:
                optimiser.step([parameter], [torch.tensor([gradient, 1.0])], torch.tensor(loss), "test")

    with pytest.raises(NotFinite, match="the gradient of the test loss is inf; no parameter was changed") as caught:
        attempt((0.0, 1.0), (1.0, math.inf), (math.nan, math.nan))
    assert caught.value.what == "gradient"
    with pytest.raises(NotFinite, match="the test loss is nan; no parameter was changed") as caught:
        attempt((math.nan, math.inf))
    assert caught.value.what == "loss"
    assert parameter.tolist() == [0.0, 1.0]
    assert optimiser.state_dict() == {}
    attempt((0.0, 1.0))
    assert parameter.tolist() != [0.0, 1.0]


def test_an_error_that_a_step_has_led_to_is_reported_as_that_step():
    parameter = torch.nn.Parameter(torch.ones(1))
    optimiser = Optimiser(learning_rate=0.1, max_grad_norm=None)

    def lead_to_an_error(gradient: float) -> None:
        with optimiser.attempt([parameter]):
            optimiser.step([parameter], [torch.full((1,), gradient)], torch.zeros(()), "test")
            raise NotFinite("a target is not finite", what="value")

    for gradient, message in ((math.nan, "the gradient of the test loss is nan"), (1.0, "a target is not finite")):
        with pytest.raises(PgtsError, match=message):
            lead_to_an_error(gradient)
        assert parameter.tolist() == [1.0]
        assert optimiser.num_steps == 0
