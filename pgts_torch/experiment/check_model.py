"""The data and the text behind `pgts check-model`: whether an environment can serve as a model, and what is missing."""

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import torch

from pgts_torch.models.environments import make_env
from pgts_torch.models.fidelity import Report, check_model

_WIDTH = 79


def answer(env_id: str, *, kwargs: Mapping[str, Any], seed: int) -> Report:
    """What `check_model` finds of an id and the arguments of `gymnasium.make`, on one thread."""
    torch.set_num_threads(1)
    return check_model(lambda: make_env(env_id, **kwargs), seed=seed)


def to_json(report: Report) -> dict[str, Any]:
    """All that is in a report, and what follows from it."""
    return asdict(report) | {"usable": report.usable, "verdict": report.verdict}


def describe(report: Report) -> str:
    """The report for people: at most 79 columns."""
    return "\n".join(_lines(report))


def _lines(report: Report) -> Iterator[str]:
    yield f"{report.env}: {report.family}, {report.num_actions} actions"
    yield ""
    for check in report.checks:
        mark = "yes" if check.passed else "NO"
        yield from textwrap.wrap(
            f"{check.name:<9}  {mark:<3}  {check.detail}", _WIDTH, subsequent_indent=" " * 16, break_on_hyphens=False
        )
    cost = report.cost
    yield ""
    yield (
        f"a call   {cost.call:.0f} us = restore {cost.restore:.0f} + step {cost.step:.0f} + snapshot "
        f"{cost.snapshot:.0f}; a snapshot has {cost.bytes:,} bytes"
    )
    yield ""
    yield from textwrap.wrap(report.verdict, _WIDTH, break_on_hyphens=False)
