"""Samples at the end of the magnetometer's range, and those of sensors that are stuck."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.mag_rejection import are_saturated, new_limit
from imu_fusion.estimation.orientation.params import kernel_parameters
from imu_fusion.estimation.orientation.rows import FLAG_MAG_SATURATED, FLAG_MAG_USED
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from test.estimation.orientation.test_estimator import errors_deg, make

RANGE = 130e-6
STEP = 0.3e-6      # a 12-bit or 16-bit sensor of 130 to 4900 uT
NOISY = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7)


def screen(mags, ranges=None):
    """Mask of the samples taken for saturated."""
    params = OrientationParams.from_mapping({"sensor.mag_range": ranges})
    par = kernel_parameters(params)
    return are_saturated(new_limit(par), par, mags)


def quantised(mags, step=STEP):
    return np.round(mags / step) * step


@pytest.fixture(scope="module")
def near_iron():
    """A tumbling sensor that passes a magnet of 150 uT between 10 and 16 s."""
    imu, mag, truth, _ = simulate(Tumbling(seed=6), 30.0, rate=200.0, mag_rate=100.0,
                                  sensors=NOISY, seed=5)
    strength = 150e-6 * np.clip(1.0 - np.abs(mag.stamp * 1e-9 - 13.0) / 3.0, 0.0, 1.0) ** 0.5
    turn = Rotation.from_quat(truth.quat_world_imu[::2])
    true = mag.mag + turn.inv().apply(strength[:, None] * [1.0, 0.0, 0.0])
    reported = quantised(np.clip(true, -RANGE, RANGE))
    return imu, MagLog(mag.stamp, reported), np.abs(true).max(axis=1) > RANGE, truth


def test_flat_tops_are_found_and_nothing_else(near_iron):
    _, mag, beyond, _ = near_iron
    found = screen(mag.mag)
    assert beyond.sum() > 50
    # All but the samples of the first flat tops, which cannot be known yet.
    assert (found & beyond).sum() > beyond.sum() - 3 * 4
    at_limit = np.abs(mag.mag).max(axis=1) > RANGE - 1.5 * STEP
    assert not (found & ~at_limit).any()


def test_a_given_range_needs_no_search(near_iron):
    _, mag, beyond, _ = near_iron
    top = np.abs(mag.mag).max()
    found = screen(mag.mag, (top, top, top))
    assert (found == (np.abs(mag.mag) >= top).any(axis=1)).all() and found[beyond].all()
    assert not screen(mag.mag, (1.0, 1.0, 1.0)).any()


@pytest.mark.parametrize("step", [0.15e-6, 0.6e-6, 2e-6])
@pytest.mark.parametrize("noise", [0.0, 0.3e-6])
def test_coarse_still_and_slow_sensors_are_not_saturated(step, noise):
    """In a field of 300 uT (hard iron), beyond what the Earth's own excludes."""
    rng = np.random.default_rng(1)
    t = np.arange(6000) * 0.01
    still = np.tile([300e-6, 20e-6, -40e-6], (6000, 1))
    turning = np.column_stack([250e-6 + 50e-6 * np.sin(t), 50e-6 * np.cos(t),
                               40e-6 * np.sin(0.3 * t)])
    stops = turning.copy()
    stops[157:] = turning[157]      # an abrupt stop where x is largest
    slow = np.column_stack([250e-6 + 50e-6 * np.sin(0.02 * t), 5e-6 * np.cos(0.02 * t), 0 * t])
    fast = np.column_stack([250e-6 + 50e-6 * np.sin(20 * t), 50e-6 * np.cos(20 * t), 0 * t])
    for signal in (still, turning, stops, slow, fast):
        mags = quantised(signal + rng.normal(0, noise, signal.shape), step)
        assert not screen(mags).any()
        assert not screen(np.repeat(mags, 4, axis=0)).any()    # 100 Hz read at 400 Hz


