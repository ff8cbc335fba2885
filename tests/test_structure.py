"""The order of the rooms: imports point one way, and the paper's equations are where the documentation says."""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "pgts_torch"
STUDY = ROOT / "study"
BESIDE = {"study", "benchmarks", "tests"}
"""What stands beside the package, and may import it."""

ROOMS = [
    "errors",
    "files",
    "trust",
    "compiled",
    "readings",
    "options",
    "bellman_kernels",
    "bellman",
    "seeding",
    "exchange",
    "ranks",
    "tabular",
    "envs",
    "models",
    "search",
    "agent",
    "pgts_torch",
    "config",
    "experiment",
    "cli",
]
"""Each may import itself and what stands before it; "pgts_torch" is `__init__.py`, the public face of the rooms."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def modules() -> dict[str, ast.Module]:
    """Those of the package and of the study."""
    paths = [*sorted(PACKAGE.rglob("*.py")), *sorted(STUDY.glob("*.py"))]
    return {module_name(path): ast.parse(path.read_text()) for path in paths}


# Imports


def room_of(name: str) -> str:
    """The room of a dotted name; names that `pgts_torch` itself offers belong to its face."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in ROOMS else "pgts_torch"


def imported_names(tree: ast.Module, module: str, is_package: bool) -> Iterator[str]:
    """Everything of this repository that a module imports anywhere, also in functions and behind TYPE_CHECKING."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = module.split(".")[: len(module.split(".")) - node.level + is_package] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            found = [f"{origin}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name for name in found if name.split(".")[0] in {"pgts_torch", *BESIDE})


def wrong_imports(tree: ast.Module, module: str, is_package: bool = False) -> list[str]:
    own = ROOMS.index(room_of(module))
    return [
        f"{module} imports {name}"
        for name in imported_names(tree, module, is_package)
        if name.split(".")[0] in BESIDE or ROOMS.index(room_of(name)) > own
    ]


def test_every_file_of_the_package_is_in_a_known_room():
    found = {path.stem if path.is_file() else path.name for path in PACKAGE.iterdir()}
    found = {name for name in found if name not in ("__init__", "__pycache__", "__main__", "py")}
    assert found <= set(ROOMS) - {"pgts_torch"}


def test_imports_point_one_way():
    packages = {module_name(path) for path in PACKAGE.rglob("__init__.py")}
    trees = {name: tree for name, tree in modules().items() if name.startswith("pgts_torch")}
    assert [wrong for name, tree in trees.items() for wrong in wrong_imports(tree, name, name in packages)] == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("pgts_torch.bellman", "from pgts_torch.tabular import exact"),
        ("pgts_torch.tabular.exact", "import pgts_torch.search.expectimax"),
        ("pgts_torch.tabular.exact", "from pgts_torch import search"),
        ("pgts_torch.tabular.exact", "from ..search import expectimax"),
        ("pgts_torch.search.expectimax", "def f():\n    from pgts_torch.agent.pgts import PGTS"),
        ("pgts_torch.search.expectimax", "from pgts_torch import PGTS"),
        (
            "pgts_torch.agent.pgts",
            "import torch\nif TYPE_CHECKING:\n    from pgts_torch.config import Config",
        ),
        ("pgts_torch", "from pgts_torch import cli"),
        ("pgts_torch.experiment.run", "from pgts_torch.cli.main import main"),
        ("pgts_torch.cli.main", "def figures():\n    from study import command"),
    ],
)
def test_an_import_from_a_later_room_would_be_found(module, source):
    assert len(wrong_imports(ast.parse(source), module)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("pgts_torch.tabular.exact", "import torch\nfrom pgts_torch.bellman import backup"),
        ("pgts_torch.tabular.exact", "from pgts_torch.tabular.mdp import TabularMDP\nfrom . import mdp"),
        ("pgts_torch.agent.pgts", "from pgts_torch import tabular, search"),
        ("pgts_torch.experiment.run", "from pgts_torch import PGTS\nfrom ..config import Config"),
    ],
)
def test_an_import_from_an_earlier_room_is_allowed(module, source):
    assert wrong_imports(ast.parse(source), module) == []


def import_circles(trees: dict[str, ast.Module], packages: set[str]) -> list[set[str]]:
    """The sets of modules that import each other, at the top or within functions. Names that a package offers count as
    imports of the package; that Python also runs the `__init__.py` of every package above a module does not count."""

    def modules_in(name: str, tree: ast.Module) -> Iterator[str]:
        for found in imported_names(tree, name, name in packages):
            parent = found.rpartition(".")[0]
            yield found if found in trees else parent

    graph = {name: {found for found in modules_in(name, tree) if found in trees} for name, tree in trees.items()}

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        left = [start]
        while left:
            for found in graph[left.pop()] - seen:
                seen.add(found)
                left.append(found)
        return seen

    onwards = {name: reached(name) for name in trees}
    circles = {frozenset(other for other in onwards[name] if name in onwards[other]) for name in trees}
    return [set(circle) for circle in circles if circle]


def test_no_modules_import_each_other_in_a_circle():
    packages = {module_name(path) for path in PACKAGE.rglob("__init__.py")}
    assert import_circles(modules(), packages) == []


def test_a_circle_of_imports_would_be_found_also_within_functions():
    trees = {
        "pgts_torch.a": "from pgts_torch.b import x",
        "pgts_torch.b": "def f():\n    from pgts_torch import c",
        "pgts_torch.c": "import pgts_torch.a",
        "pgts_torch.d": "from pgts_torch.a import y",
    }
    parsed = {name: ast.parse(source) for name, source in trees.items()}
    assert import_circles(parsed, set()) == [{"pgts_torch.a", "pgts_torch.b", "pgts_torch.c"}]


def test_relative_imports_in_a_package_file_are_understood():
    assert wrong_imports(ast.parse("from .agent import pgts"), "pgts_torch.search", is_package=True) == []
    assert len(wrong_imports(ast.parse("from ..agent import pgts"), "pgts_torch.search", is_package=True)) == 1


# Equations

IN_THE_PAPER = {"Eq.": 4, "Sec.": 5, "Alg.": 1, "Ex.": 4, "Lemma": 2, "Thm.": 1, "Prop.": 1, "Cor.": 1, "Table": 2}
"""How many numbered ones there are; equations (5) and on stand in proofs and are not cited."""

CITATION = re.compile(r"(Eq\.|Sec\.|Alg\.|Ex\.|Lemma|Thm\.|Prop\.|Cor\.|Table) \(?(\d+)\)?")


class Row(NamedTuple):
    citation: str
    formula: str
    function: str
    test: str


def citations(docstring: str | None) -> list[str]:
    """Each citation in `[PGTS Eq. (3), Lemma 2; another source]`; a bracket that cites nothing known is an error."""
    found = []
    for bracket in re.findall(r"\[PGTS\b([^\]]*)\]", docstring or ""):
        matches = CITATION.findall(bracket)
        assert matches, f"[PGTS{bracket}] cites nothing: write for instance [PGTS Eq. (3)]"
        for kind, number in matches:
            assert 1 <= int(number) <= IN_THE_PAPER[kind], f"the paper has no {kind} {number}"
            found.append(f"{kind} ({number})" if kind == "Eq." else f"{kind} {number}")
    return found


def documented(tree: ast.Module, prefix: str) -> Iterator[tuple[str, str | None]]:
    """The public functions, classes and methods of a module, each with its docstring."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield f"{prefix}.{node.name}", ast.get_docstring(node)
            if isinstance(node, ast.ClassDef):
                yield from documented(ast.Module(node.body, []), f"{prefix}.{node.name}")


