"""Flow control between our nodes: nothing lost, ends known, whatever the speed.

DDS drops messages when a subscriber lags (KEEP_LAST) or blocks the publisher
(KEEP_ALL). So our nodes count. A *session* is one pass of data from a *source*
(the replayer, or a node that processes a session of somebody else):

1. The source announces the session on ``/flow/status``: its topics, with types
   and the sequence number after which the session starts.
2. Every node that owns a :class:`FlowSink` (seen in the graph as a publisher of
   ``/flow/ack``) answers on ``/flow/ack`` which of the topics it takes. The
   source sends nothing before all have answered and their subscriptions match.
3. Sinks acknowledge the highest sequence number received. The source keeps at
   most ``WINDOW`` messages per topic unacknowledged, less than the queue depth.
4. At the end the source states the last sequence number of each topic, so that
   a sink knows when it has everything, or what it lost, and says that it is done.

A processing node is sink and source, tied by a :class:`Relay`: it answers and
acknowledges upstream only while its own outputs may flow, so that back pressure,
readiness and the end of the stream pass through any chain of nodes.

Without a session (live drivers) nobody waits and nobody acknowledges. Other
people's subscribers never acknowledge; :attr:`FlowSource.foreign` names them.

Both topics carry diagnostic_msgs/DiagnosticStatus: ``name`` is the node,
``hardware_id`` the session, ``message`` the event, ``values`` topic and numbers.
"""

import time
import uuid
from collections import deque
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.qos import (
    DurabilityPolicy, HistoryPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy,
    qos_check_compatible)

STATUS_TOPIC = "/flow/status"
ACK_TOPIC = "/flow/ack"

DEPTH = 1000  # queue depth of data topics, at both ends
WINDOW = 500  # unacknowledged messages per topic; late joiners add a quarter at most
ACK_EVERY = WINDOW // 4

PATIENCE = 5.0  # s of silence after which the last messages of an ended session count as lost

# Events on /flow/status. NEXT: this session ended, the source starts another (loop).
BEGIN, NEXT, END = "begin", "next", "end"
# Events on /flow/ack.
ACK, DONE = "ack", "done"

_UNBOUNDED = float("inf")
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # rmw: endpoint discovered before its node's name


def reliable_qos(depth=DEPTH, durability=DurabilityPolicy.VOLATILE):
    """The QoS of data in a session: reliable, with room for the window."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth,
                      reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def sensor_qos():
    """The QoS of live inputs: best effort takes any publisher; deep, for bursts."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH,
                      reliability=ReliabilityPolicy.BEST_EFFORT)


# A source keeps one event: who comes late hears of the present session, not of past ones.
# None is overwritten unheard, since each but the last is answered before the next.
_STATUS_OFFERED = reliable_qos(1, DurabilityPolicy.TRANSIENT_LOCAL)
_STATUS_HEARD = reliable_qos(100, DurabilityPolicy.TRANSIENT_LOCAL)  # of all sources together
_ACK_QOS = reliable_qos(1000)


def subscribe_raw(node, msg_type, topic, callback, qos, batch=100):
    """Subscribe to CDR bytes, taking all that wait (at most ``batch``) per wake-up.

    An executor takes one message per turn of its wait set, which costs 100 us and
    more; taking what is queued in the same turn is an order of magnitude faster.

    Args:
        callback: called as ``callback(cdr: bytes, info: dict)``, info as in rclpy
            (source_timestamp, received_timestamp, publication_sequence_number).
    """
    def on_message(cdr, info):
        callback(cdr, info)
        handle = subscription.handle
        with handle:
            for _ in range(batch):
                taken = handle.take_message(msg_type, True)
                if taken is None:
                    return
                callback(*taken)

    subscription = node.create_subscription(msg_type, topic, on_message, qos, raw=True)
    return subscription


