"""The command `pgts tune`: which values are tried, what they are worth, and a tuning that is cut off."""

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pgts_torch.cli.main import main
from pgts_torch.config import load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.compare.comparison import compare
from pgts_torch.experiment.compare.text import to_json
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.statistics import estimate
from pgts_torch.experiment.tune import result, space, watch
from tests.experiment import finished
from tests.experiment.runs import tree
from tests.forks import ForkedCommand, in_child

optuna = pytest.importorskip("optuna")
import sqlalchemy  # noqa: E402
import sqlalchemy.event  # noqa: E402

from pgts_torch.experiment.tune import study as studies  # noqa: E402 (needs nothing of it, but would be of no use)

LADDER = ["--total_steps", "1000", "--eval.every", "250", "--run.tensorboard", "false"]
STEP = "update.step_size=log(0.01,100)"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Trainer:
    """In place of `train_all`: leaves the files of runs whose greedy return is a function of their configuration.

    A run leaves one evaluation more each time it is looked at, as one that trains would.

    Attributes:
        trained: the names of the runs, in the order in which they began.
        worth: of a configuration, the return at its end. A message: the run fails.
    """

    def __init__(self, worth: Callable[[Any], float | str]) -> None:
        self.trained: list[str] = []
        self.evaluations = 0
        self.worth = worth

    def __call__(
        self,
        trainings: Mapping[str, Sequence[str]],
        *,
        jobs: int,
        unwanted: Callable[[Mapping[str, str]], Collection[str]] = lambda failures: (),
    ) -> dict[str, str]:
        failures: dict[str, str] = {}
        waiting = list(trainings.items())
        while waiting := [each for each in waiting if each[0] not in unwanted(failures)]:
            started, waiting = waiting[:jobs], waiting[jobs:]
            self.trained += [name for name, _ in started]
            running = [(name, load(None, arguments)) for name, arguments in started]
            for step in range(250, 1001, 250):
                off = unwanted(failures)
                for name, config in running:
                    if name not in off:
                        self.train(name, config, step, failures)
        return failures

    def train(self, name: str, config: Any, step: int, failures: dict[str, str]) -> None:
        """Train a run up to its next evaluation."""
        worth = self.worth(config)
        if isinstance(worth, str):
            failures[name] = worth
            return
        points = [(at, worth * at / 1000) for at in range(250, step + 1, 250)]
        lines = [{"step": at, "eval/deterministic_return": value} for at, value in points]
        place = Path(str(config.run.dir))
        if not (place / "config.yaml").exists():
            finished.leave(place, config, lines)
        (place / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        self.evaluations += 1
        if step == 1000:
            what = finished.summary(config, J=None, env_steps=1000, greedy=worth)
            (place / "summary.json").write_text(json.dumps(asdict(what)))


def near_one(config: Any) -> float:
    """Best where the step size is 1."""
    return 100 - 20 * abs(np.log10(config.update.step_size)) + config.seed


@pytest.fixture
def unsynced() -> Iterator[None]:
    """SQLite does not wait for the disk, which takes longer than all else here."""

    def on_connect(connection: sqlite3.Connection, record: object) -> None:
        connection.execute("PRAGMA synchronous = OFF")

    sqlalchemy.event.listen(sqlalchemy.Engine, "connect", on_connect)
    yield
    sqlalchemy.event.remove(sqlalchemy.Engine, "connect", on_connect)


@pytest.fixture
def trainer(here: Path, unsynced: None, monkeypatch: pytest.MonkeyPatch) -> Trainer:
    made = Trainer(near_one)
    monkeypatch.setattr(result, "png", lambda drawn: b"a picture")
    monkeypatch.setattr(studies, "train_all", made)
    monkeypatch.setattr(result, "train_all", made)
    monkeypatch.setattr(watch, "_LOOK", 0.0)
    return made


def tuned(*more: str, out: str = "out", options: Sequence[str] = (STEP,)) -> dict[str, Any]:
    given = [f"--option={option}" for option in options]
    assert main(["tune", "--out", out, *given, "--update.type=mirror", *LADDER, "--seeds=2", *more]) == 0
    return json.loads(Path(out, "tune.json").read_text())


def without(answer: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in answer.items() if name not in names}


def test_the_best_trial_is_that_of_the_best_configuration_and_the_file_of_it_trains(trainer, capsys):
    answer = tuned("--trials=12", "--prune=0")
    steps = [trial["values"]["update.step_size"] for trial in answer["trials"]]
    assert len(steps) == 12
    assert all(0.01 <= step <= 100 for step in steps)
    best = answer["trials"][answer["best"]]
    assert abs(np.log10(best["values"]["update.step_size"])) == min(abs(np.log10(steps)))
    base = 100 - 20 * abs(np.log10(best["values"]["update.step_size"]))
    scores = np.array([base, base + 1])
    assert best["score"] == asdict(estimate([scores]))
    config = load("out/best.yaml")
    assert config.update.plain()["step_size"] == best["values"]["update.step_size"]
    assert (config.run.dir, config.seed, config.total_steps) == (None, 0, 1000)
    assert answer["importance"] == {"update.step_size": 1.0}
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) < 80
    assert out.splitlines()[-2:] == ["pgts train --config out/best.yaml", "pgts compare out --finished"]
    assert len(trainer.trained) == 24


