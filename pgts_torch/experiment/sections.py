"""The sections of a configuration that are of the run, not of the training."""

import json
from typing import Any

from pydantic import ValidationInfo, field_validator

from pgts_torch.options.fields import Count, Folder, Natural, conflict
from pgts_torch.options.part import Part


class LogConfig(Part):
    """What is written down, and when."""

    every: Count = 1
    """Iterations from one line of metrics to the next."""

    checkpoint_every: Natural = 20
    """Iterations from one checkpoint to the next, fewer where they take more than a minute; 0: only after the last, and
    where a signal ends the training."""

    keep: Count = 3
    """Checkpoints that are kept, the newest; the best model is a matter of eval.keep_best."""


class EvalConfig(Part):
    """Episodes of the current policy that nothing is learned from: of the most probable actions, and of drawn ones."""

    every: Count | None = None
    """Environment steps from one evaluation to the next; null: only after the last iteration."""

    episodes: Count = 10
    """Episodes of one evaluation."""

    stop_at_return: float | None = None
    """Training ends once greedy episodes have this mean return; null: it does not. Only with eval.every."""

    keep_best: bool = False
    """Save the model as best.pt whenever greedy episodes have a higher mean return than ever. Only with eval.every."""

    @field_validator("stop_at_return", "keep_best")
    @classmethod
    def _only_during_training(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and value is not False and info.data.get("every", 1) is None:
            name = str(info.field_name)
            raise conflict(
                "eval.{name} is {value}, which needs evaluations during training; eval.every is null",
                f"eval.{name}",
                "eval.every",
                name=name,
                value=json.dumps(value),
            )
        return value


class RunConfig(Part):
    """The folder that the run leaves."""

    dir: Folder | None = None
    """Its path; null: a new one in runs/, named after the run, its seed and the time."""

    overwrite: bool = False
    """Replace an earlier run in run.dir. Otherwise one of the same configuration goes on where it was cut off, and
    any other is refused."""

    tensorboard: bool = True
    """Write TensorBoard events beside metrics.jsonl."""
