"""Gradient steps in compiled loops: those of torch up to rounding, for every objective, network and number of ranks."""

import copy
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.agent import optimisers
from pgts_torch.agent.dense_steps import compiles
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.neural_updates import GradientUpdate, NetworkUpdate, PPOUpdate
from pgts_torch.agent.optimisers import Optimiser
from pgts_torch.agent.target_updates import CMPOUpdate, NetworkMirrorUpdate
from pgts_torch.compiled import torch_only
from pgts_torch.errors import NotFinite
from pgts_torch.options import CMPO, MLP, PPO, FixedHorizon, Gradient, Mirror, NetworkValues
from pgts_torch.seeding import stream
from pgts_torch.tabular import random_mdp
from tests.agent.helpers import experience
from tests.forks import on_ranks

dense_kernels = pytest.importorskip("pgts_torch.agent.dense_kernels")

VECTORS = spaces.Box(-math.inf, math.inf, (3,))
MINIBATCHES: dict[str, Any] = {"num_epochs": 2, "minibatch_size": 32, "learning_rate": 1e-3}
UPDATES: dict[str, Callable[[], NetworkUpdate]] = {
    "gradient": lambda: GradientUpdate(Gradient(learning_rate=1e-3, entropy_coef=0.1)),
    "ppo": lambda: PPOUpdate(PPO(entropy_coef=0.1, **MINIBATCHES)),
    "ppo, unclipped gradients": lambda: PPOUpdate(PPO(max_grad_norm="never", **MINIBATCHES)),
    "cmpo": lambda: CMPOUpdate(CMPO(**MINIBATCHES)),
    "mirror": lambda: NetworkMirrorUpdate(Mirror(**MINIBATCHES)),
}
NETWORKS = {
    "tanh": MLP(hidden=[16, 8]),
    "relu": MLP(hidden=[16], activation="relu"),
    "linear": MLP(hidden=[]),
    "wide": MLP(hidden=[130, 130]),  # in blocks of fewer rows than a minibatch
    "normalised": MLP(hidden=[8], normalize=True),
}


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """The number of rows of each compiled gradient; all steps are compiled."""
    monkeypatch.setattr(optimisers, "_MANY", 0)
    made, plain = list[int](), dense_kernels.gradient

    def counted(*given: Any) -> None:
        made.append(len(given[4][0]))
        plain(*given)

    monkeypatch.setattr(dense_kernels, "gradient", counted)
    return made


def batch(num_rows: int = 70, size: float = 1.0) -> Batch:
    generator = stream(0, "rows")
    advantage_NA = size * torch.randn(num_rows, 4, generator=generator, dtype=torch.float64)
    weight_N = torch.rand(num_rows, generator=generator, dtype=torch.float64) + 0.1
    return Batch(torch.randn(num_rows, 3, generator=generator), advantage_NA, weight_N)


def weights(network: torch.nn.Module) -> Tensor:
    return torch.cat([weight.detach().flatten() for weight in network.parameters()])


def moved(update: NetworkUpdate, options: MLP, rows: Batch) -> tuple[Tensor, dict[str, float], Tensor]:
    """The change of the weights, the losses, and the second moments."""
    policy = NetworkPolicy(VECTORS, 4, options, seed=1)
    before = weights(policy.network)
    losses = update(policy, rows, generator=stream(0, "update"))
    return weights(policy.network) - before, losses, update.state_dict()["second_D"]


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("update", UPDATES)
def test_compiled_steps_of_a_policy_are_those_of_torch_up_to_rounding(update, network, calls):
    make, options = UPDATES[update], NETWORKS[network]
    with torch_only():
        expected, losses, second = moved(make(), options, batch())
    assert calls == []
    found, its_losses, its_second = moved(make(), options, batch())
    assert calls == ([70] if update == "gradient" else [32, 32, 6] * 2)
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-3)
    torch.testing.assert_close(its_second, second, atol=1e-9, rtol=1e-4)
    assert its_losses == pytest.approx(losses, rel=1e-3, abs=1e-5)
    assert not torch.equal(found, moved(make(), options, batch(size=-1.0))[0])


@pytest.mark.parametrize("target", ["v", "q"])
@pytest.mark.parametrize("unit", [1e-3, 1e6])
def test_compiled_fits_of_a_critic_are_those_of_torch_up_to_rounding(target, unit, calls):
    mdp = random_mdp(6, 4, branching=2)
    pi_SA = torch.full((6, 4), 0.25, dtype=torch.float64)
    made = experience(mdp, pi_SA, FixedHorizon(length=9), episodes=12)
    made.reward_TB.mul_(unit)
    policy, values = NetworkPolicy(spaces.Discrete(6), 4, MLP(hidden=[8])), []
    for form in (torch_only, None):
        critic = NetworkCritic(spaces.Discrete(6), 4, NetworkValues(target=target, network=MLP(hidden=[8])), seed=1)
        if form is None:
            losses = critic.fit(policy, made, generator=stream(0, "fit"))
        else:
            with form():
                losses = critic.fit(policy, made, generator=stream(0, "fit"))
            assert calls == []
        values.append((critic.v(torch.arange(6)) / unit, losses["value"] / unit**2, losses["value_grad_norm"]))
    assert len(calls) == 10 * math.ceil(made.num_steps / 64)
    torch.testing.assert_close(values[0][0], values[1][0], atol=1e-4, rtol=1e-4)
    assert values[0][1:] == pytest.approx(values[1][1:], rel=1e-3)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("target", ["v", "q"])
