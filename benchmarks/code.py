"""How large the package is: lines, large files, comments where the code is dense. (tests/test_structure.py keeps its
imports free of circles.)

python benchmarks/code.py
"""

import io
import sys
import tokenize
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "pgts_torch"
LARGE = 300
DENSE = (
    "search/tree.py",
    "search/topology.py",
    "search/split.py",
    "search/outcome_table.py",
    "search/levels.py",
    "search/nodes.py",
    "search/known.py",
    "search/empirical.py",
    "search/sampled.py",
    "search/bootstrap.py",
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
    print(f"comment lines in dense modules   {comment_share():.1%}")
    if "--files" in sys.argv:
        for path in sorted(large, key=lines.__getitem__, reverse=True):
            print(f"  {lines[path]:5}  {path.relative_to(PACKAGE)}")


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
