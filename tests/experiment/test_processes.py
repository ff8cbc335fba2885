"""Processes that are killed, stopped or interrupted while they train: nothing is lost and no bit differs."""

import os
import resource
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pgts_torch.cli.main import main
from pgts_torch.experiment import checkpoint, ownership
from pgts_torch.experiment.tracking import read_metrics
from tests import reliability
from tests.experiment.runs import arguments, left, train_with_signals
from tests.forks import PATIENCE, in_child, started

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

ROOT = Path(__file__).parents[2]


LEARNED = {
    name: [
        *("--config", str(ROOT / "configs" / "learned" / f"{name}.yaml"), "--env.id", env),
        *("--rollout.horizon", "{type: steps, first: 12, length: 8}"),
        *("--model.first_updates", "5", "--model.hidden", "[8]"),
        *("--replay", "{type: uniform, updates_per_step: 0.1, starts: 4, length: 5}"),
    ]
    for name, env in {"cartpole": "CartPole-v1", "catch": "images/Catch-v0"}.items()
}
"""Shipped configurations of learned models, of vectors and of images, with less to compute."""


def training(folder: Path, *more: str, kill_at: int = -1, counted: Path | None = None) -> int:
    """Train in a process of its own; its exit code.

    Args:
        more: further arguments.
        kill_at: the call of a function, counted from the start, at which it is killed.
        counted: where it writes down how many there were.
    """
    calls = 0

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    def work() -> int:
        sys.setprofile(count if kill_at > 0 or counted is not None else None)
        code = main(arguments(folder, *more))
        sys.setprofile(None)
        if counted is not None:
            counted.write_text(str(calls))
        return code

    return in_child(work)


def signalled(folder: Path, *numbers: int) -> int:
    """Train in a process that gets these signals in its third iteration; its exit code."""
    return in_child(lambda: train_with_signals(folder, *numbers))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[dict[str, Any], int]:
    """What an uninterrupted run leaves, and how many calls of functions it makes."""
    folder = tmp_path_factory.mktemp("whole")
    assert training(folder / "run", counted=folder / "calls") == 0
    return left(folder / "run"), int((folder / "calls").read_text())


@pytest.mark.fault("kill at any moment")
@pytest.mark.parametrize("kills", [2, pytest.param(25, marks=pytest.mark.long)])
def test_after_kills_at_random_moments_every_byte_is_that_of_an_uninterrupted_run(kills, whole, tmp_path):
    expected, calls = whole
    random = np.random.default_rng(kills)
    killed, compared, folder = 0, 1, tmp_path / "0"
    while killed < kills:
        code = training(folder, kill_at=int(random.integers(1, calls)))
        assert code in (0, 2, -signal.SIGKILL)  # 2: it was finished already
        killed += code == -signal.SIGKILL
        if code != -signal.SIGKILL:
            assert left(folder) == expected
            compared, folder = compared + 1, tmp_path / str(compared)
    assert training(folder) in (0, 2)
    assert left(folder) == expected
    if kills >= 25:
        reliability.record("kills at random moments of training", kills=killed, runs=compared, runs_with_another_bit=0)


@pytest.mark.fault("kill at any moment")
@pytest.mark.parametrize("learned", [LEARNED["cartpole"], pytest.param(LEARNED["catch"], marks=pytest.mark.long)])
def test_after_a_kill_a_learned_model_its_replay_and_its_episodes_are_those_of_an_uninterrupted_run(learned, tmp_path):
    assert training(tmp_path / "whole", *learned) == 0
    folder = tmp_path / "killed"
    assert in_child(lambda: train_with_signals(folder, signal.SIGKILL, more=learned)) == -signal.SIGKILL
    assert checkpoint.newest(folder, strict=True)[1].iterations == 2
    assert training(folder, *learned) == 0
    assert left(folder) == left(tmp_path / "whole")


