"""All options of a training, and the rules between them."""

from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator

from pgts_torch.options.critics import AutoCritic, Critic, NetworkValues, TabularValues
from pgts_torch.options.fields import Ascending, EnvId, Key, Kwargs, UnitInterval, conflict
from pgts_torch.options.part import Part
from pgts_torch.options.policies import CNN, MLP, AutoPolicy, Biased, Network, Simplex, Softmax, Table
from pgts_torch.options.rollouts import Estimator, LookaheadAdvantages, Rollouts, SampledAdvantages
from pgts_torch.options.search import AutoSearch, Search
from pgts_torch.options.updates import CMPO, PPO, AutoUpdate, Gradient, Mirror, Projected, SoftmaxGradient, Update


class Env(Part):
    """The environment."""

    id: EnvId = "pgts/Ladder-v0"
    """Gymnasium environment."""

    gamma: UnitInterval | None = None
    """Discount factor; null: the environment's own, else 0.99."""

    kwargs: Kwargs = Field(default={})
    """Arguments for gymnasium.make, for instance --env.kwargs.n 7."""

    actions_per_dimension: Annotated[int, Field(ge=2, le=10_000)] | None = None
    """The number of evenly spaced values of each dimension of continuous actions; null: actions are discrete."""

    observation_key: Key | None = None
    """The entry of dictionary observations that policy and critic use, for instance image; null: observations are no
    dictionaries."""

    reward_range: Ascending | None = None
    """The lowest and the highest reward of a single step, for instance [0, 1]; a reward outside of it is an error.
    search.stop_at and search.depth adaptive need it where the model has no largest reward; null: the model's own."""