def rows_of(text: str) -> list[Row]:
    """The rows of the one table of a text."""
    table = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip().strip("`") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table]
    return [Row(*line) for line in cells[2:]]


@functools.cache
def docstrings() -> dict[str, str | None]:
    return {name: text for module, tree in modules().items() for name, text in documented(tree, module)}


def cited_in_docstrings() -> set[tuple[str, str]]:
    return {(citation, name) for name, text in docstrings().items() for citation in citations(text)}


def tables() -> tuple[str, str]:
    """What is cited from the paper, and results of our own."""
    paper, own = (ROOT / "docs" / "equations.md").read_text().split("## Results of our own")
    return paper, own


def listed_rows() -> list[Row]:
    return rows_of(tables()[0])


def test_every_citation_in_a_docstring_is_in_the_list():
    assert cited_in_docstrings() - {(row.citation, row.function) for row in listed_rows()} == set()


def test_every_row_of_the_list_names_a_function_that_carries_the_citation():
    assert {(row.citation, row.function) for row in listed_rows()} - cited_in_docstrings() == set()


def test_every_result_of_our_own_names_a_function_that_cites_its_proof():
    proved = set(
        re.findall(r"^\*\*(?:Proposition|Corollary) (\d+)", (ROOT / "docs/theory.md").read_text(), re.MULTILINE)
    )
    for row in rows_of(tables()[1]):
        kind, number = row.citation.split()
        assert number in proved, row
        text = re.sub(r"\s+", " ", docstrings()[row.function] or "")
        assert re.search(rf"docs/theory\.md, {re.escape(kind)} {number}\b", text), row


