"""The run loop, the folder it leaves, and the numbers in it."""

import io
import json
import math
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pgts_torch.agent import diagnostics
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.config import Config, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import pictures, run
from pgts_torch.experiment.evaluate import last_checkpoint
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.pictures import policy_picture  # before conftest.py puts a smaller one in its place
from pgts_torch.experiment.summary import describe
from pgts_torch.experiment.tracking import RunFolder, read_metrics
from pgts_torch.models.environments import EnvSource
from pgts_torch.options.models import LEARNED
from pgts_torch.tabular import exact, stationary
from pgts_torch.tabular.ascent import mirror_step
from tests.config.shipped import SHIPPED, skip_unless_installed
from tests.experiment.runs import TAGS

ROOT = Path(__file__).parents[2]
LESS_REPLAY = ["--rollout.num_envs", "1", "--rollout.horizon.first", "15", "--replay.updates_per_step", "0.02"]
FEW_ROOTS = ["--search.max_roots", "2"]
OF_EPISODES = {"charts/discounted_return", "charts/episodic_return", "charts/episodic_length"}
"""Tags of episodes that end, which an iteration need not have where they go on."""
EXACT_TAGS = {"search/nodes", "search/stationarity_gap", "exact/J", "exact/optimality_gap", "exact/lookahead_error"}


def few_iterations(folder: Path, *arguments: str, config: Path = ROOT / "configs" / "ladder.yaml") -> Config:
    """A shipped configuration, cut down to about three iterations of four episodes."""
    steps = [
        "--total_steps",
        "150",
        "--rollout.num_envs",
        "4",
        "--rollout.horizon.length",
        "15",
        "--eval.episodes",
        "2",
    ]
    return load(str(config), [*steps, "--run.dir", str(folder / "run"), *arguments])


@pytest.mark.usefixtures("unchecked_shapes")  # other tests check them; here they cost half the time
@pytest.mark.filterwarnings("ignore:.*has wrappers that are part of the model", "ignore:.*has random steps")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name.startswith("atari") else name for name in SHIPPED]
)
def test_each_shipped_configuration_runs_and_leaves_a_whole_folder(name, tmp_path, monkeypatch):
    skip_unless_installed(name)
    config = SHIPPED[name]
    monkeypatch.setattr(pictures, "policy_picture", policy_picture)
    monkeypatch.setattr(EnvSource, "time_limit", 15)
    model, roots = load(config).model, load(config).search.max_roots
    learns, fits = isinstance(model, LEARNED), hasattr(model, "first_updates")
    replays = learns or load(config).replay.type == "uniform"
    less = LESS_REPLAY if replays else FEW_ROOTS if roots is not None else []
    less = [*less, *(["--model.first_updates", "5"] if fits else [])]
    summary = run.train(few_iterations(tmp_path, *less, config=config))
    folder = tmp_path / "run"
    lines = read_metrics(folder)
    is_table = load(config).policy.type in ("softmax", "simplex") and not learns
    own = TAGS - OF_EPISODES if replays else TAGS
    tags = own | {tag for tag in EXACT_TAGS if is_table or not tag.startswith("exact/")}
    assert len(lines) == summary.iterations >= 2
    for line in lines:
        assert set(line) >= tags | {"step"}
        assert is_table == any(tag.startswith("exact/") for tag in line)
        assert all(math.isfinite(line[tag]) for tag in tags)
    assert lines[-1]["step"] == summary.env_steps >= 150
    assert load(str(folder / "config.yaml")) == few_iterations(tmp_path, *less, config=config)
    assert json.loads((folder / "versions.json").read_text())["torch"] == version("torch")
    assert json.loads((folder / "summary.json").read_text())["J"] == summary.J
    assert (summary.J is not None) == is_table
    events = EventAccumulator(str(folder)).Reload()
    assert set(events.Tags()["scalars"]) >= tags
    assert [event.step for event in events.Scalars("losses/value")] == [line["step"] for line in lines]
    assert events.Tags()["images"] == (["policy"] if is_table else [])
    if is_table:
        drawn, logged = imread(folder / "policy.png"), io.BytesIO(events.Images("policy")[0].encoded_image_string)
        assert min(drawn.shape[:2]) > 300
        assert np.array_equal(drawn, imread(logged))


def test_the_metrics_of_a_line_are_those_of_the_policy_that_made_its_episodes(tmp_path):
    config = few_iterations(tmp_path)
    algorithm = run.build(config)
    truth = diagnostics.Truth(algorithm.mdp, algorithm.update)
    algorithm.iterate()  # so that the critic knows something
    pi_SA = algorithm.policy.table()
    iteration = algorithm.iterate()
    tags = diagnostics.metrics(algorithm.parts, iteration, algorithm.counters) | truth.metrics(pi_SA, iteration)
    evaluation = exact.evaluate(algorithm.mdp, pi_SA)
    look_SA = exact.lookahead(algorithm.mdp, evaluation.q_SA, 4)
    assert tags["exact/J"] == evaluation.J
    assert tags["exact/optimality_gap"] == pytest.approx(6.561 - evaluation.J)
    error = (iteration.look.q_BA - look_SA[iteration.state_N]).abs().max()
    assert tags["exact/lookahead_error"] == float(error) > 0
    assert tags["charts/discounted_return"] == float(iteration.experience.returns().mean())
    assert tags["exact/J"] != exact.evaluate(algorithm.mdp, algorithm.policy.table()).J


