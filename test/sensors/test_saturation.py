"""Ranges found from flat tops, and recovery of clipped rates (Winkler 2025, appendix B), on exact
simulated motion."""

import numpy as np
import pytest

from imu_fusion.errors import SampleError
from imu_fusion.kernels import njit
from imu_fusion.sensors.saturation import (
    BAND,
    FLAT_TOPS,
    find_flat_tops,
    recover_rates,
    saturated_axes,
    start_flat_tops,
)
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
    rates, lost = recover_rates(imu.stamp, imu.gyr, mag.mag,
                                saturated_axes(imu.gyr, 6.0))
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
    rates, lost = recover_rates(imu.stamp, imu.gyr, mag.mag,
                                saturated_axes(imu.gyr, 6.0))
    good = ~saturated_axes(imu.gyr, 6.0).any(axis=1)
    assert (rates[good] == imu.gyr[good]).all()
    all_lost, lost = recover_rates(imu.stamp[:3], np.full((3, 3), 7.0), mag.mag[:3],
                                   np.ones((3, 3), bool))
    assert lost.all() and (all_lost == 7.0).all()


def test_shapes_are_checked(clipped):
    imu, mag, _ = clipped
    with pytest.raises(SampleError, match="recover_rates"):
        recover_rates(imu.stamp, imu.gyr, mag.mag[:-1], saturated_axes(imu.gyr, 6.0))


@njit
def _search(found, ranges, values, marked):
    start_flat_tops(found[0], ranges)
    for i in range(len(values)):
        marked[i] = find_flat_tops(found[0], ranges, 1.0, values[i])


def search(values, ranges=(np.nan, np.nan, np.nan)):
    """FLAT_TOPS after values (n, 3), and the bits of the axes at their limit (n,)."""
    found, marked = np.zeros(1, FLAT_TOPS), np.zeros(len(values), dtype=np.int64)
    _search(found, np.array(ranges), np.ascontiguousarray(values), marked)
    return found[0], marked


def rates(seed, rate_sd=5.0, rate=200.0):
    return simulate(Tumbling(seed=seed, rate_sd=rate_sd), 30.0, rate=rate)[3]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("limit", [4.0, 8.0])
def test_tops_behind_a_calibration_are_flat_though_not_equal(seed, limit):
    rng = np.random.default_rng(seed)
    true = rates(seed)
    matrix = np.eye(3) + rng.normal(0, 0.003, (3, 3))
    bias = rng.normal(0, 0.01, 3)
    values = (np.clip(true, -limit, limit) - bias) @ matrix.T + rng.normal(0, 3e-3, true.shape)
    found, marked = search(values)
    clipped = np.abs(true) > limit
    for i in range(3):
        if clipped[:, i].sum() < 50:
            continue
        assert found["limit"][i] == pytest.approx(limit, rel=2.5 * BAND)
        bits = (marked >> i) & 1 == 1
        # What comes before the second flat top is not known.
        later = np.flatnonzero(bits)[0]
        assert bits[later:][clipped[later:, i]].mean() > 0.95
        assert np.abs(true[bits, i]).min() > limit * (1 - 4 * BAND)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("rate", [40.0, 100.0, 300.0])
def test_smooth_motion_has_no_flat_tops(seed, rate):
    rng = np.random.default_rng(seed)
    true = rates(seed, rate_sd=rng.uniform(1, 8), rate=rate)
    for noise in (0.0, 5e-3):
        found, marked = search(true + rng.normal(0, noise, true.shape))
        assert np.isinf(found["limit"]).all() and not marked.any()


def test_a_spike_or_a_pause_is_no_limit():
    true = rates(1)
    true[50:3000:100] = 30.0
    assert np.isinf(search(true)[0]["limit"]).all()
    # Turning at one rate for a while, then faster: what was no limit is given up.
    steps = np.repeat([[0.0], [3.0], [0.5], [3.0], [0.5], [5.0], [0.0]], 40, axis=0) * np.ones(3)
    steps += np.random.default_rng(0).normal(0, 1e-3, steps.shape)
    found, marked = search(steps)
    assert np.isinf(found["limit"]).all() and not marked[-79:].any()


def test_a_range_of_the_data_sheet_is_met_within_a_calibration():
    values = np.array([[5.96, -5.95, 5.9]])
    assert search(values, (6.0, 6.0, 6.0))[1][0] == 3
