"""Where loops are compiled, and that they are found on disk the next time."""

import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from pgts_torch import compiled
from tests.forks import PATIENCE

CPU = torch.device("cpu")

KERNEL = """
from pgts_torch.compiled import jit

@jit
def total(x):
    total = 0.0
    for i in range(len(x)):
        total += x[i]
    return total
"""

CALL = """
import sys
import numpy as np
sys.path.insert(0, {folder!r})
from kernel import total
assert total(np.array([0.1, 0.2, 0.3])) == 0.1 + 0.2 + 0.3
print(sum(total.stats.cache_hits.values()))
"""


def call(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """In a new process: what it prints is how many compiled functions were found on disk."""
    code = CALL.format(folder=str(folder))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=120)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    pytest.importorskip("numba")
    (tmp_path / "kernel.py").write_text(KERNEL)
    return tmp_path


def test_tensors_of_the_cpu_are_compiled_for_where_numba_is_installed() -> None:
    pytest.importorskip("numba")
    assert compiled.can_compile(CPU)
    assert not compiled.can_compile(torch.device("cuda"))
    with compiled.torch_only():
        assert not compiled.can_compile(CPU)
    assert compiled.can_compile(CPU)


def test_the_environment_variable_turns_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(compiled.SWITCH, "0")
    compiled._usable.cache_clear()
    try:
        assert not compiled.can_compile(CPU)
    finally:
        compiled._usable.cache_clear()


def test_little_work_does_not_load_numba() -> None:
    pytest.importorskip("numba")
    asked = "import sys, torch; from pgts_torch.compiled import pays; cpu = torch.device('cpu'); "
    answers = "print(pays(cpu, 255), pays(cpu, 256)); import numba; print(pays(cpu, 1), pays(torch.device('cuda'), 1))"
    done = subprocess.run(
        [sys.executable, "-c", asked + answers], capture_output=True, text=True, check=True, timeout=PATIENCE
    )
    assert done.stdout == "False True\nTrue False\n"


def test_the_readmes_first_training_does_without_numba(tmp_path: Path) -> None:
    run = ["--config", "configs/ladder.yaml", "--total_steps", "2000", "--run.dir", str(tmp_path / "run")]
    code = f"import sys; from pgts_torch.cli.main import main; print(main(['train', *{run}]), 'numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE)
    assert done.stdout.splitlines()[-1] == "0 False", done.stderr


def test_without_numba_torch_is_used_and_that_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled.importlib.util, "find_spec", lambda name: None)
    compiled._usable.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="numba is not installed .* torch alone is used"):
            assert not compiled.can_compile(CPU)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert not compiled.can_compile(CPU)
    finally:
        compiled._usable.cache_clear()


def test_a_second_process_finds_compiled_code_on_disk(folder: Path) -> None:
    assert [call(folder).stdout for _ in range(2)] == ["0\n", "1\n"]


def test_where_nothing_can_be_written_it_is_compiled_all_the_same_and_said(folder: Path) -> None:
    # A file where a folder is needed: nothing can be written there, by nobody.
    (folder / "__pycache__").write_text("")
    (folder / "home").write_text("")
    done = call(folder, HOME=str(folder / "home"), XDG_CACHE_HOME=str(folder / "home"))
    assert done.stdout == "0\n", done.stderr
    assert "NUMBA_CACHE_DIR" in done.stderr
    kept = [call(folder, NUMBA_CACHE_DIR=str(folder / "kept")).stdout for _ in range(2)]
    assert kept == ["0\n", "1\n"]


def test_a_change_in_another_file_of_loops_is_noticed(folder: Path) -> None:
    """Numba alone compares the age of one file only."""
    (folder / "unit_kernels.py").write_text("UNIT = 1.0\n")
    (folder / "kernel.py").write_text(
        KERNEL.replace("total += x[i]", "total += UNIT * x[i]") + "from unit_kernels import UNIT\n"
    )
    call(folder)
    assert call(folder).stdout == "1\n"
    (folder / "unit_kernels.py").write_text("UNIT = 2.0\n")
    assert "AssertionError" in call(folder).stderr