def test_values_are_proposed_from_what_earlier_ones_came_to():
    def mean_distance(sampler: str) -> float:
        study, distances = optuna.create_study(direction="maximize"), []
        for number in range(60):
            trial = studies._proposed(study, number, sampler)
            distances.append(abs(np.log10(studies._suggested(trial, space.option(STEP)))))
            study.tell(trial, -distances[-1])
        return float(np.mean(distances[30:]))

    assert mean_distance("random") == pytest.approx(1, abs=0.3)
    assert mean_distance("tpe") < 0.4
    assert mean_distance("tpe") == mean_distance("tpe")


def test_trials_below_the_median_are_pruned_and_their_runs_stay_unfinished(trainer):
    answer = tuned("--trials=16")
    states = [trial["state"] for trial in answer["trials"]]
    assert states[:5] == ["complete"] * 5
    assert 3 < states.count("pruned") < 11
    assert trainer.evaluations < 16 * 2 * 4 - 10
    pruned = states.index("pruned")
    assert answer["trials"][pruned]["score"] is None
    assert not Path(f"out/trial-{pruned:04d}/seed-0/summary.json").exists()
    worst = min(trial["score"]["mean"] for trial in answer["trials"][5:] if trial["score"])
    assert worst >= sorted(trial["score"]["mean"] for trial in answer["trials"][:5])[1]
    found = [trial["state"] for trial in tuned("--trials=16", "--prune=0.2", out="p")["trials"]]
    assert found.count("pruned") < states.count("pruned")
    found = [trial["state"] for trial in tuned("--trials=10", "--prune-trials=9", out="late")["trials"]]
    assert found[:9] == ["complete"] * 9


def test_no_trial_is_pruned_before_the_steps_that_it_is_given(trainer):
    def pruned_at(*more: str, out: str) -> list[int]:
        tuned("--trials=10", "--prune-trials=2", *more, out=out)
        study = optuna.load_study(study_name=studies.STUDY, storage=f"sqlite:///{out}/tune.db")
        return [trial.last_step for trial in study.trials if trial.state.name == "PRUNED"]

    assert min(pruned_at(out="soon")) == 250
    late = pruned_at("--prune-steps=1400", out="late")
    assert late
    assert min(late) >= 1500  # the second evaluation of the second seed


@pytest.mark.parametrize("batch", [1, 3])
def test_how_many_runs_there_are_at_once_changes_nothing(batch, trainer):
    one, all_at_once = (tuned("--trials=14", f"--batch={batch}", f"--jobs={jobs}", out=f"j{jobs}") for jobs in (1, 6))
    assert without(one, "out") == without(all_at_once, "out")
    assert any(trial["state"] == "pruned" for trial in one["trials"])


