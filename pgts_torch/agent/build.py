"""Make the parts of the algorithm from their options; where these are auto, the environment decides."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import nn

from pgts_torch.agent.critics import Critic, ExactCritic, RolloutCritic, TabularCritic
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.gaussian_updates import GaussianGradientUpdate, GaussianPPOUpdate, MPOUpdate
from pgts_torch.agent.latent import LatentModel
from pgts_torch.agent.networks import default_network
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.neural_updates import GradientUpdate, PPOUpdate
from pgts_torch.agent.policies import Policy, SimplexPolicy, SoftmaxPolicy, TabularPolicy
from pgts_torch.agent.target_updates import CMPOUpdate, NetworkMirrorUpdate
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate, SoftmaxUpdate, Update
from pgts_torch.agent.world import World
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.base import Model, SamplingModel
from pgts_torch.models.snapshots import env_name
from pgts_torch.options.arguments import checked, described
from pgts_torch.options.critics import (
    AutoCritic,
    ExactValues,
    NetworkTDLambda,
    NetworkValues,
    OwnNetwork,
    RolloutValues,
    SharedNetwork,
    TabularValues,
)
from pgts_torch.options.part import Part
from pgts_torch.options.policies import AutoLayers, AutoPolicy, Gaussian, Network, Simplex, Softmax
from pgts_torch.options.replay import UniformReplay
from pgts_torch.options.rollouts import Estimator, LookaheadAdvantages, SampledAdvantages
from pgts_torch.options.search import MCTS, Auto, Expectimax, Kind, Sampled
from pgts_torch.options.training import Training
from pgts_torch.options.updates import CMPO, MPO, PPO, AutoUpdate, Gradient, Mirror, Projected, SoftmaxGradient
from pgts_torch.search.auto import AutoSearch
from pgts_torch.search.engine import ExpectimaxSearch, MCTSSearch, SampledSearch, Search

Description = str | Mapping[str, Any] | Part
"""Options; or their name, as "ppo"; or a mapping of plain values, as {"type": "ppo", "clip_range": 0.1}."""

MakesModule = Callable[..., nn.Module]

_Choices = Mapping[type[Part], Callable[..., Any]]

_SEARCHES: _Choices = {Auto: AutoSearch, Expectimax: ExpectimaxSearch, Sampled: SampledSearch, MCTS: MCTSSearch}
_TABLES: _Choices = {Softmax: SoftmaxPolicy, Simplex: SimplexPolicy}
_UPDATES: _Choices = {
    Projected: ProjectedUpdate,
    SoftmaxGradient: SoftmaxUpdate,
    Mirror: MirrorUpdate,
    Gradient: GradientUpdate,
    PPO: PPOUpdate,
    CMPO: CMPOUpdate,
}
_OF_GAUSSIANS: _Choices = {MPO: MPOUpdate, Gradient: GaussianGradientUpdate, PPO: GaussianPPOUpdate}

_PASSES: dict[str, Any] = {"minibatch_size": 256, "max_grad_norm": 1.0}
_FITS = NetworkValues(
    **_PASSES, num_epochs=4, learning_rate=2e-3, fresh_targets=False, method=NetworkTDLambda(lambda_=1.0)
)
_STEPS = CMPO(**_PASSES, num_epochs=1, temperature=1.0, clip=1.0)
_REGRESSIONS = MPO(**_PASSES, num_epochs=1)
"""The critic and the update of networks that suit long imagined episodes: returns that are bootstrapped only where an
episode was cut off, and one pass of short steps of the policy. Where fewer visits are searched minibatches are as much
smaller, so that the steps are as many."""


def make_device(device: torch.device | str) -> torch.device:
    """Return the torch device; PgtsError unless torch can compute there."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        why = str(error).partition("\n")[0]
        raise PgtsError(f"device is {str(device)!r}, where torch cannot compute: {why}") from error
    return torch.device(device)


