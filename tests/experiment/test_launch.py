"""`pgts train --processes`: what is refused before anything starts, and what becomes of processes that end."""

import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pytest

from pgts_torch.cli import rank
from pgts_torch.cli.commands import COMMANDS
from pgts_torch.cli.main import main
from pgts_torch.errors import LOST, NotFinite, RankLost
from pgts_torch.experiment import checkpoint, launch
from pgts_torch.experiment.locking import RunLock
from tests.experiment.pretended import starts
from tests.experiment.runs import OFTEN, SHORT, arguments, left
from tests.forks import PATIENCE, in_child, launched, started

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def light(monkeypatch):
    """Processes that only pretend to train, and the threads that each is given."""
    monkeypatch.setattr(launch, "RANK", "tests.experiment.pretended")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)


def pretended(place: Path, *what: str, restarts: int = 0) -> int:
    return launch.launch([str(place), *what], processes=len(what), max_restarts=restarts)


@pytest.mark.parametrize(
    ("more", "mistake"),
    [
        (["--processes", "0"], "argument --processes: '0' is not a whole number >= 1 and below 2**63 (see pgts train "),
        (["--processes", "4"], "num_envs is 3; 4 processes need at least as many"),
        (["--max-restarts", "2"], "--max-restarts is 2, which goes with --processes only"),
        (["--processes", "2", "--max-restarts", "1", "--overwrite"], "run.overwrite does not go with --max-restarts: "),
        (["--processes", "2", "--serch.depth", "1"], "--serch.depth is unknown; did you mean --search.depth?"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_started(more, mistake, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(launch, "_Attempt", None)
    assert main(arguments(tmp_path / "run", *more)) == 2
    [line] = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("no --config")]
    assert line.startswith(f"error: {mistake}")
    assert not list(tmp_path.iterdir())


def test_restarts_need_a_folder_and_torchrun_no_launcher(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", *SHORT, "--processes=2", "--max-restarts=1"]) == 2
    assert "run.dir is not set; --max-restarts needs it" in capsys.readouterr().err
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "x")
    monkeypatch.setenv("RANK", "0")
    assert main(["train", *SHORT, "--processes=2"]) == 2
    assert capsys.readouterr().err == (
        "error: --processes is 2, but torchrun has started this process: leave one of them out\n"
    )
    assert not list(tmp_path.iterdir())


def test_the_sweep_says_what_to_use_in_place_of_processes(tmp_path, capsys):
    assert main(["sweep", f"--out={tmp_path / 'out'}", "--processes=2"]) == 2
    assert capsys.readouterr().err == (
        "error: --processes is set by the sweep: every run is one, --jobs says how many run at once\n"
    )


@pytest.mark.parametrize("code", [0, 2, *(pytest.param(code, marks=pytest.mark.long) for code in (1, 143))])
def test_the_exit_code_is_that_of_a_training_and_what_it_reports_is_not_tried_again(code, tmp_path, capfd):
    assert pretended(tmp_path, str(code), str(code), restarts=3) == code
    assert starts(tmp_path, 0) == starts(tmp_path, 1) == 1
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("given", "used"), [(None, max(1, len(os.sched_getaffinity(0)) // 2)), pytest.param("3", 3, marks=pytest.mark.long)]
)
def test_the_processes_share_the_cores_unless_it_is_said_otherwise(given, used, tmp_path, monkeypatch):
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    assert pretended(tmp_path, "0", "0") == 0
    assert (tmp_path / "starts-1").read_text() == f"{used}\n"


@pytest.mark.fault("lost rank")
@pytest.mark.parametrize(
    ("what", "loss"),
    [
        (("lost", "kill"), "rank 1 of 2 was killed by SIGKILL"),
        pytest.param(("hang", "lost"), "rank 0 of 2 hangs", marks=pytest.mark.long),
        pytest.param(("lost", "crash"), "rank 1 of 2 has ended with exit code 1", marks=pytest.mark.long),
        pytest.param(("lost", "lost"), "rank 0 has lost another one", marks=pytest.mark.long),
    ],
)
def test_lost_processes_begin_again_as_often_as_they_may_and_the_cause_is_one_line(what, loss, tmp_path, capfd):
    (tmp_path / "once").mkdir()
    assert pretended(tmp_path / "once", *(f"{word},0" for word in what), restarts=2) == 0
    assert capfd.readouterr() == ("", f"note: {loss}; restart 1 of 2\n")
    assert starts(tmp_path / "once", 0) == starts(tmp_path / "once", 1) == 2
    with pytest.raises(RankLost, match=f"^{loss} after 1 restart; --resume goes on from the last checkpoint$"):
        pretended(tmp_path, *what, restarts=1)
    assert capfd.readouterr() == ("", f"note: {loss}; restart 1 of 1\n")
    assert starts(tmp_path, 0) == 2


def test_without_restarts_a_loss_that_has_been_said_is_not_said_again(tmp_path, capfd):
    assert pretended(tmp_path, "lost", "hang") == LOST
    assert capfd.readouterr() == ("", "")


@pytest.mark.fault("SIGTERM", "Ctrl-C")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), pytest.param(signal.SIGINT, 130, marks=pytest.mark.long)]
)
def test_a_signal_reaches_each_process_and_is_no_loss(number, code, tmp_path):
    def work() -> int:
        threading.Thread(target=signal_once_all_wait, daemon=True).start()
        return pretended(tmp_path, "wait", "wait", restarts=2)

    def signal_once_all_wait() -> None:
        while not all((tmp_path / f"waits-{rank}").exists() for rank in (0, 1)):
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    assert in_child(work) == code
    assert starts(tmp_path, 0) == 1


@pytest.mark.parametrize(
    ("error", "code", "report"),
    [
        (None, 0, {"code": 0, "lost": ""}),
        (NotFinite("no number"), 0, {"code": 1, "lost": ""}),
        (RankLost("rank 0 has lost another one"), LOST, {"code": LOST, "lost": "rank 0 has lost another one"}),
    ],
)
def test_a_process_leaves_its_exit_code_and_only_the_first_one_speaks(
    error, code, report, tmp_path, monkeypatch, capfd
):
    def trained(given: Sequence[str]) -> None:
        assert list(given) == ["--seed=3"]
        warnings.warn("the table is odd", stacklevel=1)
        if error is not None:
            raise error

    def work(number: str) -> int:
        os.environ.update(TORCHELASTIC_RUN_ID="x", RANK=number)
        importlib.reload(warnings)  # pytest keeps them to itself
        warnings.resetwarnings()
        return rank.main()

    monkeypatch.setitem(COMMANDS, "train", trained)
    monkeypatch.setattr(sys, "argv", ["rank", str(tmp_path), "--seed=3"])
    said = "error: no number\n" if isinstance(error, NotFinite) else ""
    for number, text in {"0": f"warning: the table is odd\n{said}", "1": ""}.items():
        assert in_child(partial(work, number)) == code
        assert json.loads((tmp_path / number).read_text()) == report
        assert capfd.readouterr() == ("", text)


FATAL = ["--env.id=tests.experiment.fatal:Fatal-v0", "--search.depth=0", "--estimator.type=sampled", *SHORT, *OFTEN]
PLAIN = {"RANK": "0", "OMP_NUM_THREADS": "1"}


@pytest.mark.long
def test_a_killed_process_starts_again_and_the_run_ends_with_the_bits_of_one_that_was_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT))
    train = ["train", *FATAL, "--policy.type=mlp", "--run.dir"]
    assert launched(2, lambda: main([*train, "whole"])) == [0, 0]
    Path("fatal").touch()
    command = [sys.executable, "-m", "pgts_torch.cli", *train, "run", "--processes=2", "--max-restarts=1", "--json"]
    made = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env={**os.environ, **PLAIN})
    assert made.returncode == 0, made.stderr
    assert "note: rank 1 of 2 was killed by SIGKILL; restart 1 of 1\n" in made.stderr
    assert not [line for line in made.stderr.splitlines() if "error" in line or "Traceback" in line or "W1" in line]
    assert json.loads(made.stdout)["env_steps"] >= 100
    assert not Path("fatal").exists()
    assert left(Path("run")) == left(Path("whole"))


@pytest.mark.fault("launcher killed")
def test_when_the_launcher_is_killed_the_processes_save_and_end(tmp_path):
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "pgts_torch.cli", *arguments(folder, "--processes=2", "--total_steps=1000000")]
    with started(command, cwd=ROOT) as process:
        while not list(folder.glob("checkpoints/*.pt")):
            assert process.poll() is None
            time.sleep(0.05)
        process.kill()
        assert process.stderr is not None
        assert "goes on\n" in process.stderr.read()  # to the end, when all that wrote to it have ended
    with RunLock(folder):
        assert checkpoint.newest(folder, strict=True) is not None
