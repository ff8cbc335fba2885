"""Options of rollouts, and of the advantages that are estimated from them."""

from typing import Literal

from pydantic import Field

from pgts_torch.options.fields import Count, UnitInterval
from pgts_torch.options.part import Part


class FixedHorizon(Part):
    """Every rollout runs for the same number of steps, or until it terminates."""

    type: Literal["fixed"] = "fixed"

    length: Count = 200
    """Steps of a rollout."""

    @property
    def limit(self) -> int:
        """The largest number of steps of an episode."""
        return self.length


class GeometricHorizon(Part):
    """After each step a rollout goes on with probability gamma, so that its visits are a sample of the occupancy."""

    type: Literal["geometric"] = "geometric"

    max_length: Count = 100_000
    """Reaching this length is an error; it guards against rollouts that never end (gamma = 1)."""

    @property
    def limit(self) -> int:
        """The largest number of steps of an episode."""
        return self.max_length


Horizon = FixedHorizon | GeometricHorizon


class Rollouts(Part):
    """The rollouts of one iteration."""

    num_envs: Count = 16
    """Rollouts of one iteration, each in an environment of its own."""

    horizon: Horizon = Field(default=FixedHorizon(), discriminator="type")
    """When a rollout ends."""


class LookaheadAdvantages(Part):
    """Advantages of all actions, by the lookahead from the visited states."""

    type: Literal["lookahead"] = "lookahead"


class SampledAdvantages(Part):
    """Advantages of the actions taken, from the rewards after them, as in PPO and A2C: without lookahead or model, for
    comparison. Needs a network policy and search.depth 0."""

    type: Literal["sampled"] = "sampled"

    lambda_: UnitInterval = Field(default=0.95, validation_alias="lambda", serialization_alias="lambda")
    """0 uses the reward of one step, 1 all rewards until the end (Schulman et al. 2016)."""


Estimator = LookaheadAdvantages | SampledAdvantages
