"""The sections of a configuration, in the order in which `pgts train --help` lists them."""

import json
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from pgts_torch.experiment.fields import (
    Ascending,
    Clip,
    Count,
    EnvId,
    Folder,
    Key,
    Kwargs,
    Natural,
    NonNegative,
    Positive,
    Section,
    Share,
    Sizes,
    UnitInterval,
    conflict,
)


class EnvConfig(Section):
    """The environment."""

    id: EnvId = "pgts/Ladder-v0"
    """Gymnasium environment."""

    gamma: UnitInterval | None = None
    """Discount factor; null: the environment's own, else 0.99."""

    kwargs: Kwargs = Field(default={})
    """Arguments for gymnasium.make, for instance --env.kwargs.n 7."""

    actions_per_dimension: Annotated[int, Field(ge=2, le=10_000)] | None = None
    """Into how many evenly spaced values each dimension of continuous actions is divided; null: actions are
    discrete."""

    observation_key: Key | None = None
    """The part of dictionary observations that policy and critic see, for instance image; null: they are no
    dictionaries."""

    reward_range: Ascending | None = None
    """The lowest and the highest reward of a single step, for instance [0, 1], to which the run holds the environment.
    search.stop_at and search.depth adaptive need it where the model does not know; null: the model's own."""


class UniformInitConfig(Section):
    """All actions equally likely."""

    type: Literal["uniform"] = "uniform"


class RandomInitConfig(Section):
    """Action probabilities drawn from the uniform distribution over the simplex."""

    type: Literal["random"] = "random"


class BiasedInitConfig(Section):
    """One action preferred in every state; the others share the rest."""

    type: Literal["biased"] = "biased"

    action: Natural = 0
    """The preferred action."""

    probability: Share = 0.99
    """Its probability; 1 only with policy.type simplex."""


Init = UniformInitConfig | RandomInitConfig | BiasedInitConfig


class AutoPolicyConfig(Section):
    """By the environment: a softmax table where its states are numbered, else a network, cnn for images and mlp."""

    type: Literal["auto"] = "auto"


class SoftmaxConfig(Section):
    """A table of logits, for environments whose observations are numbered states."""

    type: Literal["softmax"] = "softmax"

    init: Init = Field(default=UniformInitConfig(), discriminator="type")
    """The policy before the first update."""

    @field_validator("init")
    @classmethod
    def _finite_logits(cls, init: Any) -> Any:
        if isinstance(init, BiasedInitConfig) and init.probability == 1:
            raise conflict(
                "policy.init.probability is 1, which policy.type softmax cannot represent (infinite logits); "
                "it must be below 1, or policy.type simplex",
                "policy.init.probability",
                "policy.type",
            )
        return init


class SimplexConfig(Section):
    """A table of the probabilities themselves, likewise."""

    type: Literal["simplex"] = "simplex"

    init: Init = Field(default=UniformInitConfig(), discriminator="type")
    """The policy before the first update."""


class MLPConfig(Section):
    """Fully connected layers over numbered states or vectors."""

    type: Literal["mlp"] = "mlp"

    hidden: Sizes = Field(default=[64, 64])
    """Sizes of the hidden layers."""

    activation: Literal["tanh", "relu"] = "tanh"
    """What follows each of them."""

    normalize: bool = False
    """Subtract the running mean of the observations and divide by their running deviation; not for numbered states."""


class CNNConfig(Section):
    """Convolutions over images (height, width, channels), then fully connected layers."""

    type: Literal["cnn"] = "cnn"

    channels: Sizes = Field(default=[16, 32, 64])
    """Channels of the convolutions, one after the other."""

    kernel_size: Count = 2
    """Height and width of each of them."""

    stride: Count = 1
    """Steps of each of them."""

    hidden: Sizes = Field(default=[128])
    """Sizes of the fully connected layers."""

    activation: Literal["tanh", "relu"] = "relu"
    """What follows each layer."""

    normalize: bool = False
    """Subtract the running mean of each channel and divide by its running deviation."""

    scale: Positive | None = None
    """What observations are divided by; null: 255 for bytes, else 1. MiniGrid's codes are at most 10."""