@pytest.mark.fault("kill while a checkpoint is written")
@pytest.mark.parametrize("kills", [2, pytest.param(25, marks=pytest.mark.long)])
def test_after_kills_while_a_checkpoint_is_written_the_one_before_is_intact(kills, whole, tmp_path, monkeypatch):
    random, write, calls, kill_at = np.random.default_rng(0), checkpoint.write, 0, 0

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    def write_and_count(folder: Path, *args: Any, **kwargs: Any) -> Path:
        sys.setprofile(count if ownership.checkpoints(folder) else None)
        try:
            return write(folder, *args, **kwargs)
        finally:
            sys.setprofile(None)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write", write_and_count)
        for number in range(kills):
            folder, kill_at = tmp_path / str(number), int(random.integers(1, 3000))
            assert in_child(lambda folder=folder: main(arguments(folder))) == -signal.SIGKILL
            assert checkpoint.newest(folder, strict=True) is not None
    assert training(folder) == 0
    assert left(folder) == whole[0]
    if kills >= 25:
        reliability.record("kills while a checkpoint is written", kills=kills, checkpoints_lost=0)


@pytest.mark.fault("SIGTERM", "Ctrl-C", "closed terminal")
@pytest.mark.parametrize(
    ("numbers", "code"),
    [((signal.SIGTERM,), 143), ((signal.SIGINT,), 130), ((signal.SIGHUP, signal.SIGHUP), 129)],
)
def test_a_signal_finishes_the_iteration_saves_and_says_how_to_go_on(numbers, code, whole, tmp_path, capfd):
    folder = tmp_path / "run"
    assert signalled(folder, *numbers) == code
    _, notes, _ = checkpoint.newest(folder, strict=True)
    assert notes.iterations == 3
    assert read_metrics(folder)[-1]["step"] == notes.env_steps
    assert f"stopped at step {notes.env_steps}; `pgts train --resume {folder}` goes on\n" in capfd.readouterr().err
    assert training(folder) == 0
    assert left(folder) == whole[0]


@pytest.mark.fault("closed terminal")
def test_under_nohup_a_training_outlives_its_terminal(whole, tmp_path):
    def work() -> int:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        return train_with_signals(tmp_path / "run", signal.SIGHUP)

    assert in_child(work) == 0
    assert left(tmp_path / "run") == whole[0]


@pytest.mark.fault("second Ctrl-C")
def test_a_second_signal_ends_the_process_at_once(whole, tmp_path, capfd):
    folder = tmp_path / "run"
    assert signalled(folder, signal.SIGINT, signal.SIGINT) == 130
    assert checkpoint.newest(folder, strict=True)[1].iterations == 2
    assert "stopped at step" not in capfd.readouterr().err
    assert training(folder) == 0
    assert left(folder) == whole[0]


@pytest.mark.fault("disk full")
@pytest.mark.parametrize(
    ("most_bytes", "more", "named"),
    [
        (3_000, ["--run.tensorboard=false"], ".pt cannot be written: File too large"),
        (8_000, [], "events cannot be written to: File too large"),
        (3_000, ["--log.checkpoint_every=100", "--run.tensorboard=false"], "; is the disk full?"),
    ],
)
def test_a_file_that_cannot_grow_is_one_line_and_with_more_room_the_run_goes_on(
    most_bytes, more, named, tmp_path, capfd
):
    folder = tmp_path / "run"
    steps = ["--total_steps", "600", "--rollout.num_envs", "4", "--rollout.horizon.length", "15"]
    ladder = ["train", *steps, "--eval.episodes", "2", "--log.checkpoint_every", "1", "--run.dir", str(folder), *more]

    def short_of_room() -> int:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        return main(ladder)

    assert in_child(short_of_room) == 2
    complaint = [line for line in capfd.readouterr().err.splitlines() if not line.startswith(("step ", "note: "))]
    assert len(complaint) == 2  # one of them says that there was no --config
    assert complaint[1].startswith(f"error: {folder}/")
    assert complaint[1].endswith(named)
    assert (checkpoint.newest(folder, strict=True) is None) == ("events" not in named)
    assert main(ladder) == 0
    assert [line["step"] for line in read_metrics(folder)] == list(range(60, 601, 60))


@pytest.mark.fault("SIGTERM")
def test_the_command_stops_at_a_signal_and_goes_on(tmp_path):
    command = [sys.executable, "train.py", *arguments(tmp_path / "run")[1:], "--total_steps", "100000"]
    with started(command, cwd=ROOT) as process:
        while not ownership.checkpoints(tmp_path / "run"):
            assert process.poll() is None
            time.sleep(0.05)
        process.terminate()
        assert "goes on" in process.communicate(timeout=PATIENCE)[1]
        assert process.returncode == 143
    assert main(["train", "--resume", str(tmp_path / "run"), "--total_steps", "300"]) == 2  # another configuration
