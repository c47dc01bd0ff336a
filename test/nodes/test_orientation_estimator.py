"""The orientation node: equal to batch, live without waiting, controllable, orderly.

Where every sample counts it listens reliably: of a burst, best effort loses what a busy machine
does not take at once.
"""

from importlib.util import find_spec

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistWithCovarianceStamped, Vector3Stamped
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu, MagneticField
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from imu_fusion import batch
from imu_fusion.errors import ParameterError
from imu_fusion.messages.convert import fix_message, imu_message, mag_message
from imu_fusion.messages.layouts import FIX, IMU, MAG, VECTOR3
from imu_fusion.messages.orientation_status import FLAGS_TYPE, flags_value
from imu_fusion.nodes.orientation_estimator import OrientationEstimatorNode
from imu_fusion.nodes.replayer import Replayer
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from imu_fusion.streams.orientation_messages import OUTPUTS as TYPES
from test.layouts import LAYOUTS
from test.nodes.conftest import START, STEP, collector

OUTPUTS = {"/imu/data": Imu, "/imu/rpy/filtered": Vector3Stamped, "/imu/steady_state": Bool,
           "/imu/data_smoothed": Imu, "/imu/flags": DiagnosticArray,
           "/imu/gyro_bias": TwistWithCovarianceStamped}
NOISY = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=(0.01, -0.02, 0.005))


@pytest.fixture(scope="module")
def recording():
    imu, mag, _ = simulate(Tumbling(seed=3), 12.0, rate=200.0, mag_rate=47.0, sensors=NOISY,
                           seed=4)[:3]
    return imu, mag


def write(path, imu, mag, faults=True):
    """The recording with what real ones have: late arrival, repeats, NaN, a clock set back."""
    rows = [(int(s) + 2_000_000, 0, i) for i, s in enumerate(imu.stamp)]
    rows += [(int(s) + 9_000_000, 1, i) for i, s in enumerate(mag.stamp)]
    with BagWriter(path) as writer:
        for log_time, kind, i in sorted(rows):
            if kind == 0:
                stamp, gyr = int(imu.stamp[i]), imu.gyr[i].copy()
                if faults and i == 700:
                    gyr[1] = np.nan
                if faults and i == 900:
                    stamp = int(imu.stamp[899])
                if faults and i >= 1500:
                    stamp -= 3_000_000_000
                cdr = imu_message(stamp, "ball", gyr, imu.acc[i])
                writer.write("/imu/data_raw", IMU.msgtype, cdr, log_time)
            else:
                stamp = int(mag.stamp[i])
                if faults and log_time >= imu.stamp[1500]:
                    stamp -= 3_000_000_000
                writer.write("/imu/mag", MAG.msgtype, mag_message(stamp, "ball", mag.mag[i]),
                             log_time)
    return path


def fields(topic, cdr):
    """All decoded fields of a message, as bytes so that NaN equals itself."""
    msgtype = TYPES[topic.lstrip("/")]
    if msgtype == FLAGS_TYPE:
        return flags_value(bytes(cdr))
    if msgtype not in LAYOUTS:
        return bytes(cdr[4:5])
    stamp, frame_id, values = LAYOUTS[msgtype].decode(cdr)
    return stamp, frame_id, values.tobytes()


@pytest.mark.parametrize("told", [{}, {"lag": 0.4}], ids=["causal", "with a lag"])
def test_nodes_and_batch_give_the_same_fields_bit_for_bit(graph, recording, tmp_path, told):
    bag = write(tmp_path / "bag", *recording)
    params = tmp_path / "params.yaml"
    params.write_text(yaml.safe_dump({"orientation_estimator": {"ros__parameters": told}}))
    batch.process(bag, tmp_path / "out", params)
    sink = collector(graph, topics=OUTPUTS)
    graph.start(OrientationEstimatorNode, qos="reliable", **told)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished and sink.ended)
    with open_bag(tmp_path / "out") as reader:
        for topic in OUTPUTS:
            live = [fields(topic, cdr) for cdr in sink.messages[topic]]
            offline = [fields(topic, m[3]) for m in reader.messages([topic])]
            # Two epochs: in the recording of batch, log times (stamps) interleave.
            assert sorted(live) == sorted(offline), topic
            if topic == "/imu/data":
                assert len(offline) == len(recording[0]) - 2
            if topic == "/imu/data_smoothed":
                assert len(offline) == (len(recording[0]) - 2 if told else 0)


