"""A saved state whose checksum is right is held to what a model can be in; what cannot be is named by its part."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.agent import saving
from pgts_torch.errors import PgtsError
from tests.support import same_values

State = dict[str, Any]


def table() -> PGTS:
    return PGTS("pgts/Ladder-v0", depth=1, num_envs=2, horizon={"type": "fixed", "length": 6})


def network() -> PGTS:
    small = {"policy": {"type": "mlp", "hidden": [4], "normalize": True}, "num_envs": 2, "depth": 1}
    critic = {"type": "network", "network": {"type": "mlp", "hidden": [4]}}
    return PGTS("CartPole-v1", **small, critic=critic, horizon={"type": "fixed", "length": 6})


MADE: dict[str, Callable[[], PGTS]] = {"table": table, "network": network}


@pytest.fixture(scope="module")
def states() -> dict[str, State]:
    return {name: make().learn(12).state_dict() for name, make in MADE.items()}


def put(*path: Any, value: Any) -> Callable[[State], None]:
    """A state with another value at a place; a function makes it from the one before."""

    def change(state: State) -> None:
        inner = state
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value(inner[path[-1]]) if callable(value) else value

    return change


def drop(*path: Any) -> Callable[[State], None]:
    def change(state: State) -> None:
        inner = state
        for key in path[:-1]:
            inner = inner[key]
        del inner[path[-1]]

    return change


def first(change: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[State], State]:
    """Another first tensor of a dict."""
    return lambda state: {**state, next(iter(state)): change(next(iter(state.values())))}


def nan(tensor: torch.Tensor) -> torch.Tensor:
    return torch.full_like(tensor, torch.nan)


WRONG: dict[str, tuple[str, str, Callable[[State], None]]] = {
    "a missing part": ("table", "policy", drop("policy")),
    "a missing counter": ("table", "num_env_steps", drop("num_env_steps")),
    "an extra part": ("table", "'shadow'", lambda s: s.update(shadow={})),
    "a part of another kind": ("table", "policy", put("policy", value=[1, 2])),
    "a part that is none": ("table", "critic", put("critic", value=None)),
    "a missing tensor": ("table", "policy", put("policy", value={})),
    "an extra tensor": ("table", "policy", lambda s: s["policy"].update(more=torch.zeros(2))),
    "a tensor as a list": ("table", "policy", put("policy", "logits_SA", value=lambda t: t.tolist())),
    "another shape": ("table", "policy", put("policy", "logits_SA", value=lambda t: t[:-1])),
    "another dtype": ("table", "policy", put("policy", "logits_SA", value=lambda t: t.float())),
    "weights that are not numbers": ("table", "policy", put("policy", "logits_SA", value=nan)),
    "an infinite value": ("table", "critic", put("critic", "value_C", value=lambda t: t / 0)),
    "negative counts": ("table", "critic", put("critic", "count_C", value=lambda t: t - 10**6)),
    "a negative counter": ("table", "num_env_steps", put("num_env_steps", value=-1)),
    "a counter that is true": ("table", "num_iterations", put("num_iterations", value=True)),
    "a counter that is a number": ("table", "num_model_calls", put("num_model_calls", value=1.5)),
    "a counter that is text": ("table", "num_iterations", put("num_iterations", value="3")),
    "an update that remembers what it cannot": ("table", "update", put("update", value={"num_steps": 1})),
    "no searches": ("table", "searches", put("searches", value={})),
    "searches as a list": ("table", "searches", put("searches", value=lambda s: list(s.values()))),
    "a search without its choices": ("table", "searches.0", drop("searches", 0, "choices")),
    "other choices": ("table", "searches.0", put("searches", 0, "choices", value={"_width": 1})),
    "choices that are no counts": ("table", "searches.0", put("searches", 0, "choices", "_width", value="wide")),
    "states that do not exist": ("table", "searches.0", put("searches", 0, "queried", value=torch.tensor([0, 99]))),
    "negative states": ("table", "searches.0", put("searches", 0, "queried", value=torch.tensor([-1, 2]))),
    "states that are no whole numbers": ("table", "searches.0", put("searches", 0, "queried", value=torch.ones(2))),
    "a network with a missing layer": ("network", "policy", lambda s: s["policy"].popitem()),
    "a network with NaN weights": ("network", "policy", put("policy", value=first(nan))),
    "a network of another shape": ("network", "policy", put("policy", value=first(lambda t: t[..., None]))),
    "a critic with a NaN scale": ("network", "critic.scale", put("critic", "scale", value=float("nan"))),
    "a critic with a negative scale": ("network", "critic", put("critic", "scale", value=-1.0)),
    "a critic with text for a mean": ("network", "critic", put("critic", "mean", value="much")),
    "a critic that was fitted -1 times": ("network", "critic", put("critic", "num_fits", value=-1)),
    "a critic without its network": ("network", "critic", drop("critic", "network")),
    "an optimiser without a moment": ("network", "update", drop("update", "first_D")),
    "moments of another network": (
        "network",
        "the optimiser",
        lambda s: s["update"].update(first_D=torch.zeros(3), second_D=torch.zeros(3)),
    ),
    "negative squares": ("network", "update", put("update", "second_D", value=lambda t: t - 1)),
    "moments of a critic's other network": (
        "network",
        "critic",
        lambda s: s["critic"]["optimiser"].update(first_D=torch.zeros(3), second_D=torch.zeros(3)),
    ),
    "a step that was never taken": ("network", "update", put("update", "num_steps", value=0)),
    "nested without end": ("table", "policy", lambda s: s.update(policy=nested(200))),
}


def nested(depth: int) -> State:
    state: State = {}
    for _ in range(depth):
        state = {"a": state}
    return state


@pytest.mark.fault("saved state that no model can be in")
@pytest.mark.parametrize("kind", WRONG)
def test_an_impossible_state_is_refused_by_the_name_of_its_part(kind, states, tmp_path):
    made, part, change = WRONG[kind]
    model = MADE[made]()
    model.load_state_dict(copy.deepcopy(states[made]))
    before = model.state_dict()
    wrong = copy.deepcopy(states[made])
    change(wrong)
    with pytest.raises(PgtsError) as caught:
        model.load_state_dict(wrong)
    assert part in str(caught.value)
    assert same_values(model.state_dict(), before)
    path = tmp_path / "model.pt"
    saving.write(path, model.content() | {"state": wrong})
    with pytest.raises(PgtsError) as caught:
        PGTS.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert part in str(caught.value)


@pytest.mark.fault("saved state that no model can be in")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (None, "must be a dict"),
        ({}, "lacks env"),
        ({"env": "pgts/Ladder-v0", "speed": 3}, "has 'speed'"),
        ({"env": "pgts/Ladder-v0", "num_envs": "many"}, "num_envs|arguments"),
        ({"env": "pgts/Ladder-v0", "horizon": 3}, "horizon"),
        ({"env": 3}, "3"),
    ],
)
def test_arguments_that_make_no_model_are_refused(arguments, message, states, tmp_path):
    path = tmp_path / "model.pt"
    saving.write(path, {"arguments": arguments, "state": states["table"]})
    with pytest.raises(PgtsError, match=message):
        PGTS.load(path)


@pytest.mark.parametrize("kind", MADE)
def test_a_loaded_state_is_the_saved_one_bit_for_bit(kind, states, tmp_path):
    model = MADE[kind]()
    model.load_state_dict(copy.deepcopy(states[kind]))
    assert same_values(model.state_dict(), states[kind])
    model.save(Path(tmp_path / "model.pt"))
    assert same_values(PGTS.load(tmp_path / "model.pt").state_dict(), states[kind])
