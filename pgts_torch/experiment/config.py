"""What a run can be configured to do, and which choices go together.

This module and everything it imports are free of torch, so that mistakes and help appear at once.
"""

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator, model_validator

from pgts_torch.experiment import strict_yaml
from pgts_torch.experiment.fields import Count, Device, Name, Natural, Section, conflict
from pgts_torch.experiment.sections import (
    NETWORKS,
    TABLES,
    AutoCriticConfig,
    AutoPolicyConfig,
    AutoUpdateConfig,
    BiasedInitConfig,
    CMPOUpdateConfig,
    CNNConfig,
    EnvConfig,
    EvalConfig,
    ExactCriticConfig,
    GradientUpdateConfig,
    LogConfig,
    LookaheadConfig,
    MirrorUpdateConfig,
    MLPConfig,
    NetworkCriticConfig,
    PPOUpdateConfig,
    ProjectedUpdateConfig,
    RolloutConfig,
    RolloutCriticConfig,
    RunConfig,
    SampledAdvantagesConfig,
    SearchConfig,
    SimplexConfig,
    SoftmaxConfig,
    SoftmaxUpdateConfig,
    TabularCriticConfig,
)


class Config(Section):
    """A whole run."""

    name: Name = "run"
    """Begins the name of the run's folder."""

    seed: Natural = 0
    """Everything random follows from it."""

    total_steps: Count = 50_000
    """Environment steps to train for."""

    device: Device = "cpu"
    """Where tensors live."""

    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    """Threads of torch."""

    env: EnvConfig = EnvConfig()
    policy: AutoPolicyConfig | SoftmaxConfig | SimplexConfig | MLPConfig | CNNConfig = Field(
        default=AutoPolicyConfig(), discriminator="type"
    )
    """The policy that is trained: a table (softmax, simplex) or a network (mlp, cnn)."""

    rollout: RolloutConfig = RolloutConfig()
    critic: AutoCriticConfig | ExactCriticConfig | TabularCriticConfig | RolloutCriticConfig | NetworkCriticConfig = (
        Field(default=AutoCriticConfig(), discriminator="type")
    )
    """Where the values at the leaves of the lookahead come from."""

    search: SearchConfig = SearchConfig()
    estimator: LookaheadConfig | SampledAdvantagesConfig = Field(default=LookaheadConfig(), discriminator="type")
    """Where the advantages come from that the policy is moved by."""

    update: (
        AutoUpdateConfig
        | ProjectedUpdateConfig
        | SoftmaxUpdateConfig
        | MirrorUpdateConfig
        | GradientUpdateConfig
        | PPOUpdateConfig
        | CMPOUpdateConfig
    ) = Field(default=AutoUpdateConfig(), discriminator="type")
    """How the policy moves toward the lookahead values."""

    log: LogConfig = LogConfig()
    eval: EvalConfig = EvalConfig()
    run: RunConfig = RunConfig()

    @model_validator(mode="before")
    @classmethod
    def _fill_types(cls, data: Any) -> Any:
        return with_types(data) if isinstance(data, dict) else data

    @field_validator("policy")
    @classmethod
    def _sees_observations(cls, policy: Any, info: ValidationInfo) -> Any:
        env = info.data.get("env")
        if env is not None and env.observation_key is not None and policy.type in TABLES:
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
        if policy is None or env is None:
            return critic
        if isinstance(critic, AutoCriticConfig):
            return critic
        network = isinstance(critic, NetworkCriticConfig)
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
        if network and critic.network.type == "shared" and policy.type in TABLES:
            raise conflict(
                "critic.network.type is shared; policy.type {policy} is a table, which has no network to share",
                "critic.network.type",
                "policy.type",
                policy=policy.type,
            )
        if network and {critic.network.type, policy.type} in ({"cnn", kind} for kind in ("mlp", *TABLES)):
            raise conflict(
                "critic.network.type is {critic} and policy.type is {policy}; a cnn sees images, the others do not",
                "critic.network.type",
                "policy.type",
                critic=critic.network.type,
                policy=policy.type,
            )
        return critic

    @field_validator("estimator")
    @classmethod
    def _needs_no_lookahead(cls, estimator: Any, info: ValidationInfo) -> Any:
        search, policy = info.data.get("search"), info.data.get("policy")
        if isinstance(estimator, LookaheadConfig):
            return estimator
        idle = SearchConfig(depth=0)
        for name in SearchConfig.model_fields if search is not None else ():
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
        if policy is not None and policy.type in TABLES:
            raise conflict(
                "estimator.type is sampled, which needs policy.type mlp or cnn; policy.type is {policy}",
                "estimator.type",
                "policy.type",
                policy=policy.type,
            )
        return estimator

    @field_validator("update")
    @classmethod
    def _fits_policy(cls, update: Any, info: ValidationInfo) -> Any:
        policy = info.data.get("policy")
        if policy is None:
            return update
        needed: dict[str, tuple[str, ...]] = {"projected": ("simplex",), "softmax": ("softmax",)}
        needed |= dict.fromkeys(("gradient", "ppo", "cmpo"), NETWORKS)
        if policy.type not in ("auto", *needed.get(update.type, (policy.type,))):
            raise conflict(
                "update.type is {update}, which needs policy.type {needed}; policy.type is {policy}",
                "update.type",
                "policy.type",
                update=update.type,
                needed=" or ".join(needed[update.type]),
                policy=policy.type,
            )
        if isinstance(update, MirrorUpdateConfig) and policy.type != "auto":
            _check_mirror(update, policy)
        sampled = isinstance(info.data.get("estimator"), SampledAdvantagesConfig)
        if sampled and isinstance(update, MirrorUpdateConfig | CMPOUpdateConfig):
            raise conflict(
                "update.type is {update}, which needs the advantages of all actions; estimator.type is sampled",
                "update.type",
                "estimator.type",
                update=update.type,
            )
        return update

    def policy_description(self) -> dict[str, Any] | None:
        """The policy as `agent.build` reads it; None: by the environment."""
        return _chosen(self.policy)

    def update_description(self) -> dict[str, Any] | None:
        """The update, likewise."""
        return _chosen(self.update)

    def critic_description(self) -> dict[str, Any] | None:
        """The critic, likewise."""
        description = _chosen(self.critic)
        if description is None:
            return None
        match description.get("network"):
            case {"type": "shared"}:
                description["network"] = "shared"
            case {"type": "own"} if self.policy.type not in NETWORKS:
                del description["network"]
            case {"type": "own"}:
                description["network"] = self.policy.plain()
        return description


