"""Calibration of accelerometers from still poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import CalibrationError
from imu_fusion.sensors.accelerometer_calibration import (
    calibrate_accelerometer,
    calibrate_array,
)


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
    for k, part in enumerate(found.parts):
        assert np.abs(part.bias + part.matrix @ bias[k]).max() < 2e-3
    assert np.abs(found.apply(readings) - felt[:, None]).max() < 5e-3
    assert np.linalg.det(found.parts[1].matrix) < 0
    assert max(part.rms for part in found.parts) < 2e-3 and found.disagreement.max() < 2e-3


def test_too_few_or_too_similar_poses_are_refused():
    readings = make_poses(60, np.random.default_rng(1))[-1]
    with pytest.raises(CalibrationError, match="need at least"):
        calibrate_array(readings[:5])
    similar = np.repeat(readings[:4], 5, axis=0)
    with pytest.raises(CalibrationError, match="condition number"):
        calibrate_array(similar)


MATRIX = np.array([[1.03, 0.01, -0.02], [0.015, 0.97, 0.01], [-0.01, 0.02, 1.01]])
BIAS = np.array([0.2, -0.1, 0.3])


def test_six_sides_give_the_whole_matrix_and_what_they_state_holds():
    """Winkler's six poses: twelve parameters from eighteen readings; 50 draws of the noise."""
    felt = 9.8 * np.vstack([np.eye(3), -np.eye(3)])
    inside = []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        seen = (felt - BIAS) @ np.linalg.inv(MATRIX).T + rng.normal(0, 5e-3, felt.shape)
        found = calibrate_accelerometer(seen, 9.8, 5e-3)
        error = np.r_[(found.matrix - MATRIX).ravel(), found.bias - BIAS]
        inside.append(np.abs(error) < 3 * found.sd)
        assert np.abs(error).max() < 0.02
    # The scatter of six poses is itself known to a third: a t distribution has wider tails.
    assert np.mean(inside) > 0.97


def test_any_poses_give_a_symmetric_matrix_and_what_they_state_holds():
    symmetric = 0.5 * (MATRIX + MATRIX.T)
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        felt = rng.standard_normal((20, 3))
        felt *= 9.8 / np.linalg.norm(felt, axis=1)[:, None]
        seen = (felt - BIAS) @ np.linalg.inv(symmetric).T + rng.normal(0, 5e-3, felt.shape)
        found = calibrate_accelerometer(seen, 9.8, 5e-3)
        error = np.r_[(found.matrix - symmetric).ravel(), found.bias - BIAS]
        inside.append(np.abs(error) < 3 * found.sd)
    assert np.mean(inside) > 0.97


def test_poses_that_contradict_each_other_are_refused():
    rng = np.random.default_rng(2)
    moved = 9.8 * np.vstack([np.eye(3), -np.eye(3)]) + rng.normal(0, 1.0, (6, 3))
    with pytest.raises(CalibrationError, match="contradict each other"):
        calibrate_accelerometer(moved)
    with pytest.raises(CalibrationError, match="5 of the six sides"):
        calibrate_accelerometer((9.8 * np.vstack([np.eye(3), -np.eye(3)]))[:5])
