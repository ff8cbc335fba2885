"""Parts of the algorithm from plain descriptions, `"softmax"` or `{"type": "softmax", "init": {"type": "uniform"}}`.

The command line, `PGTS(...)` and saved models speak of parts in this one form.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import torch

from pgts_torch.agent.advantages import Estimator, LookaheadAdvantages, SampledAdvantages
from pgts_torch.agent.critics import Critic, ExactCritic, MonteCarlo, RolloutCritic, TabularCritic, TDLambda
from pgts_torch.agent.networks import CNN, MLP
from pgts_torch.agent.neural import NetworkCritic, NetworkPolicy
from pgts_torch.agent.neural_updates import GradientUpdate, NetworkUpdate, PPOUpdate
from pgts_torch.agent.policies import Biased, Policy, Random, SimplexPolicy, SoftmaxPolicy, TabularPolicy, Uniform
from pgts_torch.agent.rollout import FixedHorizon, GeometricHorizon, Horizon
from pgts_torch.agent.target_updates import CMPOUpdate, NetworkMirrorUpdate, TargetUpdate
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate, SoftmaxUpdate, Update
from pgts_torch.agent.world import TabularWorld, World
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.snapshots import env_name
from pgts_torch.search.auto import AutoSearch
from pgts_torch.search.engine import ExpectimaxSearch, MCTSSearch, SampledSearch, Search
from pgts_torch.tabular.exact import check_depth

Description = str | Mapping[str, Any]

DEFAULT_MAX_DEPTH = 64
DEFAULT_TOLERANCE = 0.7

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
_NETWORK_UPDATES: _Choices = {
    "gradient": GradientUpdate,
    "ppo": PPOUpdate,
    "mirror": NetworkMirrorUpdate,
    "cmpo": CMPOUpdate,
}


def make_device(device: torch.device | str) -> torch.device:
    """A device; PgtsError unless torch can compute there."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        why = str(error).partition("\n")[0]
        raise PgtsError(f"device is {str(device)!r}, where torch cannot compute: {why}") from error
    return torch.device(device)


def make_horizon(description: Description) -> Horizon:
    """A horizon: fixed(length), geometric(max_length)."""
    return _make("horizon", _HORIZONS, description)


def make_estimator(description: Description) -> Estimator:
    """What advantages come from: lookahead, or sampled(lambda)."""
    return _make("estimator", _ESTIMATORS, description)


def make_search(description: Description, world: World) -> Search:
    """A search: auto, expectimax(max_width), sampled(samples, share) or mcts(simulations, root,
    rule, exploration, wave, prior, backup, merge, samples); each also takes max_nodes and max_bytes."""
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


def make_update(
    description: Description | None,
    policy: Policy,
    estimator: Estimator = LookaheadAdvantages(),  # noqa: B008 - frozen
) -> Update:
    """An update, of a table: projected, softmax or mirror (step_size, state_weight; of mirror also
    normalize, floor); of a network: gradient, ppo,
    mirror or cmpo. Default: the one for the policy, of a network cmpo with a lookahead and ppo without."""
    network = isinstance(policy, NetworkPolicy)
    if description is None:
        neural = "ppo" if isinstance(estimator, SampledAdvantages) else "cmpo"
        description = neural if network else "projected" if isinstance(policy, SimplexPolicy) else "mirror"
    kind = _parts("update", {**_TABLE_UPDATES, **_NETWORK_UPDATES}, description)[0]
    choices = _NETWORK_UPDATES if kind not in _TABLE_UPDATES or (network and kind == "mirror") else _TABLE_UPDATES
    return _make("update", choices, description)