def test_trials_of_a_batch_run_side_by_side_and_are_proposed_without_each_other(trainer):
    alone = tuned("--trials=14", "--prune=0", out="alone")
    begun = len(trainer.trained)
    batch = tuned("--trials=14", "--prune=0", "--batch=7", "--jobs=3")
    assert trainer.trained[begun : begun + 3] == ["trial-0000, seed 0", "trial-0000, seed 1", "trial-0001, seed 0"]
    values = [[trial["values"]["update.step_size"] for trial in each["trials"]] for each in (alone, batch)]
    assert values[0][:10] == values[1][:10]  # which are drawn at random
    study = optuna.create_study(direction="maximize")
    for trial in batch["trials"][:7]:
        known = studies._proposed(study, trial["number"], "tpe")
        assert studies._suggested(known, space.option(STEP)) == trial["values"]["update.step_size"]
        study.tell(known, trial["score"]["mean"])
    for trial in batch["trials"][7:]:
        found = studies._suggested(studies._proposed(study, trial["number"], "tpe"), space.option(STEP))
        assert found == trial["values"]["update.step_size"]


def test_one_trial_of_a_batch_may_fail_or_be_pruned_while_the_others_go_on(trainer):
    trainer.worth = lambda config: "loss is nan" if config.update.step_size > 10 else near_one(config)
    answer = tuned("--trials=16", "--batch=4", "--jobs=8", "--prune-trials=3")
    for trial in answer["trials"]:
        assert (trial["values"]["update.step_size"] > 10) == (trial["state"] == "failed")
    mixed = [{trial["state"] for trial in answer["trials"][at : at + 4]} for at in range(0, 16, 4)]
    assert {"complete", "failed"} <= set.union(*(states for states in mixed if len(states) > 1))
    assert any(trial["state"] == "pruned" for trial in answer["trials"])


class Killed(BaseException):
    """Stands for `kill -9`."""


@pytest.mark.fault("tuning killed at any moment")
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("where", ["ask", "report", "train", "tell"])
def test_a_tuning_that_is_killed_goes_on_with_the_same_trial_and_ends_as_if_it_had_not_been(
    where, batch, trainer, monkeypatch
):
    options = ["--trials=9", "--prune-trials=3", f"--batch={batch}"]
    whole = tuned(*options, out="whole")
    assert any(trial["state"] == "pruned" for trial in whole["trials"])
    calls = {"n": 0}
    owner, name = {
        "ask": (optuna.Study, "ask"),
        "report": (optuna.Trial, "report"),
        "train": (Trainer, "__call__"),
        "tell": (optuna.Study, "tell"),
    }[where]
    plain = getattr(owner, name)

    def dies(*args: Any, **kwargs: Any) -> Any:
        calls["n"] += 1
        if calls["n"] in (2, 4, 7, 30) and where != "ask":
            raise Killed
        answer = plain(*args, **kwargs)
        if calls["n"] in (3, 7) and where == "ask":
            raise Killed  # the trial is in the storage, without values
        return answer

    monkeypatch.setattr(owner, name, dies)
    deaths = 0
    while not Path("out/tune.json").exists():
        try:
            tuned(*options)
        except Killed:
            deaths += 1
    assert deaths >= 2
    answer = json.loads(Path("out/tune.json").read_text())
    assert without(answer, "out") == without(whole, "out")


@pytest.mark.fault("tuning killed at any moment")
def test_trainings_that_outlive_a_tuning_are_waited_for(trainer, monkeypatch, capsys):
    whole = tuned("--trials=3", out="whole")
    left, waits = RunLock(Path("out/trial-0001/seed-1")), list[float]()

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            left.__exit__()

    monkeypatch.setattr(time, "sleep", sleep)
    assert without(tuned("--trials=3"), "out") == without(whole, "out")
    assert len(waits) == 3
    waiting = f"waiting: run.dir out/trial-0001/seed-1 is in use by the process {os.getpid()}"
    assert capsys.readouterr().err.splitlines().count(waiting) == 1


def test_a_tuning_that_is_done_trains_nothing_and_more_trials_are_added(trainer):
    first = tuned("--trials=6")
    count = len(trainer.trained)
    assert without(tuned("--trials=6"), "out") == without(first, "out")
    assert tuned("--trials=3")["trials"] == first["trials"]
    assert len(trainer.trained) == count
    more = tuned("--trials=8", "--confirm=3")
    assert more["trials"][:6] == first["trials"]
    assert len(more["trials"]) == 8
    best = more["trials"][more["best"]]
    assert trainer.trained[-3:] == [f"best-{more['best']:04d}, seed {seed}" for seed in (2, 3, 4)]
    assert more["confirmed"]["mean"] == pytest.approx(best["score"]["mean"] + 2.5)


