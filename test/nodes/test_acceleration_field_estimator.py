"""The acceleration field node: equal to batch, tolerant of faults, controllable."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import AccelWithCovarianceStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, PointCloud2
from std_srvs.srv import Trigger

from imu_fusion import batch
from imu_fusion.errors import ParameterError, TopicError
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import ACCEL, IMU
from imu_fusion.nodes.acceleration_field_estimator import AccelerationFieldEstimatorNode
from imu_fusion.nodes.replayer import Replayer
from imu_fusion.parameters.declare import flatten
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate
from imu_fusion.streams.acceleration_field import OUTPUTS as TYPES
from test.layouts import LAYOUTS
from test.nodes.conftest import collector

PRESET = Path(__file__).parents[2] / "config" / "head_four_accelerometers.yaml"
NAMES = ("top", "left", "front", "back")
OUTPUTS = {"/acceleration_field/imu": Imu,
           "/acceleration_field/accel": AccelWithCovarianceStamped,
           "/acceleration_field/points": PointCloud2}
GIVEN = {"initial.mode": "given", "initial.angular_velocity": [5.0, 5.0, 5.0], "gravity": 9.8}


def parameters(**changes):
    values = flatten(yaml.safe_load(PRESET.read_text())["acceleration_field_estimator"][
        "ros__parameters"])
    return {**values, **GIVEN, **changes}


def start(graph, **changes):
    return graph.start(AccelerationFieldEstimatorNode, **parameters(**changes))


@pytest.fixture(scope="module")
def motion():
    return simulate(duration=0.6)


def write(path, motion, faults=True):
    """A recording with late, missing, repeated and slightly shifted samples."""
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    rows = []
    for n, stamp in enumerate(motion.stamp):
        for k, name in enumerate(NAMES):
            log_time = int(stamp) + 1000 * k + (3_000_000 if faults and k == 2 else 0)
            if faults and (n, k) == (100, 1):
                continue
            # The back sensor's clock is 20 us late: within the tolerance.
            rows.append((log_time, name, int(stamp) + 20_000 * (k == 3), readings[n, k]))
            if faults and (n, k) == (200, 3):
                rows.append((log_time + 10, name, int(stamp) + 20_000, readings[n, k]))
    with BagWriter(path) as writer:
        for log_time, name, stamp, acc in sorted(rows, key=lambda r: r[0]):
            writer.write(f"/accelerometers/{name}", IMU.msgtype,
                         imu_message(stamp, name, None, acc), log_time)
    return path


def params_file(path, **changes):
    path.write_text(yaml.safe_dump(
        {"acceleration_field_estimator": {"ros__parameters": parameters(**changes)}}))
    return path


def fields(topic, cdr):
    msgtype = TYPES[topic.lstrip("/")]
    if msgtype in LAYOUTS:
        stamp, frame_id, values = LAYOUTS[msgtype].decode(cdr)
        return stamp, frame_id, values.tobytes()
    cloud = deserialize_message(bytes(cdr), PointCloud2)
    return (cloud.header.stamp.sec, cloud.header.stamp.nanosec, bytes(cloud.data),
            tuple(f.name for f in cloud.fields))


@pytest.mark.parametrize("change", [{}, {"mode": "smoothed"}, {"method": "ao"}],
                         ids=["causal", "smoothed", "ao"])
def test_nodes_and_batch_give_the_same_fields_bit_for_bit(graph, motion, tmp_path, change):
    bag = write(tmp_path / "bag", motion)
    reports, _ = batch.process(bag, tmp_path / "out", params_file(tmp_path / "p.yaml", **change))
    (report,) = [r for r in reports if not r.skipped]
    assert report.refused == {"accelerometers/back": {"repeated stamp": 1}}
    sink = collector(graph, topics=OUTPUTS)
    start(graph, qos="reliable", **change)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished and sink.ended)
    with open_bag(tmp_path / "out") as reader:
        for topic in OUTPUTS:
            live = [fields(topic, cdr) for cdr in sink.messages[topic]]
            offline = [fields(topic, m[3]) for m in reader.messages([topic])]
            assert len(offline) == len(motion.t) and live == offline, topic


def test_what_is_published_is_the_motion(graph, motion, tmp_path):
    bag = write(tmp_path / "bag", motion, faults=False)
    batch.process(bag, tmp_path / "out", params_file(tmp_path / "p.yaml"))
    with open_bag(tmp_path / "out") as reader:
        accel = ACCEL.decode_many([m[3] for m in reader.messages(["/acceleration_field/accel"])])[2]
        imu = IMU.decode_many([m[3] for m in reader.messages(["/acceleration_field/imu"])])[2]
        clouds = [deserialize_message(bytes(m[3]), PointCloud2)
                  for m in reader.messages(["/acceleration_field/points"])]
    peak = np.abs(motion.acc_origin).max()
    # Exact readings, sensors with 0.5 m/s^2 of possible bias: a part in a thousand.
    assert np.abs(accel[:, ACCEL["linear"]] - motion.acc_origin).max() < 2e-3 * peak
    assert np.abs(imu[:, IMU["angular_velocity"]] - motion.omega).max() < 0.05
    assert np.abs(imu[:, IMU["linear_acceleration"]]
                  - motion.specific_force_body([0, 0, 0])).max() < 2e-3 * peak
    field = np.frombuffer(bytes(clouds[550].data), "<f4").reshape(-1, 7)
    assert [f.name for f in clouds[550].fields] == ["x", "y", "z", "ax", "ay", "az", "magnitude"]
    assert np.allclose(field[1, :3], [0, 0, 0.67])
    truth = motion.acceleration_body([0, 0, 0.67])[550]
    assert np.allclose(field[1, 3:6], truth, atol=2e-3 * peak)
    assert field[1, 6] == pytest.approx(np.linalg.norm(truth), abs=2e-3 * peak)
    assert clouds[550].header.frame_id == "body"


def test_batch_measures_impacts(motion, tmp_path):
    bag = write(tmp_path / "bag", motion, faults=False)
    file = params_file(tmp_path / "p.yaml", **{"impact.trigger": 20.0})
    batch.process(bag, tmp_path / "out", file)
    found = json.loads((tmp_path / "out" / "results.json").read_text())
    impacts = found["acceleration_field_estimator"]["impacts"]
    assert [i["point"][2] for i in impacts] == [0.75, 0.67]
    truth = np.linalg.norm(motion.acceleration_body([0, 0, 0.75]), axis=1).max()
    assert impacts[0]["peak_linear_acceleration"] == pytest.approx(truth, rel=2e-3)


def test_below_the_trigger_the_peaks_are_there_with_a_hint(motion, tmp_path):
    bag = write(tmp_path / "bag", motion, faults=False)
    file = params_file(tmp_path / "p.yaml", **{"impact.trigger": 5000.0})
    (report,) = [r for r in batch.process(bag, tmp_path / "out", file)[0] if not r.skipped]
    found = json.loads((tmp_path / "out" / "results.json").read_text())[report.node]
    assert "impacts" not in found and "impact.trigger is 5e+03" in report.remarks[-1]
    size = np.linalg.norm(motion.acceleration_body([0, 0, 0.75]), axis=1)
    peaks = found["peaks"]
    assert peaks["peak_linear_acceleration"][0] == pytest.approx(size.max(), rel=2e-3)
    assert peaks["stamp"][0] == motion.stamp[size.argmax()]
    assert found["units"]["peak_linear_acceleration"] == "m/s^2"


def test_a_channel_class_that_the_rate_cannot_carry_is_refused_ahead(motion, tmp_path):
    bag = write(tmp_path / "bag", motion, faults=False)
    file = params_file(tmp_path / "p.yaml", **{"impact.linear_class": 1000, "sample_rate": 1000.0})
    said = []
    with pytest.raises(ParameterError, match=r"'impact.linear_class': CFC 1000 .* 1000 Hz is too"):
        batch.process(bag, tmp_path / "out", file, progress=said.append)
    assert not said    # nothing was read


def test_live_rows_leave_when_complete(graph, motion):
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    node = graph.node("driver")
    publishers = [node.create_publisher(Imu, f"/accelerometers/{name}", 1000) for name in NAMES]
    estimator = start(graph)
    heard = []
    node.create_subscription(Imu, "/acceleration_field/imu", heard.append, 1000)
    graph.until(lambda: all(p.get_subscription_count() == 1 for p in publishers))
    for n in range(50):
        for k, publisher in enumerate(publishers):
            publisher.publish(imu_message(int(motion.stamp[n]), NAMES[k], None, readings[n, k]))
        graph.executor.spin_once(timeout_sec=0)
    graph.until(lambda: len(heard) == 50)
    assert estimator.summary()["incomplete"] == 0
    assert float(estimator.summary()["condition number"]) < 10
    response = graph.call(node, Trigger, "/acceleration_field_estimator/reset")
    assert response.success and not estimator._stream.estimator.get_state()["filter"]
    response = graph.call(node, Trigger, "/acceleration_field_estimator/smooth")
    assert not response.success and "causal" in response.message


def test_smooth_service_publishes_what_is_held(graph, motion):
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    node = graph.node("driver")
    publishers = [node.create_publisher(Imu, f"/accelerometers/{name}", 1000) for name in NAMES]
    estimator = start(graph, mode="smoothed")
    heard = []
    node.create_subscription(Imu, "/acceleration_field/imu", heard.append, 1000)
    graph.until(lambda: all(p.get_subscription_count() == 1 for p in publishers))
    for n in range(40):
        for k, publisher in enumerate(publishers):
            publisher.publish(imu_message(int(motion.stamp[n]), NAMES[k], None, readings[n, k]))
        graph.executor.spin_once(timeout_sec=0)
    graph.until(lambda: sum(map(len, estimator._stream.estimator.get_state()["stamps"])) == 40)
    assert not heard
    response = graph.call(node, Trigger, "/acceleration_field_estimator/smooth")
    assert response.success and response.message.startswith("40 ")
    graph.until(lambda: len(heard) == 40)


def test_wrong_parameters_are_refused_by_name(graph, motion, tmp_path):
    with pytest.raises(ParameterError, match="noise_densty"):
        start(graph, **{"accelerometers.top.noise_densty": 1.0})
    with pytest.raises(ParameterError, match="accelerometers.bottom"):
        start(graph, **{"accelerometers.bottom.range": 1.0})
    bag = write(tmp_path / "bag", motion)
    with pytest.raises(TopicError, match="accelerometers.names"):
        batch.process(bag, tmp_path / "out")
