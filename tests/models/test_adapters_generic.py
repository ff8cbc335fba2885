"""Environments without get_state: their attributes are pickled, where that is enough and as long as it is."""

import collections
import copy
import dataclasses
import functools
import itertools
import random
import threading
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from pgts_torch import PGTS
from pgts_torch.errors import MissingModel, ModelMismatch, PgtsError
from pgts_torch.models import SimulatorModel, check_model
from pgts_torch.models.adapters import same_content
from pgts_torch.models.adapters_generic import PickledAttributes
from pgts_torch.seeding import sample_keys, stream
from tests.models.corridors import Bare, Corridor, Dice

pytestmark = [
    pytest.mark.usefixtures("unchecked_shapes"),
    pytest.mark.filterwarnings("ignore:.*has no get_state. its attributes are pickled"),
]

SHORT = {"depth": 2, "num_envs": 2, "horizon": {"type": "fixed", "length": 30}, "seed": 3}


class Board:
    """What an environment may be made of: parts that know each other, the environment and its generator."""

    def __init__(self, env):
        self.env, self.cells, self.random = env, np.zeros(4, np.int64), env.np_random
        self.first, self.space = self, env.action_space


class Parts(gymnasium.Env):
    """Pieces fall on a board, at random or as chosen. It holds a window that no pickle takes."""

    observation_space = spaces.Box(-9, 9, (4,), np.float64)

    def __init__(self):
        self.action_space, self.window = spaces.Discrete(3), threading.Lock()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.board, self.late = Board(self), None
        return self.board.cells.astype(float), {}

    def step(self, action):
        cells = self.board.first.cells
        cells[action if action < 2 else int(self.board.env.board.random.integers(4))] += 1
        if cells.sum() == 3:
            self.late = [cells]
        if self.late:
            self.late[0][3] = cells.sum()
        return cells.astype(float), float(cells[0]), bool(cells.max() > 5), False, {}


def test_a_lookahead_from_pickled_attributes_is_that_of_methods_of_its_own():
    own, pickled = (PGTS(lambda kind=kind: kind(slip=0), **SHORT) for kind in (Corridor, Bare))
    assert isinstance(pickled.world.model.adapter, PickledAttributes)
    for _ in range(2):
        one, other = own.iterate(), pickled.iterate()
        assert torch.equal(one.look.q_BA, other.look.q_BA)
        assert one.look.nodes_per_level == other.look.nodes_per_level  # states merge as well
        assert torch.equal(own.policy.probs(one.observation_N), pickled.policy.probs(other.observation_N))


def test_parts_that_refer_to_each_other_to_the_environment_and_to_its_generator_are_restored():
    report = check_model(Parts)
    assert report.usable
    assert report.family == "its attributes, pickled"
    assert 0 < report.random_share < 1
    adapter, one, other = PickledAttributes(), Parts(), Parts()
    for env in (one, other):
        env.reset(seed=1)
    for action in (0, 0, 1, 1):
        one.step(action)
    adapter.set_state(other, adapter.get_state(one).data)
    assert adapter.left_out == {"window"}
    assert other.board.env is other
    assert other.board.random is other.np_random
    assert other.board.space is other.action_space
    assert other.late[0] is other.board.cells is not one.board.cells
    assert PGTS(Parts, **SHORT).iterate().model_calls > 0


class Road:
    """A road, whose cars know it and each other."""

    def __init__(self, *speeds):
        self.cars = [Car(self, speed) for speed in speeds]
        for car, ahead in itertools.pairwise(self.cars):
            car.ahead, ahead.behind = ahead, [car]


class Car:
    def __init__(self, road, speed):
        self.road, self.speed, self.ahead, self.behind = road, speed, None, []


def test_objects_that_lead_back_to_themselves_are_compared():
    assert same_content(Road(*range(2000)), Road(*map(np.float64, range(2000))))
    assert not same_content(Road(1, 2, 3), Road(1, 2, 4))
    assert not same_content(Road(1, 2), Road(1, 2, 3))
    ring: list = [1.0]
    longer: list = [1.0]
    ring.append(ring)
    longer.append([2.0, longer])
    assert same_content(ring, [1, (1, ring)])
    assert same_content(ring, ring[1])
    assert not same_content(ring, longer)
    shared = np.array([ring, None], object)
    assert same_content([shared, shared], [shared.copy(), np.array([[1, ring], None], object)])
    assert not same_content(shared, np.array([longer, None], object))


