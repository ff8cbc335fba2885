"""The command `pgts sweep`: many runs, what they come to, and what happens if one fails."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

import pytest

from pgts_torch.cli.main import main
from pgts_torch.errors import PgtsError, Stopped
from pgts_torch.experiment import ownership, run, sweep
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.processes import train_all
from pgts_torch.experiment.statistics import Mean
from tests.experiment import finished
from tests.forks import PATIENCE, ForkedCommand, in_child

SMALL = ["--total_steps", "60", "--rollout.num_envs", "3", "--rollout.horizon.length", "10", "--eval.episodes", "2"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def planned(*arguments: str, depths: tuple[int | str, ...] = (0, 2), num_seeds: int = 3) -> list[sweep.Run]:
    return sweep.plan(None, [*SMALL, *arguments], depths=depths, num_seeds=num_seeds, out=Path("out"))


def test_every_depth_meets_every_seed_in_a_folder_of_its_own(here):
    runs = planned("--update.step_size", "0.5")
    assert [(each.depth, each.seed) for each in runs] == [(d, s) for d in (0, 2) for s in range(3)]
    assert [str(each.folder) for each in runs][1::3] == ["out/depth-0/seed-1", "out/depth-2/seed-1"]
    for each in runs:
        assert (each.config.search.depth, each.config.seed, each.config.threads) == (each.depth, each.seed, 1)
        assert each.config.update.plain()["step_size"] == 0.5
    assert [each.depth for each in planned(depths=(), num_seeds=1)] == [4]
    assert planned(depths=("adaptive",), num_seeds=1)[0].config.search.depth == "adaptive"


def finish(each: sweep.Run, *, J: float | None) -> None:
    """What a finished run with this result leaves."""
    tag = "charts/episodic_return" if J is None else "exact/J"
    lines = [{"step": step + each.seed, tag: value} for step, value in ((30, 0.0), (45, None), (60, J))]
    what = finished.summary(each.config, J=J, env_steps=60 + each.seed, greedy=20.0 + each.seed)
    finished.leave(each.folder, each.config, lines, what)


def test_finished_runs_are_kept_and_summed_up_without_a_process(here, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", None)
    runs = planned(num_seeds=4)
    for each in runs:
        finish(each, J=[0.0, 1.0, 2.0, 9.0][each.seed] + int(each.depth))
    answer = sweep.sweep(runs, jobs=2, out=Path("out"))
    assert (answer.failures, answer.score_is) == ({}, "J")
    assert [(row.depth, row.num_runs, row.score.mean) for row in answer.rows] == [(0, 4, 1.5), (2, 4, 3.5)]
    for row in answer.rows:
        assert (row.env_steps, row.model_calls, row.seconds, row.greedy.mean) == (61.5, 7, 1, 21.5)
        assert row.score.low is not None
        assert row.depth <= row.score.low < row.score.mean < row.score.high <= row.depth + 9
    assert json.loads(Path("out/table.json").read_text()) == json.loads(json.dumps(asdict(answer)))
    assert Path("out/curves.png").read_bytes().startswith(b"\x89PNG")
    text = sweep.describe(answer)
    assert max(map(len, text.splitlines())) < 80
    assert text.split()[:3] == ["depth", "runs", "J"]


def test_where_nothing_exact_is_known_sampled_episodes_score_and_one_seed_has_no_interval(here):
    [each] = planned(depths=(0,), num_seeds=1)
    finish(each, J=None)
    answer = sweep.sweep([each], jobs=1, out=Path("out"))
    assert (answer.score_is, answer.rows[0].score) == ("return", Mean(10.0, None, None))
    assert "return of sampled episodes" in sweep.describe(answer)


def test_a_folder_with_a_run_of_another_configuration_is_refused_also_where_it_is_unfinished(here):
    finish(planned()[0], J=1.0)
    for _ in range(2):
        assert len(planned()) == 6
        with pytest.raises(PgtsError, match="depth-0/seed-0 holds a run of another configuration; choose another --o"):
            planned("--update.step_size", "0.7")
        Path("out/depth-0/seed-0/summary.json").unlink(missing_ok=True)


def until(done: Callable[[], bool]) -> None:
    begun = time.monotonic()
    while not done():
        assert time.monotonic() - begun < PATIENCE
        time.sleep(0.02)


@pytest.mark.fault("SIGTERM")
@pytest.mark.usefixtures("unchecked_shapes")
def test_a_sweep_that_is_stopped_saves_and_the_same_command_ends_with_the_table_of_one_that_was_not(
    here, monkeypatch, capfd
):
    monkeypatch.setattr(subprocess, "Popen", ForkedCommand)
    long = ["--total_steps", "1500", "--log.checkpoint_every", "1", "--log.keep", "999", "--run.tensorboard", "false"]
    whole = sweep.plan(None, [*SMALL, *long], depths=(1,), num_seeds=1, out=Path("whole"))
    run.train(whole[0].config)
    expected = asdict(sweep.sweep(whole, jobs=1, out=Path("whole")))
    arguments = ["sweep", "--out", "out", "--depths", "1", "--seeds", "1", *SMALL, *long]
    folder = Path("out/depth-1/seed-0")

    def stopped() -> int:
        signal_when(lambda: bool(ownership.checkpoints(folder)), signal.SIGTERM)
        return main(arguments)

    assert in_child(stopped) == 143
    assert "stopped: 0 of 1 runs are done; the same command goes on\n" in capfd.readouterr().err
    assert not (folder / "summary.json").exists()
    with RunLock(folder):  # nobody else has it any more
        pass
    first = ownership.checkpoints(folder)[0]
    written = first.stat().st_mtime_ns
    assert main(arguments) == 0
    assert first.stat().st_mtime_ns == written  # it did not start from the beginning
    answer = json.loads(Path("out/table.json").read_text())
    for row in (*answer["rows"], *expected["rows"]):
        del row["seconds"]
    assert answer["rows"] == json.loads(json.dumps(expected["rows"]))


@pytest.fixture
def trainer(here, monkeypatch) -> Callable[[str], Path]:
    """Puts a shell script in the place of `pgts train`; it writes its process id into `pids` when it has begun, and
    gives up after a minute or two, so that a signal that never comes fails a test and does not hang it."""

    def replace(on_signal: str) -> Path:
        script = here / "trainer"
        waiting = "n=0; while [ $n -lt 1200 ]; do sleep 0.05; n=$((n + 1)); done; exit 9"
        script.write_text(f"#!/bin/sh\ntrap '{on_signal}' TERM\necho $$ >> pids\n{waiting}\n")
        script.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(script))
        return here / "pids"

    return replace


def signal_when(done: Callable[[], bool], *numbers: int) -> None:
    """Send this process signals, a little apart, once something is the case."""

    def send() -> None:
        until(done)
        for number in numbers:
            os.kill(os.getpid(), number)
            time.sleep(0.3)

    threading.Thread(target=send, daemon=True).start()


def lines(path: Path) -> list[str]:
    return path.read_text().split() if path.exists() else []


@pytest.fixture
def hang_ups() -> Iterator[None]:
    """SIGHUP is handled, also where pytest runs under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def test_a_run_that_is_not_wanted_any_more_ends_and_the_others_go_on(trainer, capsys):
    pids = trainer("echo asked >> pids; exit 143")

    def unwanted(failures: Mapping[str, str]) -> set[str]:
        said = lines(pids)
        return {"a", "b", "c"} if "asked" in said else {"a"} if len(said) == 2 else set()

    assert train_all({name: [] for name in "abc"}, jobs=2, unwanted=unwanted) == {}
    assert lines(pids)[2:] == ["asked", "asked"]
    said = [line.partition(" after")[0] for line in capsys.readouterr().err.splitlines()]
    assert [line.split()[1:] for line in said] == [["a:", "stopped"], ["b:", "stopped"]]