def test_a_trial_that_fails_is_named_and_the_sampler_keeps_away(trainer, capsys):
    trainer.worth = lambda config: "loss is nan" if config.update.step_size > 1 else near_one(config)
    answer = tuned("--trials=24", "--seeds=1", "--prune=0")
    failed = [trial for trial in answer["trials"] if trial["state"] == "failed"]
    assert all(trial["failure"].endswith("seed 0: loss is nan") for trial in failed)
    assert all((trial["values"]["update.step_size"] > 1) == (trial["state"] == "failed") for trial in answer["trials"])
    early, late = (
        sum(trial["state"] == "failed" for trial in part) for part in (answer["trials"][:10], answer["trials"][14:])
    )
    assert late < early
    assert "trial-0" in capsys.readouterr().out
    trainer.worth = lambda config: "no"
    assert (
        main(["tune", "--out", "none", "--option", STEP, *LADDER, "--update.type=mirror", "--trials=2", "--seeds=1"])
        == 1
    )
    assert "no trial is complete" in capsys.readouterr().out
    assert not Path("none/best.yaml").exists()


def test_values_that_do_not_go_together_are_a_failed_trial(trainer):
    trainer.worth = lambda config: float(config.seed)
    answer = tuned(
        "--search.kind=expectimax", "--trials=12", options=["search.doubt=false,true", "search.max_width=null,5"]
    )
    for trial in answer["trials"]:
        both = tuple(trial["values"].values()) == ("true", "5")
        assert (trial["state"] == "failed") == both
        assert ("search.doubt needs all states of a level" in trial["failure"]) == both
    assert 0 < sum(trial["state"] == "failed" for trial in answer["trials"]) < 8


def test_whole_numbers_are_tuned_and_what_matters_is_important(trainer):
    trainer.worth = lambda config: float(config.search.depth)
    answer = tuned("--trials=15", "--prune=0", options=["search.depth=int(1,4)", "rollout.num_envs=logint(1,100)"])
    assert {trial["values"]["search.depth"] for trial in answer["trials"]} == {1, 2, 3, 4}
    assert all(type(value) is int for trial in answer["trials"] for value in trial["values"].values())
    assert answer["importance"]["search.depth"] > 0.7
    assert sum(answer["importance"].values()) == pytest.approx(1)


def test_the_runs_of_trials_are_compared(trainer):
    trainer.worth = lambda config: float(config.search.depth)
    answer = tuned("--trials=4", options=["search.depth=1,2,3"])
    found = to_json(compare([Path("out")]))
    depths = {trial["values"]["search.depth"] for trial in answer["trials"]}
    assert [group["label"] for group in found["groups"]] == [f"search.depth {depth}" for depth in sorted(depths)]


def refused(capsys: pytest.CaptureFixture[str], *more: str) -> str:
    before = tree(Path())
    assert main(["tune", "--option", STEP, "--update.type=mirror", *LADDER, *more]) == 2
    assert tree(Path()) == before
    out, err = capsys.readouterr()
    [mistake] = err.splitlines()
    assert not out
    return mistake


@pytest.mark.fault("folder of the user as an output")
def test_a_folder_with_other_things_only_is_left_alone_and_others_are_named(trainer, capsys):
    Path("thesis.tex").write_text("mine")
    expected = "error: --out . holds files that no tuning has left (thesis.tex); choose another folder"
    assert refused(capsys, "--out", ".") == expected
    first = tuned("--trials=2")
    capsys.readouterr()
    Path("out/thesis.tex").write_text("mine")
    assert tuned("--trials=2") == first
    assert capsys.readouterr().err == "note: --out out also holds thesis.tex, which no tuning has left; it stays\n"
    assert Path("out/thesis.tex").read_text() == "mine"


