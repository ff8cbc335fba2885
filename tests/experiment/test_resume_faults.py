"""A run folder from which a training cannot go on, or not as if nothing had happened, is refused or named."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from pgts_torch.agent import saving
from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.config import Config
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import ownership, resume, run, tracking
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.recorder import Recorder
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


@pytest.mark.fault("another configuration at resume")
def test_another_configuration_is_refused_key_by_key_and_nothing_is_lost(cut, capsys):
    before = content(cut)
    other = [
        "--seed",
        "3",
        "--rollout.horizon",
        "{type: geometric}",
        "--search.depth",
        "adaptive",
        "--eval.every",
        "60",
    ]
    assert main(arguments(*other)) == 2
    where = "in run.dir cut it is"
    assert capsys.readouterr().err.splitlines()[1:] == [
        f"error: seed is 3; {where} 0",
        f"error: rollout.horizon.type is geometric; {where} fixed",
        f"error: rollout.horizon.max_length is 100000; {where} null",
        f"error: search.depth is adaptive; {where} 4",
        f"error: rollout.horizon.length is null; {where} 15",
        "error: run.dir cut holds an earlier run of another configuration; choose another folder, or set run.overwrite",
    ]
    assert content(cut) == before


@pytest.mark.fault("another shape at resume")
def test_an_environment_of_another_size_is_refused_and_nothing_is_lost(cut, monkeypatch, capsys):
    before, build = content(cut), run.build

    def build_larger(config: Config) -> PGTS:
        return build(config.model_copy(update={"env": config.env.model_copy(update={"kwargs": {"n": 7}})}))

    with monkeypatch.context() as patch:
        patch.setattr(run, "build", build_larger)
        assert main(arguments()) == 2
    mistakes = capsys.readouterr().err.splitlines()[1:]
    assert mistakes[0].startswith("error: cut/checkpoints/000000000120.pt: the saved state of policy does not fit: ")
    assert "(5, 2); " in mistakes[0]
    assert "(7, 2)" in mistakes[0]
    assert "if the environment has changed since" in mistakes[1]
    assert content(cut) == before
    assert main(arguments()) == 0


@pytest.mark.fault("damaged last checkpoint")
def test_after_a_damaged_checkpoint_the_one_before_leads_to_the_same_values(cut, uninterrupted, capsys):
    newest = ownership.checkpoints(cut)[-1]
    newest.write_bytes(newest.read_bytes()[:-1])
    before = content(cut)
    assert main(arguments("--strict-resume")) == 2
    damaged = f"{newest} is damaged: its checksum does not fit its content"
    assert f"error: {damaged}\n" in capsys.readouterr().err
    assert content(cut) == before
    assert main(arguments()) == 0
    err = capsys.readouterr().err
    assert f"warning: {damaged}\ngoing on from cut/checkpoints/000000000060.pt" in err
    assert same_values(left(cut), left(uninterrupted(*QUIET)))


@pytest.mark.fault("last checkpoint missing")
def test_without_the_last_checkpoint_the_one_before_leads_to_the_same_values(cut, uninterrupted):
    ownership.checkpoints(cut)[-1].unlink()
    assert main(arguments("--strict-resume")) == 0
    assert same_values(left(cut), left(uninterrupted(*QUIET)))


@pytest.mark.fault("lost metrics")
@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda raw: raw[:100], "was cut to 100 bytes since cut/checkpoints/000000000120.pt"),
        (lambda raw: raw.replace(b"0.5", b"0.6", 1), "was changed since cut/checkpoints/000000000120.pt was written"),
        (lambda raw: raw[:40] + bytes([raw[40] ^ 1]) + raw[41:], "was changed since"),
        (None, "was removed since"),
    ],
)
def test_lost_or_changed_metrics_are_noticed(damage, said, cut, capsys):
    path = cut / "metrics.jsonl"
    changed = None if damage is None else damage(path.read_bytes())
    assert changed != path.read_bytes()
    path.unlink()
    if changed is not None:
        path.write_bytes(changed)
    before = content(cut)
    assert main(arguments()) == 2
    assert f"cut/metrics.jsonl {said}" in capsys.readouterr().err
    assert content(cut) == before


@pytest.mark.fault("all checkpoints gone")
@pytest.mark.parametrize("whole", [True, False])
def test_a_run_that_has_lost_its_checkpoints_does_not_start_from_the_beginning(whole, cut, capsys):
    shutil.rmtree(cut / "checkpoints")
    if not whole:
        (cut / "checkpoints").mkdir()
    before = content(cut)
    assert main(arguments()) == 2
    mistake = "error: run.dir cut has lost its checkpoints and cannot go on: bring them back, or choose another folder"
    assert mistake in capsys.readouterr().err
    assert content(cut) == before
    assert main(arguments("--run.overwrite")) == 0


def test_a_run_whose_configuration_is_gone_resumes(cut, uninterrupted):
    (cut / "config.yaml").unlink()
    assert main(arguments()) == 0
    assert same_values(left(cut), left(uninterrupted(*QUIET)))


def watched(folder: Path, monkeypatch: pytest.MonkeyPatch, *more: str) -> Config:
    """A run that keeps its best model and events, cut off after its third checkpoint."""
    config = configured(folder, *WATCHED, *more)
    cut_off(config, monkeypatch, after=3, logs=2)
    return config


@pytest.mark.fault("best model missing or damaged")
@pytest.mark.parametrize("damage", ["missing", "cut", "empty", "another"])
def test_a_lost_best_model_is_named_and_the_run_does_not_end_without_one(damage, tmp_path, monkeypatch, capsys):
    config = watched(tmp_path / "run", monkeypatch, "--run.tensorboard=false")
    path, raw = tmp_path / "run" / "best.pt", (tmp_path / "run" / "best.pt").read_bytes()
    path.unlink()
    if damage == "another":
        PGTS("pgts/Ladder-v0", depth=0, seed=5).save(path)
    elif damage != "missing":
        path.write_bytes(raw[:-7] if damage == "cut" else b"")
    before = content(tmp_path / "run")
    with pytest.raises(PgtsError, match=r"best\.pt"):
        run.train(config, strict_resume=True)
    assert content(tmp_path / "run") == before
    run.train(config)
    [warning] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning")]
    assert "best.pt" in warning
    assert warning.endswith("takes its place until a better one comes")
    assert PGTS.load(path).num_env_steps > 0


@pytest.mark.fault("best model missing or damaged")
def test_a_finished_training_that_has_lost_its_best_model_ends_with_one(tmp_path, monkeypatch, capsys):
    config = configured(tmp_path / "run", *QUIET, *WATCHED)
    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "finish", lambda recorder: (_ for _ in ()).throw(Killed()))
        with pytest.raises(Killed):
            run.train(config)
    (tmp_path / "run" / "best.pt").unlink()
    run.train(config)
    assert "best.pt is missing" in capsys.readouterr().err
    assert PGTS.load(tmp_path / "run" / "best.pt").num_env_steps == 300


@pytest.mark.fault("events missing or damaged")
@pytest.mark.parametrize("damage", ["missing", "cut", "changed"])
def test_lost_events_are_rebuilt_from_the_metrics(damage, uninterrupted, tmp_path, monkeypatch, capsys):
    config = watched(tmp_path / "cut", monkeypatch)
    [path] = (tmp_path / "cut").glob("events*")
    raw = path.read_bytes()
    path.unlink()
    if damage != "missing":
        path.write_bytes(raw[:200] if damage == "cut" else raw[:200] + b"?" + raw[201:])
    with pytest.raises(PgtsError, match="events"):
        run.train(config, strict_resume=True)
    run.train(config)
    assert "the events are rebuilt from metrics.jsonl" in capsys.readouterr().err
    assert same_values(left(tmp_path / "cut"), left(uninterrupted(*WATCHED)))
    assert [step for step, _ in curve(tmp_path / "cut")] == [60, 120, 180, 240, 300]


def resealed(path: Path, change: Callable[[dict[str, Any], dict[str, Any]], object]) -> None:
    """Change what a checkpoint says, its notes and its model, with a checksum that is right."""
    saved = saving.read(path)
    change(saved["notes"], saved["state"])
    saving.write(path, saved)


@pytest.mark.fault("checkpoint with impossible values")
@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda notes, state: state.pop("policy"), "policy"),
        (lambda notes, state: state["policy"]["logits_SA"].fill_(torch.nan), "policy"),
        (lambda notes, state: state["critic"].update(count_C=-state["critic"]["count_C"] - 1), "critic"),
        (lambda notes, state: state.update(num_iterations="2"), "num_iterations"),
        (lambda notes, state: state.update(num_env_steps=7), "step 7"),
        (lambda notes, state: notes.pop("progress"), "progress"),
        (lambda notes, state: notes.update(more=1), "more"),
        (lambda notes, state: notes.update(env_steps=-1), "env_steps"),
        (lambda notes, state: notes.update(files=[]), "files"),
        (lambda notes, state: notes.update(files={"metrics.jsonl": "all"}), "files.metrics"),
        (lambda notes, state: notes.update(world_size="1"), "world_size"),
        (lambda notes, state: notes.update(config=None), "config"),
        (lambda notes, state: notes["progress"].update(depth=-1), "progress.depth"),
        (lambda notes, state: notes["progress"].update(ended_by="rain"), "progress.ended_by"),
        (lambda notes, state: notes["progress"].update(movement={}), "movement"),
    ],
)
def test_a_checkpoint_with_impossible_values_is_refused_by_the_name_of_the_value(change, part, cut, capsys):
    resealed(ownership.checkpoints(cut)[-1], change)
    assert main(arguments()) == 2
    mistakes = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert part in mistakes[0]


@pytest.mark.fault("other versions at resume")
def test_other_versions_are_a_warning_or_refused(cut, monkeypatch, capsys):
    now = tracking.versions()
    monkeypatch.setattr(resume, "versions", lambda: now | {"torch": "0.1"})
    line = f"torch is 0.1; cut/checkpoints/000000000120.pt was written with {now['torch']}"
    assert main(arguments("--strict-resume")) == 2
    assert f"error: {line}: the last bits may differ\n" in capsys.readouterr().err
    assert main(arguments()) == 0
    assert f"warning: {line}: the last bits may differ\n" in capsys.readouterr().err


@pytest.mark.fault("read-only folder")
def test_a_folder_that_cannot_be_written_to_is_named(tmp_path, monkeypatch, capsys):
    def read_only(path: Path, *args: Any, **kwargs: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "mkdir", read_only)
    assert main(["train", "--run.dir", str(tmp_path / "run")]) == 2
    mistake = f"error: run.dir {tmp_path / 'run'} cannot be written to: Read-only file system"
    assert capsys.readouterr().err.splitlines()[1:] == [mistake]


@pytest.mark.fault("second process in a run folder")
def test_a_second_process_is_refused_with_the_id_of_the_first(cut, capsys):
    before = content(cut)
    with RunLock(cut):
        for more in ([], ["--run.overwrite"]):
            assert main(arguments(*more)) == 2
            assert f"error: run.dir cut is in use by the process {os.getpid()}\n" in capsys.readouterr().err
    assert content(cut) == before
    assert main(arguments()) == 0
