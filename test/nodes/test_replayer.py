"""The replayer: what it plays, at which pace, to whom, and how it is controlled."""

import math
import time

import pytest
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, MagneticField
from std_srvs.srv import Trigger

from imu_fusion.errors import BagError, ParameterError, TopicError
from imu_fusion.nodes.flow import END, NEXT
from imu_fusion.nodes.flow.state import MARK
from imu_fusion.nodes.orientation_estimator import OrientationEstimatorNode
from imu_fusion.nodes.replayer import Replayer
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from test.nodes.conftest import START, STEP, collector, write_bag

IMU, MAG = "/imu/data_raw", "/imu/mag"
BOTH = {IMU: Imu, MAG: MagneticField}


def stored(bag, topic):
    with open_bag(bag) as reader:
        return [bytes(m[3]) for m in reader.messages([topic])]


def since_begin(replayer, sink):
    """When messages were published, in ns since the first one was due."""
    begin, _ = replayer._anchor
    begin = time.time_ns() - round((time.monotonic() - begin) * 1e9)
    return [info["source_timestamp"] - begin for info in sink.infos[IMU]]


def test_rate_zero_delivers_the_stored_bytes_and_ends_by_itself(graph, bag):
    sink = collector(graph, topics=BOTH)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0)
    graph.until(lambda: replayer.finished)
    assert sink.messages[IMU] == stored(bag, IMU)
    assert sink.messages[MAG] == stored(bag, MAG)
    assert sink.ended == [END]


def test_rate_zero_loses_nothing_with_a_slow_consumer(graph, tmp_path):
    """The consumer takes nothing until its queue is full and the replayer shut."""
    bag = write_bag(tmp_path / "long", 4000)
    sink = collector(graph)
    sink.takes = False
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, topics=[IMU])
    out, = replayer._outputs.values()
    graph.until(lambda: out.sent >= 1000 and not out.is_open())
    assert "/collector" in replayer._source.waiting_for()
    sink.takes = True
    graph.until(lambda: replayer.finished)
    assert sink.messages[IMU] == stored(bag, IMU)


def test_pace_follows_log_time(graph, bag):
    """100 messages at 10 ms, 4 times as fast: the last is due 0.2475 s after the first."""
    sink = collector(graph)
    replayer = graph.start(Replayer, bag=str(bag), rate=4.0, duration=1.0, topics=[IMU])
    graph.until(lambda: replayer.finished)
    times = since_begin(replayer, sink)
    assert len(times) == 100
    # never early; how late depends on the machine
    assert all(t > i * STEP / 4 - 5e6 for i, t in enumerate(times))


def test_rate_can_be_changed_while_playing(graph, bag):
    """At a hundredth of the pace the 2 s would last 200 s."""
    sink = collector(graph)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.01)
    graph.until(lambda: sink.messages[IMU])
    assert replayer.set_parameters([Parameter("rate", value=0.0)])[0].successful
    graph.until(lambda: replayer.finished)
    assert sink.messages[IMU] == stored(bag, IMU)


def test_start_offset_and_duration_select_by_log_time(graph, bag):
    sink = collector(graph)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, start_offset=0.5, duration=0.3)
    graph.until(lambda: replayer.finished)
    assert sink.messages[IMU] == stored(bag, IMU)[50:80]


def test_topics_exclude_and_remap(graph, bag):
    sink = collector(graph, topics={"/renamed": MagneticField, IMU: Imu})
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, topics=["imu/*"],
                           exclude=["*/data_raw"], remap=["imu/mag:=/renamed"])
    graph.until(lambda: replayer.finished)
    assert sink.messages["/renamed"] == stored(bag, MAG) and not sink.messages[IMU]


def test_loop_plays_again_in_a_session_of_its_own(graph, bag):
    sink = collector(graph)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, loop=True, topics=[IMU])
    graph.until(lambda: len(sink.ended) >= 2)
    replayer.stop()
    graph.until(lambda: replayer.finished)
    assert sink.messages[IMU][:400] == stored(bag, IMU) * 2
    assert sink.ended[:2] == [NEXT, NEXT] and sink.ended[-1] == END


