"""Wrappers are looked through, applied to the answers of a model, or refused."""

import functools
import math
import random
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces, wrappers

from pgts_torch.agent.worlds import DynamicsWorld, SimulatedWorld, TabularWorld
from pgts_torch.errors import MissingModel
from pgts_torch.models import SimulatorModel
from pgts_torch.options.environment import Observed
from tests.agent.cells import FIRST, Cells, Walk, agrees, reached, refusal_of, row_of_cells, world_of


def cart() -> gymnasium.Env:
    return gymnasium.make("CartPole-v1")


def tenth(reward: Any) -> Any:
    return reward / 10


# Refused


class Skipping(gymnasium.ActionWrapper):
    def action(self, action: Any) -> Any:
        return action

    def step(self, action: Any) -> Any:
        total = 0.0
        for _ in range(4):
            observation, reward, ends, *rest = self.env.step(action)
            total += float(reward)
            if ends:
                break
        return observation, total, ends, *rest


class Alternating(gymnasium.ActionWrapper):
    turn = 0

    def action(self, action: Any) -> Any:
        self.turn += 1
        return (action + self.turn) % 2


class Slipping(gymnasium.ActionWrapper):
    def action(self, action: Any) -> Any:
        return action if random.random() < 0.9 else 1 - action


class Steering(gymnasium.ActionWrapper):
    def action(self, action: Any) -> Any:
        return action if self.unwrapped.state[0] > 0 else 1 - action  # type: ignore[attr-defined]


class Growing(gymnasium.RewardWrapper):
    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.paid = [0]

    def reward(self, reward: Any) -> Any:
        self.paid[0] += 1
        return reward + self.paid[0]


class Positioned(gymnasium.RewardWrapper):
    def reward(self, reward: Any) -> Any:
        return reward + float(self.unwrapped.state[0])  # type: ignore[attr-defined]


class Noisy(gymnasium.ObservationWrapper):
    def observation(self, observation: Any) -> Any:
        return observation + np.random.normal(size=observation.shape)  # noqa: NPY002


class Resetting(gymnasium.ObservationWrapper):
    def observation(self, observation: Any) -> Any:
        return observation

    def reset(self, **options: Any) -> Any:
        return super().reset(**options)


class Doubling(wrappers.TimeLimit):
    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, 2 * float(reward), *rest


def replaced() -> gymnasium.Env:
    env: Any = wrappers.TransformReward(cart(), tenth)
    env.step = functools.partial(lambda step, action: step(1 - action), env.step)
    return env


@pytest.mark.fault("a wrapper that has a step of its own, a memory, or draws")
@pytest.mark.parametrize(
    ("wrap", "name", "why"),
    [
        (Alternating, "Alternating", "which remembers something from step to step"),
        (Growing, "Growing", "which remembers something from step to step"),
        (Slipping, "Slipping", "which makes different things of the same action"),
        (Noisy, "Noisy", "which makes different things of the same observation"),
        (wrappers.NormalizeReward, "NormalizeReward", "whose running statistics are neither saved"),
        (wrappers.NormalizeObservation, "NormalizeObservation", "whose running statistics are neither saved"),
    ],
)
def test_a_wrapper_that_remembers_episodes_or_draws_from_elsewhere_is_refused_by_name(wrap, name, why):
    assert f"is wrapped in {name}, {why}" in refusal_of(lambda: wrap(cart()))


