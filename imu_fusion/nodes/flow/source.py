"""The sending side of a session."""

import time
import uuid
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

from imu_fusion.nodes.flow.peers import Peers
from imu_fusion.nodes.flow.qos import (
    AT_ONCE,
    SILENT,
    UNKNOWN_NODE,
    Endpoints,
    full_name,
    gid,
    made,
    reliable_qos,
    type_name,
)
from imu_fusion.nodes.flow.state import BEGIN, END, MARK, Joined, Sending, Sent

WINDOW = 900  # messages of a topic sent before all must be acknowledged: see fastdds.xml
WINDOW_BYTES = 16e6
QUEUED_BYTES = 64e6  # of one topic, acknowledged but not taken

SETTLING = 1.0  # s without anybody new, after which all who are there are taken to be known
MATCHING = 5.0  # s, for which readers that are not matched are waited for once all have answered

_LIVE, _JOINING, _OPEN, _ENDED = range(4)


class Output:
    """A publisher; in a session, what may not leave yet waits in ``waiting``."""

    def __init__(self, source: "Source", msg_type: type, name: str, qos: QoSProfile) -> None:
        self.msg_type, self.name = msg_type, name  # name before remapping
        self.topic = source.node.resolve_topic_name(name)
        self.waiting: deque = deque()
        self._source = source
        self._publisher: Publisher
        self.writer = ""  # its gid
        self.renew(qos)

    def renew(self, qos: QoSProfile) -> None:
        """Begin anew, between sessions: what was latched is forgotten."""
        node = self._source.node
        if self.writer:
            node.destroy_publisher(self._publisher)
        self._publisher, self.writer = made(
            node.get_publishers_info_by_topic, self.topic,
            lambda: node.create_publisher(self.msg_type, self.name, qos, event_callbacks=SILENT),
            self._source.peers.participant)
        # As the graph shows it: in one's own an unlimited deadline is 0, which suits no reader.
        self.qos = next(info.qos_profile for info in node.get_publishers_info_by_topic(self.topic)
                        if gid(info) == self.writer)
        self.sent = self.start = self.bytes = 0
        self._flight = self._flight_bytes = 0

    def publish(self, *messages: Any) -> None:
        """Send messages (or their CDR bytes) now, or as soon as they may leave."""
        is_shut = bool(self.waiting)
        self.waiting.extend(messages)
        if not is_shut:
            self.drain()

    def is_open(self) -> bool:
        """Whether a message would leave at once."""
        if self._source.phase != _OPEN:
            return self._source.phase == _LIVE
        if self._has_room():
            return True
        taken = self._source.taken(self.topic)
        if taken is not None and (self.sent - taken) * self.bytes > QUEUED_BYTES * self.sent:
            return False
        if self.acknowledged():
            self._flight = self._flight_bytes = 0
            return True
        return False

    def acknowledged(self) -> bool:
        """Whether everything is in the queue of each reader, or was taken by all of ours."""
        if self._publisher.wait_for_all_acked(AT_ONCE):
            return True
        taken = self._source.taken(self.topic)
        return taken is not None and taken >= self.sent

    def matched(self) -> int:
        """Number of subscriptions that get what is published now."""
        return self._publisher.get_subscription_count()

    def drain(self) -> None:
        """Send what waits, as far as it may leave."""
        handle, is_live = self._publisher.handle, self._source.phase == _LIVE
        while self.waiting and self.is_open():
            with handle:  # as Publisher.publish does, but once for many
                self._send(handle, self.waiting.popleft())
                while self.waiting and (is_live or self._has_room()):
                    self._send(handle, self.waiting.popleft())

    def _has_room(self):
        """Whether the window is not full."""
        return self._flight < WINDOW and self._flight_bytes < WINDOW_BYTES

    def _send(self, handle, message):
        if isinstance(message, bytes):
            handle.publish_raw(message)
            self._flight_bytes += len(message)
            self.bytes += len(message)
        else:
            handle.publish(message)
        self.sent += 1
        self._flight += 1


