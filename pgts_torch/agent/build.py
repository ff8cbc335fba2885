"""Parts of the algorithm from plain descriptions, `"softmax"` or `{"type": "softmax", "init": {"type": "uniform"}}`.

The command line, `PGTS(...)` and saved models speak of parts in this one form.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch

from pgts_torch.agent.advantages import Estimator, LookaheadAdvantages, SampledAdvantages
from pgts_torch.agent.critics import Critic, ExactCritic, MonteCarlo, RolloutCritic, TabularCritic, TDLambda
from pgts_torch.agent.networks import CNN, MLP
from pgts_torch.agent.neural import NetworkCritic, NetworkPolicy
from pgts_torch.agent.neural_updates import GradientUpdate, NetworkMirrorUpdate, PPOUpdate
from pgts_torch.agent.policies import Biased, Policy, Random, SimplexPolicy, SoftmaxPolicy, TabularPolicy, Uniform
from pgts_torch.agent.rollout import FixedHorizon, GeometricHorizon, Horizon
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate, SoftmaxUpdate, Update
from pgts_torch.agent.world import TabularWorld, World
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.search.auto import AutoSearch
from pgts_torch.search.engine import ExpectimaxSearch, MCTSSearch, SampledSearch, Search

Description = str | Mapping[str, Any]

_Choices = Mapping[str, Callable[..., Any]]

_INITS: _Choices = {"uniform": Uniform, "random": Random, "biased": Biased}
_HORIZONS: _Choices = {"fixed": FixedHorizon, "geometric": GeometricHorizon}
_METHODS: _Choices = {"monte_carlo": MonteCarlo, "td_lambda": TDLambda}
_ESTIMATORS: _Choices = {"lookahead": LookaheadAdvantages, "sampled": SampledAdvantages}
_TABLES: _Choices = {"softmax": SoftmaxPolicy, "simplex": SimplexPolicy}
_NETWORKS: _Choices = {"mlp": MLP, "cnn": CNN}
_CRITICS: _Choices = {
    "exact": ExactCritic,
    "tabular": TabularCritic,
    "rollout": RolloutCritic,
    "network": NetworkCritic,
}
_SEARCHES: _Choices = {
    "auto": AutoSearch,
    "expectimax": ExpectimaxSearch,
    "sampled": SampledSearch,
    "mcts": MCTSSearch,
}
_TABLE_UPDATES: _Choices = {"projected": ProjectedUpdate, "softmax": SoftmaxUpdate, "mirror": MirrorUpdate}
_NETWORK_UPDATES: _Choices = {"gradient": GradientUpdate, "ppo": PPOUpdate, "mirror": NetworkMirrorUpdate}


def make_horizon(description: Description) -> Horizon:
    """A horizon: fixed(length), geometric(max_length)."""
    return _make("horizon", _HORIZONS, description)


def make_estimator(description: Description) -> Estimator:
    """What advantages come from: lookahead, or sampled(lambda)."""
    return _make("estimator", _ESTIMATORS, description)


def make_search(description: Description, world: World) -> Search:
    """A search: auto(max_nodes), expectimax(max_nodes, max_width), sampled(samples, share, max_nodes) or
    mcts(simulations, merge)."""
    if world.model is None:
        raise MissingModel("the environment has no model that a lookahead could ask")
    return _make("search", _SEARCHES, description, world.model)


def make_policy(description: Description | None, world: World, *, seed: int) -> Policy:
    """A policy: softmax or simplex (init: uniform, random, biased(action, probability)), or a network, mlp(hidden,
    activation, normalize) or cnn(...). Default: a softmax table where the environment is tabular, else a network."""
    if description is None:
        images = len(world.observation_space.shape or ()) == 3
        description = "softmax" if isinstance(world, TabularWorld) else "cnn" if images else "mlp"
    kind = _parts("policy", {**_TABLES, **_NETWORKS}, description)[0]
    if kind in _NETWORKS:
        network = _make("policy", _NETWORKS, description)
        return NetworkPolicy(
            world.observation_space, world.num_actions, network=network, seed=seed, device=world.device
        )
    S, A = _tabular(world, f"the policy {kind!r}").mdp_shape
    return make_tabular_policy(description, S, A, seed=seed, device=world.device)


def make_tabular_policy(
    description: Description, num_states: int, num_actions: int, *, seed: int = 0, device: torch.device | str = "cpu"
) -> TabularPolicy:
    """A policy that is a table."""
    nested = {"init": _INITS}
    return _make("policy", _TABLES, description, num_states, num_actions, nested=nested, seed=seed, device=device)


def make_update(description: Description | None, policy: Policy) -> Update:
    """An update, of a table: projected, softmax or mirror (step_size, state_weight); of a network: gradient, ppo or
    mirror. Default: the one for the policy."""
    network = isinstance(policy, NetworkPolicy)
    if description is None:
        description = "ppo" if network else "projected" if isinstance(policy, SimplexPolicy) else "softmax"
    kind = _parts("update", {**_TABLE_UPDATES, **_NETWORK_UPDATES}, description)[0]
    choices = _NETWORK_UPDATES if kind not in _TABLE_UPDATES or (network and kind == "mirror") else _TABLE_UPDATES
    return _make("update", choices, description)


def make_critic(description: Description | None, world: World, policy: Policy, *, seed: int) -> Critic:
    """A critic: exact(target), tabular(target, method, step_size), rollout(samples, target, horizon) or
    network(network, target, method, ...), whose network may be "shared" with the policy's. Default: tabular where the
    environment is, else a network like the policy's."""
    if description is None:
        description = "tabular" if isinstance(world, TabularWorld) else "network"
    kind, options = _parts("critic", _CRITICS, description)
    nested: dict[str, _Choices] = {"method": _METHODS, "horizon": _HORIZONS}
    if kind == "network":
        if options.get("network") == "shared":
            if not isinstance(policy, NetworkPolicy):
                raise PgtsError(f"critic.network is 'shared'; a {type(policy).__name__} has no network to share")
            description = {"type": kind, **options, "network": policy.network.trunk}
        else:
            nested["network"] = _NETWORKS
            images = len(world.observation_space.shape or ()) == 3
            description = {"type": kind, "network": "cnn" if images else "mlp", **options}
        given: tuple[Any, ...] = (world.observation_space, world.num_actions)
        return _make("critic", _CRITICS, description, *given, nested=nested, seed=seed, device=world.device)
    tabular = _tabular(world, f"the critic {kind!r}")
    if kind == "tabular":
        return _make("critic", _CRITICS, description, *tabular.mdp_shape, nested=nested, device=world.device)
    given = (tabular.mdp,) if kind == "exact" else (tabular.model,)
    return _make("critic", _CRITICS, description, *given, nested=nested)


def _tabular(world: World, what: str) -> TabularWorld:
    if not isinstance(world, TabularWorld):
        raise PgtsError(f"{what} is a table; observations of this environment are {world.observation_space}")
    return world


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