def test_every_row_of_the_lists_names_a_test_that_exists():
    for row in [*listed_rows(), *rows_of(tables()[1])]:
        file, _, test = row.test.partition("::")
        tree = ast.parse((ROOT / file).read_text())
        assert test in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, row


def test_no_row_stands_twice_and_every_row_has_a_formula():
    rows = listed_rows()
    assert len({(row.citation, row.function) for row in rows}) == len(rows) > 20
    assert all(row.formula for row in rows)


def test_modules_and_private_functions_cite_only_what_the_paper_has():
    cited = [
        citation
        for tree in modules().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef)
        for citation in citations(ast.get_docstring(node))
    ]
    assert {"Alg. 1", "Eq. (3)", "Sec. 2"} <= set(cited)


def test_a_citation_is_read_with_its_neighbours():
    assert citations("It moves.   [PGTS Eq. (3), Lemma 2; Xiao 2022] and [PGTS Sec. 2]") == [
        "Eq. (3)",
        "Lemma 2",
        "Sec. 2",
    ]
    assert citations("No [citation] of Eq. (3).") == []


@pytest.mark.parametrize("docstring", ["[PGTS Eq. (9)]", "[PGTS Thm. 2]", "[PGTS equation 3]", "[PGTS]"])
def test_a_citation_of_what_the_paper_does_not_have_is_refused(docstring):
    with pytest.raises(AssertionError, match=r"the paper has no|cites nothing"):
        citations(docstring)


def test_a_bar_in_a_formula_does_not_end_its_cell():
    text = "| a | b | c | d |\n|---|---|---|---|\n| Eq. (1) | `pi(a\\|s)` | `f.g` | `tests/t.py::test_x` |"
    assert rows_of(text) == [Row("Eq. (1)", "pi(a\\|s)", "f.g", "tests/t.py::test_x")]


def test_methods_of_public_classes_are_read_and_private_ones_are_not():
    source = 'class A:\n  "[PGTS Sec. 2]"\n  def f(self):\n    "[PGTS Sec. 3]"\n  def _g(self): ...\ndef _h(): ...'
    assert dict(documented(ast.parse(source), "m")) == {"m.A": "[PGTS Sec. 2]", "m.A.f": "[PGTS Sec. 3]"}


# Theory

THEORY_TESTS = ("tests/tabular/test_stationary_sets.py", "tests/tabular/test_rates.py", "study/tests/test_theory.py")
"""The files whose tests docs/theory.md and docs/rates.md name without a file."""


def unknown_tests(text: str) -> set[str]:
    """The tests and files of tests that a text names and that do not exist."""
    files = set(re.findall(r"`((?:tests|study)/[\w/]+\.py)`", text))
    known = [node for file in THEORY_TESTS for node in ast.parse((ROOT / file).read_text()).body]
    names = {node.name for node in known if isinstance(node, ast.FunctionDef)}
    return {file for file in files if not (ROOT / file).exists()} | (set(re.findall(r"`(test_\w+)`", text)) - names)


@pytest.mark.parametrize(("page", "least"), [("theory", 20), ("rates", 10)])
def test_every_test_that_the_pages_on_theory_name_exists(page, least):
    text = (ROOT / "docs" / f"{page}.md").read_text()
    assert len(re.findall(r"`test_\w+`", text)) > least
    assert unknown_tests(text) == set()


def test_a_test_that_does_not_exist_would_be_found_on_the_page_on_theory():
    assert unknown_tests("`test_of_nothing` in `tests/test_nothing.py`") == {"test_of_nothing", "tests/test_nothing.py"}
