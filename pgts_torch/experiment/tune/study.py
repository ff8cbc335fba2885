"""The trials of a tuning: proposed by Optuna, trained over several seeds, pruned by what the runs log, kept in SQLite.

A trial is a function of those of the batches before its own: the sampler is seeded by its number, evaluations are
reported in the order of seeds and steps, and trials told in the order of their numbers when a batch is over, however
many runs there are at once. A batch that was cut off is begun again where it was.
"""

import sys
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pgts_torch import files
from pgts_torch.config import ConfigError
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.compare.runs import GREEDY, SAMPLED, J
from pgts_torch.experiment.locking import wait_for
from pgts_torch.experiment.processes import train_all
from pgts_torch.experiment.resume import flat, plain
from pgts_torch.experiment.run import build
from pgts_torch.experiment.statistics import interquartile_mean
from pgts_torch.experiment.summary import Summary, summary_in
from pgts_torch.experiment.tune.space import Option, Plan, Values
from pgts_torch.experiment.tune.watch import Watch

if TYPE_CHECKING:
    import optuna

STUDY = "pgts tune"
FAILURE, SCORES, ABOUT = "failure", "scores", "about"
_BEFORE = ("the configuration", "the options", "--seeds", "--metric", "--batch")


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
        while batch := _batch(study, plan, trials, sampler):
            _train(study, batch, plan, jobs)
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
    now = dict(zip(_BEFORE, (config, options, plan.seeds, plan.metric, plan.batch), strict=True))
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


@dataclass
class _Trial:
    """A trial that is trained.

    failure: why it has failed; empty where it has not.
    names: of its runs that are not finished.
    """

    trial: "optuna.Trial"
    values: Values
    folders: Mapping[int, Path]
    failure: str = ""
    names: Collection[str] = ()


def _batch(study: "optuna.Study", plan: Plan, trials: int, sampler: str) -> list[_Trial]:
    """The trials of a batch that was cut off, else of a new one; none: there are enough."""
    known = study.get_trials(deepcopy=False)
    first = next((trial.number for trial in known if not trial.state.is_finished()), len(known))
    first = first // plan.batch * plan.batch
    found = []
    for number in range(first, min(first + plan.batch, trials)):
        if number >= len(known) or not known[number].state.is_finished():
            trial = _proposed(study, number, sampler)
            values = {option.key: _suggested(trial, option) for option in plan.options}
            found.append(_Trial(trial, values, {seed: folder(plan, number, seed) for seed in range(plan.seeds)}))
    return found


def _proposed(study: "optuna.Study", number: int, sampler: str) -> "optuna.Trial":
    """The trial of this number, a new one where there is none."""
    optuna = imported()
    known = study.get_trials(deepcopy=False)
    seed = int(np.random.SeedSequence([0, number]).generate_state(1)[0])
    samplers = optuna.samplers
    study.sampler = samplers.TPESampler(seed=seed) if sampler == "tpe" else samplers.RandomSampler(seed=seed)
    return study.ask() if number == len(known) else optuna.Trial(study, known[number]._trial_id)


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


def _train(study: "optuna.Study", batch: Sequence[_Trial], plan: Plan, jobs: int) -> None:
    """Train the trials of a batch, and tell the study what they are worth, in their order."""
    watches = {each.trial.number: Watch(each.trial, each.folders, plan) for each in batch}
    runs: dict[str, tuple[str, ...]] = {}
    for each in batch:
        try:
            plan.config(each.values)
        except ConfigError as error:
            each.failure = f"the values do not go together: {error.mistakes[0]}"
            continue
        wait_for(each.folders.values())
        own = trainings(plan, each.values, each.folders)
        runs, each.names = runs | own, own.keys()

    def unwanted(failures: Mapping[str, str]) -> set[str]:
        over = (each for each in batch if failures.keys() & each.names or watches[each.trial.number].looked().is_pruned)
        return {name for each in over for name in each.names}

    failures = train_all(runs, jobs=jobs, unwanted=unwanted)
    for watch in watches.values():
        watch.looked(at_once=True)  # before any trial is told, by which the others would be judged
    for each in batch:
        failed = (f"{name}: {what}" for name, what in failures.items() if name in each.names)
        each.failure = each.failure or next(failed, "")
        _tell(study, each, watches[each.trial.number], plan)


def _tell(study: "optuna.Study", each: _Trial, watch: Watch, plan: Plan) -> None:
    """Tell the study what a trial is worth, and print it."""
    states, trial = imported().trial.TrialState, each.trial
    if each.failure:
        trial.set_user_attr(FAILURE, each.failure)
        study.tell(trial, state=states.PRUNED)  # not FAIL, which the sampler would not learn from
    elif watch.is_pruned:
        study.tell(trial, state=states.PRUNED)
    else:
        summaries = [summary_in(place) for place in each.folders.values()]
        scores = [score(summary, plan.metric) for summary in summaries if summary is not None]
        trial.set_user_attr(SCORES, scores)
        study.tell(trial, float(interquartile_mean(np.array(scores, dtype=np.float64))))
    told = study.get_trials(deepcopy=False)[trial.number]
    worth = told.user_attrs.get(FAILURE) or (
        f"pruned at step {told.last_step:,}" if told.state == states.PRUNED else f"{told.value:.4g}"
    )
    print(f"trial {trial.number}: {worth}", file=sys.stderr, flush=True)
