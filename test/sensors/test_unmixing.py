"""What a calibration has mixed into clipped rates is told by their tops."""

import numpy as np
import pytest

from imu_fusion.sensors.unmixing import unmix

RANGE = 6.0


def recorded(mixing, noise=0.01, seed=0, size=12.0, n=4000, turns=(0.9, 1.7, 2.3)):
    """What axes that tumble record behind a calibration: rates (n, 3), matrix, clipped
    (n, 3), what they saw (n, 3)."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) / 150.0
    true = size * np.column_stack([np.sin(f * time + f) for f in turns])
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


def test_an_axis_that_is_clipped_only_while_another_is():
    """What that one mixes in is not told; the third one tells that both were clipped."""
    gyr, matrix, clipped, _ = recorded(0.01, turns=(0.9, 1.7, 0.9))
    assert np.mean(np.abs(gyr[clipped[:, 0], 0]) < 0.99 * np.abs(gyr[:, 0]).max()) > 0.2
    found = unmix(gyr, np.array([np.abs(gyr[:, 0]).max(), RANGE, RANGE]), 0.01)
    assert found.clipped[clipped].mean() > 0.999
    assert found.matrix[0, 1] == pytest.approx(matrix[0, 1] / matrix[0, 0], abs=2e-4)
    assert found.matrix[0, 2] == pytest.approx(0.0, abs=1e-6)


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
    gyr, *_ = recorded(0.01, n=50)
    found = unmix(gyr, np.full(3, RANGE), 0.01)
    assert not found.known.any()
    assert np.array_equal(found.clipped, np.abs(gyr) >= 0.99 * RANGE)
