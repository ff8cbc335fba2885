"""How large and how tangled the package is: lines, large files, import circles, comments where the code is dense.

python benchmarks/code.py
"""

import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "pgts_torch"
LARGE = 300
DENSE = (
    "search/tree.py",
    "search/topology.py",
    "search/split.py",
    "search/outcome_table.py",
    "search/levels.py",
    "search/nodes.py",
    "search/empirical.py",
    "search/sampled.py",
    "models/state_index.py",
    "models/simulator.py",
    "models/stepper.py",
)
"""Masks, scatters and index arithmetic: here a reader needs comments."""


def main() -> None:
    lines = {path: path.read_text().count("\n") for path in sorted(PACKAGE.rglob("*.py"))}
    large = [path for path in lines if lines[path] > LARGE]
    largest = max(lines, key=lines.__getitem__)
    print(f"package lines                    {sum(lines.values())}")
    print(f"largest file                     {lines[largest]}  {largest.relative_to(PACKAGE)}")
    print(f"files above {LARGE} lines            {len(large)}")
    print(f"import circle                    {import_circle() or 'none'}")
    print(f"comment lines in dense modules   {comment_share():.1%}")
    if "--files" in sys.argv:
        for path in sorted(large, key=lines.__getitem__, reverse=True):
            print(f"  {lines[path]:5}  {path.relative_to(PACKAGE)}")


def import_circle() -> str:
    """The first circle of modules that import each other, imports in functions included; empty where there is none."""
    names = {_dotted(path): path for path in PACKAGE.rglob("*.py")}
    graph = {name: set(_imports(path, names)) - {name} for name, path in names.items() if path.name != "__init__.py"}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return " -> ".join(error.args[1])
    return ""


def _dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def _imports(path: Path, names: dict[str, Path]) -> Iterator[str]:
    """The modules of the package, packages' faces aside, that this one imports anywhere."""
    for node in ast.walk(ast.parse(path.read_text())):
        found: list[str] = []
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        yield from (name for name in found if name in names)


def comment_share() -> float:
    """Lines that begin with a comment among the lines of the dense modules."""
    comments = total = 0
    for name in DENSE:
        if (path := PACKAGE / name).exists():
            text = path.read_text()
            total += text.count("\n")
            tokens = tokenize.generate_tokens(io.StringIO(text).readline)
            comments += sum(
                token.type == tokenize.COMMENT and not token.line[: token.start[1]].strip() for token in tokens
            )
    return comments / total


if __name__ == "__main__":
    main()