class Training(Part):
    """The options of `PGTS` but for seed and device. The rules between parts do not apply to those that are auto."""

    env: Env = Env()
    policy: AutoPolicy | Table | Network = Field(default=AutoPolicy(), discriminator="type")
    """The policy that is trained: a table (softmax, simplex) or a network (mlp, cnn)."""

    rollout: Rollouts = Rollouts()
    critic: AutoCritic | Critic = Field(default=AutoCritic(), discriminator="type")
    """Where the values at the leaves of the lookahead come from."""

    search: Search = Field(default=AutoSearch(), discriminator="kind")
    """The search that computes the lookahead."""

    estimator: Estimator = Field(default=LookaheadAdvantages(), discriminator="type")
    """Where the advantages in the update come from."""

    update: AutoUpdate | Update = Field(default=AutoUpdate(), discriminator="type")
    """How the policy is changed by the advantages."""

    @field_validator("policy")
    @classmethod
    def _sees_observations(cls, policy: Any, info: ValidationInfo) -> Any:
        env = info.data.get("env")
        if env is not None and env.observation_key is not None and isinstance(policy, Table):
            raise conflict(
                "env.observation_key is {key}, a part of dictionary observations; policy.type {policy} is a table of "
                "numbered states, it must be mlp or cnn",
                "env.observation_key",
                "policy.type",
                key=env.observation_key,
                policy=policy.type,
            )
        return policy

    @field_validator("critic")
    @classmethod
    def _sees_what_the_policy_sees(cls, critic: Any, info: ValidationInfo) -> Any:
        policy, env = info.data.get("policy"), info.data.get("env")
        if policy is None or env is None or isinstance(critic, AutoCritic):
            return critic
        network = isinstance(critic, NetworkValues)
        if not network and (policy.type == "cnn" or env.observation_key is not None):
            key, value = (
                ("policy.type", "cnn") if policy.type == "cnn" else ("env.observation_key", env.observation_key)
            )
            raise conflict(
                "critic.type is {critic}, which needs numbered states; with {key} {value} it must be network",
                "critic.type",
                key,
                critic=critic.type,
                key=key,
                value=value,
            )
        if network and critic.network.type == "shared" and isinstance(policy, Table):
            raise conflict(
                "critic.network.type is shared; policy.type {policy} is a table, which has no network to share",
                "critic.network.type",
                "policy.type",
                policy=policy.type,
            )
        if network and {critic.network.type, policy.type} in ({"cnn", kind} for kind in ("mlp", "softmax", "simplex")):
            raise conflict(
                "critic.network.type is {critic} and policy.type is {policy}; a cnn takes images, the others do not",
                "critic.network.type",
                "policy.type",
                critic=critic.network.type,
                policy=policy.type,
            )
        return critic

    @field_validator("estimator")
    @classmethod
    def _needs_no_lookahead(cls, estimator: Any, info: ValidationInfo) -> Any:
        search, policy, critic = (info.data.get(name) for name in ("search", "policy", "critic"))
        if isinstance(estimator, LookaheadAdvantages):
            return estimator
        idle = AutoSearch(depth=0)
        for name in AutoSearch.model_fields if search is not None else ():
            value, needed = getattr(search, name), getattr(idle, name)
            if value != needed:
                raise conflict(
                    "search.{name} is {value}; with estimator.type sampled there is no lookahead, it must be {needed}",
                    f"search.{name}",
                    "estimator.type",
                    name=name,
                    value=str(value),
                    needed="null" if needed is None else str(needed),
                )
        if isinstance(policy, Table):
            raise conflict(
                "estimator.type is sampled, which needs policy.type mlp or cnn; policy.type is {policy}",
                "estimator.type",
                "policy.type",
                policy=policy.type,
            )
        if isinstance(critic, Critic) and not (
            isinstance(critic, TabularValues | NetworkValues) and critic.target == "v"
        ):
            raise conflict(
                "critic.type is {critic} of target {target}; sampled advantages use values learned from earlier "
                "episodes, so estimator.type sampled needs critic.type tabular or network, of target v",
                "critic.type",
                "critic.target",
                "estimator.type",
                critic=critic.type,
                target=critic.target,
            )
        return estimator

    @field_validator("update")
    @classmethod
    def _fits_policy(cls, update: Any, info: ValidationInfo) -> Any:
        policy = info.data.get("policy")
        if policy is None or isinstance(update, AutoUpdate):
            return update
        movable = MOVES[type(update)]
        if not isinstance(policy, (AutoPolicy, *movable)):
            raise conflict(
                "update.type is {update}, which needs policy.type {needed}; policy.type is {policy}",
                "update.type",
                "policy.type",
                update=update.type,
                needed=" or ".join(kind().type for kind in movable),
                policy=policy.type,
            )
        if isinstance(update, Mirror) and not isinstance(policy, AutoPolicy):
            _check_mirror(update, policy)
        if isinstance(info.data.get("estimator"), SampledAdvantages) and isinstance(update, Mirror | CMPO):
            raise conflict(
                "update.type is {update}, which needs the advantages of all actions; estimator.type is sampled",
                "update.type",
                "estimator.type",
                update=update.type,
            )
        return update


MOVES: dict[type[Part], tuple[type[Table | Network], ...]] = {
    Projected: (Simplex,),
    SoftmaxGradient: (Softmax,),
    Mirror: (Softmax, Simplex, MLP, CNN),
    Gradient: (MLP, CNN),
    PPO: (MLP, CNN),
    CMPO: (MLP, CNN),
}
"""The policies that each update can move."""


def _check_mirror(update: Mirror, policy: Any) -> None:
    is_table = isinstance(policy, Table)
    if is_table and update.floor == "never" and isinstance(policy.init, Biased) and policy.init.probability == 1:
        raise conflict(
            "update.floor is never, so that a mirror step leaves probabilities of 0 at 0; a policy with "
            "policy.init.probability 1 would never move",
            "update.floor",
            "policy.init.probability",
        )
    used = {"type", *Mirror.standing("tables" if is_table else "networks")}
    for name in Mirror.model_fields:
        value = getattr(update, name)
        if name not in used and value is not None:
            raise conflict(
                "update.{name} is {value}, which the mirror update of a {kind} does not use; policy.type is {policy}",
                f"update.{name}",
                "policy.type",
                name=name,
                value=str(value),
                kind="table" if is_table else "network",
                policy=policy.type,
            )
