"""All options of a training, and the rules between them."""

from typing import Any

from pydantic import Field, ValidationInfo, model_validator

from pgts_torch.options.critics import AutoCritic, Critic, NetworkValues
from pgts_torch.options.environment import Env
from pgts_torch.options.fields import checks, conflict
from pgts_torch.options.inferred import with_types
from pgts_torch.options.models import LEARNED, AutoModel, Counts, Ensemble, Latent, Model
from pgts_torch.options.own import OwnModule
from pgts_torch.options.part import Part
from pgts_torch.options.policies import CNN, MLP, AutoPolicy, Biased, Gaussian, Network, Simplex, Softmax, Table
from pgts_torch.options.replay import AutoReplay, NoReplay, Replay, UniformReplay
from pgts_torch.options.rollouts import (
    AutoHorizon,
    Estimator,
    FixedHorizon,
    LookaheadAdvantages,
    Rollouts,
    SampledAdvantages,
    StepsHorizon,
)
from pgts_torch.options.schema import either
from pgts_torch.options.search import AutoSection, ExpectimaxSection, SampledSection, SearchSection
from pgts_torch.options.updates import CMPO, MPO, PPO, AutoUpdate, Gradient, Mirror, Projected, SoftmaxGradient, Update


class Training(Part):
    """The options of `PGTS` but for seed and device. The rules between parts do not apply to those that are auto."""

    env: Env = Env()
    policy: AutoPolicy | Table | Network | Gaussian = Field(default=AutoPolicy(), discriminator="type")
    """The policy that is trained: a table (softmax, simplex), a network (mlp, cnn), or gaussian, for vectors."""

    rollout: Rollouts = Rollouts()
    critic: AutoCritic | Critic = Field(default=AutoCritic(), discriminator="type")
    """Where the values at the leaves of the lookahead come from."""

    search: SearchSection = Field(default=AutoSection(), discriminator="kind")
    """The search that computes the lookahead."""

    estimator: Estimator = Field(default=LookaheadAdvantages(), discriminator="type")
    """Where the advantages in the update come from."""

    update: AutoUpdate | Update = Field(default=AutoUpdate(), discriminator="type")
    """How the policy is changed by the advantages."""

    model: Model = Field(default=AutoModel(), discriminator="type")
    """What the lookahead queries: what is known of the environment, or what is learned of it."""

    replay: Replay = Field(default=AutoReplay(), discriminator="type")
    """Whether what was seen is learned from again."""

    @model_validator(mode="before")
    @classmethod
    def _infer_types(cls, data: Any) -> Any:
        return with_types(data) if isinstance(data, dict) else data

    def resolved(self) -> "Training":
        """Return the options with replay, horizon and number of environments in place of auto and null."""
        replay, rollout = self.replay, self.rollout
        if isinstance(replay, AutoReplay):
            replay = UniformReplay() if isinstance(self.model, LEARNED) else NoReplay()
        if isinstance(rollout.horizon, AutoHorizon):
            horizon = FixedHorizon() if isinstance(replay, NoReplay) else StepsHorizon()
            rollout = rollout.model_copy(update={"horizon": horizon})
        if isinstance(rollout.horizon, StepsHorizon):
            rollout = rollout.model_copy(update={"horizon": rollout.horizon.filled(replay.type)})
        return self.model_copy(update={"replay": replay, "rollout": rollout.filled(rollout.horizon.type)})

    @checks("critic")
    def _sees_what_the_policy_sees(cls, critic: Any, info: ValidationInfo) -> Any:
        policy = info.data.get("policy")
        if policy is None or isinstance(critic, AutoCritic):
            return critic
        if not isinstance(critic, NetworkValues):
            if isinstance(policy, CNN | Gaussian):
                raise conflict(
                    f"critic.type is {critic.type}, which needs numbered states; with policy.type {policy.type} it "
                    "must be network"
                )
            return critic
        if policy.type == "gaussian" and critic.target == "q":
            raise conflict(
                "critic.target is q, which has a value for each numbered action; policy.type gaussian has none, it "
                "must be v"
            )
        network = critic.network.type
        if network == "shared" and isinstance(policy, Table):
            raise conflict(
                f"critic.network.type is shared; policy.type {policy.type} is a table, which has no network to share"
            )
        layers, key = (policy.network, "policy.network") if isinstance(policy, Gaussian) else (policy, "policy")
        if network == "shared" and isinstance(layers, OwnModule) and not layers.head:
            raise conflict(
                f"critic.network.type is shared; {key}.make {layers.make} returns outputs, which no critic can share: "
                f"set {key}.head to true, where it returns features, or give the critic a network of its own"
            )
        if isinstance(critic.network, CNN) and isinstance(policy, Table):
            raise conflict(
                f"critic.network.type is {network}, which takes images; policy.type is {policy.type}, a table of "
                "numbered states"
            )
        return critic

    @checks("estimator")
    def _needs_no_lookahead(cls, estimator: Any, info: ValidationInfo) -> Any:
        search, policy, critic = (info.data.get(name) for name in ("search", "policy", "critic"))
        if isinstance(estimator, LookaheadAdvantages):
            return estimator
        for name, needed in AutoSection(depth=0) if search is not None else ():
            if (value := getattr(search, name)) != needed:
                raise conflict(
                    f"search.{name} is {value}; with estimator.type sampled there is no lookahead, it must be "
                    f"{'null' if needed is None else needed}"
                )
        if isinstance(policy, Table):
            raise conflict(
                "estimator.type is sampled, which needs policy.type mlp, cnn, module or gaussian; policy.type is "
                f"{policy.type}"
            )
        if isinstance(critic, Critic) and (critic.type in ("exact", "rollout") or critic.target == "q"):
            raise conflict(
                f"critic.type is {critic.type} and critic.target {critic.target}; sampled advantages use values "
                "learned from earlier episodes, so estimator.type sampled needs critic.type tabular or network, and "
                "critic.target v"
            )
        return estimator

    @checks("update")
    def _fits_policy(cls, update: Any, info: ValidationInfo) -> Any:
        policy = info.data.get("policy")
        if policy is None or isinstance(update, AutoUpdate):
            return update
        if not isinstance(policy, (AutoPolicy, *MOVES[type(update)])):
            needed = either([kind.model_fields["type"].default for kind in MOVES[type(update)]])
            raise conflict(
                f"update.type is {update.type}, which needs policy.type {needed}; policy.type is {policy.type}"
            )
        if isinstance(update, Mirror) and not isinstance(policy, AutoPolicy):
            _check_mirror(update, policy)
        if isinstance(info.data.get("estimator"), SampledAdvantages) and isinstance(update, Mirror | CMPO | MPO):
            raise conflict(
                f"update.type is {update.type}, which needs the advantages of all actions; estimator.type is sampled"
            )
        return update

    @checks("search")
    def _draws_actions(cls, search: Any, info: ValidationInfo) -> Any:
        policy = info.data.get("policy")
        if not isinstance(policy, Gaussian):
            for name in ("actions", "proposal_scale", "widening"):
                if policy is not None and (value := getattr(search, name, None)) is not None:
                    raise conflict(
                        f"search.{name} is {value}, which only policy.type gaussian uses; policy.type is {policy.type}"
                    )
            return search
        if search.depth == "adaptive" or search.stop_at is not None:
            name = "depth" if search.depth == "adaptive" else "stop_at"
            raise conflict(
                f"search.{name} is {getattr(search, name)}, which needs a bound over all actions; with policy.type "
                "gaussian a lookahead sees the drawn ones only: take a fixed depth without stop_at",
                f"search.{name}",
                "policy.type",
            )
        if isinstance(search, SampledSection) or getattr(search, "samples", None) is not None:
            raise conflict(
                "search.kind is sampled or has samples, which are of outcomes; with policy.type gaussian each drawn "
                "action has one outcome: take auto, expectimax or mcts",
                "search.kind",
                "policy.type",
            )
        return search

    @checks("model", "replay")
    def _needs_a_lookahead(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(info.data.get("estimator"), SampledAdvantages) and isinstance(value, (*LEARNED, UniformReplay)):
            key = f"{info.field_name}.type"
            raise conflict(
                f"{key} is {value.type}; with estimator.type sampled there is no lookahead, it must be auto",
                key,
                "estimator.type",
            )
        return value

    @checks("model")
    def _does_what_is_asked(cls, model: Any, info: ValidationInfo) -> Any:
        search, policy, critic = (info.data.get(name) for name in ("search", "policy", "critic"))
        has_bound = not isinstance(model, LEARNED) or (isinstance(model, Counts) and model.certificate is not None)
        if search is not None and search.stop_at is not None and not has_bound:
            way_out = "give model.certificate" if isinstance(model, Counts) else "only one of type counts has bounds"
            raise conflict(
                f"search.stop_at is {search.stop_at}, which needs an upper bound on the optimality gap; model.type "
                f"{model.type} is learned and proves none: {way_out}",
                "search.stop_at",
                "model.type",
            )
        if isinstance(policy, Gaussian) and isinstance(model, Counts | Latent):
            raise conflict(
                f"model.type is {model.type}, which learns what follows numbered actions; with policy.type gaussian it "
                "must be auto, ensemble or a model of your own"
            )
        for name, part in {"policy": policy, "critic.network": getattr(critic, "network", None)}.items():
            if isinstance(model, Latent) and isinstance(part, CNN):
                raise conflict(
                    f"{name}.type is {part.type}; with model.type latent it takes vectors that represent images: it "
                    "must be mlp, and the cnn be model.network",
                    f"{name}.type",
                    "model.type",
                )
        if isinstance(search, ExpectimaxSection) and search.doubt:
            _check_doubt(model, search.action_repeat)
        return model

    @checks("replay")
    def _goes_on(cls, replay: Any, info: ValidationInfo) -> Any:
        rollout, model = info.data.get("rollout"), info.data.get("model")
        if isinstance(model, LEARNED) and isinstance(replay, NoReplay):
            raise conflict(
                f"replay.type is none; model.type {model.type} learns from what replay keeps: it must be uniform",
                "model.type",
                "replay.type",
            )
        is_none = isinstance(replay, NoReplay) or (isinstance(replay, AutoReplay) and not isinstance(model, LEARNED))
        if rollout is None or not isinstance(rollout.horizon, StepsHorizon) or not is_none:
            return replay
        if isinstance(info.data.get("estimator"), LookaheadAdvantages):
            raise conflict(
                "rollout.horizon.type is steps, so that rollouts do not begin where episodes begin; that needs "
                "replay.type uniform, or estimator.type sampled",
                "rollout.horizon.type",
                "replay.type",
                "estimator.type",
            )
        if getattr(info.data.get("update"), "state_weight", None) == "occupancy":
            raise conflict(
                "update.state_weight is occupancy, and rollout.horizon.type is steps, so that rollouts do not begin "
                "where episodes begin: it must be visits or uniform"
            )
        return replay


MOVES: dict[type[Part], tuple[type[Table | Network | Gaussian], ...]] = {
    Projected: (Simplex,),
    SoftmaxGradient: (Softmax,),
    Mirror: (Softmax, Simplex, MLP, CNN, OwnModule),
    Gradient: (MLP, CNN, OwnModule, Gaussian),
    PPO: (MLP, CNN, OwnModule, Gaussian),
    CMPO: (MLP, CNN, OwnModule),
    MPO: (Gaussian,),
}
"""The policies that each update can move."""


def _check_doubt(model: Any, action_repeat: int) -> None:
    if isinstance(model, Counts) and model.confidence is None:
        raise conflict(
            "search.doubt is true, which needs model.confidence and model.value_range where counts are learned"
        )
    if isinstance(model, Latent):
        raise conflict("search.doubt is true, and model.type is latent, which does not know its error")
    if isinstance(model, Ensemble) and (model.members == 1 or action_repeat > 1):
        raise conflict(
            f"search.doubt is true, which needs model.members 2 or more and search.action_repeat 1; they are "
            f"{model.members} and {action_repeat}"
        )


def _check_mirror(update: Mirror, policy: Any) -> None:
    kind = "table" if isinstance(policy, Table) else "network"
    if kind == "table" and update.floor == "never" and isinstance(policy.init, Biased) and policy.init.probability == 1:
        raise conflict(
            "update.floor is never, so that a mirror step leaves probabilities of 0 at 0; a policy with "
            "policy.init.probability 1 would never move"
        )
    for name, value in update:
        if value is not None and name not in ("type", *Mirror.standing(f"{kind}s")):
            raise conflict(
                f"update.{name} is {value}, which the mirror update of a {kind} does not use; policy.type is "
                f"{policy.type}"
            )
