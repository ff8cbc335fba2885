"""Runs that are cut off as by `kill -9`, and what they leave."""

import json
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pgts_torch.agent.pgts import PGTS
from pgts_torch.config import Config, load
from pgts_torch.experiment import checkpoint, run
from pgts_torch.experiment.evaluate import last_checkpoint
from pgts_torch.experiment.tracking import RunFolder, read_metrics

SHORT = ["--total_steps", "300", "--rollout.num_envs", "4", "--rollout.horizon.length", "15", "--eval.episodes", "2"]
QUIET = ["--run.tensorboard", "false"]
WATCHED = ["--eval.every", "60", "--eval.keep_best", "--search.depth", "adaptive"]


def configured(folder: Path, *arguments: str) -> Config:
    """About five iterations, with a checkpoint after each."""
    return load(None, [*SHORT, "--log.checkpoint_every", "1", "--run.dir", str(folder), *arguments])


class Killed(BaseException):
    """Stands for `kill -9`: nothing is written after it."""


def cut_off(config: Config, monkeypatch: pytest.MonkeyPatch, *, after: int, logs: int = 1) -> None:
    """Train until so many checkpoints are written, and after that so many lines of metrics, then die."""
    written = {"checkpoints": 0, "logs": 0}
    write, log = checkpoint.write, RunFolder.log

    def counted_write(*args: Any, **kwargs: Any) -> Path:
        written["checkpoints"] += 1
        return write(*args, **kwargs)

    def counted_log(*args: Any) -> None:
        log(*args)
        written["logs"] += written["checkpoints"] >= after
        if written["logs"] >= logs:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write", counted_write)
        patch.setattr(RunFolder, "log", counted_log)
        with pytest.raises(Killed):
            run.train(config)


def left(folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]], dict[str, Any], list[tuple[int, float]]]:
    """Weights and counters, metrics, summary and a TensorBoard curve, without what the clock says."""
    state = PGTS.load(last_checkpoint(folder)).state_dict()
    lines = [{tag: value for tag, value in line.items() if tag != "charts/SPS"} for line in read_metrics(folder)]
    summary = json.loads((folder / "summary.json").read_text())
    for name in ("seconds", "run"):
        del summary[name]
    return state, lines, summary, curve(folder)


def curve(folder: Path) -> list[tuple[int, float]]:
    """What TensorBoard shows of a tag; nothing where there are no events."""
    if not list(folder.glob("events*")):
        return []
    events = EventAccumulator(str(folder)).Reload().Scalars("search/model_calls")
    return [(event.step, event.value) for event in events]


def arguments(*more: str) -> list[str]:
    return ["train", *SHORT, *QUIET, "--log.checkpoint_every", "1", "--run.dir", "cut", *more]


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path): path.read_bytes() for path in files}