@pytest.mark.usefixtures("hang_ups")
@pytest.mark.fault("SIGTERM", "Ctrl-C", "closed terminal")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_to_a_sweep_asks_each_run_once_to_end_and_begins_no_other(number, trainer, capsys):
    pids = trainer("echo asked >> pids; sleep 0.3; exit 143")
    signal_when(lambda: len(lines(pids)) >= 2, number)
    before = signal.getsignal(number)
    with pytest.raises(Stopped, match="stopped: 0 of 3 runs are done; the same command goes on") as caught:
        train_all({name: [] for name in "abc"}, jobs=2)
    assert caught.value.signal == number
    assert signal.getsignal(number) is before
    assert lines(pids)[2:] == ["asked", "asked"]
    said = [line.partition(" after")[0].split(maxsplit=1) for line in capsys.readouterr().err.splitlines()]
    assert [number for number, _ in said] == ["[1/3]", "[2/3]"]
    assert sorted(ending for _, ending in said) == ["a: stopped", "b: stopped"]


@pytest.mark.fault("second Ctrl-C")
def test_a_second_signal_to_a_sweep_ends_all_runs_at_once(trainer):
    pids = trainer("")

    def interrupted() -> int:
        signal_when(lambda: len(lines(pids)) >= 2, signal.SIGINT, signal.SIGINT)
        train_all({name: [] for name in "abc"}, jobs=2)
        return 0

    assert in_child(interrupted) == 130
    for pid in map(int, lines(pids)):
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_run_that_was_killed_has_failed(trainer):
    pids = trainer("")

    def kill() -> None:
        until(lambda: bool(lines(pids)))
        os.kill(int(lines(pids)[0]), signal.SIGKILL)

    threading.Thread(target=kill, daemon=True).start()
    assert train_all({"a": []}, jobs=1) == {"a": "killed by the signal 9"}


