"""Recovery of clipped rates (Winkler 2025, appendix B) on exact simulated motion."""

import numpy as np
import pytest

from imu_fusion.errors import SampleError
from imu_fusion.sensors.saturation import recover_rates, saturated_axes
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate


@pytest.fixture(scope="module")
def clipped():
    imu, mag, _, rates = simulate(Tumbling(seed=3, rate_sd=5.0), 10.0, rate=500.0,
                                  sensors=Sensors(gyr_limit=6.0))
    return imu, mag, rates


def test_one_and_two_missing_axes_are_recovered(clipped):
    imu, mag, truth = clipped
    missing = saturated_axes(imu.gyr, 6.0)
    assert (missing.sum(axis=1) == 1).any() and (missing.sum(axis=1) == 2).any()
    rates, lost = recover_rates(imu.stamp, imu.gyr, mag.mag, 6.0)
    # An axis is observed as far as it leans away from the field, and its square counts.
    b = mag.mag / np.linalg.norm(mag.mag, axis=1, keepdims=True)
    for axis in range(3):
        alone = missing[:, axis] & (missing.sum(axis=1) == 1) & (np.abs(b[:, axis]) < 0.9)
        # Error of the symmetric quotient: dt^2 / 6 times the third derivative, w^3 ~ 1500.
        assert np.abs(rates - truth)[alone, axis].max() < 0.02
    two = (missing.sum(axis=1) == 2) & ~lost
    raw = np.abs(imu.gyr - truth)[two].max(axis=1)
    assert np.median(np.abs(rates - truth)[two].max(axis=1)) < 0.02 * np.median(raw) + 0.02


def test_good_samples_and_lost_ones_stay(clipped):
    imu, mag, _ = clipped
    rates, lost = recover_rates(imu.stamp, imu.gyr, mag.mag, 6.0)
    good = ~saturated_axes(imu.gyr, 6.0).any(axis=1)
    assert (rates[good] == imu.gyr[good]).all()
    all_lost, lost = recover_rates(imu.stamp[:3], np.full((3, 3), 7.0), mag.mag[:3], 6.0)
    assert lost.all() and (all_lost == 7.0).all()


def test_shapes_are_checked(clipped):
    imu, mag, _ = clipped
    with pytest.raises(SampleError, match="recover_rates"):
        recover_rates(imu.stamp, imu.gyr, mag.mag[:-1], 6.0)
