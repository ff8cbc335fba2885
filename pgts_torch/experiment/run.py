"""Train from a configuration: build the algorithm, find where to begin, iterate, and say what became of it."""

import copy
import sys
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import torch

from pgts_torch.agent.board import event_writer
from pgts_torch.agent.pgts import PGTS
from pgts_torch.config import Config
from pgts_torch.errors import Failed, ModelMismatch, NotFinite, Stopped, failure
from pgts_torch.experiment.advice import Movement
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.opening import claimed, opened, seeded
from pgts_torch.experiment.ownership import FAILURE_FILE, SUMMARY_FILE
from pgts_torch.experiment.recorder import Recorder
from pgts_torch.experiment.resume import Start, find, names_modules, resuming
from pgts_torch.experiment.signals import StopFlag
from pgts_torch.experiment.summary import Summary
from pgts_torch.experiment.watchdog import Watchdog
from pgts_torch.ranks import joined_ranks

A_YEAR = 365 * 24 * 3600.0


def build(config: Config) -> PGTS:
    """The algorithm that a configuration describes.

    Raises:
        PgtsError: the environment does not exist or has no model, or parts do not fit it.
    """
    return PGTS(**config.arguments())


def train(config: Config, *, strict_resume: bool = False, any_world_size: bool = False) -> Summary:
    """Run a configuration to its end and leave a run folder.

    If the folder holds an unfinished run of this configuration, the training goes on from its last checkpoint, and
    ends with the same bits as if it had never been cut off.

    Processes that torchrun has started train together; the first one writes and speaks for all.

    Args:
        strict_resume: refuse a last checkpoint that is damaged or of other versions, which otherwise is a warning.
        any_world_size: go on with another number of processes than before.

    Raises:
        PgtsError: something in the configuration cannot be built, or the folder is taken; nothing was written.
        Failed: the environment failed in training; where stands in failure.json.
        NotFinite: training met a number that is not finite; which and where stands in failure.json, too.
        ModelMismatch: the environment contradicted its model; what happened stands in failure.json.
        Stopped: SIGTERM, SIGINT or SIGHUP came; the iteration was finished and saved.
        RankLost: another process is gone; the last checkpoint is what remains.
    """
    torch.set_num_threads(config.threads)
    if config.run.tensorboard:
        event_writer()
    timeout = min(config.run.timeout or A_YEAR, A_YEAR)
    with (
        joined_ranks(config.device, timeout=2 * timeout) as ranks,
        StopFlag() as stop,
        Watchdog(timeout, ranks),
        ExitStack() as held,
    ):
        config = ranks.first("the run folder", lambda: seeded(config))
        algorithm = held.enter_context(ranks.together("the algorithm", lambda: build(config)))
        algorithm.content()  # what cannot be saved is refused now, not at the first checkpoint
        movement = Movement(copy.deepcopy(algorithm.policy))
        locks: list[RunLock] = []  # of the first process

        def begin() -> tuple[Path, Start | None]:
            locks.append(held.enter_context(claimed(config)))
            path = locks[0].path
            if config.run.overwrite:
                return path, None
            return path, find(config, path, strict=strict_resume, world_size=ranks.size, any_world_size=any_world_size)

        path, start = ranks.first("where to begin", begin)
        if start is not None:
            ranks.together("the saved state", lambda: start.load(algorithm))
        folder = ranks.together(
            "an open folder",
            lambda: held.enter_context(opened(config, locks[0], start, algorithm)) if ranks.leads else None,
        )
        if ranks.leads and (why := _out_of_reach(config, algorithm)):
            print(f"note: {why}", file=sys.stderr)
        recorder = Recorder(config, algorithm, path, folder, stop, movement)
        if start is not None:
            recorder.load(start)
        try:
            summary = _loop(config, algorithm, recorder)
        except (NotFinite, ModelMismatch, Failed) as error:
            where = {"iteration": algorithm.num_iterations, "env_step": algorithm.num_env_steps, "seed": config.seed}
            tensor = error.what if isinstance(error, NotFinite) else None
            if folder is not None:
                folder.json(FAILURE_FILE, where | {"tensor": tensor, "message": str(error)})
            raise failure(f"iteration {algorithm.num_iterations} of {path} stopped", error) from error
        if folder is not None:
            folder.json(SUMMARY_FILE, asdict(summary))
    return summary


def _out_of_reach(config: Config, algorithm: PGTS) -> str:
    """Why search.stop_at cannot be reached by any certificate; empty where it can."""
    target, certificates, episodes = config.search.stop_at, algorithm.certificates, algorithm.options.rollout.num_envs
    if target is None or certificates is None or episodes is None or certificates.trust != "sampled starts":
        return ""
    if (least := certificates.width(episodes)) <= target:
        return ""
    return (
        f"search.stop_at is {target}, which ends nothing: start states are known from the {episodes} episodes of an "
        f"iteration only, and from so many no certificate is below {least:.3g}"
    )


def _loop(config: Config, algorithm: PGTS, recorder: Recorder) -> Summary:
    try:
        if not recorder.finished:
            algorithm.learn(config.total_steps, callback=recorder)
    finally:
        recorder.report.close()
    recorder.save()
    if not recorder.finished:
        signals = algorithm.ranks.gather("signals", lambda: recorder.stop.signal)
        again = resuming(recorder.path, algorithm.ranks.size, imports=names_modules(config))
        raise Stopped(
            f"stopped at step {algorithm.num_env_steps}; `{again}` goes on",
            next(each for each in signals if each is not None),
        )
    return algorithm.ranks.first("a summary", recorder.finish)