@pytest.mark.fault("folder of the user as an output")
def test_a_folder_with_other_things_only_is_left_alone_and_others_are_named(here, capsys):
    Path("thesis.tex").write_text("mine")
    assert main(["sweep", "--out", ".", *SMALL]) == 2
    refusal = "error: --out . holds files that no sweep has left (thesis.tex); choose another folder\n"
    assert capsys.readouterr() == ("", refusal)
    assert [path.name for path in here.iterdir()] == ["thesis.tex"]
    finish(planned(num_seeds=1)[0], J=0.5)
    Path("out/thesis.tex").write_text("mine")
    assert main(["sweep", "--out", "out", "--depths", "0", "--seeds", "1", *SMALL]) == 0
    note = "note: --out out also holds thesis.tex, which no sweep has left; it stays\n"
    assert capsys.readouterr().err == note
    assert Path("out/thesis.tex").read_text() == "mine"


@pytest.mark.fault("kill at any moment")
def test_runs_that_outlive_a_killed_sweep_are_waited_for_and_count(here, monkeypatch, capsys):
    monkeypatch.setattr(subprocess, "Popen", None)
    [each] = planned(depths=(0,), num_seeds=1)
    left, waits = RunLock(each.folder), list[float]()

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            finish(each, J=0.5)
            left.__exit__()

    monkeypatch.setattr(time, "sleep", sleep)
    answer = sweep.sweep([each], jobs=1, out=Path("out"))
    assert (len(waits), answer.failures, answer.rows[0].score.mean) == (3, {}, 0.5)
    waiting = f"waiting: run.dir out/depth-0/seed-0 is in use by the process {os.getpid()}\n"
    assert capsys.readouterr().err == waiting


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_run_that_fails_is_named_and_the_others_go_on(here, capsys, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", ForkedCommand)
    finish(planned(num_seeds=1)[0], J=0.5)
    alien = here / "out" / "depth-1" / "seed-0"
    alien.mkdir(parents=True)
    (alien / "thesis.txt").write_text("mine")
    arguments = ["sweep", "--out", "out", "--depths", "0,1,2", "--seeds", "1", "--jobs", "2", *SMALL]
    assert main(arguments) == 1
    out, err = capsys.readouterr()
    mistake = "run.dir out/depth-1/seed-0 holds files that no run has left (thesis.txt); choose another folder"
    assert err.splitlines()[-1] == f"error: depth 1, seed 0: {mistake}"
    assert sum(line.endswith(f"depth 1, seed 0: FAILED: {mistake}") for line in err.splitlines()) == 1
    assert "depth 0, seed 0" not in err
    assert [line.split()[:2] for line in out.splitlines()[1:3]] == [["0", "1"], ["2", "1"]]
    assert json.loads(Path("out/table.json").read_text())["failures"] == {"depth 1, seed 0": mistake}
    assert [path.name for path in alien.iterdir()] == ["thesis.txt"]


MISTAKES = {
    "": "--out",
    "--out o --seed 3": "--seed is set by the sweep: --seeds says how many",
    "--out o --search.depth=3": "--search.depth is set by the sweep: --depths says which",
    "--out o --run.dir x": "--run.dir is set by the sweep: --out is the folder of all runs",
    "--out o --seeds 0": "--seeds: '0'",
    "--out o --depths 1,x": "--depths: 'x'",
    "--out o --depths adaptive,2 --search.tolerance 1": "search.tolerance is 1.0",
    "--out o --update.step_size -1": "--update.step_size is -1",
    "--out o --env.id CartPole-v1 --policy.type softmax --depths 0,1": "the policy 'softmax' is a table",
    "--out o --config none.yaml": "none.yaml: ",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_line_with_exit_code_2_and_starts_nothing(arguments, here, capsys):
    assert main(["sweep", *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    [mistake] = err.splitlines()
    assert mistake.startswith("error: ")
    assert MISTAKES[arguments] in mistake
    assert not list(here.iterdir())
