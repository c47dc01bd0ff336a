"""The pipeline: replay, smooth, record; as nodes on one executor and as processes."""

import json
import os
import subprocess
import sys

import pytest
from rclpy.parameter import Parameter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from imu_fusion import batch
from imu_fusion.errors import EstimationError, LayoutError, TopicError
from imu_fusion.messages.convert import fix_message, imu_message
from imu_fusion.messages.layouts import FIX, IMU
from imu_fusion.messages.typestore import TYPES
from imu_fusion.nodes.pipeline import plan_pipeline, run_pipeline
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.nodes.recorder import Recorder
from imu_fusion.nodes.replayer import Replayer
from imu_fusion.nodes.smoother import SmootherNode
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.streams.smoother_messages import RESULTS_TOPIC, results_value
from test.layouts import LAYOUTS
from test.nodes.conftest import START, STEP, write_bag
from test.nodes.test_smoother import write
from test.test_bags import ROOT


def fields(path, topics):
    """topic -> decoded messages: CDR padding is undefined, so bytes are not compared."""
    with open_bag(path) as reader:
        found = {topic: [] for topic in topics}
        for topic, msgtype, _, cdr in reader.messages(topics):
            layout = LAYOUTS.get(msgtype)
            if topic == f"/{RESULTS_TOPIC}":
                found[topic].append(results_value(cdr))
            elif layout is None:
                found[topic].append(bytes(cdr))
            else:
                stamp, frame_id, values = layout.decode(cdr)
                found[topic].append((stamp, frame_id, values.tobytes()))
        return found


def assert_same(processed, recorded, topics):
    expected, found = fields(processed, topics), fields(recorded, topics)
    assert all(expected.values())
    assert found == expected


def start(graph, bag, out, expected=("smoother",)):
    recorder = graph.start(Recorder, out=str(out), expected_sources=list(expected))
    smoother = graph.start(SmootherNode, qos="reliable", smooth_at_end=True)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, wait_for_subscribers=0,
                           wait_for_nodes=["recorder", "smoother"])
    return recorder, smoother, replayer


def test_recording_holds_all_of_the_smoother_as_batch_writes_it(graph, tmp_path):
    bag, out = write(tmp_path / "bag", 400), tmp_path / "out"
    reports, _ = batch.process(bag, tmp_path / "batch", without=["orientation_estimator"])
    recorder, _, replayer = start(graph, bag, out)
    graph.until(lambda: replayer.finished)
    assert not recorder.finished  # the smoother has not even begun
    graph.close(replayer)
    graph.until(lambda: recorder.finished, timeout=120.0)
    graph.close(recorder)
    assert_same(tmp_path / "batch", out, ["/smoother/odometry", "/smoother/imu", "/smoother/fix",
                                          "/smoother/path", "/smoother/results"])
    assert_same(bag, out, ["/imu/data_raw", "/fix", "/fix_velocity"])


def test_a_refusal_of_the_smoother_is_an_error_with_its_reason(graph, tmp_path):
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:  # fixes without a fix
        for i in range(50):
            stamp = START + i * STEP
            writer.write("/imu/data_raw", IMU.msgtype,
                         imu_message(stamp, "car", (0, 0, 0), (0, 0, 9.8)), stamp)
            writer.write("/fix", FIX.msgtype,
                         fix_message(stamp, "gnss", 47.0, 11.0, 600.0, status=-1), stamp)
    _, _, replayer = start(graph, bag, tmp_path / "out")
    graph.until(lambda: replayer.finished)
    graph.close(replayer)
    with pytest.raises(EstimationError, match="not smoothed: no valid GNSS fix"):
        graph.until(lambda: False, timeout=120.0)


def test_a_replay_that_breaks_off_is_not_smoothed(graph, tmp_path):
    _, smoother, replayer = start(graph, write(tmp_path / "bag", 400), tmp_path / "out")
    replayer.set_parameters([Parameter("rate", value=0.1)])
    graph.until(lambda: smoother._stream.counts()["imu/data_raw"])
    graph.remove(replayer)
    with pytest.raises(EstimationError, match="not smoothed: the replay of /replayer broke off"):
        graph.until(lambda: False)


def test_a_replay_without_fixes_is_refused_when_it_begins(graph, tmp_path):
    start(graph, write_bag(tmp_path / "bag", 20), tmp_path / "out")
    with pytest.raises(TopicError, match="/replayer plays no fix"):
        graph.until(lambda: False)


def test_a_recording_without_fixes_is_refused_before_anything_starts(tmp_path):
    with pytest.raises(TopicError, match="nothing to smooth: no messages on 'fix'"):
        run_pipeline(write_bag(tmp_path / "bag", 20), tmp_path / "out")


