"""What README.md and the pages of docs/start say: their Python runs as printed, their commands are known, links lead
somewhere."""

import ast
import contextlib
import doctest
import importlib
import io
import re
import shlex
import subprocess
import sys
import tomllib
import types
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from pgts_torch.cli.commands import COMMANDS
from tests.forks import PATIENCE

ROOT = Path(__file__).parents[1]
PAGES = {
    str(path.relative_to(ROOT)): path
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs/start").glob("*.md")))
}
LINKED = PAGES | {
    str(path.relative_to(ROOT)): path
    for path in sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs/tutorials").glob("*.md")])
    if path.name != "index.md"
}
"""With those whose Python `test_tutorials` runs, and those without."""


class Block(NamedTuple):
    """A fenced block: its language, what it holds, and the comment before it: "long" where it takes longer than a test
    may, "parsed" where it needs what is not installed."""

    language: str
    text: str
    mark: str


def blocks(page: str) -> list[Block]:
    found = re.findall(
        r"^(?:<!-- (long|parsed) -->\n)?```(\w*|\{code-cell\} python)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE
    )
    return [Block(language, text, mark) for mark, language, text in found]


def links(page: str) -> list[tuple[str, str]]:
    """The (file, heading) of the links of a page, "" where one is missing, without those to other places."""
    prose = re.sub(r"^```.*?^```$|`[^`\n]*`", "", page, flags=re.DOTALL | re.MULTILINE)
    return [(file, name) for file, name in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", prose) if "://" not in file]


def headings(page: str) -> set[str]:
    """The headings of a page as links name them."""
    lines = re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", line.lower()).replace(" ", "-") for line in lines}


def printed(page: list[Block], *, long: bool) -> Iterator[tuple[str, str]]:
    """What the Python of a page prints, and what the page says, block by block; one namespace for all."""
    names = vars(module := types.ModuleType("page"))
    sys.modules["page"] = module  # where classes of the page are found by their names
    for block, after in zip(page, [*page[1:], Block("", "", "")], strict=True):
        if block.language == "python" and block.mark == "parsed":
            ast.parse(block.text)
        elif block.language == "python" and (long or not block.mark):
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(block.text, names)
            yield out.getvalue(), after.text if after.language == "text" else ""


def says(wanted: str, got: str) -> bool:
    """Whether they are the same, where ... stands for anything."""
    return doctest.OutputChecker().check_output(wanted, got, doctest.ELLIPSIS)


def differences(page: str, *, long: bool) -> list[tuple[str, str]]:
    """What a page says and what its Python prints instead."""
    found = printed(blocks(PAGES[page].read_text(encoding="utf-8")), long=long)
    return [(wanted, got) for got, wanted in found if not says(wanted, got)]


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("page", PAGES)
def test_the_python_of_a_page_runs_and_prints_what_it_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert differences(page, long=False) == []


@pytest.mark.long
@pytest.mark.filterwarnings("default::UserWarning")  # which say what a model costs
@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("page", [page for page, path in PAGES.items() if "<!-- long -->" in path.read_text()])
def test_what_takes_longer_runs_too(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert differences(page, long=True) == []


def test_another_number_than_the_printed_one_is_noticed():
    page = blocks("```python\nprint(1.25, [2])\n```\n\n```text\n1.26 [...]\n```\n")
    ((got, wanted),) = printed(page, long=False)
    assert not says(wanted, got)
    assert says(wanted.replace("1.26", "1.25"), got)


@pytest.mark.parametrize("page", LINKED)
def test_commands_and_links_of_a_page_exist(page, capsys):
    text = LINKED[page].read_text(encoding="utf-8")
    for block in blocks(text):
        for line in block.text.replace("\\\n", "").splitlines() if block.language == "sh" else ():
            program, command, *arguments = shlex.split(line)
            if program == "pgts":
                with contextlib.suppress(SystemExit):
                    COMMANDS[command](["--help"])
                known = capsys.readouterr().out
                assert all(word in known for word in arguments if word.startswith("--"))
    for link, heading in links(text):
        target = LINKED[page].parent / link if link else LINKED[page]
        assert target.exists(), link
        assert not heading or heading in headings(target.read_text(encoding="utf-8")), (link, heading)


@pytest.mark.parametrize("page", LINKED)
def test_code_of_a_page_is_as_narrow_as_the_site(page):
    text = LINKED[page].read_text(encoding="utf-8")
    lines = [line for block in blocks(text) if "python" in block.language for line in block.text.splitlines()]
    assert all(len(line) <= 100 for line in lines)


def test_a_dead_link_is_noticed(tmp_path):
    page = "# One\n\n[a](b.md#c-d), [e](#one), [f](https://g.org/h#i), `[j](k)`\n\n```python\nl[m](n)\n```\n"
    assert links(page) == [("b.md", "c-d"), ("", "one")]
    assert headings(page + "## 9. What (it) is\n") == {"one", "9-what-it-is"}

    def dead(body):
        (tmp_path / "index.html").write_text(f"<h1 id='top'>Top</h1>{body}", encoding="utf-8")
        done = subprocess.run([sys.executable, ROOT / ".ci/links", tmp_path], timeout=PATIENCE, stdout=subprocess.PIPE)
        return done.returncode, done.stdout.decode().splitlines()

    assert dead("<a href='#top'>a</a><a href='https://b.org/c'>b</a>") == (0, ["1 links"])
    assert dead("<a href='#up'>a</a><img src='d.png'>") == (1, ["2 links", "index.html: #up", "index.html: d.png"])
    assert dead("") == (1, ["0 links"])


@pytest.mark.parametrize("package", ["models", "search", "tabular", "envs"])
def test_every_public_name_is_in_the_reference(package):
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs/reference").glob("*.md"))
    named = set(re.findall(r"^\.\. auto\w+:: .*?(\w+)$", pages, re.MULTILINE))
    zoo = {
        "combination_lock",
        "corridor",
        "deep_sea",
        "grid",
        "ladder",
        "mirage",
        "random_mdp",
        "river_swim",
        "roundabout",
        "tightrope",
    }
    whole = zoo if "zoo" in named else set()
    assert set(importlib.import_module(f"pgts_torch.{package}").__all__) <= named | whole
    assert {"PGTS", "EvalCallback", "evaluate"} <= named


def test_the_version_is_the_same_everywhere():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)[1] == version
