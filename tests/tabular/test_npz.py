"""MDPs in npz files."""

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, ladder
from tests.support import random_policy, weights, zoo

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

TWO_STATES = {
    "P": np.array([[[1.0, 0.0], [0.25, 0.75]], [[0.5, 0.5], [0.0, 1.0]]]),
    "R": np.array([[0.0, 1.0], [2.0, -1.0]]),
    "gamma": 0.9,
}


def written(folder: Path, **changes: Any) -> Path:
    """A file with TWO_STATES, changed; a value of None leaves the array out."""
    arrays = {name: value for name, value in (TWO_STATES | changes).items() if value is not None}
    path = folder / "mdp.npz"
    np.savez(path, **arrays)
    return path


def bad_cell(name: str, index: tuple[int, ...], value: float) -> np.ndarray:
    array = np.array(TWO_STATES[name])
    array[index] = value
    return array


@pytest.mark.parametrize("name", ["ladder", "ladder, uniform start", "tightrope", "random, dense", "garnet", "grid"])
def test_what_was_saved_is_loaded(name, tmp_path):
    mdp, path = zoo(name), tmp_path / "no ending"
    mdp.save_npz(path)
    again = TabularMDP.load_npz(path)
    assert np.array_equal(weights(again), weights(mdp))
    assert torch.equal(again.outcomes.reward_NA, mdp.outcomes.reward_NA)
    assert torch.equal(again.start_S, mdp.start_S)
    pi_SA = random_policy(mdp)
    J = exact.evaluate(mdp, pi_SA).J
    assert exact.evaluate(again, pi_SA).J == pytest.approx(J, rel=1e-12)


def test_a_file_of_the_documented_arrays_is_the_mdp_from_dense(tmp_path):
    mdp = TabularMDP.load_npz(written(tmp_path))
    assert np.array_equal(weights(mdp), 0.9 * TWO_STATES["P"])
    assert mdp.outcomes.reward_NA.tolist() == TWO_STATES["R"].tolist()
    assert mdp.start_S.tolist() == [0.5, 0.5]


@pytest.mark.parametrize(
    ("start", "expected"), [(1, [0, 1]), (np.int32(0), [1, 0]), ([0.25, 0.75], [0.25, 0.75]), ([0, 1], [0, 1])]
)
def test_the_start_is_a_state_or_a_distribution(start, expected, tmp_path):
    assert TabularMDP.load_npz(written(tmp_path, start=start)).start_S.tolist() == expected


def test_whole_numbers_serve_where_they_are_exact(tmp_path):
    mdp = TabularMDP.load_npz(written(tmp_path, P=np.eye(2, dtype=int)[None].repeat(2, 0), R=np.eye(2, dtype=bool)))
    assert mdp.outcomes.reward_NA.tolist() == [[1, 0], [0, 1]]


MISTAKES = {
    "array 'P' is missing; it holds R, gamma": {"P": None},
    "array 'R' is missing; it holds P, gamma": {"R": None},
    "array 'gamma' is missing; it holds P, R": {"gamma": None},
    "array 'gama' is unknown; the arrays are P, R, gamma and start": {"gama": 0.9, "gamma": None},
    "P has shape (2, 2); it must be [S, A, S] with at least one state and one action": {"P": np.eye(2)},
    "R has shape (2, 3); P needs (2, 2)": {"R": np.zeros((2, 3))},
    "P[1, 0] is not a distribution: it sums to 0.9": {"P": bad_cell("P", (1, 0, 1), 0.4)},
    "P[0, 1, 0] is -0.25; probabilities are finite and at least 0": {"P": bad_cell("P", (0, 1, 0), -0.25)},
    "R[1, 0] is nan; rewards must be finite": {"R": bad_cell("R", (1, 0), np.nan)},
    "gamma is 1.5; it must be in [0, 1]": {"gamma": 1.5},
    "gamma has shape (1,); it must be a single number": {"gamma": [0.9]},
    "gamma is of type <U3; it must hold real numbers": {"gamma": "0.9"},
    "P is of type complex128; it must hold real numbers": {"P": TWO_STATES["P"].astype(complex)},
    "start state 2 does not exist; states are 0 to 1": {"start": 2},
    "start is 0.5; a single state must be a whole number": {"start": 0.5},
    "start has shape (3,); the MDP needs (2,)": {"start": [1.0, 0.0, 0.0]},
    "start[1] is nan; probabilities are finite and at least 0": {"start": [1.0, np.nan]},
    "array 'R' cannot be read: Object arrays cannot be loaded": {"R": np.array([[None, 1], [2, 3]])},
}


@pytest.mark.fault("rows that do not sum to one", "negative probability", "NaN in an MDP", "wrong shape")
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_file_is_named_with_its_array_its_index_and_its_value(mistake, tmp_path):
    path = written(tmp_path, **MISTAKES[mistake])
    with pytest.raises(PgtsError) as refused:
        TabularMDP.load_npz(path)
    assert str(refused.value).startswith(f"{path}: {mistake}")
    assert len(str(refused.value).splitlines()) == 1


