"""What the runs of a trial have come to so far, reported to Optuna, which says whether the trial is given up."""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from pgts_torch.experiment.report.facts import metrics
from pgts_torch.experiment.statistics import interquartile_mean
from pgts_torch.experiment.summary import summary_in
from pgts_torch.experiment.tune.space import Plan

if TYPE_CHECKING:
    import optuna

PRUNED = "pruned"
"""The step at which a trial was given up, kept because others of its batch are told before it."""

_LOOK = 0.5
"""Seconds between two looks at what runs have logged."""


@final
class Watch:
    """Reports the evaluations that the runs of a trial log, in the order of seeds and steps.

    is_pruned: whether the trial is given up.

    What is reported at a step of a seed is the interquartile mean over this seed and those before it, at this step.
    """

    def __init__(self, trial: "optuna.Trial", folders: Mapping[int, Path], plan: Plan) -> None:
        self._trial, self._folders, self._plan = trial, folders, plan
        self._every, self._total = plan.base.eval.every or 1, plan.base.total_steps
        self._told = set(trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values)
        self._looked_at = 0.0
        is_late = max(self._told, default=self._last) == self._last
        self.is_pruned = PRUNED in trial.user_attrs or (not is_late and trial.should_prune())

    def looked(self, *, at_once: bool = False) -> "Watch":
        """Report what is new, unless it was looked for a moment ago."""
        if at_once or time.monotonic() - self._looked_at > _LOOK:
            for step, value in self._evaluations():
                if self.is_pruned:
                    break
                if step not in self._told:
                    self._told.add(step)
                    self._trial.report(value, step)
                    self.is_pruned = step < self._last and self._trial.should_prune()
                    if self.is_pruned:
                        self._trial.set_user_attr(PRUNED, step)
            self._looked_at = time.monotonic()
        return self

    @property
    def _last(self) -> int:
        """The last step of all: nothing is saved by pruning there."""
        return len(self._folders) * self._total

    def _evaluations(self) -> Iterator[tuple[int, float]]:
        """Steps and values, up to the first seed that is still being trained."""
        curves: list[tuple[list[int], list[float]]] = []
        for number, place in enumerate(self._folders.values()):
            lines = metrics(place, [])
            points = {
                line["step"]: line[self._plan.metric] for line in lines if line.get(self._plan.metric) is not None
            }
            curves.append((list(points), list(points.values())))
            for at, value in points.items():
                if at < self._every:
                    continue
                earlier = [float(np.interp(at, *curve)) for curve in curves[:-1]]
                step = number * self._total + min(at // self._every * self._every, self._total)
                yield step, float(interquartile_mean(np.array([*earlier, value])))
            if summary_in(place) is None or not points:
                return
