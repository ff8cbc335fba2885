"""Make the parts of a training from the arguments of `PGTS`."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from pgts_torch.agent.build import check_parts, chosen, make_critic, make_policy, make_search, make_update
from pgts_torch.agent.certificate import Certificates
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.depth import DepthChoice
from pgts_torch.agent.estimators import Estimator, LookaheadEstimator, SampledEstimator
from pgts_torch.agent.make_world import make_world
from pgts_torch.agent.model_check import ModelCheck
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.agent.ranks import Ranks
from pgts_torch.agent.updates import Update
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.errors import PgtsError
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.rewards import RewardRange
from pgts_torch.options.arguments import read
from pgts_torch.options.rollouts import SampledAdvantages
from pgts_torch.options.training import Training
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

    @property
    def model_calls(self) -> int:
        """For how many (state, action) lookahead and critic have queried the model so far, in this process."""
        return self.critic.model_calls + (self.search.model_calls if self.search is not None else 0)


def make_parts(arguments: Mapping[str, Any], ranks: Ranks) -> Parts:
    """Make all parts, from the environments to the model check; parts that are given as objects are used as they are.

    Args:
        arguments: all arguments of `PGTS`.
        ranks: the processes that train together.

    Raises:
        PgtsError, MissingModel, ModelMismatch: as `PGTS`.
    """
    options, seed = read(arguments), arguments["seed"]
    source, world = _environments(arguments, options, ranks)
    options = chosen(options, world)
    policy, critic, update = (arguments[name] for name in ("policy", "critic", "update"))
    if not isinstance(policy, Policy):
        policy = make_policy(options.policy, world, seed=seed)
    if not isinstance(critic, Critic):
        critic = make_critic(options.critic, world, policy, options.estimator, seed=seed)
    if not isinstance(update, Update):
        update = make_update(options.update, policy)
    search, certificates, depth_choice = None, None, None
    if isinstance(options.estimator, SampledAdvantages):
        estimator: Estimator = SampledEstimator(policy, critic, options.estimator.lambda_, update.state_weight)
    else:
        search = make_search(options.search, world)
        assert isinstance(world, ModelWorld)
        depths, stop_at = options.search.depths, options.search.stop_at
        certificates = Certificates(world, search, critic, num_depths=len(depths), ranks=ranks)
        if stop_at is not None:
            certificates.check(f"stop_at is {stop_at}")
        if options.search.depth == "adaptive":
            certificates.check("depth is adaptive")
        look = PolicyLookahead(world, policy, critic, search, ranks)
        tolerance = options.search.filled("adaptive").tolerance
        depth_choice = DepthChoice(look, certificates, depths=depths, tolerance=tolerance, stop_at=stop_at)
        estimator = LookaheadEstimator(depth_choice, update.state_weight)
    model_check = ModelCheck(
        world, mode=options.search.model_check, is_queried=search is not None, seed=seed, ranks=ranks
    )
    check_parts(arguments, world, policy, update)
    return Parts(
        options, source, world, policy, critic, update, search, certificates, depth_choice, estimator, model_check
    )


def _environments(arguments: Mapping[str, Any], options: Training, ranks: Ranks) -> tuple[EnvSource, World]:
    """Return the source of environments, and the world of this rank's part of them."""
    num_envs, given = options.rollout.num_envs, ("gamma", "actions_per_dimension")
    with SharedGenerators(arguments["seed"], "construction"):
        source = EnvSource.of(
            arguments["env"], kwargs=arguments["env_kwargs"], **{name: arguments[name] for name in given}
        )
        if source.given is None:
            if num_envs < ranks.size:
                raise PgtsError(f"num_envs is {num_envs}; {ranks.size} ranks need at least as many")
        elif arguments["num_envs"] not in (None, (has := source.given.num_envs) * ranks.size):
            raise PgtsError(f"num_envs is {num_envs}, and a VectorEnv of {has} was given: leave num_envs out")
        world = make_world(
            source,
            num_envs=ranks.count(num_envs),
            gamma=arguments["gamma"],
            observation_key=arguments["observation_key"],
            plain=isinstance(options.estimator, SampledAdvantages),
            action_repeat=options.search.action_repeat,
            device=arguments["device"],
        )
    if arguments["reward_range"] is not None:
        world.promise(RewardRange.of(arguments["reward_range"]))
    return source, world