TABLES = ("softmax", "simplex")
NETWORKS = ("mlp", "cnn")
"""The types of policy that are tables, and those that are networks; which of them auto is, the environment says."""


class FixedHorizonConfig(Section):
    """The same number of steps for every rollout, or until it terminates."""

    type: Literal["fixed"] = "fixed"

    length: Count = 100
    """Steps of a rollout."""


class GeometricHorizonConfig(Section):
    """After each step a rollout goes on with probability gamma: it visits states as often as the occupancy says."""

    type: Literal["geometric"] = "geometric"

    max_length: Count = 100_000
    """A guard; reaching it is an error."""


class RolloutConfig(Section):
    """The rollouts of one iteration."""

    num_envs: Count = 32
    """Rollouts of one iteration, each in an environment of its own."""

    horizon: FixedHorizonConfig | GeometricHorizonConfig = Field(default=FixedHorizonConfig(), discriminator="type")
    """When a rollout ends."""


class MonteCarloConfig(Section):
    """Discounted returns of whole rollouts."""

    type: Literal["monte_carlo"] = "monte_carlo"


class TDLambdaConfig(Section):
    """Lambda returns (Sutton 1988)."""

    type: Literal["td_lambda"] = "td_lambda"

    lambda_: UnitInterval = Field(default=0.9, alias="lambda")
    """0 bootstraps after one step; 1 is Monte Carlo."""


class AutoCriticConfig(Section):
    """By the environment: a table where its states are numbered, else a network; with a network policy a network."""

    type: Literal["auto"] = "auto"


class ExactCriticConfig(Section):
    """The true values, from the tables of the environment; for validation."""

    type: Literal["exact"] = "exact"

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""


class TabularCriticConfig(Section):
    """One value for each state (and action), learned from the rollouts."""

    type: Literal["tabular"] = "tabular"

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""

    method: MonteCarloConfig | TDLambdaConfig = Field(default=TDLambdaConfig(), discriminator="type")
    """What a value is moved toward."""

    step_size: Share | Literal["mean"] = 0.5
    """How far it is moved; mean: so that it is the mean of all targets so far."""

    initial: float | Literal["mean"] = "mean"
    """The value of what was never visited, in reward units; mean: that of all visits of the iteration."""


class RolloutCriticConfig(Section):
    """The mean return of fresh rollouts from each state that is asked for; nothing is learned."""

    type: Literal["rollout"] = "rollout"

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""

    samples: Count = 8
    """Rollouts for each state (and action)."""

    horizon: FixedHorizonConfig | GeometricHorizonConfig = Field(default=GeometricHorizonConfig(), discriminator="type")
    """When such a rollout ends."""


class OwnNetworkConfig(Section):
    """A network of its own like the policy's; an mlp beside a table."""

    type: Literal["own"] = "own"


class SharedNetworkConfig(Section):
    """The policy's, up to its last layer."""

    type: Literal["shared"] = "shared"


class NetworkTDLambdaConfig(Section):
    """Lambda returns (Sutton 1988)."""

    type: Literal["td_lambda"] = "td_lambda"

    lambda_: UnitInterval = Field(default=0.95, alias="lambda")
    """0 bootstraps after one step; 1 is Monte Carlo."""


