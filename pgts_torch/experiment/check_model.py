"""The data and the text behind `pgts check-model`: whether an environment can serve as a model, and if not, why."""

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch

from pgts_torch.errors import MissingModel
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.fidelity import Check, Report, check_model, held
from pgts_torch.models.tabular import tabular_truth

_WIDTH = 79


@dataclass(frozen=True)
class Table:
    """The answer for an environment that publishes its transitions, so that it need not be restored.

    checks: whether its steps agree with the table.
    """

    env: str
    num_states: int
    num_actions: int
    checks: tuple[Check, ...]
    family: str = "table"

    @property
    def usable(self) -> bool:
        """Whether the table can serve as a model."""
        return all(check.passed for check in self.checks)

    @property
    def verdict(self) -> str:
        """The answer as a sentence, with the details of its checks."""
        size = f"{self.env}: a table of {self.num_states} states and {self.num_actions} actions"
        details = "; ".join(check.detail for check in self.checks)
        return f"{size}, {'no snapshot is needed' if self.usable else 'which cannot serve as a model'}; {details}"


def answer(env_id: str, *, kwargs: Mapping[str, Any], seed: int) -> Report | Table:
    """Return the report of `check_model` on an environment, or of its table where it publishes one; on one thread.

    Args:
        env_id, kwargs: the arguments of `gymnasium.make`.
        seed: of the trials.
    """
    torch.set_num_threads(1)
    source = EnvSource.of(env_id, kwargs=kwargs)
    try:
        return check_model(source.make_one, seed=seed)
    except MissingModel as missing:
        try:
            mdp = tabular_truth(source.make_one(), gamma=1.0)
        except MissingModel:
            raise missing from None
        checks = held(source.make_one(), seed=seed)
        return Table(env_id, mdp.num_states, mdp.num_actions, tuple(checks))


def to_json(report: Report | Table) -> dict[str, Any]:
    """Return a report as JSON values, with `usable` and `verdict`."""
    return asdict(report) | {"usable": report.usable, "verdict": report.verdict}


def describe(report: Report | Table) -> str:
    """Return a report as text of at most 79 columns."""
    if isinstance(report, Table):
        return textwrap.fill(report.verdict, _WIDTH, break_on_hyphens=False)
    return "\n".join(_lines(report))


def _lines(report: Report) -> Iterator[str]:
    yield f"{report.env}: {report.family}, {report.num_actions} actions"
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
