"""Returns against iterations, exactly: what the figures show and what the statements about them are checked on."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.build import Description
from pgts_torch.agent.policies import SimplexPolicy
from pgts_torch.options import Simplex
from pgts_torch.tabular import exact
from pgts_torch.tabular.ascent import projected_step
from pgts_torch.tabular.mdp import TabularMDP
from study.batch import Batch, Cells, Iterate, Step

ARRIVED = 0.99
"""A return has arrived when it has made this share of the way from J^{pi_0} to J*."""

STARTS: dict[str, int | None] = {"s0": 0, "uniform": None}
"""The start distributions of the figures, as the functions of the zoo take them."""

Watch = Callable[[Iterate], Mapping[str, Tensor]]
"""Numbers, one for each of the B settings, that are to be remembered of an iterate."""


@dataclass(frozen=True, eq=False)
class Trace:
    """One run of Algorithm 1: J_K of pi_0, pi_1, ..., J*, and what else was watched, by name."""

    J_K: Float[Tensor, "K"]
    J_optimal: float
    watched: Mapping[str, Float[Tensor, "K"]] = field(default_factory=dict)

    @property
    def progress_K(self) -> Float[Tensor, "K"]:
        """The share of the way from J^{pi_0} to J* that each policy has made."""
        return (self.J_K - self.J_K[0]) / (self.J_optimal - self.J_K[0])

    @property
    def arrival(self) -> int | None:
        """The first iteration with ARRIVED of the way made."""
        return first(self.progress_K >= ARRIVED)

    def arrives_before(self, other: Self) -> bool:
        """Whether this one arrives, and sooner than the other, which may not arrive at all."""
        return self.arrival is not None and (other.arrival is None or self.arrival < other.arrival)

    @property
    def rounding(self) -> float:
        """What float64 may lose in a return."""
        return 1e-9 * max(1.0, float(self.J_K.abs().max()), abs(self.J_optimal))

    @property
    def is_stuck(self) -> bool:
        """Whether the return never moves: by nothing but rounding."""
        return bool((self.J_K - self.J_K[0]).abs().max() <= self.rounding)

    @property
    def dips(self) -> bool:
        """Whether the return is at some time below that of the initial policy."""
        return bool(self.J_K.min() < self.J_K[0] - self.rounding)

    @property
    def largest_fall(self) -> float:
        """The largest fall of the return in one iteration, at least 0."""
        return max(0.0, -float(self.J_K.diff().min()))

    @property
    def is_monotone(self) -> bool:
        """Whether the return never falls by more than rounding."""
        return bool(self.J_K.diff().min() >= -self.rounding)


def first(mask_K: Tensor) -> int | None:
    """The first k where the mask is true."""
    found_N = torch.nonzero(mask_K).flatten()
    return int(found_N[0]) if len(found_N) else None


def trace(
    mdp: TabularMDP,
    pi_SA: Float[Tensor, "S A"],
    *,
    depths: Sequence[int],
    steps: Sequence[float],
    iterations: int,
    update: Step = projected_step,
    watch: Watch | None = None,
) -> dict[tuple[int, float], Trace]:
    """Algorithm 1 from one policy with every depth and every step size, by (depth, step size)."""
    settings = list(itertools.product(depths, steps))
    J_optimal, batch = exact.optimal(mdp).J, Batch(mdp, step=update)
    J_KB, watched_KB, running = [], [], cells(settings, pi_SA)
    for _ in range(iterations + 1):
        iterate, running = batch.advance(running)
        J_KB.append(iterate.J_B)
        watched_KB.append(watch(iterate) if watch else {})
    J_BK = torch.stack(J_KB, -1)
    watched_BK = {name: torch.stack([row[name] for row in watched_KB], -1) for name in watched_KB[0]}
    return {
        setting: Trace(J_BK[b], J_optimal, {name: values_BK[b] for name, values_BK in watched_BK.items()})
        for b, setting in enumerate(settings)
    }


def arrivals(
    mdp: TabularMDP,
    pi_SA: Float[Tensor, "S A"],
    *,
    depths: Sequence[int],
    steps: Sequence[float],
    limit: int,
) -> dict[tuple[int, float], int | None]:
    """The iteration in which each run arrives (see `Trace.arrival`), None if not within `limit`.

    Runs that have arrived are not continued, which makes this cheaper than `trace`.
    """
    settings = list(itertools.product(depths, steps))
    running, batch, J_optimal = cells(settings, pi_SA), Batch(mdp), exact.optimal(mdp).J
    goal = float("inf")
    arrived: dict[tuple[int, float], int | None] = dict.fromkeys(settings)
    for k in range(limit + 1):
        iterate, after = batch.advance(running)
        if k == 0:
            J_0 = float(iterate.J_B[0])
            goal = J_0 + ARRIVED * (J_optimal - J_0)
        done_B = iterate.J_B >= goal
        arrived |= {settings[b]: k for b in torch.nonzero(done_B).flatten().tolist()}
        settings = [setting for setting, done in zip(settings, done_B.tolist(), strict=True) if not done]
        if not settings:
            break
        running = after.rows(~done_B)
    return arrived


def cells(settings: Sequence[tuple[int, float]], pi_SA: Float[Tensor, "S A"]) -> Cells:
    """The (depth, step size) pairs as cells that all start from one policy."""
    depths, steps = zip(*settings, strict=True)
    pi_BSA = pi_SA.expand(len(settings), *pi_SA.shape)
    return Cells(torch.tensor(depths), torch.tensor(steps, dtype=torch.float64), pi_BSA)


def initial_policy(mdp: TabularMDP, init: Description) -> Float[Tensor, "S A"]:
    """The policy that a description like {"type": "biased", "action": 0, "probability": 1.0} names."""
    return SimplexPolicy(mdp.num_states, mdp.num_actions, Simplex.model_validate({"init": init})).table()
