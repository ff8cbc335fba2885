"""No bit of a checkpoint can be wrong unnoticed; nothing in it is executed; what is damaged is not used."""

import errno
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from pgts_torch.agent import saving
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint, ownership
from pgts_torch.experiment.checkpoint import Damaged, Notes, Progress
from tests import reliability

pytestmark = pytest.mark.usefixtures("unchecked_shapes")


def notes(env_steps: int) -> Notes:
    return Notes(
        iterations=1,
        env_steps=env_steps,
        model_calls=3,
        config={"search": {"depth": 2}, "seed": 3},
        versions={"torch": "1"},
        world_size=1,
        files={"metrics.jsonl": (0, "sha")},
        progress=Progress(depth=2),
    )


def model() -> PGTS:
    return PGTS("pgts/Ladder-v0", depth=1, num_envs=2, horizon={"type": "fixed", "length": 5}, seed=0)


def written(run: Path, *steps: int, keep: int = 9) -> list[Path]:
    algorithm = model()
    return [checkpoint.write(run, algorithm, notes(step), keep=keep) for step in steps]


def test_a_checkpoint_says_what_was_written_and_the_newest_is_found(tmp_path):
    first, second = written(tmp_path, 90, 1000)
    assert ownership.checkpoints(tmp_path) == [first, second]
    path, found, content = checkpoint.newest(tmp_path, strict=True)
    assert (path, found) == (second, notes(1000))
    assert content["state"].keys() == model().state_dict().keys()
    assert PGTS.load(second).num_env_steps == 0
    assert checkpoint.newest(tmp_path / "elsewhere") is None


def test_the_newest_are_kept_and_those_ahead_are_removed(tmp_path):
    written(tmp_path, 10, 20, 30, 40, 50)
    written(tmp_path, 35, keep=3)
    assert [int(path.stem) for path in ownership.checkpoints(tmp_path)] == [20, 30, 35]
    written(tmp_path, 35, keep=1)
    assert [int(path.stem) for path in ownership.checkpoints(tmp_path)] == [35]


@pytest.mark.fault("flipped bit in a checkpoint")
@pytest.mark.parametrize("flips", [400, pytest.param(3000, marks=pytest.mark.long)])
def test_no_flipped_bit_is_accepted(flips, tmp_path):
    [path] = written(tmp_path, 10)
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    for flip in range(flips):
        damaged = bytearray(whole)
        place = int(random.integers(64 if flip % 4 == 0 else len(damaged)))  # the head more often than its share
        damaged[place] ^= 1 << int(random.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(Damaged, match=r"0010\.pt is (damaged|not a file saved by pgts_torch)"):
            checkpoint.read(path)
    path.write_bytes(whole)
    checkpoint.read(path)
    if flips >= 3000:
        reliability.record("flipped bits in a checkpoint", flipped=flips, accepted=0)


@pytest.mark.fault("truncated checkpoint")
@pytest.mark.parametrize("cuts", [60, pytest.param(400, marks=pytest.mark.long)])
def test_no_missing_end_and_no_longer_end_is_accepted(cuts, tmp_path):
    [path] = written(tmp_path, 10)
    random, whole = np.random.default_rng(0), path.read_bytes()
    lengths = [0, 1, *range(10, 50), len(whole) - 1, *random.integers(len(whole), size=cuts).tolist()]
    for damaged in (*(whole[:length] for length in lengths), whole + b"\n"):
        path.write_bytes(damaged)
        with pytest.raises(Damaged):
            checkpoint.read(path)
    path.write_bytes(whole)
    checkpoint.read(path)
    if cuts >= 400:
        reliability.record("truncated checkpoints", truncated=len(lengths), accepted=0)


@pytest.mark.fault("checkpoints mixed up")
def test_the_checkpoint_of_another_step_is_not_accepted(tmp_path):
    first, second = written(tmp_path, 10, 20)
    shutil.copy(first, second)
    with pytest.raises(Damaged, match="it is the checkpoint of step 10"):
        checkpoint.read(second)


def test_a_model_without_notes_is_no_checkpoint(tmp_path):
    [path] = written(tmp_path, 10)
    model().save(path)
    with pytest.raises(PgtsError, match="is not of the form that this version writes: notes: "):
        checkpoint.read(path)


class Bomb:
    """Unpickling it writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.fault("malicious pickle in a checkpoint")
def test_a_pickle_is_not_executed_even_where_the_checksum_is_right(tmp_path):
    trace, [path] = tmp_path / "trace", written(tmp_path, 10)
    torch.save({"arguments": Bomb(trace), "state": {}}, tmp_path / "bomb")
    for payload in ((tmp_path / "bomb").read_bytes(), pickle.dumps(Bomb(trace))):
        path.write_bytes(saving.sealed(payload))
        with pytest.raises(PgtsError, match="holds something other than tensors and plain values"):
            checkpoint.read(path)
    assert not trace.exists()
    pickle.loads(pickle.dumps(Bomb(trace))).close()
    assert trace.exists()


@pytest.mark.fault("checkpoint of another format")
def test_another_format_is_named(tmp_path):
    [path] = written(tmp_path, 10)
    path.write_bytes(saving.sealed(b"what a later version writes", 7))
    with pytest.raises(PgtsError, match="has the format 7; this version of pgts_torch reads 6") as raised:
        checkpoint.read(path)
    assert not isinstance(raised.value, Damaged)


@pytest.mark.fault("damaged last checkpoint")
def test_the_one_before_a_damaged_checkpoint_is_used_with_a_warning_unless_that_is_refused(tmp_path, capsys):
    first, second = written(tmp_path, 10, 20)
    second.write_bytes(second.read_bytes()[:-1])
    assert checkpoint.newest(tmp_path)[0] == first
    warning = f"warning: {second} is damaged: its checksum does not fit its content\n"
    assert capsys.readouterr() == ("", warning)
    with pytest.raises(Damaged):
        checkpoint.newest(tmp_path, strict=True)
    first.write_bytes(b"")
    with pytest.raises(PgtsError, match="has no checkpoint that is intact"):
        checkpoint.newest(tmp_path)


@pytest.mark.fault("disk full")
def test_a_disk_that_is_full_leaves_the_others_as_they_are(tmp_path, monkeypatch):
    [path] = written(tmp_path, 10)

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(PgtsError, match=r"cannot be written: No space left on device"):
        written(tmp_path, 20, keep=1)
    assert list((tmp_path / "checkpoints").iterdir()) == [path]
    checkpoint.read(path)


@pytest.mark.fault("kill while a checkpoint is written")
def test_what_was_left_half_written_is_removed(tmp_path):
    [path] = written(tmp_path, 10)
    (tmp_path / "checkpoints" / ".000000000020.pt.123.partial").write_bytes(b"half")
    (tmp_path / ".best.pt.123.partial").write_bytes(b"half")
    (tmp_path / "best.pt").write_bytes(b"whole")
    assert checkpoint.newest(tmp_path)[0] == path
    checkpoint.tidy(tmp_path, path, keep=1)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["best.pt", "checkpoints"]
    assert list((tmp_path / "checkpoints").iterdir()) == [path]
