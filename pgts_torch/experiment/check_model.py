"""The data and the text behind `pgts check-model`: whether an environment can serve as a model, and if not, why."""

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import torch

from pgts_torch.models.environments import EnvSource
from pgts_torch.models.fidelity import Report, check_model

_WIDTH = 79


def answer(env_id: str, *, kwargs: Mapping[str, Any], seed: int) -> Report:
    """Return the report of `check_model` on an environment, on one thread.

    Args:
        env_id, kwargs: the arguments of `gymnasium.make`.
        seed: of the trials.
    """
    torch.set_num_threads(1)
    return check_model(EnvSource.of(env_id, kwargs=kwargs).make_one, seed=seed)


def to_json(report: Report) -> dict[str, Any]:
    """Return a report as JSON values, with `usable` and `verdict`."""
    return asdict(report) | {"usable": report.usable, "verdict": report.verdict}


def describe(report: Report) -> str:
    """Return a report as text of at most 79 columns."""
    return "\n".join(_lines(report))


def _lines(report: Report) -> Iterator[str]:
    states = "" if report.num_states is None else f"{report.num_states} states, "
    yield f"{report.env}: {report.family}, {states}{report.num_actions} actions"
    yield ""
    for check in report.checks:
        mark = "yes" if check.passed else "NO"
        yield from textwrap.wrap(
            f"{check.name:<9}  {mark:<3}  {check.detail}", _WIDTH, subsequent_indent=" " * 16, break_on_hyphens=False
        )
    if (cost := report.cost) is not None:
        yield ""
        yield (
            f"a call   {cost.call:.0f} us = restore {cost.restore:.0f} + step {cost.step:.0f} + snapshot "
            f"{cost.snapshot:.0f}; a snapshot has {cost.bytes:,} bytes"
        )
    yield ""
    yield from textwrap.wrap(report.verdict, _WIDTH, break_on_hyphens=False)
