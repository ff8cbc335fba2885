"""What the study says of bounds on what is lacking."""

import numpy as np
import pytest

from study.bounds import DEPTHS, settings, trained


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("number", [0, 1])
def test_no_bound_is_below_what_is_lacking_and_depth_leaves_the_error_of_the_baseline(number):
    setting = settings(quick=True)[number]
    for row in trained(setting):
        for bounds in (row.true, row.known, row.measured):
            assert len(bounds) == len(DEPTHS)
            assert min(bounds) >= row.lacks - 1e-9
        assert np.all(np.array(row.true) <= np.array(row.known) + 1e-9)
    assert row.lacks < 0.01
    assert row.known[-1] < 0.2, "at depth 64 hardly anything is behind the horizon"
    assert row.measured[-1] - row.known[-1] > 0.1, "the baseline may be off, whatever the depth"
