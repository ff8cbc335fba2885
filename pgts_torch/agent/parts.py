"""Make the parts of a training from the arguments of `PGTS`."""

import copy
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import torch
from gymnasium.vector import VectorEnv

from pgts_torch.agent.build import check_parts, chosen, make_critic, make_policy, make_search, make_update
from pgts_torch.agent.certificate import Certificates
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.depth import DepthChoice
from pgts_torch.agent.dyna import Dyna
from pgts_torch.agent.estimators import Estimator, LookaheadEstimator, SampledEstimator
from pgts_torch.agent.explorer import Explorer
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.latent import LatentModel
from pgts_torch.agent.make_world import make_world
from pgts_torch.agent.model_check import ModelCheck
from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.agent.own_models import learned_world, own_model, world_of
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.agent.posterior_certificate import PosteriorCertificate
from pgts_torch.agent.updates import Update
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.base import FollowingModel, LearningModel, Model
from pgts_torch.models.counts import CountsModel
from pgts_torch.models.drawn_actions import DrawnActions
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.masks import ActionMasks
from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.snapshots import env_name
from pgts_torch.options.arguments import read
from pgts_torch.options.models import LEARNED
from pgts_torch.options.own import OwnModel
from pgts_torch.options.policies import Gaussian
from pgts_torch.options.replay import UniformReplay
from pgts_torch.options.rollouts import SampledAdvantages, StepsHorizon, check_processes
from pgts_torch.options.training import Training
from pgts_torch.ranks import Ranks
from pgts_torch.search.engine import Search
from pgts_torch.seeding import SharedGenerators


class Parts(NamedTuple):
    """The parts of a training; search, certificates and depth choice are None with sampled advantages."""

    options: Training
    source: EnvSource
    world: World
    policy: Policy
    critic: Critic
    update: Update
    search: Search | None
    certificates: Certificates | None
    depth_choice: DepthChoice | None
    estimator: Estimator
    model_check: ModelCheck
    episodes: OngoingEpisodes | None
    dyna: Dyna | None
    posterior: PosteriorCertificate | None

    @property
    def model_calls(self) -> int:
        """For how many (state, action) the model has been queried so far in this process, but for its check."""
        searched = 0 if self.search is None else self.search.model_calls
        return self.critic.model_calls + searched + (0 if self.dyna is None else self.dyna.model_calls)

    @property
    def visiting(self) -> Policy:
        """The policy that acts in the environments."""
        explorer = None if self.dyna is None else self.dyna.explorer
        return self.policy if explorer is None else explorer.policy

    def follow(self, num_env_steps: int) -> None:
        """Tell the number of environment steps to all whose options may be schedules."""
        explorer = None if self.dyna is None else self.dyna.explorer
        for part in (self.update, self.critic, *(() if explorer is None else explorer.learners)):
            part.num_env_steps = num_env_steps


def make_parts(arguments: Mapping[str, Any], ranks: Ranks) -> Parts:
    """Make all parts, from the environments to the model check; parts that are given as objects are used as they are.

    Args:
        arguments: all arguments of `PGTS`.

    Raises:
        PgtsError, MissingModel, ModelMismatch: as `PGTS`.
    """
    options, seed = read(arguments).resolved(), arguments["seed"]
    source, world = _environments(arguments, options, ranks)
    options = chosen(options, world)
    policy, critic, update = (arguments[name] for name in ("policy", "critic", "update"))
    if not isinstance(policy, Policy):
        policy = make_policy(options.policy, world, seed=seed)
    if not isinstance(critic, Critic):
        critic = make_critic(options.critic, world, policy, options.estimator, seed=seed)
    if not isinstance(update, Update):
        update = make_update(options.update, policy)
    if isinstance(world.model, LatentModel):
        world.model.serve(critic, policy)
    model_check = ModelCheck(
        world,
        mode=options.search.model_check,
        is_queried=not isinstance(options.estimator, SampledAdvantages),
        seed=seed,
        ranks=ranks,
    )
    search, certificates, depth_choice, dyna, posterior = None, None, None, None, None
    if isinstance(options.replay, UniformReplay):
        assert isinstance(world, ModelWorld)
        world, explorer = _with_explorer(world, policy, critic, update, options, ranks)
        dyna = Dyna(world, policy, options.replay, model_check, explorer)
        if isinstance(world.model, CountsModel) and world.model.options.certificate is not None:
            posterior = PosteriorCertificate(world.model, policy, seed=seed)
    elif isinstance(world.model, LearningModel):
        raise PgtsError(f"{type(world.model).__name__} learns from steps, which needs replay: set replay to uniform")
    if isinstance(options.estimator, SampledAdvantages):
        estimator: Estimator = SampledEstimator(policy, critic, options.estimator.lambda_, update.state_weight)
    else:
        assert isinstance(world, ModelWorld)
        followed = policy if dyna is None else dyna.policy
        search, certificates, depth_choice = _lookahead(
            world, followed, critic, options, ranks, samples_starts=dyna is None
        )
        estimator = LookaheadEstimator(depth_choice, update.state_weight, options.search.max_roots)
    check_parts(arguments, world, policy, update)
    horizon, episodes = options.rollout.horizon, None
    if isinstance(horizon, StepsHorizon):
        max_length = source.time_limit if horizon.max_length is None else horizon.max_length
        episodes = OngoingEpisodes(world, max_length=max_length, seed=seed, names=ranks.names)
    return Parts(
        options,
        source,
        world,
        policy,
        critic,
        update,
        search,
        certificates,
        depth_choice,
        estimator,
        model_check,
        episodes,
        dyna,
        posterior,
    )