def test_a_bad_surface_is_refused_before_anything_starts(tmp_path):
    params, out = tmp_path / "params.yaml", tmp_path / "out"
    params.write_text("smoother: {ros__parameters: {surface: {file: nowhere}}}")
    bag = write(tmp_path / "bag", 20)
    for call in (run_pipeline, batch.process):
        with pytest.raises(LayoutError, match="nowhere"):
            call(bag, out, params)
        assert not out.exists()


def as_ros1(path, messages):
    noetic = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        connections = {}
        for i, (topic, msgtype, log_time, cdr) in enumerate(messages):
            message = TYPES.deserialize_cdr(bytes(cdr), msgtype)
            message.header = noetic.types["std_msgs/msg/Header"](
                seq=i, stamp=message.header.stamp, frame_id=message.header.frame_id)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=noetic)
            writer.write(connections[topic], log_time, noetic.serialize_ros1(message, msgtype))
    return path


def as_ros2(path, messages, plugin):
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, msgtype, log_time, cdr in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=TYPES)
            writer.write(connections[topic], log_time, bytes(cdr))
    return path


def play(bag, out, logs):
    """The recording of `imu_fusion play` through the orientation estimator."""
    with NodeProcesses(logs) as nodes:
        nodes.start("recorder", out=str(out))
        nodes.start("orientation_estimator", qos="reliable")
        subprocess.run(
            [sys.executable, "-m", "imu_fusion.cli", "play", str(bag), "--rate", "0", "--wait-for",
             "recorder", "--wait-for", "orientation_estimator"], check=True, timeout=120,
            env=os.environ | {"ROS_DOMAIN_ID": str(nodes.domain)})
        nodes.wait("recorder", 60)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["mcap", "db3", "ROS 1"])
def test_each_format_gives_what_process_gives(tmp_path, form):
    """Played, and through the pipeline; against what `process` makes of it as we write it."""
    original = write(tmp_path / "original", 400)
    with open_bag(original) as reader:
        if form == "ROS 1":
            bag = as_ros1(tmp_path / "foreign.bag", reader.messages())
        else:
            bag = as_ros2(tmp_path / "foreign", reader.messages(), {
                "mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}[form])
    batch.process(original, tmp_path / "batch")
    batch.process(bag, tmp_path / "again")
    play(bag, tmp_path / "played", tmp_path / "logs")
    run_pipeline(bag, tmp_path / "smoothed", show=False)
    orientation = ["/imu/data", "/imu/rpy/filtered", "/imu/gyro_bias"]
    smoothed = ["/smoother/odometry", "/smoother/imu", "/smoother/fix", "/smoother/path",
                "/smoother/results"]
    assert_same(tmp_path / "batch", tmp_path / "again", orientation + smoothed)
    assert_same(tmp_path / "batch", tmp_path / "played", orientation)
    assert_same(tmp_path / "batch", tmp_path / "smoothed", orientation + smoothed)
    for out in ("played", "smoothed"):
        assert_same(original, tmp_path / out, ["/imu/data_raw", "/fix", "/fix_velocity"])


@pytest.mark.slow
def test_processes_record_what_batch_writes(tmp_path):
    """Renamed topics and old estimates in the recording included."""
    bag, out = tmp_path / "bag", tmp_path / "out"
    with open_bag(write(tmp_path / "plain", 400)) as reader, BagWriter(bag) as writer:
        for topic, msgtype, log_time, cdr in reader.messages():
            writer.write({"/fix": "/gps/fix"}.get(topic, topic), msgtype, cdr, log_time)
            if topic == "/imu/data_raw":
                writer.write("/imu/data", msgtype, cdr, log_time)
    batch.process(bag, tmp_path / "batch", remap={"fix": "/gps/fix"})
    run_pipeline(bag, out, remap={"fix": "/gps/fix"}, show=False)
    assert_same(tmp_path / "batch", out, ["/imu/data", "/smoother/odometry", "/smoother/imu",
                                          "/smoother/fix", "/smoother/path",
                                          "/smoother/results"])
    found = [json.loads((path / "results.json").read_text())["smoother"]
             for path in (tmp_path / "batch", out)]
    assert found[0] == found[1] and found[0]["samples"] == 400 and found[0]["remarks"] == []


def test_estimators_whose_topics_are_not_recorded_take_no_part():
    plan = plan_pipeline(ROOT / "bags" / "jump_simulated")
    assert plan.estimators == ["orientation_estimator", "smoother"]
