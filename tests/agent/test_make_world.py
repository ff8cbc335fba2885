"""Which model an environment gets, and which it does not: only one that was written for what runs."""

import functools
import random
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces, wrappers
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.envs.toy_text.blackjack import BlackjackEnv
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from pgts_torch.agent.make_world import make_world
from pgts_torch.agent.world import DynamicsWorld, PlainWorld, SimulatedWorld, TabularWorld, World
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models import SimulatorModel
from pgts_torch.models.fidelity import check_model
from pgts_torch.tabular import exact

KEYWORDS: dict[str, Any] = {"num_envs": 2, "gamma": 0.9, "observation_key": None, "plain": False, "device": "cpu"}
N = 6


def world_of(env: Any, **options: Any) -> World:
    return make_world(env, **KEYWORDS | options)


def refusal_of(env: Any, **options: Any) -> str:
    with pytest.raises(PgtsError) as refused:
        world_of(env, **options)
    return str(refused.value)


def vector_of(*makers: Callable[[], gymnasium.Env]) -> SyncVectorEnv:
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)


def reached(world: World) -> tuple[torch.Tensor, torch.Tensor]:
    """The number of the state in which the first copy begins, and what it shows, after a reset with seed 0."""
    observation, _ = world.env.reset(seed=0)
    encoded, read = world.see(world.env, observation)
    return world.numbers(read)[:1], encoded[:1]


def agrees(world: World, actions: Sequence[int]) -> bool:
    """Whether the model says of each of these steps what then happens in the first copy: reward, and what it shows."""
    state, _ = reached(world)
    for action in actions:
        outcomes = world.model.outcomes(state)
        observation, reward, *_ = world.env.step(np.full(world.env.num_envs, action))
        state = outcomes.child_NAK[0, action, :1]
        shown = world.encode(observation)[:1].double()
        if float(outcomes.reward_NA[0, action]) != pytest.approx(float(reward[0]), rel=1e-9):
            return False
        if not torch.allclose(world.observe(state).double(), shown, atol=1e-6):
            return False
    return True


# Tables


def row_of_cells(n: int = N) -> dict[int, dict[int, list[tuple[float, int, float, bool]]]]:
    """Left and right along n cells; the last one pays 1 and ends."""
    P = {
        s: {0: [(1.0, max(0, s - 1), 0.0, False)], 1: [(1.0, s + 1, float(s == n - 2), s == n - 2)]}
        for s in range(n - 1)
    }
    return P | {n - 1: {a: [(1.0, n - 1, 0.0, True)] for a in (0, 1)}}


class Cells(gymnasium.Env):
    """A row of cells that publishes what it is told to."""

    def __init__(self, P: Any, *, starts: Any = None, slip: float = 0.0, pays: float = 1.0, begins: int = 1) -> None:
        self.P, self.position, self.slip, self.pays, self.begins = P, 0, slip, pays, begins
        if starts is not None:
            self.initial_state_distrib = starts
        self.observation_space, self.action_space = spaces.Discrete(N), spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = int(self.np_random.integers(self.begins))
        return self.position, {}

    def step(self, action: int) -> Any:
        if self.slip and self.np_random.random() < self.slip:
            action = 1 - action
        self.position = min(N - 1, max(0, self.position + 2 * int(action) - 1))
        ends = self.position == N - 1
        return self.position, self.pays * ends, ends, False, {}


FIRST = np.eye(N)[0]


class Shaped(FrozenLakeEnv):
    def step(self, action: int) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, reward - 0.1, *rest


class Costly:
    def step(self, action: int) -> Any:
        observation, reward, *rest = super().step(action)  # type: ignore[misc]
        return observation, reward - 1, *rest


class Mixed(Costly, CliffWalkingEnv):
    pass


class Elsewhere(FrozenLakeEnv):
    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        self.s = 6
        return 6, {}


class Encoded(TaxiEnv):
    def action_mask(self, state: int) -> Any:
        self.s = 0
        return super().action_mask(state)


class Chosen(FrozenLakeEnv):
    np_random = property(lambda self: np.random.default_rng(0), lambda self, value: None)  # type: ignore[assignment]


def patched() -> gymnasium.Env:
    env = gymnasium.make("FrozenLake-v1")
    inner: Any = env.unwrapped
    inner.step = functools.partial(lambda step, action: step((action + 1) % 4), inner.step)
    return env


