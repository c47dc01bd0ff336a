"""Sessions between nodes of this process; see imu_fusion/nodes/flow."""

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int64, String

from imu_fusion.nodes.flow import END, NEXT, sink, source
from imu_fusion.nodes.flow.qos import sensor_qos, session_qos
from imu_fusion.nodes.flow.source import WINDOW
from imu_fusion.nodes.flow.state import MARK
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


def test_late_joiner_gets_everything_from_where_it_joined(graph):
    early = Receiver(graph, "early")
    sender = Sender(graph, wait_for=["early"])
    sender.session(30_000)
    graph.until(lambda: len(early.values) > 5000)
    late = Receiver(graph, "late", qos=sensor_qos())
    graph.until(lambda: early.ended and late.ended)
    assert early.values == list(range(30_000))
    missed = late.input.missed
    assert 0 < missed < 30_000
    assert late.values[-(30_000 - missed):] == list(range(missed, 30_000))
    assert not late.input.lost and late.flow.problems == [
        f"joined /sender late: {missed} of its messages had been sent before"]


def test_node_between_that_joins_late_says_what_is_not_in_its_session(graph):
    """Its receivers hear of it: what they have is made of incomplete data."""
    early, receiver = Receiver(graph, "early"), Receiver(graph, topic="/doubled")
    sender = Sender(graph, wait_for=["early"])
    sender.session(30_000)
    graph.until(lambda: len(early.values) > 5000)
    doubler = Doubler(graph)
    graph.until(lambda: receiver.ended)
    missed, = (int(text.split(": ")[1].split()[0]) for text in doubler.flow.problems)
    assert 0 < missed < 30_000  # what it heard before it had joined is not of its session
    assert receiver.values[-2 * (30_000 - missed) - 1:] == [
        i for i in twice(30_000) if i >= missed]
    assert receiver.flow.problems == [
        f"/doubler made its messages of incomplete data: it lacks at least {missed} messages"]


def test_node_between_that_is_stopped_while_its_sender_goes_on_says_so(graph):
    early, receiver = Receiver(graph, "early"), Receiver(graph, topic="/doubled")
    doubler, sender = Doubler(graph), Sender(graph, wait_for=["early", "doubler", "receiver"])
    sender.session(4000)
    graph.until(lambda: len(receiver.values) > 500)

    def only_send():
        doubler.flow.send()
        return 0.01

    doubler.node.work = only_send
    doubler.flow.close()
    graph.until(lambda: receiver.ended and early.ended)
    assert receiver.flow.problems == [
        "/doubler made its messages of incomplete data: it lacks at least 1 messages"]
    assert not early.flow.problems
    assert sender.flow.problems == ["/doubler has left in mid-session"]


def test_vanished_consumer_is_named_and_does_not_block_the_others(graph):
    gone, stays = Receiver(graph, "gone"), Receiver(graph, "stays")
    sender = Sender(graph, wait_for=["gone", "stays"])
    sender.session(10_000)
    graph.until(lambda: len(gone.values) > 10)
    gone.takes = False
    graph.until(lambda: not sender.out.is_open())
    graph.remove(gone.node)
    graph.until(lambda: stays.ended)
    assert stays.values == list(range(10_000))
    assert sender.flow.problems == ["/gone has vanished in mid-session"]


def test_a_sink_that_lost_sight_of_its_sender_joins_it_anew(graph, monkeypatch):
    """A lease that ran out on one side only: the sender was stopped, and saw nothing of it."""
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    sender.session(100, event=None)
    graph.until(lambda: len(receiver.values) == 100)
    with monkeypatch.context() as blind:
        blind.setattr(receiver.flow.peers, "_writers", lambda topic: set())
        graph.until(lambda: receiver.ended)
    graph.until(receiver.flow.sink.feeding)
    sender.todo, sender.event = [102, 101, 100], END
    graph.until(lambda: len(receiver.ended) == 2 and sender.source.drained())
    assert receiver.values == list(range(103)) and receiver.input.missed == 100
    assert sender.flow.problems == ["/receiver has left in mid-session"]
    assert receiver.flow.problems[1:] == [
        "joined /sender late: 100 of its messages had been sent before"]


def test_who_was_waited_for_may_leave_and_others_join(graph):
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    sender.session(100, event=None)
    graph.until(lambda: len(receiver.values) == 100)
    receiver.flow.close()
    graph.remove(receiver.node)
    graph.until(lambda: sender.flow.problems)
    late = Receiver(graph, "late")
    graph.until(late.flow.sink.feeding)
    sender.todo, sender.event = [101, 100], END
    graph.until(lambda: late.ended and sender.source.drained())
    assert late.values == [100, 101]