def test_a_gyroscope_alone_gives_orientation_and_says_what_is_absent(graph, recording, tmp_path):
    """No accelerometer, no magnetometer: the turn since the start, in node and batch alike."""
    imu, _ = recording
    with BagWriter(tmp_path / "bag") as writer:
        for stamp, gyr in zip(imu.stamp.tolist(), imu.gyr, strict=True):
            writer.write("/imu/data_raw", IMU.msgtype, imu_message(stamp, "ball", gyr, None), stamp)
    batch.process(tmp_path / "bag", tmp_path / "out")
    sink = collector(graph, topics=OUTPUTS)
    graph.start(OrientationEstimatorNode, qos="reliable")
    replayer = graph.start(Replayer, bag=str(tmp_path / "bag"), rate=0.0)
    graph.until(lambda: replayer.finished and sink.ended)
    with open_bag(tmp_path / "out") as reader:
        offline = [m[3] for m in reader.messages(["/imu/data"])]
    live = [fields("/imu/data", cdr) for cdr in sink.messages["/imu/data"]]
    assert sorted(live) == sorted(fields("/imu/data", cdr) for cdr in offline)
    values = np.array([IMU.decode(cdr)[2] for cdr in offline])
    assert len(values) == len(imu.stamp)
    assert (values[:, IMU["linear_acceleration_covariance"].start] == -1.0).all()
    truth = simulate(Tumbling(seed=3), 12.0, rate=200.0, mag_rate=47.0, sensors=NOISY, seed=4)[2]
    got = Rotation.from_quat(values[:, IMU["orientation"]])
    want = Rotation.from_quat(truth.quat_world_imu)
    turned = (got[0].inv() * got) * (want[0].inv() * want).inv()
    # Noise 3e-4 rad/s/sqrt(Hz) over 12 s is 0.06 deg; bias and scale are those of NOISY.
    assert np.degrees(turned.magnitude()).max() < 5.0


def test_force_that_is_lost_for_a_while_is_no_free_fall(recording, tmp_path):
    imu, mag = recording
    with BagWriter(tmp_path / "bag") as writer:
        for i, stamp in enumerate(imu.stamp.tolist()):
            force = None if 1000 <= i < 1400 and i % 2 else imu.acc[i]
            writer.write("/imu/data_raw", IMU.msgtype,
                         imu_message(stamp, "ball", imu.gyr[i], force), stamp)
    batch.process(tmp_path / "bag", tmp_path / "out")
    with open_bag(tmp_path / "out") as reader:
        assert reader.topics["/imu/data"].count == len(imu.stamp) - 200


def test_another_pass_gives_the_same_again(graph, recording, tmp_path):
    bag = write(tmp_path / "bag", *recording, faults=False)
    sink = collector(graph, topics={"/imu/data": Imu})
    graph.start(OrientationEstimatorNode, qos="reliable")
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, loop=True)
    graph.until(lambda: len(sink.ended) >= 2)
    replayer.stop()
    graph.until(lambda: replayer.finished)
    n = len(recording[0])
    first, second = sink.messages["/imu/data"][:n], sink.messages["/imu/data"][n:2 * n]
    assert [fields("/imu/data", c) for c in first] == [fields("/imu/data", c) for c in second]


def test_live_answers_every_imu_without_waiting_for_the_magnetometer(graph, recording):
    imu, _ = recording
    node = graph.node("driver")
    raw = node.create_publisher(Imu, "/imu/data_raw", 1000)
    node.create_publisher(MagneticField, "/imu/mag", 1000)  # says nothing
    graph.start(OrientationEstimatorNode, qos="reliable")
    heard = []
    node.create_subscription(Imu, "/imu/data", heard.append, 1000)
    graph.until(lambda: raw.get_subscription_count() == 1)
    for i in range(500):
        raw.publish(imu_message(int(imu.stamp[i]), "ball", imu.gyr[i], imu.acc[i]))
        graph.executor.spin_once(timeout_sec=0)
    graph.until(lambda: len(heard) == 500)
    assert heard[-1].header.frame_id == "ball"
    stamp = heard[-1].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == imu.stamp[499]


