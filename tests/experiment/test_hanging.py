"""A process that hangs is noticed and says where; one that is slow is left alone."""

import itertools
import re
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from gymnasium.envs.classic_control import CartPoleEnv

from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.errors import LOST
from pgts_torch.experiment import checkpoint, run
from pgts_torch.ranks import joined_ranks
from tests.experiment.runs import arguments, left
from tests.forks import in_child, launched

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

SECONDS = 3.0
"""Longer than any call of a training takes on a busy machine."""

FOR_EVER = 1e5


def sleeps() -> None:
    time.sleep(FOR_EVER)


def spins() -> None:
    while True:
        pass


def lets_no_other_thread_run() -> None:
    sum(itertools.repeat(0))


def training(folder: Path, does: Callable[[], Any], *, rank: int = 0, evaluating: bool = False) -> int:
    """Train in a process whose environments do this in each step of the third iteration; its exit code. Only where the
    process ends after it.

    Args:
        evaluating: not in that iteration, but in the evaluation after it.
    """
    iterate, step, hangs = PGTS.iterate, CartPoleEnv.step, False

    def noted(self: PGTS) -> Any:
        nonlocal hangs
        is_third = self.num_iterations == 2 and self.ranks.rank == rank
        hangs = is_third and not evaluating
        made = iterate(self)
        hangs = is_third and evaluating
        return made

    def stepped(self: CartPoleEnv, action: Any) -> Any:
        if hangs:
            does()
        return step(self, action)

    PGTS.iterate, CartPoleEnv.step = noted, stepped  # type: ignore[method-assign]
    return main(arguments(folder, f"--run.timeout={SECONDS}"))


@pytest.fixture(scope="module", autouse=True)
def whole(tmp_path_factory) -> dict[str, Any]:
    """What a training leaves that does not hang. What it imports is not imported again where the time is short."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main(arguments(folder)) == 0
    return left(folder)


def complaints(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("error: ")]


@pytest.mark.fault("environment that hangs")
@pytest.mark.parametrize("does", [sleeps, pytest.param(spins, marks=pytest.mark.long)])
def test_an_environment_that_hangs_ends_the_training_which_goes_on_from_its_checkpoint(does, whole, tmp_path, capfd):
    folder = tmp_path / "run"
    assert in_child(lambda: training(folder, does)) == LOST
    [line] = complaints(capfd.readouterr().err)
    at = rf"{does.__name__} in line \d+ of {re.escape(__file__)}"
    assert re.match(rf"error: the process hangs in its episodes: {at} has not come back for 3 s \(run.timeout\)", line)
    assert checkpoint.newest(folder, strict=True)[1].iterations == 2
    assert main(arguments(folder)) == 0
    assert left(folder) == whole


@pytest.mark.fault("environment that hangs")
def test_a_call_that_holds_the_interpreter_is_ended_with_a_traceback(tmp_path, capfd):
    assert in_child(lambda: training(tmp_path / "run", lets_no_other_thread_run)) == 1
    assert re.search(r"^Timeout .*\n(.*\n)*.* in lets_no_other_thread_run$", capfd.readouterr().err, re.MULTILINE)


@pytest.mark.long
def test_it_is_said_what_the_process_was_doing(tmp_path, capfd):
    assert in_child(lambda: training(tmp_path / "run", sleeps, evaluating=True)) == LOST
    [line] = complaints(capfd.readouterr().err)
    assert line.startswith("error: the process hangs in an evaluation: sleeps in line ")


@pytest.mark.parametrize(("ranks", "share"), [(1, 1 / 16), pytest.param(2, 1 / 6, marks=pytest.mark.long)])
def test_slow_steps_that_take_longer_in_all_are_no_hang(ranks, share, tmp_path):
    """Each call is a fraction of the limit. They are made from one place, so it is calls that must be told apart. The
    first of two processes waits for the second one for longer than the limit."""

    def work() -> int:
        patient = partial(joined_ranks, timeout=FOR_EVER)  # its own limit of waiting is another matter
        run.joined_ranks = lambda device, timeout: patient(device)  # type: ignore[assignment]
        return training(tmp_path / "run", lambda: time.sleep(share * SECONDS), rank=ranks - 1)

    begun = time.perf_counter()
    assert launched(ranks, work) == [0] * ranks
    assert time.perf_counter() - begun > 4 / 3 * SECONDS


@pytest.mark.fault("rank that hangs")
@pytest.mark.parametrize("rank", [pytest.param(0, marks=pytest.mark.long), 1])
def test_a_rank_that_hangs_is_named_and_all_end(rank, tmp_path, capfd):
    folder = tmp_path / "run"
    assert launched(2, lambda: training(folder, sleeps, rank=rank)) == [LOST, LOST]
    lines = complaints(capfd.readouterr().err)
    assert lines[0].startswith(f"error: rank {rank} of 2 hangs in its episodes: sleeps in line ")
    assert lines[1:] == ["error: rank 0 of 2 has lost another one, asking for episodes"] * rank
    assert checkpoint.newest(folder, strict=True)[1].iterations == 2
