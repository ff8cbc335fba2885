"""The scripts of examples/: short, and what they print says that they have worked."""

import contextlib
import io
import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"

PRINTED = {
    "cartpole": "return 500",
    "certificate": "in truth 0.00",
    "exact_mdp": "depth 4:  1 stationary",
    "ladder": "depth 4: 6.56 of 6.56",
    "learned_model": "steps: return 500",
    "lookahead": "as the optimum",
    "own_environment": "return 1",
    "own_model": "model calls",
}
LONG = ("cartpole", "certificate", "learned_model", "own_model")


def test_every_example_is_run_and_has_at_most_40_lines():
    lines = {path.stem: len(path.read_text(encoding="utf-8").splitlines()) for path in EXAMPLES.glob("*.py")}
    assert set(lines) == set(PRINTED)
    assert max(lines.values()) <= 40


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name in PRINTED])
def test_an_example_prints_that_it_has_worked(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        runpy.run_path(str(EXAMPLES / f"{name}.py"))
    assert PRINTED[name] in out.getvalue()