@pytest.mark.parametrize(
    ("wrap", "name", "why"),
    [
        (Skipping, "Skipping", "which may change what a step gives"),
        (lambda env: Doubling(env, 100), "Doubling", "which may change what a step gives"),
        (Resetting, "Resetting", "which may change what a step gives"),
        (lambda _: replaced(), "TransformReward", "which may change what a step gives"),
        (Steering, "Steering", "which makes different things of the same action"),
        (Positioned, "Positioned", "which makes different things of the same reward"),
        (lambda env: wrappers.FrameStackObservation(env, 3), "FrameStackObservation", "which may change"),
        (wrappers.TimeAwareObservation, "TimeAwareObservation", "which may change"),
        (lambda env: wrappers.DelayObservation(env, 2), "DelayObservation", "which may change"),
        (lambda env: wrappers.RepeatAction(env, 2), "RepeatAction", "which may change"),
        (wrappers.Autoreset, "Autoreset", "which may change"),
    ],
)
def test_a_wrapper_that_does_more_than_transform_single_answers_is_part_of_the_simulator(wrap, name, why):
    make = lambda: wrappers.FlattenObservation(wrap(cart()))  # noqa: E731
    with pytest.warns(UserWarning, match=f"wrappers that are part of the model: .*is wrapped in {name}, {why}"):
        world = world_of(make)
    assert type(world) is SimulatedWorld
    assert agrees(world, [1, 0])  # not to the end of an episode, which some of these step beyond


def test_simulators_refuse_such_wrappers_too():
    with pytest.raises(MissingModel, match="is wrapped in Skipping"):
        SimulatorModel(lambda: Skipping(Walk()), gamma=0.9)


def test_a_wrapper_around_several_environments_leaves_them_without_a_model():
    vector = gymnasium.wrappers.vector.TransformReward(
        gymnasium.vector.SyncVectorEnv([Walk], autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED), tenth
    )
    assert "a simulator needs a SyncVectorEnv" in refusal_of(vector)


# Looked through


class Talking(gymnasium.Wrapper):
    """Has more methods, and the same steps."""

    def talk(self) -> str:
        return "hello"


def test_wrappers_that_change_nothing_are_looked_through():
    world = world_of(lambda: wrappers.RecordEpisodeStatistics(Talking(cart())))
    assert isinstance(world, DynamicsWorld)
    assert agrees(world, [0, 1, 1])


# Applied


class ThreeOfTwo(gymnasium.ActionWrapper):
    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.action_space = spaces.Discrete(3)

    def action(self, action: Any) -> Any:
        return (1, 0, 1)[action]


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (lambda: wrappers.TransformReward(cart(), tenth), DynamicsWorld),
        (lambda: wrappers.ClipReward(gymnasium.make("Acrobot-v1"), -0.5, 0.5), DynamicsWorld),
        (lambda: wrappers.FlattenObservation(cart()), DynamicsWorld),
        (lambda: wrappers.RescaleObservation(mountain(), np.float32(-1), np.float32(1)), DynamicsWorld),
        (lambda: wrappers.TransformObservation(cart(), abs, None), DynamicsWorld),
        (lambda: wrappers.DiscretizeObservation(mountain(), 10), DynamicsWorld),
        (lambda: wrappers.TransformReward(wrappers.FlattenObservation(Walk()), tenth), SimulatedWorld),
        (lambda: wrappers.TransformObservation(Walk(), lambda seen: 2 * seen, spaces.Box(-9, 9, (1,))), SimulatedWorld),
        (lambda: wrappers.TransformAction(Walk(), lambda action: 1 - action, None), SimulatedWorld),
        (lambda: wrappers.TransformAction(cart(), lambda action: 1 - action, None), DynamicsWorld),
        (lambda: ThreeOfTwo(cart()), DynamicsWorld),
        (lambda: ThreeOfTwo(Cells(row_of_cells(), starts=FIRST)), TabularWorld),
        (lambda: wrappers.TransformReward(Cells(row_of_cells(), starts=FIRST), tenth), TabularWorld),
        (lambda: wrappers.TransformAction(Cells(row_of_cells(), starts=FIRST), lambda a: 1 - a, None), TabularWorld),
        (lambda: wrappers.TransformReward(gymnasium.make("pgts/Ladder-v0"), lambda r: r - 1), TabularWorld),
        (lambda: wrappers.TransformAction(gymnasium.make("pgts/Ladder-v0"), lambda a: 1 - a, None), TabularWorld),
    ],
)
def test_a_model_says_what_happens_through_stateless_wrappers(make: Callable[[], gymnasium.Env], kind):
    world = world_of(make)
    assert type(world) is kind
    assert agrees(world, [1, 1, 0, 1, 0, 0, 1])


