"""The ends of the ranges of options: what stands on one is taken or refused as the docstrings say."""

import math
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from pgts_torch import PGTS
from pgts_torch.errors import PgtsError
from pgts_torch.options import fields

TINY = math.ulp(0.0)
BELOW_0, BELOW_1, ABOVE_1 = -TINY, math.nextafter(1.0, 0.0), math.nextafter(1.0, 2.0)

CLOSED = ((0, 0.0, TINY, BELOW_1, 1), (BELOW_0, ABOVE_1, 2.0, math.nan))
SHARE = ((TINY, BELOW_1, 1), (0, 0.0, BELOW_0, ABOVE_1, 2.0, math.nan))
POSITIVE = ((TINY, 1e300), (0, 0.0, BELOW_0, math.inf, math.nan))
NOT_NEGATIVE = ((0, 0.0, TINY, 1e300), (BELOW_0, math.inf, math.nan))
COUNT = ((1, 2), (0, -1))
"""What is taken and what is refused."""

Range = tuple[tuple[float, ...], tuple[float, ...]]
NET = {"type": "mlp", "hidden": [2]}


def critic(**options: Any) -> dict[str, Any]:
    return {"critic": {"type": "tabular", **options}}


def network(**options: Any) -> dict[str, Any]:
    return {"policy": NET, "critic": {"type": "network", "network": NET, **options}}


def update(kind: str, **options: Any) -> dict[str, Any]:
    return {"policy": NET, "update": {"type": kind, **options}}


OPTIONS: dict[str, tuple[Any, Range]] = {
    "lambda of a critic": (lambda x: critic(method={"type": "td_lambda", "lambda": x}), CLOSED),
    "lambda of advantages": (
        lambda x: {"depth": 0, "policy": NET, "estimator": {"type": "sampled", "lambda": x}},
        CLOSED,
    ),
    "floor of a mirror step": (lambda x: {"update": {"type": "mirror", "floor": x}}, POSITIVE),
    "step size of a critic": (lambda x: critic(step_size=x), SHARE),
    "probability of a biased policy": (
        lambda x: {"policy": {"type": "softmax", "init": {"type": "biased", "action": 0, "probability": x}}},
        ((TINY, BELOW_1), SHARE[1]),  # the Ladder's second action would have probability 0
    ),
    "action of a biased policy": (
        lambda x: {"policy": {"type": "softmax", "init": {"type": "biased", "action": x, "probability": 0.5}}},
        ((0, 1), (-1, 2)),
    ),
    "samples of a rollout critic": (lambda x: {"critic": {"type": "rollout", "samples": x}}, COUNT),
    "length": (lambda x: {"horizon": {"type": "fixed", "length": x}}, COUNT),
    "max_length": (lambda x: {"horizon": {"type": "geometric", "max_length": x}}, COUNT),
    "num_envs": (lambda x: {"num_envs": x}, COUNT),
    "step size of a table": (lambda x: {"update": {"type": "softmax", "step_size": x}}, POSITIVE),
    "step size of a projected step": (
        lambda x: {"policy": "simplex", "update": {"type": "projected", "step_size": x}},
        POSITIVE,
    ),
    "step size of a mirror step": (lambda x: {"update": {"type": "mirror", "step_size": x}}, POSITIVE),
    "initial value of a critic": (lambda x: critic(initial=x), ((-1e300, 0, 1e300), (math.nan, math.inf, -math.inf))),
    "stop_at": (lambda x: {"stop_at": x}, NOT_NEGATIVE),
    "tolerance": (lambda x: {"depth": "adaptive", "tolerance": x}, NOT_NEGATIVE),
    "max_depth": (lambda x: {"depth": "adaptive", "max_depth": x}, ((0, 1), (-1,))),
    "depth": (lambda x: {"depth": x}, ((0, 1), (-1,))),
    "max_width": (lambda x: {"search": {"type": "expectimax", "max_width": x}}, COUNT),
    "samples of a search": (lambda x: {"search": {"type": "sampled", "samples": x}}, COUNT),
    "simulations": (lambda x: {"search": {"type": "mcts", "simulations": x}}, COUNT),
    "polyak": (lambda x: network(polyak=x), SHARE),
    "target_period": (lambda x: network(target_period=x), COUNT),
    "learning rate of a critic": (lambda x: network(learning_rate=x), POSITIVE),
    "num_epochs of a critic": (lambda x: network(num_epochs=x), COUNT),
    "minibatch_size of a critic": (lambda x: network(minibatch_size=x), COUNT),
    "learning rate": (lambda x: update("ppo", learning_rate=x), POSITIVE),
    "clip_range": (lambda x: update("ppo", clip_range=x), POSITIVE),
    "target_kl": (lambda x: update("ppo", target_kl=x), POSITIVE),
    "entropy_coef": (lambda x: update("gradient", entropy_coef=x), NOT_NEGATIVE),
    "max_grad_norm": (lambda x: update("gradient", max_grad_norm=x), POSITIVE),
    "num_epochs": (lambda x: update("ppo", num_epochs=x), COUNT),
    "minibatch_size": (lambda x: update("ppo", minibatch_size=x), COUNT),
    "temperature": (lambda x: update("mirror", temperature=x), POSITIVE),
    "temperature of cmpo": (lambda x: update("cmpo", temperature=x), POSITIVE),
    "clip of cmpo": (lambda x: update("cmpo", clip=x), POSITIVE),
    "hidden": (lambda x: {"policy": {"type": "mlp", "hidden": [x]}}, COUNT),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_takes_the_ends_of_its_range_and_nothing_beyond_them(name):
    options, (taken, refused) = OPTIONS[name]
    for value in taken:
        PGTS("pgts/Ladder-v0", **options(value))
    for value in refused:
        with pytest.raises(PgtsError, match=r"is |holds "):
            PGTS("pgts/Ladder-v0", **options(value))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (critic(initial="median"), "initial is 'median'; it must be a number or mean"),
        (network(target="u"), "target is 'u'"),
        (update("gradient", optimizer="lion"), "optimizer is 'lion'"),
        (update("gradient", state_weight="all"), "state_weight is 'all'"),
        ({"update": {"type": "mirror", "normalize": "max"}}, "normalize is 'max'; it must be rms or none"),
        ({"update": {"type": "mirror", "floor": "low"}}, "floor is 'low'; it must be a number > 0 or never"),
    ],
)
def test_an_unknown_word_is_refused(options, message):
    with pytest.raises(PgtsError, match=message):
        PGTS("pgts/Ladder-v0", **options)


@pytest.mark.parametrize(
    ("field", "bounds"),
    [
        (fields.Count, COUNT),
        (fields.Natural, ((0, 1), (-1,))),
        (fields.Positive, ((TINY, 1e300), (0.0, BELOW_0))),
        (fields.NonNegative, ((0.0, TINY), (BELOW_0,))),
        (fields.UnitInterval, ((0.0, 1.0), (BELOW_0, ABOVE_1, 2.0))),
        (fields.Share, ((TINY, 1.0), (0.0, BELOW_0, ABOVE_1, 2.0))),
    ],
)
def test_a_key_of_a_file_takes_the_ends_of_its_range_and_nothing_beyond_them(field, bounds):
    adapter = TypeAdapter(field)
    for value in bounds[0]:
        assert adapter.validate_python(value) == value
    for value in bounds[1]:
        with pytest.raises(ValidationError):
            adapter.validate_python(value)
