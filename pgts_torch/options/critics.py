"""Where the values at the leaves of the lookahead come from."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from pgts_torch.options.fields import Clip, Count, Positive, Share, UnitInterval, conflict
from pgts_torch.options.part import Part, null
from pgts_torch.options.policies import CNN, MLP
from pgts_torch.options.rollouts import GeometricHorizon, Horizon


class MonteCarlo(Part):
    """Discounted returns of whole rollouts."""

    type: Literal["monte_carlo"] = "monte_carlo"


class TDLambda(Part):
    """Lambda returns (Sutton 1988)."""

    type: Literal["td_lambda"] = "td_lambda"

    lambda_: UnitInterval = Field(default=0.9, validation_alias="lambda", serialization_alias="lambda")
    """0 bootstraps after one step; 1 is Monte Carlo."""


class NetworkTDLambda(TDLambda):
    """Lambda returns (Sutton 1988)."""

    lambda_: UnitInterval = Field(default=0.95, validation_alias="lambda", serialization_alias="lambda")
    """0 bootstraps after one step; 1 is Monte Carlo."""


def _of_networks(method: Any) -> Any:
    """`TDLambda` is as good here, with the default of networks."""
    return (
        method.model_dump(by_alias=True, exclude_unset=True) | {"type": "td_lambda"}
        if type(method) is TDLambda
        else method
    )


class AutoCritic(Part):
    """By the environment: a table where its states are numbered, else a network; with a network policy a network."""

    type: Literal["auto"] = "auto"


class Values(Part):
    """A critic."""

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""


class ExactValues(Values):
    """The true values, from the tables of the environment; for validation."""

    type: Literal["exact"] = "exact"


class TabularValues(Values):
    """One value for each state (and action), learned from the rollouts."""

    type: Literal["tabular"] = "tabular"

    method: MonteCarlo | TDLambda = Field(default=TDLambda(), discriminator="type")
    """What a value is moved toward."""

    step_size: Share | Literal["mean"] = 0.5
    """How far it is moved; mean: so that it is the mean of all targets so far."""

    initial: float | Literal["mean"] = "mean"
    """The value of what was never visited, in reward units; mean: that of all visits of the iteration."""


class RolloutValues(Values):
    """The mean return of fresh rollouts from each state that is asked for; nothing is learned."""

    type: Literal["rollout"] = "rollout"

    samples: Count = 8
    """Rollouts for each state (and action)."""

    horizon: Horizon = Field(default=GeometricHorizon(), discriminator="type")
    """When such a rollout ends."""


class OwnNetwork(Part):
    """A network of its own like the policy's; an mlp beside a table."""

    type: Literal["own"] = "own"


class SharedNetwork(Part):
    """The policy's, up to its last layer."""

    type: Literal["shared"] = "shared"


class NetworkValues(Values):
    """A network, fitted to the rollouts by least squares."""

    type: Literal["network"] = "network"

    network: OwnNetwork | SharedNetwork | MLP | CNN = Field(default=OwnNetwork(), discriminator="type")
    """Which network."""

    method: Annotated[MonteCarlo | NetworkTDLambda, Field(discriminator="type"), BeforeValidator(_of_networks)] = (
        NetworkTDLambda()
    )
    """What a value is moved toward."""

    learning_rate: Positive | None = null(lookahead=1e-3, sampled=3e-4)
    """Step size of Adam."""

    max_grad_norm: Clip = 0.5
    """Longer gradients are shortened to it."""

    num_epochs: Count = 10
    """Passes over the rollouts in each iteration."""

    minibatch_size: Count = 64
    """Visits in each step."""

    normalize_returns: bool = True
    """Fit what the targets are above their running mean, in units of their running deviation."""

    polyak: Share = 1.0
    """How far the network that targets are made with moves toward the one that is fitted; 1: it is the same."""

    target_period: Count = 1
    """Iterations from one such move to the next."""

    fresh_targets: bool | None = null(lookahead=True, sampled=False)
    """Make new targets for each pass, of the critic as it is by then. One fit to the same targets leaves
    gamma (1 - lambda) / (1 - gamma lambda) of what is missing to v^pi, often 0.83. Not where the network that targets
    are made with lags."""

    @property
    def lags(self) -> bool:
        """Whether targets are made with a network of their own."""
        return self.polyak < 1 or self.target_period > 1

    def filled(self, case: str) -> Any:
        """These options, with what null stands for in such a case."""
        filled = super().filled(case)
        return filled if self.fresh_targets or not self.lags else filled.model_copy(update={"fresh_targets": False})

    @field_validator("fresh_targets")
    @classmethod
    def _of_a_network_that_lags(cls, value: Any, info: ValidationInfo) -> Any:
        polyak, period = info.data.get("polyak", 1.0), info.data.get("target_period", 1)
        if value and (polyak < 1 or period > 1):
            raise conflict(
                "critic.fresh_targets is true, but the network that makes targets lags behind: critic.polyak is "
                "{polyak} and critic.target_period {period}; take the one or the other",
                "critic.fresh_targets",
                "critic.polyak",
                "critic.target_period",
                polyak=str(polyak),
                period=str(period),
            )
        return value


Critic = ExactValues | TabularValues | RolloutValues | NetworkValues
