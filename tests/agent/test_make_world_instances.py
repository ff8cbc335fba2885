"""Models of environments that differ from each other or from the instance that was given."""

import functools
import operator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.wrappers import RepeatAction, TimeLimit, TransformReward

from pgts_torch.agent.worlds import DynamicsWorld, SimulatedWorld, TabularWorld
from pgts_torch.errors import PgtsError
from pgts_torch.models import SimulatorModel
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.fidelity import check_model
from pgts_torch.models.wrappers import wrappers_of
from tests.agent.cells import Walk, agrees, heavier, refusal_of, vector_of, world_of


class Longer(Walk):
    n = 7


def longer() -> gymnasium.Env:
    env = Walk()
    env.n = 7
    return env


@pytest.mark.fault("environments that differ, or differ from the instance that was given")
@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: gymnasium.make("FrozenLake-v1", map_name=None), "given as an instance with another P"),
        (lambda: functools.partial(FrozenLakeEnv, map_name=None), "each instance has its own P"),
        (
            lambda: vector_of(FrozenLakeEnv, lambda: FrozenLakeEnv(is_slippery=False)),
            "environment 1 of FrozenLakeEnv has another P",
        ),
        (lambda: vector_of(Walk, Longer), "the environments of Walk are of different classes"),
        (lambda: vector_of(Walk, longer), "environment 1 of Walk has n = 7, where another instance has 5"),
        (
            lambda: vector_of(lambda: gymnasium.make("CartPole-v1"), heavier),
            r"environment 1 of CartPole-v1 has gravity = 20, where another instance has 9\.8",
        ),
    ],
)
def test_where_environments_differ_no_model_is_used(make, why):
    assert why.replace("\\", "") in refusal_of(make())


def test_an_instance_that_was_changed_is_refused_by_the_attribute():
    for make in (world_of, lambda env: SimulatorModel(env, gamma=0.9), check_model):
        with pytest.raises(PgtsError, match=r"gravity = 20, where another instance has 9\.8 of its spec: give a func"):
            make(heavier())
    lake = gymnasium.make("FrozenLake-v1")
    lake.unwrapped.P[14][2] = [(1.0, 15, 5.0, True)]  # type: ignore[attr-defined]
    assert "another P" in refusal_of(lake)
    steered: Any = gymnasium.make("CartPole-v1")
    steered.unwrapped.step = functools.partial(lambda step, action: step(1 - action), steered.unwrapped.step)
    assert "another step" in refusal_of(steered)


class Aim(Walk):
    """It is set in the first reset, and stays."""

    metadata, render_mode = {"render_modes": ["ansi"], "render_fps": 4}, "ansi"

    def __init__(self) -> None:
        super().__init__()
        self.aim: int | None = None
        self.drawn = ""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.aim = 3 if self.aim is None else self.aim
        return super().reset(seed=seed)

    def render(self) -> Any:
        self.drawn = "a picture"
        return self.drawn


gymnasium.register("Aim-v0", Aim)


def aimed(env: Any) -> Any:
    env.unwrapped.aim = 7
    return env


@pytest.mark.parametrize("num_envs", [1, 2])
def test_what_only_the_first_reset_sets_is_an_attribute_that_may_differ(num_envs):
    assert isinstance(world_of(gymnasium.make("Aim-v0"), num_envs=num_envs), SimulatedWorld)
    assert "given as an instance with aim = 7, where another instance has 3" in refusal_of(
        aimed(gymnasium.make("Aim-v0")), num_envs=num_envs
    )
    envs: Any = vector_of(*[lambda: aimed(Aim())] * num_envs)
    assert isinstance(world_of(envs), SimulatedWorld)
    envs = vector_of(*[Aim] * num_envs)
    aimed(envs.envs[-1])
    assert f"environment {num_envs - 1} of Aim has aim = 7, where another instance has 3" in refusal_of(envs)


