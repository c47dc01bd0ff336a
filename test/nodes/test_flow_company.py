"""Nodes that join a session, leave it, vanish and come back; see imu_fusion/nodes/flow."""

import pytest
from rclpy.node import Node

from imu_fusion.nodes.flow import END, source
from imu_fusion.nodes.flow.peers import Peer
from imu_fusion.nodes.flow.qos import sensor_qos
from imu_fusion.nodes.flow.source import Output
from imu_fusion.nodes.flow.state import MARK
from test.nodes.flow_parts import Doubler, Receiver, Sender, twice


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
        graph.until(lambda: "no answer yet from /receiver" in sender.source.waiting_for())
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


def no_readers_of_the_sender(node, topic, known=Node.get_subscriptions_info_by_topic):
    return [] if node.get_name() == "sender" else known(node, topic)


@pytest.mark.parametrize("unknown", [
    (Output, "matched", lambda output: 0), (Peer, "is_silent", property(lambda peer: True)),
    (Node, "get_subscriptions_info_by_topic", no_readers_of_the_sender)],
    ids=["readers not matched", "a peer not heard", "readers not in the graph"])
def test_nothing_leaves_before_all_that_is_there_is_known(graph, monkeypatch, unknown):
    """Between processes discovery takes its time; here it is held up."""
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    with monkeypatch.context() as held_up:
        held_up.setattr(*unknown)
        sender.session(3)
        graph.until(lambda: receiver.flow.sink.sessions and not sender.source._awaited
                    and not sender.source._is_settling())
        turns = iter(range(20))    # in which it would begin
        graph.until(lambda: next(turns, None) is None)
        assert sender.out.sent == 0 and sender.source.waiting_for()
    graph.until(lambda: receiver.ended)
    assert receiver.values == [0, 1, 2]
