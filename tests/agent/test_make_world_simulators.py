"""Which model an environment gets, and which it does not: dynamics, adapters and simulators."""

import functools
import random
import time
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.envs.toy_text.blackjack import BlackjackEnv

from pgts_torch.agent.world import ModelWorld
from pgts_torch.agent.worlds import SimulatedWorld
from pgts_torch.models import check_model
from tests.agent.cells import Walk, agrees, refusal_of, vector_of, world_of
from tests.models import corridors

# Dynamics and adapters


class Halved(CartPoleEnv):
    def step(self, action: int) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, reward / 2, *rest


def test_a_subclass_without_a_state_of_its_own_is_restored_and_not_taken_for_its_family():
    world = world_of(Halved)
    assert isinstance(world, SimulatedWorld)
    assert agrees(world, [0, 1, 1, 0])
    replaced = world_of(steered)
    assert isinstance(replaced, SimulatedWorld)
    assert agrees(replaced, [0, 1, 1, 0])


def steered() -> gymnasium.Env:
    env: Any = gymnasium.make("CartPole-v1")
    env.unwrapped.step = functools.partial(lambda step, action: step(1 - action), env.unwrapped.step)
    return env


def test_dynamics_are_held_to_the_step_of_a_class_that_was_replaced_as_a_whole(monkeypatch):
    usual = CartPoleEnv.step
    monkeypatch.setattr(CartPoleEnv, "step", lambda self, action: usual(self, 1 - action))
    world = world_of("CartPole-v1")
    assert isinstance(world, SimulatedWorld)
    assert agrees(world, [0, 1, 1, 0])


class Battery(CartPoleEnv):
    """Keeps a charge in one of several ways; `left` is what is left of it."""

    kept: Any = None

    def reset(self, **options: Any) -> Any:
        self.charge(5)
        return super().reset(**options)

    def step(self, action: int) -> Any:
        observation, reward, ends, *rest = super().step(action)
        return observation, reward, ends or self.used() <= 0, *rest

    def charge(self, amount: int) -> None:
        self.kept = amount

    def used(self) -> int:
        self.kept -= 1
        return self.kept


class InArray(Battery):
    def charge(self, amount: int) -> None:
        self.kept = np.array([amount])

    def used(self) -> int:
        self.kept[0] -= 1
        return int(self.kept[0])


class InDict(Battery):
    def charge(self, amount: int) -> None:
        self.kept = {"battery": [None] * amount}

    def used(self) -> int:
        self.kept["battery"].pop()
        return len(self.kept["battery"])


class Cell:
    def __init__(self, amount: int) -> None:
        self.amount = amount


class InObject(Battery):
    def charge(self, amount: int) -> None:
        self.kept = Cell(amount)

    def used(self) -> int:
        self.kept.amount -= 1
        return self.kept.amount


class InClass(Battery):
    def charge(self, amount: int) -> None:
        InClass.kept = amount

    def used(self) -> int:
        InClass.kept -= 1
        return InClass.kept


class Heavier(CartPoleEnv):
    """Its own constant is its state."""

    def step(self, action: int) -> Any:
        self.gravity += 0.1
        return super().step(action)


class Stretched(CartPoleEnv):
    """Each episode has a pole of its own."""

    def reset(self, **options: Any) -> Any:
        answer = super().reset(**options)
        self.length = float(self.np_random.uniform(0.3, 0.7))
        return answer


class Counting(BlackjackEnv):
    def step(self, action: int) -> Any:
        self.count = getattr(self, "count", 0) + 1
        observation, reward, *rest = super().step(action)
        return observation, reward - self.count, *rest


class AnyPole(CartPoleEnv):
    def __init__(self) -> None:
        super().__init__()
        self.gravity = random.uniform(5, 15)


@pytest.mark.fault("a subclass with a state of its own beside the snapshots of its family")
@pytest.mark.parametrize(
    ("make", "name"),
    [
        *((kind, "kept") for kind in (Battery, InArray, InDict, InObject, InClass)),
        (Heavier, "gravity"),
        (Stretched, "length"),
        (lambda: wrappers.FlattenObservation(Counting()), "count"),
    ],
)
def test_a_subclass_with_a_state_of_its_own_is_told_to_write_two_methods(make, name):
    refusal = refusal_of(make)
    assert f"{name} changes in its steps or resets and is in no snapshot of" in refusal
    assert "the methods get_state(self)" in refusal


