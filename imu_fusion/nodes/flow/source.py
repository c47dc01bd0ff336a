"""The publishing side of a session: :class:`FlowSource`."""

import time
import uuid
from collections import deque
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSCompatibility, qos_check_compatible

from imu_fusion.nodes.flow.protocol import (
    ACK_EVERY,
    ACK_QOS,
    ACK_TOPIC,
    BEGIN,
    COMPANY,
    DONE,
    END,
    RENEWED,
    STATUS_OFFERED,
    STATUS_TOPIC,
    WINDOW,
    full_name,
    is_reliable,
    reliable_qos,
    status_message,
    steady_timer,
    type_name,
)

HEARSAY = 20.0  # s to discover a sink that another node knows; DDS forgets a dead one in 20 s
_UNBOUNDED = float("inf")
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # rmw: endpoint discovered before its node's name


class FlowPublisher:
    """A publisher that counts, and keeps what the window does not admit in an outbox."""

    def __init__(self, source, publisher, name, msg_type, qos):
        self.name = name  # before remapping
        self.msg_type = msg_type
        self.topic = publisher.topic_name
        self.sent = 0  # equals the DDS sequence number of the last message
        self.limit = _UNBOUNDED
        self.outbox: deque = deque()
        self.qos = qos
        self._publisher = publisher
        self._source = source
        self._look_at = 0

    @property
    def is_open(self):
        """Whether a message would leave at once."""
        return self.sent < self.limit

    def publish(self, message):
        """Send a message (or its CDR bytes) now, or as soon as the window admits it."""
        if self.sent >= self.limit:
            self.outbox.append(message)
            return
        self._publisher.publish(message)
        self.sent += 1
        if self.sent >= self._look_at:
            self._look_at = self.sent + ACK_EVERY
            self._source.look_for_joiners()

    def renew(self, qos):
        """Begin anew, between sessions: what was latched is forgotten."""
        self._publisher = self._source.exchange(self, self._publisher, qos)
        self.qos, self.sent, self._look_at = qos, 0, 0

    def matched(self):
        """Number of subscriptions that get what is published now."""
        return self._publisher.get_subscription_count()

    def drain(self):
        while self.outbox and self.sent < self.limit:
            self.publish(self.outbox.popleft())


@dataclass
class _Consumer:
    """What a source knows of one of our sinks."""

    joined: dict  # topic -> sent when it joined
    acked: dict = field(default_factory=dict)  # topic -> sequence number
    lost: dict = field(default_factory=dict)
    since: float = 0.0
    answered: bool = False
    done: bool = False

    def position(self, topic):
        return max(self.acked[topic], self.joined.get(topic, 0))