def test_reset_service_starts_anew(graph, recording):
    imu, _ = recording
    node = graph.node("driver")
    raw = node.create_publisher(Imu, "/imu/data_raw", 1000)
    estimator = graph.start(OrientationEstimatorNode, qos="reliable")
    graph.until(lambda: raw.get_subscription_count() == 1)
    for i in range(400):
        raw.publish(imu_message(int(imu.stamp[i]), "ball", imu.gyr[i], imu.acc[i]))
    summary = estimator._stream.estimator.summary
    graph.until(lambda: summary()["imu_used"] == 400)
    response = graph.call(node, Trigger, "/orientation_estimator/reset")
    assert response.success and response.message
    assert summary()["imu_used"] == 0 and not summary()["aligned"]


def test_diagnostics_say_what_was_left_out(graph, recording):
    imu, _ = recording
    node = graph.node("driver")
    raw = node.create_publisher(Imu, "/imu/data_raw", 1000)
    said = []
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: said.extend(m.status), 10)
    graph.start(OrientationEstimatorNode, qos="reliable")
    graph.until(lambda: raw.get_subscription_count() == 1)
    for i in (0, 1, 1, 2):
        raw.publish(imu_message(int(imu.stamp[i]), "ball", imu.gyr[i], imu.acc[i]))

    def told():
        return any({v.key: v.value for v in s.values}.get("imu/data_raw repeated stamp") == "1"
                   for s in said if s.name == "orientation_estimator: samples")
    graph.until(told)


@pytest.mark.parametrize("parameters, words", [
    (dict(method="magic"), "'method'.*'magic'"), (dict(nosie=1.0), "unknown parameter 'nosie'"),
    ({"sensor.mag_noise_sd": -1.0}, "'sensor.mag_noise_sd'.*out of bounds"),
])
def test_bad_parameters_are_refused_by_name(graph, parameters, words):
    with pytest.raises(ParameterError, match=words):
        graph.start(OrientationEstimatorNode, **parameters)


def test_the_first_fix_turns_magnetic_into_true_north_in_nodes_and_batch(graph, tmp_path):
    """At rest, x to magnetic east. Winkler had magnetic north 2.1 deg east of north in Davos in
    January 2013; it has drifted by 0.18 deg a year: 4.05 deg in November 2023 (Innsbruck lies
    1.5 deg further east: 0.1 deg more or less). So x points south of east: negative yaw."""
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        for i in range(400):
            stamp = START + i * STEP
            writer.write("/imu/data_raw", IMU.msgtype,
                         imu_message(stamp, "ball", [0, 0, 0], [0, 0, 9.81]), stamp)
            writer.write("/imu/mag", MAG.msgtype, mag_message(stamp, "ball", [0, 2e-5, -4e-5]),
                         stamp)
            if i >= 300 and i % 20 == 0:
                writer.write("/fix", FIX.msgtype,
                             fix_message(stamp, "gnss", 47.26, 11.39, 600.0), stamp)
    batch.process(bag, tmp_path / "out", without=["smoother"])
    with open_bag(tmp_path / "out") as reader:
        offline = [fields("/imu/data", m[3]) for m in reader.messages(["/imu/data"])]
        yaw = [VECTOR3.decode(m[3])[2][2] for m in reader.messages(["/imu/rpy/filtered"])]
    assert yaw[299] == pytest.approx(0.0, abs=1e-6)
    assert np.degrees(yaw[300]) == pytest.approx(-4.05, abs=0.2)
    sink = collector(graph, topics={"/imu/data": Imu})
    graph.start(OrientationEstimatorNode, qos="reliable")
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished and sink.ended)
    assert [fields("/imu/data", cdr) for cdr in sink.messages["/imu/data"]] == offline