class NetworkCriticConfig(Section):
    """A network, fitted to the rollouts by least squares."""

    type: Literal["network"] = "network"

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""

    network: OwnNetworkConfig | SharedNetworkConfig | MLPConfig | CNNConfig = Field(
        default=OwnNetworkConfig(), discriminator="type"
    )
    """Which network."""

    method: MonteCarloConfig | NetworkTDLambdaConfig = Field(default=NetworkTDLambdaConfig(), discriminator="type")
    """What a value is moved toward."""

    learning_rate: Positive | None = None
    """Step size of Adam; null: 1e-3 with a lookahead, 3e-4 with sampled advantages."""

    max_grad_norm: Clip = 0.5
    """Longer gradients are shortened to it."""

    num_epochs: Count = 10
    """Passes over the rollouts in each iteration."""

    minibatch_size: Count = 64
    """Visits in each step."""

    fresh_targets: bool | None = None
    """Make new targets for each pass; null: with a lookahead, unless the network that they are made with lags."""

    normalize_returns: bool = True
    """Fit what the targets are above their running mean, in units of their running deviation."""

    polyak: Share = 1.0
    """How far the network that targets are made with moves toward the one that is fitted; 1: it is the same."""

    target_period: Count = 1
    """Iterations from one such move to the next."""


SEARCH_OPTIONS = {
    "max_width": "expectimax",
    "samples": "sampled",
    "share": "sampled",
    "simulations": "mcts",
    "merge": "mcts",
}
"""The kind of search that heeds an option."""