def steady_timer(node, period, callback):
    """A timer of real time: also under use_sim_time, and while nobody publishes /clock."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def type_name(msg_type):
    """'sensor_msgs/msg/Imu' of the class."""
    return f"{msg_type.__module__.split('.')[0]}/msg/{msg_type.__name__}"


def _full_name(info):
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _status(node_name, session, event, values):
    return DiagnosticStatus(
        level=DiagnosticStatus.OK, name=node_name, hardware_id=session, message=event,
        values=[KeyValue(key=topic, value=value) for topic, value in values.items()])


class FlowPublisher:
    """A publisher that counts, and keeps what the window does not admit in an outbox."""

    def __init__(self, source, publisher, msg_type, qos):
        self.msg_type = msg_type
        self.topic = publisher.topic_name
        self.sent = 0  # equals the DDS sequence number of the last message
        self.limit = _UNBOUNDED
        self.outbox = deque()
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
        self._ending = None  # the event that ends the session
        self._announced = False
        self.session = None
        self.foreign = {}
        self._status = node.create_publisher(DiagnosticStatus, STATUS_TOPIC, _STATUS_OFFERED)
        node.create_subscription(DiagnosticStatus, ACK_TOPIC, self._on_ack, _ACK_QOS)
        steady_timer(node, 0.1, self._watch)

    def publisher(self, msg_type, topic, qos=None):
        """Make a :class:`FlowPublisher`; all of them before the session begins."""
        qos = qos or reliable_qos()
        publisher = FlowPublisher(
            self, self._node.create_publisher(msg_type, topic, qos), msg_type, qos)
        self._publishers[publisher.topic] = publisher
        return publisher

    def begin(self):
        """Announce a session; :meth:`ready` turns true when all sinks have answered."""
        if self.session is not None and not self.drained():
            self._begin_after_drain = True
            return
        self.session = f"{self._name}#{uuid.uuid4().hex[:12]}"
        self._begin_after_drain = False
        self._ending = None
        self._announced = False
        self._matched = None
        self._consumers = {}
        for name in self._wait_for:
            self._expect(name)
        self._refresh()
        self._settling = True
        self._close_windows()
        self._status.publish(_status(self._name, self.session, BEGIN, {
            p.topic: f"{p.sent} {type_name(p.msg_type)}" for p in self._publishers.values()}))

    def ready(self):
        """Whether every topic may send (always, outside sessions)."""
        if self._settling or self._begin_after_drain:
            return False
        for publisher in self._publishers.values():
            if publisher.sent >= publisher.limit:
                return False
        return True

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
                self._refresh()

    def _expect(self, name):
        self._consumers[name] = _Consumer({t: p.sent for t, p in self._publishers.items()})
        self._settling = True
        self._close_windows()

    def _close_windows(self):
        for publisher in self._publishers.values():
            publisher.limit = publisher.sent

    def _refresh(self):
        """Compare consumers with the graph: joined, vanished, foreign."""
        names = [_full_name(i) for i in self._node.get_publishers_info_by_topic(ACK_TOPIC)
                 if i.node_name != _UNKNOWN_NODE]
        sinks = set(names) - {self._name}
        if len(names) > len(set(names)):
            self._node.get_logger().warning(
                "several nodes have the same name; their acknowledgements cannot be told apart: "
                + ", ".join(sorted(n for n in sinks if names.count(n) > 1))
                + "; rename all but one with -r __node:=NAME", once=True)
        self._seen |= sinks
        if not self._announced:
            for name in sinks - self._consumers.keys():
                self._expect(name)
        for name in (self._consumers.keys() & self._seen) - sinks:
            self._node.get_logger().warning(f"{name} has vanished")
            del self._consumers[name]
            self._seen.discard(name)
        self.foreign = {}
        for topic in self._publishers:
            others = {_full_name(i) for i in self._node.get_subscriptions_info_by_topic(topic)}
            others -= sinks | {self._name} | self._consumers.keys()
            if others:
                self.foreign[topic] = sorted(others)

    def _is_settled(self):
        """All have answered, and the subscriptions they speak of have been matched."""
        if not all(c.answered for c in self._consumers.values()):
            return False
        for topic, publisher in self._publishers.items():
            infos = self._node.get_subscriptions_info_by_topic(topic)
            names = {_full_name(i) for i in infos}
            if any(topic in c.acked and n not in names for n, c in self._consumers.items()):
                return False
            compatible = sum(
                qos_check_compatible(publisher.qos, i.qos_profile)[0] != QoSCompatibility.ERROR
                for i in infos)
            if publisher.matched() < compatible:
                return False
        return True

    def _watch(self):
        if self.session is not None:
            self._refresh()
            self._update()

    def _on_ack(self, message):
        if message.hardware_id != self.session or message.name == self._name:
            return
        if message.name not in self._consumers:
            self._expect(message.name)
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
                self.begin()
        self._on_ready()

    def _announce_end(self):
        if self._ending and not self._announced and not any(
                p.outbox for p in self._publishers.values()):
            self._status.publish(_status(self._name, self.session, self._ending, {
                p.topic: str(p.sent) for p in self._publishers.values()}))
            self._announced = True


@dataclass
class Session:
    """A session as a sink sees it: topics map to message types."""

    id: str
    source: str
    topics: dict
    start: dict  # topic -> sequence number before the first message
    final: dict | None = None  # topic -> sequence number of the last message
    event: str = BEGIN
    idle_since: float = 0.0
    seen_in_graph: bool = False
    is_open: bool = True


class Inbox:
    """What a sink counts of one topic."""

    def __init__(self, topic, callback):
        self.topic = topic
        self.callback = callback
        self.session = None
        self.last = None  # sequence number of the last message
        self.received = 0
        self.missed = 0  # of the session, before the first message: we joined late
        self.lost = 0  # after that
        self.unacknowledged = 0
        self.final = None


class FlowSink:
    """The subscribing side: counts, acknowledges, and knows when a session is over.

    Args:
        node: the rclpy node.
        on_begin: called with each new :class:`Session`, before it is answered; may
            subscribe to more topics.
        on_topic_end: called with a topic when all of it has arrived.
        on_end: called with a session when all its topics that are taken have ended.
        hold: while it returns true, acknowledgements are withheld (see :meth:`release`).
        confirm: whether the sink says that it is done by itself; else see :meth:`done`.
    """

    def __init__(self, node, *, on_begin=lambda session: None,
                 on_topic_end=lambda topic: None, on_end=lambda session: None,
                 hold=lambda: False, confirm=True, ack_every=ACK_EVERY):
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._on_begin, self._on_topic_end, self._on_end = on_begin, on_topic_end, on_end
        self._hold = hold
        self._confirm = confirm
        self._unconfirmed = []
        self._ack_every = ack_every
        self._owed = False
        self.inboxes = {}
        self.sessions = {}  # open ones, by source
        self._ack = node.create_publisher(DiagnosticStatus, ACK_TOPIC, _ACK_QOS)
        node.create_subscription(DiagnosticStatus, STATUS_TOPIC, self._on_status, _STATUS_HEARD)
        steady_timer(node, 0.5, self._watch)

    def subscribe(self, msg_type, topic, callback, qos=None):
        """Subscribe to CDR bytes: ``callback(cdr, info)``; returns the :class:`Inbox`."""
        topic = self._node.resolve_topic_name(topic)
        inbox = self.inboxes[topic] = Inbox(topic, callback)
        for session in self.sessions.values():
            if topic in session.topics:
                self._enter(inbox, session)
        subscribe_raw(self._node, msg_type, topic,
                      lambda cdr, info: self._on_data(inbox, cdr, info), qos or reliable_qos())
        return inbox

    def release(self):
        """Send the acknowledgements that ``hold`` has withheld."""
        if self._owed:
            self.acknowledge()

    def acknowledge(self):
        """Tell the sources of the open sessions that we take how far we are."""
        self._owed = self._hold()
        if not self._owed:
            for session in self.sessions.values():
                taken = self._taken(session)
                if taken:
                    self._send_ack(session, taken)

    def done(self):
        """Confirm the sessions that have ended."""
        while self._unconfirmed:
            session = self._unconfirmed.pop()
            self._send_ack(session, self._taken(session), DONE)

    def feeding(self):
        """The open sessions of which this node takes topics."""
        return [s for s in self.sessions.values() if self._taken(s)]

    def _taken(self, session):
        return [self.inboxes[t] for t in session.topics if t in self.inboxes
                and self.inboxes[t].session is session]

    def _send_ack(self, session, taken, event=ACK):
        for inbox in taken:
            inbox.unacknowledged = 0
        self._ack.publish(_status(self._name, session.id, event, {
            inbox.topic: f"{inbox.last} {inbox.lost}" for inbox in taken}))

    def _enter(self, inbox, session):
        # A sink that joined late has heard messages of this session already.
        heard = inbox.session is None and inbox.received and inbox.last is not None
        if not heard or inbox.last < session.start[inbox.topic]:
            inbox.last = session.start[inbox.topic]
        inbox.session = session
        inbox.final = None
        inbox.received = inbox.received if heard else 0
        inbox.missed = inbox.lost = 0

    def _on_status(self, message):
        if message.name == self._name:
            return
        if message.message == BEGIN:
            self._begin(message)
            return
        session = self.sessions.get(message.name)
        if session is None or session.id != message.hardware_id:
            return
        session.event = message.message
        session.idle_since = time.monotonic()
        session.final = {entry.key: int(entry.value) for entry in message.values}
        for inbox in self._taken(session):
            inbox.final = session.final[inbox.topic]
            if inbox.last >= inbox.final:
                self._on_topic_end(inbox.topic)
        self._check_end(session)

    def _begin(self, message):
        old = self.sessions.get(message.name)
        if old is not None:
            old.event = NEXT
            self._abandon(old, "was replaced by a new one")
        start, topics = {}, {}
        for entry in message.values:
            sent, topics[entry.key] = entry.value.split()
            start[entry.key] = int(sent)
        session = Session(message.hardware_id, message.name, topics, start,
                          idle_since=time.monotonic())
        self.sessions[session.source] = session
        for topic in topics:
            if topic in self.inboxes:
                self._enter(self.inboxes[topic], session)
        self._on_begin(session)
        if self._taken(session):
            self.acknowledge()
        else:  # never withheld: sources that feed each other would wait in a circle
            self._send_ack(session, [])

    def _on_data(self, inbox, cdr, info):
        sequence = info["publication_sequence_number"]
        last = inbox.last
        if last is None:
            last = 0 if sequence is None else sequence - 1
        if sequence is None:  # this middleware does not number: count
            sequence = last + 1
        session = inbox.session
        # Without a session there may be several writers, each with numbers of its own.
        if sequence > last + 1 and session is not None:
            if inbox.received:
                inbox.lost += sequence - last - 1
            else:
                inbox.missed += sequence - last - 1
        inbox.last = sequence  # not above the last one: another writer, counted from there
        inbox.received += 1
        inbox.callback(cdr, info)
        if session is None or not session.is_open:
            return
        inbox.unacknowledged += 1
        if inbox.final is not None:
            session.idle_since = time.monotonic()
            if sequence >= inbox.final:
                self._on_topic_end(inbox.topic)
                self._check_end(session)
                return
        if inbox.unacknowledged >= self._ack_every:
            self.acknowledge()

    def _check_end(self, session):
        taken = self._taken(session)
        if session.final is None or any(i.last < i.final for i in taken):
            return
        self._close(session, taken)

    def _close(self, session, taken):
        session.is_open = False
        del self.sessions[session.source]
        if taken:
            self._unconfirmed.append(session)
            self._on_end(session)
            if self._confirm:
                self.done()

    def _abandon(self, session, why):
        """Close a session that will not complete by itself."""
        taken = self._taken(session)
        if taken:
            self._node.get_logger().warning(f"the session of {session.source} {why}")
        for inbox in taken:
            if inbox.final is None or inbox.last < inbox.final:
                if inbox.final is not None:
                    inbox.lost += inbox.final - inbox.last
                    self._node.get_logger().warning(
                        f"{inbox.topic}: {inbox.final - inbox.last} messages have not arrived")
                    inbox.last = inbox.final
                self._on_topic_end(inbox.topic)
        self._close(session, taken)

    def _watch(self):
        """Find sessions that cannot end: their source is gone, or their tail was lost."""
        self.release()
        if not self.sessions:
            return
        sources = {_full_name(i) for i in self._node.get_publishers_info_by_topic(STATUS_TOPIC)}
        for session in list(self.sessions.values()):
            if session.source in sources:
                session.seen_in_graph = True
            elif session.seen_in_graph and session.final is None:
                self._abandon(session, "broke off: its node has vanished")
                continue
            if session.final is not None and time.monotonic() - session.idle_since > PATIENCE:
                self._abandon(session, "has ended without its last messages")


class Relay:
    """Sink and source of a processing node, tied together.

    ``stage`` (usually the node) has four methods:

    ``reset(topics)``: a session with these input topics begins.
    ``step()``: process one sample that may be processed; False if there is none.
    ``topic_ended(topic)``: nothing more comes on this input.
    ``finish()``: all inputs have ended and all samples are processed; publish the rest.

    Samples wait in the stage while the outputs are full; outputs made by ``finish``
    may exceed the window: they wait in the outboxes.
    """

    def __init__(self, node, stage, *, wait_for=(), window=WINDOW):
        self._stage = stage
        self._finishing = None
        self._topics = set()
        self.source = FlowSource(node, wait_for=wait_for, window=window, on_ready=self.pump)
        self.sink = FlowSink(
            node, on_begin=self._begin, on_topic_end=stage.topic_ended, on_end=self._end,
            hold=lambda: not self.source.ready(), confirm=False, ack_every=max(1, window // 4))

    def publisher(self, msg_type, topic, qos=None):
        """A :class:`FlowPublisher` of this node."""
        return self.source.publisher(msg_type, topic, qos)

    def subscribe(self, msg_type, topic, callback, qos=None):
        """``callback(cdr, info)`` stores a sample; the relay then calls ``stage.step``."""
        def on_data(cdr, info):
            callback(cdr, info)
            self.pump()
        return self.sink.subscribe(msg_type, topic, on_data, qos)

    def pump(self):
        """Process what may be processed, as far as the outputs take it."""
        while self.source.ready() and self._stage.step():
            pass
        if self._finishing and self.source.ready():
            event, self._finishing = self._finishing, None
            self._stage.finish()
            self.source.end(event)
            self.sink.done()
        self.sink.release()

    def close(self):
        """The node stops: whoever listens is told that nothing more comes."""
        self.source.end()

    def _begin(self, session):
        feeding = self.sink.feeding()
        if session not in feeding:
            return
        if len(feeding) == 1:
            self.source.begin()
        self._stage.reset(sorted({topic for s in feeding for topic in s.topics
                                  if topic in self.sink.inboxes}))

    def _end(self, session):
        if not self.sink.feeding():
            self._finishing = NEXT if session.event == NEXT else END
            self.pump()