def make_critic(
    description: Description | None,
    world: World,
    policy: Policy,
    estimator: Estimator = LookaheadAdvantages(),  # noqa: B008 - frozen
    *,
    seed: int,
) -> Critic:
    """A critic: exact(target), tabular(target, method, step_size), rollout(samples, target, horizon) or
    network(network, target, method, ...), whose network may be "shared" with the policy's. Default: tabular where the
    environment is, else a network like the policy's. With a lookahead its learning rate is 1e-3 and, unless its target
    network lags, its targets are fresh; with sampled advantages they are not, and the rate is 3e-4."""
    if description is None:
        description = "tabular" if isinstance(world, TabularWorld) else "network"
    kind, options = _parts("critic", _CRITICS, description)
    nested: dict[str, _Choices] = {"method": _METHODS, "horizon": _HORIZONS}
    if kind == "network":
        sampled = isinstance(estimator, SampledAdvantages)
        lags = (options.get("polyak", 1), options.get("target_period", 1)) != (1, 1)
        options.setdefault("learning_rate", 3e-4 if sampled else 1e-3)
        options.setdefault("fresh_targets", not sampled and not lags)
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


def make_depths(depth: int | Literal["adaptive"], max_depth: int | None, tolerance: float | None) -> Sequence[int]:
    """The depths that an iteration tries, in order; PgtsError where an argument is out of range or has no effect."""
    if depth != "adaptive":
        for name, value in (("max_depth", max_depth), ("tolerance", tolerance)):
            if value is not None:
                raise PgtsError(f"{name} is {value}, which only depth='adaptive' heeds; depth is {depth}")
        return (check_depth(depth),)
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise PgtsError(f"tolerance is {tolerance}; it must be finite and at least 0")
    return range(check_depth(DEFAULT_MAX_DEPTH if max_depth is None else max_depth) + 1)


def check_parts(
    arguments: Mapping[str, Any],
    world: World,
    policy: Policy,
    critic: Critic,
    update: Update,
    estimator: Estimator,
) -> None:
    """PgtsError where parts do not fit each other, or where one of the arguments of `PGTS` would have no effect."""
    update.check(policy)
    if isinstance(policy, TabularPolicy):
        shape, found = _tabular(world, "the policy").mdp_shape, (policy.num_states, policy.num_actions)
        if found != shape:
            raise PgtsError(f"the policy is one of (states, actions) = {found}; the environment has {shape}")
    if arguments["gamma"] not in (None, world.gamma):
        raise PgtsError(f"gamma is {arguments['gamma']}; the environment has its own, {world.gamma}")
    if not isinstance(estimator, SampledAdvantages):
        return
    for name, default in (("depth", 0), ("search", "auto"), ("stop_at", None)):
        if (value := arguments[name]) != default:
            raise PgtsError(f"{name} is {value}; sampled advantages look no step ahead, it must be {default}")
    if not isinstance(update, NetworkUpdate):
        raise PgtsError(
            f"{type(update).__name__} takes one row a state; sampled advantages have one a visit: take a network, mlp "
            "or cnn, as policy"
        )
    if not isinstance(critic, TabularCritic | NetworkCritic) or critic.target != "v":
        raise PgtsError(
            f"the critic is {type(critic).__name__} of {critic.target}; sampled advantages stand on what was learned "
            "before, so they need a tabular or network critic of v"
        )
    if isinstance(update, TargetUpdate):
        raise PgtsError(
            f"{type(update).__name__} needs the advantages of all actions, for they stand in an exponent; sampled ones "
            "are of the actions taken"
        )


def described(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `PGTS` as plain values; PgtsError where a part was given as an object."""
    for name in ("search", "estimator", "policy", "critic", "update", "horizon"):
        if not isinstance(arguments[name], str | Mapping | None):
            raise PgtsError(f"{name} was given as {arguments[name]!r}; only models made from descriptions can be saved")
    return {**arguments, "env_kwargs": dict(arguments["env_kwargs"] or {})}


def _tabular(world: World, what: str) -> TabularWorld:
    if not isinstance(world, TabularWorld):
        raise PgtsError(
            f"{what} is a table of numbered states, which {env_name(world.env)} does not have; take a network: mlp or "
            "cnn as policy, network as critic"
        )
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
