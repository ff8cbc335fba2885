"""`check_model`: simulators that can serve as models pass, and of the others it is said what is missing."""

import copy
import random
import re
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.models import check_model
from tests.models.corridors import (
    Broken,
    Clairvoyant,
    Corridor,
    Forgetful,
    GlobalGenerator,
    InBytes,
    OwnGenerator,
    Prophet,
    SharedPlace,
    Stuck,
    Unseeded,
    Untidy,
)

FEW = {"continuations": 8, "length": 8, "seed": 1}


@pytest.fixture
def own_global_generators() -> Iterator[None]:
    """The generators that all programs share, in a known state for one test, and back where they were."""
    states = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002
    torch.manual_seed(0)
    yield
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
    torch.set_rng_state(states[2])


@pytest.mark.parametrize(
    ("env", "is_random"),
    [
        ("FrozenLake-v1", True),
        ("CliffWalking-v1", False),
        ("Blackjack-v1", True),
        ("CartPole-v1", False),
        ("Pendulum-v1", False),
        (Corridor, True),
        (lambda: Corridor(slip=0.0), False),
        (InBytes, True),
    ],
)
def test_a_faithful_simulator_is_usable(env, is_random):
    report = check_model(env, **FEW)
    assert [check.name for check in report.checks][:5] == ["answers", "restore", "merge", "chance", "untouched"]
    assert all(check.passed for check in report.checks), report.verdict
    assert report.usable
    assert (report.random_share > 0) == is_random
    assert report.verdict.endswith("search it by `sampled`" if is_random else "its outcomes can be enumerated")
    assert report.cost is not None
    assert min(report.cost.restore, report.cost.step, report.cost.snapshot, report.cost.bytes) > 0
    assert report.cost.call == report.cost.restore + report.cost.step + report.cost.snapshot


@pytest.mark.parametrize(
    ("make", "failed", "missing"),
    [
        (Forgetful, {"restore"}, r"goes on differently at step 1: get_state misses something"),
        (Prophet, {"chance"}, r"get_state returns the generator too, and a search would foresee"),
        (OwnGenerator, {"restore", "chance"}, r"attribute dice is a generator of its own"),
        *[
            (
                lambda share=share: GlobalGenerator(share),
                {"restore", "chance", "untouched"},
                rf"global generator of {share}",
            )
            for share in ("random", "numpy", "torch")
        ],
        (Clairvoyant, {"chance"}, r"attribute box.0.dice is a generator of its own"),
        (Unseeded, {"untouched"}, r"after reset with the same seed two instances go on differently"),
        (Stuck, {"answers", "restore", "merge", "chance", "untouched"}, r"NotImplementedError: later"),
        (SharedPlace, {"untouched"}, r"a search changes the real environment"),
        (
            lambda: Broken("reward"),
            {"answers", "untouched"},
            r"Broken failed in state \d+ under action .*reward is nan",
        ),
        (
            lambda: Broken("observation"),
            {"answers", "untouched"},
            r"the observation is \[nan, 1.0\]; it must be finite",
        ),
        (lambda: Broken("shape"), {"answers", "untouched"}, r"shape \(1,\); \(2,\) is declared"),
    ],
)
def test_what_is_missing_is_named(make, failed, missing, own_global_generators):
    report = check_model(make, **FEW)
    assert {check.name for check in report.checks if not check.passed} == failed
    assert not report.usable
    assert re.search(missing, report.verdict)
    assert "cannot serve as a model: " in report.verdict


def test_bytes_that_merge_too_few_states_cost_time_but_no_truth():
    report = check_model(Untidy, **FEW)
    assert [check.name for check in report.checks if not check.passed] == ["merge"]
    assert report.usable
    assert "search it by `sampled`; but equal states gave different bytes in 8 of 8 continuations" in report.verdict


def test_an_environment_that_raises_fails_the_walks_by_name_and_seed():
    for fault in ("raises", "arity"):
        with pytest.raises(
            PgtsError, match=r"^Broken fails in random walks with seed 3: (ZeroDivision|Value)Error"
        ) as error:
            check_model(lambda fault=fault: Broken(fault), seed=3)
        assert error.value.__cause__ is not None


def test_without_continuations_there_is_nothing_to_check():
    with pytest.raises(PgtsError, match="continuations is 0"):
        check_model(Corridor, continuations=0)


def test_an_instance_is_not_touched_and_deepcopy_is_not_used(monkeypatch):
    env = gymnasium.make("FrozenLake-v1", is_slippery=False)
    env.reset(seed=0)
    before = repr(vars(env.unwrapped)), env.unwrapped.np_random.bit_generator.state
    real = copy.deepcopy
    copied = []
    monkeypatch.setattr(copy, "deepcopy", lambda value, *memo: copied.append(value) or real(value, *memo))
    report = check_model(env, **FEW)
    assert report.random_share == 0  # is_slippery=False went with the spec
    assert not [value for value in copied if isinstance(value, gymnasium.Env)]
    assert (repr(vars(env.unwrapped)), env.unwrapped.np_random.bit_generator.state) == before


def test_the_same_seed_finds_the_same():
    first, again, other = (check_model("FrozenLake-v1", seed=seed) for seed in (5, 5, 6))
    assert first.checks == again.checks != other.checks


@pytest.mark.parametrize(
    ("id", "module"),
    [
        ("MiniGrid-DoorKey-5x5-v0", "minigrid"),
        ("MiniGrid-Dynamic-Obstacles-5x5-v0", "minigrid"),
        ("ALE/Pong-v5", "ale_py"),
        ("Hopper-v5", "mujoco"),
    ],
)
def test_simulators_that_come_as_extras_are_usable(id, module):
    pytest.importorskip(module, exc_type=ImportError)
    kwargs = {"repeat_action_probability": 0.0} if module == "ale_py" else {}
    report = check_model(lambda: gymnasium.make(id, **kwargs), continuations=3, length=5)
    assert all(check.passed for check in report.checks), report.verdict
