"""`pgts watch` and `pgts export`: what they print and write of a finished run, and what they refuse."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.cli.main import main
from pgts_torch.experiment.evaluate import checkpoint_of
from tests.experiment.runs import arguments, tree

pytestmark = pytest.mark.usefixtures("unchecked_shapes")  # which torch.export would trace


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    assert main(arguments(folder)) == 0
    return folder


def test_an_episode_is_shown_in_the_terminal(finished, capsys):
    before = tree(finished)
    assert main(["watch", str(finished), "--steps", "3", "--seed", "4", "--episodes", "2"]) == 0
    out = capsys.readouterr().out
    assert out.count("observation  ") == 2 * 4
    assert out.count("T^1 Q") == 2 * 3
    assert "episode 1, step 3, return 3: cut off after 3 steps" in out
    assert out.endswith(
        "episode 0, seed 4: 3 steps, return 3, cut off after 3 steps\n"
        "episode 1, seed 5: 3 steps, return 3, cut off after 3 steps\n"
    )
    assert max(map(len, out.splitlines())) <= 80
    assert tree(finished) == before


def test_a_film_is_written_and_said(finished, capsys, tmp_path):
    film = tmp_path / "film.gif"
    assert main(["watch", str(finished), "--out", str(film), "--steps", "2", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["file"] == str(film)
    assert [episode["length"] for episode in answer["episodes"]] == [2]
    assert film.read_bytes()[:4] == b"GIF8"


def test_where_there_is_no_picture_there_is_a_note_and_the_text(finished, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("gymnasium.envs.classic_control.CartPoleEnv.metadata", {"render_modes": ["human"]})
    assert main(["watch", str(finished), "--out", str(tmp_path / "film.gif"), "--steps", "2"]) == 0
    out, err = capsys.readouterr()
    [note] = [line for line in err.splitlines() if line.startswith("note: CartPole")]
    assert "cannot be drawn: its render modes are human; a picture needs rgb_array; these are the same" in note
    assert out.count("T^1 Q") == 2
    assert not list(tmp_path.iterdir())


def test_the_depth_beside_the_picture_can_be_another_one(finished, capsys):
    assert main(["watch", str(finished), "--steps", "1", "--depth", "3", "--sampled"]) == 0
    assert "T^3 Q" in capsys.readouterr().out


def test_the_last_or_the_best_model_is_exported(finished, capsys, tmp_path):
    assert main(["export", str(finished), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["file"] == str(finished / "policy.pt2")
    observation = torch.tensor([[0.1, 0.2, -0.1, -0.2], [0.0, 1.0, 0.0, -1.0]])
    found = {}
    for which in ("last", "best"):
        out = tmp_path / f"{which}.pt2"
        assert main(["export", str(finished), "--out", str(out), "--checkpoint", which]) == 0
        assert "float32 (batch, 4)" in capsys.readouterr().out
        found[which] = torch.export.load(out).module()({"observation": observation})["probs"]
        model = PGTS.load(checkpoint_of(finished, which))
        assert torch.equal(found[which], model.policy.probs(observation))
    own = torch.export.load(finished / "policy.pt2").module()({"observation": observation})["probs"]
    assert torch.equal(own, found["last"])


@pytest.mark.parametrize(
    ("more", "mistake"),
    [
        (["--out", "film.avi"], "argument --out: 'film.avi' does not end in .gif, .mp4 or .txt"),
        (["--out", "none/film.gif"], "argument --out: 'none/film.gif': 'none' is not a folder"),
        (["--fps", "0"], "argument --fps: '0' is not a number above 0"),
        (["--checkpoint", "first"], "argument --checkpoint: 'first' is neither a whole number >= 0 nor last nor best"),
    ],
)
def test_a_mistake_is_named_before_anything_is_loaded(finished, more, mistake, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["watch", str(finished), *more]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith(f"error: {mistake}")
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_run_without_a_best_model_says_what_leaves_one(finished, capsys, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("config.yaml", ".pgts_run"):
        shutil.copy(finished / name, folder)
    for command in ("watch", "export"):
        assert main([command, str(folder), "--checkpoint", "best"]) == 2
        assert "holds no best.pt, which eval.every with eval.keep_best leave" in capsys.readouterr().err


def test_a_checkpoint_is_chosen_by_its_step(finished, capsys, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    kept = [int(path.stem) for path in sorted((folder / "checkpoints").iterdir())]
    assert len(kept) > 1
    assert [PGTS.load(checkpoint_of(folder, step)).num_env_steps for step in kept] == kept
    assert main(["evaluate", str(folder), "--checkpoint", str(kept[0]), "--episodes", "3", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    shutil.rmtree(folder / "checkpoints")
    (folder / "checkpoints").mkdir()
    shutil.copy(finished / "checkpoints" / f"{kept[0]:012d}.pt", folder / "checkpoints")
    assert main(["evaluate", str(folder), "--episodes", "3", "--json"]) == 0  # the last one, where no other is left
    assert json.loads(capsys.readouterr().out) == first
    for command in ("watch", "export", "evaluate"):
        assert main([command, str(finished), "--checkpoint", "7"]) == 2
        steps = ", ".join(map(str, kept))
        assert f"holds no checkpoint of step 7; it has those of {steps}\n" in capsys.readouterr().err


def test_a_run_that_was_cut_off_before_its_first_checkpoint_is_said_to_be_one(finished, capsys, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("checkpoints", "best.pt"))
    for command in ("watch", "export", "evaluate"):
        assert main([command, str(folder)]) == 2
        assert "has left no checkpoint yet: go on with it (pgts train --resume)" in capsys.readouterr().err
    assert main(["watch", str(folder), "--checkpoint", "best"]) == 2
    assert "take its last" not in capsys.readouterr().err
