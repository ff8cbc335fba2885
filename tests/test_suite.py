"""The suite itself: shapes are checked, no process is waited for without end, and no benchmark is forgotten."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from tests import typecheck

ROOT = Path(__file__).parents[1]


def double(x_N: Float[Tensor, "N"], y_N: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    return (x_N + y_N)[: len(x_N)]


def test_shapes_are_checked_in_the_first_calls_of_each_test_and_in_some_later_ones():
    checked = typecheck.jaxtyped(typechecker=typecheck.check)(double)

    def refused(calls: int, size: int) -> list[int]:
        """Those of so many calls that do not take one number and so many others."""
        found = []
        for call in range(calls):
            try:
                checked(torch.ones(1), torch.ones(size))
            except TypeCheckError:
                found.append(call)
        return found

    assert refused(10, 3) == [*range(10)]
    assert len(refused(160, 3)) == 10
    typecheck.begin_test()
    assert refused(5, 3) == [*range(5)]
    assert refused(100, 1) == []


def endless_waits(source: str) -> Iterator[str]:
    """Calls in a test that wait for a process, however long that takes."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            limited = any(keyword.arg == "timeout" for keyword in node.keywords)
            runs = (
                node.func.attr in ("run", "check_output", "check_call") and ast.unparse(node.func.value) == "subprocess"
            )
            waits = node.func.attr in ("wait", "communicate") and not node.args
            if (runs or waits) and not limited:
                yield f"line {node.lineno}: {ast.unparse(node.func)}"


def test_every_process_that_a_test_waits_for_has_a_time_limit():
    sources = {
        path: path.read_text(encoding="utf-8")
        for folder in ("tests", "study")
        for path in (ROOT / folder).rglob("*.py")
    }
    assert {path.name: waits for path, source in sources.items() if (waits := list(endless_waits(source)))} == {}


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("subprocess.run(['ls'], check=True)", 1),
        ("subprocess.run(['ls'], timeout=3)", 0),
        ("process.wait()", 1),
        ("process.wait(PATIENCE)", 0),
        ("out = process.communicate()[1]", 1),
        ("out = process.communicate(timeout=PATIENCE)[1]", 0),
    ],
)
def test_a_wait_without_end_is_found(source, count):
    assert len(list(endless_waits(source))) == count


def test_each_benchmark_runs_in_its_short_form_before_a_release():
    scripts = [path for path in (ROOT / "benchmarks").glob("*.py") if "__main__" in path.read_text(encoding="utf-8")]
    long = (ROOT / ".ci" / "long").read_text(encoding="utf-8")
    part = re.search(r"^benchmarks\(\) \{\n(.*?)^\}", long, re.DOTALL | re.MULTILINE)
    assert part is not None
    others = {"learning", "checksums", "code"}  # which starts benchmarks; tools for changes of the code
    forgotten = {path.stem for path in scripts} - set(re.findall(r"\w+", part[1])) - others
    assert len(scripts) > 10
    assert forgotten == set()