def mountain() -> gymnasium.Env:
    return gymnasium.make("MountainCar-v0")


def test_what_is_read_through_wrappers_depends_on_them():
    # A control for the test above: without its wrapper the model would say something else.
    world, bare = (world_of(make) for make in (lambda: wrappers.TransformReward(cart(), tenth), cart))
    rewards = [one.model.outcomes(reached(one)[0]).reward_NA for one in (world, bare)]
    assert torch.equal(rewards[0], rewards[1] / 10)
    assert not agrees_crosswise(world, bare)


def agrees_crosswise(world: Any, bare: Any) -> bool:
    state, _ = reached(bare)
    reached(world)
    _, reward, *_ = world.env.step(np.zeros(2, dtype=int))
    return float(bare.model.outcomes(state).reward_NA[0, 0]) == float(reward[0])


def test_what_wrappers_make_of_rewards_is_made_of_those_of_each_outcome():
    # A lake whose goal pays 1 with probability 1/3: the mean of r**3 - r is not that of the mean cubed.
    def cubed(reward: Any) -> float:
        return 8 * reward**3 - reward

    world = world_of(lambda: wrappers.TransformReward(gymnasium.make("FrozenLake-v1"), cubed))
    assert world.mdp.outcomes.reward_NA[14, 2] == pytest.approx(7 / 3, rel=1e-12)
    assert cubed(1 / 3) != pytest.approx(7 / 3)
    assert sorted(set(world.mdp.outcome_reward_SAK[14, 2].tolist())) == [0.0, 7.0]


def test_terminal_states_of_a_table_earn_nothing_whatever_a_wrapper_makes_of_0():
    world = world_of(lambda: wrappers.TransformReward(Cells(row_of_cells(), starts=FIRST), lambda reward: reward - 1))
    assert world.mdp.outcomes.reward_NA[:, 1].tolist() == [-1, -1, -1, -1, 0, 0]


def test_bounds_of_values_are_those_of_the_transformed_rewards():
    world = world_of(lambda: wrappers.TransformReward(cart(), lambda reward: 3 * reward - 1))
    assert world.model.highest_value == pytest.approx(2 / (1 - 0.9))
    assert world.model.lowest_value == pytest.approx(-1 / (1 - 0.9))
    swing = world_of(
        lambda: wrappers.TransformReward(wrappers.DiscretizeAction(gymnasium.make("Pendulum-v1"), 3), tenth)
    )
    assert (swing.model.lowest_value, swing.model.highest_value) == (-math.inf, math.inf)


def test_a_specification_with_wrappers_makes_them():
    spec = wrappers.TransformReward(cart(), tenth).spec
    world = world_of(spec)
    assert isinstance(world, DynamicsWorld)
    assert agrees(world, [0, 1])


def test_images_and_dictionaries_are_seen_through_wrappers():
    pytest.importorskip("minigrid")
    from minigrid.wrappers import FullyObsWrapper, ImgObsWrapper

    world = world_of(lambda: ImgObsWrapper(gymnasium.make("MiniGrid-Empty-5x5-v0")))
    assert agrees(world, [2, 1, 2])
    # What this one shows depends on more of the environment than on the observation inside.
    with pytest.warns(UserWarning, match="is wrapped in FullyObsWrapper, which makes different things"):
        world = world_of(
            lambda: FullyObsWrapper(gymnasium.make("MiniGrid-Empty-5x5-v0")),
            observed=Observed(observation_keys=["image"]),
        )
    assert agrees(world, [2, 1, 2])