def test_constants_that_each_instance_draws_for_itself_are_refused():
    assert "each instance has its own gravity, which is in no snapshot" in refusal_of(AnyPole)


# Simulators


class Idle(Walk):
    def set_state(self, state: Any) -> None:
        pass


class Trembling(Walk):
    def set_state(self, state: Any) -> None:
        self.position = max(0, min(3, state + int(self.np_random.integers(-1, 2))))


class Mazes(Walk):
    """Where episodes end is drawn when an instance is made."""

    def __init__(self) -> None:
        self.goal = random.randint(2, 4)

    def step(self, action: int) -> Any:
        observation, *_ = super().step(action)
        return observation, 1.0, self.position == self.goal, False, {}


class Goals(Mazes):
    """Where an episode ends is drawn in reset."""

    def reset(self, **options: Any) -> Any:
        answer = super().reset(**options)
        self.goal = int(self.np_random.integers(2, 5))
        return answer


class Shared(Walk):
    box = [0]  # noqa: RUF012

    def step(self, action: int) -> Any:
        self.box[0] += 1
        observation, reward, *rest = super().step(action)
        return observation, reward + self.box[0], *rest


@pytest.mark.fault("get_state or set_state that does not hold what step reads or changes")
@pytest.mark.parametrize("make", [corridors.Forgetful, Idle, Trembling, Goals, Mazes, Shared])
def test_a_simulator_that_does_not_go_on_as_before_is_refused(make):
    assert f"{make.__name__} cannot serve as a model: a restored state goes on differently" in refusal_of(make)
    assert not isinstance(world_of(make, plain=True), ModelWorld)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (corridors.GlobalGenerator, "step draws from the global generator of random"),
        (lambda: corridors.GlobalGenerator("numpy"), "step draws from the global generator of numpy"),
        (corridors.OwnGenerator, "attribute dice is a generator of its own"),
        (corridors.Clairvoyant, "attribute box.0.dice is a generator of its own"),
        (corridors.Prophet, "get_state returns the generator too"),
        (corridors.SharedPlace, "a search changes the real environment"),
    ],
)
def test_a_simulator_whose_chance_or_state_is_not_its_own_is_refused(make, why):
    assert f"cannot serve as a model: {why}" in refusal_of(make)


def test_an_environment_that_is_slow_is_tried_in_few_steps():
    steps = 0

    class Slow(Walk):
        def step(self, action: int) -> Any:
            nonlocal steps
            steps += 1
            time.sleep(0.02)
            return super().step(action)

    assert isinstance(world_of(Slow), SimulatedWorld)
    assert steps < 60


def test_the_search_for_a_model_changes_no_environment_and_no_global_generator():
    states = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # type: ignore[index]  # noqa: NPY002
    vector = vector_of(Walk, Walk)
    vector.reset(seed=1)
    before = [(env.position, env.np_random.bit_generator.state) for env in vector.envs]  # type: ignore[attr-defined]
    world_of(vector)
    refusal_of(corridors.GlobalGenerator)
    assert [(env.position, env.np_random.bit_generator.state) for env in vector.envs] == before  # type: ignore[attr-defined]
    assert states == (random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist())  # type: ignore[index]  # noqa: NPY002


def test_an_error_of_the_environment_in_a_trial_is_left_to_the_training():
    class Falling(Walk):
        def step(self, action: int) -> Any:
            raise RuntimeError("it fell")

    assert isinstance(world_of(Falling), SimulatedWorld)


@pytest.mark.parametrize(
    ("ours", "make"),
    [
        ("restoring.sample_keys", Walk),
        ("restoring.bits", Walk),
        ("attributes.different", InDict),
        ("wrapper_trial.fingerprint", lambda: wrappers.FlattenObservation(Walk())),
        ("trial.number_of", lambda: gymnasium.make("CartPole-v1")),
    ],
)
def test_an_error_of_our_own_in_a_trial_is_not_taken_for_one_of_the_environment(ours, make, monkeypatch):
    def broken(*args: Any, **kwargs: Any) -> Any:
        raise IndexError("a bug of ours")

    monkeypatch.setattr(f"pgts_torch.models.{ours}", broken)
    with pytest.raises(IndexError, match="a bug of ours"):
        world_of(make)
    if ours.startswith("restoring"):
        with pytest.raises(IndexError, match="a bug of ours"):
            check_model(make)
