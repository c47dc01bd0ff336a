"""Normalised errors of drawn samples."""

import numpy as np

from imu_fusion.evaluation.consistency import nees


def test_nees_of_drawn_errors_is_their_dimension():
    rng = np.random.default_rng(0)
    root = np.array([[2.0, 0.0], [1.5, 0.1]])
    error = rng.standard_normal((20000, 2)) @ root.T
    values = nees(error, np.broadcast_to(root @ root.T, (20000, 2, 2)))
    # Chi-square of 2: variance 4, so the mean of 20000 scatters by 0.014; here four times that.
    assert abs(values.mean() - 2.0) < 0.06 and abs(values.var() - 4.0) < 0.4
    assert np.isclose(nees(np.array([[3.0]]), np.array([[[4.0]]]))[0], 2.25)
