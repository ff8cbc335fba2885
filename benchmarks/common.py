"""What the search benchmarks share: MDPs, exact truth, timing in turns, one core, a report as JSON."""

import importlib.metadata
import json
import multiprocessing
import os
import platform
import statistics
import sys
import tempfile
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import torch

from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, random_mdp

SECONDS = 0.02
"""How long one repeat lasts at least: fast forms run more than once in it."""

Form = Callable[[], Any]


def frozen_lake() -> TabularMDP:
    return TabularMDP.from_gymnasium(gymnasium.make("FrozenLake8x8-v1"), 0.99)


def taxi() -> TabularMDP:
    return TabularMDP.from_gymnasium(gymnasium.make("Taxi-v4"), 0.99)


def garnet() -> TabularMDP:
    return random_mdp(200, 4, branching=5)


MDPS: dict[str, Callable[[], TabularMDP]] = {
    "Grid": grid,
    "FrozenLake8x8": frozen_lake,
    "Taxi": taxi,
    "Garnet(200,4,5)": garnet,
    "DeepSea(20)": lambda: deep_sea(20),
}


def uniform_evaluation(mdp: TabularMDP) -> exact.Evaluation:
    pi_SA = torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions, dtype=torch.float64)
    return exact.evaluate(mdp, pi_SA)


def sampled_roots(mdp: TabularMDP, count: int) -> torch.Tensor:
    """States in which something can still follow, drawn with a fixed seed: distinct ones if there are that many."""
    goes_on_S = ((mdp.outcomes.prob_NAK > 0) & (mdp.outcomes.discount_NAK > 0)).any(-1).any(-1)
    states = torch.nonzero(goes_on_S).flatten().numpy()
    return torch.from_numpy(numpy_stream(0, "roots").choice(states, count, replace=count > len(states)))


def unmerged_nodes(mdp: TabularMDP, root: int, expansions: int) -> float:
    """Nodes of the tree in which every path is its own: 1 + the number of outcomes with weight, level by level."""
    outcomes = mdp.outcomes
    counts_NAK = (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0)
    row_N = torch.arange(mdp.num_states)[:, None, None].expand_as(counts_NAK)[counts_NAK]
    child_N = outcomes.child_NAK[counts_NAK]
    paths_S = torch.nn.functional.one_hot(torch.tensor(root), mdp.num_states).double()
    nodes = 1.0
    for _ in range(expansions):
        paths_S = torch.zeros_like(paths_S).index_add_(0, child_N, paths_S[row_N])
        nodes += float(paths_S.sum())
    return nodes


def take_turns(forms: dict[str, Form], repeats: int) -> dict[str, list[float]]:
    """Milliseconds of each form in each repeat; a first repeat, in which caches fill, does not count."""
    rounds = [{name: milliseconds(form) for name, form in forms.items()} for _ in range(repeats + 1)]
    return {name: [times[name] for times in rounds[1:]] for name in forms}


def milliseconds(form: Form) -> float:
    """CPU time of one call of the form, which other work of the machine hardly changes, or with a GPU wall time; the
    mean of as many as fill `SECONDS`."""
    on_gpu = torch.cuda.is_initialized()
    clock = time.perf_counter if on_gpu else time.process_time
    calls, begin, end = 0, clock(), 0.0
    while end < begin + SECONDS:
        for _ in range(max(1, calls)):  # to read the clock takes a while too
            form()
            if on_gpu:
                torch.cuda.synchronize()
            calls += 1
        end = clock()
    return (end - begin) / calls * 1e3


@contextmanager
def timed(owner: Any, name: str, clock: Callable[[], float] = time.process_time) -> Iterator[list[float]]:
    """The CPU seconds, or those of another clock, of each call of `owner.name` within."""
    plain, seconds = getattr(owner, name), []

    def call(*args: Any, **kwargs: Any) -> Any:
        begin = clock()
        try:
            return plain(*args, **kwargs)
        finally:
            seconds.append(clock() - begin)

    setattr(owner, name, call)
    try:
        yield seconds
    finally:
        setattr(owner, name, plain)


def on_ranks(size: int, work: Callable[[], Any]) -> list[Any]:
    """What `work` gives in each of so many processes that train together, in the order of ranks. They are forked."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:

        def join(rank: int) -> None:
            torch.distributed.init_process_group("gloo", f"file://{folder}/meeting", world_size=size, rank=rank)
            torch.distributed.barrier()
            Path(folder, f"{rank}.json").write_text(json.dumps(work()))
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

        processes = [multiprocessing.get_context("fork").Process(target=join, args=(rank,)) for rank in range(size)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        if any(process.exitcode for process in processes):
            raise SystemExit("a process has failed")
        return [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(size)]


def median_ratio(above: list[float], below: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(above, below, strict=True))


def use_one_core(device: str = "cpu") -> None:
    """One thread of one core for torch and, if it is imported later, for XLA, which runs on the same kind of device."""
    torch.set_num_threads(1)
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["JAX_PLATFORMS"] = device.partition(":")[0]
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # torch needs memory too
    if sys.platform == "linux":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def parser(doc: str) -> ArgumentParser:
    """The options of all search benchmarks."""
    options = ArgumentParser(description=doc, formatter_class=RawDescriptionHelpFormatter)
    options.add_argument("--json", type=Path, help="where to write the figures")
    options.add_argument("--device", default="cpu", help="where searches run: cpu or cuda")
    options.add_argument("--quick", action="store_true", help="fewer sizes and repeats, under a minute")
    return options


def about(args: Namespace) -> dict[str, Any]:
    """What the figures were measured with."""
    packages = ("pgts_torch", "torch", "numpy", "gymnasium", "mctx", "jax")
    installed = {package.metadata["Name"]: package.version for package in importlib.metadata.distributions()}
    device = torch.cuda.get_device_name(args.device) if args.device.startswith("cuda") else args.device
    return {
        "threads": 1,
        "device": device,
        "quick": args.quick,
        "versions": {"python": platform.python_version()} | {p: installed[p] for p in packages if p in installed},
    }


def write(report: dict[str, Any], path: Path | None) -> None:
    if path:
        path.write_text(json.dumps(report, indent=2) + "\n")


def short(number: float) -> str:
    """A number in at most 5 characters: 3.25, 812, 1.4k, 22k, 4.2M, 40G, 4e+15."""
    for factor, unit in ((1, ""), (1e3, "k"), (1e6, "M"), (1e9, "G")):
        if number < 999.5 * factor:
            scaled = number / factor
            if not unit and float(scaled).is_integer():
                return f"{scaled:.0f}"
            return f"{scaled:.{max(0, 2 - len(str(int(scaled))) + (not unit))}f}{unit}"
    return f"{number:.0e}"
