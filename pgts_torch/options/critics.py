"""Options of the critic, which gives the values at the leaves of the lookahead."""

from functools import partial
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo

from pgts_torch.options.fields import Clip, Count, Share, UnitInterval, checks, conflict
from pgts_torch.options.own import OwnModule, by_name
from pgts_torch.options.part import Part, null
from pgts_torch.options.policies import CNN, MLP, NatureCNN
from pgts_torch.options.rollouts import GeometricHorizon, Horizon
from pgts_torch.options.schedules import ScheduledPositive


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
    """Accept a `TDLambda` for a network, with the default lambda of networks."""
    return (
        method.model_dump(by_alias=True, exclude_unset=True) | {"type": "td_lambda"}
        if type(method) is TDLambda
        else method
    )


class AutoCritic(Part):
    """By the environment: a table where observations are numbered states, else a network; with a network policy
    a network."""

    type: Literal["auto"] = "auto"


class Values(Part):
    """A critic."""

    target: Literal["v", "q"] = "v"
    """State values V, or action values Q."""


class ExactValues(Values):
    """The exact values, from the tables of the environment; for validation."""

    type: Literal["exact"] = "exact"


class TabularValues(Values):
    """One value for each state (and action), learned from the rollouts."""

    type: Literal["tabular"] = "tabular"

    method: MonteCarlo | TDLambda = Field(default=TDLambda(), discriminator="type")
    """The targets of values."""

    step_size: Share | Literal["mean"] = 0.5
    """The step of a value toward its targets; mean: the value is the mean of all targets so far."""

    initial: float | Literal["mean"] = "mean"
    """The value of states that were never visited, in reward units; mean: the mean of all visits of the iteration."""


class RolloutValues(Values):
    """The mean return of new rollouts in the model from each queried state; nothing is learned."""

    type: Literal["rollout"] = "rollout"

    samples: Count = 8
    """Rollouts for each state (and action)."""

    horizon: Horizon = Field(default=GeometricHorizon(), discriminator="type")
    """When such a rollout ends."""


class OwnNetwork(Part):
    """A network of its own with the options of the policy's; an mlp where the policy is a table."""

    type: Literal["own"] = "own"


class SharedNetwork(Part):
    """The policy's network, with a last layer of its own."""

    type: Literal["shared"] = "shared"


class NetworkValues(Values):
    """A network, fitted to the rollouts by least squares."""

    type: Literal["network"] = "network"

    network: Annotated[
        OwnNetwork | SharedNetwork | MLP | CNN | NatureCNN | OwnModule,
        Field(discriminator="type"),
        BeforeValidator(partial(by_name, kind=OwnModule)),
    ] = OwnNetwork()
    """The network."""

    method: Annotated[MonteCarlo | NetworkTDLambda, Field(discriminator="type"), BeforeValidator(_of_networks)] = (
        NetworkTDLambda()
    )
    """The targets of values."""

    learning_rate: ScheduledPositive | None = null(lookahead=1e-3, sampled=3e-4)
    """Step size of Adam."""

    max_grad_norm: Clip = 0.5
    """The norm to which longer gradients are clipped."""

    num_epochs: Count = 10
    """Passes over the rollouts in each iteration."""

    minibatch_size: Count = 64
    """Visits in each step."""

    normalize_returns: bool = True
    """Subtract the running mean of the targets and divide by their running deviation before the fit."""

    polyak: Share = 1.0
    """The step of the target network's weights toward those of the fitted network; 1: they are equal."""

    target_period: Count = 1
    """Iterations from one step of the target network to the next."""

    fresh_targets: bool | None = null(lookahead=True, sampled=False)
    """Compute new targets with the current critic for each pass. A fit to the same targets in all passes leaves a
    fraction gamma (1 - lambda) / (1 - gamma lambda) of the error to v^pi, often 0.83. Not with a target network."""

    @property
    def lags(self) -> bool:
        """Whether there is a target network, which lags behind the fitted one."""
        return self.polyak < 1 or self.target_period > 1

    def filled(self, case: str) -> Any:
        """Return the options with null replaced by its value in a case."""
        filled = super().filled(case)
        return filled if self.fresh_targets or not self.lags else filled.model_copy(update={"fresh_targets": False})

    @checks("fresh_targets")
    def _of_a_network_that_lags(cls, value: Any, info: ValidationInfo) -> Any:
        polyak, period = info.data.get("polyak", 1.0), info.data.get("target_period", 1)
        if value and (polyak < 1 or period > 1):
            raise conflict(
                "critic.fresh_targets is true, but there is a target network, which lags behind: critic.polyak is "
                f"{polyak} and critic.target_period {period}; take the one or the other"
            )
        return value


Critic = ExactValues | TabularValues | RolloutValues | NetworkValues
