"""The tutorials of docs/tutorials: their cells run as plain Python, and what their text says is what these find."""

import contextlib
import io
import itertools
import re
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

TUTORIALS = {path.stem: path for path in sorted((Path(__file__).parents[1] / "docs/tutorials").glob("*.md"))}

SHORT: dict[str, dict[str, Any]] = {
    "continuous": {"steps": 60, "every": 30, "first": 40},
    "learned_model": {"first": 60, "total": 70},
    "machines": {"processes": 1, "total_steps": 3_000},
    "puzzle": {"steps": 200, "every": 100},
}
"""Of the tutorials that take longer: the values that shorten their cell tagged `parameters`, as papermill has them."""


def run(text: str, parameters: dict[str, Any]) -> tuple[types.SimpleNamespace, str]:
    """The names that the cells of a tutorial leave, and what they print."""
    import matplotlib.pyplot as plt

    names = vars(module := types.ModuleType("tutorial"))
    sys.modules["tutorial"] = module  # where its classes are found by their names
    with contextlib.redirect_stdout(io.StringIO()) as out, matplotlib.rc_context({"backend": "agg"}):
        for options, cell in re.findall(r"^```\{code-cell\} python\n((?::\w+:[^\n]*\n)*)(.*?)^```$", text, re.M | re.S):
            exec(cell, names)
            if "parameters" in options:
                assert set(parameters) <= set(names)
                names.update(parameters)
        plt.close("all")
    return types.SimpleNamespace(**names), out.getvalue()


def certificate(it: Any, out: str) -> None:
    # Stuck: the gap is 0, and the certificate large. Free: it ends by its certificate.
    assert all(gap < 1e-3 and bound > 6 for gap, bound, _ in it.stuck_rows)
    assert it.stuck.certificates.trust == it.free.certificates.trust == "proved"
    assert it.free_rows[-1][1] <= 0.01 < it.free_rows[-2][1]
    # Upper bounds, on the line with an exact critic, behind it with a learned one.
    assert all(bound >= missing for _, bound, missing in [*it.stuck_rows, *it.free_rows, *it.learned_rows])
    assert all(bound == pytest.approx(missing, abs=1e-3) for _, bound, missing in it.free_rows)
    assert it.learned.certificates.trust == "critic"
    assert it.learned_rows[-1][1] > 1 > 0.01 > it.learned_rows[-1][2]
    # Counts: from nothing known to little missing, and not in each iteration.
    assert it.computed[0] == 10 > 1 > it.computed[-1]
    assert len(it.computed) < len(it.bounds)


def continuous(it: Any, out: str) -> None:
    first, *_, last = (each.mean for each in it.watch.history)
    assert first < last
    assert last > -400
    assert it.model.num_model_calls > 1000 * it.model.num_env_steps
    # Hanging down it pushes with the speed, upright against the angle.
    slow, down = np.abs(it.speed) < 2, np.abs(it.angle) > 3
    assert np.corrcoef(it.speed[slow & down], it.torque[slow & down])[0, 1] > 0.3
    near = (np.abs(it.angle) < 0.5) & (np.abs(it.speed) < 0.5)
    assert np.corrcoef(it.angle[near], it.torque[near])[0, 1] < -0.3
    assert np.abs(it.angles[-50:]).mean() < 0.5


def inventory(it: Any, out: str) -> None:
    *closed, shop = re.findall(r"rest +(-?[\d.]+) +warm up +(-?[\d.]+)", out)[:2]
    assert all(float(warm) < float(rest) for rest, warm in closed)
    assert float(shop[1]) > float(shop[0])
    J_0, J_1, J_2 = (float(J) for J in re.findall(r"depth \d: J = +(-?[\d.]+)", out))
    assert J_0 <= 0 < 0.99 * it.best.J < min(J_1, J_2)
    visited_S = it.exact.evaluate(it.mdp, it.pi_SA).d_S > 0.01
    assert it.pi_SA[visited_S].argmax(1).equal(it.best.pi_SA[visited_S].argmax(1))
    assert not it.pi_SA.argmax(1).equal(it.best.pi_SA.argmax(1))
    # As the square root: four times as many samples halve the error, give or take 100 searches' chance.
    errors = [it.errors[n] for n in (2, 8, 32)]
    assert all(1.4 < more / less < 2.8 for more, less in itertools.pairwise(errors))
    assert all(it.stated[n] == pytest.approx(it.errors[n], rel=0.3) for n in it.errors)
    assert it.J_sampled > 0.95 * it.best.J


