"""Runs of equal samples."""

import numpy as np
import pytest

from imu_fusion.samples.equal_runs import equal_runs


@pytest.mark.parametrize("values, first, lengths", [
    ([], [], []), ([3.0], [0], [1]), ([1, 1, 2, 2, 2, 1], [0, 2, 5], [2, 3, 1]),
    ([[1, 2], [1, 2], [1, 3], [0, 3]], [0, 2, 3], [2, 1, 1]),
    ([np.nan, np.nan], [0, 1], [1, 1])])     # a value that is lost repeats nothing
def test_runs(values, first, lengths):
    found = equal_runs(np.array(values, dtype=float))
    assert found[0].tolist() == first and found[1].tolist() == lengths
