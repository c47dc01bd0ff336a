"""After a gap in which a tumbling body may have turned anywhere, what is stated says so."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation.estimator import OrientationEstimator
from imu_fusion.estimation.orientation.lost_turn import unseen_turn
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.messages.convert import imu_message
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.streams.orientation import IMU_TOPIC, OrientationStream

RATE, GAP = 100, (4.0, 4.5)
FIELD = np.array([0.0, 21e-6, -43e-6])
PARAMS = OrientationParams().replace(**{
    "mode": "smoothed", "fusion.use_acc": False, "gap.rate_sd": 5.0, "sensor.gyro_range": (50.0,)})


@pytest.fixture(scope="module")
def tumbling():
    """Two seconds of rest, six of tumbling, half a second of them missing: logs, attitudes, s."""
    rng = np.random.default_rng(3)
    time = np.arange(8 * RATE) / RATE
    rate = 4.0 * np.clip(time - 2.0, 0.0, 1.0)[:, None] * np.column_stack(
        [np.sin(time), np.cos(0.7 * time), 0.5 + 0.0 * time])
    turn, quat = Rotation.from_euler("xyz", [0.2, 0.1, 1.0]), []
    for step in Rotation.from_rotvec(rate / RATE):
        quat.append(turn.as_quat())
        turn = turn * step
    body = Rotation.from_quat(quat).inv()
    stamp = 10**18 + np.round(time * 1e9).astype(np.int64)
    kept = (time < GAP[0]) | (time >= GAP[1])
    noise = rng.standard_normal((3, len(time), 3))
    imu = ImuLog(stamp, rate + 2e-3 * noise[0], body.apply([0.0, 0.0, 9.81]) + 0.02 * noise[1])
    mag = MagLog(stamp, body.apply(FIELD) + 1e-7 * noise[2])
    return imu[kept], mag[kept], np.array(quat)[kept], time[kept]


def run(params, tumbling):
    imu, mag, quat, _ = tumbling
    rows = OrientationEstimator(params).run(imu, mag)
    found = Rotation.from_quat(rows["quat_world_imu"])
    return (found.inv() * Rotation.from_quat(quat)).magnitude(), rows["cov_attitude"]


def test_the_turn_about_the_field_is_unknown_from_the_gap_on(tumbling):
    error, cov = run(PARAMS, tumbling)
    after = tumbling[3] > GAP[1] - 1e-6
    sd = np.sqrt(np.trace(cov, axis1=1, axis2=2))
    assert np.degrees(sd[~after].max()) < 30.0 and (error[~after] < 3.0 * sd[~after]).all()
    assert np.degrees(sd[after].min()) > 90.0 and (error[after] < 3.0 * sd[after]).all()
    # Only about the field: across it the field still tells.
    smallest = np.linalg.eigvalsh(cov[after])[:, 0]
    assert np.degrees(np.sqrt(smallest.max())) < 10.0


def test_it_is_known_with_gravity_and_after_shorter_gaps(tumbling):
    after = tumbling[3] > GAP[1] - 1e-6
    _, cov = run(PARAMS.replace(**{"fusion.use_acc": True}), tumbling)
    assert np.degrees(np.sqrt(np.trace(cov[after], axis1=1, axis2=2)).max()) < 90.0
    assert unseen_turn(PARAMS, 0.05) == 0.0 == unseen_turn(PARAMS, 2.0)
    assert unseen_turn(PARAMS, 0.5) == 2.5


def test_a_body_that_goes_on_in_motion_without_forces_has_no_attitude(tumbling):
    """After a gap in which all starts anew: the force of a body in motion passed for gravity, 28
    deg stated at 120 deg of error."""
    params = PARAMS.replace(**{"gap.restart": 0.3})
    error, cov = run(params, tumbling)
    after = tumbling[3] > GAP[1] - 1e-6
    sd = np.sqrt(np.trace(cov, axis1=1, axis2=2))
    assert np.degrees(sd[~after].max()) < 30.0
    assert np.degrees(sd[after].min()) > 150.0 and (error[after] < 3.0 * sd[after]).all()
    estimator = OrientationEstimator(params)
    estimator.run(*tumbling[:2])
    assert any("nothing shows the vertical" in text for text in estimator.remarks())
    # At rest, or with gravity, there is something to begin with.
    for known in (PARAMS, params.replace(**{"fusion.use_acc": True})):
        estimator = OrientationEstimator(known)
        estimator.run(*tumbling[:2])
        assert not any("nothing shows" in text for text in estimator.remarks())


def test_the_stream_says_that_all_starts_anew():
    said = []
    stream = OrientationStream(PARAMS, warn=said.append)
    for start in (0, 3000, 6000):
        stream.take({IMU_TOPIC: [imu_message(10**18 + (start + k) * 10**6, "imu", (0, 0, 0),
                                             (0, 0, 9.8)) for k in range(0, 100, 10)]})
    assert sum("all starts anew" in text for text in said) == 1


def test_the_stream_says_it_once():
    said = []
    stream = OrientationStream(PARAMS, warn=said.append)
    for start in (0, 500, 1000):
        stream.take({IMU_TOPIC: [imu_message(10**18 + (start + k) * 10**6, "imu", (0, 0, 0),
                                             (0, 0, 9.8)) for k in range(0, 100, 10)]})
    assert sum("may have turned by 2" in text for text in said) == 1
