"""The method from samples, repeated over seeds in worker processes, and what the repetitions say together."""

import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from pgts_torch.agent.pgts import PGTS
from pgts_torch.experiment.statistics import bootstrap_interval, interquartile_mean
from pgts_torch.seeding import numpy_stream, seed_sequence
from pgts_torch.tabular import exact

WORKERS = 2
RESAMPLES = 2000


@dataclass(frozen=True)
class Job:
    """One training run: `iterations` updates of PGTS with these arguments, from the stream of its own name.

    stream: names the run; runs of different names are independent.
    """

    stream: tuple[str | int, ...]
    env_id: str
    iterations: int
    arguments: Mapping[str, Any]


def returns(job: Job) -> list[float]:
    """The exact return of pi_0 .. pi_K in one run."""
    seed = int(seed_sequence(0, "figures", *job.stream).generate_state(1, np.uint64)[0] >> np.uint64(1))
    algorithm = PGTS(job.env_id, seed=seed, **job.arguments)
    J = [exact.evaluate(algorithm.mdp, algorithm.policy_table()).J]
    for _ in range(job.iterations):
        algorithm.iterate()
        J.append(exact.evaluate(algorithm.mdp, algorithm.policy_table()).J)
    return J


class Here(Executor):
    """Runs what it is given at once, in this process."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The finished future of function(*args)."""
        future: Future[Any] = Future()
        future.set_result(function(*args, **kwargs))
        return future


def executor(workers: int) -> Executor:
    """Processes that run jobs on one thread each; 0 workers: this process. How many changes no result."""
    if workers == 0:
        return Here()
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=torch.set_num_threads, initargs=(1,))


@dataclass(frozen=True)
class Band:
    """The interquartile mean of several curves and its confidence interval, point by point."""

    iqm: list[float]
    low: list[float]
    high: list[float]


def band(J_NK: Float[np.ndarray, "N K"], *names: str | int) -> Band:
    """Interquartile mean over N seeds with its bootstrap percentile interval.   (Agarwal et al. 2021)

    Args:
        names: of the stream that resamples the seeds.
    """
    random = numpy_stream(0, "bootstrap", *names)
    low_K, high_K = bootstrap_interval(J_NK.T, random=random, resamples=RESAMPLES)
    return Band(interquartile_mean(J_NK.T).tolist(), low_K.tolist(), high_K.tolist())
