"""The paper's statements on curves, held to exact runs under the readings of what the paper leaves unsaid."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pgts_torch.agent.build import Description
from pgts_torch.tabular.mdp import TabularMDP
from study.claims import Finding, Reading
from study.curves import STARTS, Trace, Watch, initial_policy, trace

SIMILAR = 0.1
"""Similar are curves that no iteration sets apart by more than this share of the way from J^{pi_0} to J*, or, by the
other reading, arrivals that differ by no more than this share, or by one iteration."""

Variants = Sequence[tuple[Reading, Mapping[str, Any]]]
"""Readings of an MDP, each with the arguments of the function that makes it."""


@dataclass(frozen=True)
class Run:
    """Algorithm 1 at several depths under one reading of what the paper leaves unsaid, from one start."""

    reading: Reading
    start: str
    mdp: TabularMDP
    traces: Mapping[int, Trace]

    def without(self, name: str) -> dict[str, Any]:
        """The reading but for one name."""
        return {other: value for other, value in self.reading.items() if other != name}


def exact_runs(
    make: Callable[..., TabularMDP],
    variants: Variants,
    *,
    init: Description,
    depths: Sequence[int],
    steps: Sequence[float],
    iterations: int,
    watch: Watch | None = None,
    starts: Sequence[str] = tuple(STARTS),
) -> list[Run]:
    """Runs for every variant of the MDP, start distribution and step size; those of the figure first."""
    runs = []
    for reading, kwargs in variants:
        for start in starts:
            mdp = make(start=STARTS[start], **kwargs)
            pi_SA = initial_policy(mdp, init)
            found = trace(mdp, pi_SA, depths=depths, steps=steps, iterations=iterations, watch=watch)
            for step in steps:
                traces = {depth: found[depth, step] for depth in depths}
                runs.append(Run({**reading, "step size": step}, start, mdp, traces))
    return runs


def from_start(runs: Iterable[Run], start: str) -> list[Run]:
    """Those from one start."""
    return [run for run in runs if run.start == start]


def deeper(runs: Iterable[Run]) -> Iterator[tuple[Run, int]]:
    """Each run with each of its depths m >= 1."""
    return ((run, m) for run in runs for m in run.traces if m > 0)


def arrivals_text(traces: Mapping[int, Trace]) -> str:
    """`arrival (iteration): 53 for m = 0, never for m = 1`."""
    times = (f"{'never' if run.arrival is None else run.arrival} for m = {depth}" for depth, run in traces.items())
    return "arrival (iteration): " + ", ".join(times)


def similar(reading: Reading, traces: Mapping[int, Trace]) -> list[Finding]:
    """Whether m = 0 and the other depths perform similarly, by both readings of the word."""
    gap = largest_gap(traces)
    curves = f"curves differ from PG's by up to {gap:.1%} of the way to J*"
    arrivals = [run.arrival for run in traces.values()]
    alike = all(_near(arrival, arrivals[0]) for arrival in arrivals)
    return [
        Finding({**reading, "comparison": "of curves"}, f"{curves}; {arrivals_text(traces)}", gap <= SIMILAR),
        Finding({**reading, "comparison": "of arrivals"}, arrivals_text(traces), alike),
    ]


def largest_gap(traces: Mapping[int, Trace]) -> float:
    """The largest distance at any iteration between m = 0 and another depth, as a share of J* - J^{pi_0}."""
    return max(float((run.progress_K - traces[0].progress_K).abs().max()) for m, run in traces.items() if m > 0)


def _near(arrival: int | None, other: int | None) -> bool:
    if arrival is None or other is None:
        return arrival == other
    return abs(arrival - other) <= max(1, SIMILAR * other)