def test_node_between_whose_sender_dies_waits_for_nobody_that_only_that_one_knew(graph):
    """It would be deaf to all senders after it."""
    mute, doubler = Receiver(graph, "mute", hold=lambda: True), Doubler(graph)
    sender = Sender(graph, wait_for=["doubler"])
    sender.session(10)
    graph.until(lambda: "/mute" in doubler.flow.source.waiting_for())
    graph.until(lambda: mute.flow.peers.own in doubler.flow.sink.company())
    graph.remove(sender.node)
    graph.remove(mute.node)
    receiver, again = Receiver(graph, topic="/doubled"), Sender(graph, "again",
                                                                wait_for=["doubler"])
    again.session(10)
    graph.until(again.source.drained)
    graph.until(lambda: receiver.values[-21:] == twice(10))


def test_restarted_under_its_name_it_is_somebody_else(graph):
    stays = Receiver(graph, "stays")
    first = Receiver(graph, "receiver")
    sender = Sender(graph, wait_for=["receiver", "stays"])
    sender.session(60_000)
    graph.until(lambda: len(first.values) > 10)
    first.flow.close()
    graph.remove(first.node)
    again = Receiver(graph, "receiver")
    graph.until(lambda: stays.ended and again.ended)
    assert stays.values == list(range(60_000))
    assert again.values[-1] == 59_999 and again.input.missed + len(again.values) >= 60_000
    assert not stays.flow.problems
    assert sender.flow.problems == ["/receiver has left in mid-session"]
    assert again.flow.problems == [
        f"joined /sender late: {again.input.missed} of its messages had been sent before"]


def test_a_session_that_went_on_without_a_sink_is_over_for_it(graph):
    """As for a process that was stopped for longer than its lease."""
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    sender.session(100, event=None)
    graph.until(lambda: len(receiver.values) == 100)
    sender.source.phase = source._LIVE
    sender.flow.peers.say()
    graph.until(lambda: receiver.ended)
    assert receiver.flow.problems == [
        "the session of /sender broke off: it went on without this node"]


def test_two_sinks_of_one_name_get_everything(graph):
    one, two = Receiver(graph), Receiver(graph)
    sender = Sender(graph, wait_for=["receiver"])
    graph.until(lambda: len(sender.flow.peers) == 2)
    sender.session(8000)
    graph.until(lambda: one.ended and two.ended and sender.source.drained())
    assert one.values == two.values == list(range(8000))


def test_sink_does_not_wait_for_a_source_that_has_vanished(graph):
    receiver = Receiver(graph)
    sender = Sender(graph, wait_for=["receiver"])
    sender.session(5, event=None)
    graph.until(lambda: len(receiver.values) == 5)
    graph.remove(sender.node)
    graph.until(lambda: receiver.ended)
    assert not receiver.flow.sink.feeding()
    assert receiver.flow.problems == ["the session of /sender broke off: it has vanished"]


def test_foreign_subscriber_is_named_and_never_waited_for(graph):
    stranger = graph.node("stranger")
    stranger.create_subscription(Int64, "/numbers", lambda m: None, 10)
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    graph.until(lambda: sender.out.matched() == 2)
    sender.session(2000)
    graph.until(lambda: receiver.ended)
    assert sender.source.foreign == {"/numbers": ["/stranger"]}
    assert receiver.values == list(range(2000))


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


def test_node_between_waits_for_sinks_that_only_its_source_has_discovered(graph):
    """Discovery between each two nodes takes its own time. Here the doubler cannot see the
    receiver, and the receiver not the doubler, until they may."""
    receiver, doubler = Receiver(graph, topic="/doubled"), Doubler(graph)
    hidden = [True]
    for one, other in ((doubler, "/receiver"), (receiver, "/doubler")):
        names = one.node.get_topic_names_and_types
        one.node.get_topic_names_and_types = lambda names=names, other=other: [
            (topic, types) for topic, types in names()
            if not (hidden[0] and topic.startswith(other + MARK))]
    sender = Sender(graph, wait_for=["doubler", "receiver"])
    sender.session(100)
    graph.until(lambda: "/receiver" in doubler.flow.source.waiting_for())
    graph.until(lambda: "/doubler" in sender.source.waiting_for())
    assert sender.out.sent == 0
    hidden[0] = False
    graph.until(lambda: receiver.ended)
    assert receiver.values == twice(100)
    assert receiver.input.missed == 0 and not receiver.flow.problems


def test_node_between_answers_anew_when_its_sender_has_discovered_more(graph):
    """The receiver comes when the doubler has answered, and does not see it for a while. Were
    they all sent now, the receiver had all of the numbers, and would leave before the doubler's."""
    Doubler(graph)
    sender = Sender(graph, wait_for=["doubler", "receiver"])
    sender.session(100)
    graph.until(lambda: sender.source.waiting_for() == "no answer yet from /receiver")
    receiver, hidden = Receiver(graph, topic="/doubled"), [True]
    names = receiver.node.get_topic_names_and_types
    receiver.node.get_topic_names_and_types = lambda: [
        (topic, types) for topic, types in names()
        if not (hidden[0] and topic.startswith("/doubler" + MARK))]
    graph.until(lambda: receiver.flow.sink.sessions
                and sender.source.waiting_for() == "no answer yet from /doubler")
    assert sender.out.sent == 0
    hidden[0] = False
    graph.until(lambda: receiver.ended)
    assert receiver.values == twice(100) and not receiver.flow.problems


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