class Slotted:
    __slots__ = ("value",)

    def __init__(self, value):
        self.value = value

    def show(self):
        return self.value


def test_methods_slots_and_iterators_are_compared():
    assert same_content([Slotted(1), Slotted(1).show], [Slotted(1), Slotted(1).show])
    assert not same_content(Slotted(1), Slotted(2))
    assert not same_content(Slotted(1).show, Slotted(2).show)
    assert same_content(itertools.cycle([1, 2]), itertools.cycle([1, 2]))
    assert not same_content(itertools.cycle([1, 2]), iter([1, 2]))


@dataclasses.dataclass
class Level:
    """As dataclasses are, it is equal to another if a tuple of its fields is, of which arrays cannot be asked that."""

    cells: Any
    name: str = "first"


class Suited:
    """It calls equal what is not the same."""

    def __init__(self, rank, suit):
        self.rank, self.suit = rank, suit

    def __eq__(self, other):
        return self.rank == other.rank

    __hash__ = None


def test_objects_with_an_equality_of_their_own_are_looked_into():
    ones = Level(np.ones(3)), Level(torch.ones(3)), Level({"board": [np.ones(2), None, 1.5]})
    for level in ones:
        assert same_content([level], [copy.deepcopy(level)])
        assert not same_content([level], [Level(np.zeros(3))])
        assert not same_content([level], [Level(level.cells, "second")])
    assert same_content(Suited(1, "hearts"), Suited(1, "hearts"))
    assert not same_content(Suited(1, "hearts"), Suited(1, "spades"))
    assert not same_content(collections.OrderedDict(a=1), collections.OrderedDict(a=2))
    assert not same_content({"a": {1, 2}}, {"a": {1, 3}})


class Bound(Bare):
    """It holds methods of its own, and an iterator that only a picture would read."""

    def __init__(self):
        super().__init__(slip=0)
        self.shown, self.later = self.look, functools.partial(self.look)
        self.frames = itertools.cycle([0, 1, 2, 1])

    def step(self, action):
        next(self.frames)
        super().step(action)
        return self.shown(), float(self.fuel), self.position == 0, False, {}


def test_an_environment_that_holds_its_methods_and_iterators_is_one_with_its_snapshots():
    training = PGTS(Bound, **SHORT | {"depth": 1})
    assert isinstance(training.world.model.adapter, PickledAttributes)
    training.iterate()
    training.iterate()


def test_its_cost_is_said():
    with pytest.warns(UserWarning, match=r"Bare has no get_state: its attributes are pickled, \d+ bytes and \d+ us a"):
        PGTS(Bare, **SHORT)


class Elsewhere(Bare):
    """A part of its state is in no attribute."""

    steps = itertools.count()

    def step(self, action):
        look, reward, *rest = super().step(action)
        return look, reward + next(self.steps) % 2, *rest


class OwnRandom(Bare):
    """It has a generator of a class of its own, which a restored state would foresee."""

    def __init__(self):
        super().__init__()
        self.dice = Dice(0)


@pytest.mark.parametrize(
    ("env", "why"),
    [(Elsewhere, "a restored state goes on differently"), (OwnRandom, "attribute dice is a generator of its own")],
)
def test_where_attributes_are_not_enough_the_two_methods_are_named_as_before(env, why):
    for use in (lambda: PGTS(env, **SHORT), lambda: check_model(env)):
        with pytest.raises(MissingModel, match=rf"give {env.__name__} the methods get_state.*are not enough: {why}"):
            use()


class Box:
    """Something that throws a die of its own."""

    def __init__(self, seed):
        self.dice = np.random.default_rng(seed)

    def throw(self):
        return int(self.dice.integers(6))


class Thrown(gymnasium.Env):
    """Each step shows what a die has thrown, which belongs to something that a reset makes."""

    observation_space, action_space = spaces.Discrete(6), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.box = self.made(seed)
        self.face = self.box.throw()
        return self.face, {}

    def made(self, seed):
        return Box(seed)

    def step(self, action):
        self.face = self.box.throw() if action else self.face
        return self.face, float(self.face), False, False, {}


class Holding(Thrown):
    """Its two methods hold the die."""

    def get_state(self):
        return self.box, self.face

    def set_state(self, state):
        self.box, self.face = state


class Legacy(Thrown):
    """Its np_random is one of legacy numpy."""

    def made(self, seed):
        self.np_random = np.random.RandomState(seed)
        return self

    def throw(self):
        return self.np_random.randint(6)


