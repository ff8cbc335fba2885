"""Options of the environment."""

from typing import Annotated, Literal

from pydantic import Field

from pgts_torch.options.fields import Ascending, EnvId, Keys, Kwargs, UnitInterval
from pgts_torch.options.part import Part


class Made(Part):
    """How environments are made."""

    id: EnvId = "pgts/Ladder-v0"
    """Gymnasium environment."""

    kwargs: Kwargs = Field(default={})
    """Arguments for gymnasium.make, for instance --env.kwargs.n 7."""

    actions_per_dimension: Annotated[int, Field(ge=2, le=10_000)] | None = None
    """The number of evenly spaced values of each dimension of continuous actions; null: actions are discrete."""


class Observed(Part):
    """What is seen of observations."""

    observation_keys: Keys | None = None
    """The entries of dictionary observations that policy, critic and model see, for instance [image, direction]; null:
    all of them."""

    image_channels: Literal["first", "last"] | None = None
    """Which axis of images has the channels, or the stacked frames; null: as their shape tells, and it is an error
    where that does not."""

    action_masks: Literal["auto", "on", "off"] = "auto"
    """Whether actions are never taken that are not legal by the first of these that an environment has: action_masks(),
    info["action_mask"], observation["action_mask"]. off: these are ignored. on: it must have one. auto: as on, where it
    has one; but info["action_mask"] is ignored beside a table that says what every action does (Taxi)."""


class Env(Observed, Made):
    """The environment."""

    gamma: UnitInterval | None = None
    """Discount factor; null: the environment's own, else 0.99."""

    reward_range: Ascending | None = None
    """The lowest and the highest reward of a single step, for instance [0, 1]; a reward outside of it is an error.
    search.stop_at and search.depth adaptive need it where the model has no largest reward; null: the model's own."""
