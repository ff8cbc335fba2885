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


Pending = Sequence[tuple[tuple[str, str, int], Future[list[float]]]]
"""Sampled runs under way, each with the (update, start, depth) that it belongs to."""


def start(figure: Figure, effort: Effort, executor: Executor) -> Pending:
    """Begin the sampled runs of a figure."""
    return [(key, executor.submit(returns, job)) for key, job in _jobs(figure, effort)]


def finish(figure: Figure, effort: Effort, pending: Pending, report: Report) -> dict[str, Any]:
    """The plain data of a figure: curves, parameters and checked statements."""
    report(f"{figure.name}: exact curves and statements")
    claims = figure.claims(effort.quick)
    panels = [panel(figure, update, start) for update in figure.moves for start in STARTS]
    results = []
    for done, (_, future) in enumerate(pending, 1):
        results.append(future.result())
        if done % max(1, len(pending) // 4) == 0:
            report(f"{figure.name}: {done} of {len(pending)} sampled runs")
    _add_bands(panels, [key for key, _ in pending], results)
    return {
        "part": figure.name,
        "title": figure.title,
        "quick": effort.quick,
        "seeds": effort.seeds,
        "parameters": [asdict(parameter) for parameter in figure.parameters],
        "panels": panels,
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


def _jobs(figure: Figure, effort: Effort) -> list[tuple[tuple[str, str, int], Job]]:
    """All sampled runs, each with the (update, start, depth) that it belongs to."""
    depths = figure.quick_depths if effort.quick else figure.sampled_depths
    jobs = []
    for update, start, depth in itertools.product(figure.moves, STARTS, depths):
        iterations = figure.sampled_iterations[start] // (2 if effort.quick else 1)
        given = sampled_arguments(figure, update, start, depth)
        for seed in range(effort.seeds):
            job = Job((figure.name, update, start, depth, seed), figure.env_id, iterations, given)
            jobs.append(((update, start, depth), job))
    return jobs


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


def _add_bands(panels: list[dict[str, Any]], keys: list[tuple[str, str, int]], results: list[list[float]]) -> None:
    for panel in panels:
        for depth in dict.fromkeys(depth for _, _, depth in keys):
            key = (panel["update"], panel["start"], depth)
            J_NK = np.array([J_K for k, J_K in zip(keys, results, strict=True) if k == key])
            made = asdict(band(J_NK, *key))
            panel["sampled"][str(depth)] = {name: _rounded(values) for name, values in made.items()}


def _rounded(values: list[float]) -> list[float]:
    """Six digits: the data are read by people and kept in version control."""
    return [float(f"{value:.6g}") for value in values]
