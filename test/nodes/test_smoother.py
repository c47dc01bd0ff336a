"""The smoother node: collects, smooths in a child, answers, equals batch."""

import importlib.util
from typing import ClassVar

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from imu_fusion import batch
from imu_fusion.errors import EstimationError, LayoutError, ParameterError
from imu_fusion.messages.convert import fix_message, imu_message, velocity_message
from imu_fusion.messages.layouts import FIX, IMU, TWIST
from imu_fusion.nodes import smoother
from imu_fusion.nodes.flow import END
from imu_fusion.nodes.replayer import Replayer
from imu_fusion.nodes.smoother import SmootherNode
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.streams.smoother import SmootherStream, smooth
from imu_fusion.streams.smoother_messages import OUTPUTS, RESULTS_TOPIC, Outcome, results_value
from test.layouts import LAYOUTS
from test.nodes.conftest import START, STEP, collector

TOPICS = {"/smoother/odometry": Odometry, "/smoother/imu": Imu, "/smoother/fix": NavSatFix,
          "/smoother/pose": PoseWithCovarianceStamped, "/smoother/path": Path,
          "/smoother/results": DiagnosticArray}


def write(path, count=600, without_fixes=range(0), broken=(), set_back=None):
    """Standing still at Innsbruck for two seconds, then off to the east at 1 m/s^2.

    without_fixes: numbers of Imu samples beside which there is no fix. broken: of those whose
    message has 60 bytes. set_back: that from which on the clock is behind by an hour.
    """
    rng = np.random.default_rng(5)
    with BagWriter(path) as writer:
        for i in range(count):
            at = START + i * STEP
            stamp = at - (3600 * 10**9 if set_back is not None and i >= set_back else 0)
            t = max(0.0, (i - 200) * STEP * 1e-9)
            noise = rng.normal(0, 0.01, 3)
            force = [1.0 if t else 0.0, 0.0, 9.805]
            cdr = imu_message(stamp, "car", 0.001 * noise, force + noise)
            writer.write("/imu/data_raw", IMU.msgtype, cdr[:60] if i in broken else cdr, at)
            if i % 10 == 0 and i not in without_fixes:
                east = 0.5 * t * t
                writer.write("/fix", FIX.msgtype, fix_message(
                    stamp, "gnss", 47.26, 11.39 + np.degrees(east / (6388e3 * np.cos(0.8248))),
                    600.0, np.eye(3)), at)
                writer.write("/fix_velocity", TWIST.msgtype, velocity_message(
                    stamp, "world", [t, 0.0, 0.0], 0.01 * np.eye(3)), at)
    return path


def fields(topic, cdr):
    if topic == f"/{RESULTS_TOPIC}":
        return results_value(cdr)
    layout = LAYOUTS.get(OUTPUTS[topic.lstrip("/")])
    if layout is None:
        return bytes(cdr)  # a Path has no padding: strings end on the boundary of stamps
    stamp, frame_id, values = layout.decode(cdr)
    return stamp, frame_id, values.tobytes()


def test_service_smooths_what_was_played_and_equals_batch(graph, tmp_path):
    # The last fix comes after a pause: it waits for one after it, which does not come.
    bag = write(tmp_path / "bag", without_fixes=range(250, 590))
    reports, _ = batch.process(bag, tmp_path / "out", without=["orientation_estimator"])
    sink = collector(graph, topics=TOPICS)
    graph.start(SmootherNode, qos="reliable")
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished)
    node = graph.node("client")
    response = graph.call(node, Trigger, "/smoother/smooth", timeout=120.0)
    assert response.success, response.message
    (report,) = [r for r in reports if r.node == "smoother"]
    assert response.message == report.summary
    graph.until(lambda: sink.ended)
    with open_bag(tmp_path / "out") as reader:
        for topic in TOPICS:
            assert [fields(topic, c) for c in sink.messages[topic]] == [
                fields(topic, m[3]) for m in reader.messages([topic])], topic
    # It did go east: the last odometry is at 0.5 * 3.99^2 m.
    values = LAYOUTS["nav_msgs/msg/Odometry"].decode(sink.messages["/smoother/odometry"][-1])[2]
    assert values[0] == pytest.approx(0.5 * 3.99 ** 2, abs=0.5)


def test_of_a_replay_whose_clock_is_set_back_the_longest_stretch_is_collected(graph, tmp_path):
    """As in batch: live it would be the last one."""
    bag = write(tmp_path / "bag", set_back=400)
    node = graph.start(SmootherNode, qos="reliable")
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished)
    imu = node._stream.logs()["imu/data_raw"]
    assert len(imu) == 400 and imu.stamp[0] == START


class Here:
    """Stands for the process that smooths, which takes seconds: what it would answer, made once."""

    answers: ClassVar[list] = []

    def __init__(self, params, logs):
        if not self.answers:
            result = smooth(params, logs)
            self.answers.append((result.samples, Outcome.of(result, "car")))

    def is_done(self):
        return True

    def result(self):
        return self.answers[0]

    def close(self):
        pass