def learned_model(it: Any, out: str) -> None:
    assert it.returns[-1] > 0.99 * it.best
    assert it.dives < 2**it.N / 50
    # Networks: errors add up along a path, which is balanced all the same.
    last = it.losses[-1]
    assert last["model_error_1"] < last["model_error_4"] < last["model_error_16"] < 0.5
    assert it.before < 50 < 400 < it.after
    off = [abs(float(state[0, 2]) - true[2]) for state, true in zip(it.imagined, it.true, strict=True)]
    assert max(off[:5]) < max(off[-5:])


def machines(it: Any, out: str) -> None:
    assert re.findall(r"exit code (\d+)", out) == ["0", "143", "0"]
    assert it.whole[0]["charts/discounted_return"] < 1 < 6 < it.whole[-1]["charts/discounted_return"]
    assert it.same is True


def paper(it: Any, out: str) -> None:
    down, up = it.seen[3]
    assert down == up == 0 < it.seen[4][1] - it.seen[4][0]
    counts = [it.sets.count(depth) for depth in it.depths]
    assert counts == sorted(set(counts), reverse=True)
    assert counts[-1] == 1
    assert it.sets.worst_return(4) == pytest.approx(it.best.J)
    assert all(it.sets.worst_return(m) >= it.best.J - it.stationary.closed_form_bound(it.mdp, m) for m in it.depths)
    assert [float(run.J_K[-1]) for run in it.runs.values()] == pytest.approx([0, 0, 0, 0, it.best.J, it.best.J])
    assert it.runs[4].J_K.tolist() == pytest.approx(it.runs[5].J_K.tolist(), rel=0.2)
    assert it.walks[0].J_K.abs().max() == 0
    assert it.walks[1].J_K.min() < it.walks[1].J_K[0] < it.walks[1].J_K[-1]
    assert it.reached == pytest.approx(it.best.J, rel=0.01)


def puzzle(it: Any, out: str) -> None:
    assert "can serve as a model" in out
    at = {name: curve[-1] for name, curve in it.curves.items()}
    assert at["PPO"][1] < 0.7
    assert at["PGTS"][1] == 1
    assert at["PGTS"][0] < it.steps
    assert "moves, reward 1" in out


CLAIMS: dict[str, Callable[[Any, str], None]] = {
    "certificate": certificate,
    "continuous": continuous,
    "inventory": inventory,
    "learned_model": learned_model,
    "machines": machines,
    "paper": paper,
    "puzzle": puzzle,
}


def test_every_tutorial_is_short_and_ends_with_what_to_try_next():
    assert set(CLAIMS) == set(TUTORIALS)
    for path in TUTORIALS.values():
        text = path.read_text(encoding="utf-8")
        assert 60 <= len(text.splitlines()) <= 150
        assert text.count("\n## What to try next\n") == 1
        assert not re.search(r"^#", text.split("\n## What to try next\n")[1], re.M)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.filterwarnings("default::UserWarning")  # which say what a model costs
@pytest.mark.parametrize("name", TUTORIALS)
def test_the_cells_of_a_tutorial_run_as_plain_python(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = run(TUTORIALS[name].read_text(encoding="utf-8"), SHORT.get(name, {}))
    assert found[1], "no cell has printed anything"
    if name not in SHORT:
        CLAIMS[name](*found)


@pytest.mark.long
@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.filterwarnings("default::UserWarning")
@pytest.mark.parametrize("name", SHORT)
def test_what_a_longer_tutorial_says_is_what_its_cells_find(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    CLAIMS[name](*run(TUTORIALS[name].read_text(encoding="utf-8"), {}))


def test_a_failing_cell_and_an_unknown_parameter_are_noticed():
    cell = "```{code-cell} python\n:tags: [parameters]\nsteps = 5\n```\n```{code-cell} python\nprint(1 / steps)\n```\n"
    assert run(cell, {"steps": 4})[1] == "0.25\n"
    with pytest.raises(ZeroDivisionError):
        run(cell, {"steps": 0})
    with pytest.raises(AssertionError):
        run(cell, {"stps": 4})
