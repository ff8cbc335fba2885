"""Several trainings at once, each in its own process; a signal stops all of them, each with a checkpoint."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import final

from pgts_torch.errors import Stopped
from pgts_torch.experiment.signals import StopFlag

_POLL = 0.05
"""Seconds between two polls of the processes."""

_STOPPED = (128 + signal.SIGTERM, -signal.SIGTERM)
"""Exit codes of a training that was terminated: it has saved, or had not begun."""


def train_all(
    trainings: Mapping[str, Sequence[str]],
    *,
    jobs: int,
    unwanted: Callable[[Mapping[str, str]], Collection[str]] = lambda failures: (),
) -> dict[str, str]:
    """Run `pgts train` with each of these arguments, `jobs` at once.

    Args:
        trainings: the arguments, by the name of the training.
        unwanted: the names of those that are not wanted any more, given the failures so far. It is asked all the time;
            then those that run save and end, which is no failure, and those that wait do not begin.

    Returns:
        The last line on stderr of each training that failed, by name.

    Raises:
        Stopped: SIGTERM, SIGINT or SIGHUP came. The trainings have finished their iterations and saved; a second
            signal ends them, and this process, at once.
    """
    failures: dict[str, str] = {}
    waiting, running, finished = deque(trainings.items()), list[_Training](), 0
    with StopFlag(at_once=lambda: _kill(running)) as stop:
        try:
            while running or (waiting and stop.signal is None):
                off = unwanted(failures)
                waiting = deque(each for each in waiting if each[0] not in off)
                while waiting and len(running) < jobs and stop.signal is None:
                    running.append(_Training(*waiting.popleft()))
                stopped = {each.name for each in running if stop.signal is not None or each.name in off}
                for training in [each for each in running if each.ended(terminate=each.name in stopped)]:
                    running.remove(training)
                    code, seconds, last = training.outcome()
                    if code == 0:
                        ending = f"done in {seconds:.0f} s"
                        finished += 1
                    elif training.name in stopped and code in _STOPPED:
                        ending = f"stopped after {seconds:.0f} s"
                    else:
                        ending, failures[training.name] = f"FAILED: {last}", last
                    number = len(trainings) - len(waiting) - len(running)
                    print(f"[{number}/{len(trainings)}] {training.name}: {ending}", file=sys.stderr, flush=True)
                time.sleep(_POLL)
        finally:
            _kill(running)
    if stop.signal is not None:
        raise Stopped(f"stopped: {finished} of {len(trainings)} runs are done; the same command goes on", stop.signal)
    return failures


@final
class _Training:
    """A training process in a process group of its own, so that it gets no signals from the terminal, only from us."""

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self.name = name
        self._started, self._is_terminated = time.perf_counter(), False
        self.stderr = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115 (outlives this)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "pgts_torch.cli", "train", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=self.stderr,
            env={**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
            process_group=0,
        )

    def ended(self, *, terminate: bool) -> bool:
        """Whether the process has ended; if not and `terminate`, send it SIGTERM once."""
        if self.process.poll() is not None:
            return True
        if terminate and not self._is_terminated:
            self.process.terminate()
            self._is_terminated = True
        return False

    def outcome(self) -> tuple[int, float, str]:
        """Exit code, seconds, and last line on stderr."""
        self.stderr.seek(0)
        code, lines = self.process.returncode, self.stderr.read().strip().splitlines()
        self.stderr.close()
        last = f"killed by the signal {-code}" if code < 0 else (lines or [f"exit code {code}"])[-1]
        return code, time.perf_counter() - self._started, last.removeprefix("error: ")


def _kill(trainings: Sequence[_Training]) -> None:
    """Kill processes at once; their checkpoints stay."""
    for each in trainings:
        each.process.kill()
    for each in trainings:
        each.process.wait()
        each.stderr.close()
