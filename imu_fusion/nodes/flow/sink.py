"""The taking side of sessions."""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from imu_fusion.nodes.flow.peers import Peer, Peers
from imu_fusion.nodes.flow.qos import made, reliable_qos, session_qos
from imu_fusion.nodes.flow.source import Source
from imu_fusion.nodes.flow.state import BEGIN, END, NEXT, Joined, Sending, Taken

AT_ONCE = 2000  # messages of one topic that are taken in one turn
# s, in which a block grows: in a session; live, for what was sent together; where nobody waits.
NAP, NAP_LIVE, NAP_PATIENT = 0.002, 0.001, 0.02
SHARED = ("/tf", "/tf_static")  # topics on which others' messages are no fault
SILENCE = 5.0  # s, after which what is missing at the end counts as lost
REPORT_BYTES = 16e6  # taken, after which that is said; see QUEUED_BYTES of a source
REPORT_EVERY = 0.5  # s

Message = tuple[bytes, dict]
"""CDR bytes; source_timestamp, received_timestamp (ns) and numbers, as rclpy has them."""


@dataclass(eq=False)
class Session:
    """A session as who takes it sees it."""

    id: str
    instance: str
    source: str  # name of the node
    said: Sending
    topics: dict[str, int]  # those taken -> count of the writer when we joined
    late: int = 0  # messages before that
    answered: int = 0  # version of its company with which we are ready
    broken: bool = False
    finished: bool = False

    @property
    def has_ended(self) -> bool:
        """Whether its sender has said so, or has vanished."""
        return self.broken or self.said.event != BEGIN

    @property
    def event(self) -> str:
        """How it ended."""
        return NEXT if self.said.event == NEXT else END


@dataclass
class Turn:
    """What has happened since the last turn, in this order.

    ``begun``: the input topics of the sessions that are open, if one has begun; ``blocks``: the
    messages of each topic; ``ended``: topics of which nothing more comes; ``over``: sessions that
    have ended and were taken to the end, ``event`` how the last of all ended (empty while
    others are open); ``lost``: messages that these lack, as far as is known.
    """

    begun: list[str] | None = None
    blocks: dict[str, list[Message]] = field(default_factory=dict)
    ended: list[str] = field(default_factory=list)
    over: list[Session] = field(default_factory=list)
    event: str = ""
    lost: int = 0


class _Gate(ReentrantCallbackGroup):
    """Subscriptions of an executor's wait set, while ``is_open()`` and not ``aside``."""

    def __init__(self, is_open):
        super().__init__()
        self._is_open = is_open
        self.aside = False

    def can_execute(self, entity):
        return not self.aside and self._is_open()


class Input:
    """One subscription: live, or of a session. The counts are of all its sessions together."""

    def __init__(self, sink: "Sink", msg_type: type, topic: str, qos: QoSProfile,
                 wakes: bool) -> None:
        self.msg_type, self.topic, self.qos, self.wakes = msg_type, topic, qos, wakes
        self.subscription: Subscription
        self.reader = ""  # its gid
        self.in_session = False  # whether it reads as in one
        self.lost = self.unexpected = self.missed = 0  # missed: sent before we joined
        self.sessions: list[Session] = []  # until all of them have ended
        self.count = 0  # taken in them
        self.heard_at = 0.0
        self.is_empty = False
        self._first: list[Message] = []  # taken by the executor
        self._sink = sink
        self.listen(False)

    def listen(self, in_session: bool) -> None:
        """Subscribe anew."""
        node, qos = self._sink.node, session_qos() if in_session else self.qos
        callback: Any = self._on_data  # rclpy counts its arguments; its types know of one
        self.in_session = in_session
        if self.reader:
            node.destroy_subscription(self.subscription)
        self.subscription, self.reader = made(
            node.get_subscriptions_info_by_topic, self.topic,
            lambda: node.create_subscription(self.msg_type, self.topic, callback, qos,
                                             raw=True, callback_group=self._sink.gate),
            self._sink.peers.participant)

    def _on_data(self, cdr, info):
        # What wakes the executor; the rest is taken with it in the next turn.
        self._first.append((cdr, info))
        self._sink.woken = True

    def take(self) -> list[Message]:
        """All that waits, up to AT_ONCE."""
        messages, self._first = self._first, []
        handle = self.subscription.handle
        with handle:
            while len(messages) < AT_ONCE:
                taken = handle.take_message(self.msg_type, True)
                if taken is None:
                    self.is_empty = True
                    return messages
                messages.append(taken)
        self.is_empty = False
        return messages

    def is_complete(self) -> bool:
        """Whether nothing more comes: all is taken, or what is missing does not come."""
        if not (self.sessions and self.is_empty and all(s.has_ended for s in self.sessions)):
            return False
        missing = self.expected() - self.count
        return missing <= 0 or time.monotonic() - self.heard_at > SILENCE

    def expected(self) -> int:
        """Messages that the sessions should bring; those of one that broke off are not known."""
        return sum(s.said.topics[self.topic].sent - s.topics[self.topic]
                   for s in self.sessions if not s.broken)


