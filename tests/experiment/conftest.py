"""What the tests of runs share."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from pgts_torch.experiment import pictures, run
from pgts_torch.experiment.report import page
from tests.experiment.cut_off import QUIET, configured, cut_off


@pytest.fixture(scope="session", autouse=True)
def small_pictures() -> Iterator[None]:
    """At its end a run draws a blank stamp: a whole picture takes longer than the trainings of these tests do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "policy_picture", lambda mdp, pi_SA, *, title="": Figure(figsize=(0.2, 0.2)))
        yield


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pictures of a report stay empty, which takes no time."""
    monkeypatch.setattr(page, "image", lambda figure, **options: "data:image/svg+xml;base64,")


@pytest.fixture(scope="session")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Gives the folder of a run with these arguments that was never cut off; the same arguments are trained once."""

    @functools.cache
    def trained(*arguments: str) -> Path:
        folder = tmp_path_factory.mktemp("uninterrupted") / "run"
        run.train(configured(folder, *arguments))
        return folder

    return trained


@pytest.fixture
def cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run that was cut off after its second checkpoint, in the folder in which the test is."""
    monkeypatch.chdir(tmp_path)
    cut_off(configured(Path("cut"), *QUIET), monkeypatch, after=2)
    return Path("cut")
