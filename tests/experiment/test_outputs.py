"""A file under a name of the user's choice is replaced only where it is an earlier output of the same kind."""

import os
import subprocess

import pytest

from pgts_torch import PGTS, EvalCallback
from pgts_torch.cli.main import main
from pgts_torch.config import load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import run
from tests.experiment.runs import put, tree
from tests.forks import ForkedCommand

pytestmark = pytest.mark.usefixtures("unchecked_shapes", "undrawn")

TINY = ["--rollout.num_envs=1", "--rollout.horizon.length=5", "--eval.episodes=1"]
SHORT = [*TINY, "--search.depth=0", "--total_steps=5", "--run.tensorboard=false"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def model() -> PGTS:
    return PGTS("pgts/Ladder-v0", depth=0, num_envs=1)


@pytest.mark.fault("file of the user under the name of an output")
def test_a_model_replaces_a_model_and_nothing_else(model, here):
    put(here, thesis_tex="mine")
    (here / "link.pt").symlink_to("thesis.tex")
    for name in ("thesis.tex", "link.pt"):
        with pytest.raises(PgtsError, match=f"^{name} exists and is not a model that pgts_torch has saved: move it"):
            model.save(name)
        with pytest.raises(PgtsError, match=f"^{name} exists and is not a model"):
            EvalCallback(every=1, best_path=name)
    assert (here / "thesis.tex").read_text() == "mine"
    os.mkfifo(here / "pipe.pt")
    for name, kind in {"pipe.pt": "pipe", ".": "folder", "/dev/null": "device"}.items():
        with pytest.raises(PgtsError, match=rf"^{name} is a {kind}; it must be a file, or not exist$"):
            model.save(name)
    (here / "empty.pt").touch()
    (here / "to-new.pt").symlink_to("new.pt")
    for name in ("empty.pt", "empty.pt", "to-new.pt"):
        model.save(name)
    assert (here / "to-new.pt").is_symlink()
    assert PGTS.load("new.pt").num_env_steps == 0


@pytest.mark.fault("file of the user under the name of an output")
def test_a_page_replaces_a_page_and_nothing_else(here, capsys):
    run.train(load(None, [*SHORT, "--run.dir=run"]))
    put(here, thesis_html="<!DOCTYPE html>mine", run__report_html="mine")
    for arguments, name in ((["--out=thesis.html"], "thesis.html"), ([], "run/report.html")):
        assert main(["report", "run", *arguments]) == 2
        assert f"error: {name} exists and is not a page of pgts report: move it away" in capsys.readouterr().err
    assert (here / "run" / "report.html").read_text() == "mine"
    for _ in range(2):
        assert main(["report", "run", "--out=new.html"]) == 0


@pytest.mark.fault("file of the user under the name of an output")
@pytest.mark.parametrize("name", ["table.json", "curves.png"])
def test_a_sweep_replaces_its_own_table_and_picture_and_nothing_else(name, here, capsys, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", ForkedCommand)
    (here / "out").mkdir()
    (here / "out" / name).write_text('{"rows": []}')
    before = tree(here)
    sweep = ["sweep", "--out=out", "--seeds=1", "--depths=0", *TINY, "--total_steps=5", "--run.tensorboard=false"]
    assert main(sweep) == 2
    assert f"error: out/{name} exists and is not the " in capsys.readouterr().err
    assert tree(here) == before
    (here / "out" / name).unlink()
    for _ in range(2):
        assert main(sweep) == 0
