"""Single wild samples, and sudden motion that looks like them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation.estimator import OrientationEstimator
from imu_fusion.estimation.orientation.rows import FLAG_HELD
from imu_fusion.samples.logs import ImuLog
from test.estimation.orientation.errors import rmse_deg
from test.estimation.orientation.test_estimator import make


def test_single_wild_rates_do_not_turn_the_attitude(ordinary):
    imu, mag, truth, _ = ordinary
    rng = np.random.default_rng(0)
    wild = rng.random(len(imu.stamp)) < 0.005
    wild[:300] = False
    wild[1:] &= ~wild[:-1]
    gyr = imu.gyr.copy()
    gyr[wild] += rng.choice([-1, 1], (wild.sum(), 3)) * rng.uniform(15, 40, (wild.sum(), 3))
    estimator = OrientationEstimator()
    rows = estimator.run(ImuLog(imu.stamp, gyr, imu.acc), mag)
    assert (((rows["flags"] & FLAG_HELD) != 0) == wild).all() and wild.sum() > 20
    assert estimator.summary()["rates_held"] == wild.sum()
    # Each would turn it by 15 to 40 rad/s times 5 ms, 4 to 11 deg.
    assert rmse_deg(rows, truth) < 1.1 * rmse_deg(OrientationEstimator().run(imu, mag), truth)


def test_single_wild_forces_do_not_tilt_the_attitude_and_are_published(ordinary):
    imu, mag, truth, _ = ordinary
    wild = np.arange(400, len(imu.stamp), 301)
    acc = imu.acc.copy()
    acc[wild] += np.random.default_rng(1).choice([-1.0, 1.0], (len(wild), 3)) * 1000.0
    estimator = OrientationEstimator()
    rows = estimator.run(ImuLog(imu.stamp, imu.gyr, acc), mag)
    assert list(np.flatnonzero(rows["flags"] & FLAG_HELD)) == list(wild)
    assert estimator.summary()["forces_held"] == len(wild)
    # Each would push it by 1000 m/s^2 times 5 ms in each axis, 9 m/s.
    assert rmse_deg(rows, truth) < 1.1 * rmse_deg(OrientationEstimator().run(imu, mag), truth)
    assert np.abs(rows["acc"] - acc).max() < 1.0


def test_a_sudden_push_is_motion_and_none_of_it_is_lost():
    """At rest, then at once 400 m/s^2 for 20 ms and back: held for one sample, then made up for."""
    n = 800
    stamp = np.arange(n, dtype=np.int64) * 5_000_000
    force = np.tile([0.0, 0.0, 9.81], (n, 1))
    force[600:604, 0] = 400.0
    estimator = make({"fusion.gyro_factor": 1.0, "fusion.velocity_sd": 100.0})
    rows = estimator.run(ImuLog(stamp, np.zeros((n, 3)), force)[:606])
    assert 600 in np.flatnonzero(rows["flags"] & FLAG_HELD)
    # Trapezoids over 4 samples between two that are still: 4 steps of 2 m/s.
    assert estimator.get_state()["state"][0]["velocity"][0] == pytest.approx(8.0, rel=0.02)


def test_a_sudden_turn_is_motion_and_none_of_it_is_lost():
    """At rest, then at once 20 rad/s for 0.1 s: held for one sample, then made up for."""
    n = 1000
    stamp = np.arange(n, dtype=np.int64) * 5_000_000
    gyr = np.zeros((n, 3))
    gyr[600:620, 2] = 20.0
    force = np.tile([0.0, 0.0, 9.81], (n, 1))
    rows = make({"sensor.gyro_scale_sd": 0.0}).run(ImuLog(stamp, gyr, force))
    held = np.flatnonzero(rows["flags"] & FLAG_HELD)
    assert 600 in held and len(held) <= 2
    yaw = np.unwrap(Rotation.from_quat(rows["quat_world_imu"]).as_euler("ZYX")[:, 0])
    # Trapezoids over 20 samples between two zeros: 20 steps of 0.1 rad.
    assert yaw[-1] - yaw[0] == pytest.approx(2.0, abs=1e-3)
