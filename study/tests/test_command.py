"""`python -m study`: what it leaves, and what it refuses."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from pgts_torch.tabular import ladder
from study import PARTS, command, depth, families, sets, table1
from study.__main__ import main
from study.claims import Finding
from study.document import document
from study.figure import Effort
from study.tests.made_up import smallest
from tests.forks import PATIENCE

ROOT = Path(__file__).parents[2]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, ladder_members: table1.Found) -> None:
    monkeypatch.setattr(command, "CURVES", {name: smallest(shown) for name, shown in command.CURVES.items()})
    monkeypatch.setattr(command, "QUICK", Effort(quick=True, seeds=2, workers=0))
    monkeypatch.setattr(command, "DOTS_PER_INCH", 20)
    monkeypatch.setattr(depth, "FAMILIES", (depth.FAMILIES[1], depth.FAMILIES[4]))
    monkeypatch.setattr(depth, "QUICK", depth.Scale((0.3, 1.0), 8, 8, 2))
    monkeypatch.setattr(depth, "in_S_iterations", lambda: [Finding({}, "made up", True)])
    monkeypatch.setattr(table1, "PAPER", {"ladder": table1.PAPER["ladder"]})
    monkeypatch.setattr(table1, "members", lambda column: ladder_members)
    monkeypatch.setattr(sets, "COUNTED", {"Ladder": ladder})
    family = families.family_study(branchings=(1, 2), sizes=(4,), gammas=(0.5, 0.9), seeds=range(3))
    monkeypatch.setattr(sets, "family_study", lambda seeds: family)


@pytest.mark.usefixtures("unchecked_shapes")
def test_the_command_leaves_a_document_that_is_made_of_its_data_alone(small, tmp_path, capsys):
    assert main(["--quick", "--json", "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    printed = json.loads(out)
    folder = tmp_path / "figures"
    assert list(printed) == list(PARTS)
    assert all("s  " in line for line in err.splitlines())
    stored = {name: json.loads((folder / f"{name}.json").read_text()) for name in PARTS}
    assert printed == stored
    drawn = {path.stem for path in folder.glob("*.png")}
    assert drawn == {*PARTS, "mirage"}
    text = (tmp_path / "reproduction.md").read_text()
    assert text == document(stored)
    assert "**Made with `--quick`**" in text
    assert all(f"figures/{name}.png" in text for name in drawn)
    for claim in (claim for part in stored.values() for claim in part["claims"]):
        assert claim["text"] in text
        assert claim["measured"].replace("|", "\\|") in text or claim["measured"] in text
    stored["ladder"]["claims"][0] |= {"measured": "something else", "verdict": "holds", "condition": ""}
    stored["stationary"]["counted"]["Ladder"]["depths"][0]["count"] = 123
    changed = document(stored)
    assert "something else" in changed
    assert "| 0 | 123 |" in changed
    assert "something else" not in text


@pytest.mark.usefixtures("unchecked_shapes")
def test_one_part_alone_keeps_the_others_and_missing_ones_are_named(small, tmp_path, capsys):
    assert main(["--quick", "--only", "ladder", "--out", str(tmp_path)]) == 0
    assert "Run `python -m study --only random`" in (tmp_path / "reproduction.md").read_text()
    kept = (tmp_path / "figures" / "ladder.json").read_bytes()
    assert main(["--quick", "--only", "depth", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "figures" / "ladder.json").read_bytes() == kept
    text = (tmp_path / "reproduction.md").read_text()
    assert "## Figure 1: Ladder" in text
    assert "### Where more depth is slower" in text
    out = capsys.readouterr().out
    assert "depends        A statement about ladder" in out
    assert "holds for m = 1" in out
    assert max(map(len, out.splitlines())) < 80


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        (["--only", "laddr"], "argument --only: invalid choice: 'laddr'"),
        (["--out", "file"], "argument --out: 'file' is not a folder"),
        (["--quik"], "unrecognized arguments: --quik"),
        (["ladder"], "unrecognized arguments: ladder"),
    ],
)
def test_a_mistake_is_one_line(arguments, mistake, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    assert mistake in err


def test_damaged_data_of_an_earlier_run_are_named_before_any_work(tmp_path, capsys):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "grid.json").write_text("{")
    assert main(["--only", "ladder", "--out", str(tmp_path)]) == 2
    assert "grid.json cannot be read" in capsys.readouterr().err


def test_mistakes_and_help_do_not_wait_for_torch():
    source = (
        "import sys; from study.__main__ import main; main(['--help']); "
        "main(['--only', 'x']); sys.exit('torch' in sys.modules or 'matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", source], cwd=ROOT, capture_output=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0


@pytest.mark.parametrize("name", ["reproduction.md", "figures/depth.png", "figures/mirage.png", "figures/depth.json"])
def test_the_study_replaces_its_own_files_and_nothing_else(name, tmp_path, capsys):
    (tmp_path / "figures").mkdir()
    (tmp_path / name).write_text('{"mine": true}')
    assert main(["--quick", "--only=depth", f"--out={tmp_path}"]) == 2
    assert name in capsys.readouterr().err
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / name]
    assert (tmp_path / name).read_text() == '{"mine": true}'


def test_the_document_is_what_the_stored_data_make():
    parts = command.stored(ROOT / "docs" / "figures")
    assert tuple(parts) == PARTS
    assert (ROOT / "docs" / "reproduction.md").read_text() == document(parts)
