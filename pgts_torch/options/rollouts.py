"""Options of rollouts, and of the advantages that are estimated from them."""

from typing import Literal

from pydantic import Field

from pgts_torch.errors import PgtsError
from pgts_torch.options.fields import Count, UnitInterval
from pgts_torch.options.part import Part, null


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


class StepsHorizon(Part):
    """Every iteration takes the same number of steps in each environment. An episode that is not over goes on in the
    next iteration. Needs replay, or sampled advantages whose weights are not the occupancy."""

    type: Literal["steps"] = "steps"

    length: Count = 200
    """Steps of an iteration in each environment."""

    first: Count | None = null(uniform=500)
    """Steps of the first iteration in each environment, by replay.type; without replay null is as many as in others."""

    max_length: Count | None = None
    """The largest number of steps of an episode; null: the time limit of the environment, if it has one."""


Horizon = FixedHorizon | GeometricHorizon
"""When an episode from a reset ends that is not over."""


class AutoHorizon(Part):
    """By the replay: steps with it, else fixed."""

    type: Literal["auto"] = "auto"


class Rollouts(Part):
    """The rollouts of one iteration."""

    num_envs: Count | None = null(fixed=16, geometric=16, steps=1)
    """Rollouts of one iteration, each in an environment of its own."""

    horizon: AutoHorizon | FixedHorizon | GeometricHorizon | StepsHorizon = Field(
        default=AutoHorizon(), discriminator="type"
    )
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


def check_processes(count: int, num_envs: int) -> None:
    """PgtsError if so many processes cannot share out these environments."""
    if num_envs < count:
        raise PgtsError(f"num_envs is {num_envs}; {count} processes need at least as many")
