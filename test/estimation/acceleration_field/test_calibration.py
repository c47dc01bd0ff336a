"""Calibration of an array from still poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import CalibrationError
from imu_fusion.estimation.acceleration_field.calibration import calibrate_array


def make_poses(count, rng):
    """Readings of three sensors, one with left-handed axes, and what made them."""
    felt = rng.standard_normal((count, 3))
    felt *= 9.80665 / np.linalg.norm(felt, axis=1)[:, None]
    axes = np.array([np.eye(3), np.diag([1, -1, 1.0]), Rotation.from_rotvec([1, 2, 0]).as_matrix()])
    scale = np.eye(3) + 0.02 * rng.standard_normal((3, 3, 3))
    scale = 0.5 * (scale + scale.transpose(0, 2, 1))
    bias = rng.normal(0, 0.3, (3, 3))
    readings = np.einsum("kij,kjl,pl->pki", np.linalg.inv(scale), axes, felt) + bias
    return felt, axes, scale, bias, readings


def test_finds_what_made_the_readings():
    rng = np.random.default_rng(0)
    felt, axes, scale, bias, readings = make_poses(60, rng)
    found = calibrate_array(readings + rng.normal(0, 1e-3, readings.shape))
    # 60 poses with 1 mm/s^2 noise: biases and the vectors felt to a fraction of that noise.
    assert np.abs(found.bias - bias).max() < 2e-3
    assert np.abs(found.apply(readings) - felt[:, None]).max() < 5e-3
    assert np.linalg.det(found.matrix[1]) < 0
    assert found.residual.max() < 2e-3 and found.disagreement.max() < 2e-3


def test_too_few_or_too_similar_poses_are_refused():
    readings = make_poses(60, np.random.default_rng(1))[-1]
    with pytest.raises(CalibrationError, match="need at least"):
        calibrate_array(readings[:5])
    similar = np.repeat(readings[:4], 5, axis=0)
    with pytest.raises(CalibrationError, match="condition number"):
        calibrate_array(similar)
