"""Choose, create and clear the folder of a run, without touching files that no run has written."""

import itertools
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pgts_torch import files
from pgts_torch.agent.board import hyperparameters
from pgts_torch.agent.pgts import PGTS
from pgts_torch.config import Config, dump, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint, ownership
from pgts_torch.experiment.launch import check_restarts
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.resume import Start
from pgts_torch.experiment.tracking import RunFolder, versions
from pgts_torch.seeding import drawn_seed

RUNS = Path("runs")
"""The parent of run folders where a configuration names none."""


def seeded(config: Config) -> Config:
    """The configuration with a seed: that of the run in its folder, or a new one, where it has none. Writes nothing.

    Raises:
        PgtsError: the configured folder cannot be used as a run folder.
    """
    _check_dir(config)
    if config.seed is not None:
        return config
    run = None if config.run.dir is None or config.run.overwrite else Path(config.run.dir)
    goes_on = run is not None and files.kind(run / ownership.CONFIG_FILE) is not None
    seed = load(run / ownership.CONFIG_FILE).seed if run is not None and goes_on else drawn_seed()
    print(
        f"note: seed is null; {'the run in the folder' if goes_on else 'this run'} has the seed {seed}", file=sys.stderr
    )
    return config.model_copy(update={"seed": seed})


def _check_dir(config: Config) -> None:
    """PgtsError if the configured folder cannot be used as a run folder."""
    if config.run.dir:
        with files.named(f"run.dir {config.run.dir!a}"):
            config.run.dir.encode()  # it is written down in config.yaml
        ownership.check_folder(Path(config.run.dir))
    check_restarts(config, int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")))


@contextmanager
def claimed(config: Config) -> Iterator[RunLock]:
    """Lock the configured folder, or a new one; PgtsError as from `check_folder`, or for an edited configuration."""
    with RunLock(Path(config.run.dir) if config.run.dir else new_folder(config)) as lock:
        _is_edited(config, lock.path, ownership.check_folder(lock.path))
        yield lock


def new_folder(config: Config) -> Path:
    """Create a new folder in runs/. Two processes that do this at the same time get different ones."""
    stem = RUNS / f"{config.name}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    for number in itertools.count(1):
        path = stem if number == 1 else stem.with_name(f"{stem.name}-{number}")
        with files.named(f"run.dir {path} cannot be written to"):
            try:
                path.mkdir(parents=True)
                return path
            except FileExistsError:
                if not path.parent.is_dir():
                    raise
    raise AssertionError


def _is_edited(config: Config, run: Path, mark: ownership.Mark) -> bool:
    """Whether a user has edited config.yaml in a run folder without changing its meaning, so that it is kept.

    Raises:
        PgtsError: it was edited and has another meaning, so that this run would overwrite the user's changes.
    """
    path = run / ownership.CONFIG_FILE
    if files.kind(path) is None or ownership.digest(files.read(path)) in mark.configs:
        return False
    try:
        is_same = load(path).model_copy(update={"run": config.run}) == config
    except PgtsError:
        is_same = False
    if not is_same:
        raise PgtsError(f"{path} is not as a run has written it, and says something else than this one: move it away")
    return True


def opened(config: Config, lock: RunLock, start: Start | None, algorithm: PGTS) -> RunFolder:
    """Write the configuration and the versions; files of earlier runs are removed, or kept where the run resumes,
    TensorBoard events up to the checkpoint."""
    path = lock.path
    lock.check()
    mark = ownership.check_folder(path)
    text = dump(config).encode()
    is_edited = _is_edited(config, path, mark)
    new_mark = mark.of(text) if start is not None else replace(mark.of(text), has_checkpoints=False)
    ownership.write_mark(path, new_mark)  # first of all: the mark makes this a run folder
    if start is None:
        if left := [name for name in ownership.clear(path, mark) if not (is_edited and name == ownership.CONFIG_FILE)]:
            print(
                f"note: run.dir {path} also holds {files.listing(left)}, which no run has left; it stays",
                file=sys.stderr,
            )
    else:
        checkpoint.tidy(path, start.path, keep=config.log.keep)
        print(f"going on from {start.path}", file=sys.stderr)
        if start.lost_best:
            (path / ownership.BEST_FILE).unlink(missing_ok=True)
        if config.run.tensorboard:
            ownership.cut_events(path, start.notes.files if start.has_events else {})
    if config.critic.type == "exact":
        print("note: critic exact learns from the true values; it is for validation", file=sys.stderr)
    if not is_edited:
        files.replace(path / ownership.CONFIG_FILE, text)
    position: dict[str, int] = {}
    if start is not None:
        position = {"metrics_bytes": start.notes.files[ownership.METRICS_FILE][0], "after_step": start.notes.env_steps}
    folder = RunFolder(lock, tensorboard=config.run.tensorboard, **position)
    if folder.events is not None and folder.events.is_new:
        folder.events.begin(
            hyperparameters(algorithm.parts, env_kwargs=config.env.kwargs, seed=algorithm.seed),
            text.decode(),
        )
    folder.json(ownership.VERSIONS_FILE, versions() | {"threads": config.threads})
    return folder
