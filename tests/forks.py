"""Processes forked from a test, alone or as torchrun starts them, without the seconds that an import takes."""

import os
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import IO, Any

import torch
from torch import distributed

from pgts_torch.cli.main import main

PATIENCE = 120
"""Seconds that a child may take: more than it needs on a busy machine, and less than the time limit of a test."""

AS_IN_A_TERMINAL = {
    signal.SIGHUP: signal.SIG_DFL,  # nohup ignores it
    signal.SIGINT: signal.default_int_handler,  # a shell without job control ignores it in what it starts with `&`
    signal.SIGALRM: signal.SIG_DFL,  # pytest-timeout has it
}


def forked(works: list[Callable[[], int]]) -> list[int]:
    """The exit codes of processes that do these things at the same time; minus the signal that killed one."""
    children = [_forked(work) for work in works]
    try:
        return [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in children]
    except BaseException:  # the test has run out of time
        for pid in children:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        raise


def _forked(work: Callable[[], int]) -> int:
    """The id of a process that does this, and hears signals as one that was started in a terminal."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads: it needs none of them
        pid = os.fork()
    if pid == 0:
        code = 70
        try:
            for number, handler in AS_IN_A_TERMINAL.items():
                signal.signal(number, handler)
            signal.alarm(PATIENCE)  # ends a process that waits for another one in vain
            code = work()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    return pid


class ForkedCommand:
    """In place of `subprocess.Popen`, for the trainings of a sweep: the command line of this package, in a process that
    is forked."""

    def __init__(self, command: list[str], *, stdout: int, stderr: IO[str], env: dict[str, str], process_group: int):
        def work() -> int:
            os.setpgid(0, process_group)
            os.environ.update(env)
            with open(os.devnull, "w") as sys.stdout, os.fdopen(os.dup(stderr.fileno()), "w") as sys.stderr:
                return main(command[3:])

        assert (stdout, command[:3]) == (subprocess.DEVNULL, [sys.executable, "-m", "pgts_torch.cli"])
        self.returncode: int | None = None
        self._pid = _forked(work)

    def poll(self) -> int | None:
        """The exit code, once there is one."""
        return self._waited(os.WNOHANG)

    def wait(self) -> int | None:
        """The exit code."""
        return self._waited(0)

    def _waited(self, how: int) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self._pid, how)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def terminate(self) -> None:
        """Tell it to end."""
        if self.poll() is None:
            os.kill(self._pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        if self.poll() is None:
            os.kill(self._pid, signal.SIGKILL)


@contextmanager
def started(command: list[str], **options: Any) -> Iterator["subprocess.Popen[str]"]:
    """A command whose stderr is read; it does not outlive the context, however that is left."""
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()  # nothing where it has ended


def in_child(work: Callable[[], int]) -> int:
    """The exit code of one process that does this."""
    return forked([work])[0]


def on_ranks(size: int, work: Callable[[], Any]) -> list[Any]:
    """What `work` gives in each process of a group, in the order of ranks."""
    with tempfile.TemporaryDirectory() as folder:

        def joined(rank: int) -> int:
            patience, meeting = timedelta(seconds=PATIENCE), f"file://{folder}/meeting"
            distributed.init_process_group("gloo", meeting, patience, world_size=size, rank=rank)
            distributed.barrier()  # nobody leaves while another one still connects
            torch.save(work(), Path(folder) / str(rank))
            distributed.destroy_process_group()
            return 0

        codes = forked([lambda rank=rank: joined(rank) for rank in range(size)])
        assert codes == [0] * size
        return [torch.load(Path(folder) / str(rank), weights_only=False) for rank in range(size)]


def launched(size: int, work: Callable[[], int]) -> list[int]:
    """The exit codes of processes that believe to be started by torchrun, which keeps the store where they meet."""
    store = distributed.TCPStore("localhost", 0, is_master=True, wait_for_workers=False)  # at a port that nobody has

    def started_by_torchrun(rank: int) -> int:
        numbers = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "MASTER_PORT": store.port}
        os.environ.update({name: str(number) for name, number in numbers.items()})
        os.environ.update(TORCHELASTIC_RUN_ID="test", TORCHELASTIC_USE_AGENT_STORE="True", MASTER_ADDR="localhost")
        return work()

    return forked([lambda rank=rank: started_by_torchrun(rank) for rank in range(size)])
