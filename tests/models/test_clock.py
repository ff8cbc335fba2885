"""MiniGrid's count of steps: transitions are remembered without it, and nothing that a search sees depends on that."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TransformReward
from torch import Tensor

pytest.importorskip("minigrid", exc_type=ImportError)

from minigrid.envs import DoorKeyEnv, DynamicObstaclesEnv, EmptyEnv, RedBlueDoorEnv

from pgts_torch.models import SimulatorModel, check_model, clocks, simulator
from pgts_torch.models.adapters_minigrid import MiniGrid
from pgts_torch.models.exact_model import CONTRADICTED, Happened
from pgts_torch.search import expectimax
from pgts_torch.seeding import sample_keys, stream

GAMMA = 0.95


class Impatient(DoorKeyEnv):
    """Its door opens by itself at the tenth step."""

    def step(self, action):
        if self.step_count == 9:
            door = next(cell for cell in self.grid.grid if cell is not None and cell.type == "door")
            door.is_open, door.is_locked = True, False
        return super().step(action)


class Doubled(EmptyEnv):
    """It makes another reward of the one that reads the clock."""

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, 2 * reward, *rest


class Late(EmptyEnv):
    """It pays late arrivals more, by a formula of its own."""

    def _reward(self):
        return self.step_count**2 / 7


class Shown(EmptyEnv):
    """The count can be seen."""

    def gen_obs(self):
        observation = super().gen_obs()
        observation["image"][0, 0, 0] = self.step_count % 200
        return observation


class Strict(EmptyEnv):
    """An episode also ends early, at the fifth step."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated or self.step_count == 5, info


APART: dict[str, Callable[[], gymnasium.Env]] = {
    "empty": lambda: EmptyEnv(size=5, max_steps=9),
    "door": lambda: DoorKeyEnv(size=5, max_steps=12),
    "two doors": lambda: RedBlueDoorEnv(size=8, max_steps=9),
    "wrapped": lambda: TransformReward(EmptyEnv(size=5, max_steps=9), lambda reward: 3 * reward - 1),
    "doubled": lambda: Doubled(size=5, max_steps=9),
}
KEPT: dict[str, Callable[[], gymnasium.Env]] = {
    "impatient": lambda: Impatient(size=5),
    "late": lambda: Late(size=5, max_steps=9),
    "shown": lambda: Shown(size=5, max_steps=9),
    "strict": lambda: Strict(size=5, max_steps=9),
}


def zeros(state_N: Tensor) -> Tensor:
    return torch.zeros(len(state_N), dtype=torch.float64)


def image(observation: Any) -> Any:
    return observation["image"]


def walked(make: Callable[[], gymnasium.Env], seed: int, count: int) -> gymnasium.Env:
    """An environment whose clock stands at a count, after turns to the left."""
    env = make()
    env.reset(seed=seed)
    for _ in range(count):
        env.step(0)
    return env


def searched(make: Callable[[], gymnasium.Env], envs: list[gymnasium.Env], depth: int) -> tuple[SimulatorModel, Any]:
    model = SimulatorModel(make, gamma=GAMMA, observe=image)
    root_B = model.roots(envs, [env.unwrapped.gen_obs() for env in envs])
    return model, expectimax(model, root_B, depth=depth, v_leaf=zeros)


def with_the_clock_kept(monkeypatch: pytest.MonkeyPatch, *arguments: Any) -> tuple[SimulatorModel, Any]:
    with monkeypatch.context() as patch:
        patch.setattr(simulator, "trusted_clock", lambda stepper: None)
        return searched(*arguments)


def test_paths_of_other_lengths_to_one_place_cost_no_calls_and_change_no_value(monkeypatch):
    envs = [walked(lambda: DoorKeyEnv(size=5), seed, 0) for seed in range(10)]
    arguments = lambda: DoorKeyEnv(size=5), envs, 8
    model, look = searched(*arguments)
    kept, expected = with_the_clock_kept(monkeypatch, *arguments)
    assert (model.simulator_steps, kept.simulator_steps) == (1218, 4781)
    assert torch.equal(look.q_BA, expected.q_BA)
    assert look.q_BA.max() > 0  # the goal, whose reward reads the clock, is among what is seen
    assert look.nodes_per_level == expected.nodes_per_level


