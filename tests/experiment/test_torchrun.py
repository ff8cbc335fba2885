"""`torchrun train.py`: one folder, one voice, and nothing lost when a process is."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.errors import LOST
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.tracking import read_metrics
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import check_finite
from tests.experiment.runs import SHORT, SMALL, arguments, left, train_with_signals
from tests.forks import PATIENCE, launched, started

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

ROOT = Path(__file__).parents[2]


def trained(folder: Path, *more: str, size: int = 2) -> list[int]:
    return launched(size, lambda: main(arguments(folder, *more)))


def signalled(folder: Path, number: int, *, rank: int) -> list[int]:
    """The exit codes where one process gets a signal in its third iteration."""
    return launched(2, lambda: train_with_signals(folder, number, rank=rank))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, Any]:
    """What an uninterrupted run of two processes leaves."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert trained(folder) == [0, 0]
    return left(folder)


def test_two_processes_leave_one_run_and_speak_with_one_voice(whole, tmp_path, capfd):
    folder = tmp_path / "run"
    assert trained(folder) == [0, 0]
    said = capfd.readouterr()
    assert said.out.count("environment steps") == 1
    shown = re.findall("^step +[0-9]+", said.err, re.MULTILINE)
    assert len(shown) == len(set(shown)) > 1
    steps = [line["step"] for line in read_metrics(folder) if "charts/SPS" in line]
    assert steps == sorted(set(steps))
    assert left(folder) == whole
    assert main(["evaluate", str(folder), "--episodes", "2"]) == 0


def test_one_process_makes_other_episodes(whole, tmp_path):
    assert main(arguments(tmp_path / "run")) == 0
    assert left(tmp_path / "run")["metrics"] != whole["metrics"]


@pytest.mark.fault("lost rank")
@pytest.mark.parametrize("rank", [pytest.param(0, marks=pytest.mark.long), 1])
def test_a_lost_rank_ends_all_and_the_same_command_goes_on_bit_for_bit(rank, whole, tmp_path, capfd):
    folder = tmp_path / "run"
    codes = signalled(folder, signal.SIGKILL, rank=rank)
    assert codes[rank] == -signal.SIGKILL
    assert codes[1 - rank] == LOST
    said = capfd.readouterr().err
    assert said.count("error: rank 0 of 2 has lost another one, asking for ") == rank
    assert "Traceback" not in said
    assert checkpoint.newest(folder, strict=True)[1].iterations == 2
    assert trained(folder) == [0, 0]
    assert left(folder) == whole


@pytest.mark.parametrize("rank", [pytest.param(0, marks=pytest.mark.long), 1])
def test_a_signal_to_one_process_stops_all_after_the_iteration(rank, whole, tmp_path, capfd):
    folder = tmp_path / "run"
    assert signalled(folder, signal.SIGTERM, rank=rank) == [143, 143]
    assert capfd.readouterr().err.count(f"`pgts train --processes 2 --resume {folder}` goes on") == 1
    assert checkpoint.newest(folder, strict=True)[1].iterations == 3
    assert trained(folder) == [0, 0]
    assert left(folder) == whole


@pytest.mark.fault("other world size at resume")
def test_another_world_size_is_refused_unless_it_is_asked_for(tmp_path, capfd):
    folder = tmp_path / "run"
    assert signalled(folder, signal.SIGTERM, rank=0) == [143, 143]
    capfd.readouterr()
    assert trained(folder, size=3) == [2] * 3
    said = capfd.readouterr().err
    assert said.count("error: ") == 1
    assert "was written by 2 processes, and 3 are to go on" in said
    assert main(arguments(folder, "--any-world-size")) == 0
    assert checkpoint.newest(folder, strict=True)[1].world_size == 1


def test_a_mistake_that_only_the_first_process_can_see_is_said_once(whole, tmp_path, capfd):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("mine")
    assert trained(tmp_path / "run") == [2, 2]
    assert capfd.readouterr().err.count("holds files that no run has left") == 1
    assert os.listdir(tmp_path / "run") == ["thesis.tex"]


def test_a_number_that_is_not_finite_in_the_second_process_stops_both_and_is_written_down(tmp_path, capfd):
    folder = tmp_path / "run"

    def work() -> int:
        look, iterate, models = Search.__call__, PGTS.iterate, list[PGTS]()

        def watched(self: PGTS) -> Any:
            models.append(self)
            return iterate(self)

        def blind(self: Search, state_N: torch.Tensor, **options: Any) -> Any:
            found = look(self, state_N, **options)
            if models[-1].ranks.rank == 1 and models[-1].num_iterations == 1:
                check_finite("lookahead", "the lookahead", found.q_BA * torch.nan, state_N)
            return found

        # In this process, which ends here.
        PGTS.iterate, Search.__call__ = watched, blind  # type: ignore[method-assign]
        return main(arguments(folder))

    assert launched(2, work) == [1, 1]
    said = capfd.readouterr().err
    assert said.count("error: ") == said.count("error: [rank 1] ") == 1
    assert json.loads((folder / "failure.json").read_text())["tensor"] == "lookahead"
    assert checkpoint.newest(folder, strict=True)[1].iterations == 1


def test_torchrun_trains(tmp_path):
    folder = tmp_path / "run"
    command = ["-m", "torch.distributed.run", "--nproc-per-node=2", "train.py", *arguments(folder)[1:], "--json"]
    made = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert made.returncode == 0, made.stderr
    assert json.loads(made.stdout)["env_steps"] == read_metrics(folder)[-1]["step"]


@pytest.mark.long
def test_two_agents_that_meet_by_a_rendezvous_train_as_one_with_two_processes(whole, tmp_path):
    """As on two machines: each agent has one process, and knows only where they meet."""
    folder = tmp_path / "run"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    meeting = ["--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{port}", "--rdzv-id=test", "--local-addr=127.0.0.1"]
    command = [sys.executable, "-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=1", *meeting, "train.py"]
    options: Any = {"cwd": ROOT, "stdout": subprocess.PIPE}
    command += arguments(folder)[1:]
    with started(command, **options) as one, started(command, **options) as other:
        said = [agent.communicate(timeout=PATIENCE) for agent in (one, other)]
    assert (one.returncode, other.returncode) == (0, 0), said
    assert sorted(out.count("environment steps") for out, _ in said) == [0, 1]
    assert left(folder) == whole


def test_a_restart_by_torchrun_needs_a_folder_that_it_can_find(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("TORCHELASTIC_MAX_RESTARTS", "3")
    monkeypatch.chdir(tmp_path)
    assert main(["train", *SMALL, *SHORT]) == 2
    assert "run.dir is not set; --max-restarts needs it" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main(arguments(tmp_path / "run")) == 0
