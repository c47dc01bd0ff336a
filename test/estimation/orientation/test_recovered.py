"""Rates beyond the range, recovered from a recording whose calibration mixes its axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation.gyro_limit import limits_of, ranges_of
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.recovered import recover
from imu_fusion.samples.logs import ImuLog, MagLog

RATE, RANGE = 150, 6.0
FIELD = np.array([1e-6, 21e-6, -43e-6])
MIXED = np.eye(3) + np.array([[0.0, 0.006, -0.004], [-0.005, 0.0, 0.006], [0.006, 0.005, 0.0]])


@pytest.fixture(scope="module")
def rolling():
    """Two seconds of rest, then eight of rolling about an axis that all three axes see, clipped
    before a calibration: log, field, true rates (n, 3)."""
    rng = np.random.default_rng(8)
    time = np.arange(10 * RATE) / RATE
    speed = 14.0 * np.clip(time - 2.0, 0.0, 1.0) * (1.0 + 0.3 * np.sin(2.0 * time))
    axis = np.column_stack([0.8 + 0.1 * np.sin(time), 0.5 + 0.1 * np.cos(1.3 * time),
                            0.33 * np.ones_like(time)])
    true = speed[:, None] * axis
    steps = Rotation.from_rotvec(0.5 * (true + np.roll(true, -1, axis=0)) / RATE)
    attitude, quats = Rotation.from_euler("xyz", [0.3, 0.2, 1.0]), []
    for step in steps:
        quats.append(attitude.as_quat())
        attitude = attitude * step
    body = Rotation.from_quat(quats).inv()
    seen = np.clip(true + 0.005 * rng.standard_normal(true.shape), -RANGE, RANGE) @ MIXED.T
    stamp = 10**18 + np.round(time * 1e9).astype(np.int64)
    force = body.apply([0.0, 0.0, 9.81]) + 0.05 * rng.standard_normal(true.shape)
    field = body.apply(FIELD) + 1e-7 * rng.standard_normal(true.shape)
    return ImuLog(stamp, seen, force), MagLog(stamp, field), true


def test_what_is_recovered_and_what_is_measured_beside_it_state_their_errors(rolling):
    imu, mag, true = rolling
    found = recover(imu, mag, OrientationParams().replace(**{
        "fusion.use_acc": False, "sensor.gyro_range": (RANGE,), "sensor.gyro_scale_sd": 0.006}))
    assert found.mag_lag == 0.0 and np.array_equal(found.mag.stamp, mag.stamp)
    found = found.imu
    assert len(found) == len(imu)
    fast = np.abs(true).max(axis=1) > 1.2 * RANGE
    beside = fast[:, None] & (np.abs(true) < 0.9 * RANGE)
    error = np.abs(found.gyr - true)
    # Five times the noise: the calibration mixes in what the clipped axis lacks.
    assert np.sqrt(np.mean(error[beside] ** 2)) > 0.02
    assert np.mean(error[beside] < 3.0 * found.gyr_sd[beside]) > 0.95
    beyond = np.abs(true) > 1.1 * RANGE
    assert np.mean(error[beyond] < 3.0 * found.gyr_sd[beyond]) > 0.95
    # Seconds of rolling are held by the field; their errors taken as one would state far more.
    assert np.median(found.gyr_sd[beyond]) < 20.0


def test_a_wild_value_is_no_limit(rolling):
    imu, mag, true = rolling
    gyr = imu.gyr.copy()
    gyr[700, 1] = 900.0
    found = recover(ImuLog(imu.stamp, gyr, imu.acc), mag, OrientationParams().replace(**{
        "fusion.use_acc": False, "sensor.gyro_range": (RANGE,)})).imu
    assert np.abs(found.gyr - true)[:690].max() < 3.0


def test_a_magnetometer_that_is_late_is_taken_earlier(rolling):
    imu, mag, true = rolling
    late = MagLog(mag.stamp + 8_000_000, mag.mag)
    found = recover(imu, late, OrientationParams().replace(**{
        "fusion.use_acc": False, "sensor.gyro_range": (RANGE,)}))
    # Of eight seconds in which the field hardly shows the fast axis, half of it.
    assert 0.003 < found.mag_lag < 0.01
    assert np.array_equal(found.mag.stamp, late.stamp - round(1e9 * found.mag_lag))


def test_an_axis_that_stops_where_the_others_do_is_clipped_too():
    """x and y show flat tops; z wobbles below the same level and never passes it."""
    time = np.arange(3000) / RATE
    gyr = np.column_stack([np.clip(15.0 * np.sin(3.0 * time + k), -RANGE, RANGE)
                           for k in range(3)])
    rng = np.random.default_rng(1)
    top = np.abs(gyr[:, 2]) >= RANGE
    gyr[top, 2] *= 1.0 - 0.03 * rng.random(top.sum())
    parameters = kernel_parameters(OrientationParams())
    assert ranges_of(gyr, parameters) == pytest.approx([RANGE] * 3, rel=0.01)
    assert limits_of(gyr, parameters)["limit"][0] == pytest.approx([RANGE] * 3, rel=0.01)
    gyr[:, 2] = 0.5 * RANGE * np.sin(3.0 * time + 2.0)     # one that never came near keeps its own
    assert np.isinf(limits_of(gyr, parameters)["limit"][0, 2])


@pytest.mark.parametrize(("euler", "known"), [([0.3, 0.2, 1.0], True), ([-1.0, 1.0, 0.0], False)])
def test_rates_do_not_hang_on_how_hard_blows_are_said_to_be(euler, known):
    """A blow of 12 ms turns a spin of 6 rad/s into one of 20, two axes of which are clipped: with
    100 rad/s^2 turns of 100 rad/s that never were explain the field. What fits several is said."""
    rng = np.random.default_rng(1)
    time = np.arange(6 * RATE) / RATE
    at = [0.0, 2.0, 2.3, 2.988, 3.0, 3.1, 3.2, 3.3, 3.5, 3.55, 3.7, 4.3, 5.0, 6.0]
    true = np.column_stack([np.interp(time, at, rates) for rates in (
        [0.0, 0.0, 0.0, -0.3, 12.3, 13.7, 13.3, 14.1, 15.1, 14.4, 14.8, 15.1, 13.0, 6.0],
        [0.0, 0.0, 6.2, 6.0, -5.6, -4.3, -2.9, -2.2, -0.6, -3.0, -2.0, 1.0, 1.0, 1.0],
        [0.0, 0.0, -0.4, -0.4, -16.1, -14.7, -12.7, -12.2, -11.5, -5.3, -4.5, -3.8, -2.5, -1.0])])
    attitude, quats = Rotation.from_euler("xyz", euler), []
    for step in Rotation.from_rotvec(0.5 * (true + np.roll(true, -1, axis=0)) / RATE):
        quats.append(attitude.as_quat())
        attitude = attitude * step
    body = Rotation.from_quat(quats).inv()
    stamp = 10**18 + np.round(time * 1e9).astype(np.int64)
    imu = ImuLog(stamp, np.clip(true + 0.005 * rng.standard_normal(true.shape), -8.0, 8.0),
                 body.apply([0.0, 0.0, 9.81]) + 0.05 * rng.standard_normal(true.shape))
    found = recover(imu, MagLog(stamp, body.apply(FIELD) + 3e-7 * rng.standard_normal(true.shape)),
                    OrientationParams().replace(**{
                        "fusion.use_acc": False, "fusion.angular_acc_sd": 100.0,
                        "fusion.angular_acc_time": 0.1, "sensor.gyro_range": (8.0,)}))
    error = np.abs(found.imu.gyr - true)[time < 5.9]
    if known:
        assert not found.lost and error.max() < 7.0
    else:
        assert found.lost == (stamp[450],)
        assert np.all(error[450:500] < 3.0 * found.imu.gyr_sd[450:500] + 0.1)
