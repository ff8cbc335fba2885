"""Environments that draw from the generators which a whole process shares: one seed, one result, nothing moved."""

import random
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models import SimulatorModel
from pgts_torch.seeding import SharedGenerators

DRAWS = {
    "random": random.random,
    "numpy.random": lambda: float(np.random.rand()),  # noqa: NPY002
    "torch": lambda: float(torch.rand(())),
}
SMALL = {"num_envs": 3, "horizon": {"type": "fixed", "length": 8}, "policy": {"type": "mlp", "hidden": [8]}, "seed": 5}

pytestmark = pytest.mark.usefixtures("unchecked_shapes")  # the checker itself draws from `random`


class Windy(gymnasium.Env):
    """A walk that a wind of somebody else's pushes, in steps, in resets or when it is made."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-99, 99, (1,), np.float64)

    def __init__(self, module: str, where: str = "step") -> None:
        self.draw, self.where = DRAWS[module], where
        self.bias = self.wind("init")
        self.position = 0.0

    def wind(self, now: str) -> float:
        return self.draw() if self.where == now else 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = self.bias + self.wind("reset")
        return np.array([self.position]), {}

    def step(self, action: int) -> Any:
        self.position += action - 0.5 + self.wind("step")
        return np.array([self.position]), self.position, False, False, {}

    def get_state(self) -> tuple[float, float]:
        return self.position, self.bias

    def set_state(self, state: tuple[float, float]) -> None:
        self.position, self.bias = state


def states() -> tuple[Any, ...]:
    return random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # noqa: NPY002


def trained(make: Any, **options: Any) -> tuple[list[float], float]:
    model = PGTS(make, depth=0, estimator="sampled", **SMALL, **options).learn(60)
    weights = [x for tensor in model.policy.state_dict().values() for x in tensor.flatten().tolist()]
    return weights, evaluate(model, episodes=2).episodic_return.mean


@pytest.mark.fault("environment that draws from global generators")
@pytest.mark.parametrize("module", DRAWS)
@pytest.mark.parametrize("where", ["step", "reset", "init"])
def test_one_seed_gives_the_same_bits_and_a_single_warning_and_the_users_generators_go_on(module, where):
    found, said = [], []
    for other_state in (0, 1):
        random.seed(other_state), np.random.seed(other_state), torch.manual_seed(other_state)  # noqa: NPY002
        before = states()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found.append(trained(lambda: TimeLimit(Windy(module, where), 9)))
        said.append([str(each.message) for each in caught])
        assert states() == before
    assert found[0] == found[1]
    if where == "init":
        assert said == [[], []]
    else:
        assert all(len(each) == 1 and f"uses the generator of {module}, which" in each[0] for each in said)


def test_an_environment_that_uses_its_own_generator_causes_no_warning():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        trained("CartPole-v1")
    assert said == []


@pytest.mark.parametrize("module", DRAWS)
def test_a_step_that_uses_a_global_generator_is_no_model(module):
    before = states()
    with pytest.raises(MissingModel, match=f"step draws from the global generator of {module}: draw from"):
        PGTS(lambda: Windy(module), depth=1, **SMALL)
    assert states() == before


@pytest.mark.parametrize("module", DRAWS)
def test_a_simulator_notices_later_too_that_a_step_uses_a_global_generator(module):
    model, env = SimulatorModel(lambda: Windy(module, "later"), gamma=0.9), Windy(module, "later")
    env.reset(seed=0)
    state_N, action_N = torch.tensor([model.root(env)] * 2), torch.tensor([0, 1])
    assert model.is_random(state_N, action_N).tolist() == [False, False]
    model.clear()
    model.env.where = "step"
    env.position = 7.0
    state_N, before = torch.tensor([model.root(env)] * 2), states()
    with pytest.raises(MissingModel, match=f"step draws from the global generator of {module}"):
        model.sample(state_N, action_N, key_N=action_N)
    assert model.is_random(state_N, action_N).tolist() == [True, True]
    assert states() == before


def test_an_error_leaves_the_users_generators_as_they_were():
    class Broken(Windy):
        def step(self, action: int) -> Any:
            self.draw()
            raise RuntimeError("no wind")

    before = states()
    with pytest.raises(PgtsError, match="no wind"):
        trained(lambda: Broken("random"))
    assert states() == before


def test_the_context_has_a_stream_for_each_name_and_tells_which_generators_were_used():
    def draws(*names: str) -> list[float]:
        with SharedGenerators(*names):
            return [draw() for draw in DRAWS.values()]

    first, again, other, another_seed = draws(3, "a"), draws(3, "a"), draws(3, "b"), draws(4, "a")
    assert first == again
    assert all(x != y for x, y in zip(first, other, strict=True))
    assert all(x != y for x, y in zip(first, another_seed, strict=True))
    with SharedGenerators(0) as shared:
        pass
    assert shared.used == ()
    for module, draw in DRAWS.items():
        before = states()
        with SharedGenerators() as shared:
            draw()
        assert shared.used == (module,)
        assert states() == before