def test_values_of_a_critic_are_those_of_torch_up_to_rounding_and_compiled_as_its_steps_are(
    network, target, monkeypatch
):
    rows, plain = list[int](), dense_kernels.outputs

    def counted(*given: Any) -> None:
        rows.append(len(given[3]))
        plain(*given)

    monkeypatch.setattr(dense_kernels, "outputs", counted)
    critic = NetworkCritic(
        VECTORS, 4, NetworkValues(target=target, network=NETWORKS[network], normalize_returns=False), seed=1
    )
    values = getattr(critic, target)
    observation_N = torch.randn(70, 3, generator=stream(0, "rows"))
    expected = values(observation_N)
    assert rows == []  # it has not taken 200 steps
    monkeypatch.setattr(optimisers, "_MANY", 0)
    torch.testing.assert_close(values(observation_N), expected, atol=1e-6, rtol=1e-5)
    assert rows == [70]
    assert values(observation_N[:0]).shape == expected[:0].shape
    with torch.no_grad():
        critic.network.weights[-1].add_(1.0)  # the last bias: what was learned since counts
    torch.testing.assert_close(values(observation_N), expected + 1, atol=1e-5, rtol=1e-5)
    with torch_only():
        assert not torch.equal(values(observation_N), expected)
    assert rows == [70, 0, 70]


@pytest.mark.parametrize("network", NETWORKS)
def test_a_policy_acts_as_by_torch_and_compiled_as_its_steps_are(network, monkeypatch):
    made, plain = list[int](), dense_kernels.choices

    def counted(*given: Any) -> bool:
        made.append(len(given[3]))
        return plain(*given)

    monkeypatch.setattr(dense_kernels, "choices", counted)
    policy, update = NetworkPolicy(VECTORS, 4, NETWORKS[network], seed=1), UPDATES["gradient"]()
    with torch.no_grad():
        policy.network.weights[-1].copy_(torch.tensor([0.0, 1.0, -1.0, 0.5]))  # biases, or nearly all are equal
    update.check(policy)
    observation_N = torch.randn(2000, 3, generator=stream(0, "rows"))
    probs, actions = policy.probs(observation_N), policy.sample(observation_N, generator=stream(0, "actions"))
    assert made == []
    monkeypatch.setattr(optimisers, "_MANY", 0)
    torch.testing.assert_close(policy.probs(observation_N), probs, atol=1e-6, rtol=1e-5)
    found = policy.sample(observation_N, generator=stream(0, "actions"))
    assert made == [2000]
    assert (found != actions).sum() <= 1  # where rounding decides
    assert not torch.equal(policy.sample(observation_N, generator=stream(1, "actions")), actions)
    with torch.no_grad():
        policy.network.weights[-1][2] = math.nan
    with pytest.raises(NotFinite, match="the policy's probabilities are"):
        policy.sample(observation_N, generator=stream(0, "actions"))


def test_weights_have_gradients_also_where_a_policy_was_first_asked_in_inference_mode(calls):
    policy, update = NetworkPolicy(VECTORS, 4, MLP(hidden=[8]), seed=1), UPDATES["gradient"]()
    update.check(policy)
    with torch.inference_mode():
        policy.probs(batch().observation_N)
    policy.network(batch().observation_N).square().sum().backward()
    for weight in policy.network.weights:
        assert weight.grad is not None
        assert weight.grad.abs().sum() > 0


def test_a_trunk_that_two_networks_share_and_copies_of_them_have_the_weights_that_were_last_learned(calls):
    policy = NetworkPolicy(VECTORS, 4, MLP(hidden=[8]), seed=1)
    options = NetworkValues(network="shared", normalize_returns=False)
    critic = NetworkCritic(VECTORS, 4, options, trunk=policy.network.trunk, seed=1)
    update, observation_N = UPDATES["gradient"](), batch().observation_N
    update.check(policy)
    with torch_only():
        first = critic.v(observation_N), policy.probs(observation_N)
    for _ in range(2):
        update(policy, batch(), generator=stream(0, "update"))
        found = critic.v(observation_N), policy.probs(observation_N)
        copied = copy.deepcopy(policy.network).outputs(observation_N).softmax(-1)
        with torch_only():
            expected = critic.v(observation_N), policy.probs(observation_N)
        for now, by_torch, before in zip(found, expected, first, strict=True):
            torch.testing.assert_close(now, by_torch, atol=1e-6, rtol=1e-5)
            assert not torch.allclose(now, before, atol=1e-5)
        assert torch.equal(copied, found[1])


