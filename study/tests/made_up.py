"""Curves with given returns, to decide statements on; and figures with next to nothing to compute."""

import dataclasses
from typing import Any

import torch

from study import figure
from study.claims import Claim, Finding, judge
from study.curves import Trace
from study.readings import Run
from tests.support import zoo


def made_up(*J: float, J_optimal: float = 10.0, **watched: list[float]) -> Trace:
    """A curve with these returns, as if Algorithm 1 had made it."""
    values = {name.replace("_", " "): torch.tensor(row).double() for name, row in watched.items()}
    return Trace(torch.tensor(J).double(), J_optimal, values)


def made_up_run(traces: dict[int, Trace], **reading: Any) -> Run:
    return Run(reading or {"step size": 0.1}, "s0", zoo("tightrope"), traces)


FLAT, FAST, SLOW, DIP = (made_up(*J) for J in [(0, 0, 0, 0), (0, 10, 10, 10), (0, 2, 4, 10), (0, -3, 10, 10)])
FALLS = made_up(0, 5, 3, 10)


def smallest(shown: figure.Figure) -> figure.Figure:
    """The same figure with next to nothing to compute."""

    def claims(quick: bool) -> list[Claim]:
        return [
            judge(
                f"A statement about {shown.name}",
                "Sec. 3",
                [Finding({"m": 1}, "1.25 a", True), Finding({"m": 2}, "2.5 b", False)],
            )
        ]

    few = {"s0": 2, "uniform": 2}
    return dataclasses.replace(
        shown,
        depths=(0, 1),
        iterations=few,
        sampled_iterations=few,
        quick_depths=(1,),
        num_envs=2,
        critic={"type": "tabular"},
        horizon={"type": "fixed", "length": 3},
        claims=claims,
    )
