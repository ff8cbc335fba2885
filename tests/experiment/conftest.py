"""What the tests of runs share."""

from collections.abc import Iterator

import pytest
from matplotlib.figure import Figure

from pgts_torch.experiment import pictures


@pytest.fixture(scope="session", autouse=True)
def small_pictures() -> Iterator[None]:
    """At its end a run draws a blank stamp: a whole picture takes longer than the trainings of these tests do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "policy_picture", lambda mdp, pi_SA, *, title="": Figure(figsize=(0.2, 0.2)))
        yield