@pytest.mark.parametrize("x", [0.0, 1e-30, 1e-3, 0.3, 1.0, 4.0, 7.8, 8.0, 1e30, math.inf])
def test_tanh_is_right_to_a_few_roundings(x):
    for sign in (1, -1):
        assert float(dense_kernels._tanh(torch.tensor(sign * x).numpy()[()])) == pytest.approx(
            math.tanh(sign * x), rel=4e-7
        )
    assert math.isnan(dense_kernels._tanh(torch.tensor(math.nan).numpy()[()]))


@pytest.mark.parametrize("target_kl", [1e-9, 1e9])
def test_steps_end_where_the_policy_has_moved_far_enough(target_kl, calls):
    found = []
    for form in (torch_only, None):
        update = PPOUpdate(PPO(target_kl=target_kl, **MINIBATCHES))
        if form is None:
            found.append(moved(update, MLP(), batch())[1]["num_steps"])
        else:
            with form():
                found.append(moved(update, MLP(), batch())[1]["num_steps"])
    assert found == ([6, 6] if target_kl > 1 else [1, 1])
    assert len(calls) == (6 if target_kl > 1 else 2)


def test_a_step_that_is_not_finite_is_taken_back(calls):
    policy, update = NetworkPolicy(VECTORS, 4, MLP(hidden=[8]), seed=1), UPDATES["ppo"]()
    update(policy, batch(), generator=stream(0, "update"))
    before, state = weights(policy.network), update.state_dict()
    with torch.no_grad():
        policy.network.weights[0][0, 0] = math.nan
    with pytest.raises(NotFinite, match="the policy loss is nan; no parameter was changed"):
        update(policy, batch(), generator=stream(0, "update"))
    with torch.no_grad():
        assert math.isnan(policy.network.weights[0][0, 0])
        policy.network.weights[0][0, 0] = before[0]
    assert torch.equal(weights(policy.network), before)
    for name, value in update.state_dict().items():
        assert torch.equal(torch.as_tensor(value), torch.as_tensor(state[name]))


@pytest.mark.usefixtures("unchecked_shapes")
def test_ranks_take_the_steps_of_one_process_with_all_rows(calls):
    def trained() -> tuple[Tensor, int]:
        model = PGTS(
            "CartPole-v1",
            depth=1,
            num_envs=4,
            policy={"type": "mlp", "hidden": [8]},
            horizon={"type": "fixed", "length": 12},
            seed=3,
        )
        model.iterate()
        return weights(model.policy.network), len(calls)

    (one, count), (other, _) = on_ranks(2, trained)
    assert torch.equal(one, other)
    assert count > 0
    with torch_only():  # in the processes, which are forked here
        (expected, none), _ = on_ranks(2, trained)
    assert none == 0
    torch.testing.assert_close(one, expected, atol=1e-4, rtol=1e-3)
    assert not torch.equal(one, expected)


def test_few_steps_large_networks_other_layers_and_devices_are_left_to_torch(calls, monkeypatch):
    moved(UPDATES["ppo"](), MLP(hidden=[300, 120]), batch())  # 37,900 weights
    assert calls == []
    policy, update = NetworkPolicy(VECTORS, 4, MLP(hidden=[8]), seed=1), UPDATES["ppo"]()
    policy.network.double()
    assert not compiles(policy.network, update._optimiser)
    monkeypatch.setattr(optimisers, "_MANY", 7)
    loaded = Optimiser(learning_rate=1.0, max_grad_norm=None)
    loaded.load_state_dict({"num_steps": 7, "first_D": torch.zeros(3), "second_D": torch.zeros(3)})
    assert loaded.compiles_all_of(3, torch.zeros(3))
    assert not loaded.compiles_all_of(3, torch.zeros(3, device="meta"))  # as on a GPU, where it has taken no step yet
    policy = NetworkPolicy(VECTORS, 4, MLP(hidden=[8]), seed=1)
    for expected in (0, 0, 6):  # steps 1 to 6, 7 to 12 and 13 to 18
        update(policy, batch(), generator=stream(0, "update"))
        assert len(calls) == expected


def test_a_training_goes_on_bit_for_bit_where_its_steps_become_compiled(tmp_path, monkeypatch, calls):
    monkeypatch.setattr(optimisers, "_MANY", 25)
    given = {"depth": 0, "estimator": "sampled", "update": PPO(num_epochs=5, minibatch_size=20), "seed": 2}
    given |= {"policy": MLP(hidden=[8]), "horizon": {"type": "steps", "length": 20}, "num_envs": 2}
    whole = PGTS("CartPole-v1", **given).learn(40 * 5)
    assert calls
    PGTS("CartPole-v1", **given).learn(40 * 2).save(tmp_path / "half.pt")
    rest = PGTS.load(tmp_path / "half.pt").learn(40 * 5)
    assert torch.equal(weights(rest.policy.network), weights(whole.policy.network))
    with torch_only():
        other = PGTS("CartPole-v1", **given).learn(40 * 5)
    assert not torch.equal(weights(other.policy.network), weights(whole.policy.network))