@pytest.mark.parametrize("update", ["softmax", "mirror"])
def test_with_the_exact_critic_the_lookahead_has_no_error_and_the_direction_is_nearly_exact(update, tmp_path):
    config = few_iterations(tmp_path, "--critic", "{type: exact}", "--update.type", update, "--rollout.num_envs", "400")
    algorithm = run.build(config)
    truth = diagnostics.Truth(algorithm.mdp, algorithm.update)
    pi_SA = algorithm.policy.table()
    tags = truth.metrics(pi_SA, algorithm.iterate())
    assert tags["exact/lookahead_error"] < 1e-12
    assert 0.99 < tags["exact/gradient_cosine"] <= 1 + 1e-12


@pytest.mark.parametrize(("points", "every", "lines"), [(1000, 1, 10), (5, 1, 6), (2, 1, 3), (2, 3, 3)])
def test_a_policy_is_compared_with_the_truth_at_so_many_points_and_in_the_first_and_last_line(
    points, every, lines, tmp_path
):
    # Ladder pays until the horizon: ten iterations of 60 steps each.
    given = ["--total_steps", "600", "--log.exact_points", str(points), "--log.every", str(every)]
    run.train(few_iterations(tmp_path, *given, "--eval.episodes", "1"))
    metrics = read_metrics(tmp_path / "run")
    assert len(metrics) == 10 // every
    compared = ["exact/J" in line for line in metrics]
    assert sum(compared) == lines
    assert compared[0]
    assert compared[-1]


def test_a_direction_of_zero_has_no_cosine():
    left = {"type": "softmax", "init": {"type": "biased", "action": 0, "probability": 0.9999}}
    algorithm = PGTS("pgts/Ladder-v0", depth=0, policy=left, num_envs=2, seed=0)
    truth = diagnostics.Truth(algorithm.mdp, algorithm.update)
    pi_SA = algorithm.policy.table()
    assert "exact/gradient_cosine" not in truth.metrics(pi_SA, algorithm.iterate())


@pytest.mark.fault("evaluation and logging")
def test_what_is_logged_and_evaluated_does_not_change_what_is_learned(tmp_path):
    quiet = few_iterations(tmp_path, "--log.every", "1000", "--run.tensorboard", "false")
    loud = few_iterations(tmp_path, "--eval.every", "1", "--log.checkpoint_every", "1", "--run.overwrite")
    run.train(quiet)
    silent = PGTS.load(last_checkpoint(tmp_path / "run")).policy.table()
    run.train(loud)
    watched = PGTS.load(last_checkpoint(tmp_path / "run")).policy.table()
    assert torch.equal(silent, watched)
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) >= 2
    assert any("eval/deterministic_return" in line for line in read_metrics(tmp_path / "run"))


def test_evaluations_during_training_are_written_down_at_their_steps_with_their_intervals(tmp_path):
    run.train(few_iterations(tmp_path, "--eval.every", "100", "--eval.episodes", "3"))
    lines = [line for line in read_metrics(tmp_path / "run") if any(tag.startswith("eval/") for tag in line)]
    assert [line["step"] for line in lines] == [120]
    names = [f"eval/{kind}_{score}" for kind in ("deterministic", "sampled") for score in ("return", "length")]
    assert set(lines[0]) == {"step", *names, *(f"{name}_half_width" for name in names)}
    algorithm = run.build(few_iterations(tmp_path))
    algorithm.learn(120)
    score = evaluate(algorithm, episodes=3, deterministic=False, seed=0)
    assert lines[0]["eval/sampled_return"] == score.episodic_return.mean
    assert lines[0]["eval/sampled_length_half_width"] == score.episodic_length.half_width
    assert set(EventAccumulator(str(tmp_path / "run")).Reload().Tags()["scalars"]) >= set(names)


@pytest.mark.usefixtures("unchecked_shapes")
def test_training_ends_at_the_stated_return_of_greedy_episodes_and_the_best_model_is_kept(tmp_path):
    fast = ["--update.step_size", "50", "--policy.init", "{type: uniform}", "--eval.every", "120"]
    best = ["--eval.keep_best", "--run.overwrite"]
    summary = run.train(few_iterations(tmp_path, *fast, *best, "--total_steps", "600", "--eval.stop_at_return", "96"))
    lines = read_metrics(tmp_path / "run")
    assert summary.env_steps == lines[-1]["step"] < 600
    assert summary.ended_by == "return"
    greedy = [line["eval/deterministic_return"] for line in lines if "eval/deterministic_return" in line]
    assert greedy[-1] == 96.0 == PGTS.load(tmp_path / "run" / "best.pt").predict(0) * 96
    assert all(score < 96 for score in greedy[:-1])
    assert last_checkpoint(tmp_path / "run").stem == f"{summary.env_steps:012d}"
    summary = run.train(few_iterations(tmp_path, *fast, "--run.overwrite", "--total_steps", "600"))
    assert summary.env_steps >= 600
    assert summary.ended_by == "total_steps"
    assert not (tmp_path / "run" / "best.pt").exists()