class Sink:
    """What a node takes.

    Args:
        hold: while it returns true, no session is joined.
        on_begin: called with the :class:`Session` that is about to be joined; may add inputs.
        nap: s, live, between the coming of a message and its being taken.

    ``feeds``: the source, where there is one, that sends what is made of this; while it cannot,
    nothing is taken.
    """

    def __init__(self, peers: Peers, hold: Callable[[], bool],
                 on_begin: Callable[[Session], None], nap: float = NAP_LIVE) -> None:
        self.peers, self.node, self._nap = peers, peers.node, nap
        self.feeds: Source | None = None
        self.inputs: dict[str, Input] = {}
        self.sessions: dict[str, Session] = {}  # by instance of the sender
        self.gate = _Gate(lambda: self.feeds is None or self.feeds.ready())
        self.woken = self._is_flowing = False
        self._hold, self._on_begin = hold, on_begin
        self._begun = False
        self._left: dict[str, int] = {}  # broken session -> its version then
        self._reported: dict[str, int] = {}  # topic -> count
        self._unreported = 0.0  # bytes
        self._report_at = 0.0

    def input(self, msg_type: type, topic: str, qos: QoSProfile | None = None,
              wakes: bool = True) -> Input:
        """A new :class:`Input`; see :meth:`Flow.input`."""
        topic = self.node.resolve_topic_name(topic)
        found = self.inputs[topic] = Input(self, msg_type, topic, qos or reliable_qos(), wakes)
        return found

    def feeding(self) -> list[Session]:
        """The sessions of which this node takes topics, until they are finished."""
        return [s for s in self.sessions.values() if s.topics and not s.finished]

    def company(self) -> set[str]:
        """The instances that the senders of these sessions know, as long as they are there."""
        return {i for s in self.feeding() if not s.broken
                for i in s.said.company} - {self.peers.own}

    def joined(self) -> Mapping[str, Joined]:
        """What is said of the sessions.

        One that feeds what this node sends is answered when that may be sent, and to all whom
        its sender knows: it begins when all behind this node are ready, too.
        """
        ready = self.feeds is None or (
            self.feeds.is_settled() and self.company() <= self.feeds.company)
        for session in self.sessions.values():
            if ready or not session.topics:
                session.answered = session.said.version
        return {s.instance: Joined(s.id, s.answered, s.finished, {
            topic: Taken(self.inputs[topic].reader, base + self._reported.get(topic, 0),
                         self.inputs[topic].lost)
            for topic, base in s.topics.items()})
            for s in self.sessions.values() if s.answered}

    def follow(self) -> None:
        """Join, and hear how sessions end."""
        for peer in list(self.peers.values()):
            if peer.state is not None:
                self._follow(peer)
        for session in list(self.sessions.values()):
            if session.instance not in self.peers:
                if session.finished:
                    del self.sessions[session.instance]
                elif not session.has_ended:
                    self._break(session, "has vanished")
        for topic_input in self.inputs.values():
            if (topic_input.in_session and not topic_input.sessions
                    and not self.promised(topic_input.topic)):
                topic_input.listen(False)
        self._close_idle()

    def promised(self, topic: str | None = None) -> bool:
        """Whether a sender that is there has promised another session (of this topic)."""
        return any(s.finished and s.said.event == NEXT and (topic is None or topic in s.topics)
                   for s in self.sessions.values() if s.topics)

    def report(self) -> None:
        """Say now and then how much was taken."""
        if time.monotonic() - self._report_at > REPORT_EVERY or self._unreported > REPORT_BYTES:
            self._report_at, self._unreported = time.monotonic(), 0.0
            self._reported = {topic: i.count for topic, i in self.inputs.items() if i.sessions}
            self.peers.say()

    def wait(self, seconds: float) -> bool:
        """Wait for messages alone, at most so long; whether there are any."""
        handles = [i.subscription.handle for i in self.inputs.values() if i.wakes or i.sessions]
        if not handles or not self.gate.can_execute(None):
            return False
        if self._is_flowing:  # more follow: a nap costs less than waiting for them
            self.woken = True
            return True
        with ExitStack() as held:
            for handle in (*handles, self.node.context.handle):
                held.enter_context(handle)
            waiting = _rclpy.WaitSet(len(handles), 0, 0, 0, 0, 0, self.node.context.handle)
            waiting.clear_entities()
            for handle in handles:
                waiting.add_subscription(handle)
            waiting.wait(round(seconds * 1e9))
            self.woken = bool(waiting.get_ready_entities("subscription"))
        return self.woken

    def take(self) -> Turn:
        """One turn: all that waits on all topics."""
        in_session = bool(self.feeding())
        nap = NAP if in_session else self._nap
        if self.woken and nap:  # even none at all would last for 60 us
            time.sleep(nap)
        self.woken = False
        turn = Turn()
        if self._begun:
            self._begun = False
            turn.begun = sorted({t for s in self.feeding() for t in s.topics})
        for topic, topic_input in self.inputs.items():
            messages = topic_input.take()
            if messages:
                turn.blocks[topic] = messages
                topic_input.heard_at = time.monotonic()
                topic_input.count += len(messages)
                self._unreported += len(messages) * len(messages[0][0])
            if topic_input.is_complete():
                turn.ended.append(topic)
                turn.lost += self._compare(topic_input)
        self._is_flowing = in_session and bool(turn.blocks)
        if turn.ended:
            turn.over = [s for s in self.feeding() if s.has_ended
                         and not any(s in self.inputs[t].sessions for t in s.topics)]
            turn.lost += sum(self._lacks(s) for s in turn.over)
            if turn.over and len(turn.over) == len(self.feeding()):
                turn.event = turn.over[-1].event
        return turn

    def done(self, sessions: list[Session]) -> None:
        """Say that these sessions, of the last turn, are finished."""
        for session in sessions:
            session.finished = True
        if sessions:
            self._report_at = float("-inf")
            self.report()

    def leave(self) -> None:
        """The node stops, as it was asked to: nobody waits for it any more."""
        for session in self.sessions.values():
            session.finished = True
        self.peers.say()

    def _follow(self, peer):
        said = peer.state.sending
        session = self.sessions.get(peer.instance)
        if session is not None and session.id == said.session and not session.broken:
            session.said = said
        elif session is not None and not session.finished:
            if not session.has_ended:
                self._break(session, "went on without this node")
        elif (said.event == BEGIN and self.peers.own in said.company and not self._hold()
              and said.version > self._left.get(said.session, 0)):
            self._join(peer, said)

    def _join(self, peer: Peer, said: Sending) -> None:
        session = Session(said.session, peer.instance, peer.name, said, {})
        session.topics = dict.fromkeys(said.topics, 0)
        self._on_begin(session)
        session.topics = {t: said.topics[t].sent for t in said.topics if t in self.inputs}
        self.sessions[peer.instance] = session
        for topic, count in session.topics.items():
            topic_input = self.inputs[topic]
            if not topic_input.in_session:
                topic_input.take()
                topic_input.listen(True)
            if not topic_input.sessions:
                topic_input.count = 0
                self._reported.pop(topic, None)
            topic_input.sessions.append(session)
            topic_input.heard_at = time.monotonic()
            late = count - said.topics[topic].before
            topic_input.missed += late
            session.late += late
            self._name_others(topic, peer)
        if session.topics:
            self._begun = True
            if self.feeds is not None:
                if len(self.feeding()) == 1:
                    self.feeds.begin()
                else:
                    self.feeds.look()
        self.peers.say()

    def _name_others(self, topic, peer):
        if topic in SHARED:
            return
        names = sorted({i.node_name for i in self.node.get_publishers_info_by_topic(topic)
                        if bytes(i.endpoint_gid).hex() != peer.state.sending.topics[topic].writer})
        if names:
            self.node.get_logger().warning(
                f"{', '.join(names)} publishes {topic} beside {peer.name}: messages of both reach "
                "this node and cannot be told apart")

    def _break(self, session, why):
        session.broken = True
        self._left[session.id] = session.said.version
        if session.topics:
            self.peers.problem(f"the session of {session.source} broke off: it {why}")

    def _lacks(self, session):
        """What a session that is over lacks, beyond what was sent and not taken."""
        if session.said.lost:
            self.peers.problem(f"{session.source} made its messages of incomplete data: it lacks "
                          f"at least {session.said.lost} messages")
        if session.late:
            self.peers.problem(f"joined {session.source} late: {session.late} of its messages had "
                               "been sent before")
        return session.said.lost + session.late + session.broken

    def _compare(self, topic_input):
        """At the end of all sessions of a topic: what was taken, and what they count.

        Returns:
            Number of messages lost.
        """
        expected, broken = topic_input.expected(), any(s.broken for s in topic_input.sessions)
        topic_input.sessions = []
        surplus = topic_input.count - expected
        if surplus < 0:
            topic_input.lost -= surplus
            self.peers.problem(f"{topic_input.topic}: {-surplus} of {expected} messages LOST")
        elif surplus > 0 and not broken:
            topic_input.unexpected += surplus
            if topic_input.topic not in SHARED:
                self.peers.problem(f"{topic_input.topic}: {surplus} messages more than the "
                                   f"{expected} of the session: somebody else publishes it, too")
        return max(0, -surplus)

    def _close_idle(self):
        """Finish sessions of which nothing is taken."""
        idle = [s for s in self.sessions.values() if s.has_ended and not s.topics
                and not s.finished]
        for session in idle:
            session.finished = True
        if idle:
            self.peers.say()