def test_a_larger_value_that_lasts_shows_that_a_limit_was_none():
    ramp = np.linspace(0, 200e-6, 21)
    x = np.r_[ramp, np.full(6, 200e-6), ramp[::-1], 250e-6, 250e-6, 200e-6]
    y = 1e-6 * np.arange(len(x)) ** 2          # turns all the time
    mags = np.column_stack([x, y, y])
    mags[4, 0] = mags[3, 0] + 1e-6             # shows the sensor's step
    found = screen(mags)
    # Of the larger values the first could be a wild one: refused.
    assert list(np.flatnonzero(found)) == [23, 24, 25, 26, 27, 48]


@pytest.mark.parametrize("method", ["fusion", "gyro_mag"])
def test_saturated_samples_are_no_field(near_iron, method):
    imu, mag, beyond, _ = near_iron
    given = make({"method": method, "sensor.mag_range": (RANGE - STEP,)})
    rows = given.run(imu, mag)
    saturated = (np.abs(mag.mag) >= RANGE - STEP).any(axis=1)
    assert given.summary()["mag_saturated"] == saturated.sum()
    # The row of the same stamp says so, and uses no field.
    flagged = (rows["flags"] & FLAG_MAG_SATURATED) != 0
    assert (flagged == np.isin(rows["stamp"], mag.stamp[saturated])).all()
    assert np.isnan(rows["mag_world"][flagged]).all()
    assert not (rows["flags"][flagged] & FLAG_MAG_USED).any()
    # The same as if these samples had not been there at all.
    without = OrientationEstimator(OrientationParams(method=method)).run(imu, mag[~saturated])
    assert (rows["quat_world_imu"] == without["quat_world_imu"]).all()


def test_the_range_is_that_of_the_sensor_before_calibration(near_iron):
    imu, mag, _, _ = near_iron
    shifted = MagLog(mag.stamp, mag.mag + [500e-6, 0.0, 0.0])
    estimator = make({"sensor.mag_range": (520e-6, 1.0, 1.0),
                      "sensor.mag_offset": (500e-6, 0.0, 0.0)})
    estimator.run(imu, shifted)
    # Without the sample before the first Imu, which the kernel does not see.
    assert estimator.summary()["mag_saturated"] == (shifted.mag[1:, 0] >= 520e-6).sum()


def test_alignment_leaves_saturated_samples_and_outliers_out():
    imu, mag, truth, _ = simulate(Tumbling(seed=2), 2.0, rate=200.0, sensors=NOISY, seed=1)
    broken = mag.mag.copy()
    broken[50:90, 0] = 2e-3
    broken[100] = [0.0, 5.0, 0.0]
    broken[101] = [1e30, 0.0, 0.0]
    broken[102] = 0.0
    for mode in ("causal", "smoothed"):
        rows = make({"mode": mode, "sensor.mag_range": (2e-3,)}).run(
            imu, MagLog(mag.stamp, broken))
        error = (Rotation.from_quat(rows["quat_world_imu"]).inv()
                 * Rotation.from_quat(truth.quat_world_imu)).magnitude()
        assert np.degrees(error).max() < 1.0


def test_all_at_the_limit_leaves_the_heading_unknown(near_iron):
    imu, mag, _, _ = near_iron
    estimator = make({"sensor.mag_range": (1e-6,)})
    rows = estimator.run(imu, mag)
    assert len(rows) == len(imu) and not estimator.summary()["has_heading"]
    assert estimator.summary()["mag_saturated"] == len(mag) - 1   # not that before the first Imu


def test_smoothing_counts_each_sample_once(near_iron):
    imu, mag, _, _ = near_iron
    causal, smoothed = (OrientationEstimator(OrientationParams(mode=mode))
                        for mode in ("causal", "smoothed"))
    a, b = causal.run(imu, mag), smoothed.run(imu, mag)
    assert causal.summary()["mag_saturated"] == smoothed.summary()["mag_saturated"] > 50
    assert (a["flags"] == b["flags"]).all()


def test_one_or_three_elements_in_tesla():
    for wrong in ((1e-3, 1e-3), (-1e-3,)):
        with pytest.raises(ParameterError, match="mag_range"):
            OrientationParams.from_mapping({"sensor.mag_range": wrong})
    three = OrientationParams.from_mapping({"sensor.mag_range": (1e-3, 2e-3, 3e-3)})
    assert three.sensor.mag_range == (1e-3, 2e-3, 3e-3)


