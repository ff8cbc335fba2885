"""Options of the replay of what was seen."""

from typing import Literal

from pgts_torch.options.fields import Count, Positive, Share
from pgts_torch.options.part import Part, null


class AutoReplay(Part):
    """By the model: uniform where it is learned, else none."""

    type: Literal["auto"] = "auto"


class NoReplay(Part):
    """Each iteration learns from its own rollouts, once."""

    type: Literal["none"] = "none"


class UniformReplay(Part):
    """Each iteration makes many updates, from episodes that are imagined in the model and start in states seen so far,
    all equally likely (Dyna, Sutton 1990)."""

    type: Literal["uniform"] = "uniform"

    capacity: Count = 100_000
    """The number of visits that are kept; the oldest ones are dropped."""

    updates_per_step: Positive | None = null(tables=0.2, vectors=0.05, images=0.05)
    """Updates of critic and policy for each environment step."""

    starts: Count | Literal["all"] | None = null(tables="all", vectors=64, images=32)
    """Imagined episodes of an update; all: one from each state seen so far, for tables only."""

    length: Count | None = null(tables=16, vectors=128, images=12)
    """The largest number of steps of an imagined episode. Where a critic is bootstrapped after few steps, its errors at
    steep places of the value add up along the way to the goal."""

    search_every: Count | None = null(tables=1, vectors=4, images=1)
    """The lookahead starts from one visit of an imagined episode in so many; the critic learns from all of them."""

    polyak: Share = 0.5
    """The step of the slow copy of a network policy toward it after each update. Imagined episodes follow the copy, and
    updates start from it; 1: there is no copy."""


Replay = AutoReplay | NoReplay | UniformReplay
