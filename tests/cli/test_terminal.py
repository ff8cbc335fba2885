"""Output that cannot be written, pipes in place of files, names that are too long or not of this locale, and signals
that have a handler already."""

import faulthandler
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import pytest

from pgts_torch.cli.main import main
from pgts_torch.cli.terminal import SafeStream
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.signals import StopFlag
from pgts_torch.experiment.tracking import read_metrics
from pgts_torch.tabular import TabularMDP
from tests.forks import PATIENCE

SHORT = ["--total_steps=15", "--rollout.num_envs=1", "--rollout.horizon.length=5", "--eval.episodes=1"]
BARE = [*SHORT, "--search.depth=0", "--run.tensorboard=false", "--run.dir=run"]


def full() -> IO[str]:
    return Path("/dev/full").open("w")


def closed_pipe() -> IO[str]:
    """What is left of a pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


@contextmanager
def standard_streams(**streams: IO[str] | None) -> Iterator[None]:
    """Replace sys.stdout, sys.stderr or both."""
    with pytest.MonkeyPatch.context() as patch:
        for name, stream in streams.items():
            patch.setattr(sys, name, stream)
        yield
        for stream in {getattr(sys, name) for name in streams}:
            with suppress(OSError):  # it closes all the same
                stream.close()


@pytest.mark.fault("full output")
@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("stdout", "stderr", "code"),
    [(full, None, 0), (lambda: None, full, 0), (closed_pipe, closed_pipe, 141)],
    ids=["full", "no stdout, full stderr", "closed pipe"],
)
def test_output_that_cannot_be_written_ends_no_training(stdout, stderr, code, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with standard_streams(stdout=stdout(), **({} if stderr is None else {"stderr": stderr()})):
        assert main(["train", *BARE]) == code
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["env_steps"] == 15
    assert len(read_metrics(tmp_path / "run")) == 3
    if stderr is None:
        mistake = "warning: the answer cannot be written to stdout: No space left on device; it is in summary.json"
        assert mistake in capsys.readouterr().err


@pytest.mark.fault("full output")
def test_an_answer_that_cannot_be_written_is_an_error_of_other_commands(capsys):
    with standard_streams(stdout=full()):
        assert main(["train", "--print-config"]) == 2
    assert capsys.readouterr().err.startswith("error: the answer cannot be written to stdout: No space left on device")


def test_a_stream_escapes_what_its_encoding_lacks_and_discards_everything_once_it_fails(tmp_path):
    with (tmp_path / "log").open("w", encoding="ascii") as file:
        print("run.dir ä日\udcc3", file=SafeStream(file, required=True))
    assert (tmp_path / "log").read_text() == "run.dir \\xe4\\u65e5\\udcc3\n"
    with full() as file:
        stream = SafeStream(file, required=False)
        print("x", file=stream, flush=True)
        print("x", file=stream, flush=True)
    with full() as file, pytest.raises(PgtsError, match="cannot be written to stdout: No space"):
        print("x", file=SafeStream(file, required=True), flush=True)


@pytest.mark.fault("pipe in place of a file")
def test_a_pipe_that_nobody_writes_to_is_named_and_not_waited_for(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("pipe", "pipe.npz"):
        os.mkfifo(name)
    before = signal.alarm(20)
    for arguments, mistake in {
        ("train", "--config=pipe"): "pipe: the configuration is a pipe; it must be a file",
        ("train", "--run.dir=pipe"): "run.dir pipe is a pipe; it must be a folder or not exist",
        ("stationary", "pipe.npz"): "'pipe.npz' is not a file",
        ("sweep", "--out=pipe"): "'pipe' is not a folder",
        ("evaluate", "pipe"): "'pipe' is not a folder",
    }.items():
        assert main(list(arguments)) == 2
        assert mistake in capsys.readouterr().err
    with pytest.raises(PgtsError, match="is a pipe"):
        TabularMDP.load_npz("pipe.npz")
    signal.alarm(before)
    assert sys.stdout.write


@pytest.mark.fault("name of more than 255 bytes")
@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "--config={}.yaml"],
        ["train", "--run.dir={}"],
        ["train", "--resume={}"],
        ["sweep", "--out={}"],
        ["evaluate", "{}"],
        ["report", "{}"],
        ["stationary", "{}.npz"],
    ],
)
def test_a_name_that_is_too_long_is_one_line(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([argument.format("x" * 300) for argument in arguments]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "no --config" not in line]
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault("letters that the locale lacks")
@pytest.mark.parametrize("argument", ["train --run.dir={}", "sweep --out={}", "train --config={}.yaml"])
def test_a_name_that_the_locale_lacks_is_one_line(argument, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    as_in_the_c_locale = "äß".encode().decode("ascii", "surrogateescape")
    assert main(argument.format(as_in_the_c_locale).split()) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert r"\udcc3\udca4" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault("damaged summary in a sweep")
@pytest.mark.parametrize("content", ["", "{", "[]", "{}", '{"J": "high"}'])
def test_a_sweep_names_a_damaged_summary(content, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "out" / "depth-0" / "seed-0"
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text(content)
    assert main(["sweep", "--out=out", "--depths=0", "--seeds=1", *SHORT]) == 2
    assert "error: out/depth-0/seed-0/summary.json is damaged (" in capsys.readouterr().err
    assert (folder / "summary.json").read_text() == content


WARNS = """
import warnings
from pgts_torch.cli.commands import COMMANDS
from pgts_torch.cli.main import main

def warns(arguments):
    warnings.warn("the table is odd")
    warnings.warn("of another kind", RuntimeWarning)

COMMANDS["train"] = warns
main(["train"])
"""


def test_a_warning_on_the_command_line_is_one_line_without_its_place_in_the_code():
    done = subprocess.run([sys.executable, "-c", WARNS], capture_output=True, text=True, timeout=PATIENCE)
    first, second, *_ = done.stderr.splitlines()
    assert first == "warning: the table is odd"
    assert second == "<string>:8: RuntimeWarning: of another kind"


@pytest.mark.parametrize(("number", "is_left"), [(signal.SIGHUP, True), (signal.SIGTERM, False)])
def test_a_handler_outside_of_python_keeps_sighup_but_not_sigterm(number, is_left, tmp_path):
    before = signal.signal(number, signal.SIG_DFL)
    with (tmp_path / "traces").open("w+") as file:
        faulthandler.register(number, file, all_threads=False)
        try:
            with StopFlag() as stop:
                os.kill(os.getpid(), number)
            assert stop.signal == (None if is_left else number)
            if is_left:
                os.kill(os.getpid(), number)
        finally:
            faulthandler.unregister(number)
        assert (tmp_path / "traces").read_text().count("most recent call first") == 2 * is_left
    signal.signal(number, before)