def test_who_comes_late_gets_all_of_the_last_result_and_nothing_else(
        graph, tmp_path, monkeypatch):
    """Volatile and latched subscribers there before, a latched one and a sink after two runs."""
    monkeypatch.setattr(smoother, "_Child", Here)
    bag = write(tmp_path / "bag", count=1500)
    collects = graph.start(SmootherNode, qos="reliable")
    early = graph.node("early")
    stamps = {"early": [], "late": []}

    def listen(node, name, durability):
        node.create_subscription(
            Odometry, "/smoother/odometry",
            lambda m: stamps[name].append(m.header.stamp.sec * 10**9 + m.header.stamp.nanosec),
            QoSProfile(depth=5000, durability=durability,
                       reliability=ReliabilityPolicy.RELIABLE))

    listen(early, "early", DurabilityPolicy.VOLATILE)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished)
    node = graph.node("client")
    for run in (1, 2):
        assert graph.call(node, Trigger, "/smoother/smooth", timeout=120.0).success
        graph.until(lambda: collects._messages is collects._result is None)
        graph.until(lambda: len(stamps["early"]) == run * 1500)
    late = graph.node("late")
    listen(late, "late", DurabilityPolicy.TRANSIENT_LOCAL)
    graph.until(lambda: len(stamps["late"]) >= 1500)
    assert stamps["late"] == [START + i * STEP for i in range(1500)]
    # A sink that takes the next session gets that one alone, once.
    sink = collector(graph, topics={"/smoother/odometry": Odometry})
    assert graph.call(node, Trigger, "/smoother/smooth", timeout=120.0).success
    graph.until(lambda: sink.ended)
    assert len(sink.messages["/smoother/odometry"]) == 1500 and sink.ended == [END]
    assert not sink.flow.problems and not collects.problems


def test_transforms_without_tf2_are_refused_with_the_parameter_s_name(graph):
    if importlib.util.find_spec("tf2_msgs"):
        pytest.skip("tf2_msgs is installed here")
    with pytest.raises(ParameterError, match="publish_tf.*tf2_msgs"):
        graph.start(SmootherNode, publish_tf=True)


def test_a_bad_surface_ends_the_node_at_its_start(graph):
    with pytest.raises(LayoutError, match="nowhere"):
        graph.start(SmootherNode, **{"surface.file": "nowhere"})


def test_without_samples_the_answer_is_no_with_the_reason(graph):
    graph.start(SmootherNode)
    response = graph.call(graph.node("client"), Trigger, "/smoother/smooth")
    assert not response.success and "no samples on imu/data_raw and fix" in response.message


def test_a_second_call_is_refused_and_clear_empties(graph, tmp_path):
    bag = write(tmp_path / "bag", broken=[300])
    smoother = graph.start(SmootherNode, qos="reliable")
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished)
    node = graph.node("client")
    client = node.create_client(Trigger, "/smoother/smooth")
    graph.until(client.service_is_ready)
    first, second = client.call_async(Trigger.Request()), client.call_async(Trigger.Request())
    graph.until(second.done)
    assert not second.result().success and "already running" in second.result().message
    graph.until(first.done, 120.0)
    assert first.result().success
    left_out = "imu/data_raw: 1 samples left out: cannot be decoded"    # as of every door
    assert left_out in first.result().message and left_out in smoother._left_out()
    assert smoother._stream.counts()["imu/data_raw"] == 599
    assert graph.call(node, Trigger, "/smoother/clear").success
    assert smoother._stream.counts()["imu/data_raw"] == 0


def test_collection_is_bounded_and_says_so():
    said = []
    stream = SmootherStream(limit=56 * 10, warn=said.append)
    for first in (0, 9):
        stream.take({"imu/data_raw": [
            imu_message(START + i * STEP, "car", [0, 0, 0], [0, 0, 9])
            for i in range(first, first + 9 - first // 3)]})
    assert stream.counts()["imu/data_raw"] == 10 and stream.dropped == 5
    assert len(said) == 1 and "memory_limit" in said[0]
    with pytest.raises(EstimationError, match="5 samples were dropped"):
        stream.logs()


def test_a_clock_set_back_drops_what_was_before_it():
    stream = SmootherStream()
    stream.take({"fix": [fix_message(11 * 10**9, "gnss", 47.0, 11.0, 600.0)]})
    stream.take({"imu/data_raw": [imu_message(stamp * 10**9, "car", [0, 0, 0], [0, 0, 9])
                                  for stamp in (10, 11, 12, 3, 4, 5)]})
    assert stream.counts() == {"imu/data_raw": 3, "imu/mag": 0, "fix": 0, "fix_velocity": 0}
    with pytest.raises(EstimationError, match="no samples on fix since the clock was set back"):
        stream.logs()
    stream.take({"fix": [fix_message(4 * 10**9, "gnss", 47.0, 11.0, 600.0)]})
    assert list(stream.logs()["imu/data_raw"].stamp) == [3 * 10**9, 4 * 10**9, 5 * 10**9]
