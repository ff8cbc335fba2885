"""Start the processes of one training on this machine by torchrun's agent, and start them again where one is lost."""

import json
import logging
import os
import signal
import sys
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from pgts_torch.config import Config
from pgts_torch.errors import LOST, PgtsError, RankLost
from pgts_torch.experiment.signals import StopFlag
from pgts_torch.options.rollouts import check_processes

if TYPE_CHECKING:
    from torch.distributed.elastic.agent.server.local_elastic_agent import LocalElasticAgent

_POLL = 0.05
"""Seconds between two looks at the processes."""

RANK = "pgts_torch.cli.rank"
"""What each process runs."""


def check_launch(config: Config, *, processes: int, max_restarts: int) -> None:
    """PgtsError if this training cannot be started in so many processes. Knows of no environment yet."""
    if "TORCHELASTIC_RUN_ID" in os.environ:
        raise PgtsError(f"--processes is {processes}, but torchrun has started this process: leave one of them out")
    num_envs = config.resolved().rollout.num_envs
    assert num_envs is not None
    check_processes(processes, num_envs)
    check_restarts(config, max_restarts)


def check_restarts(config: Config, max_restarts: int) -> None:
    """PgtsError if a restart would not find the run, or would start it from the beginning."""
    if max_restarts and config.run.dir is None:
        raise PgtsError("run.dir is not set; --max-restarts needs it, so that a restart finds the run")
    if max_restarts and config.run.overwrite:
        raise PgtsError("run.overwrite does not go with --max-restarts: a restart would overwrite what it goes on from")


def launch(arguments: Sequence[str], *, processes: int, max_restarts: int) -> int:
    """Run `pgts train` with these arguments in several processes that train together.

    They begin again, from the last checkpoint, where one was killed, crashed or hangs. An error that the training
    itself reports would come again, and ends it. SIGTERM, SIGINT and SIGHUP end it, as they end a single process; a
    second one kills all.

    Returns:
        The exit code of a single process that trains.

    Raises:
        RankLost: a process was lost once more than it may be.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores // processes)))
    attempt: _Attempt | None = None
    with StopFlag(at_once=lambda: attempt and attempt.signal(signal.SIGKILL)) as stop:
        for restarts in range(max_restarts + 1):
            with tempfile.TemporaryDirectory(prefix="pgts-") as reports:
                attempt = _Attempt(arguments, processes, Path(reports))
                code = attempt.run(stop)
            if stop.signal is not None and code in (LOST, 128 + signal.SIGTERM):
                return 128 + stop.signal
            if code != LOST:
                return code
            if restarts < max_restarts:
                print(f"note: {attempt.loss}; restart {restarts + 1} of {max_restarts}", file=sys.stderr, flush=True)
    assert attempt is not None
    after = f" after {max_restarts} restart{'s' * (max_restarts > 1)}" if max_restarts else ""
    if attempt.is_said and not max_restarts:
        return LOST
    raise RankLost(f"{attempt.loss}{after}; --resume goes on from the last checkpoint")


@final
class _Attempt:
    """The processes from one start to their end.

    loss: which one was lost first, and how.
    is_said: whether it has said so itself.
    """

    def __init__(self, arguments: Sequence[str], processes: int, reports: Path) -> None:
        self.loss, self.is_said = "", False
        self._processes, self._reports = processes, reports
        self._agent = _agent([*("-m", RANK), str(reports), *arguments], processes)

    def run(self, stop: StopFlag) -> int:
        """The exit code of the first process, or LOST; the processes get SIGTERM after a signal to this one."""
        told = set[int]()
        with ThreadPoolExecutor(1) as pool:  # in the main thread the agent would take the signals
            running = pool.submit(self._agent.run)
            try:
                while not wait([running], _POLL).done:
                    if stop.signal is not None:
                        told |= self.signal(signal.SIGTERM, beside=told)
            finally:
                if not running.done():
                    self.signal(signal.SIGKILL)
        self._agent.get_worker_group().spec.rdzv_handler.shutdown()
        ended = running.result()
        if not ended.is_failed():
            return int(self._report(0)["code"])
        self.loss, self.is_said = min(self._losses(ended.failures))[1:]
        return LOST

    def signal(self, number: signal.Signals, *, beside: set[int] = frozenset()) -> set[int]:  # type: ignore[assignment]
        """Send a signal to the processes, without those with these ids; the ids of all that got it."""
        ids = {worker.id for worker in self._agent.get_worker_group().workers if worker.id is not None} - beside
        for each in ids:
            with suppress(ProcessLookupError):
                os.kill(each, number)
        return ids

    def _losses(self, failures: Any) -> Iterator[tuple[int, str, bool]]:
        """What is known of each lost process, with how little it says of the cause."""
        for rank, failure in sorted(failures.items()):
            code, name = failure.exitcode, f"rank {rank} of {self._processes}"
            if lost := self._report(rank).get("lost"):
                yield 2, lost, False
            elif code < 0:  # those that are left over get SIGTERM
                yield 3 if code == -signal.SIGTERM else 0, f"{name} was killed by {signal.Signals(-code).name}", False
            else:
                yield 1, f"{name} hangs" if code == LOST else f"{name} has ended with exit code {code}", True

    def _report(self, rank: int) -> dict[str, Any]:
        path = self._reports / str(rank)
        return json.loads(path.read_text()) if path.exists() else {}


def _agent(command: Sequence[str], processes: int) -> "LocalElasticAgent":
    """torchrun's agent for processes on this machine, which meet at a port that it has found free."""
    from torch.distributed.elastic.agent.server.api import WorkerSpec
    from torch.distributed.elastic.agent.server.local_elastic_agent import LocalElasticAgent
    from torch.distributed.elastic.multiprocessing import DefaultLogsSpecs
    from torch.distributed.elastic.rendezvous import RendezvousParameters
    from torch.distributed.elastic.rendezvous.registry import get_rendezvous_handler

    for name in [name for name in logging.root.manager.loggerDict if name.startswith("torch.distributed.")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what they say of a lost process is said here, in one line
    meeting = RendezvousParameters("c10d", "localhost:0", uuid.uuid4().hex, 1, 1, local_addr="localhost")
    spec = WorkerSpec(
        role="train",
        local_world_size=processes,
        rdzv_handler=get_rendezvous_handler(meeting),
        entrypoint=sys.executable,
        args=tuple(command),
        max_restarts=0,
        monitor_interval=_POLL,
        local_addr="localhost",
    )
    return LocalElasticAgent(spec, DefaultLogsSpecs(log_dir=os.devnull))