@pytest.mark.fault("a table of transitions that is not that of step and reset")
@pytest.mark.parametrize(
    ("make", "why"),
    [
        (Shaped, "step is overridden by Shaped"),
        (Mixed, "step is overridden by Costly"),
        (Elsewhere, "reset is overridden by Elsewhere"),
        (Encoded, "action_mask is overridden by Encoded"),
        (Chosen, "np_random is overridden by Chosen"),
        (patched, "step was set on the instance"),
        (lambda: Cells(row_of_cells(), starts=FIRST, slip=0.1), r"after action \d in state \d came .* it has reward"),
        (lambda: Cells(row_of_cells(), starts=FIRST, pays=2.0), r"came reward 2, an end; it has reward 1, an end"),
        (lambda: Cells(row_of_cells(), starts=FIRST, begins=3), "it starts in state [12], which has probability 0"),
        (lambda: Cells(row_of_cells(N - 1), starts=FIRST), "is no transition table: start_S has shape"),
        (lambda: Cells(row_of_cells(N - 1)), r"is no transition table: reset|it has 5 states|it shows 5"),
    ],
)
def test_a_table_that_was_not_written_for_what_runs_is_not_used_and_the_reason_is_told(make, why):
    with pytest.raises(MissingModel, match=why):
        world_of(make)
    assert isinstance(world_of(make, plain=True), PlainWorld)  # where no model is needed there is no exact J either


def test_a_subclass_that_only_renders_keeps_the_table():
    class Seen(FrozenLakeEnv):
        def render(self) -> None:
            return None

    assert isinstance(world_of(Seen), TabularWorld)


@pytest.mark.parametrize(
    "env",
    [
        ("FrozenLake-v1", {"success_rate": 0.9}),
        ("FrozenLake-v1", {"reward_schedule": (10, -5, -0.1)}),
        ("CliffWalking-v1", {"is_slippery": True}),
        ("Taxi-v4", {"is_rainy": True}),
    ],
)
def test_options_that_the_table_has_keep_it(env):
    assert isinstance(world_of(env[0], **env[1]), TabularWorld)


def test_a_passenger_who_changes_his_mind_is_in_no_table_and_taxis_are_restored_from_snapshots():
    assert isinstance(world_of("Taxi-v4", fickle_passenger=True), SimulatedWorld)


@pytest.mark.parametrize(
    "P",
    [
        {s: {a: [(*rows[0], {})] for a, rows in each.items()} for s, each in row_of_cells().items()},
        {s: {a: [rows[0][:3]] for a, rows in each.items()} for s, each in row_of_cells().items()},
        {(0, s): each for s, each in row_of_cells().items()},
        np.full((2, N, N), 1 / N),
        0.8,
        lambda state, action: None,
        "P",
        [],
    ],
    ids=["rows of 5", "rows of 3", "tuples", "array", "number", "method", "text", "empty"],
)
def test_an_attribute_P_of_another_meaning_is_no_table(P):
    assert isinstance(world_of(lambda: Cells(P), plain=True), PlainWorld)
    assert "attribute P of Cells is no transition table" in refusal_of(lambda: Cells(P))


def test_an_attribute_of_another_meaning_beside_a_table_lays_no_picture_out():
    class Framed(Cells):
        shape = "wide"

    assert world_of(lambda: Framed(row_of_cells(), starts=FIRST)).mdp.shape == (1, N)


def test_more_actions_than_a_table_has_are_a_reason():
    class Three(Cells):
        def __init__(self) -> None:
            super().__init__(row_of_cells(), starts=FIRST)
            self.action_space = spaces.Discrete(3)

    assert "it has 2 actions, and its space is Discrete(3)" in refusal_of(Three)


def test_a_table_without_starts_takes_them_from_resets_and_says_so():
    with pytest.warns(UserWarning, match="Cells has a table P and no initial_state_distrib"):
        world = world_of(lambda: Cells(row_of_cells()))
    assert exact.optimal(world.mdp).J == pytest.approx(0.9 ** (N - 2), rel=1e-12)
    assert world.start_S is None
    with pytest.warns(UserWarning, match="start distribution is counted"):
        spread = world_of(lambda: Cells(row_of_cells(), begins=3))
    # 1,000 resets: 5 standard errors of a share of 1/3 are 0.075.
    assert spread.mdp.start_S[:3].tolist() == pytest.approx([1 / 3] * 3, abs=0.075)
    assert spread.mdp.start_S[3:].tolist() == [0] * (N - 3)


# Copies and instances


def heavier() -> gymnasium.Env:
    env = gymnasium.make("CartPole-v1")
    env.unwrapped.gravity = 20  # type: ignore[attr-defined]
    return env