class Source:
    """What a node sends.

    Args:
        peers: the other instances.
        wait_for: names of nodes that must have joined before the first message.

    ``upstream``, where this node processes the sessions of others, returns the instances that
    those know.
    """

    def __init__(self, peers: Peers, wait_for: Collection[str]) -> None:
        self.peers, self.node = peers, peers.node
        self.upstream: Callable[[], set[str]] | None = None
        self.outputs: dict[str, Output] = {}
        self.phase = _LIVE
        self.lost = 0  # see Sending
        self.foreign: dict[str, list[str]] = {}
        self.company: set[str] = set()  # instances that must have joined
        self._wait_for = {name if name.startswith("/") else "/" + name for name in wait_for}
        self._subscriptions = Endpoints(self.node.count_subscribers,
                                        self.node.get_subscriptions_info_by_topic)
        self._seen: set[str] = set()  # instances, and gids of readers that may be of others
        # When anybody new was seen last.
        self._news_at = float("-inf") if wait_for else time.monotonic()
        self._session = ""
        self._awaited: set[str] = set()  # of those names, not yet here in this session
        self._version = 0  # of the company
        self._answered_at = float("inf")  # when all of it had answered
        self._takers: dict[str, tuple[str, Joined]] = {}  # instance -> name, what it said last
        self._event = ""  # with which the session is to end
        self._begin_after = False

    def output(self, msg_type: type, topic: str, qos: QoSProfile | None = None) -> Output:
        """A new :class:`Output`; all of them before the session begins."""
        output = Output(self, msg_type, topic, qos or reliable_qos())
        self.outputs[output.topic] = output
        return output

    def sending(self) -> Sending:
        """What is said of the session."""
        if self.phase == _LIVE:
            return Sending()
        return Sending(
            self._session, self._event if self.phase == _ENDED else BEGIN,
            {topic: Sent(type_name(o.msg_type), o.writer, o.start, o.sent)
             for topic, o in self.outputs.items()}, frozenset(self.company),
            self._version, self.lost)

    def begin(self) -> None:
        """Announce a session, now or when the last one is over."""
        if self.phase != _LIVE:
            self._begin_after = True
            return
        self._begin_after, self._event, self._session = False, "", uuid.uuid4().hex[:12]
        self._awaited = set(self._wait_for)
        self.company, self._takers, self.lost = set(), {}, 0
        for output in self.outputs.values():
            output.start = output.sent
        self.phase = _JOINING
        self.peers.look()
        self.look(anew=True)

    def end(self, event: str = END) -> None:
        """End the session when everything has left; ``NEXT`` promises another one."""
        if self.phase in (_JOINING, _OPEN) and not self._event:
            self._event = event
            self.advance()

    def ready(self) -> bool:
        """Whether more may be made: no topic has a window's worth waiting (without a session:
        always). While the last window is acknowledged, the next one is made."""
        return self.phase == _LIVE or (self.is_settled() and all(
            len(output.waiting) < WINDOW for output in self.outputs.values()))

    def is_settled(self) -> bool:
        """Whether a session is open which all have joined."""
        return self.phase == _OPEN and not self._begin_after

    def is_shut(self) -> bool:
        """Whether something waits for acknowledgements, whose coming wakes nobody."""
        return self.phase == _OPEN and (bool(self._event) or not all(
            output.is_open() for output in self.outputs.values()))

    def drained(self) -> bool:
        """Whether no session is open: all who joined have everything."""
        return self.phase == _LIVE

    def taken(self, topic: str) -> int | None:
        """How far all who joined have taken a topic; None: nobody takes it."""
        return min((joined.topics[topic].taken for joined in self._answers().values()
                    if joined is not None and topic in joined.topics and not joined.finished),
                   default=None)

    def report(self) -> dict[str, tuple[int, dict[str, int]]]:
        """{topic: (messages sent, {name of a node that took it: messages that it lost})}."""
        return {topic: (output.sent, {
            name: joined.topics[topic].lost for name, joined in self._takers.values()
            if topic in joined.topics}) for topic, output in self.outputs.items()}

    def waiting_for(self) -> str:
        """Who keeps the source from sending or ending, in words; '' if nobody does."""
        if self.phase == _JOINING:
            names = {peer.name for peer in self.peers.values() if peer.is_silent}
            names |= {instance.partition(MARK)[0] for instance in self._waiting()}
            names |= self._awaited
            return ("no answer yet from " + ", ".join(sorted(names)) if names
                    else "discovery is not complete")
        if self.phase == _LIVE:
            return ""
        slow = sorted({self.peers[i].name for i, j in self._answers().items() if j is not None
                       and not j.finished and (self.phase == _ENDED or any(
                           t in self.outputs and taken.taken < self.outputs[t].sent
                           for t, taken in j.topics.items()))})
        slow += sorted({n for topic, names in self.foreign.items() for n in names
                        if not self.outputs[topic].is_open()})
        return "not taken yet by " + ", ".join(slow) if slow else ""

    def look(self, anew: bool = False) -> None:
        """Compare with the graph: who listens, who has come, who has gone."""
        self._look_around()
        self._hear()
        if self.phase in (_JOINING, _OPEN):
            known = {p.instance for p in self.peers.values() if p.state and p.state.listens}
            if self.upstream is not None:
                known |= self.upstream()
            if anew or known - self.company:
                self.company |= known
                self._version += 1
                self._answered_at = float("inf")
                self.phase = _JOINING
                self.peers.say()
        else:
            known = self.company & self.peers.keys()
        for instance in self.company - known:
            self.company.discard(instance)
            _, joined = self._takers.get(instance, ("", None))
            if joined is not None and not joined.finished:
                self._miss(instance, "has vanished")
            if self.phase != _ENDED:
                self.peers.say()
        self.advance()

    def advance(self) -> None:
        """Do what has become possible: open, send what waits, end, begin the next."""
        if self.phase == _LIVE:
            return
        self._hear()
        if self.phase == _JOINING and self._all_joined():
            self.phase = _OPEN
            self.peers.say()
        if self.phase == _OPEN:
            for output in self.outputs.values():
                output.drain()
            if self._event and all(not output.waiting and output.acknowledged()
                                   for output in self.outputs.values()):
                self.phase = _ENDED
                self.peers.say()
        if self.phase == _ENDED and all(j is not None and j.finished
                                        for j in self._answers().values()):
            self._close()

    def _hear(self):
        """What those who joined say now; who has finished before the end has left."""
        for instance, joined in self._answers().items():
            name, before = self._takers.get(instance, ("", None))
            if joined is None and before is not None and instance in self.peers:
                joined = replace(before, finished=True)  # it has lost sight of us for a while
            if joined is None:
                continue
            self._takers[instance] = name or self.peers[instance].name, joined
            if (before is not None and joined.finished and not before.finished
                    and self.phase in (_JOINING, _OPEN)):
                self._miss(instance, "has left")
                self.company.discard(instance)  # asked anew, if it is still there and listens

    def _close(self):
        self.phase = _LIVE
        for name, joined in self._takers.values():
            lost = {topic: taken.lost for topic, taken in joined.topics.items() if taken.lost}
            if lost:
                self.peers.problem(f"{name} lost "
                                   + ", ".join(f"{n} of {t}" for t, n in lost.items()))
        for output in self.outputs.values():
            output.drain()
        if self._begin_after:
            self.begin()

    def _miss(self, instance, how):
        """One that had joined does not take the rest."""
        name, joined = self._takers[instance]
        if joined.topics and any(output.sent > output.start for output in self.outputs.values()):
            self.peers.problem(f"{name} {how} in mid-session")

    def _answers(self):
        """What each of the company says of this session; None: nothing yet."""
        answers = {}
        for instance in self.company:
            peer = self.peers.get(instance)
            joined = peer.state.joined.get(self.peers.own) if peer and peer.state else None
            answers[instance] = joined if joined and joined.session == self._session else None
        return answers

    def _waiting(self):
        """Those of the company that are not ready with the company as it is now."""
        return {instance for instance, joined in self._answers().items()
                if joined is None or joined.version < self._version}

    def _names(self):
        return {self.peers[i].name for i, j in self._answers().items() if j is not None}

    def _all_joined(self):
        """All have answered, and the readers that they speak of are matched."""
        self._awaited -= self._names()  # who has joined may leave
        if (self._waiting() or self._awaited
                or any(peer.is_silent for peer in self.peers.values()) or self._is_settling()):
            return False
        self._answered_at = min(self._answered_at, time.monotonic())
        for topic, output in self.outputs.items():
            infos = self.node.get_subscriptions_info_by_topic(topic)
            ours = {j.topics[topic].reader for j in self._answers().values()
                    if topic in j.topics and not j.finished}
            if ours - set(map(gid, infos)) or output.matched() < len(ours):
                return False
            compatible = sum(
                i.topic_type == type_name(output.msg_type)
                and qos_check_compatible(output.qos, i.qos_profile)[0] != QoSCompatibility.ERROR
                for i in infos)
            # One that is not ours may stay so: in another partition, say.
            if (output.matched() < compatible
                    and time.monotonic() - self._answered_at < MATCHING):
                return False
        return True

    def _is_settling(self):
        """Whether somebody may be there who is not known yet."""
        return time.monotonic() - self._news_at < SETTLING

    def _look_around(self):
        """Find out who subscribes and is not, or not yet, known as one of ours."""
        ours = {peer.name for peer in self.peers.values() if peer.state}
        ours.add(self.node.get_fully_qualified_name())
        # With names to wait for, or known to those upstream, it is not time that tells who comes.
        seen = set() if self._wait_for or self.upstream else set(self.peers)
        self.foreign = {}
        for topic in self.outputs:
            others = [info for info in self._subscriptions[topic]
                      if full_name(info) not in ours]
            seen |= set(map(gid, others))
            names = {full_name(info) for info in others if info.node_name != UNKNOWN_NODE}
            if names:
                self.foreign[topic] = sorted(names)
        if seen - self._seen:
            self._news_at = time.monotonic()
        self._seen = seen
