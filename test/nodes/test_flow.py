"""Sessions between nodes of this process; see imu_fusion/nodes/flow."""

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int64, String

from imu_fusion.nodes.flow import END, NEXT, sink, source
from imu_fusion.nodes.flow.qos import sensor_qos, session_qos
from imu_fusion.nodes.flow.source import WINDOW, Output
from test.nodes.flow_parts import Doubler, Part, Receiver, Sender, twice


def test_more_than_any_queue_holds_arrives_complete_and_in_order(graph):
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    sender.session(20_000)
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == list(range(20_000))
    assert sender.source.report() == {"/numbers": (20_000, {"/receiver": 0})}
    assert not receiver.flow.problems and not sender.flow.problems


def test_sender_stops_while_a_sink_takes_nothing(graph):
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    receiver.takes = False
    sender.session(9000)
    graph.until(lambda: sender.out.sent >= 1000 and not sender.out.is_open())
    assert sender.out.sent <= 1000 + WINDOW  # what a queue holds (fastdds.xml), and the window
    assert "/receiver" in sender.source.waiting_for()
    receiver.takes = True
    graph.until(lambda: receiver.ended)
    assert receiver.values == list(range(9000))


def test_back_pressure_and_end_pass_through_processing_nodes(graph):
    receiver, doubler = Receiver(graph, topic="/doubled"), Doubler(graph)
    sender = Sender(graph, wait_for=["doubler", "receiver"])
    receiver.takes = False
    sender.session(12_000)
    graph.until(lambda: not sender.out.is_open() and doubler.out.waiting and sender.out.sent)
    assert sender.out.sent < 12_000
    receiver.takes = True
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == twice(12_000)
    assert doubler.ended == ["/numbers"] and doubler.finishes == 1
    assert doubler.most <= WINDOW + 2 * sink.AT_ONCE + 1  # a window, and what one turn makes


def test_a_chain_of_processing_nodes_is_ready_and_ends_as_one(graph):
    receiver = Receiver(graph, topic="/twice")
    sender = Sender(graph, wait_for=["first", "second"])
    graph.until(lambda: sender.flow.peers)
    sender.session(3000)
    graph.until(lambda: "/first" in sender.source.waiting_for())
    first, second = Doubler(graph, "first"), Doubler(graph, "second", ("/doubled",), "/twice")
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == [*[i for i in range(3000) for _ in range(4)], *3 * [999_999]]
    assert first.finishes == second.finishes == 1
    for part in (receiver, first, second, sender):
        assert not part.flow.problems


def test_node_between_ends_only_when_all_its_sources_have_ended(graph):
    receiver = Receiver(graph, topic="/doubled")
    doubler = Doubler(graph, inputs=("/a", "/b"))
    a = Sender(graph, "a", "/a", wait_for=["doubler"])
    b = Sender(graph, "b", "/b", wait_for=["doubler"])
    b.session(5, event=None)
    graph.until(lambda: b.out.sent == 5)
    a.session(10)
    graph.until(lambda: doubler.ended == ["/a"])
    b.source.end(END)
    graph.until(lambda: receiver.ended)
    assert doubler.ended == ["/a", "/b"] and doubler.finishes == 1
    assert doubler.begun == [["/b"], ["/a", "/b"]]
    assert len(receiver.values) == 2 * 15 + 1
    graph.until(lambda: a.source.drained() and b.source.drained())


def test_next_session_resets_and_its_messages_do_not_mix_with_the_last(graph):
    receiver, doubler = Receiver(graph, topic="/doubled"), Doubler(graph)
    sender = Sender(graph, wait_for=["doubler", "receiver"])
    sender.session(300, event=NEXT)
    graph.until(sender.source.drained)
    sender.session(200)
    graph.until(lambda: len(receiver.ended) == 2)
    assert receiver.values == twice(300) + twice(200)
    assert receiver.ended == [NEXT, END]
    assert doubler.begun == [["/numbers"], ["/numbers"]] and doubler.finishes == 2


def test_short_sessions_one_after_the_other_with_new_receivers_lose_nothing(graph):
    """The processing node lives on; names of receivers and senders come back each time."""
    doubler = Doubler(graph)
    for count in (30, 1, 200, 0, 3000, 7):
        receiver = Receiver(graph, topic="/doubled")
        sender = Sender(graph, wait_for=["receiver", "doubler"])
        sender.session(count)
        graph.until(lambda r=receiver, s=sender: r.ended and s.source.drained())
        assert receiver.values == twice(count)
        assert not receiver.flow.problems and not sender.flow.problems
        for part in (receiver, sender):
            part.flow.close()
            graph.remove(part.node)
    assert not doubler.flow.problems


