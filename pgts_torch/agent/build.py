"""Parts of the algorithm from plain descriptions, `"softmax"` or `{"type": "softmax", "init": {"type": "uniform"}}`.

The command line, `PGTS(...)` and saved models speak of parts in this one form.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch

from pgts_torch.agent.critics import Critic, ExactCritic, MonteCarlo, RolloutCritic, TabularCritic, TDLambda
from pgts_torch.agent.policies import Biased, Policy, Random, SimplexPolicy, SoftmaxPolicy, Uniform
from pgts_torch.agent.rollout import FixedHorizon, GeometricHorizon, Horizon
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate, SoftmaxUpdate, Update
from pgts_torch.errors import PgtsError
from pgts_torch.models.tabular import TabularModel
from pgts_torch.tabular.mdp import TabularMDP

Description = str | Mapping[str, Any]

_INITS: dict[str, Callable[..., Any]] = {"uniform": Uniform, "random": Random, "biased": Biased}
_HORIZONS: dict[str, Callable[..., Any]] = {"fixed": FixedHorizon, "geometric": GeometricHorizon}
_METHODS: dict[str, Callable[..., Any]] = {"monte_carlo": MonteCarlo, "td_lambda": TDLambda}
_POLICIES: dict[str, Callable[..., Any]] = {"softmax": SoftmaxPolicy, "simplex": SimplexPolicy}
_CRITICS: dict[str, Callable[..., Any]] = {"exact": ExactCritic, "tabular": TabularCritic, "rollout": RolloutCritic}
_UPDATES: dict[str, Callable[..., Any]] = {
    "projected": ProjectedUpdate,
    "softmax": SoftmaxUpdate,
    "mirror": MirrorUpdate,
}


def make_horizon(description: Description) -> Horizon:
    """A horizon: fixed(length), geometric(max_length)."""
    return _make("horizon", _HORIZONS, description)


def make_update(description: Description) -> Update:
    """An update: projected, softmax or mirror (step_size, state_weight)."""
    return _make("update", _UPDATES, description)


def make_policy(
    description: Description, num_states: int, num_actions: int, *, seed: int, device: torch.device | str
) -> Policy:
    """A policy: softmax or simplex (init: uniform, random, biased(action, probability))."""
    return _make(
        "policy", _POLICIES, description, num_states, num_actions, nested={"init": _INITS}, seed=seed, device=device
    )


def make_critic(description: Description, model: TabularModel, mdp: TabularMDP) -> Critic:
    """A critic: exact(target), tabular(target, method, step_size), rollout(samples, target, horizon)."""
    kind = _parts("critic", _CRITICS, description)[0]
    given: dict[str, tuple[Any, ...]] = {
        "exact": (mdp,),
        "tabular": (model.num_states, model.num_actions),
        "rollout": (model,),
    }
    nested = {"method": _METHODS, "horizon": _HORIZONS}
    device = {"device": model.device} if kind == "tabular" else {}
    return _make("critic", _CRITICS, description, *given[kind], nested=nested, **device)


def _make(
    what: str,
    known: Mapping[str, Callable[..., Any]],
    description: Description,
    *given: Any,
    nested: Mapping[str, Mapping[str, Callable[..., Any]]] | None = None,
    **extra: Any,
) -> Any:
    """Build `what` from its description, its nested parts first."""
    kind, options = _parts(what, known, description)
    for name, choices in (nested or {}).items():
        if name in options:
            options[name] = _make(f"{what}.{name}", choices, options[name])
    if "lambda" in options:
        options["lambda_"] = options.pop("lambda")
    try:
        return known[kind](*given, **options, **extra)
    except TypeError as error:
        raise PgtsError(f"{what} {kind!r} does not take these options: {sorted(options)} ({error})") from error


def _parts(what: str, known: Mapping[str, Any], description: Description) -> tuple[str, dict[str, Any]]:
    options = dict(description) if isinstance(description, Mapping) else {}
    kind = options.pop("type", None) if isinstance(description, Mapping) else description
    if not isinstance(kind, str) or kind not in known:
        raise PgtsError(f"{what} is {kind!r}; it must be one of {', '.join(known)}")
    return kind, options
