"""One figure of the paper: what it shows, computed exactly and from samples."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pgts_torch.agent.build import Description
from pgts_torch.tabular import exact
from pgts_torch.tabular.ascent import projected_step, softmax_step
from pgts_torch.tabular.mdp import TabularMDP
from study.claims import Claim
from study.curves import STARTS, initial_policy, trace
from study.sampled import Job, band, returns

STEPS = {"projected": projected_step, "softmax": softmax_step}

Report = Callable[[str], None]


@dataclass(frozen=True)
class Move:
    """How the policy of one row of panels starts and moves."""

    init: Description
    step_size: float


@dataclass(frozen=True)
class Parameter:
    """What a figure was made with, and whether the paper says so."""

    name: str
    value: str
    source: str


@dataclass(frozen=True)
class Effort:
    """How much a figure may cost. `quick` bounds what is tried; the statements and their checks stay the same."""

    quick: bool
    seeds: int
    workers: int


@dataclass(frozen=True)
class Figure:
    """A figure with return against iteration.

    make: the MDP for start=... (a state, or None for the uniform distribution).
    moves: by update, "projected" first.
    iterations: of the panels, by start.   sampled_iterations: of the sampled runs.
    sampled_depths, quick_depths: the depths that are also run from samples.
    """

    name: str
    title: str
    env_id: str
    make: Callable[..., TabularMDP]
    depths: Sequence[int]
    moves: Mapping[str, Move]
    iterations: Mapping[str, int]
    sampled_iterations: Mapping[str, int]
    sampled_depths: Sequence[int]
    quick_depths: Sequence[int]
    parameters: Sequence[Parameter]
    claims: Callable[[bool], list[Claim]]
    gamma: float = 0.9
    critic: Description = field(default_factory=lambda: {"type": "tabular", "initial": 0.0})
    horizon: Description = field(default_factory=lambda: {"type": "fixed", "length": 40})
    num_envs: int = 32


Pending = Mapping[tuple[str, str, int], Sequence[Future[list[float]]]]
"""Sampled runs under way, a seed each, by (update, start, depth)."""


def start(figure: Figure, effort: Effort, executor: Executor) -> Pending:
    """Begin the sampled runs of a figure."""
    depths, share = (figure.quick_depths, 2) if effort.quick else (figure.sampled_depths, 1)
    pending = {}
    for update, start, depth in itertools.product(figure.moves, STARTS, depths):
        iterations = figure.sampled_iterations[start] // share
        given, names = sampled_arguments(figure, update, start, depth), (figure.name, update, start, depth)
        jobs = [Job((*names, seed), figure.env_id, iterations, given) for seed in range(effort.seeds)]
        pending[update, start, depth] = [executor.submit(returns, job) for job in jobs]
    return pending


def finish(figure: Figure, effort: Effort, pending: Pending, report: Report) -> dict[str, Any]:
    """The plain data of a figure: curves, parameters and checked statements."""
    report(f"{figure.name}: exact curves and statements")
    claims = figure.claims(effort.quick)
    panels = {(update, start): panel(figure, update, start) for update in figure.moves for start in STARTS}
    for done, ((update, start, depth), runs) in enumerate(pending.items(), 1):
        made = band(np.array([run.result() for run in runs]), update, start, depth)
        panels[update, start]["sampled"][str(depth)] = {name: _rounded(J_K) for name, J_K in asdict(made).items()}
        if done % max(1, len(pending) // 4) == 0:
            report(f"{figure.name}: {done} of {len(pending)} settings from samples")
    return {
        "part": figure.name,
        "title": figure.title,
        "quick": effort.quick,
        "seeds": effort.seeds,
        "parameters": [asdict(parameter) for parameter in figure.parameters],
        "panels": list(panels.values()),
        "claims": [claim.plain() for claim in claims],
    }


def panel(figure: Figure, update: str, start: str) -> dict[str, Any]:
    mdp, move = figure.make(start=STARTS[start]), figure.moves[update]
    traces = trace(
        mdp,
        initial_policy(mdp, move.init),
        depths=figure.depths,
        steps=[move.step_size],
        iterations=figure.iterations[start],
        update=STEPS[update],
    )
    return {
        "update": update,
        "start": start,
        "step_size": move.step_size,
        "J_optimal": exact.optimal(mdp).J,
        "exact": {str(depth): _rounded(traces[depth, move.step_size].J_K.tolist()) for depth in figure.depths},
        "sampled": {},
    }


def sampled_arguments(figure: Figure, update: str, start: str, depth: int) -> dict[str, Any]:
    """Arguments of PGTS for the paper's projected update of a simplex policy, or the softmax one."""
    move = figure.moves[update]
    return {
        "depth": depth,
        "policy": {"type": {"projected": "simplex", "softmax": "softmax"}[update], "init": move.init},
        "update": {"type": update, "step_size": move.step_size, "state_weight": "occupancy"},
        "critic": figure.critic,
        "horizon": figure.horizon,
        "num_envs": figure.num_envs,
        "gamma": figure.gamma,
        "env_kwargs": {"start": STARTS[start]},
    }


def _rounded(values: list[float]) -> list[float]:
    """Six digits: the data are read by people and kept in version control."""
    return [float(f"{value:.6g}") for value in values]
