"""The fusion method on simulated motion with known errors of the sensors."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError, ParameterError
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.rows import (
    FLAG_NO_HEADING,
    FLAG_STILL,
)
from imu_fusion.samples.logs import ImuLog
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from test.estimation.orientation.errors import local_errors, rmse_deg, tilt_errors_deg
from test.estimation.orientation.test_estimator import make


@pytest.fixture(scope="module")
def causal(ordinary):
    estimator = make({"sensor.axes_sd": 0.0})
    return estimator.run(*ordinary[:2]), estimator


@pytest.fixture(scope="module")
def smoothed(ordinary):
    return make({"mode": "smoothed", "sensor.axes_sd": 0.0}).run(*ordinary[:2])


def test_bias_and_delay_are_found(causal):
    rows, estimator = causal
    # rate = M^-1 (raw - bias): the bias state is that of the scaled rate, 0.5 % apart.
    error = rows["gyr_bias"][-1] - [0.01, -0.02, 0.005]
    assert (np.abs(error) < 4 * rows["gyr_bias_sd"][-1] + 1e-4).all()
    assert estimator.summary()["mag_delay"] == pytest.approx(0.011, abs=1e-3)


def test_rates_are_better_than_the_gyroscope(ordinary, causal):
    imu, _, _, truth = ordinary
    late = slice(6000, None)
    raw = np.sqrt(((imu.gyr - [0.01, -0.02, 0.005] - truth)[late] ** 2).mean())
    ours = np.sqrt(((causal[0]["gyr"] - truth)[late] ** 2).mean())
    # Scale is found; a common rotation of the gyroscope's axes is told only as well as
    # the magnetometer's axes are known (0.2 %), and 2e-4 * sqrt(200 Hz) of noise remains.
    assert ours < 0.75 * raw


def test_smoothing_beats_the_causal_filter(ordinary, causal, smoothed):
    truth = ordinary[2]
    # Initial heading: 3e-7 T / 22e-6 T over sqrt(200) samples, and 0.2 deg of tilt by the
    # accelerometer's bias times tan(63 deg): about half a degree that nothing removes.
    assert rmse_deg(causal[0], truth) < 1.2
    assert rmse_deg(smoothed, truth) < rmse_deg(causal[0], truth)
    assert tilt_errors_deg(smoothed, truth).max() < 0.5
    traces = [np.trace(r["cov_attitude"], axis1=1, axis2=2).mean() for r in (causal[0], smoothed)]
    assert traces[1] < traces[0]


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_covariance_is_honest(mode):
    distances = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        sensors = Sensors(
            gyr_density=3e-4, acc_density=2e-3, mag_sd=5e-7, gyr_bias=tuple(rng.normal(0, 0.01, 3)),
            gyr_matrix=np.eye(3) + rng.normal(0, 0.005, (3, 3)),
            acc_bias=tuple(rng.normal(0, 0.03, 3)), mag_offset=tuple(rng.normal(0, 5e-7, 3)),
            mag_delay=float(rng.normal(0.0, 0.01)))
        imu, mag, truth, _ = simulate(Tumbling(seed=seed), 20.0, rate=100.0, sensors=sensors,
                                      seed=seed)
        rows = make({"mode": mode, "sensor.axes_sd": 0.0, "sensor.gyro_delay": 0.0,
                     "alignment.heading_anchor": "field"}).run(imu, mag)
        d = local_errors(rows, truth)
        distances.append(np.einsum("ni,nij,nj->n", d, np.linalg.inv(rows["cov_attitude"]), d))
    distances = np.concatenate(distances)
    # Conservative is permitted (the defaults allow for disturbances that are not simulated),
    # optimistic is not: mean of chi2(3) / 3 is 1.
    assert 0.05 < distances.mean() / 3 < 1.2
    assert (distances < 14.2).mean() > 0.98


def test_six_axes_keep_the_tilt_and_say_that_heading_is_unknown(ordinary):
    imu, _, truth, _ = ordinary
    rows = OrientationEstimator().run(imu)
    assert tilt_errors_deg(rows, truth).max() < 2.5
    assert (rows["flags"] & FLAG_NO_HEADING).all()
    assert np.isnan(rows["mag_world"]).all()
    up = Rotation.from_quat(rows["quat_world_imu"]).inv().apply([0.0, 0.0, 1.0])
    # Uniform over the circle: pi^2 / 3 = 3.29.
    assert (np.einsum("ni,nij,nj->n", up, rows["cov_attitude"], up) > 3.2).all()


def test_slow_turning_is_not_taken_for_bias():
    # 1 deg/s about the vertical after 5 s of rest, no magnetometer: only the bias' own
    # uncertainty tells it from rest.
    n, rate = 200 * 40, math.radians(1.0)
    rng = np.random.default_rng(1)
    stamp = np.arange(n, dtype=np.int64) * 5_000_000
    gyr = rng.normal(0, 2e-3, (n, 3))
    gyr[1000:, 2] += rate
    acc = rng.normal(0, 0.02, (n, 3)) + [0, 0, 9.80665]
    rows = OrientationEstimator().run(ImuLog(stamp, gyr, acc))
    yaw = np.unwrap(Rotation.from_quat(rows["quat_world_imu"]).as_euler("ZYX")[:, 0])
    assert math.degrees(yaw[-1] - yaw[0]) == pytest.approx(35.0, abs=1.0)
    assert (rows["flags"][300:990] & FLAG_STILL).all()
    assert not (rows["flags"][1200:] & FLAG_STILL).any()


def test_without_the_accelerometer_impacts_do_no_harm(ordinary):
    imu, mag, truth, _ = ordinary
    shaken = imu.acc.copy()
    shaken[600:] = np.random.default_rng(0).normal(0, 100.0, shaken[600:].shape)
    rows = make({"fusion.use_acc": False}).run(
        ImuLog(imu.stamp, imu.gyr, shaken), mag)
    same = make({"fusion.use_acc": False}).run(imu, mag)
    assert rmse_deg(rows, truth) < 3.0
    assert rmse_deg(same, truth) == pytest.approx(rmse_deg(rows, truth), abs=0.3)


def test_start_in_motion(ordinary):
    imu, mag, truth, _ = ordinary
    begin = imu.stamp[0] + int(8e9)
    later = imu.stamp >= begin
    rows = OrientationEstimator().run(imu[later], mag[mag.stamp >= begin])
    error = np.degrees(np.linalg.norm(local_errors(rows, truth[later]), axis=1))
    assert error[2000:].max() < 6.0
    assert OrientationEstimator().summary()["aligned"] is False


@pytest.mark.parametrize("rate, mag_rate, jitter", [(50.0, 7.0, 0.0), (1000.0, 100.0, 0.0),
                                                    (200.0, 50.0, 2e-3)])
def test_rates_and_jitter(rate, mag_rate, jitter):
    sensors = Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7, jitter=jitter)
    imu, mag, truth, _ = simulate(Tumbling(seed=5), 15.0, rate=rate, mag_rate=mag_rate,
                                  sensors=sensors, seed=1)
    assert rmse_deg(OrientationEstimator().run(imu, mag), truth) < 1.2


def test_bias_estimation_can_be_switched_off(ordinary):
    imu, mag, _, _ = ordinary
    # Of several hypotheses the weights would go on.
    one = {"fusion.gyro_factor": 1.0, "fusion.local_field_sd": 0.01,
           "fusion.lasting_acc_sd": 0.0}
    estimator = make(one)
    first = estimator.run(imu[:2000], mag[:2000])
    estimator.set_params(OrientationParams.from_mapping(one | {"fusion.estimate_bias": False}))
    rows = estimator.run(imu[2000:4000], mag[2000:4000])
    assert (rows["gyr_bias"] == first["gyr_bias"][-1]).all()
    with pytest.raises(ParameterError, match="method"):
        estimator.set_params(OrientationParams(method="gyro_mag"))


def test_smoothing_needs_the_whole_recording(ordinary):
    imu, mag, _, _ = ordinary
    estimator = OrientationEstimator(OrientationParams(mode="smoothed"))
    estimator.add_imu(int(imu.stamp[0]), imu.gyr[0], imu.acc[0])
    with pytest.raises(EstimationError, match="whole recording"):
        estimator.run(imu[1:], mag)
    with pytest.raises(ParameterError, match="mode"):
        OrientationParams(method="gyro_mag", mode="smoothed")
