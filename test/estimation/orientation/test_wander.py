"""What samples say against the model: poor gyroscopes as a hypothesis, wandering innovations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation import wander
from imu_fusion.estimation.orientation.state import WANDER
from imu_fusion.kernels import njit
from imu_fusion.simulation.rotation import Sensors, Tumbling, earth_field, simulate
from test.estimation.orientation.errors import local_errors, tilt_errors_deg
from test.estimation.orientation.test_estimator import make

MODES = ("causal", "smoothed")


def within_3_sigma(rows, truth, heading=True):
    """Share of rows whose error, or whose tilt's, is within 3 standard deviations."""
    error = local_errors(rows, truth)
    turn = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    world = np.einsum("nij,nj->ni", turn, error)
    cov = turn @ rows["cov_attitude"] @ turn.transpose(0, 2, 1)
    n, bound = (3, 14.16) if heading else (2, 11.83)
    distance = np.einsum("ni,nij,nj->n", world[:, :n], np.linalg.inv(cov[:, :n, :n]), world[:, :n])
    return (distance < bound).mean()


@pytest.fixture(scope="module")
def biased():
    """A start in motion with the bias of a phone that nobody calibrated, 6 deg/s."""
    sensors = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=(0.1, -0.03, 0.02))
    imu, mag, truth, _ = simulate(Tumbling(seed=3, rest=0.0, fade=1e-3), 40.0, rate=100.0,
                                  sensors=sensors, seed=3)
    return imu, mag, truth


@pytest.mark.parametrize("mode", MODES)
def test_a_large_bias_at_a_start_in_motion_is_found(biased, mode):
    imu, mag, truth = biased
    estimator = make({"mode": mode})
    rows = estimator.run(imu, mag)
    assert estimator.summary()["gyro_factor"] == 5.0
    assert estimator.summary()["gyro_factor_weight"] > 0.95
    assert within_3_sigma(rows, truth) > 0.95
    assert np.abs(rows["gyr_bias"][-1] - [0.1, -0.03, 0.02]).max() < 0.005


@pytest.mark.parametrize("mode", MODES)
def test_a_scale_off_by_six_percent_is_found_without_a_magnetometer(mode):
    sensors = Sensors(gyr_density=1e-4, acc_density=2e-3,
                      gyr_matrix=np.diag([1.06, 0.95, 1.05]))
    imu, _, truth, _ = simulate(Tumbling(seed=5), 60.0, rate=100.0, sensors=sensors, seed=5)
    estimator = make({"mode": mode})
    rows = estimator.run(imu)
    assert estimator.summary()["gyro_factor"] == 5.0
    # The evidence comes with the turning, from 2 s on.
    late = imu.stamp > imu.stamp[0] + int(10e9)
    assert within_3_sigma(rows[late], truth[late], heading=False) > 0.95
    one = make({"mode": mode, "fusion.gyro_factor": 1.0}).run(imu)
    better = [np.sqrt((tilt_errors_deg(r, truth) ** 2).mean()) for r in (rows, one)]
    assert better[0] < 0.5 * better[1]


def test_innovations_that_wander_widen_what_is_stated():
    """One hypothesis and a gyroscope that it does not allow for: only the innovations tell."""
    sensors = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7,
                      gyr_matrix=np.diag([1.04, 0.96, 1.04]))
    imu, _, truth, _ = simulate(Tumbling(seed=7), 60.0, rate=100.0, sensors=sensors, seed=7)
    estimator = make({"mode": "smoothed", "fusion.gyro_factor": 1.0})
    rows = estimator.run(imu)
    widened = estimator.summary()["wander_tilt"]
    assert widened > 1.5 and within_3_sigma(rows, truth, heading=False) > 0.95
    rows["cov_attitude"] /= widened ** 4    # standard deviations grow by the mean square
    assert within_3_sigma(rows, truth, heading=False) < 0.95


@njit
def _feed(found, innovations, time):
    for n in range(len(innovations)):
        for i in range(2):
            found[0].velocity[i] = wander.low_passed(found[0].velocity[i], innovations[n, i], time)
        found[0].field = wander.low_passed(found[0].field, innovations[n, 2], time)
        wander.judge(found[0], time)


@pytest.mark.parametrize("time", [0.02, 0.1])
def test_white_innovations_do_not_wander_and_constant_ones_do(time):
    rng = np.random.default_rng(0)
    n = int(600 / time)
    found = np.zeros(1, WANDER)
    _feed(found, rng.normal(size=(n, 3)), time)
    # 600 s have some 60 independent values, two axes of velocity.
    assert found[0]["overall"] == pytest.approx([1.0, 1.0], abs=0.6)
    # An error that lasts: a tenth of a standard deviation in each of n samples is
    # sqrt(n) / 10 of that of their mean.
    found = np.zeros(1, WANDER)
    _feed(found, rng.normal(size=(n, 3)) + [1.0, 1.0, 0.0], time)
    assert found[0]["overall"][0] > 0.5 * 2 * 5.0 / time
    assert found[0]["overall"][1] < 2.0


@pytest.mark.parametrize("mode", MODES)
def test_a_filter_that_is_lost_says_that_its_heading_may_be_any(mode):
    """A start in motion with hard iron of half the level field, seven times what is stated."""
    imu, mag, truth, _ = simulate(
        Tumbling(seed=0, rate_sd=1.5, rest=3.0), 35.0, rate=100.0, seed=0,
        field_world=earth_field(48e-6, np.radians(65)),
        sensors=Sensors(gyr_density=3e-4, acc_density=2e-3, mag_sd=4e-7,
                        mag_offset=(9.5e-6, -2.2e-6, 3e-6)))
    estimator = make({"mode": mode})
    rows = estimator.run(imu[1000:], mag[1000:])
    error = np.degrees(np.linalg.norm(local_errors(rows, truth[1000:]), axis=1))
    assert error.max() > 90.0
    assert "the heading may be any" in estimator.remarks()[-1]
    known = slice(1500 if mode == "causal" else 0, None)    # live it takes some 10 s to show
    assert within_3_sigma(rows[known], truth[1000:][known]) > 0.95