def test_others_than_the_environments_that_were_given_are_not_evaluated_in():
    envs: Any = vector_of(Aim, lambda: aimed(Aim()))
    source = EnvSource.of(envs)
    assert [env.aim for env in source.make(4).envs] == [None, 7, None, 7]  # type: ignore[attr-defined]
    envs.reset(seed=0)
    envs.step(np.zeros(2, dtype=int))
    source.make(4)
    envs.envs[0].aim = 5
    with pytest.raises(PgtsError, match="environment 0 of Aim has aim = 5, where another instance has 3: others come"):
        source.make(4)


def test_an_instance_that_was_rendered_or_is_in_an_episode_is_not_changed():
    env = gymnasium.make("Aim-v0")
    env.reset(seed=0)
    env.step(0)
    env.render()
    assert isinstance(world_of(env), SimulatedWorld)


class Chained(Walk):
    """It holds a chain of objects that is longer than Python's recursion."""

    def __init__(self, last: int = 0) -> None:
        self.chain: Any = [last]
        for _ in range(1_500):
            self.chain = {"next": self.chain, "other": set}


def test_instances_are_compared_to_the_end_of_long_chains_of_objects():
    assert isinstance(world_of(vector_of(Chained, Chained)), SimulatedWorld)
    assert "environment 1 of Chained has another chain" in refusal_of(vector_of(Chained, lambda: Chained(last=1)))


def test_two_wrappers_of_a_kind_are_both_held_to_the_spec():
    lake, louder = gymnasium.make("FrozenLake-v1"), functools.partial(operator.mul, 2)
    for k in range(2):
        env: Any = TransformReward(TransformReward(lake, louder), louder)
        assert isinstance(world_of(env), TabularWorld)
        (env if k else env.env).func = operator.neg
        assert "func" in refusal_of(env)


def test_a_function_that_gives_the_same_environment_again_is_refused():
    env = gymnasium.make("CartPole-v1")
    for num_envs in (1, 2):
        refused = refusal_of(lambda: env, num_envs=num_envs)
        assert "gave the same environment twice; the function that makes it must make a new one each time" in refused
    assert "gave the same environment twice" in refusal_of(vector_of(lambda: env))


def test_an_instance_that_was_only_used_is_not_changed_and_a_function_may_change_what_it_makes():
    used = gymnasium.make("CartPole-v1")
    used.reset(seed=3)
    used.step(0)
    assert isinstance(world_of(used), DynamicsWorld)
    world = world_of(heavier)
    assert isinstance(world, DynamicsWorld)
    assert agrees(world, [0, 1, 1, 0])


def test_an_instance_that_its_spec_cannot_make_again_is_refused_with_the_way_out():
    class Louder(gymnasium.RewardWrapper):
        def reward(self, reward: Any) -> Any:
            return 2 * reward

    assert "its spec cannot make again" in refusal_of(Louder(gymnasium.make("CartPole-v1")))
    assert agrees(world_of(lambda: Louder(gymnasium.make("CartPole-v1"))), [0, 1])


@pytest.mark.parametrize(("limits", "shortest"), [((100,), 100), ((9_000,), 500), ((100, 30, 200), 30)])
def test_time_limits_around_an_instance_that_has_one_are_the_shortest_of_them(limits, shortest):
    env = gymnasium.make("CartPole-v1")
    for limit in limits:
        env = TimeLimit(env, limit)
    source = EnvSource.of(env)
    assert source.time_limit == shortest
    assert [made._max_episode_steps for made in wrappers_of(source.make_one()) if isinstance(made, TimeLimit)] == [
        shortest
    ]
    assert isinstance(world_of(env), DynamicsWorld)
    env.unwrapped.gravity = 20  # type: ignore[attr-defined]
    assert "gravity = 20, where another instance has 9.8" in refusal_of(env)
    skipping = TimeLimit(RepeatAction(gymnasium.make("CartPole-v1"), 2), 100)
    assert "TimeLimit in RepeatAction" in refusal_of(skipping)  # its spec counts the steps that are repeated
