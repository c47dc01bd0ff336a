"""What a calibration has mixed into clipped rates is told by their tops."""

import numpy as np
import pytest

from imu_fusion.sensors.unmixing import unmix

RANGE = 6.0


def recorded(mixing, noise=0.01, seed=0, size=12.0, n=4000):
    """What axes that tumble record behind a calibration: rates (n, 3), matrix, clipped
    (n, 3), what they saw (n, 3)."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) / 150.0
    true = size * np.column_stack([np.sin(f * time + f) for f in (0.9, 1.7, 2.3)])
    seen = true + noise * rng.standard_normal(true.shape)
    matrix = np.eye(3) + mixing * rng.standard_normal((3, 3))
    return np.clip(seen, -RANGE, RANGE) @ matrix.T + 0.02, matrix, np.abs(seen) >= RANGE, seen


@pytest.mark.parametrize("mixing", [0.003, 0.01, 0.03])
def test_the_matrix_and_the_clipped_samples_come_out(mixing):
    gyr, matrix, clipped, seen = recorded(mixing)
    found = unmix(gyr, np.full(3, RANGE), 0.01)
    assert found.known.all()
    expected = matrix / np.diag(matrix)
    assert found.matrix == pytest.approx(expected, abs=2e-4)
    # All of them, and others only where they end within the band and noise.
    assert found.clipped[clipped].mean() > 0.9995
    assert np.abs(seen[found.clipped]).min() > 0.975 * RANGE
    # Tops that are not flat to their 6 % are, once unmixed.
    tops = np.abs(found.seen[clipped[:, 0], 0])
    assert tops.std() < 2e-2 * RANGE


def test_what_was_not_clipped_tells_nothing():
    gyr, *_ = recorded(0.01, size=5.0)
    found = unmix(gyr, np.full(3, np.inf), 0.01)
    assert not found.known.any() and not found.clipped.any()
    assert np.array_equal(found.seen, gyr)


def test_tops_that_a_filter_has_rounded_are_left_alone():
    """Their residuals are no calibration's: the limit with its band is all there is."""
    gyr, *_ = recorded(0.01)
    rounded = np.array([np.convolve(column, np.ones(75) / 75, "same") for column in gyr.T]).T
    found = unmix(rounded, np.full(3, RANGE), 0.01)
    assert np.abs(found.matrix - np.eye(3)).max() < 0.05


def test_too_few_tops_tell_nothing():
    gyr, *_ = recorded(0.01, n=60)
    found = unmix(gyr, np.full(3, RANGE), 0.01)
    assert not found.known.any()
    assert np.array_equal(found.clipped, np.abs(gyr) >= 0.99 * RANGE)