def test_a_promise_of_another_session_lasts_until_that_begins(graph):
    """The sender says other things in between, and never that the last session goes on."""
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    sender.session(10, event=NEXT)
    graph.until(lambda: receiver.ended and sender.source.drained())
    sender.flow.peers.say()
    peer = receiver.flow.peers[sender.flow.peers.own]
    graph.until(lambda: not peer.state.sending.session)
    assert receiver.flow.sink.promised()
    sender.session(10)
    graph.until(lambda: receiver.ended == [NEXT, END])
    assert not receiver.flow.sink.promised()


def test_foreign_subscriber_is_named_and_never_waited_for(graph):
    stranger = graph.node("stranger")
    stranger.create_subscription(Int64, "/numbers", lambda m: None, 10)
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    graph.until(lambda: sender.out.matched() == 2)
    sender.session(2000)
    graph.until(lambda: receiver.ended)
    assert sender.source.foreign == {"/numbers": ["/stranger"]}
    assert receiver.values == list(range(2000))


def test_subscribers_that_can_never_be_matched_are_not_waited_for(graph):
    """Of another type, or asking for what was sent before they came."""
    elsewhere = rclpy.Context()    # one participant has one type for a topic
    rclpy.init(context=elsewhere)
    other, late = rclpy.create_node("other", context=elsewhere), graph.node("late")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    other.create_subscription(String, "/numbers", lambda message: None, 10)
    late.create_subscription(Int64, "/numbers", lambda message: None, latched)
    receiver, sender = Receiver(graph), Sender(graph)
    try:
        graph.until(lambda: sender.node.count_subscribers("/numbers") == 3)
        sender.session(3)
        graph.until(lambda: receiver.ended)
    finally:
        other.destroy_node()
        rclpy.shutdown(context=elsewhere)
    assert receiver.values == [0, 1, 2]
    assert sender.source.foreign == {"/numbers": ["/late", "/other"]}


def test_a_subscriber_that_stays_unmatched_keeps_a_session_for_a_while_only(graph, monkeypatch):
    """It suits by its QoS, and the middleware does not join them: e.g. of another partition."""
    receiver, sender = Receiver(graph), Sender(graph)
    stranger = graph.node("stranger")
    stranger.create_subscription(Int64, "/numbers", lambda message: None, 10)
    matched = Output.matched
    monkeypatch.setattr(Output, "matched", lambda output: matched(output) - 1)
    monkeypatch.setattr(source, "MATCHING", 1e9)
    graph.until(lambda: sender.node.count_subscribers("/numbers") == 2)
    sender.session(3)
    graph.until(lambda: sender.source.phase and not sender.source._is_settling())
    turns = iter(range(20))    # in which it would begin
    graph.until(lambda: next(turns, None) is None)
    assert sender.out.sent == 0
    monkeypatch.setattr(source, "MATCHING", 0.0)
    graph.until(lambda: receiver.ended)
    assert receiver.values == [0, 1, 2]


def test_foreign_subscriber_that_takes_nothing_does_not_stop_a_session(graph):
    """Its queue is full after 1000 messages; then it acknowledges no more, for ever."""
    stranger = rclpy.create_node("stranger")  # no executor: it never takes
    stranger.create_subscription(Int64, "/numbers", lambda m: None, session_qos())
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    graph.until(lambda: sender.out.matched() == 2)
    sender.session(2000)
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == list(range(2000))
    assert not sender.flow.problems and not receiver.flow.problems
    stranger.destroy_node()


def test_second_publisher_is_named_counted_and_stops_nothing(graph, capfd):
    driver = graph.node("driver")
    other = driver.create_publisher(Int64, "/numbers", 10)
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    graph.until(lambda: other.get_subscription_count() == 1)
    sender.session(20_000)
    graph.until(lambda: len(receiver.values) > 100)
    graph.until(lambda: other.get_subscription_count() == 1)
    for i in range(5):
        other.publish(Int64(data=-1 - i))
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert [v for v in receiver.values if v >= 0] == list(range(20_000))
    assert [v for v in receiver.values if v < 0] == [-1, -2, -3, -4, -5]
    assert receiver.input.unexpected == 5 and not receiver.input.lost
    problem, = receiver.flow.problems
    assert "5 messages more than the 20000" in problem
    assert "driver publishes /numbers beside /sender" in capfd.readouterr().err


def test_transforms_of_others_are_counted_and_no_fault(graph, capfd):
    driver = graph.node("driver")
    other = driver.create_publisher(Int64, "/tf", 10)
    receiver = Receiver(graph, topic="/tf")
    sender = Sender(graph, topic="/tf", wait_for=["receiver"])
    sender.session(100, event=None)
    graph.until(lambda: len(receiver.values) == 100 and other.get_subscription_count() == 1)
    other.publish(Int64(data=-1))
    graph.until(lambda: -1 in receiver.values)
    sender.event = END
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.input.unexpected == 1
    assert not receiver.flow.problems and "driver" not in capfd.readouterr().err


