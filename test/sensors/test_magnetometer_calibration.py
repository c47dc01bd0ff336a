"""In situ magnetometer calibration against known distortions."""

import math

import numpy as np
import pytest

from imu_fusion.errors import CalibrationError
from imu_fusion.estimation.orientation.estimator import OrientationParams
from imu_fusion.sensors.magnetometer_calibration import (
    MagCalibrator,
    calibrate_magnetometer,
    coverage,
)

NORM = 48e-6
OFFSET = np.array([12e-6, -25e-6, 8e-6])
# Symmetric, determinant not 1: |soft @ (m - offset)| = NORM.
SOFT = np.array([[1.10, 0.05, -0.03], [0.05, 0.92, 0.04], [-0.03, 0.04, 1.02]])


def sphere(n, rng):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def distorted(directions, noise=0.0, rng=None):
    m = NORM * directions @ np.linalg.inv(SOFT).T + OFFSET
    return m if rng is None else m + rng.normal(0, noise, m.shape)


def test_exact_samples_give_the_exact_calibration():
    c = calibrate_magnetometer(distorted(sphere(300, np.random.default_rng(1))), field_norm=NORM)
    assert c.offset == pytest.approx(OFFSET, abs=1e-12)
    assert c.matrix == pytest.approx(SOFT, abs=1e-7)
    assert c.field_norm == pytest.approx(NORM)


@pytest.mark.parametrize("share", [0.9, 1.0, 1.1, 3.0])
def test_hard_iron_may_be_as_strong_as_the_field(share):
    """The origin then lies on the ellipsoid, or near it, or outside."""
    rng = np.random.default_rng(6)
    m = distorted(sphere(300, rng), 3e-7, rng) - OFFSET
    iron = share * NORM * np.linalg.inv(SOFT) @ np.array([0.6, 0.0, 0.8])
    c = calibrate_magnetometer(m + iron, field_norm=NORM)
    assert c.offset == pytest.approx(iron, abs=2e-7)


def test_without_a_norm_the_determinant_is_one():
    c = calibrate_magnetometer(distorted(sphere(300, np.random.default_rng(1))))
    assert np.linalg.det(c.matrix) == pytest.approx(1.0)
    assert c.matrix / c.matrix[0, 0] == pytest.approx(SOFT / SOFT[0, 0], abs=1e-7)


def test_errors_keep_to_the_covariance():
    rng = np.random.default_rng(7)
    truth = np.concatenate([OFFSET, SOFT[np.triu_indices(3)]])
    distances = []
    for _ in range(60):
        # The sensor does not see all directions: a band, as in a tumbling ball.
        d = sphere(600, rng)
        d = d[np.abs(d[:, 2]) < 0.8][:250]
        c = calibrate_magnetometer(distorted(d, 0.3e-6, rng), field_norm=NORM)
        error = np.concatenate([c.offset, c.matrix[np.triu_indices(3)]]) - truth
        distances.append(error @ np.linalg.solve(c.cov, error))
    # Mean of 60 chi2 with 9 degrees: sd sqrt(18 / 60) = 0.55; the median-based noise
    # estimate adds a little.
    assert np.mean(distances) == pytest.approx(9.0, abs=2.2)


def test_disturbed_samples_are_outvoted():
    rng = np.random.default_rng(3)
    m = distorted(sphere(400, rng), 0.2e-6, rng)
    m[:20] += 30e-6
    c = calibrate_magnetometer(m, field_norm=NORM)
    assert np.abs(c.offset - OFFSET).max() < 0.5e-6
    assert np.abs(c.matrix - SOFT).max() < 0.02


def test_too_little_turning_is_refused_with_the_reason():
    rng = np.random.default_rng(4)
    angle = rng.uniform(0, 2 * math.pi, 200)
    flat = np.column_stack([np.cos(angle), np.sin(angle), np.full(200, 0.3)])
    with pytest.raises(CalibrationError, match="turn the sensor"):
        calibrate_magnetometer(distorted(flat))
    with pytest.raises(CalibrationError, match="at least"):
        calibrate_magnetometer(distorted(flat[:5]))
    with pytest.raises(CalibrationError, match="equal"):
        calibrate_magnetometer(np.tile(OFFSET, (50, 1)))


def test_coverage_counts_directions():
    rng = np.random.default_rng(5)
    d = sphere(5000, rng)
    assert coverage(d) == 1.0
    assert coverage(d[d[:, 2] > 0]) == pytest.approx(0.5, abs=0.1)
    assert coverage(np.tile([1.0, 0.0, 0.0], (9, 1))) == pytest.approx(1 / 96)


def test_running_set_is_balanced_and_agrees_with_batch():
    rng = np.random.default_rng(6)
    turning = distorted(sphere(3000, rng), 0.2e-6, rng)
    resting = distorted(np.tile(sphere(1, rng), (2000, 1)), 0.2e-6, rng)
    calibrator = MagCalibrator(field_norm=NORM)
    kept_resting = sum(calibrator.add(m) for m in resting)
    kept = sum(calibrator.add(m) for m in turning)
    assert kept_resting == 1
    assert 200 < kept < 800
    assert not calibrator.add([math.nan, 0, 0])
    c = calibrator.result()
    # Within four of its own standard deviations.
    assert (np.abs(c.offset - OFFSET) < 4 * np.sqrt(np.diag(c.cov)[:3])).all()
    assert c.coverage == 1.0


def test_result_is_valid_as_parameters():
    c = calibrate_magnetometer(distorted(sphere(300, np.random.default_rng(1))), field_norm=NORM)
    p = OrientationParams.from_mapping(c.to_parameters())
    assert p.sensor.mag_offset == pytest.approx(OFFSET, abs=1e-11)
    assert np.reshape(p.sensor.mag_matrix, (3, 3)) == pytest.approx(SOFT, abs=1e-6)