class Walk(gymnasium.Env):
    """Right four times pays 1 and ends; restored by its own methods."""

    n = 5
    action_space, observation_space = spaces.Discrete(2), spaces.Box(-1, 10, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = 0
        return self.shown(), {}

    def shown(self) -> np.ndarray:
        return np.array([self.position], np.float32)

    def step(self, action: int) -> Any:
        self.position = max(0, self.position + (1 if action == 1 else -1))
        ends = self.position >= self.n - 1
        return self.shown(), float(ends), ends, False, {}

    def get_state(self) -> Any:
        return self.position

    def set_state(self, state: Any) -> None:
        self.position = state


class Longer(Walk):
    n = 7


def longer() -> gymnasium.Env:
    env = Walk()
    env.n = 7
    return env


@pytest.mark.fault("copies of an environment that differ, or differ from the instance that was given")
@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: gymnasium.make("FrozenLake-v1", map_name=None), "given as an instance with another P"),
        (lambda: functools.partial(FrozenLakeEnv, map_name=None), "each instance has its own P"),
        (
            lambda: vector_of(FrozenLakeEnv, lambda: FrozenLakeEnv(is_slippery=False)),
            "copy 1 of FrozenLakeEnv has another P",
        ),
        (lambda: vector_of(Walk, Longer), "the copies of Walk are of different classes"),
        (lambda: vector_of(Walk, longer), "copy 1 of Walk has n = 7, where another instance has 5"),
        (
            lambda: vector_of(lambda: gymnasium.make("CartPole-v1"), heavier),
            r"copy 1 of CartPole-v1 has gravity = 20, where another instance has 9\.8",
        ),
    ],
)
def test_where_copies_differ_no_model_is_used(make, why):
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


def test_an_instance_that_was_only_used_is_not_changed_and_a_function_may_change_what_it_makes():
    used = gymnasium.make("CartPole-v1")
    used.reset(seed=3)
    used.step(0)
    assert isinstance(world_of(used), DynamicsWorld)
    world = world_of(heavier)
    assert isinstance(world, DynamicsWorld)
    assert agrees(world, [0, 1, 1, 0])


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


class Forgetful(Walk):
    def reset(self, **options: Any) -> Any:
        self.fuel = 15
        return super().reset(**options)

    def step(self, action: int) -> Any:
        observation, reward, ends, *rest = super().step(action)
        self.fuel -= 1
        return observation, reward, ends or self.fuel <= 0, *rest


class Idle(Walk):
    def set_state(self, state: Any) -> None:
        pass


class Trembling(Walk):
    def set_state(self, state: Any) -> None:
        self.position = max(0, min(3, state + int(self.np_random.integers(-1, 2))))


class Global(Walk):
    def step(self, action: int) -> Any:
        return super().step(action if random.random() < 0.8 else 1 - action)


class GlobalNumpy(Walk):
    def step(self, action: int) -> Any:
        return super().step(action if np.random.rand() < 0.8 else 1 - action)  # noqa: NPY002


class OwnGenerator(Walk):
    def __init__(self) -> None:
        self.own = np.random.default_rng(1)

    def step(self, action: int) -> Any:
        return super().step(action if self.own.random() < 0.8 else 1 - action)


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


DIFFERENTLY = "a restored state goes on differently at step"


@pytest.mark.fault("get_state or set_state that does not hold what step reads or changes")
@pytest.mark.parametrize(
    ("make", "why"),
    [
        (Forgetful, DIFFERENTLY),
        (Idle, DIFFERENTLY),
        (Trembling, DIFFERENTLY),
        (Goals, DIFFERENTLY),
        (Mazes, DIFFERENTLY),
        (Shared, DIFFERENTLY),
        (Global, "step draws from the global generator of random"),
        (GlobalNumpy, "step draws from the global generator of numpy"),
        (OwnGenerator, "attribute own is a generator of its own"),
    ],
)
def test_a_simulator_that_cannot_be_restored_is_refused_in_the_words_of_check_model(make, why):
    assert f"{make.__name__} cannot serve as a model: {why}" in refusal_of(make)
    assert isinstance(world_of(make, plain=True), PlainWorld)


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


def test_what_is_drawn_and_done_while_models_are_sought_is_noticed_by_nobody():
    states = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # type: ignore[index]  # noqa: NPY002
    copies = vector_of(Walk, Walk)
    copies.reset(seed=1)
    before = [(env.position, env.np_random.bit_generator.state) for env in copies.envs]  # type: ignore[attr-defined]
    world_of(copies)
    refusal_of(Global)
    assert [(env.position, env.np_random.bit_generator.state) for env in copies.envs] == before  # type: ignore[attr-defined]
    assert states == (random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist())  # type: ignore[index]  # noqa: NPY002


def test_what_an_environment_raises_while_it_is_tried_is_told_by_the_training():
    class Falling(Walk):
        def step(self, action: int) -> Any:
            raise RuntimeError("it fell")

    assert isinstance(world_of(Falling), SimulatedWorld)
