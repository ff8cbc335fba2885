"""Processes forked from a test, alone or as torchrun starts them, without the seconds that an import takes."""

import os
import signal
import socket
import tempfile
import traceback
import warnings
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from torch import distributed

PATIENCE = timedelta(seconds=180)


def forked(works: list[Callable[[], int]]) -> list[int]:
    """The exit codes of processes that do these things at the same time; minus the signal that killed one."""
    children = []
    for work in works:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads: it needs none of them
            pid = os.fork()
        if pid == 0:
            code = 70
            signal.alarm(int(PATIENCE.total_seconds()))  # ends a process that waits for another one in vain
            try:
                code = work()
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        children.append(pid)
    return [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in children]


def in_child(work: Callable[[], int]) -> int:
    """The exit code of one process that does this."""
    return forked([work])[0]


def on_ranks(size: int, work: Callable[[], Any]) -> list[Any]:
    """What `work` gives in each process of a group, in the order of ranks."""
    with tempfile.TemporaryDirectory() as folder:

        def joined(rank: int) -> int:
            distributed.init_process_group(
                "gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=size, timeout=PATIENCE
            )
            torch.save(work(), Path(folder) / str(rank))
            distributed.destroy_process_group()
            return 0

        codes = forked([lambda rank=rank: joined(rank) for rank in range(size)])
        assert codes == [0] * size
        return [torch.load(Path(folder) / str(rank), weights_only=False) for rank in range(size)]


def launched(size: int, work: Callable[[], int]) -> list[int]:
    """The exit codes of processes that believe to be started by torchrun."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]

    def started(rank: int) -> int:
        names = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "MASTER_PORT": port}
        os.environ.update({name: str(value) for name, value in names.items()})
        os.environ.update(TORCHELASTIC_RUN_ID="test", MASTER_ADDR="localhost")
        return work()

    return forked([lambda rank=rank: started(rank) for rank in range(size)])