TABLE_OPTIONS = ("step_size", "normalize", "floor")
"""Options of the mirror update that only tables have."""

MIRROR_OF_NETWORKS = MirrorUpdateConfig.model_fields.keys() - {"type", "state_weight", *TABLE_OPTIONS}
"""Those that only networks have."""


def _check_mirror(update: MirrorUpdateConfig, policy: Any) -> None:
    is_table = policy.type in TABLES
    floor_less = update.floor == "never"
    if is_table and floor_less and isinstance(policy.init, BiasedInitConfig) and policy.init.probability == 1:
        raise conflict(
            "update.floor is never, so that a mirror step leaves probabilities of 0 at 0; a policy with "
            "policy.init.probability 1 would never move",
            "update.floor",
            "policy.init.probability",
        )
    for name in MirrorUpdateConfig.model_fields:
        value = getattr(update, name)
        if name in ("type", "state_weight") or value is None or (name in TABLE_OPTIONS) == is_table:
            continue
        raise conflict(
            "update.{name} is {value}, which the mirror update of a {kind} does not heed; policy.type is {policy}",
            f"update.{name}",
            "policy.type",
            name=name,
            value=str(value),
            kind="table" if is_table else "network",
            policy=policy.type,
        )


def _chosen(section: Section) -> dict[str, Any] | None:
    description = section.plain()
    return None if description["type"] == "auto" else description


def with_types(data: dict[str, Any]) -> dict[str, Any]:
    """The values, with the type of policy, critic and update where they name other keys but not their type: the first
    of those that suit the rest of the values and know these keys, else the first that suits."""
    data = _typed(data, "policy", [SoftmaxConfig, MLPConfig, CNNConfig])
    policy, sampled = _type(data, "policy"), _type(data, "estimator") == "sampled"
    tables, networks = policy not in NETWORKS, policy not in TABLES
    for_tables: list[type[Section]] = [ProjectedUpdateConfig if policy == "simplex" else MirrorUpdateConfig]
    for_networks: list[type[Section]] = [PPOUpdateConfig] if sampled else [CMPOUpdateConfig, PPOUpdateConfig]
    critic = data.get("critic") or {}
    if policy in NETWORKS and isinstance(critic, dict):  # also where states are numbered
        data = data | {"critic": {"type": "network"} | critic}
    data = _typed(data, "critic", [TabularCriticConfig] * tables + [NetworkCriticConfig] * networks)
    return _typed(data, "update", for_tables * tables + for_networks * networks)


def _typed(data: dict[str, Any], name: str, kinds: Sequence[type[Section]]) -> dict[str, Any]:
    section = data.get(name)
    if not isinstance(section, dict) or "type" in section:
        return data
    known = [{field.alias or key for key, field in kind.model_fields.items()} for kind in kinds]
    known = [
        keys - MIRROR_OF_NETWORKS if kind is MirrorUpdateConfig else keys
        for keys, kind in zip(known, kinds, strict=True)
    ]
    first = next((n for n, keys in enumerate(known) if section.keys() <= keys), 0)
    kind = kinds[first].model_fields["type"].default if section else "auto"
    return data | {name: {"type": kind} | section}


def _type(data: dict[str, Any], name: str) -> Any:
    section = data.get(name)
    return section.get("type") if isinstance(section, dict) else None


def dump(config: Config) -> str:
    """Every key of the configuration as YAML; `loading.load` reads the same configuration back."""
    return strict_yaml.dump(config.model_dump(by_alias=True))
