"""A training that was cut off ends with the bits of one that was not."""

import json

import pytest

from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.config import load
from pgts_torch.experiment import checkpoint, ownership, recorder, run
from pgts_torch.experiment.evaluate import last_checkpoint
from pgts_torch.experiment.recorder import Recorder
from pgts_torch.experiment.summary import describe
from pgts_torch.experiment.tracking import read_metrics
from tests.experiment.cut_off import (
    QUIET,
    WATCHED,
    Killed,
    arguments,
    configured,
    content,
    curve,
    cut_off,
    left,
)
from tests.support import same_values

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

NETWORK = [*QUIET, "--rollout.num_envs", "2", "--rollout.horizon.length", "10", "--search.depth", "1"]
SMALL_MLP = ["--policy.type", "mlp", "--policy.hidden", "[8]", "--total_steps", "80", "--env.id", "CartPole-v1"]
SMALL_CNN = "{type: cnn, scale: 10, channels: [4], hidden: [8]}"
MINIGRID = ["--env.id", "MiniGrid-Empty-5x5-v0", "--env.observation_keys", "[image]", "--policy", SMALL_CNN]
KINDS: dict[str, list[str]] = {
    "certified": [*QUIET, "--search.depth", "2", "--search.stop_at", "5.9", "--critic", "{type: exact}"],
    "tree": [*QUIET, "--search.kind", "mcts", "--search.simulations", "4"],
    "budget": [*NETWORK, *SMALL_MLP, "--policy.normalize", "--search.max_nodes", "100"],
    "simulator": [*NETWORK, *MINIGRID, "--total_steps", "60"],
    "sampled": [*NETWORK, *SMALL_MLP, "--search.depth", "0", "--estimator.type", "sampled"],
}


@pytest.mark.fault("kill at any moment")
@pytest.mark.parametrize("kind", KINDS)
def test_a_training_cut_off_anywhere_ends_with_the_bits_of_one_that_was_not(kind, uninterrupted, tmp_path, monkeypatch):
    if kind == "simulator":
        pytest.importorskip("minigrid")
    config = configured(tmp_path / "cut", *KINDS[kind])
    cut_off(config, monkeypatch, after=0)
    cut_off(config, monkeypatch, after=1)
    assert len(read_metrics(tmp_path / "cut")) == 2  # one more than the checkpoint knows
    run.train(config)
    assert same_values(left(uninterrupted(*KINDS[kind])), left(tmp_path / "cut"))


@pytest.mark.fault("kill at any moment")
def test_tensorboard_shows_every_step_once_and_evaluations_and_the_best_model_are_the_same(
    uninterrupted, tmp_path, monkeypatch
):
    config = configured(tmp_path / "cut", *WATCHED)
    cut_off(config, monkeypatch, after=3)
    run.train(config)
    assert [step for step, _ in curve(tmp_path / "cut")] == [60, 120, 180, 240, 300]
    whole = uninterrupted(*WATCHED)
    assert same_values(left(tmp_path / "cut"), left(whole))
    best = [PGTS.load(folder / "best.pt").state_dict() for folder in (whole, tmp_path / "cut")]
    assert same_values(*best)
    other = run.build(configured(tmp_path / "other", "--seed", "1")).learn(60).state_dict()
    assert not same_values(best[0], other)


ENDINGS = {
    "total_steps": [],
    "certificate": [*KINDS["certified"], "--search.stop_at", "1000"],
    "return": ["--eval.every", "60", "--eval.stop_at_return", "0"],
}


@pytest.mark.parametrize("ended_by", ENDINGS)
def test_the_summary_says_what_ended_a_training_also_after_a_kill_before_the_summary(ended_by, tmp_path, monkeypatch):
    config = configured(tmp_path / "run", *QUIET, *ENDINGS[ended_by])

    def killed(recorder: Recorder) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "finish", killed)
        with pytest.raises(Killed):
            run.train(config)
    assert checkpoint.newest(tmp_path / "run")[1].progress.ended_by == ended_by
    summary = run.train(config)
    assert summary.ended_by == json.loads((tmp_path / "run" / "summary.json").read_text())["ended_by"] == ended_by
    assert summary.env_steps == (300 if ended_by == "total_steps" else 60)
    [line] = [line for line in describe(summary).splitlines() if line.startswith("training ended by")]
    assert line.split()[3:][-1] == {"return": "eval.stop_at_return", "certificate": "search.stop_at"}.get(
        ended_by, ended_by
    )
    assert len(line) < 80


def test_keys_that_no_bit_of_training_depends_on_may_differ(cut, uninterrupted, capsys):
    assert main(arguments("--name", "x", "--log.keep", "1", "--log.every", "2", "--eval.every", "60")) == 0
    assert "going on from cut/checkpoints/000000000120.pt" in capsys.readouterr().err
    assert same_values(*(PGTS.load(last_checkpoint(folder)).state_dict() for folder in (cut, uninterrupted(*QUIET))))
    assert len(ownership.checkpoints(cut)) == 1
    assert load(cut / "config.yaml").name == "x"


@pytest.mark.fault("finished run")
def test_a_run_goes_on_by_its_folder_alone_and_then_is_finished(cut, capsys):
    moved = cut.rename("moved")
    assert main(["train", "--resume", "moved", "--json"]) == 0
    out, err = capsys.readouterr()
    assert "going on from moved/checkpoints/000000000120.pt" in err
    assert json.loads(out)["env_steps"] == 300
    before = content(moved)
    for again in (["--resume", "moved"], [*arguments()[1:], "--run.dir", "moved"]):
        assert main(["train", *again]) == 2
        finished = "run.dir moved holds a finished run; choose another folder, or set run.overwrite"
        assert f"error: {finished}\n" in capsys.readouterr().err
    assert content(moved) == before


@pytest.mark.parametrize("given", [["--config", "x.yaml"], ["--run.dir=x"], ["--run.overwrite"]])
def test_options_that_resume_takes_from_the_run_are_refused(given, cut, capsys):
    assert main(["train", "--resume", "cut", *given]) == 2
    name = given[0].partition("=")[0]
    mistake = f"error: {name} does not go with --resume, which takes it from the run (see pgts train --help)\n"
    assert capsys.readouterr().err == mistake


@pytest.mark.fault("finished run")
@pytest.mark.parametrize("flag", ["--overwrite", "--run.overwrite"])
def test_overwriting_starts_from_the_beginning(flag, cut):
    assert main(arguments(flag, "--seed", "1")) == 0
    assert [line["step"] for line in read_metrics(cut)] == [60, 120, 180, 240, 300]
    assert load(cut / "config.yaml").seed == 1


def test_slow_iterations_are_saved_more_often(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "MOST_SECONDS", -1)
    run.train(configured(tmp_path / "slow", *QUIET, "--log.checkpoint_every", "100", "--log.keep", "9"))
    run.train(configured(tmp_path / "last", *QUIET, "--log.checkpoint_every", "0", "--log.keep", "9"))
    assert [len(ownership.checkpoints(tmp_path / name)) for name in ("slow", "last")] == [5, 1]
