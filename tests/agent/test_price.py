"""What an iteration costs, foreseen from its first states."""

import functools
import itertools
import re
import time
from typing import Any

import pytest
import torch
from gymnasium import spaces

from pgts_torch import PGTS, compiled
from pgts_torch.agent import price
from pgts_torch.models.drawn_actions import DrawnActions
from pgts_torch.search.price import Meter
from tests.models.corridors import Corridor

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

FACTOR = 3.0
"""Within this factor the calls of an iteration are foreseen."""

FEW = {"num_envs": 3, "horizon": {"type": "fixed", "length": 40}}
NETWORK = FEW | {"policy": {"type": "mlp", "hidden": [8]}}
CARTPOLE = NETWORK | {"env": "CartPole-v1"}


class Counted(Corridor):
    """Its actions are counted from 0."""

    def __init__(self) -> None:
        super().__init__(slip=0)
        self.action_space = spaces.Discrete(2)

    def step(self, action: int):
        return super().step(action + 5)


class Far(Counted):
    """Its corridor does not end, and no two of its states are the same."""

    def step(self, action: int):
        self.fuel -= 1 / (3 + action)
        return self.look(), self.fuel, self.fuel <= 10, False, {}

    def reset(self, **kwargs):
        super().reset(**kwargs)
        self.fuel += float(self.np_random.random())
        return self.look(), {}


CASES: dict[str, dict[str, Any]] = {
    "paths that never meet": CARTPOLE | {"depth": 5},
    "paths that never meet, few levels": CARTPOLE | {"depth": 1, "num_envs": 8},
    "paths that meet, in a simulator": NETWORK | {"env": Counted, "depth": 6, "num_envs": 8},
    "many roots in a simulator": NETWORK | {"env": Far, "depth": 2, "num_envs": 4},
    "a tree search": CARTPOLE | {"depth": 6, "search": {"type": "mcts", "simulations": 20}},
    "a tree search that widens its nodes": {
        "env": "Pendulum-v1",
        "policy": "gaussian",
        "search": {"type": "mcts", "widening": 1, "simulations": 20},
        "depth": 3,
        "actions": 4,
        "replay": "none",
    }
    | FEW,
    "sampled outcomes": CARTPOLE | {"depth": 2, "search": {"type": "sampled", "samples": 2}},
    "few calls": CARTPOLE | {"depth": 6, "search": {"type": "auto", "max_calls": 1200}},
    "few states of a level": CARTPOLE | {"depth": 6, "search": {"type": "expectimax", "max_width": 30}},
    "few nodes": CARTPOLE | {"depth": 6, "search": {"type": "auto", "max_nodes": 2000}},
    "few roots": CARTPOLE | {"depth": 5, "max_roots": 20},
    "an adaptive depth": CARTPOLE | {"depth": "adaptive", "max_depth": 3, "reward_range": (0, 1)},
}