def test_seek_begins_a_session_there(graph, bag):
    """Backwards, to the same place again, and forwards; the pause lasts through it."""
    sink, user = collector(graph), graph.node("user")
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, start_paused=True, topics=[IMU])
    all_of_it, seen = stored(bag, IMU), []
    for seek, first in ((None, 0), (0.5, 50), (0.0, 0), (0.0, 0), (1.9, 190)):
        if seek is not None:
            assert replayer.set_parameters([Parameter("seek", value=seek)])[0].successful
            graph.until(lambda n=len(seen): len(sink.ended) == n)
        graph.until(lambda: graph.call(user, Trigger, "/replayer/step").success)
        seen.append(all_of_it[first])
        graph.until(lambda: sink.messages[IMU] == seen)
    assert math.isnan(replayer.get_parameter("seek").value)
    graph.call(user, Trigger, "/replayer/resume")
    graph.until(lambda: replayer.finished)
    assert sink.messages[IMU] == seen + all_of_it[191:]
    assert sink.ended == [NEXT, NEXT, NEXT, NEXT, END]


@pytest.mark.parametrize("seek, text", [(1.5, "not in what is played, 0.5 to 1 s"),
                                        (0.0, "not in what is played"), (-2.0, "at least 0")])
def test_seek_out_of_what_is_played_is_refused(graph, bag, seek, text):
    replayer = graph.start(Replayer, bag=str(bag), start_offset=0.5, duration=0.5)
    answer, = replayer.set_parameters([Parameter("seek", value=seek)])
    assert not answer.successful and text in answer.reason


def test_estimators_start_anew_where_a_seek_leads(graph, bag):
    """Half of it, and then all: the same estimates again."""
    sink = collector(graph, topics={"/imu/data": Imu})
    graph.start(OrientationEstimatorNode)
    replayer = graph.start(Replayer, bag=str(bag), rate=1.0,
                           wait_for_nodes=["collector", "orientation_estimator"])
    made = sink.messages["/imu/data"]
    graph.until(lambda: len(made) > 100)
    for parameter in (Parameter("seek", value=0.0), Parameter("rate", value=0.0)):
        assert replayer.set_parameters([parameter])[0].successful
    graph.until(lambda: replayer.finished and sink.ended[-1] == END)
    again = made[-len(stored(bag, IMU)):]
    before = made[:-len(again)]
    assert 100 < len(before) < 200 and before == again[:len(before)]
    assert sink.ended == [NEXT, END]


def test_pause_step_and_resume(graph, bag):
    sink = collector(graph)
    user = graph.node("user")
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, start_paused=True, topics=[IMU])
    graph.until(lambda: graph.call(user, Trigger, "/replayer/step").success)
    graph.until(lambda: len(sink.messages[IMU]) == 1)
    assert graph.call(user, Trigger, "/replayer/step").success
    graph.until(lambda: len(sink.messages[IMU]) == 2)
    assert graph.call(user, Trigger, "/replayer/pause").success
    assert len(sink.messages[IMU]) == 2
    assert graph.call(user, Trigger, "/replayer/resume").success
    graph.until(lambda: replayer.finished)
    assert sink.messages[IMU] == stored(bag, IMU)


def test_step_while_playing_is_refused_with_the_reason(graph, bag):
    collector(graph)
    user = graph.node("user")
    graph.start(Replayer, bag=str(bag), rate=0.01)
    answer = graph.call(user, Trigger, "/replayer/step")
    assert not answer.success and "not paused" in answer.message


