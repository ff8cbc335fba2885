"""Whatever a run is started from: its output closed, no terminal, another locale, packages missing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pgts_torch.config import load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import progress, run
from pgts_torch.experiment.tracking import read_metrics, versions
from tests.forks import PATIENCE

FEW = ["--total_steps=400", "--rollout.num_envs=4", "--rollout.horizon.length=15", "--eval.episodes=1"]
BARE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def started(folder: Path, redirections: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """`pgts` by a shell, in a session without a terminal and in the C locale."""
    environment = {name: value for name, value in os.environ.items() if name not in ("TERM", "LANG", "LC_CTYPE")}
    return subprocess.run(
        ["sh", "-c", f'"$@" {redirections}', "sh", sys.executable, "-m", "pgts_torch.cli", *arguments],
        cwd=folder,
        env=environment | BARE,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="ascii",
        timeout=PATIENCE,
        start_new_session=True,
        check=False,
    )


@pytest.mark.fault("no terminal", "C locale")
def test_without_a_terminal_and_in_the_c_locale_a_run_prints_a_few_plain_lines(tmp_path):
    done = started(tmp_path, "", "train", *FEW, "--run.dir=run", "--run.tensorboard=false")
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()[1:]
    assert 2 <= len(lines) <= 2 * progress.PLAIN_LINES
    assert all(line.startswith("step ") for line in lines)
    assert "return of the policy" in done.stdout
    assert (tmp_path / "run" / "summary.json").exists()


@pytest.mark.fault("C locale")
def test_a_configuration_with_any_letters_is_read_and_printed_in_the_c_locale(tmp_path):
    (tmp_path / "c.yaml").write_text('env: {kwargs: {map: "äß日"}}', encoding="utf-8")
    done = started(tmp_path, "", "train", "--config=c.yaml", "--print-config")
    assert done.returncode == 0, done.stderr
    (tmp_path / "printed.yaml").write_text(done.stdout, encoding="ascii")
    assert load(str(tmp_path / "printed.yaml")).env.kwargs == {"map": "äß日"}


@pytest.mark.fault("closed output")
def test_a_run_whose_output_is_closed_is_whole(tmp_path):
    done = started(tmp_path, "<&- >&- 2>&-", "train", *FEW, "--run.dir=run")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["env_steps"] >= 400
    assert len(read_metrics(tmp_path / "run")) >= 2


@pytest.mark.fault("closed output")
@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), (["train", "--print-config"], 0), (["trian"], 2)])
def test_a_command_whose_output_is_closed_has_the_exit_code_that_it_would_have(arguments, code, tmp_path):
    done = started(tmp_path, ">&-", *arguments)
    assert done.returncode == code
    assert len(done.stderr.splitlines()) == (code == 2)


@pytest.fixture
def no_tensorboard(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)


@pytest.mark.usefixtures("no_tensorboard")
@pytest.mark.fault("TensorBoard missing")
def test_without_tensorboard_a_run_says_what_to_do_before_it_writes_or_goes_on_without_events(tmp_path):
    arguments = [*FEW, "--run.dir", str(tmp_path / "run")]
    run.train(load(None, [*arguments, "--run.tensorboard=false"]))
    before = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert "summary.json" in before
    assert not any("tfevents" in name for name in before)
    with pytest.raises(PgtsError, match=r"^TensorBoard cannot be imported \(.*\): pip install tensorboard, or set run"):
        run.train(load(None, [*arguments, "--run.overwrite"]))
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == before


def test_a_package_that_is_not_installed_has_no_version(monkeypatch):
    monkeypatch.setattr("pgts_torch.experiment.tracking.PACKAGES", ("torch", "no-such-package"))
    assert versions()["no-such-package"] is None