def make_look(world: ModelWorld, policy: Policy, critic: Critic, options: Training) -> PolicyLookahead:
    """Return a search for a policy that has seen nothing of the model; MissingModel where this does not take what the
    policy does."""
    model: Model = world.model
    if isinstance(policy, GaussianPolicy):
        if not isinstance(model, FollowingModel) or model.num_actions:
            raise MissingModel(f"{type(model).__name__} does not take vectors as actions, as a gaussian policy needs")
        model = DrawnActions(model, options.search.filled("gaussian").actions)
    search = make_search(options.search, model)
    return PolicyLookahead(world, policy, critic, search, scale=options.search.filled("gaussian").proposal_scale)


def _lookahead(
    world: ModelWorld, policy: Policy, critic: Critic, options: Training, ranks: Ranks, *, samples_starts: bool
) -> tuple[Search, Certificates, DepthChoice]:
    """Return the search for a policy, its certificates, and the choice of its depth."""
    look = make_look(world, policy, critic, options)
    search = look.search
    depths, stop_at = options.search.depths, options.search.stop_at
    certificates = Certificates(
        world, search, critic, num_depths=len(depths), ranks=ranks, samples_starts=samples_starts
    )
    if stop_at is not None and not isinstance(options.model, LEARNED):
        if options.search.max_roots is not None and world.start_S is None:
            raise PgtsError(
                f"stop_at is {stop_at} and max_roots is {options.search.max_roots}; start states are known from "
                "episodes only, and a certificate needs a lookahead from all of them: leave one of the two out"
            )
        certificates.check(f"stop_at is {stop_at}")
    if options.search.depth == "adaptive":
        certificates.check("depth is adaptive")
    tolerance = options.search.filled("adaptive").tolerance
    return search, certificates, DepthChoice(look, certificates, depths=depths, tolerance=tolerance, stop_at=stop_at)


def _with_explorer(
    world: ModelWorld, policy: Policy, critic: Critic, update: Update, options: Training, ranks: Ranks
) -> tuple[ModelWorld, Explorer | None]:
    """Return the world that the trained policy learns in, and the explorer.

    Where the model is a table with optimism they are a world with the same table without optimism, and an explorer in
    the given world; else the given world, and None.
    """
    table = world.model
    if not isinstance(table, CountsModel) or table.options.optimism == "none":
        return world, None
    visiting, its_critic, its_update = copy.deepcopy((policy, critic, update))
    search, _, depth_choice = _lookahead(world, visiting, its_critic, options, ranks, samples_starts=False)
    estimator = LookaheadEstimator(depth_choice, update.state_weight, options.search.max_roots)
    explorer = Explorer(world, visiting, its_critic, its_update, search, estimator)
    trained_in = copy.copy(world)
    trained_in.model = table.plain()
    return trained_in, explorer


def _environments(arguments: Mapping[str, Any], options: Training, ranks: Ranks) -> tuple[EnvSource, World]:
    """Return the source of environments, and the world of this rank's part of them."""
    assert options.rollout.num_envs is not None
    num_envs, given = options.rollout.num_envs, ("gamma", "actions_per_dimension")
    model, device = arguments["model"], torch.device(arguments["device"])
    other: Callable[..., ModelWorld] | None = None
    if isinstance(model, Model):
        other = partial(world_of, model=model)
    elif isinstance(options.model, OwnModel):
        other = partial(world_of, model=own_model(options.model))
    elif isinstance(options.model, LEARNED):
        other = partial(_with_learned, options, arguments["seed"])
    with SharedGenerators(arguments["seed"], "construction"):
        source = EnvSource.of(
            arguments["env"],
            kwargs=arguments["env_kwargs"],
            vectors=isinstance(options.policy, Gaussian),
            **{name: arguments[name] for name in given},
        )
        if source.given is None:
            check_processes(ranks.size, num_envs)
        elif arguments["num_envs"] not in (None, (has := source.given.num_envs) * ranks.size):
            raise PgtsError(f"num_envs is {num_envs}, and a VectorEnv of {has} was given: leave num_envs out")
        world = make_world(
            source,
            num_envs=ranks.count(num_envs),
            gamma=arguments["gamma"],
            observed=options.env,
            plain=isinstance(options.estimator, SampledAdvantages),
            action_repeat=options.search.action_repeat,
            device=device,
            other=other,
        )
    masks, is_auto = world.masks, options.env.action_masks == "auto"
    if isinstance(masks, ActionMasks) and masks.source != "method" and is_auto and ranks.leads:
        said = f"actions of {source.name} are masked by {masks.what}; action_masks 'off' ignores it"
        print(f"note: {said}", file=sys.stderr)
    if arguments["reward_range"] is not None:
        world.promise(RewardRange.of(arguments["reward_range"]))
    return source, world


def _with_learned(options: Training, seed: int, env: VectorEnv, *, masks: Any, **shared: Any) -> ModelWorld:
    assert isinstance(options.model, LEARNED)
    capacity = options.replay.capacity if isinstance(options.replay, UniformReplay) else UniformReplay().capacity
    repeat = options.search.action_repeat
    if isinstance(masks, ActionMasks):
        raise MissingModel(
            f"model is {options.model.type!r}, which does not learn which actions are legal, and {env_name(env)} has "
            f"{masks.what}: take its simulator (model 'auto'), or depth 0 and the estimator 'sampled'; or set "
            "action_masks to 'off', where every action may be taken all the same"
        )
    return learned_world(env, options.model, action_repeat=repeat, capacity=capacity, seed=seed, masks=masks, **shared)
