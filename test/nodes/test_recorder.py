"""The recorder: what it writes, and that nothing written is ever lost."""

import os

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Int64, String

from imu_fusion.errors import BagError, ParameterError
from imu_fusion.nodes.flow import Flow
from imu_fusion.nodes.recorder import Recorder
from imu_fusion.nodes.replayer import Replayer
from imu_fusion.recordings.bag_reader import open_bag
from test.nodes.conftest import START, STEP, write_bag


def contents(path):
    with open_bag(path) as reader:
        return {name: [bytes(m[3]) for m in reader.messages([name])] for name in reader.topics}


def test_replay_recorded_is_the_recording(graph, bag, tmp_path):
    out = tmp_path / "out"
    recorder = graph.start(Recorder, out=str(out), topics=["/imu/data_raw", "/imu/mag"])
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, wait_for_subscribers=0,
                           wait_for_nodes=["recorder"])
    graph.until(lambda: recorder.finished and replayer.finished)
    graph.close(recorder)
    assert contents(out) == contents(bag)
    assert (out / "metadata.yaml").exists() and (out / "out_0.mcap").exists()
    with open_bag(out) as reader:
        assert reader.topics["/imu/mag"].qos_profiles[0]["reliability"] == "reliable"


def test_long_replay_loses_nothing(graph, tmp_path):
    bag = write_bag(tmp_path / "long", 10_000)
    recorder = graph.start(Recorder, out=str(tmp_path / "out"))
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, wait_for_subscribers=0,
                           wait_for_nodes=["recorder"])
    graph.until(lambda: recorder.finished and replayer.finished)
    graph.close(recorder)
    result, expected = contents(tmp_path / "out"), contents(bag)
    assert {k: result[k] for k in expected} == expected


def test_receive_time_and_send_time_are_kept_apart(graph, bag, tmp_path):
    import mcap.reader
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), topics=["/imu/data_raw"])
    graph.start(Replayer, bag=str(bag), rate=0.0, wait_for_subscribers=0,
                wait_for_nodes=["recorder"])
    graph.until(lambda: recorder.finished)
    graph.close(recorder)
    with open(tmp_path / "out" / "out_0.mcap", "rb") as stream:
        rows = [m for _, _, m in mcap.reader.make_reader(stream).iter_messages()]
    assert len(rows) == 200 and [m.sequence for m in rows] == list(range(200))
    assert all(0 < m.log_time - m.publish_time < 60e9 for m in rows)


def test_topics_that_appear_later_and_live_data_until_stopped(graph, tmp_path):
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), regex="/a.*")
    node = graph.node("talker")
    a, b = node.create_publisher(Int64, "/a1", 10), node.create_publisher(Int64, "/b", 10)
    graph.until(lambda: a.get_subscription_count() == 1)
    for i in range(5):
        a.publish(Int64(data=i))
        b.publish(Int64(data=i))
    late = node.create_publisher(String, "/a2", 10)
    graph.until(lambda: late.get_subscription_count() == 1)
    late.publish(String(data="x"))
    graph.until(lambda: recorder._writer.counts["/a1"] == 5 and recorder._writer.counts["/a2"])
    recorder.stop()
    assert recorder.finished
    graph.close(recorder)
    found = contents(tmp_path / "out")
    assert {k: len(v) for k, v in found.items()} == {"/a1": 5, "/a2": 1}


def test_best_effort_and_latched_publishers_are_heard(graph, tmp_path):
    """A reliable subscription would not hear the first, a volatile one not the second."""
    node = graph.node("talker")
    lax = node.create_publisher(
        Int64, "/lax", QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT))
    latched = node.create_publisher(
        Int64, "/latched", QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    latched.publish(Int64(data=7))
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), topics=["/lax", "/latched"])
    graph.until(lambda: lax.get_subscription_count() == 1)
    lax.publish(Int64(data=8))
    counts = recorder._writer.counts
    graph.until(lambda: counts["/lax"] == 1 and counts["/latched"] == 1)
    graph.close(recorder)
    with open_bag(tmp_path / "out") as reader:
        assert reader.topics["/lax"].qos_profiles[0]["reliability"] == "best_effort"
        assert reader.topics["/latched"].qos_profiles[0]["durability"] == "transient_local"


