"""A run that learned little says so at its end, and one that had nothing to learn does not."""

import copy
from pathlib import Path

import pytest

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import Evaluation, Score
from pgts_torch.config import load
from pgts_torch.experiment import run
from pgts_torch.experiment.advice import Movement, greedy_is_worse
from pgts_torch.experiment.report.page import write
from pgts_torch.experiment.summary import Summary, describe, summary_in

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

SHORT = ["--total_steps", "300", "--rollout.num_envs", "4", "--rollout.horizon.length", "25"]
QUIET = ["--run.tensorboard", "false", "--eval.episodes", "2", "--log.every", "100"]


def trained(folder: Path, *arguments: str) -> Summary:
    return run.train(load(None, [*SHORT, *QUIET, "--run.dir", str(folder / "run"), *arguments]))


def from_the_optimum(probability: float) -> list[str]:
    """On the Ladder, whose optimal action is 1 everywhere."""
    return ["--policy.type", "softmax", "--policy.init", f"{{type: biased, action: 1, probability: {probability}}}"]


@pytest.mark.fault("a policy that hardly moves")
@pytest.mark.parametrize("env_id", ["pgts/Ladder-v0", "FrozenLake-v1"])
def test_a_run_of_tiny_steps_says_so_and_what_to_set(tmp_path: Path, env_id: str):
    update = ["--update.type", "softmax", "--update.step_size", "1e-6", "--critic.type", "exact"]
    summary = trained(tmp_path, "--env.id", env_id, *update)
    [note] = summary.notes
    assert note.startswith("the policy hardly moved: 0.0% of its probability is elsewhere than at the start")
    assert "a larger update.step_size than 1e-06" in note
    assert "search.depth above 4" in note
    assert summary_in(tmp_path / "run") == summary
    assert "note                        the policy hardly moved" in describe(summary)
    page = write(tmp_path / "run", None)["page"]
    assert "the policy hardly moved" in Path(page).read_text()


def test_a_policy_that_is_stationary_at_this_depth_is_told_to_look_deeper(tmp_path: Path):
    stays = ["--policy.type", "simplex", "--policy.init", "{type: biased, action: 0, probability: 1}"]
    exact = ["--critic.type", "exact", "--search.depth", "0"]
    [note] = trained(tmp_path, "--env.id", "pgts/Ladder-v0", *stays, *exact).notes
    assert note.endswith("A lookahead of depth 0 finds no better actions: set a deeper one, search.depth above 0")


@pytest.mark.parametrize("critic", ["exact", "tabular"])
@pytest.mark.parametrize("step_size", ["1e-6", "0.1"])
def test_a_policy_that_is_optimal_from_the_start_says_nothing(tmp_path: Path, critic: str, step_size: str):
    update = ["--update.type", "softmax", "--update.step_size", step_size]
    summary = trained(
        tmp_path, "--env.id", "pgts/Ladder-v0", *from_the_optimum(0.999), *update, "--critic.type", critic
    )
    assert summary.J is not None
    assert summary.J_optimal is not None
    assert summary.J > 0.9 * summary.J_optimal
    assert summary.notes == ()


def test_a_network_that_hardly_moves_says_so_and_one_that_learns_does_not(tmp_path: Path):
    still = trained(tmp_path / "a", "--env.id", "CartPole-v1", "--search.depth", "1", "--update.learning_rate", "1e-9")
    assert "a larger update.learning_rate than 1e-09, a smaller update.temperature" in still.notes[0]
    moving = trained(tmp_path / "b", "--env.id", "CartPole-v1", "--search.depth", "1", "--update.learning_rate", "1e-2")
    assert not any("hardly moved" in note for note in moving.notes)


@pytest.mark.fault("a policy that does not converge")
def test_a_policy_that_still_moves_at_the_end_is_told_to_train_on_or_to_take_smaller_steps(tmp_path: Path):
    restless = trained(tmp_path / "a", "--env.id", "pgts/RiverSwim-v0")
    [note] = restless.notes
    assert note.startswith("the policy has not converged: the last iterations moved ")
    assert "a smaller update.step_size than 1" in note
    arrived = trained(tmp_path / "b", "--env.id", "pgts/Ladder-v0", "--critic.type", "exact", "--total_steps", "3000")
    assert arrived.J == pytest.approx(arrived.J_optimal, rel=1e-3)
    assert arrived.notes == ()


def evaluation(mean: float, half_width: float | None) -> Evaluation:
    score = Score(mean, half_width)
    return Evaluation(10, score, score, score)


@pytest.mark.fault("a greedy policy that is worse than sampled actions")
def test_greedy_episodes_that_are_worse_beyond_chance_are_pointed_out():
    worse = greedy_is_worse(evaluation(0.0, 0.0), evaluation(0.8, 0.3))
    assert worse is not None
    assert "deterministic=False" in worse
    assert greedy_is_worse(evaluation(0.4, 0.2), evaluation(0.8, 0.3)) is None
    assert greedy_is_worse(evaluation(0.8, 0.1), evaluation(0.2, 0.1)) is None
    assert greedy_is_worse(evaluation(0.0, None), evaluation(0.8, None)) is None


def test_with_replay_the_movement_of_an_iteration_is_that_of_all_its_updates():
    replay = {"type": "uniform", "updates_per_step": 1, "starts": 2, "length": 4}
    training = PGTS(
        "pgts/RiverSwim-v0", replay=replay, horizon={"type": "steps", "first": 30}, update={"step_size": 0.01}
    )
    first = training.policy_table()
    movement = Movement(copy.deepcopy(training.policy))
    iteration = training.iterate()
    movement.follow(training, iteration)
    states, share_N = iteration.state_N, iteration.weight_N / iteration.weight_N.sum()
    expected = share_N @ (training.policy_table() - first)[states].abs().sum(-1) / 2
    assert movement.pace == pytest.approx(float(expected))
    latest = share_N @ (training.policy_table()[states] - iteration.pi_NA).abs().sum(-1) / 2
    assert movement.pace > 5 * float(latest) > 0  # the last update alone moves it much less
    movement.follow(training, training.iterate())
    assert movement.before.probs(states).equal(training.policy.probs(states))