class Harmful:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("opened",)


@pytest.mark.fault("pickled payload in an MDP")
def test_a_pickled_payload_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, R=np.array([[Harmful()]], dtype=object))
    with pytest.raises(PgtsError, match="Object arrays cannot be loaded"):
        TabularMDP.load_npz(path)
    assert not Path("opened").exists()
    np.load(path, allow_pickle=True)["R"]
    assert Path("opened").exists(), "the payload of this test would have been harmless anyway"


def test_a_file_that_is_none_is_refused(tmp_path):
    (tmp_path / "text.npz").write_text("P = 1")
    (tmp_path / "empty.npz").touch()
    np.save(tmp_path / "one.npy", TWO_STATES["P"])
    with zipfile.ZipFile(tmp_path / "strange.npz", "w") as archive:
        archive.writestr("P.npy", "no header")
        archive.writestr("R.npy", "")
        archive.writestr("gamma.npy", "")
    for name, reason in [
        ("none.npz", "cannot be read: No such file or directory"),
        (".", "cannot be read: Is a directory"),
        ("text.npz", "is not an npz file"),
        ("empty.npz", "is not an npz file"),
        ("one.npy", "is not an npz file"),
        ("strange.npz", "P is of type |S9; it must hold real numbers"),
    ]:
        with pytest.raises(PgtsError) as refused:
            TabularMDP.load_npz(tmp_path / name)
        assert str(refused.value).startswith(f"{tmp_path / name}: {reason}"), name


def test_an_array_larger_than_memory_is_refused(tmp_path):
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("P", "R", "gamma"):
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                header, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**3, 10**6)}
            )
            archive.writestr(f"{name}.npy", header.getvalue())
    with pytest.raises(PgtsError, match="array 'P' cannot be read"):
        TabularMDP.load_npz(path)


@pytest.mark.fault("npz file that unpacks to more than memory")
def test_a_file_that_would_unpack_to_much_is_refused_before_it_is(tmp_path, monkeypatch):
    header = io.BytesIO()
    side = 160
    np.lib.format.write_array_header_1_0(header, {"descr": "|i1", "fortran_order": False, "shape": (side, side, side)})
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("R", "gamma"):
            array = io.BytesIO()
            np.save(array, 0.5)
            archive.writestr(f"{name}.npy", array.getvalue())
        with archive.open("P.npy", "w", force_zip64=True) as member:
            member.write(header.getvalue())
            for _ in range(side):
                member.write(bytes(side * side))
    assert path.stat().st_size < 2**15
    monkeypatch.setattr("pgts_torch.tabular.npz.MOST_BYTES", 2**24)
    monkeypatch.setattr(np.lib.npyio.NpzFile, "__getitem__", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(
        PgtsError, match=r"array 'P' would take the file's arrays to 0\.0305 GiB in memory; they may take 0\.0156"
    ):
        TabularMDP.load_npz(path)


@pytest.mark.fault("damaged MDP file")
def test_a_damaged_file_is_either_refused_or_read_as_an_mdp(tmp_path):
    buffer, random, verdicts = io.BytesIO(), numpy_stream(0, "damage"), []
    np.savez_compressed(buffer, **TWO_STATES)
    content, path = buffer.getvalue(), tmp_path / "damaged.npz"
    for place in range(len(content)):
        flip = int(random.integers(1, 256))
        path.write_bytes(content[:place] + bytes([content[place] ^ flip]) + content[place + 1 :])
        try:
            TabularMDP.load_npz(path)
        except PgtsError as error:
            verdicts.append(str(error).startswith(f"{path}: "))
    assert all(verdicts)
    assert 100 < len(verdicts) < len(content), "most damage is found, some is in bytes that do not matter"


def test_an_mdp_with_ends_is_not_written_and_the_reason_is_given(tmp_path):
    with pytest.raises(PgtsError, match=r"an npz file holds one gamma: let an end lead to a state"):
        deep_sea(3).save_npz(tmp_path / "mdp.npz")
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_no_mdp_is_not_replaced(tmp_path):
    results, notes, empty = tmp_path / "results.npz", tmp_path / "notes.txt", tmp_path / "empty.npz"
    np.savez(results, scores=np.arange(3.0))
    notes.write_text("chapter 1")
    empty.touch()
    for path in (results, notes):
        before = path.read_bytes()
        with pytest.raises(PgtsError, match=rf"{path} exists and is not an MDP that load_npz reads: move it away"):
            ladder(3).save_npz(path)
        assert path.read_bytes() == before
    for path, mdp in [(empty, ladder(3)), (empty, ladder(4)), (tmp_path / "new.npz", ladder(3))]:
        mdp.save_npz(path)
        assert TabularMDP.load_npz(path).num_states == mdp.num_states
    with pytest.raises(PgtsError, match="is a folder; it must be a file, or not exist"):
        ladder(3).save_npz(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"results.npz", "notes.txt", "empty.npz", "new.npz"}


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(PgtsError, match="cannot be written: No such file or directory"):
        ladder(3).save_npz(tmp_path / "no folder" / "mdp.npz")