def test_named_topic_that_never_appeared_is_said(graph, tmp_path, capsys):
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), topics=["imu/data"])
    recorder.stop()
    graph.close(recorder)
    assert "/imu/data: never appeared" in capsys.readouterr().err


def test_loop_is_recorded_until_its_end(graph, bag, tmp_path):
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), topics=["/imu/data_raw"])
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, loop=True, topics=["/imu/data_raw"],
                           wait_for_subscribers=0, wait_for_nodes=["recorder"])
    graph.until(lambda: recorder._writer.counts["/imu/data_raw"] > 300)
    replayer.stop()
    graph.until(lambda: recorder.finished and replayer.finished)
    graph.close(recorder)
    assert len(contents(tmp_path / "out")["/imu/data_raw"]) > 300


def test_disk_full_is_said_and_what_was_written_stays(graph, tmp_path):
    """/dev/full is a file on a disk that is full: the second chunk meets it."""
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), topics=["/imu/data_raw"],
                           chunk_size=4096, compression="none")
    pub = graph.node("talker").create_publisher(Imu, "/imu/data_raw", 1000)
    graph.until(lambda: pub.get_subscription_count() == 1)
    for _ in range(30):
        pub.publish(Imu())
    graph.until(lambda: recorder._writer.counts["/imu/data_raw"] == 30)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, recorder._writer._stream.fileno())
    os.close(full)
    for _ in range(30):
        pub.publish(Imu())
    with pytest.raises(BagError, match="No space left on device"):
        graph.until(lambda: recorder._writer.counts["/imu/data_raw"] == 60)
    graph.close(recorder)
    assert len(contents(tmp_path / "out")["/imu/data_raw"]) >= 10


@pytest.mark.parametrize("parameters, error, text", [
    ({}, ParameterError, "no directory given"),
    ({"out": "/proc/nowhere/out"}, BagError, "/proc/nowhere/out: cannot be written"),
    ({"out": "x", "regex": "("}, ParameterError, "not a regular expression"),
    ({"out": "x", "compression": "zip"}, ParameterError, "allowed: one of zstd, lz4, none"),
])
def test_user_errors_name_what_is_wrong(graph, tmp_path, monkeypatch, parameters, error, text):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=text):
        graph.start(Recorder, **parameters)


def test_does_not_overwrite_unless_told(graph, bag):
    with pytest.raises(BagError, match="not empty"):
        graph.start(Recorder, out=str(bag))
    graph.start(Recorder, out=str(bag), overwrite=True)


def test_sim_time_is_the_log_time(graph, bag, tmp_path):
    """Every 4th message has a /clock of its own stamp; none is written at time 0."""
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), topics=["/imu/data_raw"],
                           use_sim_time=True)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.5, duration=0.5, clock=12.5,
                           wait_for_subscribers=0, wait_for_nodes=["recorder"])
    graph.until(lambda: recorder.finished and replayer.finished)
    graph.close(recorder)
    with open_bag(tmp_path / "out") as reader:
        times = [m[2] for m in reader.messages()]
    assert len(times) == 50
    # at the recorded pace a clock of 12.5 Hz is at most a period behind, or a little ahead
    assert all(START <= t < START + 51 * STEP for t in times)
    assert all((t - START) % (4 * STEP) == 0 for t in times)
    assert len(set(times)) > 1


def test_sim_time_without_a_clock_still_finds_topics(graph, tmp_path):
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), use_sim_time=True)
    publisher = graph.node("talker").create_publisher(Int64, "/x", 10)
    graph.until(lambda: publisher.get_subscription_count() == 1)
    assert not recorder.finished


def test_ends_when_an_unrelated_session_ends_last(graph, tmp_path):
    """The session of /b, of which nothing is recorded, ends after the one that counts."""
    recorder = graph.start(Recorder, out=str(tmp_path / "out"), topics=["/a"])
    first, second = (Flow(graph.node(name), listens=False, wait_for=["recorder"])
                     for name in "ab")
    out = first.output(Int64, "/a")
    second.output(Int64, "/b")
    first.source.begin()
    second.source.begin()
    graph.until(lambda: first.source.is_settled() and second.source.is_settled())
    out.publish(Int64(data=1))
    first.source.end()
    graph.until(lambda: recorder.finished)
