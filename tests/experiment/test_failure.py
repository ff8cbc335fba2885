"""A run that meets a number that is not finite, or an environment that fails: it says where and keeps what was good."""

import json
from pathlib import Path

import numpy as np
import pytest

from pgts_torch.agent.evaluate import Evaluator
from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import ModelMismatch, NotFinite
from pgts_torch.experiment.evaluate import last_checkpoint

ROOT = Path(__file__).parents[2]


@pytest.fixture
def breaks_in_the_third_iteration(monkeypatch):
    """Rewards are not numbers from the 31st step on; an iteration has 15."""
    step, calls = TabularVectorEnv.step, iter(range(10**6))

    def wrapped(self, actions):
        observation, reward, *rest = step(self, actions)
        return observation, np.full_like(reward, np.nan) if next(calls) >= 30 else reward, *rest

    monkeypatch.setattr(TabularVectorEnv, "step", wrapped)


def train(folder: Path, *arguments: str) -> int:
    few = ["--total_steps=600", "--rollout.num_envs=4", "--rollout.horizon.length=15", "--eval.episodes=1"]
    return main(["train", "--config", str(ROOT / "configs" / "ladder.yaml"), *few, f"--run.dir={folder}", *arguments])


@pytest.mark.fault("reward that is not finite")
@pytest.mark.usefixtures("breaks_in_the_third_iteration")
def test_a_run_that_meets_what_is_not_finite_keeps_its_checkpoints_writes_what_it_met_and_exits_with_1(
    tmp_path, capsys
):
    folder = tmp_path / "run"
    assert train(folder, "--seed=7", "--log.checkpoint_every=1") == 1
    record = json.loads((folder / "failure.json").read_text())
    message = record.pop("message")
    assert record == {"iteration": 2, "env_step": 120, "seed": 7, "tensor": "reward"}
    assert "the rewards are [nan, nan, nan, nan]" in message
    complaint = capsys.readouterr().err.splitlines()[-1]
    assert complaint == f"error: iteration 2 of {folder} stopped: {message}"
    assert PGTS.load(last_checkpoint(folder)).num_env_steps == 120
    assert not (folder / "summary.json").exists()


@pytest.mark.usefixtures("undrawn")
@pytest.mark.fault("environment raises an error")
def test_a_run_whose_environment_raises_writes_down_where_and_what(tmp_path, monkeypatch, capsys):
    step, calls = TabularVectorEnv.step, iter(range(10**6))
    monkeypatch.setattr(
        TabularVectorEnv, "step", lambda self, actions: step(self, actions) if next(calls) < 30 else 1 / 0
    )
    folder = tmp_path / "run"
    assert train(folder, "--log.checkpoint_every=1") == 2
    record = json.loads((folder / "failure.json").read_text())
    assert (record["iteration"], record["env_step"], record["tensor"]) == (2, 120, None)
    assert record["message"].endswith("ZeroDivisionError: division by zero")
    complaint = capsys.readouterr().err.splitlines()[-1]
    assert complaint == f"error: iteration 2 of {folder} stopped: {record['message']}"
    assert main(["report", str(folder)]) == 0
    assert "Training stopped in iteration 2, at step 120: pgts/Ladder-v0 failed" in (folder / "report.html").read_text()


def test_what_is_not_finite_in_the_last_evaluation_is_written_down_too(tmp_path, monkeypatch):
    def fails(*args, **kwargs):
        raise NotFinite("the rewards are [nan]; they must be finite", what="reward")

    monkeypatch.setattr(Evaluator, "__call__", fails)
    assert train(tmp_path / "run") == 1
    record = json.loads((tmp_path / "run" / "failure.json").read_text())
    assert (record["env_step"], record["tensor"]) == (600, "reward")
    assert PGTS.load(last_checkpoint(tmp_path / "run")).num_env_steps == 600


def test_a_run_whose_environment_contradicts_its_model_writes_down_what_happened_and_exits_with_2(
    tmp_path, monkeypatch, capsys
):
    def contradicted(*args, **options):
        raise ModelMismatch("state 1 under action 0 led to 3")

    monkeypatch.setattr("pgts_torch.agent.pgts.visit", contradicted)
    folder = tmp_path / "run"
    assert train(folder) == 2
    record = json.loads((folder / "failure.json").read_text())
    assert (record["iteration"], record["tensor"], record["message"]) == (0, None, "state 1 under action 0 led to 3")
    complaint = capsys.readouterr().err.splitlines()[-1]
    assert complaint == f"error: iteration 0 of {folder} stopped: state 1 under action 0 led to 3"
