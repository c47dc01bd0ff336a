"""Ranges found from flat tops, and recovery of clipped rates (Winkler 2025, appendix B), on exact
simulated motion."""

import numpy as np
import pytest

from imu_fusion.errors import SampleError
from imu_fusion.kernels import njit
from imu_fusion.samples.flat_tops import (
    BAND,
    FLAT_TOPS,
    LIMIT_TOLERANCE,
    mark_flat_tops,
    start_flat_tops,
)
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
def _start(found, ranges, tolerance):
    start_flat_tops(found[0], ranges, tolerance)


def search(values, ranges=(np.nan, np.nan, np.nan), floor=1.0, rests_high=False, tolerance=BAND):
    """FLAT_TOPS after values (n, 3), and the mask (n, 3) of the axes at their limit."""
    found, ranges = np.zeros(1, FLAT_TOPS), np.array(ranges)
    _start(found, ranges, tolerance)
    marked = mark_flat_tops(found, ranges, floor, rests_high, np.ascontiguousarray(values))
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
        bits = marked[:, i]
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
    assert list(search(values, (6.0, 6.0, 6.0))[1][0]) == [True, True, False]


def test_a_range_of_other_digits_is_met_and_the_one_below_is_not():
    """1000 deg/s as the data sheet and as a float have it, and the sensor's next value."""
    values = np.array([[17.453293, 17.4533, 17.453293 * (1 - 1 / 4096)]])
    for given in (17.4533, 17.453293, 17.45329):
        marked = search(values, (given,) * 3, tolerance=LIMIT_TOLERANCE)[1]
        assert list(marked[0]) == [True, True, False]


GRAVITY = 9.81


def forces(seed, scale, rate=200.0):
    """Specific force of a tumbling body that is shaken, (n, 3) m/s^2."""
    imu, _, _, _ = simulate(Tumbling(seed=seed, rate_sd=3.0), 20.0, rate=rate)
    shaken = simulate(Tumbling(seed=seed + 50, rate_sd=8.0), 20.0, rate=rate)[3]
    return imu.acc + scale * shaken


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("step", [0.0, 2 * 2 * GRAVITY / 4096])
def test_an_accelerometer_at_its_limit(seed, step):
    """2 g, equal values or those of a matrix and noise behind the limit."""
    limit = 2 * GRAVITY
    true = forces(seed, 2.0)
    values = np.clip(true, -limit, limit)
    if step:
        values = np.round(values / step) * step
    else:
        rng = np.random.default_rng(seed)
        values = values @ (np.eye(3) + rng.normal(0, 0.002, (3, 3))).T
        values += rng.normal(0, 0.01, true.shape)
    found, marked = search(values, floor=12.0, rests_high=True)
    beyond = np.abs(true) > limit
    for i in range(3):
        assert beyond[:, i].sum() > 50
        assert found["limit"][i] == pytest.approx(limit, rel=2.5 * BAND)
        later = np.flatnonzero(marked[:, i])[0]
        assert marked[later:, i][beyond[later:, i]].mean() > 0.95
        assert np.abs(true[marked[:, i], i]).min() > limit * (1 - 4 * BAND)


@pytest.mark.parametrize("step", [0.0, 0.01, 0.15])
def test_a_body_set_down_again_and_again_is_at_no_limit(step):
    """Steep edges, equal largest values, one level: a pause, since no other axis moves."""
    rng = np.random.default_rng(3)
    poses = np.repeat([[14.0, 1.0, 2.0], [2.0, 9.0, -1.0], [1.0, 1.0, 9.5]], 60, axis=0)
    values = np.tile(poses, (6, 1)) + rng.normal(0, 0.02, (1080, 3))
    if step:
        values = np.round(values / step) * step
    for rests_high in (True, False):
        found, marked = search(values, floor=5.0, rests_high=rests_high)
        if rests_high or not step:
            assert np.isinf(found["limit"]).all() and not marked.any()
    # Nor is a turntable that stops and goes on at one rate.
    table = np.zeros((1080, 3))
    table[:, 2] = np.tile(np.repeat([0.0, 3.5], 60), 9)
    assert np.isinf(search(table + rng.normal(0, 2e-3, table.shape))[0]["limit"]).all()
