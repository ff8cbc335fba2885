"""Snapshots: a restored simulator goes on as the one it was taken from, bit for bit."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

from pgts_torch.errors import MissingModel
from pgts_torch.models.actions import all_actions, sampled_actions
from pgts_torch.models.adapters import ClassicControl, OwnState, ToyText, adapter_for
from pgts_torch.models.adapters_minigrid import NO_STATE
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.minigrid_pickles import text_of
from pgts_torch.models.minigrid_templates import Template
from pgts_torch.models.snapshots import SnapshotAdapter, generator_state, reseed
from pgts_torch.seeding import numpy_stream
from tests.models.corridors import Bare, Corridor, Forgetful, InBytes

CORE = [
    "FrozenLake-v1",
    "CliffWalking-v1",
    "CliffWalkingSlippery-v1",
    "Taxi-v4",
    "Blackjack-v1",
    "CartPole-v1",
    "Acrobot-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
]
EXTRAS = {
    "MiniGrid-Empty-5x5-v0": "minigrid",
    "MiniGrid-DoorKey-6x6-v0": "minigrid",
    "MiniGrid-Dynamic-Obstacles-5x5-v0": "minigrid",
    "BabyAI-GoToObj-v0": "minigrid",
    "ALE/Breakout-v5": "ale_py",
    "ALE/Pong-v5": "ale_py",
    "InvertedPendulum-v5": "mujoco",
    "Reacher-v5": "mujoco",
    "Pusher-v5": "mujoco",
    "Ant-v5": "mujoco",
    "Humanoid-v5": "mujoco",
}
KWARGS: dict[str, dict[str, Any]] = {
    "Taxi-v4": {"is_rainy": True, "fickle_passenger": True},
    "ALE/Breakout-v5": {"repeat_action_probability": 0.0},
    "ALE/Pong-v5": {"repeat_action_probability": 0.0, "frameskip": (2, 5), "obs_type": "ram"},
}


def made(id: str) -> gymnasium.Env:
    if id in EXTRAS:
        pytest.importorskip(EXTRAS[id], exc_type=ImportError)
    return EnvSource.of(id, kwargs=KWARGS.get(id, {})).make_one()


def actions_of(env: gymnasium.Env) -> list[Any]:
    space = env.action_space
    return sampled_actions(space, 5, seed=0) if isinstance(space, gymnasium.spaces.Box) else list(all_actions(space))


def frozen(value: Any) -> Any:
    """A value that is equal only to the same bits."""
    if isinstance(value, dict):
        return {name: frozen(part) for name, part in value.items()}
    return pickle.dumps(np.asarray(value))


def walk(env: Any, actions: list[Any]) -> list[Any]:
    """What these actions give, up to an end."""
    seen = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append((frozen(observation), float(reward), bool(terminated), bool(truncated)))
        if terminated or truncated:
            break
    return seen


def survives(make: Callable[[], gymnasium.Env], adapter: SnapshotAdapter, walks: int = 4, length: int = 12) -> bool:
    """Whether walks go on the same after their start was restored: in a fresh instance, again in it, and in the first
    one. The walk that is compared with is not interrupted by a restoration."""
    random = numpy_stream(0, "survives")
    first, second = make().unwrapped, make().unwrapped
    second.reset(seed=99)
    actions = actions_of(first)
    for n in range(walks):
        first.reset(seed=n)
        walk(first, [actions[random.integers(len(actions))] for _ in range(2 * n)])
        chosen = [actions[random.integers(len(actions))] for _ in range(length)]
        start = adapter.get_state(first)
        adapter.seed(first, n)
        expected, end = walk(first, chosen), adapter.get_state(first).name
        for other in (second, second, first):
            adapter.set_state(other, start.data)
            adapter.seed(other, n)
            if walk(other, chosen) != expected or adapter.get_state(other).name != end:
                return False
    return True


@pytest.mark.parametrize("id", [*CORE, *EXTRAS])
def test_a_restored_simulator_goes_on_the_same_bit_for_bit(id, monkeypatch):
    def refuse(*_: Any) -> None:
        raise AssertionError("deepcopy")

    made(id)  # making a pickled or wrapped environment is not what is tested
    env, other = made(id), made(id)
    monkeypatch.setattr(copy, "deepcopy", refuse)
    instances = iter([env, other])
    assert survives(lambda: next(instances), adapter_for(env))


@pytest.mark.parametrize("make", [Corridor, InBytes])
def test_an_environment_of_ones_own_is_restored_by_its_two_methods(make):
    assert isinstance(adapter_for(make()), OwnState)
    assert survives(make, OwnState())


def test_a_forgotten_variable_is_found():
    assert not survives(Forgetful, OwnState())


class Muddy(FrozenLakeEnv):
    """A lake in which every third step costs something."""

    count = 0

    def step(self, action):
        self.count += 1
        observation, reward, *rest = super().step(action)
        return observation, reward - (self.count % 3 == 0), *rest


class Honest(Muddy):
    def get_state(self):
        return int(self.s), self.count

    def set_state(self, state):
        self.s, self.count = state


def test_a_subclass_of_a_toy_text_with_a_step_of_its_own_needs_methods_of_its_own():
    with pytest.raises(MissingModel, match=r"step is overridden by Muddy.*give Muddy the methods get_state"):
        adapter_for(Muddy())
    assert not survives(Muddy, ToyText())
    assert survives(Honest, adapter_for(Honest()))


@pytest.mark.parametrize("id", ["CliffWalking-v1", "MiniGrid-Empty-5x5-v0", "MiniGrid-DoorKey-6x6-v0"])
def test_two_ways_to_a_state_give_equal_snapshots(id):
    # Left and right again; right and left again. In CliffWalking from the start: up, right, left and up, up, down.
    env = made(id).unwrapped
    ways = ([0, 1, 3, 2], [0, 0, 2, 2]) if id == "CliffWalking-v1" else ([0, 1, 3, 4], [1, 0, 3, 4])
    adapter, ends = adapter_for(env), []
    env.reset(seed=1)
    start = adapter.get_state(env)
    for way in ways:
        adapter.set_state(env, start.data)
        walk(env, way)
        ends.append(adapter.get_state(env))
    assert ends[0].name == ends[1].name
    # MiniGrid counts its steps, apart from the rest.
    assert (ends[0].key, ends[0].name == start.name) == (start.key, id == "CliffWalking-v1")
    walk(env, [0])
    assert adapter.get_state(env).key != ends[0].key


def whole_text(env: Any) -> bytes:
    """All values of a state of MiniGrid by the slow way, which pickles them."""
    return text_of({name: value for name, value in vars(env).items() if name not in NO_STATE}, env, but={"init_pos"})


@pytest.mark.parametrize(
    "id", ["MiniGrid-DoorKey-5x5-v0", "MiniGrid-ObstructedMaze-1Dlhb-v0", "MiniGrid-Fetch-5x5-N2-v0", "BabyAI-Open-v0"]
)
def test_templates_tell_the_states_of_minigrid_apart_as_pickles_do(id):
    env, random = made(id).unwrapped, numpy_stream(0, "templates", id)
    adapter, texts, keys = adapter_for(env), dict[bytes, bytes](), dict[bytes, bytes]()
    for seed in (0, 1, 2, 0):
        env.reset(seed=seed)
        for _ in range(40):
            snapshot, text = adapter.get_state(env), whole_text(env)
            assert texts.setdefault(snapshot.key, text) == text
            assert keys.setdefault(text, snapshot.key) == snapshot.key
            adapter.set_state(env, snapshot.data)
            assert (whole_text(env), adapter.get_state(env).key) == (text, snapshot.key)
            # Picking up, dropping and toggling change what lies in the grid.
            env.step(int(random.choice([0, 1, 2, 2, 2, 3, 4, 5])))
    assert len(texts) > 20


def test_only_what_a_step_has_changed_is_read_again(monkeypatch):
    env = made("MiniGrid-DoorKey-5x5-v0").unwrapped
    env.reset(seed=0)
    adapter, read, real = adapter_for(env), list[str](), Template.__init__
    snapshot = adapter.get_state(env)
    monkeypatch.setattr(Template, "__init__", lambda *args: read.append(args[1].type) or real(*args))
    adapter.set_state(env, snapshot.data)
    adapter.get_state(env)
    assert read == []
    (door,) = (cell for cell in env.grid.grid if cell is not None and cell.type == "door")
    door.is_locked = False
    changed = adapter.get_state(env)
    assert read == ["door"]
    assert changed.key != snapshot.key
    adapter.set_state(env, snapshot.data)
    assert adapter.get_state(env).key == snapshot.key


def test_an_object_that_lies_in_two_cells_is_one_object_when_it_is_restored():
    env = made("MiniGrid-DoorKey-5x5-v0").unwrapped
    env.reset(seed=0)
    (key,) = (cell for cell in env.grid.grid if cell is not None and cell.type == "key")
    env.grid.grid[env.grid.grid.index(None)] = key
    adapter = adapter_for(env)
    adapter.set_state(env, adapter.get_state(env).data)
    first, second = (cell for cell in env.grid.grid if cell is not None and cell.type == "key")
    assert first is second


@pytest.mark.parametrize("id", [*CORE, "MiniGrid-Dynamic-Obstacles-5x5-v0", "Ant-v5"])
def test_a_snapshot_is_taken_without_a_trace_and_holds_no_generator(id):
    env = made(id).unwrapped
    env.reset(seed=4)
    adapter = adapter_for(env)
    before, first = generator_state(env), adapter.get_state(env)
    assert adapter.get_state(env).key == first.key
    assert generator_state(env) == before
    reseed(env, 77)
    assert generator_state(env) != before
    assert adapter.get_state(env).key == first.key


def test_neighbouring_keys_seed_independent_generators():
    env, other = Corridor(), Corridor()
    drawn = []
    for key in (*range(-500, 500), 2**63 - 1, -(2**63)):
        reseed(env, key)
        reseed(other, key)
        drawn.append(env.np_random.random())
        assert other.np_random.random() == drawn[-1]
    assert len(set(drawn)) == len(drawn)
    # Under independence each of these is beyond 5 standard errors with a probability below 6e-7.
    assert abs(np.mean(drawn) - 0.5) < 5 / np.sqrt(12 * len(drawn))
    assert abs(np.corrcoef(drawn[:-1], drawn[1:])[0, 1]) < 5 / np.sqrt(len(drawn))


def test_a_generator_of_another_kind_is_replaced():
    env = Corridor()
    env.np_random = np.random.Generator(np.random.MT19937(0))
    reseed(env, 5)
    first = env.np_random.random(3)
    reseed(env, 5)
    assert np.array_equal(env.np_random.random(3), first)


def test_an_environment_without_an_adapter_is_told_what_to_implement():
    with pytest.raises(MissingModel) as refusal:
        adapter_for(Bare())
    assert str(refusal.value) == (
        "Bare cannot be restored: give Bare the methods get_state(self), which returns all that step reads or changes "
        "except self.np_random (bytes, or what pickles), and set_state(self, state), which puts it back; or wrap it in "
        "pgts_torch.envs.Retraced (retraced/Env-v0), which restores a state by a reset and all actions since then"
    )


def test_an_emulator_whose_actions_stick_is_refused_with_the_remedy():
    pytest.importorskip("ale_py", exc_type=ImportError)
    with pytest.raises(
        MissingModel,
        match=r"stick with probability 0\.25.*repeat_action_probability=0, and .* wrap it in .*StickyAction",
    ):
        adapter_for(EnvSource.of("ALE/Breakout-v5").make_one())


def test_positions_and_velocities_alone_do_not_restore_ant():
    mujoco = pytest.importorskip("mujoco", exc_type=ImportError)

    class Naive(SnapshotAdapter):
        name = "naive"

        def get_state(self, env):
            state = np.concatenate([env.data.qpos, env.data.qvel]).tobytes()
            return type(adapter_for(env).get_state(env))(state, state)

        def set_state(self, env, data):
            env.data.qpos[:], env.data.qvel[:] = np.split(np.frombuffer(data), [env.model.nq])
            mujoco.mj_forward(env.model, env.data)

    assert not survives(lambda: made("Ant-v5"), Naive())


@pytest.mark.parametrize(("dtype", "shape"), [(np.float64, (4,)), (np.float64, (2, 2)), (np.float32, (4,))])
def test_a_snapshot_of_classic_control_outlives_writing_into_the_state(dtype, shape):
    env, adapter = CartPoleEnv(), ClassicControl()
    env.state = np.arange(4, dtype=dtype).reshape(shape)
    snapshot = adapter.get_state(env)
    for _ in range(2):
        env.state += 1
        assert adapter.get_state(env).name != snapshot.name
        adapter.set_state(env, snapshot.data)
        assert (env.state.dtype, env.state.tolist()) == (dtype, np.arange(4).reshape(shape).tolist())
        assert (env.steps_beyond_terminated, adapter.get_state(env).name) == (None, snapshot.name)
