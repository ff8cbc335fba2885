"""How experience is made, and what advantages are estimated from."""

from typing import Literal

from pydantic import Field

from pgts_torch.options.fields import Count, UnitInterval
from pgts_torch.options.part import Part


class FixedHorizon(Part):
    """The same number of steps for every rollout, or until it terminates."""

    type: Literal["fixed"] = "fixed"

    length: Count = 200
    """Steps of a rollout."""

    @property
    def limit(self) -> int:
        """The most steps of an episode."""
        return self.length


class GeometricHorizon(Part):
    """After each step a rollout goes on with probability gamma: it visits states as often as the occupancy says."""

    type: Literal["geometric"] = "geometric"

    max_length: Count = 100_000
    """A guard against processes that never end (gamma = 1); reaching it is an error."""

    @property
    def limit(self) -> int:
        """The most steps of an episode."""
        return self.max_length


Horizon = FixedHorizon | GeometricHorizon


class Rollouts(Part):
    """The rollouts of one iteration."""

    num_envs: Count = 16
    """Rollouts of one iteration, each in an environment of its own."""

    horizon: Horizon = Field(default=FixedHorizon(), discriminator="type")
    """When a rollout ends."""


class LookaheadAdvantages(Part):
    """Of all actions, by the lookahead from the visited states."""

    type: Literal["lookahead"] = "lookahead"


class SampledAdvantages(Part):
    """Of the actions taken, from what came of them, as in PPO and A2C: no lookahead, no model, for comparison. Needs a
    network policy and search.depth 0."""

    type: Literal["sampled"] = "sampled"

    lambda_: UnitInterval = Field(default=0.95, validation_alias="lambda", serialization_alias="lambda")
    """0 looks one step at what came, 1 at all of it (Schulman et al. 2016)."""


Estimator = LookaheadAdvantages | SampledAdvantages
