"""What torch takes for numbers without a dtype changes nothing: networks stay float32, and every bit is the same."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from pgts_torch import PGTS, evaluate
from pgts_torch.models import check_model

pytestmark = pytest.mark.usefixtures("unchecked_shapes")


class Corridor(gymnasium.Env):
    """Six cells, of which the last pays; chance moves against one in a tenth of the steps of a slippery one."""

    action_space = spaces.Discrete(2)
    slip: ClassVar[float] = 0.0

    def __init__(self):
        self.observation_space = spaces.Box(0, 6, (1,), np.float32)
        self.cell = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self.look(), {}

    def step(self, action):
        if self.slip and self.np_random.random() < self.slip:
            action = 1 - action
        self.cell = max(0, self.cell + 2 * int(action) - 1)
        return self.look(), float(self.cell == 5), self.cell == 5, False, {}

    def look(self):
        return np.full(self.observation_space.shape, self.cell, self.observation_space.dtype)

    def get_state(self):
        return self.cell

    def set_state(self, state):
        self.cell = state


class Slippery(Corridor):
    slip = 0.1


class Image(Corridor):
    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 255, (4, 4, 3), np.uint8)


SAMPLED: dict[str, Any] = {"depth": 0, "estimator": {"type": "sampled", "lambda": 0.9}}
RUNS: dict[str, dict[str, Any]] = {
    "mlp, lookahead": {"env": Corridor, "policy": "mlp", "depth": 2},
    "mlp, adaptive": {"env": "CartPole-v1", "policy": "mlp", "depth": "adaptive", "max_depth": 2},
    "mlp, normalised": {"env": "CartPole-v1", "policy": {"type": "mlp", "normalize": True}, "depth": 1},
    "cnn, lookahead": {"env": Image, "policy": {"type": "cnn", "channels": (4,), "hidden": (8,)}, "depth": 1},
    "mirror": {"env": "Acrobot-v1", "policy": "mlp", "update": "mirror", "depth": 1},
    "gradient": {"env": Corridor, "policy": "mlp", "update": "gradient", **SAMPLED},
    "ppo": {"env": "CartPole-v1", "policy": "mlp", "update": "ppo", **SAMPLED},
    "q critic": {"env": Corridor, "policy": "mlp", "critic": {"type": "network", "target": "q"}, "depth": 2},
    "lagging critic": {"env": Corridor, "policy": "mlp", "critic": {"type": "network", "polyak": 0.5}, "depth": 1},
    "sampled lookahead": {"env": Slippery, "policy": "mlp", "depth": 2, "search": {"type": "sampled", "samples": 2}},
    "mcts": {"env": Corridor, "policy": "mlp", "depth": 2, "search": {"type": "mcts", "simulations": 16}},
    "pruned": {"env": "MountainCar-v0", "policy": "mlp", "depth": 2, "search": {"type": "expectimax", "max_width": 8}},
    "tables, softmax": {"env": "FrozenLake-v1", "depth": 3},
    "tables, projected": {"env": "pgts/Tightrope-v0", "policy": "simplex", "update": "projected", "depth": 2},
    "tables, mirror": {"env": "CliffWalking-v1", "update": "mirror", "depth": 2},
    "tables, learned q": {"env": "FrozenLake-v1", "critic": {"type": "tabular", "target": "q"}, "depth": 1},
    "tables, rollouts": {"env": "pgts/Random-v0", "critic": "rollout", "depth": 1},
    "tables, geometric": {"env": "pgts/Random-v0", "horizon": "geometric", "depth": 1},
    "one-hot states": {"env": "FrozenLake-v1", "policy": "mlp", "critic": "network", "depth": 1},
}  # fmt: skip


def bits(options: dict[str, Any], folder: Any) -> list[torch.Tensor]:
    """Train, save, load, go on, evaluate: everything that came of it."""
    short = {"num_envs": 3, "horizon": {"type": "fixed", "length": 7}, "gamma": 0.9, "seed": 1}
    model = PGTS(**short | options)
    seen = [model.iterate() for _ in range(2)]
    model.save(folder / "model.pt")
    again = PGTS.load(folder / "model.pt", env=None if isinstance(options["env"], str) else options["env"])
    seen += [again.iterate()]
    score = evaluate(again, episodes=2)
    kept = [value for part in (again.policy, again.critic) for value in leaves(part.state_dict())]
    numbers = [
        score.episodic_return.mean,
        score.discounted_return.mean,
        *(one.losses[name] for one in seen for name in sorted(one.losses)),
    ]
    return [*kept, *(one.advantage_NA for one in seen), torch.tensor(numbers, dtype=torch.float64)]  # fmt: skip


def leaves(state: Any) -> list[torch.Tensor]:
    if isinstance(state, dict):
        return [leaf for name in sorted(state) for leaf in leaves(state[name])]
    return [state] if isinstance(state, torch.Tensor) else []


@pytest.fixture
def in_double():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.fault("torch.set_default_dtype(torch.float64)")
@pytest.mark.parametrize("run", RUNS)
def test_training_has_the_same_bits_whatever_torchs_default_dtype_is(run, tmp_path, request):
    expected = bits(RUNS[run], tmp_path)
    request.getfixturevalue("in_double")
    found = bits(RUNS[run], tmp_path)
    assert [value.dtype for value in found] == [value.dtype for value in expected]
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_a_model_is_checked_whatever_torchs_default_dtype_is(in_double):
    assert check_model(Slippery, continuations=3, length=4).usable
