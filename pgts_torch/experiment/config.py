"""What a run can be configured to do: every key, its default, its range and its meaning.

The docstring under a field is its meaning in `pgts train --help`; the annotation is its range there and in messages.
This module and everything it imports are free of torch, so that mistakes and help appear at once.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from pgts_torch.experiment import strict_yaml

INT64_MAX = 2**63 - 1

Count = Annotated[int, Field(ge=1, le=INT64_MAX)]
Natural = Annotated[int, Field(ge=0, le=INT64_MAX)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
UnitInterval = Annotated[float, Field(ge=0, le=1)]
Share = Annotated[float, Field(gt=0, le=1)]


def _text(pattern: str, requirement: str, max_length: int) -> Any:
    """A string field; `requirement` says in words what the pattern asks for."""
    return Field(pattern=pattern, max_length=max_length, json_schema_extra={"requirement": requirement})


Name = Annotated[str, _text(r"^[A-Za-z0-9][A-Za-z0-9._-]*$", "letters, digits, '.', '_', '-', at most 100", 100)]
EnvId = Annotated[str, _text(r"^[A-Za-z0-9_.:/-]+$", "the id of a Gymnasium environment", 200)]
Folder = Annotated[str, _text(r"^[^\x00-\x1f\x7f]+$", "a folder", 4000)]
Device = Annotated[str, _text(r"^(cpu|cuda(:[0-9]{1,3})?)$", "cpu, cuda or cuda:N", 8)]

RESERVED_KWARGS = {
    "id": "env.id sets it",
    "gamma": "env.gamma sets it",
    "num_envs": "rollout.num_envs sets it",
    "max_episode_steps": "rollout.horizon ends episodes",
    "vectorization_mode": "the rollout sets it",
    "autoreset_mode": "the rollout sets it",
    "vector_kwargs": "the rollout sets it",
}
"""Arguments of gymnasium.make_vec that are not the environment's own, and why each is refused."""


def _check_kwargs(kwargs: dict[str, Any]) -> dict[str, Any]:
    for name in kwargs:
        if not name.isidentifier():
            raise _conflict(
                "env.kwargs has the key {key}, which cannot be the name of an argument",
                f"env.kwargs.{name}",
                key=repr(name),
            )
        if name in RESERVED_KWARGS:
            raise _conflict(
                "env.kwargs must not have the key {key}: {why}",
                f"env.kwargs.{name}",
                key=name,
                why=RESERVED_KWARGS[name],
            )
    for value in _plain_values(kwargs):
        if isinstance(value, float) and not math.isfinite(value):
            raise _conflict("env.kwargs holds {value}; numbers must be finite", value=str(value))
        if not (value is None or isinstance(value, bool | int | float | str)):
            raise _conflict("env.kwargs holds {value}; values must be plain", value=repr(value))
    return kwargs


def _plain_values(value: Any) -> Iterator[Any]:
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _plain_values(item)
    else:
        yield value


def _conflict(reason: str, *keys: str, **values: str) -> PydanticCustomError:
    """An error that is a whole sentence; `keys` are the dotted keys of which any could be changed."""
    return PydanticCustomError("conflict", "{reason}", {"reason": reason.format(**values), "keys": keys})


class _Section(BaseModel):
    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        validate_default=True,
        use_attribute_docstrings=True,
    )


class EnvConfig(_Section):
    """The environment."""

    id: EnvId = "pgts/Ladder-v0"
    """Gymnasium environment."""

    gamma: UnitInterval | None = None
    """Discount factor; null: the environment's own, else 0.99."""

    kwargs: Annotated[dict[str, Any], AfterValidator(_check_kwargs)] = {}
    """Arguments for gymnasium.make, for instance --env.kwargs.n 7."""


class UniformInitConfig(_Section):
    """All actions equally likely."""

    type: Literal["uniform"] = "uniform"


class RandomInitConfig(_Section):
    """Action probabilities drawn from the uniform distribution over the simplex."""

    type: Literal["random"] = "random"


class BiasedInitConfig(_Section):
    """One action preferred in every state; the others share the rest."""

    type: Literal["biased"] = "biased"

    action: Natural = 0
    """The preferred action."""

    probability: Share = 0.99
    """Its probability; 1 only with policy.type simplex."""


class PolicyConfig(_Section):
    """The policy that is trained."""

    type: Literal["softmax", "simplex"] = "softmax"
    """Logits through a softmax, or the probabilities themselves."""

    init: UniformInitConfig | RandomInitConfig | BiasedInitConfig = Field(
        default=UniformInitConfig(), discriminator="type"
    )
    """The policy before the first update."""

    @field_validator("init")
    @classmethod
    def _finite_logits(cls, init: Any, info: ValidationInfo) -> Any:
        if info.data.get("type") == "softmax" and isinstance(init, BiasedInitConfig) and init.probability == 1:
            raise _conflict(
                "policy.init.probability is 1, which policy.type softmax cannot represent (infinite logits); "
                "it must be below 1, or policy.type simplex",
                "policy.init.probability",
                "policy.type",
            )
        return init


class FixedHorizonConfig(_Section):
    """The same number of steps for every rollout, or until it terminates."""

    type: Literal["fixed"] = "fixed"

    length: Count = 50
    """Steps of a rollout."""


class GeometricHorizonConfig(_Section):
    """After each step a rollout goes on with probability gamma: it visits states as often as the occupancy says."""

    type: Literal["geometric"] = "geometric"

    max_length: Count = 100_000
    """A guard; reaching it is an error."""


class RolloutConfig(_Section):
    """The rollouts of one iteration."""

    num_envs: Count = 32
    """Rollouts of one iteration, each in an environment of its own."""

    horizon: FixedHorizonConfig | GeometricHorizonConfig = Field(default=FixedHorizonConfig(), discriminator="type")
    """When a rollout ends."""


