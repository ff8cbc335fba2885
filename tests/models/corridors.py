"""An environment of a user's own, and what can be wrong with one."""

import itertools
import math
import random
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces


class Bare(gymnasium.Env):
    """Five cells in a row; each move takes fuel and may slip. The last cell and an empty tank are ends.

    It has no get_state and set_state.
    """

    def __init__(self, slip: float = 0.3) -> None:
        self.observation_space = spaces.Box(0, 100, (2,), np.float64)
        self.action_space = spaces.Discrete(2, start=5)
        self.slip, self.position, self.fuel = slip, 0, 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.position, self.fuel = int(self.np_random.integers(3)), 20.0
        return self.look(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict]:
        move = {5: -1, 6: 1}[action]
        if self.slip and self.draw() < self.slip:
            move = -move
        self.position = max(0, self.position + move)
        self.fuel -= 1
        return self.look(), self.fuel / 10, self.position == 4 or self.fuel <= 0, False, {}

    def draw(self) -> float:
        return self.np_random.random()

    def look(self) -> Any:
        return np.array([self.position, self.fuel])


class Corridor(Bare):
    """With the two methods that make it a model."""

    def get_state(self) -> Any:
        return self.position, self.fuel

    def set_state(self, state: Any) -> None:
        self.position, self.fuel = state


class InBytes(Corridor):
    """Its state is bytes."""

    def get_state(self) -> bytes:
        return bytes([self.position, int(self.fuel)])

    def set_state(self, state: bytes) -> None:
        self.position, self.fuel = state[0], float(state[1])


class Forgetful(Corridor):
    """Its fuel is no part of its state."""

    def get_state(self) -> Any:
        return self.position

    def set_state(self, state: Any) -> None:
        self.position = state


class Untidy(Corridor):
    """Its state never has the same bytes twice."""

    count: ClassVar = itertools.count()

    def get_state(self) -> Any:
        return self.position, self.fuel, next(self.count)

    def set_state(self, state: Any) -> None:
        self.position, self.fuel, _ = state


class Prophet(Corridor):
    """Its generator is a part of its state."""

    def get_state(self) -> Any:
        return self.position, self.fuel, self.np_random.bit_generator.state

    def set_state(self, state: Any) -> None:
        self.position, self.fuel, self.np_random.bit_generator.state = state


class Dice(random.Random):
    """A generator of a class of its own, which may have any methods; so none of a search can stand for it."""


class OwnGenerator(Corridor):
    """It draws from a generator of its own."""

    def __init__(self, slip: float = 0.3) -> None:
        super().__init__(slip)
        self.dice = Dice(0)

    def draw(self) -> float:
        return self.dice.random()


class Clairvoyant(Corridor):
    """It draws from a generator inside of something, which is a part of its state."""

    def __init__(self, slip: float = 0.3) -> None:
        super().__init__(slip)
        self.box = [{"dice": Dice(0)}]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        if seed is not None:
            self.box = [{"dice": Dice(seed)}]
        return super().reset(seed=seed)

    def draw(self) -> float:
        return self.box[0]["dice"].random()

    def get_state(self) -> Any:
        return self.position, self.fuel, self.box

    def set_state(self, state: Any) -> None:
        self.position, self.fuel, self.box = state


class Unseeded(Corridor):
    """Its seed does not decide where an episode begins."""

    count: ClassVar = itertools.count()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.position = next(self.count) % 3
        return self.look(), {}


class Stuck(Corridor):
    """It cannot be set to any state, and its episodes never end."""

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict]:
        return self.look(), 0.0, False, False, {}

    def set_state(self, state: Any) -> None:
        raise NotImplementedError("later")


class GlobalGenerator(Corridor):
    """It draws from a generator that all programs share."""

    def __init__(self, share: str = "random") -> None:
        super().__init__()
        self.share = share

    def draw(self) -> float:
        return {"random": random.random, "numpy": np.random.rand, "torch": lambda: float(torch.rand(()))}[self.share]()


class SharedPlace(Corridor):
    """All its instances have one position."""

    place: ClassVar = [0]

    @property
    def position(self) -> int:
        return self.place[0]

    @position.setter
    def position(self, value: int) -> None:
        self.place[0] = value


class Broken(Corridor):
    """Something goes wrong in cell 2."""

    def __init__(self, fault: str) -> None:
        super().__init__(slip=0.0)
        self.fault = fault

    def step(self, action: int) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        if self.position != 2:
            return observation, reward, terminated, truncated, info
        return {
            "raises": lambda: 1 / 0,
            "reward": lambda: (observation, math.nan, terminated, truncated, info),
            "observation": lambda: (np.array([math.nan, 1.0]), reward, terminated, truncated, info),
            "shape": lambda: (observation[:1], reward, terminated, truncated, info),
            "arity": lambda: (observation, reward, terminated, info),
        }[self.fault]()