def test_np_random_that_is_no_generator_is_named():
    with pytest.raises(MissingModel, match=r"np_random is a RandomState; super\(\)\.reset\(seed=seed\) makes it"):
        PGTS(Legacy, **SHORT)


class OfPython(Thrown):
    """Dice of `random` and of legacy numpy, which its reset seeds, in lists and dictionaries; bits, and a method."""

    def __init__(self):
        self.dice = {"a": [random.Random(), np.random.RandomState()]}

    def made(self, seed):
        for dice in self.dice["a"]:
            dice.seed(seed)
        self.bits, self.choose = np.random.MT19937(seed), random.Random(seed).choice
        return self

    def throw(self):
        one, two = self.dice["a"]
        normal = int(100 * (one.gauss(0, 1) + two.normal()))  # both keep half of a pair of numbers
        drawn = one.randrange(2**70) + two.randint(6) + int(np.random.Generator(self.bits).integers(6)) + normal
        return (drawn + self.choose(range(6)) + one.randbytes(3)[1]) % 6


class Doubled(gymnasium.Wrapper):
    """Pays more by a coin of its own."""

    def reset(self, **given):
        self.coin = np.random.default_rng(given.get("seed"))
        return super().reset(**given)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward * (1 + int(self.coin.integers(2))), *rest


@pytest.mark.filterwarnings("ignore:.*a generator of its own. its", "ignore:.*wrappers that are part of the model")
@pytest.mark.parametrize("make", [Thrown, Holding, OfPython, lambda: Doubled(Thrown())])
def test_chance_of_generators_of_its_own_comes_from_the_keys_of_the_search(make):
    training = PGTS(make, **SHORT | {"depth": 0, "gamma": 0.5})
    model, env, twin = training.world.model, training.source.like(), training.source.like()
    for each in (env, twin):
        each.reset(seed=4)
    state = int(model.roots([env], [env.unwrapped.face])[0])
    key_N = sample_keys(3000, generator=stream(0, "keys"))
    states_N, throw_N = torch.full((3000,), state), torch.ones(3000, dtype=torch.int64)
    first, again = (model.sample(states_N, throw_N, key_N=key_N) for _ in range(2))
    faces = torch.tensor(model.observations(first.next_state_N)).reshape(-1)
    assert torch.equal(first.next_state_N, again.next_state_N)
    assert torch.bincount(faces, minlength=6).tolist() == pytest.approx([500] * 6, abs=100)  # five deviations
    assert model.is_random(states_N[:2], torch.tensor([0, 1])).tolist() == [
        env is not env.unwrapped,  # the wrapper draws for both actions
        True,
    ]
    for _ in range(20):  # nothing that the search did has moved the die of the environment
        assert env.step(1)[:2] == twin.step(1)[:2]
    assert check_model(make).usable


class Late(Bare):
    """After some thousand steps of all instances it pays otherwise."""

    steps = 0

    def __init__(self):
        super().__init__(slip=0)

    def step(self, action):
        look, reward, *rest = super().step(action)
        Late.steps += 1
        return look, reward + 5 * (Late.steps > 20_000), *rest


def test_an_environment_whose_attributes_turn_out_not_to_be_its_state_is_found_in_training():
    model = PGTS(Late, **SHORT | {"depth": 0})
    model.iterate()
    Late.steps = 20_000
    with pytest.raises(ModelMismatch):
        model.learn(5_000)


class Rising(gymnasium.Wrapper):
    """Rewards rise with the steps of an episode, and so does what is observed."""

    def reset(self, **kwargs):
        self.steps = 0
        observation, info = super().reset(**kwargs)
        return observation, info

    def step(self, action):
        self.steps += 1
        observation, reward, *rest = super().step(action)
        return observation + self.steps, reward * self.steps, *rest


