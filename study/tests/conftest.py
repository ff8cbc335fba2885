"""What the tests of the study run under: what those of the package do, and its own shapes checked too."""

import jaxtyping
import pytest

from tests.conftest import pytest_runtest_setup, unchecked_shapes

# Not all of `study`: the hook would take study.tests from pytest, which rewrites assertions to explain them.
jaxtyping.install_import_hook(
    ["study.batch", "study.curves", "study.patterns", "study.sampled"], "tests.typecheck.check"
)

from study import table1  # noqa: E402

__all__ = ["pytest_runtest_setup", "unchecked_shapes"]


@pytest.fixture(scope="session")
def ladder_members() -> table1.Found:
    return table1.members(table1.PAPER["ladder"])