class SearchConfig(Section):
    """The lookahead T^m Q at the visited states."""

    depth: Natural | Literal["adaptive"] = 4
    """m, how often the Bellman optimality operator is applied; 0 is plain policy gradient. adaptive: in each iteration
    the smallest m that sees most of what may be missing, see tolerance."""

    max_depth: Natural | None = None
    """The largest adaptive depth; null: 64. Only with search.depth adaptive."""

    tolerance: NonNegative | None = None
    """An adaptive depth is enough if the gap that it sees, summed over the occupancy, is more than this share of
    what may be missing at the visited states; null: 0.7. Only with search.depth adaptive."""

    stop_at: NonNegative | None = None
    """Training ends once the certificate says that the policy is this close to the optimal return; null: never. It is a
    proof if the start distribution is known, the critic exact and the model the environment; else an estimate."""

    action_repeat: Count = 1
    """How often the lookahead takes an action before it takes the next, so that it sees as many times further. Not in
    numbered environments."""

    model_check: Literal["error", "warn", "off"] = "error"
    """Each step of the environment is held to its model. error: the first contradiction stops the training; warn: it is
    said and counted; off: nobody looks."""

    kind: Literal["auto", "expectimax", "sampled", "mcts"] = "auto"
    """How it is made. auto picks by what the model can do and by the budget; expectimax looks at all outcomes, sampled
    at drawn ones, mcts where it seems worth while."""

    max_nodes: Count = 10_000_000
    """The most nodes of one search. One that needs more is narrowed by auto and refused by the others."""

    max_bytes: Count = 4 * 2**30
    """The most memory that a search may take at its peak, with what is remembered for the next ones. One that needs
    more is treated likewise, before it takes it."""

    max_width: Count | None = None
    """The most states of a level that are unfolded; null: all. Only with search.kind expectimax."""

    samples: Count | None = None
    """Outcomes drawn of each state and action; null: 4. Only with search.kind sampled."""

    share: Literal["none", "level", "search"] | None = None
    """What shares them: nothing, paths that meet at one level, or all that meet; null: level. Only with search.kind
    sampled."""

    simulations: Count | None = None
    """States unfolded below each root; null: 64. Only with search.kind mcts."""

    merge: bool | None = None
    """Whether paths that meet are one node; null: true. Only with search.kind mcts."""

    def description(self) -> dict[str, Any]:
        """The search as `agent.build` reads it."""
        given = {name: getattr(self, name) for name in ("max_nodes", "max_bytes", *SEARCH_OPTIONS)}
        return {"type": self.kind} | {name: value for name, value in given.items() if value is not None}

    @field_validator(*SEARCH_OPTIONS)
    @classmethod
    def _only_its_kind(cls, value: Any, info: ValidationInfo) -> Any:
        kind = info.data.get("kind")
        needed = SEARCH_OPTIONS[str(info.field_name)]
        if value is not None and kind not in (None, needed):
            raise conflict(
                "search.{name} is {value}, which only search.kind {needed} heeds; search.kind is {kind}",
                f"search.{info.field_name}",
                "search.kind",
                name=str(info.field_name),
                value=str(value),
                needed=needed,
                kind=str(kind),
            )
        return value

    @field_validator("max_depth", "tolerance")
    @classmethod
    def _only_adaptive(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("depth", "adaptive") != "adaptive":
            raise conflict(
                "search.{name} is {value}, which only search.depth adaptive heeds; search.depth is {depth}",
                f"search.{info.field_name}",
                "search.depth",
                name=str(info.field_name),
                value=str(value),
                depth=str(info.data["depth"]),
            )
        return value


class LookaheadConfig(Section):
    """Of all actions, by the lookahead from the visited states."""

    type: Literal["lookahead"] = "lookahead"


class SampledAdvantagesConfig(Section):
    """Of the actions taken, from what came of them, as in PPO and A2C: no lookahead, no model, for comparison. Needs a
    network policy and search.depth 0."""

    type: Literal["sampled"] = "sampled"

    lambda_: UnitInterval = Field(default=0.95, alias="lambda")
    """0 looks one step at what came, 1 at all of it (Schulman et al. 2016)."""


StateWeight = Literal["occupancy", "visits", "uniform"]


class AutoUpdateConfig(Section):
    """By the policy: softmax and projected for the tables; cmpo for networks, ppo where advantages are sampled."""

    type: Literal["auto"] = "auto"


class ProjectedUpdateConfig(Section):
    """Euclidean projection onto the simplex, the paper's; needs policy.type simplex."""

    type: Literal["projected"] = "projected"

    step_size: Positive = 0.1
    """eta, by which the weighted lookahead values are multiplied."""

    state_weight: StateWeight = "occupancy"
    """What a visited state counts for: its discounted occupancy, its share of all visits, or 1."""


class SoftmaxUpdateConfig(Section):
    """Gradient in the logits; needs policy.type softmax."""

    type: Literal["softmax"] = "softmax"

    step_size: Positive = 0.1
    """eta, by which the weighted lookahead values are multiplied."""

    state_weight: StateWeight = "occupancy"
    """What a visited state counts for: its discounted occupancy, its share of all visits, or 1."""


class GradientUpdateConfig(Section):
    """One step up the gradient of all actions' advantages; needs a network policy."""

    type: Literal["gradient"] = "gradient"

    learning_rate: Positive = 3e-4
    """Step size of the optimizer."""

    optimizer: Literal["adam", "sgd"] = "adam"
    """Adam, or plain gradient descent."""

    max_grad_norm: Clip = 0.5
    """Longer gradients are shortened to it."""

    state_weight: StateWeight = "visits"
    """What a visited state counts for: its discounted occupancy, its share of all visits, or 1."""

    entropy_coef: NonNegative = 0.0
    """What a nat of entropy is worth, in reward units."""


class PPOUpdateConfig(Section):
    """Many steps up a clipped objective (Schulman et al. 2017); needs a network policy."""

    type: Literal["ppo"] = "ppo"

    learning_rate: Positive = 3e-4
    """Step size of the optimizer."""

    optimizer: Literal["adam", "sgd"] = "adam"
    """Adam, or plain gradient descent."""

    max_grad_norm: Clip = 0.5
    """Longer gradients are shortened to it."""

    state_weight: StateWeight = "visits"
    """What a visited state counts for: its discounted occupancy, its share of all visits, or 1."""

    clip_range: Positive = 0.2
    """How far the probability of an action may move, as a share of itself, before it is pushed no further."""

    num_epochs: Count = 10
    """Passes over the visited states in each iteration."""

    minibatch_size: Count = 64
    """States in each step."""

    entropy_coef: NonNegative = 0.0
    """What a nat of entropy is worth, in units of the advantages."""

    target_kl: Positive | None = None
    """No further step once pi has moved this far from the old one, in nats; null: never."""

    normalize_advantage: bool = True
    """Divide advantages by the root of their mean square."""


class CMPOUpdateConfig(Section):
    """A step toward better actions of a length that no reward scale changes (Hessel et al. 2021); needs a network
    policy and the advantages of all actions."""

    type: Literal["cmpo"] = "cmpo"

    learning_rate: Positive = 1e-3
    """Step size of the optimizer."""

    optimizer: Literal["adam", "sgd"] = "adam"
    """Adam, or plain gradient descent."""

    max_grad_norm: Clip = 0.5
    """Longer gradients are shortened to it."""

    state_weight: StateWeight = "visits"
    """What a visited state counts for: its discounted occupancy, its share of all visits, or 1."""

    temperature: Positive = 0.1
    """By which advantages are divided, in units of their mean size; small ones make long steps."""

    clip: Positive = 3.0
    """The most that an action gains or loses in log pi in one iteration."""

    num_epochs: Count = 10
    """Passes over the visited states in each iteration."""

    minibatch_size: Count = 64
    """States in each step."""


class MirrorUpdateConfig(Section):
    """Mirror ascent with the KL divergence; for all policies. The steps of tables do not depend on the scale of the
    rewards."""

    type: Literal["mirror"] = "mirror"

    state_weight: StateWeight | None = None
    """What a visited state counts for: its discounted occupancy, its share of all visits, or 1; null: 1 (uniform) for
    tables, visits for networks."""

    step_size: Positive | None = None
    """eta, by which the weighted advantages are multiplied; null: 1. Only for tables, as the next two."""

    normalize: Literal["rms", "none"] | None = None
    """rms: advantages are divided by their root mean square, or by the standard error of the lookahead where that is
    larger; none: they count in reward units, as in the paper; null: rms."""

    floor: Clip | None = None
    """The most that the log of a probability may fall below the largest one of its state; null: 12."""

    temperature: Positive | None = None
    """By which the lookahead values are divided; null: 1. Only for networks, as all that follow."""

    learning_rate: Positive | None = None
    """Step size of the optimizer; null: 3e-4."""

    optimizer: Literal["adam", "sgd"] | None = None
    """Adam, or plain gradient descent; null: adam."""

    max_grad_norm: Clip | None = None
    """Longer gradients are shortened to it; null: 0.5."""

    num_epochs: Count | None = None
    """Passes over the visited states in each iteration; null: 10."""

    minibatch_size: Count | None = None
    """States in each step; null: 64."""


class LogConfig(Section):
    """What is written down, and when."""

    every: Count = 1
    """Iterations from one line of metrics to the next."""

    checkpoint_every: Natural = 20
    """Iterations from one checkpoint to the next, fewer where they take more than a minute; 0: only after the last, and
    where a signal ends the training."""

    keep: Count = 3
    """Checkpoints that are kept, the newest; the best model is a matter of eval.keep_best."""


class EvalConfig(Section):
    """Episodes of the current policy that nothing is learned from: of the most probable actions, and of drawn ones."""

    every: Count | None = None
    """Environment steps from one evaluation to the next; null: only after the last iteration."""

    episodes: Count = 10
    """Episodes of one evaluation."""

    stop_at_return: float | None = None
    """Training ends once greedy episodes have this mean return; null: it does not. Only with eval.every."""

    keep_best: bool = False
    """Save the model as best.pt whenever greedy episodes have a higher mean return than ever. Only with eval.every."""

    @field_validator("stop_at_return", "keep_best")
    @classmethod
    def _only_during_training(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and value is not False and info.data.get("every", 1) is None:
            name = str(info.field_name)
            raise conflict(
                "eval.{name} is {value}, which needs evaluations during training; eval.every is null",
                f"eval.{name}",
                "eval.every",
                name=name,
                value=json.dumps(value),
            )
        return value


class RunConfig(Section):
    """The folder that the run leaves."""

    dir: Folder | None = None
    """Its path; null: a new one in runs/, named after the run, its seed and the time."""

    overwrite: bool = False
    """Replace an earlier run in run.dir. Otherwise one of the same configuration goes on where it was cut off, and
    any other is refused."""

    tensorboard: bool = True
    """Write TensorBoard events beside metrics.jsonl."""