def test_wrappers_that_remember_belong_to_the_simulator():
    """By hand: what they give in two steps from where three steps of an episode have led."""
    make = lambda: gymnasium.wrappers.TimeLimit(Rising(gymnasium.wrappers.TimeLimit(Corridor(slip=0), 50)), 20)  # noqa: E731
    with pytest.warns(
        UserWarning, match="Corridor has wrappers that are part of the model: their attributes are pickled"
    ):
        training = PGTS(make, **SHORT | {"gamma": 0.5})
    model, env, twin = training.world.model, training.source.like(), training.source.like()
    for each in (env, twin):
        each.reset(seed=4)
        for action in (1, 0, 0):
            observation, *_ = each.step(action)
    outcomes = model.outcomes(model.roots([env], [observation]))
    below = model.outcomes(outcomes.child_NAK[0, :, 0])
    for first, second in itertools.product((0, 1), (0, 1)):
        env = training.source.like()
        env.reset(seed=4)
        steps = [env.step(action) for action in (1, 0, 0, first, second)]
        assert float(outcomes.reward_NA[0, first]) == steps[3][1]
        assert float(below.reward_NA[first, second]) == steps[4][1]
        seen = model.observations(outcomes.child_NAK[0, first])
        assert np.array_equal(np.asarray(seen[0]), steps[3][0])
    assert twin.step(0)[1] == float(outcomes.reward_NA[0, 0])  # what the search did has not touched it
    assert check_model(make).usable


@pytest.mark.filterwarnings(
    "ignore:.*has wrappers that are part of the model", "ignore:.*has random steps whose outcomes"
)
@pytest.mark.parametrize("depth", [0, 2])
def test_frames_that_are_stacked_and_actions_that_stick_are_trained_with_a_lookahead(depth):
    def make():
        return gymnasium.wrappers.FlattenObservation(
            gymnasium.wrappers.FrameStackObservation(gymnasium.make("CartPole-v1"), 3)
        )

    model = PGTS(make, **SHORT | {"depth": depth})
    assert model.world.observation_space.shape == (12,)
    assert model.iterate().model_calls > 0
    sticky = lambda: gymnasium.wrappers.StickyAction(gymnasium.make("CartPole-v1"), 0.25)  # noqa: E731
    report = check_model(sticky)
    assert report.usable
    assert 0.05 < report.random_share
    training = PGTS(sticky, **SHORT | {"depth": 1})
    training.iterate()
    assert str(training.search).startswith("sampled")


@pytest.mark.filterwarnings("ignore:.*has wrappers that are part of the model")
def test_atari_as_it_is_used_can_serve_as_a_model_with_its_stack_in_the_state():
    for package in ("ale_py", "cv2"):
        pytest.importorskip(package, exc_type=ImportError)

    def make():
        env = gymnasium.make("ALE/Breakout-v5", frameskip=1, repeat_action_probability=0)
        env = gymnasium.wrappers.AtariPreprocessing(env, noop_max=3, screen_size=21)
        return gymnasium.wrappers.StickyAction(gymnasium.wrappers.FrameStackObservation(env, 4), 0.25)

    report = check_model(make, continuations=2, length=5)
    assert report.usable
    assert [check.passed for check in report.checks if check.name == "merge"] == [True]
    assert report.random_share > 0


class Buffered(gymnasium.Wrapper):
    """Its rewards are those of the step before, and its buffer holds anything before the first episode, as that of
    AtariPreprocessing does."""

    numbers = itertools.count()

    def __init__(self, env):
        super().__init__(env)
        self.buffer = float(next(self.numbers))

    def reset(self, **kwargs):
        self.last = self.buffer = 0.0
        return self.env.reset(**kwargs)

    def step(self, action):
        observation, self.buffer, *rest = self.env.step(action)
        paid, self.last = self.last, self.buffer
        return observation, paid, *rest


@pytest.mark.filterwarnings("ignore:.*has wrappers that are part of the model")
def test_what_a_wrapper_of_each_instance_has_of_its_own_is_restored_with_the_others():
    model = PGTS(lambda: Buffered(gymnasium.make("CartPole-v1")), **SHORT | {"depth": 1})
    assert model.iterate().model_calls > 0


class Hoarder(Rising):
    """It goes on counting in the next episode."""

    def reset(self, **kwargs):
        self.steps = getattr(self, "steps", 0)
        return self.env.reset(**kwargs)


def test_a_wrapper_that_remembers_earlier_episodes_is_refused():
    with pytest.raises(MissingModel, match="remembers something from one episode to the next"):
        PGTS(lambda: Hoarder(Corridor(slip=0)), **SHORT)


def test_without_the_model_check_nothing_is_guessed():
    with pytest.raises(
        PgtsError, match=r"model_check is off, but it alone tells.*leave it on, or give Bare the methods"
    ):
        PGTS(Bare, **SHORT, model_check="off")
    with pytest.raises(MissingModel, match="give Bare the methods get_state"):
        SimulatorModel(Bare, gamma=0.9)