@pytest.mark.parametrize("make", [*APART.values(), *KEPT.values()], ids=[*APART, *KEPT])
def test_a_search_sees_what_it_sees_with_the_clock_kept(make, monkeypatch):
    # Roots at several counts, so that the limit is met at several levels.
    envs = [walked(make, seed, count) for seed, count in ((0, 0), (0, 4), (0, 7), (1, 3), (0, 1))]
    model, look = searched(make, envs, 5)
    kept, expected = with_the_clock_kept(monkeypatch, make, envs, 5)
    assert torch.equal(look.q_BA, expected.q_BA)
    assert model.num_states == kept.num_states
    state_N = torch.arange(model.num_states)
    assert torch.equal(model.is_cut(state_N), kept.is_cut(state_N))
    assert np.array_equal(model.observations(state_N), kept.observations(state_N))
    assert [model.snapshot(s).name for s in state_N] == [kept.snapshot(s).name for s in state_N]
    is_apart = make in APART.values()
    assert (model.simulator_steps < 0.7 * kept.simulator_steps) == is_apart
    assert (model.simulator_steps == kept.simulator_steps) != is_apart


@pytest.mark.parametrize(("make", "passes"), [(APART["door"], True), (KEPT["impatient"], False)])
def test_check_model_says_whether_the_clock_can_be_kept_apart(make, passes):
    report = check_model(make, continuations=4, length=6)
    (check,) = (check for check in report.checks if check.name == "clock")
    assert report.usable
    assert check.passed == passes
    assert ("depends on step_count, as at 9" in report.verdict) != passes


def test_a_step_that_contradicts_what_was_found_at_another_count_says_that_it_depends_on_the_clock(monkeypatch):
    monkeypatch.setattr(clocks, "_COUNTS", 0)  # nothing is tried, so the clock is trusted
    make = KEPT["impatient"]
    env = walked(make, 0, 8)
    model = SimulatorModel(make, gamma=GAMMA, observe=image)
    root = model.root(env)
    model.outcomes(torch.tensor([model.root(walked(make, 0, 0)), root]))
    numbers = [root]
    for _ in range(3):
        env.step(6)  # does nothing
        numbers.append(model.root(env))
    before, after = np.array(numbers[:2]), np.array(numbers[1:3])
    rest = np.full(2, 6), np.zeros(2), np.full(2, GAMMA)
    happened = Happened(before, *rest, after, np.ones(2, bool))
    assert model.outcome_of(happened).tolist() == [0, CONTRADICTED]
    text = model.contradiction(happened.part(slice(1, None)))
    assert "as at another step_count, on which it depends: give Impatient the methods get_state" in text


def test_chance_that_keys_decide_is_drawn_at_every_count(monkeypatch):
    make = lambda: DynamicObstaclesEnv(size=5, n_obstacles=1)  # noqa: E731
    model = SimulatorModel(make, gamma=GAMMA, observe=image)
    state_N = model.roots([walked(make, 0, 0)]).expand(20)
    action_N, key_N = torch.zeros(20, dtype=torch.int64), sample_keys(20, generator=stream(0, "keys"))
    sample = model.sample(state_N, action_N, key_N=key_N)
    assert model.simulator_steps == 20
    assert len(sample.next_state_N.unique()) > 1


@pytest.mark.parametrize(("kind", "merges"), [(DoorKeyEnv, True), (Impatient, False)])
def test_where_a_reset_has_put_an_object_matters_only_to_code_that_may_read_it(kind, merges):
    env, adapter, snapshots = kind(size=5), MiniGrid(), []
    env.reset(seed=0)
    key = next(cell for cell in env.grid.grid if cell is not None and cell.type == "key")
    for start in ((1, 1), (1, 2)):
        key.init_pos = start
        snapshots.append(adapter.get_state(env))
    assert (snapshots[0].key == snapshots[1].key) == merges
    adapter.set_state(env, snapshots[0].data)
    (restored,) = (cell for cell in env.grid.grid if cell is not None and cell.type == "key")
    assert restored.init_pos == (1, 1)
