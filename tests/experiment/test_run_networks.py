"""Runs in environments without a table: networks, simulators, and nothing exact to compare with."""

import json
import math
import sys
from copy import deepcopy
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.pgts import PGTS
from pgts_torch.config import Config, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import run
from pgts_torch.experiment.evaluate import evaluate_run, last_checkpoint
from pgts_torch.experiment.summary import describe
from pgts_torch.experiment.tracking import read_metrics
from tests.experiment.runs import TAGS
from tests.support import same_values

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

NETWORK_TAGS = TAGS | {"losses/explained_variance", "losses/policy", "losses/kl"}
LOOKAHEAD_TAGS = {"search/nodes", "search/pruned", "search/stationarity_gap", "search/certificate"}


def small(folder: Path, *arguments: str, env: str = "CartPole-v1") -> Config:
    """About three iterations of a small network with running statistics of its observations."""
    steps = ["--total_steps", "100", "--rollout.num_envs", "3", "--rollout.horizon.length", "12", "--search.depth", "1"]
    network = ["--policy.type", "mlp", "--policy.hidden", "[8]", "--policy.normalize", "--eval.episodes", "3"]
    return load(None, ["--env.id", env, *steps, *network, "--run.dir", str(folder / "run"), *arguments])


def trained(folder: Path) -> PGTS:
    return PGTS.load(last_checkpoint(folder / "run"))


def test_a_network_run_leaves_a_whole_folder_and_claims_nothing_exact(tmp_path):
    config = small(tmp_path)
    summary = run.train(config)
    folder = tmp_path / "run"
    lines = read_metrics(folder)
    assert len(lines) == summary.iterations >= 3
    for line in lines:
        assert set(line) >= NETWORK_TAGS | LOOKAHEAD_TAGS
        assert not [tag for tag in line if tag.startswith("exact/")]
        assert all(math.isfinite(line[tag]) for tag in NETWORK_TAGS)
    assert load(folder / "config.yaml") == config
    assert not (folder / "policy.png").exists()
    assert (summary.J, summary.J_optimal, summary.stationarity_gap) == (None,) * 3
    assert json.loads((folder / "summary.json").read_text())["J"] is None
    assert set(EventAccumulator(str(folder)).Reload().Tags()["scalars"]) >= NETWORK_TAGS
    text = describe(summary)
    assert "optimal return" not in text
    assert all(len(line) <= 80 for line in text.splitlines()[:-1])


def test_evaluating_the_folder_of_a_run_gives_the_numbers_of_its_summary(tmp_path):
    summary = run.train(small(tmp_path))
    answer = evaluate_run(tmp_path / "run", episodes=3, seed=0)
    assert answer == {"deterministic": summary.deterministic, "sampled": summary.sampled}
    assert evaluate_run(tmp_path / "run", episodes=3, seed=1) != answer


@pytest.mark.fault("evaluation and logging")
@pytest.mark.parametrize("estimator", [[], ["--search.depth", "0", "--estimator.type", "sampled"]])
def test_what_is_logged_and_evaluated_does_not_move_a_bit_of_training(estimator, tmp_path):
    run.train(small(tmp_path, *estimator, "--log.every", "1000", "--run.tensorboard", "false"))
    quiet = trained(tmp_path).state_dict()
    loud = ["--eval.every", "1", "--log.checkpoint_every", "1", "--run.overwrite", *estimator]
    run.train(small(tmp_path, *loud))
    assert same_values(quiet, trained(tmp_path).state_dict())
    assert any("eval/sampled_return" in line for line in read_metrics(tmp_path / "run"))
    run.train(small(tmp_path, *loud, "--seed", "1"))
    assert not same_values(quiet, trained(tmp_path).state_dict())


def test_a_pendulum_is_trained_by_a_knob_and_measured_again_from_its_folder(tmp_path):
    summary = run.train(small(tmp_path, "--env.actions_per_dimension", "3", env="Pendulum-v1"))
    assert summary.model_calls > 0
    answer = evaluate_run(tmp_path / "run", episodes=3, seed=0)
    assert answer["deterministic"] == summary.deterministic
    with pytest.raises(
        PgtsError, match=r"the actions of Pendulum-v1 are continuous, .*: take the policy 'gaussian', or set actions"
    ):
        run.build(small(tmp_path, env="Pendulum-v1"))


