"""A training that was cut off ends with the bits of one that was not; what cannot go on says why."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pgts_torch.agent.pgts import PGTS
from pgts_torch.experiment import checkpoint, run
from pgts_torch.experiment.config import Config
from pgts_torch.experiment.evaluate import last_checkpoint
from pgts_torch.experiment.loading import load
from pgts_torch.experiment.tracking import RunFolder, read_metrics

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

TABLE = ["--total_steps", "360", "--rollout.num_envs", "4", "--rollout.horizon.length", "15", "--eval.episodes", "2"]
NETWORK = ["--rollout.num_envs", "2", "--rollout.horizon.length", "10", "--search.depth", "1", "--policy.type", "mlp"]
KINDS: dict[str, list[str]] = {
    "table": ["--eval.every", "60", "--eval.keep_best"],
    "adaptive": ["--search.depth", "adaptive", "--critic.target", "q"],
    "certified": ["--search.depth", "2", "--search.stop_at", "5.9", "--critic", "{type: exact}"],
    "tree": ["--search.kind", "mcts", "--search.simulations", "4", "--search.merge", "true"],
    "network": [*NETWORK, "--env.id", "CartPole-v1", "--policy.normalize", "--total_steps", "100"],
    "budget": [*NETWORK, "--env.id", "CartPole-v1", "--total_steps", "100", "--search.max_nodes", "100"],
    "simulator": [
        *NETWORK[:4],
        "--env.id",
        "MiniGrid-Empty-5x5-v0",
        "--env.observation_key",
        "image",
        *NETWORK[4:6],
        "--policy",
        "{type: cnn, scale: 10, channels: [4], hidden: [8]}",
        "--total_steps",
        "60",
    ],
    "sampled": [*NETWORK, "--env.id", "CartPole-v1", "--search.depth", "0", "--estimator.type", "sampled"],
}


def configured(folder: Path, *arguments: str) -> Config:
    """About six iterations, with a checkpoint after each."""
    return load(None, [*TABLE, "--log.checkpoint_every", "1", "--run.dir", str(folder), *arguments])


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
    events = EventAccumulator(str(folder)).Reload().Scalars("search/model_calls")
    for name in ("seconds", "run"):
        del summary[name]
    return state, lines, summary, [(event.step, event.value) for event in events]


def same_bits(first: Any, second: Any) -> bool:
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second) and first.dtype == second.dtype
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same_bits(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(same_bits, first, second))
    return first == second or (first != first and second != second)


@pytest.mark.parametrize("kind", KINDS)
def test_a_training_cut_off_anywhere_ends_with_the_bits_of_one_that_was_not(kind, tmp_path, monkeypatch):
    run.train(configured(tmp_path / "whole", *KINDS[kind]))
    config = configured(tmp_path / "cut", *KINDS[kind])
    cut_off(config, monkeypatch, after=0)
    cut_off(config, monkeypatch, after=1)
    assert len(read_metrics(tmp_path / "cut")) >= 2  # more than the checkpoint knows
    run.train(config)
    assert same_bits(left(tmp_path / "whole"), left(tmp_path / "cut"))
    if kind == "table":
        assert same_bits(*(PGTS.load(tmp_path / name / "best.pt").state_dict() for name in ("whole", "cut")))
        run.train(configured(tmp_path / "other", *KINDS[kind], "--seed", "1"))
        assert not same_bits(left(tmp_path / "whole"), left(tmp_path / "other"))