class FlowSource:
    """The publishing side: announces sessions and keeps to the window.

    Args:
        node: the rclpy node.
        wait_for: names of nodes that must answer before the first message.
        window: unacknowledged messages per topic and consumer.
        on_ready: called whenever acknowledgements may have opened the window.
    """

    def __init__(self, node, *, wait_for=(), window=WINDOW, on_ready=lambda: None):
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._window = window
        self._on_ready = on_ready
        self._wait_for = {name if name.startswith("/") else "/" + name for name in wait_for}
        self._publishers = {}
        self._consumers = {}
        self._seen = set()
        self._matched = None
        self._settling = False
        self._begin_after_drain = False
        self._company = set()
        self._start = {}
        self._renewed = set()  # topics whose sequence numbers have begun anew
        self._ending = None  # the event that ends the session
        self._announced = False
        self.session = None
        self.foreign = {}
        self._status = node.create_publisher(DiagnosticStatus, STATUS_TOPIC, STATUS_OFFERED)
        node.create_subscription(DiagnosticStatus, ACK_TOPIC, self._on_ack, ACK_QOS)
        steady_timer(node, 0.1, self._watch)

    def publisher(self, msg_type, topic, qos=None):
        """Make a :class:`FlowPublisher`; all of them before the session begins."""
        qos = qos or reliable_qos()
        publisher = FlowPublisher(
            self, self._node.create_publisher(msg_type, topic, qos), topic, msg_type, qos)
        self._publishers[publisher.topic] = publisher
        return publisher

    def exchange(self, publisher, old, qos):
        """A new rclpy publisher in place of an old one; see :meth:`FlowPublisher.renew`."""
        self._renewed.add(publisher.topic)
        self._node.destroy_publisher(old)
        return self._node.create_publisher(publisher.msg_type, publisher.name, qos)

    def begin(self, company=()):
        """Announce a session; :meth:`ready` turns true when all sinks have answered.

        Args:
            company: names of sinks that somebody else has seen in the graph.
        """
        self._company = set(company) - {self._name}
        if self.session is not None and not self.drained():
            self._begin_after_drain = True
            return
        self.session = f"{self._name}#{uuid.uuid4().hex[:12]}"
        self._begin_after_drain = False
        self._ending = None
        self._announced = False
        self._matched = None
        self._consumers = {}
        self._start = {topic: p.sent for topic, p in self._publishers.items()}
        self._settling = True
        self._close_windows()
        for name in self._wait_for | self._company:
            self._expect(name)
        self._refresh()
        self._announce()

    def expect(self, company):
        """More sinks have been seen by somebody else: they must answer too."""
        self._company |= set(company) - {self._name}
        new = self._company - self._consumers.keys()
        if new and self.session is not None and not (self._announced or self._begin_after_drain):
            for name in new:
                self._expect(name)
            self._announce()

    def ready(self):
        """Whether every topic may send (always, outside sessions)."""
        if self._settling or self._begin_after_drain:
            return False
        return all(publisher.sent < publisher.limit for publisher in self._publishers.values())

    def end(self, event=END):
        """End the session once all outboxes are empty; ``NEXT`` promises another one."""
        if self.session is not None and self._ending is None:
            self._ending = event
            self._announce_end()

    def drained(self):
        """Whether the session has ended and its consumers have everything (or vanished)."""
        return self.session is None or (self._announced and all(
            c.done or (c.answered and not c.acked) for c in self._consumers.values()))

    def waiting_for(self):
        """Who keeps the source from sending, in words; '' if nobody does."""
        unanswered = sorted(n for n, c in self._consumers.items() if not c.answered)
        if unanswered:
            return "no answer yet from " + ", ".join(unanswered)
        if self._settling:
            return "discovery is not complete"
        slow = sorted(name for name, consumer in self._consumers.items() if any(
            consumer.position(t) + self._window <= self._publishers[t].sent
            for t in consumer.acked) or (self._announced and consumer.acked and not consumer.done))
        return "no acknowledgement from " + ", ".join(slow) if slow else ""

    def acknowledged(self, topic):
        """The number up to which all consumers of ``topic`` have acknowledged; None: nobody."""
        return min((c.position(topic) for c in self._consumers.values() if topic in c.acked),
                   default=None)

    def report(self):
        """{topic: (messages sent, {consumer: messages it lost})} of our consumers."""
        return {topic: (publisher.sent, {
            name: consumer.lost[topic] for name, consumer in sorted(self._consumers.items())
            if topic in consumer.acked}) for topic, publisher in self._publishers.items()}

    def look_for_joiners(self):
        """Notice new subscriptions early, so that they cannot fall behind by a queue."""
        if self.session is not None and not self._announced:
            matched = [p.matched() for p in self._publishers.values()]
            if matched != self._matched:
                self._matched = matched
                if self._refresh():
                    self._announce()

    def _expect(self, name):
        self._consumers[name] = _Consumer(
            {t: p.sent for t, p in self._publishers.items()}, since=time.monotonic())
        self._settling = True
        self._close_windows()

    def _announce(self):
        values = {topic: f"{sent} {type_name(self._publishers[topic].msg_type)}"
                  + (f" {RENEWED}" if topic in self._renewed else "")
                  for topic, sent in self._start.items()}
        values[COMPANY] = " ".join(sorted(self._consumers))
        self._status.publish(status_message(self._name, self.session, BEGIN, values))

    def _close_windows(self):
        for publisher in self._publishers.values():
            publisher.limit = publisher.sent

    def _refresh(self):
        """Compare consumers with the graph: joined, vanished, foreign.

        Returns:
            Whether sinks have joined.
        """
        names = [full_name(i) for i in self._node.get_publishers_info_by_topic(ACK_TOPIC)
                 if i.node_name != _UNKNOWN_NODE]
        sinks = set(names) - {self._name}
        if len(names) > len(set(names)):
            self._node.get_logger().warning(
                "several nodes have the same name; their acknowledgements cannot be told apart: "
                + ", ".join(sorted(n for n in sinks if names.count(n) > 1))
                + "; rename all but one with -r __node:=NAME", once=True)
        self._seen |= sinks
        new = sinks - self._consumers.keys()
        if self._announced:
            new = set()
        for name in new:
            self._expect(name)
        for name in self._consumers.keys() - sinks:
            heard_of = time.monotonic() - self._consumers[name].since
            if name in self._seen or (name not in self._wait_for and heard_of > HEARSAY):
                if not self._consumers[name].done:
                    self._node.get_logger().warning(f"{name} has vanished")
                    del self._consumers[name]
                self._seen.discard(name)
        self.foreign = {}
        for topic in self._publishers:
            others = {full_name(i) for i in self._node.get_subscriptions_info_by_topic(topic)
                      if i.node_name != _UNKNOWN_NODE}
            others -= sinks | {self._name} | self._consumers.keys()
            if others:
                self.foreign[topic] = sorted(others)
        return bool(new)

    def _is_settled(self):
        """All have answered, and the subscriptions they speak of are reliable and matched."""
        if not all(c.answered for c in self._consumers.values()):
            return False
        for topic, publisher in self._publishers.items():
            infos = self._node.get_subscriptions_info_by_topic(topic)
            listening = {full_name(i): is_reliable(i.qos_profile) for i in infos}
            if not all(listening.get(name) for name, c in self._consumers.items()
                       if topic in c.acked):
                return False
            compatible = sum(
                qos_check_compatible(publisher.qos, i.qos_profile)[0] != QoSCompatibility.ERROR
                for i in infos)
            if publisher.matched() < compatible:
                return False
        return True

    def _watch(self):
        if self.session is not None:
            if self._refresh():
                self._announce()
            self._update()

    def _on_ack(self, message):
        if message.hardware_id != self.session or message.name == self._name:
            return
        if message.name not in self._consumers:
            self._expect(message.name)
            if not self._announced:
                self._announce()
        consumer = self._consumers[message.name]
        consumer.answered = True
        consumer.done = message.message == DONE
        for entry in message.values:
            if entry.key in self._publishers:
                acked, lost = entry.value.split()
                # A sink that heard another writer of this topic before may be ahead.
                consumer.acked[entry.key] = min(int(acked), self._publishers[entry.key].sent)
                consumer.lost[entry.key] = int(lost)
        self._update()

    def _update(self):
        """Open the windows as far as the acknowledgements allow, and send what waits."""
        if self._settling:
            if not self._is_settled():
                return
            self._settling = False
        for topic, publisher in self._publishers.items():
            position = self.acknowledged(topic)
            publisher.limit = _UNBOUNDED if position is None else position + self._window
            publisher.drain()
        self._announce_end()
        if self._announced and self.drained():
            self.session = None
            for publisher in self._publishers.values():
                publisher.limit = _UNBOUNDED
            if self._begin_after_drain:
                self.begin(self._company)
        self._on_ready()

    def _announce_end(self):
        if self._ending and not self._announced and not any(
                p.outbox for p in self._publishers.values()):
            self._status.publish(status_message(self._name, self.session, self._ending, {
                p.topic: str(p.sent) for p in self._publishers.values()}))
            self._announced = True