def ticking(
    model: PGTS, monkeypatch: pytest.MonkeyPatch, *, patience: float, tick: float = 1e-3
) -> tuple[list[int], list[int]]:
    """Have the clock of the price moved on by model calls: `tick` seconds for each state. How many states had been
    queried each time that the price was said; and in all, in a list of one number."""
    queried, said = [0], list[int]()
    known = model.world.model
    outcomes, sample = known.outcomes, getattr(known, "sample", None)

    def count(states: int) -> None:
        queried[0] += states

    def counted(state_N: torch.Tensor) -> Any:
        queried[0] += len(state_N)
        return outcomes(state_N)

    def sampled(state_N: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        queried[0] += len(state_N)
        return sample(state_N, *args, **kwargs)

    if isinstance(model.search.model, DrawnActions):  # each call for itself
        known, follow = model.search.model, model.search.model.follow
        outcomes, sample = known.outcomes, None
        monkeypatch.setattr(known, "follow", lambda *args: count(len(args[0])) or follow(*args))
    monkeypatch.setattr(known, "outcomes", counted)
    monkeypatch.setattr(known, "sample", sampled, raising=False)
    monkeypatch.setattr(price, "Meter", functools.partial(Meter, patience=patience, clock=lambda: tick * queried[0]))
    say = model.pricing.say
    monkeypatch.setattr(model.pricing, "say", lambda: said.append(queried[0]) or say())
    return said, queried


@pytest.mark.parametrize("case", CASES)
def test_the_calls_of_an_iteration_are_foreseen_before_they_are_made(case, monkeypatch, capsys):
    model = PGTS(**CASES[case])
    first = PGTS(**CASES[case]).iterate().look  # how many there are is known by now
    assert first is not None
    capsys.readouterr()
    said, queried = ticking(model, monkeypatch, patience=2e-4 * first.model_calls)
    iteration = model.iterate()
    told = model.pricing.price
    assert told is not None
    assert len(said) == 1
    assert said[0] < 0.75 * queried[0]
    assert iteration.model_calls / FACTOR < told.calls
    assert told.is_bound == ("tree search" in case)
    assert told.calls < FACTOR * iteration.model_calls
    assert re.match(
        r"note: an iteration takes (about|up to) [\d,]+ model calls and [\d.,]+ s\n$", capsys.readouterr().err
    )


@pytest.mark.parametrize("case", ["paths that never meet", "many roots in a simulator", "a tree search"])
def test_what_is_measured_is_learned_from_with_the_same_bits(case, monkeypatch):
    """A training that is resumed, or runs on a slower machine, is measured in other iterations."""
    plain, measured = PGTS(**CASES[case], seed=1), PGTS(**CASES[case], seed=1)
    monkeypatch.setattr(plain.pricing, "begin", lambda: None)
    monkeypatch.setattr(price, "Meter", functools.partial(Meter, patience=0.0))
    for _ in range(2):
        one, other = plain.iterate(), measured.iterate()
        assert one.advantage_NA.equal(other.advantage_NA)
        assert one.model_calls == other.model_calls
        assert one.losses == other.losses
    assert measured.pricing.price is not None


def test_a_few_of_many_roots_are_queried_first_where_a_model_answers_singly():
    model = PGTS(**CASES["many roots in a simulator"])
    sizes = list[int]()
    answered = model.world.model.outcomes
    model.world.model.outcomes = lambda state_N: sizes.append(len(state_N)) or answered(state_N)
    roots = len(model.iterate().state_N)
    assert roots > 80
    assert sizes[:3] == [8, 32, roots - 40]


def test_what_is_done_once_in_the_first_query_is_no_part_of_the_price(monkeypatch, capsys):
    prices = []
    for once in (0.0, 90.0):
        model = PGTS(**CASES["many roots in a simulator"])
        said, queried = ticking(model, monkeypatch, patience=0.05)
        clock = functools.partial(lambda once, queried: 1e-3 * queried[0] + once * (queried[0] > 0), once, queried)
        monkeypatch.setattr(price, "Meter", functools.partial(Meter, patience=0.05, clock=clock))
        model.iterate()
        assert len(said) == 1
        prices.append(model.pricing.price)
    assert prices[1].seconds == pytest.approx(prices[0].seconds)
    assert prices[0].seconds > 0.1
    assert "cheaper" not in capsys.readouterr().err


def test_a_price_that_follows_the_roots_alone_would_be_wrong():
    model = PGTS(**CASES["paths that never meet"])
    iteration = model.iterate()
    assert iteration.model_calls > 3 * FACTOR * len(iteration.state_N) * 2


def test_the_updates_of_an_iteration_with_replay_are_foreseen_from_the_first_ones(monkeypatch):
    replay = {"type": "uniform", "updates_per_step": 0.2, "starts": 8, "length": 4, "search_every": 1}
    model = PGTS("CartPole-v1", depth=1, policy=NETWORK["policy"], replay=replay)
    said, _ = ticking(model, monkeypatch, patience=1.0)
    iteration = model.iterate()
    assert len(said) == 1
    assert said[0] < 1200
    told = model.pricing.price
    assert told is not None
    assert iteration.model_calls / FACTOR < told.calls < FACTOR * iteration.model_calls
    assert told.calls > 3 * 2 * 1200


ADVISED = {
    "auto": CARTPOLE | {"depth": 5},
    "expectimax": CARTPOLE | {"depth": 5, "search": "expectimax"},
    "sampled": CARTPOLE | {"depth": 2, "search": {"type": "sampled", "samples": 3}},
    "mcts": CARTPOLE | {"depth": 5, "search": {"type": "mcts", "simulations": 20}},
    "repeated actions": CARTPOLE | {"depth": 4, "action_repeat": 2},
}


@pytest.mark.parametrize("case", ADVISED)
def test_what_is_said_to_make_a_long_iteration_cheaper_does(case, monkeypatch, capsys):
    model = PGTS(**ADVISED[case])
    ticking(model, monkeypatch, patience=1.0, tick=0.2)
    calls = model.iterate().model_calls
    assert "; cheaper: " in capsys.readouterr().err
    told = model.pricing.price
    assert told is not None
    assert told.seconds > price.LONG
    tried = 0
    for advice in told.advice:
        found = re.match(r"search\.(\w+) ([\w,]+)", advice)
        if found is None:
            assert advice in ("a shorter rollout.horizon.length", "search.max_width")
            continue
        name, value = found[1], found[2].replace(",", "")
        given: Any = int(value) if value.isdecimal() else value
        other = {name: given}
        if name not in ("depth", "max_roots", "action_repeat"):
            kind = {"type": "auto"} | ({} if "search" not in ADVISED[case] else _described(ADVISED[case]["search"]))
            other = {"search": {"type": given} if name == "kind" else kind | {name: given}}
        cheaper = PGTS(**ADVISED[case] | other).iterate()
        if name == "action_repeat":  # a call repeats an action less often
            assert cheaper.model_calls <= 1.5 * calls
        else:
            assert cheaper.model_calls < 0.7 * calls
        tried += 1
    assert tried >= 2


def _described(search: Any) -> dict[str, Any]:
    return {"type": search} if isinstance(search, str) else search


@pytest.mark.parametrize(
    ("env", "seconds", "said"), [("pgts/Ladder-v0", 0.9, 0), ("pgts/Ladder-v0", 1.1, 1), ("CartPole-v1", 0.1, 1)]
)
def test_an_iteration_is_priced_by_the_second_one_and_that_is_said_once_of_tables_where_it_takes_more_than_a_second(
    env, seconds, said, capsys, monkeypatch
):
    times = itertools.count(0, seconds / 2)  # read when an iteration begins, when an update does, and at its end
    monkeypatch.setattr(price, "Meter", functools.partial(Meter, clock=lambda: next(times), patience=100))
    model = PGTS(env, num_envs=2)
    model.iterate()
    assert model.pricing.price is None
    second = model.iterate()
    assert model.pricing.price.calls == second.model_calls
    model.learn(model.num_env_steps + 1, progress=True)
    assert capsys.readouterr().err.count("note: an iteration takes about ") == said


def test_what_fits_a_number_of_model_calls_is_said():
    model = PGTS(**CASES["few calls"])
    model.iterate()
    model.iterate()
    assert re.search(r" s, by expectimax, \d+ states a level: ", str(model.pricing.price))


def test_without_a_lookahead_there_is_no_price():
    model = PGTS("CartPole-v1", depth=0, estimator="sampled", policy="mlp", num_envs=2)
    model.learn(model.num_env_steps + 1200)
    assert model.pricing.price is None


def test_an_iteration_that_is_long_without_model_calls_is_said_to_take_its_time():
    assert str(price.Price(0, 14.2)) == "an iteration takes about 14 s"


def test_the_seconds_in_which_loops_are_compiled_are_no_part_of_the_price():
    numba = pytest.importorskip("numba")
    if not compiled.can_compile(torch.device("cpu")):
        pytest.skip("nothing is compiled")
    meter, begun = Meter(lambda *told: None, None), time.perf_counter()
    numba.njit(lambda x: x * x + 1)(3)
    passed, counted = time.perf_counter() - begun, meter.seconds
    assert passed > 0.01
    assert counted < passed / 2
    time.sleep(0.05)
    assert meter.seconds - counted >= 0.05


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (FEW | {"depth": 0, "estimator": "sampled"}, "up to 120 s"),
        (FEW | {"depth": 1}, "up to 120 s"),
        (
            {"num_envs": 3, "horizon": {"type": "steps", "length": 40}, "depth": 0, "estimator": "sampled"},
            "up to 120 s",
        ),
        (FEW | {"depth": 0, "estimator": "sampled", "horizon": {"type": "fixed", "length": 9}}, None),
    ],
    ids=["without a lookahead", "with one", "episodes that go on", "short"],
)
def test_that_episodes_take_long_is_said_after_their_first_steps(monkeypatch, options, said):
    seconds, notes = [0.0], list[tuple[float, str]]()

    class Slow(Counted):
        def step(self, action: int):
            seconds[0] += 1.0
            return super().step(action)

    training = PGTS(Slow, **options)  # below only the steps of an environment take time
    monkeypatch.setattr(compiled, "clock", lambda: seconds[0])
    monkeypatch.setattr(price.tqdm, "write", lambda text, **_: notes.append((seconds[0], text)))
    before = seconds[0]
    training.iterate()
    found = [(at - before, text) for at, text in notes if "episodes" in text]
    if said is None:
        assert not found
    else:
        ((at, text),) = found
        assert said in text
        assert "fewer rollout.num_envs, a shorter rollout.horizon.length" in text
        assert at == 3.0  # one step in each of three environments