@pytest.mark.parametrize("kind", ["auto", "expectimax", "sampled", "mcts"])
def test_a_search_of_any_kind_that_needs_more_than_the_configured_memory_is_refused(kind, tmp_path, capsys):
    arguments = ["train", "--search.kind", kind, "--total_steps", "60", "--run.dir", str(tmp_path / "run")]
    assert main([*arguments, "--search.max_bytes", "200"]) == 2
    complaint = capsys.readouterr().err.splitlines()[-1]
    assert complaint.startswith("error: ")
    assert "the limit is 1.86e-07 GiB" in complaint
    assert main([*arguments, "--search.max_bytes", "200000", "--run.overwrite"]) == 0


def test_nothing_shipped_learns_from_exact_values(tmp_path):
    for path in SHIPPED.values():
        assert load(str(path)).critic.type in ("auto", "tabular", "network")


@pytest.mark.fault("unknown environment")
@pytest.mark.parametrize(
    "arguments", [["--env.id", "pgts/Nowhere-v0"], ["--env.id", "CartPole-v1", "--env.kwargs", "{}"]]
)
def test_what_cannot_be_built_leaves_nothing_behind(arguments, tmp_path):
    with pytest.raises(PgtsError):
        run.train(few_iterations(tmp_path, *arguments))
    assert list(tmp_path.iterdir()) == []


def test_the_summary_states_exact_numbers_and_an_exact_critic_is_said_to_be_for_validation(tmp_path, capsys):
    summary = run.train(few_iterations(tmp_path, "--critic", "{type: exact}"))
    assert "for validation" in capsys.readouterr().err
    algorithm = PGTS.load(last_checkpoint(tmp_path / "run"))
    pi_SA = algorithm.policy.table()
    assert summary.J == exact.evaluate(algorithm.mdp, pi_SA).J
    assert summary.stationarity_gap == float(stationary.gap(algorithm.mdp, pi_SA, 4).max())
    assert all(len(line) <= 80 for line in describe(summary).splitlines()[:-1])


def test_evaluation_runs_the_greedy_and_the_sampled_policy_to_the_time_limit():
    algorithm = PGTS("pgts/Ladder-v0", depth=4, policy={"type": "softmax", "init": {"type": "uniform"}}, seed=0)
    algorithm.policy.load_state_dict({"logits_SA": mirror_step(*always_right(), 1.0).log()})
    greedy = evaluate(algorithm, episodes=3, deterministic=True, seed=0)
    assert (greedy.episodic_return.mean, greedy.episodic_length.mean) == (96.0, 100.0)
    assert greedy.discounted_return.mean == pytest.approx((0.9**4 - 0.9**100) / 0.1)
    assert greedy.episodic_return.half_width == 0
    sampled = evaluate(algorithm, episodes=200, deterministic=False, seed=0)
    truth = exact.evaluate(algorithm.mdp, algorithm.policy.table()).J
    # 95 % interval, twice as wide: error probability below 1e-3. J beyond step 100 is below 1e-4.
    assert abs(sampled.discounted_return.mean - truth) < 2 * sampled.discounted_return.half_width + 1e-4
    assert sampled.discounted_return.mean < greedy.discounted_return.mean


def test_one_episode_has_no_confidence_interval():
    algorithm = PGTS("pgts/Ladder-v0", seed=0)
    assert evaluate(algorithm, episodes=1, deterministic=True, seed=0).episodic_return.half_width is None


def test_a_value_that_is_not_finite_is_written_as_null(tmp_path):
    with RunLock(tmp_path / "run") as lock, RunFolder(lock, tensorboard=False) as folder:
        folder.log(3, {"losses/value": math.nan})
    assert read_metrics(tmp_path / "run") == [{"step": 3, "losses/value": None}]


def always_right() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Arguments of a mirror step from the uniform policy that end at 95 % right in every state."""
    pi_SA = torch.full((5, 2), 0.5, dtype=torch.float64)
    q_SA = torch.tensor([0.0, math.log(19)], dtype=torch.float64).expand(5, 2)
    return pi_SA, q_SA, torch.ones(5, dtype=torch.float64)


def test_a_run_without_a_seed_draws_one_says_it_and_goes_on_with_it(tmp_path, capsys):
    config = few_iterations(tmp_path, "--seed", "null")
    assert config.seed is None
    summary = run.train(config)
    assert f"note: seed is null; this run has the seed {summary.seed}\n" in capsys.readouterr().err
    assert load(tmp_path / "run" / "config.yaml").seed == summary.seed
    same = run.train(few_iterations(tmp_path / "other", "--seed", str(summary.seed)))
    assert same.J == summary.J
    (tmp_path / "run" / "summary.json").unlink()
    with pytest.raises(PgtsError, match="finished"):
        run.train(few_iterations(tmp_path / "other", "--seed", "null"))
    assert f"the run in the folder has the seed {summary.seed}" in capsys.readouterr().err