def chosen(options: Training, world: World) -> Training:
    """Return the options with auto replaced: by tables where observations are numbered states, else by networks.

    Raises:
        PgtsError: options that do not go together.
    """
    policy, critic, update, replay = options.policy, options.critic, options.update, options.replay
    numbered, replayed = isinstance(world, TabularWorld), isinstance(options.replay, UniformReplay)
    latent = isinstance(world.model, LatentModel)
    if isinstance(policy, AutoPolicy):
        network = default_network(world.perceived_space, normalize=replayed and not latent)
        policy = Softmax() if numbered else network
    if isinstance(policy, Gaussian) and isinstance(policy.network, AutoLayers):
        network = default_network(world.perceived_space, normalize=replayed)
        policy = policy.model_copy(update={"network": network})
    layers = policy.network if isinstance(policy, Gaussian) else policy
    if isinstance(critic, AutoCritic):
        fits = _FITS if replayed else NetworkValues()
        critic = fits if isinstance(layers, Network) else TabularValues()
    if isinstance(critic, NetworkValues) and isinstance(critic.network, OwnNetwork) and isinstance(layers, Network):
        critic = critic.model_copy(update={"network": layers})
    if isinstance(replay, UniformReplay):
        if replay.starts == "all" and not numbered:
            raise PgtsError("replay.starts is 'all', which is for tables; observations here are no numbered states")
        replay = replay.filled("tables" if numbered else "images" if latent else "vectors")
    if isinstance(update, AutoUpdate):
        lookahead: Any = MPO() if isinstance(policy, Gaussian) else CMPO()
        if isinstance(replay, UniformReplay):
            assert replay.search_every is not None
            size = max(_STEPS.minibatch_size // replay.search_every, 1)
            steps = _REGRESSIONS if isinstance(policy, Gaussian) else _STEPS
            lookahead = steps.model_copy(update={"minibatch_size": size})
        neural = PPO() if isinstance(options.estimator, SampledAdvantages) else lookahead
        mirror = Mirror(step_size=20.0) if replayed else Mirror()
        update = neural if isinstance(layers, Network) else Projected() if isinstance(policy, Simplex) else mirror
    return checked(dict(options) | {"policy": policy, "critic": critic, "update": update, "replay": replay})


def make_search(options: Kind, model: Model | None) -> Search:
    """Make a search in a model; MissingModel where there is none."""
    if model is None:
        raise MissingModel("the environment has no model that a lookahead could query")
    return _made(_SEARCHES, options)(model, options)


def make_policy(options: Any, world: World, *, seed: int) -> Policy:
    """Make a policy: a table, or of networks."""
    if isinstance(options, Gaussian):
        assert world.action_size is not None
        return GaussianPolicy(world.perceived_space, world.action_size, options, seed=seed, device=world.device)
    if isinstance(options, Network):
        return NetworkPolicy(world.perceived_space, world.num_actions, options, seed=seed, device=world.device)
    tabular = _tabular(world, f"the policy {options.type!r}")
    shared = {"legal_SA": tabular.legal_SA, "seed": seed, "device": world.device}
    return _made(_TABLES, options)(*tabular.mdp_shape, options, **shared)


def make_update(options: Part, policy: Policy) -> Update:
    """Make an update for this policy."""
    if isinstance(options, Mirror) and isinstance(policy, NetworkPolicy):
        return NetworkMirrorUpdate(options)
    if isinstance(policy, GaussianPolicy):
        return _made(_OF_GAUSSIANS, options)(options)
    return _made(_UPDATES, options)(options)


def make_critic(
    options: Any,
    world: World,
    policy: Policy,
    estimator: Estimator = LookaheadAdvantages(),  # noqa: B008 - frozen
    *,
    seed: int,
) -> Critic:
    """Make a critic for this policy."""
    if isinstance(options, NetworkValues):
        trunk = None
        if isinstance(options.network, SharedNetwork):
            if not isinstance(policy, NetworkPolicy | GaussianPolicy):
                raise PgtsError(f"critic.network is 'shared'; a {type(policy).__name__} has no network to share")
            trunk = policy.network.trunk
        return NetworkCritic(
            world.perceived_space,
            world.num_actions,
            options.filled(estimator.type),
            trunk=trunk,
            seed=seed,
            device=world.device,
        )
    tabular = _tabular(world, f"the critic {options.type!r}")
    if isinstance(options, TabularValues):
        return TabularCritic(*tabular.mdp_shape, options, legal_SA=tabular.legal_SA, device=world.device)
    if isinstance(options, RolloutValues):
        if not isinstance(tabular.model, SamplingModel):
            raise MissingModel(
                f"{type(tabular.model).__name__} cannot sample outcomes, which the critic 'rollout' needs"
            )
        return RolloutCritic(tabular.model, options)
    assert isinstance(options, ExactValues)
    if tabular.mdp is None:
        raise PgtsError("the critic 'exact' needs the table of the environment, which is not known: take tabular")
    return ExactCritic(tabular.mdp, options)


def _check_legal(world: World, policy: Policy) -> None:
    """PgtsError unless the policy leaves out the actions that a table does not allow."""
    if not isinstance(world, TabularWorld) or (legal_SA := world.legal_SA) is None:
        return
    if not isinstance(policy, TabularPolicy):
        raise PgtsError(
            f"{env_name(world.env)} allows some actions in some states only, as its table says, which a "
            f"{type(policy).__name__} does not see: take the policy softmax or simplex"
        )
    if ((policy.table() > 0) & ~legal_SA.cpu()).any():
        raise PgtsError("the policy has a positive probability of an action that the table does not allow")


def check_parts(arguments: Mapping[str, Any], world: World, policy: Policy, update: Update) -> None:
    """PgtsError where parts do not fit each other, or the gamma given to `PGTS` would have no effect."""
    update.check(policy)
    if isinstance(policy, TabularPolicy):
        shape, found = _tabular(world, "the policy").mdp_shape, (policy.num_states, policy.num_actions)
        if found != shape:
            raise PgtsError(f"the policy is one of (states, actions) = {found}; the environment has {shape}")
    _check_legal(world, policy)
    if arguments["gamma"] not in (None, world.gamma):
        raise PgtsError(f"gamma is {arguments['gamma']}; the environment has its own, {world.gamma}")


def plain(arguments: Mapping[str, Any], options: Training) -> dict[str, Any]:
    """Return the arguments of `PGTS` as plain values; PgtsError where a part was given as an object."""
    for name in ("policy", "critic", "update", "model"):
        if isinstance(arguments[name], Policy | Critic | Update | Model):
            raise PgtsError(f"{name} was given as {arguments[name]!r}; only models made from descriptions can be saved")
    return {**arguments, **described(options), "env_kwargs": dict(arguments["env_kwargs"] or {})}


def _made(choices: _Choices, options: Part) -> Callable[..., Any]:
    return next(make for kind, make in choices.items() if isinstance(options, kind))


def _tabular(world: World, what: str) -> TabularWorld:
    if not isinstance(world, TabularWorld):
        raise PgtsError(
            f"{what} is a table of numbered states, which {env_name(world.env)} does not have; take a network: mlp or "
            "cnn as policy, network as critic"
        )
    return world
