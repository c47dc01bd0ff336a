"""A clock that is set back, and one that tells a wild time, in the middle of a motion: what is
estimated afterwards is as good as it says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.messages.convert import attitude_log, imu_message, mag_message
from imu_fusion.samples.guard import Verdict
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from imu_fusion.streams.orientation import OrientationStream
from imu_fusion.streams.orientation_messages import ORIENTATION_TOPIC
from imu_fusion.streams.stream import IMU_TOPIC, MAG_TOPIC

EPOCH = 1_700_000_000_000_000_000
SENSORS = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7)


def run(change, live=False):
    """The stream, its estimates, the truth and the stamps of the Imu; ``change`` maps the true
    stamps of a topic to those told. live: sample by sample, outside of a session."""
    imu, mag, truth, _ = simulate(Tumbling(seed=3), 12.0, rate=100.0, mag_rate=100.0,
                                  sensors=SENSORS, seed=4)
    stream = OrientationStream()
    stream.reset(None if live else [IMU_TOPIC, MAG_TOPIC])
    told = {topic: EPOCH + change(log.stamp) for topic, log in ((IMU_TOPIC, imu), (MAG_TOPIC, mag))}
    messages = {
        IMU_TOPIC: [imu_message(s, "ball", g, a)
                    for s, g, a in zip(told[IMU_TOPIC].tolist(), imu.gyr, imu.acc)],
        MAG_TOPIC: [mag_message(s, "ball", m)
                    for s, m in zip(told[MAG_TOPIC].tolist(), mag.mag)]}
    if live:
        made = [m for pair in zip(*messages.values()) for topic, cdr in zip(messages, pair)
                for m in stream.take({topic: [cdr]})]
    else:
        made = stream.take(messages)
    made += stream.finish()
    found = attitude_log([cdr for m in made if m.topic == ORIENTATION_TOPIC for cdr in m.cdrs])
    return stream, found, truth, told[IMU_TOPIC]


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("back", [50, 160, 600])
def test_a_clock_set_back_costs_certainty_not_truth(back, live):
    def change(stamp):
        return stamp - (stamp >= 6_000_000_000) * back * 1_000_000

    stream, found, truth, told = run(change, live)
    assert stream.restarts == 1 and not stream.refused(IMU_TOPIC)
    # Live, what the magnetometer holds back when the Imu has proven the jump is lost.
    assert sum(stream.refused(MAG_TOPIC).values()) <= (2 if live else 0)
    # Stamps come twice: the estimates after the jump are the last ones, in order.
    after = int(np.flatnonzero(np.diff(found.stamp) < 0)[-1]) + 1
    stamps = told[600:]
    rows = np.flatnonzero(np.isin(stamps, found.stamp[after:])) + 600
    error = (Rotation.from_quat(truth.quat_world_imu[rows]).inv()
             * Rotation.from_quat(found.quat_world_imu[after:])).as_rotvec()
    cov = found.cov_attitude[after:]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    assert len(rows) > 500 and np.median(nees) < 3 * 3 and nees.max() < 3 * 25


def test_a_wild_stamp_costs_one_sample():
    def change(stamp):
        stamp = stamp.copy()
        stamp[500] += 12 * 365 * 86_400_000_000_000
        return stamp

    stream, found, _, _ = run(change)
    assert stream.restarts == 0 and np.all(np.diff(found.stamp) > 0) and len(found) > 1100
    assert stream.refused(IMU_TOPIC) == stream.refused(MAG_TOPIC) == {Verdict.WILD.value: 1}