@pytest.fixture(scope="module")
def tumbling():
    imu, mag, truth, _ = simulate(Tumbling(seed=6), 24.0, rate=100.0, mag_rate=50.0, sensors=NOISY,
                                  seed=5)
    return imu, mag, truth.quat_world_imu


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_a_stuck_magnetometer_is_no_hard_iron_and_is_said(tumbling, mode):
    imu, mag, truth = tumbling
    half = len(mag) // 2
    values = mag.mag.copy()
    values[half:] = values[half]
    estimator = make({"mode": mode})
    rows = estimator.run(imu, MagLog(mag.stamp, values))
    assert errors_deg(rows, truth).max() < 5.0
    # All but those before the turn that its noise does not hide.
    assert half - 10 < estimator.summary()["mag_repeated"] < half
    assert any("repeated one value for 12 s" in text for text in estimator.remarks())


def test_what_a_driver_fills_in_is_as_if_it_had_not_come(tumbling):
    imu, mag, truth = tumbling
    filled = MagLog(mag.stamp, mag.mag[np.arange(len(mag)) // 5 * 5])
    error = []
    for each in (filled, mag[::5]):
        estimator = make({"mode": "smoothed"})
        error.append(errors_deg(estimator.run(imu, each), truth).mean())
        assert not estimator.remarks()
    assert error[0] < 1.2 * error[1]


def test_what_repeats_in_a_start_in_motion_is_no_part_of_its_field(tumbling):
    imu, mag, truth = tumbling
    moving = slice(np.searchsorted(imu.stamp, imu.stamp[0] + 8_000_000_000), None)
    held = MagLog(mag.stamp, mag.mag[np.arange(len(mag)) // 10 * 10])
    held = held[mag.stamp >= imu.stamp[moving][0]]
    estimator = make({})
    estimator.run(imu[moving], held)
    norm = np.linalg.norm(mag.mag, axis=1).mean()
    assert abs(estimator.summary()["field_norm_ut"] * 1e-6 / norm - 1.0) < 0.01


def test_a_coarse_magnetometer_at_rest_repeats_and_is_used():
    imu, mag, _, _ = simulate(Tumbling(seed=6, rest=10.0), 10.0, rate=100.0, mag_rate=50.0,
                              sensors=NOISY, seed=5)
    estimator = make({})
    estimator.run(imu, MagLog(mag.stamp, quantised(mag.mag, 2e-6)))
    assert estimator.summary()["mag_repeated"] == 0
    assert estimator.summary()["mag_used"] == len(mag) - 1   # not that before the first Imu


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_a_stuck_gyroscope_is_said_and_its_rates_are_not_believed(tumbling, mode):
    imu, mag, truth = tumbling
    half = len(imu) // 2
    rates = imu.gyr.copy()
    rates[half:] = rates[half]
    estimator = make({"mode": mode})
    rows = estimator.run(ImuLog(imu.stamp, rates, imu.acc), mag)
    late = slice(half + 200, None)
    sd = np.degrees(np.sqrt(np.trace(rows["cov_attitude"][late], axis1=1, axis2=2)))
    assert (errors_deg(rows, truth)[late] < 3.0 * sd).mean() > 0.95
    assert errors_deg(rows, truth)[late].mean() < 90.0    # any attitude: 126
    assert any("the gyroscope repeated one value for 12 s" in text
               for text in estimator.remarks())


def test_constant_rates_without_noise_are_not_stuck():
    # A turntable about an axis that leans: the force goes where the rates carry it.
    time = np.arange(2000) * 0.01
    turn = Rotation.from_rotvec(time[:, None] * [0.5, 0.0, 0.3])
    force = turn.inv().apply([0.0, 0.0, 9.81])
    estimator = make({})
    estimator.run(ImuLog(np.round(time * 1e9).astype(np.int64),
                         np.tile([0.5, 0.0, 0.3], (2000, 1)), force))
    assert not any("gyroscope repeated" in text for text in estimator.remarks())
