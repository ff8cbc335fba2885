"""What every test runs under: one thread, checked shapes, deterministic examples."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's threads, read when it is loaded

import jaxtyping

import tests.typecheck

tests.typecheck.install()  # each letter of a shape is bound anew in every call

from collections.abc import Iterator  # noqa: E402

import hypothesis  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402

torch.set_num_threads(1)

hypothesis.settings.register_profile("pgts", derandomize=True, deadline=None, max_examples=15, database=None)
hypothesis.settings.load_profile("pgts")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.timeout(3600))


def pytest_runtest_setup() -> None:
    tests.typecheck.begin_test()


@pytest.fixture
def unchecked_shapes() -> Iterator[None]:
    """The package as users run it, without jaxtyping: its own messages must name what is wrong."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