class MonteCarloConfig(_Section):
    """Discounted returns of whole rollouts."""

    type: Literal["monte_carlo"] = "monte_carlo"


class TDLambdaConfig(_Section):
    """Lambda returns (Sutton 1988)."""

    type: Literal["td_lambda"] = "td_lambda"

    lambda_: UnitInterval = Field(default=0.9, alias="lambda")
    """0 bootstraps after one step; 1 is Monte Carlo."""


class ExactCriticConfig(_Section):
    """The true values, from the tables of the environment; for validation."""

    type: Literal["exact"] = "exact"

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""


class TabularCriticConfig(_Section):
    """One value for each state (and action), learned from the rollouts."""

    type: Literal["tabular"] = "tabular"

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""

    method: MonteCarloConfig | TDLambdaConfig = Field(default=TDLambdaConfig(), discriminator="type")
    """What a value is moved toward."""

    step_size: Share | Literal["mean"] = 0.5
    """How far it is moved; mean: so that it is the mean of all targets so far."""


class RolloutCriticConfig(_Section):
    """The mean return of fresh rollouts from each state that is asked for; nothing is learned."""

    type: Literal["rollout"] = "rollout"

    samples: Count = 8
    """Rollouts for each state (and action)."""

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""

    horizon: FixedHorizonConfig | GeometricHorizonConfig = Field(default=GeometricHorizonConfig(), discriminator="type")
    """When such a rollout ends."""


class SearchConfig(_Section):
    """The lookahead T^m Q at the visited states."""

    depth: Natural | Literal["adaptive"] = 4
    """m, how often the Bellman optimality operator is applied; 0 is plain policy gradient. adaptive: in each iteration
    the smallest m at which the policy is not stationary."""

    max_depth: Natural | None = None
    """The largest adaptive depth; null: 64. Only with search.depth adaptive."""

    tolerance: NonNegative | None = None
    """An adaptive depth is enough if the gap that it sees, summed over the occupancy, is more than this share of the
    certificate; null: 0.1. Only with search.depth adaptive."""

    stop_at: NonNegative | None = None
    """Training ends once the certificate proves that the policy is this close to the optimal return; null: never."""

    max_nodes: Count = 10_000_000
    """A search that would need more nodes is refused."""

    @field_validator("max_depth", "tolerance")
    @classmethod
    def _only_adaptive(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("depth", "adaptive") != "adaptive":
            raise _conflict(
                "search.{name} is {value}, which only search.depth adaptive heeds; search.depth is {depth}",
                f"search.{info.field_name}",
                "search.depth",
                name=str(info.field_name),
                value=str(value),
                depth=str(info.data["depth"]),
            )
        return value


class UpdateConfig(_Section):
    """How the policy moves toward the lookahead values."""

    type: Literal["projected", "softmax", "mirror"] = "softmax"
    """Euclidean projection (the paper's; needs policy.type simplex), gradient in the logits (needs policy.type
    softmax), or mirror ascent with the KL divergence (both)."""

    step_size: Positive = 0.1
    """eta, by which the weighted lookahead values are multiplied."""

    state_weight: Literal["occupancy", "visits", "uniform"] = "occupancy"
    """What a visited state counts for: its discounted occupancy, its share of all visits, or 1."""


class LogConfig(_Section):
    """What is written down, and when."""

    every: Count = 1
    """Iterations from one line of metrics to the next."""

    checkpoint_every: Natural = 0
    """Iterations from one checkpoint to the next; 0: only after the last."""


class EvalConfig(_Section):
    """Episodes of the current policy that nothing is learned from."""

    every: Natural = 0
    """Iterations from one evaluation to the next; 0: never."""

    episodes: Count = 10
    """Episodes of one evaluation."""


class RunConfig(_Section):
    """The folder that the run leaves."""

    dir: Folder | None = None
    """Its path; null: a new one in runs/, named after the run, its seed and the time."""

    overwrite: bool = False
    """Replace an earlier run in run.dir, which is refused otherwise."""

    tensorboard: bool = True
    """Write TensorBoard events beside metrics.jsonl."""


class Config(_Section):
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
    policy: PolicyConfig = PolicyConfig()
    rollout: RolloutConfig = RolloutConfig()
    critic: ExactCriticConfig | TabularCriticConfig | RolloutCriticConfig = Field(
        default=TabularCriticConfig(), discriminator="type"
    )
    """Where the values at the leaves of the lookahead come from."""

    search: SearchConfig = SearchConfig()
    update: UpdateConfig = UpdateConfig()
    log: LogConfig = LogConfig()
    eval: EvalConfig = EvalConfig()
    run: RunConfig = RunConfig()

    @field_validator("update")
    @classmethod
    def _fits_policy(cls, update: UpdateConfig, info: ValidationInfo) -> UpdateConfig:
        policy = info.data.get("policy")
        if policy is None:
            return update
        needed = {"projected": "simplex", "softmax": "softmax"}.get(update.type, policy.type)
        if needed != policy.type:
            raise _conflict(
                "update.type is {update}, which needs policy.type {needed}; policy.type is {policy}",
                "update.type",
                "policy.type",
                update=update.type,
                needed=needed,
                policy=policy.type,
            )
        if update.type == "mirror" and isinstance(policy.init, BiasedInitConfig) and policy.init.probability == 1:
            raise _conflict(
                "update.type is mirror, which leaves probabilities of 0 at 0; a policy with "
                "policy.init.probability 1 would never move",
                "update.type",
                "policy.init.probability",
            )
        return update


def dump(config: Config) -> str:
    """Every key of the configuration as YAML; `loading.load` reads the same configuration back."""
    return strict_yaml.dump(config.model_dump(by_alias=True))
