"""A clock that is set back, and one that tells a wild time, in the middle of a motion: what is
estimated afterwards is as good as it says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.messages.convert import attitude_log, imu_message, mag_message
from imu_fusion.messages.layouts import IMU
from imu_fusion.samples.guard import Verdict
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from imu_fusion.streams.acceleration_field import AccelerationFieldStream, FieldConfiguration
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


def errors_after_a_restart(found, truth, told):
    """(n,) NEES of the estimates after the last stamp that falls back."""
    # Stamps come twice: the estimates after the jump are the last ones, in order.
    after = int(np.flatnonzero(np.diff(found.stamp) < 0)[-1]) + 1
    rows = np.flatnonzero(np.isin(told, found.stamp[after:]))[-(len(found.stamp) - after):]
    error = (Rotation.from_quat(truth.quat_world_imu[rows]).inv()
             * Rotation.from_quat(found.quat_world_imu[after:])).as_rotvec()
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov_attitude[after:]), error)


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("back", [50, 160, 600])
def test_a_clock_set_back_costs_certainty_not_truth(back, live):
    def change(stamp):
        return stamp - (stamp >= 6_000_000_000) * back * 1_000_000

    stream, found, truth, told = run(change, live)
    assert stream.restarts == 1 and not stream.refused(IMU_TOPIC)
    # Live, what the magnetometer holds back when the Imu has proven the jump is lost.
    assert sum(stream.refused(MAG_TOPIC).values()) <= (2 if live else 0)
    nees = errors_after_a_restart(found, truth, told)
    assert len(nees) > 500 and np.median(nees) < 3 * 3 and nees.max() < 3 * 25


def wild(count, ahead):
    """Stamps of which some are ahead, in ms."""
    def change(stamp):
        stamp = stamp.copy()
        stamp[500:500 + count] += ahead * 1_000_000
        return stamp
    return change


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("ahead", [80, 500, 12 * 365 * 86_400_000])
def test_wild_stamps_cost_their_samples(count, ahead):
    stream, found, _, _ = run(wild(count, ahead))
    assert stream.restarts == 0 and np.all(np.diff(found.stamp) > 0) and len(found) > 1100
    assert stream.refused(IMU_TOPIC) == stream.refused(MAG_TOPIC) == {Verdict.WILD.value: count}


def test_a_burst_of_wild_stamps_is_a_clock_that_was_set_and_costs_certainty_not_truth():
    stream, found, truth, told = run(wild(5, 500))
    assert stream.restarts == 1
    nees = errors_after_a_restart(found, truth, told)
    assert len(nees) > 500 and np.median(nees) < 3 * 3 and nees.max() < 3 * 25


PLACES = {"a": (0.1, 0.0, 0.0), "b": (0.0, 0.1, 0.0), "c": (0.0, 0.0, 0.1), "d": (-0.1, -0.1, 0.0)}


def test_what_was_given_of_the_start_is_not_taken_for_a_clock_that_was_set():
    """A body that spins about the vertical, slows down, and stands still from 3 s on; its clock is
    set back after 2 s."""
    t = np.arange(0.0, 5.0, 0.01)
    spin = np.clip(20.0 - 20.0 * t / 3.0, 0.0, None)
    slowing = np.where(t < 3.0, -20.0 / 3.0, 0.0)
    told = EPOCH + np.round(1e9 * t).astype(np.int64) - 400_000_000 * (t >= 2.0)
    noise = np.random.default_rng(1)
    stream = AccelerationFieldStream(FieldConfiguration.from_mapping({
        "sample_rate": 100.0, "points": [0.0, 0.0, 0.1], "initial.mode": "given",
        "initial.angular_velocity": [0.0, 0.0, 20.0], "accelerometers.names": list(PLACES),
        **{f"accelerometers.{name}.position": place for name, place in PLACES.items()}}))
    topics = {f"accelerometers/{name}": place for name, place in PLACES.items()}
    stream.reset([*topics])
    messages = {}
    for topic, (x, y, _) in topics.items():
        force = np.column_stack([-spin**2 * x - slowing * y, -spin**2 * y + slowing * x,
                                 np.full(len(t), 9.80665)]) + noise.normal(0.0, 0.02, (len(t), 3))
        messages[topic] = [imu_message(s, "body", None, f) for s, f in zip(told.tolist(), force)]
    made = stream.take(messages) + stream.finish()
    stamp, _, values = IMU.decode_many([cdr for m in made for cdr in m.cdrs
                                        if m.topic == "acceleration_field/imu"])
    again = int(np.flatnonzero(np.diff(stamp) < 0)[0]) + 1 if (np.diff(stamp) < 0).any() else 200
    rate = values[:, IMU["angular_velocity"]][:, 2]
    assert rate[:again] == pytest.approx(spin[:again], abs=0.5)
    assert stream.restarts == 1 and 100 < len(stamp) - again <= 210    # as good as still
    assert rate[again:] == pytest.approx(np.zeros(len(stamp) - again), abs=0.5)
