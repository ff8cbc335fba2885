"""An environment that truncates its own episodes: there a lookahead stands still, and the critic has the word."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from pgts_torch.agent.pgts import PGTS
from pgts_torch.models import SimulatorModel
from pgts_torch.models.fidelity import check_model
from pgts_torch.search import Lookahead, expectimax, mcts, sampled
from pgts_torch.seeding import stream

GAMMA, LIMIT, ACTIONS = 0.9, 3, 2


class Clocked(gymnasium.Env):
    """A walk on whole numbers for three steps, after which it will not be stepped; +2 is an end."""

    action_space = spaces.Discrete(ACTIONS)
    observation_space = spaces.Box(-9, 9, (2,), np.float64)
    steps_after_the_limit = 0

    def __init__(self) -> None:
        self.position = self.time = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = self.time = 0
        return self.get_observation(), {}

    def get_observation(self) -> np.ndarray:
        return np.array([self.position, self.time], dtype=np.float64)

    def step(self, action: int) -> Any:
        if self.time >= LIMIT:
            Clocked.steps_after_the_limit += 1
            raise RuntimeError("the episode is over")
        self.position, self.time = self.position + (1 if action else -1), self.time + 1
        ends = self.position == 2
        return self.get_observation(), reward(self.position), ends, self.time >= LIMIT, {}

    def get_state(self) -> bytes:
        return bytes([self.position + 9, self.time])

    def set_state(self, state: bytes) -> None:
        self.position, self.time = state[0] - 9, state[1]


@pytest.fixture(autouse=True)
def never_stepped_past_its_limit():
    Clocked.steps_after_the_limit = 0
    yield
    assert Clocked.steps_after_the_limit == 0


def reward(position: int) -> float:
    return position**2 / 7 - position


def v(position: int, time: int) -> float:
    """A critic that sees much in what the limit cuts off."""
    return 3.0 + position - 0.5 * time


def q(position: int, time: int, action: int) -> float:
    return v(position, time) * (1 + action) / 3


def by_hand(position: int, time: int, action: int, depth: int, value: Callable[[int, int], float]) -> float:
    """What follows an action, where `value` stands at the limit and below the last level."""
    there = position + (1 if action else -1)
    if there == 2:
        return reward(there)
    if depth == 0 or time + 1 == LIMIT:
        return reward(there) + GAMMA * value(there, time + 1)
    return reward(there) + GAMMA * max(by_hand(there, time + 1, a, depth - 1, value) for a in range(ACTIONS))


ENGINES: dict[str, Callable[..., Lookahead]] = {
    "expectimax": expectimax,
    "pruned": lambda *args, **kwargs: expectimax(*args, max_width=1000, **kwargs),
    "sampled": lambda *args, **kwargs: sampled(*args, samples=2, generator=stream(0, "samples"), **kwargs),
    "sampled, no share": lambda *args, **kwargs: sampled(
        *args, samples=2, share="none", generator=stream(0, "samples"), **kwargs
    ),
    "mcts, tree": lambda *args, **kwargs: mcts(*args, simulations=500, **kwargs),
    "mcts, graph": lambda *args, **kwargs: mcts(*args, simulations=500, merge=True, **kwargs),
}


def roots(model: SimulatorModel, walks: list[list[int]]) -> Tensor:
    numbers = []
    for actions in walks:
        env = Clocked()
        observation, _ = env.reset(seed=0)
        for action in actions:
            observation, *_ = env.step(action)
        numbers.append(model.root(env, observation))
    return torch.tensor(numbers)


@pytest.mark.fault("environment that truncates its own episodes")
@pytest.mark.parametrize("engine", ENGINES.values(), ids=ENGINES)
@pytest.mark.parametrize("depth", [0, 1, 2, 4])
@pytest.mark.parametrize("leaf", ["v", "q"])
def test_a_state_in_which_the_environment_truncates_has_the_critics_value_at_every_depth(engine, depth, leaf):
    model = SimulatorModel(Clocked, gamma=GAMMA)
    root_B, starts = roots(model, [[], [0], [1, 0]]), [(0, 0), (-1, 1), (0, 2)]

    def v_leaf(state_N: Tensor) -> Tensor:
        return torch.tensor([v(*map(int, row)) for row in model.observations(state_N)], dtype=torch.float64)

    def q_leaf(state_N: Tensor) -> Tensor:
        rows = [[q(*map(int, row), a) for a in range(ACTIONS)] for row in model.observations(state_N)]
        return torch.tensor(rows, dtype=torch.float64)

    look = engine(model, root_B, depth=depth, **({"v_leaf": v_leaf} if leaf == "v" else {"q_leaf": q_leaf}))
    if leaf == "v":
        expected = [[by_hand(*start, a, depth, v) for a in range(ACTIONS)] for start in starts]
    elif depth == 0:
        expected = [[q(*start, a) for a in range(ACTIONS)] for start in starts]
    else:
        best = lambda position, time: max(q(position, time, a) for a in range(ACTIONS))  # noqa: E731
        expected = [[by_hand(*start, a, depth - 1, best) for a in range(ACTIONS)] for start in starts]
    torch.testing.assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-12)
    assert float(look.pruned_BA.max()) == 0


def test_with_an_upper_bound_at_the_leaves_the_cut_states_keep_it():
    model, bound = SimulatorModel(Clocked, gamma=GAMMA), 50.0
    look = expectimax(model, roots(model, [[0, 0]]), depth=4, v_leaf=lambda state_N: torch.full((len(state_N),), bound))
    assert look.q_BA.tolist() == [[reward(-3) + GAMMA * bound, reward(-1) + GAMMA * bound]]


def test_a_cut_state_costs_no_step_and_is_another_than_the_one_in_which_a_rollout_ends():
    model = SimulatorModel(Clocked, gamma=GAMMA)
    root_B = roots(model, [[0, 0]])
    cut_N = model.outcomes(root_B).child_NAK.flatten()
    steps_before = model.simulator_steps
    again = model.outcomes(cut_N)
    assert model.simulator_steps == steps_before
    assert again.child_NAK.flatten(1).tolist() == [[int(cut), int(cut)] for cut in cut_N]
    assert again.reward_NA.tolist() == [[0.0, -torch.inf]] * 2
    env = Clocked()
    env.reset(seed=0)
    for action in (0, 0, 0):
        env.step(action)
    assert model.root(env) not in cut_N.tolist()
    assert torch.equal(model.adopt(model.export(cut_N)), cut_N)


@pytest.mark.parametrize("repeat", [1, 2, 5])
def test_repeated_actions_stop_where_the_environment_truncates(repeat):
    model = SimulatorModel(Clocked, gamma=GAMMA, action_repeat=repeat)
    look = expectimax(model, roots(model, [[]]), depth=0, v_leaf=lambda state_N: torch.ones(len(state_N)))
    steps = min(repeat, LIMIT)
    expected = sum(GAMMA**i * reward(-1 - i) for i in range(steps)) + GAMMA**steps
    assert float(look.q_BA[0, 0]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("search", ["auto", "mcts", {"type": "sampled", "samples": 2}])
def test_training_with_a_lookahead_never_steps_past_the_limit(search):
    model = PGTS(Clocked, depth=4, search=search, policy="mlp", num_envs=3, gamma=GAMMA, seed=0)
    model.learn(60)
    assert model.num_env_steps >= 60


def test_an_environment_that_refuses_steps_after_its_own_limit_can_serve_as_a_model():
    report = check_model(Clocked, continuations=8, length=6)
    assert report.usable, report.verdict


def test_the_clock_itself_still_raises():
    env = Clocked()
    env.reset(seed=0)
    env.time = LIMIT
    with pytest.raises(RuntimeError, match="over"):
        env.step(0)
    assert Clocked.steps_after_the_limit == 1
    Clocked.steps_after_the_limit = 0