def test_clock_only_when_asked(graph, bag):
    clocks = []
    graph.node("watch").create_subscription(Clock, "/clock", lambda m: clocks.append(
        m.clock.sec * 10**9 + m.clock.nanosec), 100)
    collector(graph)
    first = graph.start(Replayer, bag=str(bag), rate=20.0, topics=[IMU])
    graph.until(lambda: first.finished)
    graph.remove(first)
    assert not clocks
    second = graph.start(Replayer, bag=str(bag), rate=20.0, topics=[IMU], clock=200.0,
                         start_paused=True)
    graph.until(lambda: second.count_subscribers("/clock"))
    graph.call(graph.node("user"), Trigger, "/replayer/resume")
    graph.until(lambda: second.finished and clocks)
    # 200 Hz of real time at 20 times the pace: every 0.1 s of recorded time
    assert all((b - a) % (10 * STEP) == 0 for a, b in zip(clocks, clocks[1:]))
    assert clocks[0] >= START and clocks[-1] < START + 200 * STEP


def test_foreign_subscribers_are_served_at_the_pace_given_for_them(graph, bag):
    """They cannot acknowledge. 1 s of data at 5 times the pace lasts 0.2 s, not nothing."""
    got = []
    graph.node("stranger").create_subscription(
        Imu, IMU, lambda m: got.append(m.linear_acceleration.x), 200)  # room: no flow control
    sink = collector(graph)
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, foreign_rate=5.0, duration=1.0,
                           topics=[IMU], wait_for_subscribers=2)
    graph.until(lambda: replayer.finished and len(got) == 100)
    assert got == list(range(100))
    assert since_begin(replayer, sink)[-1] > 99 * STEP / 5 - 5e6


def test_waits_for_subscribers_and_gives_up_with_a_reason(graph, bag):
    replayer = graph.start(Replayer, bag=str(bag), wait_timeout=0.2)
    with pytest.raises(TopicError, match="1 more subscribers of /imu/data_raw.*wait_for_subscr"):
        graph.until(lambda: replayer.finished)
    assert replayer._outputs[IMU].sent == 0


def test_without_subscribers_when_none_are_asked_for(graph, bag, capsys):
    replayer = graph.start(Replayer, bag=str(bag), rate=0.0, wait_for_subscribers=0)
    graph.until(lambda: replayer.finished)
    graph.close(replayer)
    assert "/imu/data_raw: 200 messages to nobody" in capsys.readouterr().err


def test_types_that_are_not_installed_are_left_out_with_a_warning(graph, tmp_path):
    definition = ("int32 a\n", "RIHS01_" + "0" * 64)
    with BagWriter(tmp_path / "b") as writer:
        for i in range(3):
            writer.write("/x", "nowhere_msgs/msg/Thing", b"\0\1\0\0\1\0\0\0", START + i,
                         definition=definition)
    looker = graph.node("looker")
    with pytest.raises(TopicError, match="nowhere_msgs/msg/Thing is not installed"):
        graph.start(Replayer, bag=str(tmp_path / "b"), topics=["/x"])
    with pytest.raises(TopicError, match="nothing to play") as refused:
        graph.start(Replayer, bag=str(tmp_path / "b"))
    # Nothing of it stays in the graph, even while the error holds on to the node.
    assert refused.tb and looker.get_node_names() == ["looker"]
    assert not any(MARK in topic for topic, _ in looker.get_topic_names_and_types())


@pytest.mark.parametrize("parameters, error, text", [
    ({}, ParameterError, "no recording given"),
    ({"bag": "/nowhere"}, BagError, "/nowhere"),
    ({"topics": ["/imu/dat"]}, TopicError, "no topic '/imu/dat'; it has: /imu/data_raw"),
    ({"remap": ["imu/data_raw"]}, ParameterError, "not recorded:=published"),
    ({"remap": ["imu/x:=y"]}, TopicError, "no topic 'imu/x'"),
    ({"start_offset": 7.0}, ParameterError, "beyond the end"),
    ({"rate": -1.0}, ParameterError, "'rate'.*-1.0 is out of bounds; allowed: at least 0"),
    ({"rate": "fast"}, ParameterError, "'rate'.*'fast' is not a number"),
    ({"rte": 1.0}, ParameterError, "unknown parameter 'rte'.*known:.*rate"),
])
def test_user_errors_name_what_is_wrong(graph, bag, parameters, error, text):
    given = {"bag": str(bag), **parameters} if parameters else {}
    with pytest.raises(error, match=text):
        graph.start(Replayer, **given)
