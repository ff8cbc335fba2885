"""Training networks does not depend on the unit of rewards, nor moves where actions do not differ."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TransformReward

from pgts_torch import PGTS

pytestmark = pytest.mark.usefixtures("unchecked_shapes")


class Cart(gymnasium.Env[np.ndarray, np.int64]):
    """A cart on a track of length 2 that is pushed left or right and falls off its ends; rewarded in the middle.

    Args:
        unit: what rewards are multiplied by.
        heeds: whether pushes do anything.
        constant: every reward is 1 and the track has no end.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, unit: float = 1.0, heeds: bool = True, constant: bool = False) -> None:
        self.unit, self.heeds, self.constant = unit, heeds, constant
        self.action_space = spaces.Discrete(2)
        self.observation_space = spaces.Box(-10, 10, (2,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.x, self.speed = self.np_random.uniform(-0.5, 0.5, 2).tolist()
        return self._seen(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.speed += (0.1 if action else -0.1) * self.heeds - 0.05 * self.x
        self.x += 0.2 * self.speed
        over = abs(self.x) > 1 and not self.constant
        reward = 1.0 if self.constant else -3.0 if over else 1 - abs(self.x) + 0.1 * self.speed
        return self._seen(), reward * self.unit, over, False, {}

    def _seen(self) -> np.ndarray:
        return np.clip(np.array([self.x, self.speed]), -10, 10)

    def get_state(self) -> tuple[float, float]:
        return self.x, self.speed

    def set_state(self, state: tuple[float, float]) -> None:
        self.x, self.speed = state


def trained(env: Any, *, iterations: int = 3, **options: Any) -> PGTS:
    horizon = {"type": "fixed", "length": 20}
    options = {"policy": {"type": "mlp", "hidden": [16]}, "num_envs": 3, "horizon": horizon, "seed": 3} | options
    model = PGTS(env, **options)
    for _ in range(iterations):
        model.iterate()
    return model


def weights(model: PGTS) -> list[torch.Tensor]:
    return list(model.policy.state_dict().values())


def same(one: PGTS, other: PGTS) -> bool:
    return all(torch.equal(a, b) for a, b in zip(weights(one), weights(other), strict=True))


@pytest.mark.fault("rewards in another unit, networks")
@pytest.mark.parametrize("depth", [0, 2])
@pytest.mark.parametrize("critic", ["network", {"type": "network", "target": "q", "polyak": 0.5}])
def test_rewards_times_a_power_of_two_leave_every_bit_of_the_policy(depth: int, critic: Any):
    plain = trained(lambda: Cart(), depth=depth, critic=critic)
    for power in (-40, 40):
        assert same(trained(lambda: Cart(2.0**power), depth=depth, critic=critic), plain)  # noqa: B023
    assert not same(trained(lambda: Cart(-1.0), depth=depth, critic=critic), plain)


@pytest.mark.fault("rewards in another unit, networks")
@pytest.mark.parametrize("normalize", [True, False])
def test_the_same_holds_of_sampled_advantages_where_values_are_normalised(normalize: bool):
    options: dict[str, Any] = {"depth": 0, "estimator": "sampled"}
    options["critic"] = {"type": "network", "normalize_returns": normalize}
    plain = trained(Cart, **options)
    for power in (-40, 40):
        assert same(trained(lambda: Cart(2.0**power), **options), plain) == normalize  # noqa: B023


@pytest.mark.parametrize("env_id", ["CartPole-v1", "FrozenLake-v1"])
def test_dynamics_and_tables_behind_a_wrapper_of_rewards_do_not_depend_on_their_unit(env_id: str):
    def scaled(unit: float) -> PGTS:
        return trained(lambda: TransformReward(gymnasium.make(env_id), lambda r: unit * float(r)), depth=2)

    plain = scaled(1.0)
    assert type(plain.world).__name__ == ("DynamicsWorld" if env_id == "CartPole-v1" else "TabularWorld")
    assert same(scaled(2.0**-30), plain)
    assert same(scaled(2.0**30), plain)
    assert not same(scaled(-1.0), plain)


def test_values_are_in_the_unit_of_the_rewards():
    plain, large = trained(Cart, depth=2), trained(lambda: Cart(2.0**20), depth=2)
    seen_N2 = torch.rand(5, 2, dtype=torch.float64)
    assert torch.equal(large.critic.v(seen_N2), plain.critic.v(seen_N2) * 2**20)


@pytest.mark.parametrize(("depth", "constant"), [(0, False), (2, False), (2, True), (16, True)])
def test_a_policy_stays_where_actions_do_nothing(depth: int, constant: bool):
    before, after = (
        trained(lambda: Cart(heeds=False, constant=constant), iterations=count, depth=depth) for count in (0, 3)
    )
    assert same(before, after)
    assert after.num_iterations == 3


def test_rewards_of_0_are_no_error():
    model = trained(lambda: Cart(unit=0.0), depth=2, iterations=2)
    assert same(model, trained(Cart, depth=2, iterations=0))
    assert model.critic.v(torch.zeros(1, 2)).tolist() == [0.0]
