"""The trials of a tuning: proposed by Optuna, trained over several seeds, pruned by what the runs log, kept in SQLite.

A trial is a function of those before it: the sampler is seeded by its number, and evaluations are reported in the order
of seeds and steps, however many runs there are at once. A trial that was cut off is begun again where it was.
"""

import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np

from pgts_torch import files
from pgts_torch.config import ConfigError
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.compare.runs import GREEDY, SAMPLED, J
from pgts_torch.experiment.locking import wait_for
from pgts_torch.experiment.processes import train_all
from pgts_torch.experiment.report.facts import metrics
from pgts_torch.experiment.resume import flat, plain
from pgts_torch.experiment.run import build
from pgts_torch.experiment.statistics import interquartile_mean
from pgts_torch.experiment.summary import Summary, summary_in
from pgts_torch.experiment.tune.space import Option, Plan, Values

if TYPE_CHECKING:
    import optuna

STUDY = "pgts tune"
FAILURE, SCORES, ABOUT = "failure", "scores", "about"
_LOOK = 0.5
"""Seconds between two looks at what runs have logged."""

_BEFORE = ("the configuration", "the options", "--seeds", "--metric")


@dataclass(frozen=True)
class Pruning:
    """When a trial is given up: where its best evaluation so far is among the worst of those of complete trials at the
    same step. Steps are environment steps of all seeds, one after the other.

    share: of trials that are worse; 0.5: those below the median. 0: none is pruned.
    after_trials: complete trials before any is pruned.
    after_steps: environment steps before a trial is pruned.
    """

    share: float = 0.5
    after_trials: int = 5
    after_steps: int = 0


def score(summary: Summary, metric: str) -> float | None:
    """What a finished run is worth."""
    kinds = {GREEDY: summary.deterministic.episodic_return.mean, SAMPLED: summary.sampled.episodic_return.mean}
    return summary.J if metric == J else kinds[metric]


def run_trials(
    plan: Plan, *, trials: int, jobs: int, pruning: Pruning, sampler: Literal["tpe", "random"], storage: Path
) -> "optuna.Study":
    """Train so many trials, counting those that are in the storage already.

    Raises:
        PgtsError: the storage is of another tuning, or cannot be written to.
        Stopped: a signal came; the same command goes on.
    """
    optuna = imported()
    with _refused(storage):
        study = _opened(plan, storage)
        study.pruner = (
            optuna.pruners.PercentilePruner(
                100 * (1 - pruning.share), n_startup_trials=pruning.after_trials, n_warmup_steps=pruning.after_steps
            )
            if pruning.share
            else optuna.pruners.NopPruner()
        )
        while (trial := _next(study, trials, sampler)) is not None:
            _train(study, trial, plan, jobs)
    return study


def check(plan: Plan, storage: Path) -> None:
    """Check what can be checked before anything is written.

    Raises:
        PgtsError: Optuna is not installed, the first configuration cannot be built, or something else is in the place
            of the storage.
    """
    imported()
    import sqlalchemy

    found = files.kind(storage, follow=True)
    if found not in (None, "file"):
        raise PgtsError(f"--storage {storage} is a {found}; it must be a file, or not exist")
    parent = storage.parent
    if parent != plan.out and files.kind(parent, follow=True) != "folder":
        raise PgtsError(f"--storage {storage}: {parent} is not a folder")
    with _refused(storage):
        tables = sqlalchemy.inspect(sqlalchemy.create_engine(_url(storage))).get_table_names() if found else []
    if tables and "trials" not in tables:
        raise PgtsError(f"--storage {storage} is a database of something else, with {files.listing(tables)}")
    with build(plan.base) as algorithm:
        if plan.metric == J and algorithm.world.mdp is None:
            raise PgtsError(f"--metric {J}: the exact return is not known in {plan.base.env.id}; take {GREEDY}")


def _url(storage: Path) -> str:
    import sqlalchemy

    return sqlalchemy.URL.create("sqlite", database=str(storage)).render_as_string()


