"""The subscribing side of a session: :class:`FlowSink`."""

import time
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus

from imu_fusion.nodes.flow.protocol import (
    ACK,
    ACK_EVERY,
    ACK_QOS,
    ACK_TOPIC,
    BEGIN,
    COMPANY,
    DONE,
    NEXT,
    STATUS_HEARD,
    STATUS_TOPIC,
    full_name,
    is_reliable,
    reliable_qos,
    status_message,
    steady_timer,
    subscribe_raw,
)

PATIENCE = 5.0  # s of silence after which the last messages of an ended session count as lost


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
    company: set = field(default_factory=set)  # sinks that the source knows


class Inbox:
    """What a sink counts of one topic."""

    def __init__(self, topic, msg_type, callback, qos):
        self.topic = topic
        self.msg_type = msg_type
        self.callback = callback
        self.qos = qos  # outside sessions
        self.subscription = None
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
        on_company: called with a session whose source has learnt of more sinks.
        on_topic_end: called with a topic when all of it has arrived.
        on_end: called with a session when all its topics that are taken have ended.
        hold: while it returns true, acknowledgements are withheld (see :meth:`release`).
        confirm: whether the sink says that it is done by itself; else see :meth:`done`.
    """

    def __init__(self, node, *, on_begin=lambda session: None,
                 on_company=lambda session: None, on_topic_end=lambda topic: None,
                 on_end=lambda session: None,
                 hold=lambda: False, confirm=True, ack_every=ACK_EVERY):
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._on_begin, self._on_company = on_begin, on_company
        self._on_topic_end, self._on_end = on_topic_end, on_end
        self._hold = hold
        self._confirm = confirm
        self._unconfirmed = []
        self._ack_every = ack_every
        self._owed = False
        self.inboxes = {}
        self.sessions = {}  # open ones, by source
        self._ack = node.create_publisher(DiagnosticStatus, ACK_TOPIC, ACK_QOS)
        node.create_subscription(DiagnosticStatus, STATUS_TOPIC, self._on_status, STATUS_HEARD)
        steady_timer(node, 0.5, self._watch)

    def subscribe(self, msg_type, topic, callback, qos=None):
        """Subscribe to CDR bytes: ``callback(cdr, info)``; returns the :class:`Inbox`.

        A best-effort subscription hears any live publisher. During a session it is
        exchanged for a reliable one, so that nothing gets lost.
        """
        topic = self._node.resolve_topic_name(topic)
        inbox = self.inboxes[topic] = Inbox(topic, msg_type, callback, qos or reliable_qos())
        self._listen(inbox, inbox.qos)
        for session in self.sessions.values():
            if topic in session.topics:
                self._enter(inbox, session)
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
        self._ack.publish(status_message(self._name, session.id, event, {
            inbox.topic: f"{inbox.last} {inbox.lost}" for inbox in taken}))

    def _listen(self, inbox, qos):
        if inbox.subscription is not None:
            self._node.destroy_subscription(inbox.subscription)
        inbox.subscription = subscribe_raw(
            self._node, inbox.msg_type, inbox.topic,
            lambda cdr, info: self._on_data(inbox, cdr, info), qos)

    def _enter(self, inbox, session):
        if not is_reliable(inbox.subscription.qos_profile):
            self._listen(inbox, reliable_qos(durability=inbox.qos.durability))
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
        values = {entry.key: entry.value for entry in message.values}
        company = set(values.pop(COMPANY).split())
        old = self.sessions.get(message.name)
        if old is not None and old.id == message.hardware_id:
            old.company = company
            self._on_company(old)
            return
        if old is not None:
            old.event = NEXT
            self._abandon(old, "was replaced by a new one")
        start, topics = {}, {}
        for topic, value in values.items():
            sent, topics[topic], *renewed = value.split()
            start[topic] = int(sent)
            if renewed and topic in self.inboxes and self.inboxes[topic].session is None:
                self.inboxes[topic].last = None  # of the writer before
        session = Session(message.hardware_id, message.name, topics, start,
                          idle_since=time.monotonic(), company=company)
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
        for inbox in self.inboxes.values():
            session = inbox.session
            if session is not None and not session.is_open and session.event != NEXT and (
                    is_reliable(inbox.subscription.qos_profile) != is_reliable(inbox.qos)):
                self._listen(inbox, inbox.qos)
        if not self.sessions:
            return
        sources = {full_name(i) for i in self._node.get_publishers_info_by_topic(STATUS_TOPIC)}
        for session in list(self.sessions.values()):
            if session.source in sources:
                session.seen_in_graph = True
            elif session.seen_in_graph and session.final is None:
                self._abandon(session, "broke off: its node has vanished")
                continue
            if session.final is not None and time.monotonic() - session.idle_since > PATIENCE:
                self._abandon(session, "has ended without its last messages")
