"""gyro_mag: the printed step, and what is estimated around it."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.rows import FLAG_SATURATED
from imu_fusion.samples.logs import ImuLog
from imu_fusion.sensors.saturation import saturated_axes
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from test.estimation.orientation.test_estimator import make

MATRIX = ((1.004, 0.003, 0.0), (-0.002, 0.997, 0.001), (0.0, 0.003, 1.002))
ORDINARY = Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=(0.01, -0.02, 0.005),
                   gyr_matrix=MATRIX, mag_delay=0.011)


PRINTED = {"gyro_mag.as_printed": True}


def run(imu, mag, changes=None):
    return make({"method": "gyro_mag", "sensor.axes_sd": 0.0} | (changes or {})).run(imu, mag)


def local_errors(rows, truth):
    """(n, 3) rotation vectors from estimate to truth, imu axes, rad."""
    return (Rotation.from_quat(rows["quat_world_imu"]).inv()
            * Rotation.from_quat(truth.quat_world_imu)).as_rotvec()


def rmse_deg(rows, truth):
    return math.degrees(math.sqrt((local_errors(rows, truth) ** 2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def ordinary():
    return simulate(Tumbling(seed=11), 40.0, rate=100.0, sensors=ORDINARY, seed=3)


def test_without_estimation_a_step_is_the_printed_least_squares(ordinary):
    imu, mag, _, _ = ordinary
    rows = run(imu[:1000], mag[:1000], PRINTED)
    bias = rows["gyr_bias"][0]
    first = Rotation.from_quat(rows["quat_world_imu"][0])
    # The field and B0 of (9) are the alignment's: the mean over its interval at rest.
    still = mag.stamp <= imu.stamp[0] + int(1e9)
    field = first.apply(mag.mag[still].mean(axis=0))
    b0 = np.linalg.norm(field)
    dt = (imu.stamp[1] - imu.stamp[0]) * 1e-9
    for n in (300, 500, 900):
        r = Rotation.from_quat(rows["quat_world_imu"][n])
        rate, rate_next = imu.gyr[n] - bias, imu.gyr[n + 1] - bias
        b = mag.mag[n + 1]
        w = math.exp(-(5.0 * (b0 - np.linalg.norm(b)) / b0) ** 2)

        def f(phi, r=r, rate=rate, rate_next=rate_next, b=b, w=w):
            end = Rotation.from_rotvec(phi) * r
            return np.concatenate([dt * (end.apply(rate_next) + r.apply(rate)) - 2.0 * phi,
                                   w / b0 * (end.apply(b) - field)])

        phi = least_squares(f, dt * r.apply(rate), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        expected = Rotation.from_rotvec(phi) * r
        step = expected.inv() * Rotation.from_quat(rows["quat_world_imu"][n + 1])
        # The rest motion of the alignment (noise and a bias) turns its mean field by 1e-5.
        assert step.magnitude() < 2e-5


def test_scale_bias_and_delay_are_found(ordinary):
    imu, mag, truth, _ = ordinary
    estimator = OrientationEstimator(OrientationParams(method="gyro_mag"))
    rows = estimator.run(imu, mag)
    assert estimator.summary()["mag_delay"] == pytest.approx(0.011, abs=2e-3)
    assert rmse_deg(rows, truth) < 0.5 * rmse_deg(run(imu, mag, PRINTED), truth)


@pytest.mark.parametrize("changes", [{}, PRINTED])
def test_the_accelerometer_counts_in_the_start_alone(ordinary, changes):
    imu, mag, _, _ = ordinary
    shaken = imu.acc.copy()
    shaken[110:] = np.random.default_rng(0).normal(0, 100.0, shaken[110:].shape)
    first = run(imu, mag, changes)
    second = run(ImuLog(imu.stamp, imu.gyr, shaken), mag, changes)
    for name in ("quat_world_imu", "cov_attitude", "gyr", "gyr_bias", "flags"):
        assert (first[name] == second[name]).all(), name


def test_axes_at_their_limit_are_carried_by_the_field():
    sensors = Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7, gyr_limit=6.0)
    imu, mag, truth, rates = simulate(Tumbling(seed=21, rate_sd=5.0), 25.0, rate=200.0,
                                      sensors=sensors, seed=2)
    clipped = np.abs(imu.gyr) >= 6.0
    rows = run(imu, mag)
    flagged = (rows["flags"] & FLAG_SATURATED) != 0
    assert not flagged[~saturated_axes(imu.gyr, 6.0).any(axis=1)].any()
    blind = run(imu, mag, {"sensor.gyro_range": (1e3,)})
    assert rmse_deg(rows, truth) < 0.4 * rmse_deg(blind, truth)
    error = [np.sqrt(((r["gyr"] - rates)[clipped] ** 2).mean()) for r in (rows, blind)]
    assert error[0] < 0.5 * error[1]


@pytest.mark.parametrize("limit, axes", [(5.0, 3), (6.0, 2), (8.0, 1)])
def test_as_printed_drops_the_rows_of_axes_at_their_limit(limit, axes):
    """Appendix B: a quiet field stands in for one and two missing axes; noise has its price."""
    motion = Tumbling(seed=21, rate_sd=3.0)
    imu, mag, truth, rates = simulate(motion, 10.0, rate=200.0, seed=2,
                                      sensors=Sensors(gyr_limit=limit))
    clipped = np.abs(imu.gyr) >= limit
    assert clipped.sum(axis=1).max() == axes
    told = PRINTED | {"sensor.gyro_range": (limit,)}
    rows = run(imu, mag, told)
    blind = run(imu, mag, PRINTED | {"sensor.gyro_range": (1e3,)})
    # Without noise an axis is lost only where it points along the field.
    assert rmse_deg(rows, truth) < 0.2 * rmse_deg(blind, truth)
    errors = [(r["gyr"] - rates)[clipped] for r in (rows, blind)]
    assert np.sqrt((errors[0] ** 2).mean()) < 0.1 * np.sqrt((errors[1] ** 2).mean())
    noisy, mag, truth, rates = simulate(motion, 10.0, rate=200.0, seed=2,
                                        sensors=Sensors(gyr_limit=limit, mag_sd=3e-7))
    rows = run(noisy, mag, told)
    sd = np.sqrt(np.einsum("nii->ni", rows["cov_gyr"]))
    # The noise of one sample is 3e-7 T sqrt(2) / (48e-6 T dt) = 1.8 rad/s: worse, and said so.
    assert (np.abs(rows["gyr"] - rates) < 3.0 * sd)[clipped].mean() > 0.97