def test_without_a_session_messages_flow_unacknowledged(graph):
    receiver, sender = Receiver(graph), Sender(graph)
    graph.until(lambda: sender.out.matched() == 1)
    for i in range(10):
        assert sender.source.ready()
        sender.out.publish(Int64(data=i))
    graph.until(lambda: len(receiver.values) == 10)
    assert not receiver.input.sessions


def test_loss_is_counted_and_the_session_still_ends(graph, monkeypatch):
    """A lossy link: the receiver is handed every third message only."""
    monkeypatch.setattr(sink, "SILENCE", 0.5)
    receiver = Receiver(graph)
    sender = Sender(graph, wait_for=["receiver"])
    take, handed = receiver.input.take, [0]

    def lossy():
        messages = take()
        first = -handed[0] % 3
        handed[0] += len(messages)
        return messages[first::3]

    receiver.input.take = lossy
    sender.session(99)
    graph.until(lambda: receiver.ended)
    assert receiver.values == list(range(0, 99, 3))
    assert receiver.input.lost == 66
    assert receiver.flow.problems == ["/numbers: 66 of 99 messages LOST"]
    graph.until(sender.source.drained)
    assert sender.source.report()["/numbers"] == (99, {"/receiver": 66})
    assert sender.flow.problems == ["/receiver lost 66 of /numbers"]


def test_sink_that_takes_nothing_answers_and_is_not_waited_for_at_the_end(graph):
    Receiver(graph, "idle", "/other")
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver", "idle"])
    sender.session(10)
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert sender.source.report() == {"/numbers": (10, {"/receiver": 0})}


def test_remapped_names_are_those_of_the_graph(graph):
    """Both ends speak of resolved names: a remapped sink is known to take the topic."""
    node = graph.add(rclpy.create_node("remapped", cli_args=[
        "--ros-args", "-r", "/private:=/numbers", "-r", "__ns:=/deep"]))
    graph.node = lambda name: node
    remapped = Receiver(graph, topic="/private")
    del graph.node
    sender = Sender(graph, wait_for=["/deep/remapped"])
    sender.session(10)
    graph.until(sender.source.drained)
    assert remapped.input.topic == "/numbers" and len(remapped.values) == 10
    assert sender.source.report() == {"/numbers": (10, {"/deep/remapped": 0})}


def test_best_effort_sink_listens_reliably_during_a_session_and_only_then(graph):
    """A driver that offers best effort is heard before and after; a replay loses nothing."""
    receiver = Receiver(graph, qos=sensor_qos())
    driver = graph.node("driver").create_publisher(
        Int64, "/numbers", QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    graph.until(lambda: driver.get_subscription_count() == 1)
    driver.publish(Int64(data=-1))
    graph.until(lambda: receiver.values == [-1])
    sender = Sender(graph, wait_for=["receiver"])
    sender.session(20_000)
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == [-1, *range(20_000)]
    assert receiver.input.lost == receiver.input.missed == 0
    graph.until(lambda: driver.get_subscription_count() == 1)
    driver.publish(Int64(data=-2))
    graph.until(lambda: receiver.values[-1] == -2)


def test_best_effort_sink_hears_a_loop_without_gaps(graph):
    receiver = Receiver(graph, qos=sensor_qos())
    sender = Sender(graph, wait_for=["receiver"])
    for event in (NEXT, NEXT, END):
        sender.session(300, event=event)
        graph.until(sender.source.drained)
    assert receiver.values == 3 * list(range(300)) and receiver.ended == [NEXT, NEXT, END]


def test_large_messages_are_bounded_by_their_bytes(graph, monkeypatch):
    """Acknowledged is not taken: 1000 messages of a megabyte would fill the memory."""
    monkeypatch.setattr(source, "WINDOW_BYTES", 1e5)
    monkeypatch.setattr(source, "QUEUED_BYTES", 5e5)
    receiver = Part(graph, "receiver")
    taken = receiver.flow.input(String, "/texts")
    sender = Sender(graph, topic="/numbers", wait_for=["receiver"])
    out = sender.flow.output(String, "/texts")
    message = b"\0\1\0\0" + (10_001).to_bytes(4, "little") + 10_000 * b"x" + b"\0"
    sender.source.begin()
    graph.until(out.is_open)
    for _ in range(200):
        out.publish(message)
    graph.until(lambda: not out.is_open())
    assert out.bytes <= 5e5 + 1.1e5 and out.waiting
    count = [0]

    def work():
        sender.flow.send()
        turn = receiver.flow.take()
        count[0] += len(turn.blocks.get("/texts", ()))
        receiver.flow.finish(turn)
        return 0.01

    receiver.node.work = work
    graph.until(lambda: count[0] == 200)
    assert taken.count == 200 and not out.waiting