@pytest.mark.fault("file of the user under the name of an output")
def test_a_database_of_something_else_is_left_alone(trainer, capsys):
    with contextlib.closing(sqlite3.connect("mine.db")) as database:
        database.execute("CREATE TABLE songs (name TEXT)")
    mistake = refused(capsys, "--out", "out", "--storage", "mine.db")
    assert mistake == "error: --storage mine.db is a database of something else, with songs"
    optuna.create_study(storage="sqlite:///shared.db", study_name="another")
    tuned("--trials=1", "--storage=shared.db")
    names = optuna.get_all_study_names("sqlite:///shared.db")
    assert names == ["another", f"pgts tune {Path('out').resolve()}"]


@pytest.mark.parametrize(
    ("spec", "kind", "ends"),
    [
        ("a.b=log(1e-3, 1)", "log", (1e-3, 1.0)),
        ("--a=int(1,8)", "int", (1, 8)),
        ("a=logint(1,64)", "logint", (1, 64)),
        ("a=uniform(-1,2.5)", "uniform", (-1.0, 2.5)),
        ("a=x,'y, z',linear(1,0,5),[1,2]", "choice", ("x", "'y, z'", "linear(1,0,5)", "[1,2]")),
    ],
)
def test_an_option_is_read(spec, kind, ends):
    found = space.option(spec)
    assert (found.kind, found.ends) == (kind, ends)