def still(graph, node_options=None, count=300):
    """A node that has heard a still sensor, x to magnetic east; (node, client, publish)."""
    node = graph.node("driver")
    raw = node.create_publisher(Imu, "/imu/data_raw", 1000)
    mag = node.create_publisher(MagneticField, "/imu/mag", 1000)
    estimator = graph.start(OrientationEstimatorNode, qos="reliable", **(node_options or {}))
    graph.until(lambda: raw.get_subscription_count() and mag.get_subscription_count())
    sent = [0]

    def publish(n):
        for i in range(sent[0], sent[0] + n):
            mag.publish(mag_message(START + i * STEP, "ball", [0, 2e-5, -4e-5]))
            raw.publish(imu_message(START + i * STEP, "ball", [0, 0, 0], [0, 0, 9.81]))
        sent[0] += n
        graph.until(lambda: estimator._stream.estimator.summary()["imu_used"] == sent[0])
    publish(count)
    return estimator, node, publish


def test_set_heading_turns_what_is_published(graph):
    _, node, publish = still(graph, dict(heading_deg=30.0))
    heard = []
    node.create_subscription(Vector3Stamped, "/imu/rpy/filtered", heard.append, 1000)
    assert graph.call(node, Trigger, "/orientation_estimator/set_heading").success
    publish(100)
    graph.until(lambda: heard and abs(np.degrees(heard[-1].vector.z) - 30.0) < 0.1)


def test_set_heading_before_any_orientation_is_refused(graph):
    node = graph.node("driver")
    graph.start(OrientationEstimatorNode)
    response = graph.call(node, Trigger, "/orientation_estimator/set_heading")
    assert not response.success and "no orientation yet" in response.message


def test_calibration_is_refused_without_turning(graph):
    _, node, _ = still(graph)
    response = graph.call(node, Trigger, "/orientation_estimator/calibrate_magnetometer")
    assert not response.success and "samples" in response.message


def test_calibration_answers_as_yaml_and_is_used(graph, recording):
    """Hard iron of 10 uT is found by turning, to the noise of 0.3 uT."""
    imu, mag = recording
    node = graph.node("driver")
    raw = node.create_publisher(MagneticField, "/imu/mag", 5000)
    estimator = graph.start(OrientationEstimatorNode, qos="reliable")
    graph.until(raw.get_subscription_count)
    for i in range(len(mag)):
        raw.publish(mag_message(int(mag.stamp[i]), "ball", mag.mag[i] + [1e-5, 0.0, -5e-6]))
    graph.until(lambda: sum(
        estimator._stream.guards["imu/mag"].counts.values()) == len(mag))
    response = graph.call(node, Trigger, "/orientation_estimator/calibrate_magnetometer")
    assert response.success, response.message
    found = yaml.safe_load(response.message)
    assert found["sensor.mag_offset"] == pytest.approx([1e-5, 0.0, -5e-6], abs=1e-6)
    assert estimator._stream.estimator.params.sensor.mag_offset == tuple(
        found["sensor.mag_offset"])


def test_gravity_is_removed_when_asked(graph):
    _, node, publish = still(graph, dict(remove_gravity_vector=True))
    heard = []
    node.create_subscription(Imu, "/imu/data", heard.append, 1000)
    graph.until(lambda: node.count_subscribers("/imu/data"))
    publish(50)
    graph.until(lambda: heard)
    assert heard[-1].linear_acceleration.z == pytest.approx(9.81 - 9.80665, abs=1e-2)


def test_bias_estimation_is_switched_at_run_time_and_method_is_not(graph):
    estimator, _, publish = still(graph)
    off, = estimator.set_parameters([Parameter("fusion.estimate_bias", value=False)])
    assert off.successful and not estimator._stream.estimator.params.fusion.estimate_bias
    publish(10)
    other, = estimator.set_parameters([Parameter("method", value="gyro_mag")])
    assert not other.successful


@pytest.mark.skipif(find_spec("tf2_msgs") is not None, reason="tf2_msgs is installed")
def test_without_tf2_the_wish_for_transforms_is_refused_by_name(graph):
    with pytest.raises(ParameterError, match="publish_tf.*tf2_msgs"):
        graph.start(OrientationEstimatorNode, publish_tf=True)
