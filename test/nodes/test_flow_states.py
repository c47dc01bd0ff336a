"""What others say of their sessions, and who is believed; see imu_fusion/nodes/flow/peers.py."""

from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from imu_fusion.nodes.flow import END, peers, qos
from imu_fusion.nodes.flow.qos import gid
from imu_fusion.nodes.flow.state import BEGIN, MARK, STATE_QOS, Sending, Sent, State
from test.nodes.flow_parts import Receiver, Sender


def statement(instance, gid_of, topic="/numbers", event=BEGIN, session="forged"):
    """What a forger says of a session."""
    return State(True, Sending(session, event, {topic: Sent("std_msgs/msg/Int64", gid_of, 0, 0)},
                               frozenset(), 1), {}).message()


@pytest.mark.parametrize("message", [
    DiagnosticArray(),
    DiagnosticArray(status=[DiagnosticStatus(name="sends", message="begin")]),
    DiagnosticArray(status=[DiagnosticStatus(name="x")]),
])
def test_malformed_states_are_ignored_with_a_warning(graph, monkeypatch, capfd, message):
    """Of a stranger; the session begins without him after a while."""
    monkeypatch.setattr(peers, "PATIENCE", 0.5)
    stranger = graph.node("stranger")
    stranger.create_publisher(DiagnosticArray, f"/stranger{MARK}i1", STATE_QOS).publish(message)
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    graph.until(lambda: f"/stranger{MARK}i1" in sender.flow.peers)
    sender.session(10)
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == list(range(10))
    assert not receiver.flow.problems and not sender.flow.problems
    assert f"/stranger{MARK}i1 is ignored" in capfd.readouterr().err


@pytest.mark.parametrize("text", ["x", "1 2 3", "a b -1 0", "t w 1.5 0", ""])
def test_malformed_fields_are_no_state(text):
    message = State(True, Sending("s", BEGIN, {}, frozenset(), 1), {}).message()
    message.status[0].values[0].key = "topic /x"
    message.status[0].values[0].value = text
    with pytest.raises(ValueError, match="malformed"):
        State.of(message)


def test_who_does_not_publish_the_data_is_not_believed(graph, monkeypatch, capfd):
    """A session of data of somebody else, and of nobody."""
    monkeypatch.setattr(peers, "PATIENCE", 0.5)
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    forger = graph.node("forger")
    for i, writer in enumerate((sender.out.writer, 32 * "0")):
        instance = f"/forger{MARK}i{i}"
        forger.create_publisher(DiagnosticArray, instance, STATE_QOS).publish(
            statement(instance, writer))
    graph.until(lambda: sum(name.startswith("/forger") for name in sender.flow.peers) == 2)
    sender.session(1000)
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == list(range(1000)) and len(receiver.ended) == 1
    assert not receiver.flow.problems
    graph.until(lambda: all(peer.complained for peer in sender.flow.peers.values()
                            if peer.name == "/forger"))
    assert "is ignored: does not publish /numbers" in capfd.readouterr().err


def test_forged_end_ends_nothing(graph, monkeypatch):
    """Somebody writes on the topic of the sender: while there are two, neither is believed."""
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    sender.session(30_000)
    graph.until(lambda: len(receiver.values) > 100)
    instance = sender.flow.peers.own
    forger = graph.node("forger")
    said = sender.source.sending()
    forger.create_publisher(DiagnosticArray, instance, STATE_QOS).publish(statement(
        instance, sender.out.writer, event=END, session=said.session))
    peer = receiver.flow.peers[instance]
    graph.until(lambda: peer.doubted is not None and sender.out.sent == 30_000)
    assert not receiver.ended
    graph.remove(forger)
    graph.until(lambda: receiver.ended and sender.source.drained())
    assert receiver.values == list(range(30_000))
    assert not receiver.flow.problems


def test_two_that_say_who_they_are_are_given_up_after_a_while(graph, monkeypatch):
    monkeypatch.setattr(peers, "PATIENCE", 0.5)
    receiver, sender = Receiver(graph), Sender(graph, wait_for=["receiver"])
    sender.session(100, event=None)
    graph.until(lambda: len(receiver.values) == 100)
    instance = sender.flow.peers.own
    graph.node("forger").create_publisher(DiagnosticArray, instance, STATE_QOS)
    graph.until(lambda: receiver.ended)
    assert receiver.flow.problems == [
        f"two publishers of {instance}: neither is believed",
        "the session of /sender broke off: it has vanished"]


def test_the_state_of_another_is_said_by_its_own_writer(graph):
    sender, receiver = Sender(graph), Receiver(graph)
    graph.until(lambda: receiver.flow.peers and sender.flow.peers)
    instance = sender.flow.peers.own
    info, = receiver.node.get_publishers_info_by_topic(instance)
    graph.until(lambda: receiver.flow.peers[instance].state is not None)
    assert receiver.flow.peers[instance].writer == gid(info)


def test_endpoints_are_asked_for_when_their_number_changes_and_until_all_have_names(monkeypatch):
    there, asked = [SimpleNamespace(node_name="a")], []

    def infos(topic):
        asked.append(topic)
        return list(there)

    endpoints = qos.Endpoints(lambda topic: len(there), infos)
    assert endpoints["/x"] == endpoints["/x"] == there and asked == ["/x"]
    there.append(SimpleNamespace(node_name=qos.UNKNOWN_NODE))
    for _ in range(2):
        assert endpoints["/x"] == there
    assert len(asked) == 3
    there[1].node_name = "b"
    for _ in range(3):
        assert endpoints["/x"] == there
    assert len(asked) == 3
    monkeypatch.setattr(qos, "_KEPT", -1.0)    # the time is over
    there[1] = SimpleNamespace(node_name="c")
    assert endpoints["/x"] == there