def imported() -> Any:
    """Optuna, quiet; PgtsError where it is not installed."""
    try:
        import optuna
    except ImportError as error:
        raise PgtsError("pgts tune needs Optuna, which is not installed: pip install 'pgts_torch[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    return optuna


@contextmanager
def _refused(storage: Path) -> Iterator[None]:
    """PgtsError where the storage cannot be used."""
    import sqlalchemy.exc

    try:
        yield
    except (sqlalchemy.exc.SQLAlchemyError, imported().exceptions.StorageInternalError) as error:
        cause = error.__cause__ or error
        reason = str(getattr(cause, "orig", None) or cause).partition("\n")[0]
        raise PgtsError(f"the storage {storage} cannot be used: {reason}") from error


def _opened(plan: Plan, storage: Path) -> "optuna.Study":
    """The study in the storage, a new one where there is none; PgtsError where it is of another tuning."""
    optuna = imported()
    kept = optuna.storages.RDBStorage(_url(storage), engine_kwargs={"connect_args": {"timeout": 60}})
    name = STUDY if storage.parent.resolve() == plan.out.resolve() else f"{STUDY} {plan.out.resolve()}"
    study = optuna.create_study(storage=kept, study_name=name, direction="maximize", load_if_exists=True)
    options = {option.key: option.spec for option in plan.options}
    config = {key: value for key, value in flat(plain(plan.base)).items() if key not in options}
    now = dict(zip(_BEFORE, (config, options, plan.seeds, plan.metric), strict=True))
    before = study.user_attrs.get(ABOUT)
    if before is None and not study.trials:
        study.set_user_attr(ABOUT, now)
    elif before != now:
        raise PgtsError(f"{storage} holds another tuning: {_difference(before or {}, now)}; choose another --out")
    return study


def _difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    for name, value in now.items():
        earlier = before.get(name)
        if not isinstance(value, dict) or not isinstance(earlier, dict):
            if earlier != value:
                return f"{name} is {value}, and was {earlier}"
            continue
        for key in dict.fromkeys((*value, *earlier)):
            if value.get(key) != earlier.get(key):
                return f"{key} is {value.get(key)}, and was {earlier.get(key)}"
    return "it is not of pgts tune"


def _next(study: "optuna.Study", trials: int, sampler: str) -> "optuna.Trial | None":
    """The trial that was cut off, else a new one; None: there are enough."""
    optuna = imported()
    known = study.get_trials(deepcopy=False)
    cut = next((trial.number for trial in known if trial.state == optuna.trial.TrialState.RUNNING), None)
    number = len(known) if cut is None else cut
    if number >= trials:
        return None
    seed = int(np.random.SeedSequence([0, number]).generate_state(1)[0])
    samplers = optuna.samplers
    study.sampler = samplers.TPESampler(seed=seed) if sampler == "tpe" else samplers.RandomSampler(seed=seed)
    return study.ask() if cut is None else optuna.Trial(study, known[cut]._trial_id)


def _suggested(trial: "optuna.Trial", option: Option) -> float | int | str:
    if option.kind == "choice":
        return trial.suggest_categorical(option.key, option.choices)
    if option.is_whole:
        return trial.suggest_int(option.key, int(option.low), int(option.high), log=option.is_log)
    return trial.suggest_float(option.key, option.low, option.high, log=option.is_log)


def folder(plan: Plan, number: int, seed: int) -> Path:
    return plan.out / f"trial-{number:04d}" / f"seed-{seed}"


def trainings(plan: Plan, values: Values, folders: Mapping[int, Path]) -> dict[str, tuple[str, ...]]:
    """The arguments of `pgts train` for the runs that are not finished, by name, from the folders by seed."""
    config = ("--config", plan.path) if plan.path is not None else ()
    found = {}
    for seed, place in folders.items():
        if summary_in(place) is None:
            own = {"seed": seed, "threads": 1, "run.dir": place, "run.overwrite": "false"}
            found[f"{place.parent.name}, seed {seed}"] = (*config, *plan.arguments(values, own))
    return found


def _train(study: "optuna.Study", trial: "optuna.Trial", plan: Plan, jobs: int) -> None:
    """Train a trial, and tell the study what it is worth."""
    states = imported().trial.TrialState
    values = {option.key: _suggested(trial, option) for option in plan.options}
    folders = {seed: folder(plan, trial.number, seed) for seed in range(plan.seeds)}
    watch = Watch(trial, folders, plan)
    failures: Mapping[str, str] = {}
    try:
        plan.config(values)
        wait_for(folders.values())
        failures = train_all(trainings(plan, values, folders), jobs=jobs, is_over=watch)
    except ConfigError as error:
        failures = {"the values do not go together": error.mistakes[0]}
    if failures:
        where, what = next(iter(failures.items()))
        trial.set_user_attr(FAILURE, f"{where}: {what}")
        study.tell(trial, state=states.PRUNED)  # not FAIL, which the sampler would not learn from
    elif watch.looked(at_once=True).is_pruned:
        study.tell(trial, state=states.PRUNED)
    else:
        summaries = [summary_in(place) for place in folders.values()]
        scores = [score(each, plan.metric) for each in summaries if each is not None]
        trial.set_user_attr(SCORES, scores)
        study.tell(trial, float(interquartile_mean(np.array(scores, dtype=np.float64))))
    told = study.get_trials(deepcopy=False)[trial.number]
    worth = told.user_attrs.get(FAILURE) or (
        f"pruned at step {told.last_step:,}" if told.state == states.PRUNED else f"{told.value:.4g}"
    )
    print(f"trial {trial.number}: {worth}", file=sys.stderr, flush=True)


@final
class Watch:
    """Reports the evaluations that the runs of a trial log, in the order of seeds and steps, and says when it is over:
    it is pruned, or a run has failed.

    What is reported at a step of a seed is the interquartile mean over this seed and those before it, at this step.
    """

    def __init__(self, trial: "optuna.Trial", folders: Mapping[int, Path], plan: Plan) -> None:
        self._trial, self._folders, self._plan = trial, folders, plan
        self._every, self._total = plan.base.eval.every or 1, plan.base.total_steps
        self._told = set(trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values)
        self._looked_at = 0.0
        self.is_pruned = max(self._told, default=self._last) < self._last and trial.should_prune()

    def __call__(self, failures: Mapping[str, str]) -> bool:
        return bool(failures) or self.looked().is_pruned

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
