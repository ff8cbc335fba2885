"""Environments that are restored by taking the actions of their episode again."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, TimeLimit

from pgts_torch import PGTS
from pgts_torch.envs.retraced import Retraced
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models import check_model


class Drift(gymnasium.Env):
    """A number that drifts, at random where it goes up. It lies in an engine that does not pickle."""

    observation_space, action_space = spaces.Box(-np.inf, np.inf, (1,), np.float64), spaces.Discrete(2, start=1)

    @property
    def position(self) -> float:
        return self.engine()

    @position.setter
    def position(self, position: float) -> None:
        self.engine = lambda: position

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.position = self.np_random.normal()
        return np.array([self.position]), {}

    def step(self, action: int):
        self.position = self.position * 0.9 - 1 if action == 1 else self.position + self.np_random.normal()
        return np.array([self.position]), -abs(self.position), abs(self.position) > 5, False, {}


class Restored(Drift):
    def get_state(self):
        return self.position

    def set_state(self, state):
        self.position = state


class Remembers(Drift):
    """Its resets remember how many there were."""

    resets = 0

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        self.resets += 1
        self.position += self.resets
        return observation + self.resets, info


def walk(env: gymnasium.Env, actions: list[int]) -> list[tuple[float, float]]:
    return [(float(step[0][0]), float(step[1])) for step in map(env.step, actions)]


pytestmark = pytest.mark.filterwarnings("ignore:.*random steps whose outcomes its simulator does not enumerate")


@pytest.mark.parametrize("seed", [3, None])
def test_a_restored_state_goes_on_as_it_did(seed):
    env = Retraced(Drift())
    env.reset(seed=0)
    env.reset(seed=seed)
    walk(env, [1, 2, 2, 1])
    state, drawn_from = env.get_state(), env.np_random.bit_generator.state
    went_on = walk(env, [2, 1, 2])
    later = env.get_state()
    other = Retraced(Drift())
    other.reset(seed=9)
    walk(other, [1])
    for restored in (env, other):
        restored.set_state(state)
        assert restored.get_state() == state
        restored.np_random.bit_generator.state = drawn_from
        assert walk(restored, [2, 1, 2]) == went_on
        assert restored.get_state() == later


def test_chance_of_a_step_is_that_of_the_generator_and_is_retraced_with_it():
    env = Retraced(Drift())
    env.reset(seed=0)
    root = env.get_state()
    ends = {}
    for key in (5, 6):
        env.set_state(root)
        env.np_random = np.random.default_rng(key)
        steps, state = walk(env, [2, 1, 2]), env.get_state()
        ends[state] = steps[-1], walk(env, [1])
    assert len(ends) == 2
    for state, (last, after) in ends.items():
        env.np_random = np.random.default_rng(0)
        before = env.np_random.bit_generator.state
        env.set_state(state)
        assert env.np_random.bit_generator.state == before
        assert env.unwrapped._env.position == last[0]
        assert walk(env, [1]) == after


def test_a_state_on_the_way_is_not_begun_from_a_reset():
    env = Retraced(Drift())
    env.reset(seed=0)
    states = [env.get_state()]
    for _ in range(4):
        walk(env, [1])
        states.append(env.get_state())
    assert env.retraced == 0
    env.set_state(states[2])
    assert env.retraced == 2
    env.set_state(states[4])
    assert env.retraced == 4
    env.set_state(states[4])
    assert env.retraced == 4


def test_after_a_step_that_failed_nothing_of_it_is_left():
    env = Retraced(Drift())
    env.reset(seed=0)
    states = [env.get_state()]
    for _ in range(2):
        walk(env, [1])
        states.append(env.get_state())
    position = env._env.position
    for fails in (lambda: env.step(1), lambda: env.set_state(states[2])):
        env.set_state(states[1])
        moved = env._env.step
        env._env.step = lambda action, moved=moved: (moved(action), 1 / 0)  # halfway
        with pytest.raises(ZeroDivisionError):
            fails()
        env._env.step = moved
        env.set_state(states[2])
        assert env._env.position == position


def test_what_an_episode_draws_by_itself_takes_no_room():
    env = Retraced(Drift())
    env.reset(seed=0)
    begun = len(env.get_state())
    walk(env, [2] * 20)
    assert len(env.get_state()) - begun <= 20 * 20


def test_it_can_serve_as_a_model_where_its_attributes_cannot():
    with pytest.raises(MissingModel, match="goes on differently at step 1"):
        check_model(Drift)
    assert check_model(lambda: Retraced(Drift()))
    assert check_model(lambda: TimeLimit(Retraced(FrameStackObservation(Drift(), 3)), 10))


def test_resets_that_remember_earlier_episodes_are_found():
    short = {"num_envs": 1, "horizon": {"type": "fixed", "length": 6}, "depth": 0, "seed": 0, "policy": "mlp"}
    with pytest.raises(MissingModel, match="Retraced cannot serve as a model: a restored state goes on differently"):
        PGTS(lambda: Retraced(Remembers()), **short, search={"type": "sampled", "samples": 1}).learn(100)


def test_a_training_comes_to_the_same_as_with_get_state():
    search = {"type": "sampled", "samples": 2}
    short = {"num_envs": 2, "horizon": {"type": "fixed", "length": 6}, "depth": 1, "search": search, "seed": 0}
    trained = [PGTS(env, **short).learn(24) for env in (Restored, lambda: Retraced(Restored()))]
    ours, theirs = (model.policy.state_dict() for model in trained)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_registered_environment_keeps_its_time_limit_outside():
    env = gymnasium.make("retraced/Env-v0", env="CartPole-v1", render_mode="rgb_array")
    assert isinstance(env.unwrapped, Retraced)
    env.reset(seed=0)
    assert env.render().shape == (400, 600, 3)
    steps = [env.step(step % 2)[3] for step in range(3)]
    assert steps == [False, False, False]
    short = TimeLimit(env.unwrapped, 2)
    short.reset(seed=0)
    assert [short.step(0)[3] for _ in range(2)] == [False, True]


def test_a_module_of_the_user_registers_what_is_retraced(tmp_path, monkeypatch):
    (tmp_path / "drifts_of_mine.py").write_text(
        "import gymnasium\nfrom gymnasium.envs.classic_control import CartPoleEnv\n"
        "gymnasium.register('Mine-v3', CartPoleEnv, max_episode_steps=7)\n"
    )
    monkeypatch.chdir(tmp_path)
    model = PGTS("retraced/Env-v0", env_kwargs={"env": "drifts_of_mine:Mine-v3"}, depth=0)
    assert model.source.time_limit == 7
    model.close()


def test_what_cannot_be_retraced_is_refused():
    with pytest.raises(PgtsError, match=r"needs the id of an environment: --env\.kwargs\.env LunarLander-v3"):
        PGTS("retraced/Env-v0", depth=0)
    with pytest.raises(PgtsError, match=r"takes a gymnasium\.Env, not type"):
        Retraced(Drift)
    env = Drift()
    env.action_space = spaces.Text(3)
    with pytest.raises(PgtsError, match="Drift cannot be retraced: its actions are Text"):
        Retraced(env)


def test_box2d_gets_a_lookahead():
    pytest.importorskip("Box2D")
    env = {"env": "retraced/Env-v0", "env_kwargs": {"env": "LunarLander-v3"}}
    search = {"type": "sampled", "samples": 1}
    short = {"num_envs": 2, "horizon": {"type": "fixed", "length": 10}, "max_roots": 4, "seed": 0}
    model = PGTS(**env, **short, depth=0, search=search, policy="mlp").learn(40)
    assert model.num_model_calls > 0