def test_an_evaluation_leaves_statistics_and_states_as_they_are(tmp_path):
    algorithm = run.build(small(tmp_path))
    algorithm.iterate()
    assert isinstance(algorithm.policy, NetworkPolicy)
    norm = algorithm.policy.network.trunk.encoder.norm
    assert norm is not None
    model = algorithm.world.model
    assert model is not None
    before, rows, states = deepcopy(algorithm.state_dict()), float(norm.count), model.num_states
    for deterministic in (True, False):
        evaluate(algorithm, episodes=3, deterministic=deterministic, seed=5)
    assert same_values(before, deepcopy(algorithm.state_dict()))
    assert float(norm.count) == rows > 0
    assert model.num_states == states > 0
    algorithm.iterate()
    assert float(norm.count) > rows


def test_an_evaluation_ends_at_the_time_limit_of_the_environment(tmp_path):
    algorithm = run.build(small(tmp_path, env="MountainCar-v0"))
    score = evaluate(algorithm, episodes=2, deterministic=True, seed=0)
    assert (score.episodic_return.mean, score.episodic_length.mean) == (-200.0, 200.0)
    assert score.discounted_return.mean == pytest.approx(-(1 - 0.99**200) / 0.01)


def test_sampled_advantages_train_without_a_model_or_a_lookahead(tmp_path):
    summary = run.train(small(tmp_path, "--search.depth", "0", "--estimator.type", "sampled"))
    assert (summary.search, summary.model_calls, summary.depth) == ("none", 0, 0)
    for line in read_metrics(tmp_path / "run"):
        assert set(line) >= NETWORK_TAGS
        assert not set(line) & LOOKAHEAD_TAGS


def test_a_network_in_a_numbered_environment_is_held_to_the_truth(tmp_path):
    config = small(tmp_path, "--policy.normalize", "false", env="pgts/Ladder-v0")
    summary = run.train(config)
    assert summary.J_optimal == pytest.approx(6.561)
    assert summary.J is not None
    assert {"exact/J", "exact/lookahead_error", "exact/gradient_cosine"} <= set(read_metrics(tmp_path / "run")[-1])
    assert (tmp_path / "run" / "policy.png").exists()


def test_an_environment_whose_module_is_missing_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minigrid", None)
    with pytest.raises(PgtsError, match=r"needs minigrid: pip install 'pgts_torch\[envs\]'"):
        run.train(small(tmp_path, env="MiniGrid-Empty-5x5-v0"))
    assert list(tmp_path.iterdir()) == []


def test_a_table_in_an_environment_without_numbered_states_is_refused(tmp_path):
    with pytest.raises(PgtsError, match="the policy 'softmax' is a table"):
        run.train(
            load(None, ["--env.id", "CartPole-v1", "--policy.type", "softmax", "--run.dir", str(tmp_path / "run")])
        )
    assert list(tmp_path.iterdir()) == []


def test_the_summary_says_what_the_environment_chose(tmp_path):
    few = ["--total_steps", "20", "--rollout.num_envs", "2", "--rollout.horizon.length", "5", "--search.depth", "0"]
    quiet = ["--run.tensorboard", "false", "--eval.episodes", "1", "--run.dir", str(tmp_path / "run")]
    summary = run.train(load(None, ["--env.id", "CartPole-v1", *few, *quiet]))
    assert summary.parts == "NetworkPolicy, NetworkCritic, CMPOUpdate"
    assert "policy, critic, update      NetworkPolicy, NetworkCritic, CMPOUpdate" in describe(summary)


def test_the_environment_chooses_the_parts_that_PGTS_chooses():
    for env_id in ("CartPole-v1", "FrozenLake-v1"):
        configured, own = run.build(load(None, ["--env.id", env_id])), PGTS(env_id)
        for part in ("policy", "critic", "update", "horizon"):
            assert type(getattr(configured, part)) is type(getattr(own, part))
        assert isinstance(own.policy, NetworkPolicy) == (env_id == "CartPole-v1")
