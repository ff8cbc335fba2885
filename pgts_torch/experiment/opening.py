"""Choose, create and clear the folder of a run, without touching files that no run has written."""

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pgts_torch import files
from pgts_torch.config import Config, dump
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.ownership import (
    BEST_FILE,
    CONFIG_FILE,
    METRICS_FILE,
    VERSIONS_FILE,
    Mark,
    check_folder,
    clear,
    clear_events,
    listing,
    write_mark,
)
from pgts_torch.experiment.resume import Start, is_kept
from pgts_torch.experiment.tracking import RunFolder, versions

RUNS = Path("runs")
"""The parent of run folders where a configuration names none."""


def check_dir(config: Config) -> None:
    """PgtsError if the configured folder cannot be used as a run folder. Writes nothing."""
    if config.run.dir:
        with files.named(f"run.dir {config.run.dir!a}"):
            config.run.dir.encode()  # it is written down in config.yaml
        check_folder(Path(config.run.dir))
    elif int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")):
        raise PgtsError("run.dir is not set; torchrun --max-restarts needs it, so that a restart finds the run")


def claimed(config: Config) -> RunLock:
    """The lock of the configured folder, or of a new one; PgtsError as from `check_folder`."""
    lock = RunLock(Path(config.run.dir) if config.run.dir else _new_folder(config))
    try:
        is_kept(config, lock.path, check_folder(lock.path))
    except BaseException:
        lock.__exit__(None, None, None)
        raise
    return lock


def _new_folder(config: Config) -> Path:
    """Create a new folder in runs/. Two processes that do this at the same time get different ones."""
    stem = RUNS / f"{config.name}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    number = 1
    while True:
        path = stem if number == 1 else stem.with_name(f"{stem.name}-{number}")
        with files.named(f"run.dir {path} cannot be written to"):
            try:
                path.mkdir(parents=True)
                return path
            except FileExistsError:
                if not path.parent.is_dir():
                    raise
        number += 1


def opened(config: Config, lock: RunLock, start: Start | None) -> RunFolder:
    """Write the configuration and the versions; files of earlier runs are removed, or kept where the run resumes."""
    path = lock.path
    lock.check()
    mark = check_folder(path)
    text = dump(config).encode()
    keeps_config = is_kept(config, path, mark)
    position: dict[str, Any] = {}
    if start is None:
        mark = replace(mark, has_checkpoints=False)
    write_mark(path, mark.of(text))  # first of all: the mark makes this a run folder
    if start is None:
        if left := [name for name in clear(path, mark) if not (keeps_config and name == CONFIG_FILE)]:
            print(f"note: run.dir {path} also holds {listing(left)}, which no run has left; it stays", file=sys.stderr)
        write_mark(path, Mark(configs=mark.configs).of(text))
    else:
        checkpoint.tidy(path, start.path, keep=config.log.keep)
        print(f"going on from {start.path}", file=sys.stderr)
        position = {"metrics_bytes": start.notes.files[METRICS_FILE][0], "after_step": start.notes.env_steps}
        if config.run.tensorboard and not start.has_events:
            clear_events(path, mark)
            position |= {"after_step": None, "rebuild": True}
        if start.lost_best:
            (path / BEST_FILE).unlink(missing_ok=True)
    if config.critic.type == "exact":
        print("note: critic exact learns from the true values; it is for validation", file=sys.stderr)
    if not keeps_config:
        files.replace(path / CONFIG_FILE, text)
    folder = RunFolder(path, lock=lock, tensorboard=config.run.tensorboard, **position)
    folder.text(VERSIONS_FILE, json.dumps(versions() | {"threads": config.threads}, indent=2) + "\n")
    return folder