MISTAKES = {
    "": "nothing is tuned: give --option KEY=VALUES, with uniform(LOW,HIGH), log(LOW,HIGH), int(LOW,HIGH), logint",
    "--option x": "--option x is not KEY=VALUES",
    "--option update.step_size=log(0,1)": "on a logarithmic scale the ends must be above 0",
    "--option update.step_size=log(2,1)": "the ends must be two ascending numbers",
    "--option update.step_size=log(a,1)": "the ends must be two ascending numbers",
    "--option search.depth=int(1,2.5)": "the ends must be whole numbers",
    "--option search.depth=3": "VALUES must be uniform(LOW,HIGH)",
    "--option search.depth=3,3": "VALUES must be uniform(LOW,HIGH)",
    "--option search.depth=int(-1,4)": "--option search.depth=int(-1,4): --search.depth is -1",
    "--option search.depth=uniform(0,4)": "--option search.depth=uniform(0,4): --search.depth is 0.0",
    "--option search.depht=int(1,4)": "--search.depht is unknown; did you mean --search.depth?",
    "--option seed=1,2": "--option seed is set by the tuning: --seeds says how many",
    "--option eval.episodes=1,2": "--option eval.episodes would change what is measured",
    "--option total_steps=1,2": "--option total_steps would change what is measured",
    "--option search.depth=1,2 --search.depth 3": "--search.depth is tuned by --option search.depth=1,2; give one",
    "--option search.depth=1,2 --option search.depth=3,4": "--option search.depth is given twice",
    "--option search.depth=1,2 --seed 3": "--seed is set by the tuning: --seeds says how many",
    "--option search.depth=1,2 --trials 0": "--trials: '0'",
    "--option search.depth=1,2 --prune 2": "--prune: '2' is not a number in [0, 1]",
    "--option search.depth=1,2 --env.id CartPole-v1 --policy softmax": "the policy 'softmax' is a table",
    "--option search.depth=1,2 --storage nowhere/x.db": "error: --storage nowhere/x.db: nowhere is not a folder",
    "--option search.depth=1,2 --config none.yaml": "error: none.yaml: the configuration cannot be read: No such file",
    "--option search.depth=1,2 --env.id CartPole-v1 --metric exact/J": "the exact return is not known in CartPole-v1",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_line_with_exit_code_2_and_starts_nothing(arguments, here, trainer, capsys):
    assert main(["tune", "--out", "o", *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    [mistake] = err.splitlines()
    assert mistake.startswith("error: ")
    assert MISTAKES[arguments] in mistake
    assert trainer.trained == []
    assert not list(here.iterdir())


def test_another_tuning_or_something_else_in_the_storage_is_refused(trainer, capsys):
    tuned("--trials=2")

    def refused(*more: str, options: Sequence[str] = (STEP,)) -> str:
        given = [f"--option={option}" for option in options]
        assert main(["tune", "--out", "out", *given, "--update.type=mirror", *LADDER, "--trials=2", *more]) == 2
        return capsys.readouterr().err

    capsys.readouterr()
    assert refused("--seeds=3") == (
        "error: out/tune.db holds another tuning: --seeds is 3, and was 2; choose another --out\n"
    )
    assert "--batch is 2, and was 1" in refused("--seeds=2", "--batch=2")
    assert "search.depth is 2, and was 4" in refused("--seeds=2", "--search.depth=2")
    assert "update.step_size is log(0.1,1), and was log(0.01,100)" in refused(
        "--seeds=2", options=["update.step_size=log(0.1,1)"]
    )
    Path("thesis.db").write_text("mine, and long enough for a header of SQLite" * 10)
    assert "the storage thesis.db cannot be used: file is not a database" in refused("--seeds=2", "--storage=thesis.db")
    assert Path("thesis.db").read_text().startswith("mine")
    Path("folder").mkdir()
    assert "--storage folder is a folder; it must be a file" in refused("--seeds=2", "--storage=folder")
    Path("out/best.yaml").write_text("mine")
    Path("out/tune.json").write_text("{}")
    assert "out/tune.json exists and is not the table of a tuning" in refused("--seeds=2")


def test_one_storage_holds_several_tunings_by_their_folders(trainer):
    one, two = (tuned("--trials=3", "--storage=all ?%41.db", out=out) for out in ("a", "b"))
    assert one["trials"] == two["trials"]
    names = {study.study_name for study in optuna.get_all_study_summaries(f"sqlite:///{Path('all %3F%2541.db')}")}
    assert len(names) == 2


def test_two_processes_do_not_tune_in_one_folder(trainer, capsys):
    with RunLock(Path("out")):
        assert main(["tune", "--out", "out", "--option", STEP, "--update.type=mirror", *LADDER]) == 2
    assert f"error: --out out is in use by the process {os.getpid()}" in capsys.readouterr().err


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.fault("tuning killed at any moment")
def test_trainings_are_really_made_pruned_and_gone_on_with_after_kill_9(here, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", ForkedCommand)
    monkeypatch.setattr(watch, "_LOOK", 0.0)
    small = ["--total_steps=120", "--rollout.num_envs=2", "--rollout.horizon.length=10", "--eval.episodes=1"]
    more = ["--eval.every=40", "--log.checkpoint_every=1", "--run.tensorboard=false", "--update.type=mirror"]
    options = ["--option=search.depth=int(0,2)", "--option", STEP]
    command = ["tune", "--out=out", *options, *small, *more, "--seeds=1", "--trials=4", "--prune-trials=1"]

    def killed() -> int:
        tell = optuna.Study.tell

        def dies(study: Any, trial: Any, *args: Any, **kwargs: Any) -> Any:
            if trial.number == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            return tell(study, trial, *args, **kwargs)

        optuna.Study.tell = dies  # type: ignore[method-assign]
        return main(command)

    assert in_child(killed) == -signal.SIGKILL
    with sqlite3.connect("out/tune.db") as kept:
        assert dict(kept.execute("SELECT number, state FROM trials")) == {0: "COMPLETE", 1: "RUNNING"}
    assert main(command) == 0
    answer = json.loads(Path("out/tune.json").read_text())
    assert [trial["number"] for trial in answer["trials"]] == [0, 1, 2, 3]
    assert sorted(path.name for path in Path("out").glob("trial-*")) == [f"trial-000{number}" for number in range(4)]
    assert main(["train", "--config", "out/best.yaml", "--run.dir", "again", "--seed=0"]) == 0
    best = f"out/trial-{answer['best']:04d}/seed-0"
    one, other = (json.loads(Path(place, "summary.json").read_text()) for place in (best, "again"))
    assert one["deterministic"] == other["deterministic"]
    assert one["J"] == other["J"]


def test_what_is_missing_is_said_where_optuna_is_not_installed(here, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    with pytest.raises(PgtsError, match=r"needs Optuna, which is not installed: pip install 'pgts_torch\[tune\]'"):
        studies.imported()
