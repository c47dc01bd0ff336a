"""A node's part in sessions, as taker, sender or both: :class:`Flow`."""

import time
import uuid
from collections.abc import Callable, Collection

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile

from imu_fusion.nodes.flow.peers import Peers
from imu_fusion.nodes.flow.qos import PARTICIPANT, SILENT, made, steady_timer
from imu_fusion.nodes.flow.sink import Input, Session, Sink, Turn
from imu_fusion.nodes.flow.source import AT_ONCE, Output, Source
from imu_fusion.nodes.flow.state import END, MARK, STATE_QOS, State

_LOOK_EVERY = 0.1  # s
_LAST_WORDS = 0.5  # s
_POLL, _POLL_AT_MOST = 0.002, 0.016  # s, between looks whether all is acknowledged


class Flow:
    """What a node takes and sends.

    A node calls, once in each turn of its executor::

        if flow.send():               # what waits has left
            turn = flow.take()        # all that waits on the inputs
            ...                       # process it, publish
            flow.finish(turn)

    Args:
        node: the rclpy node.
        listens: whether it takes anything.
        relays: whether what it sends is made of what it takes: then it takes nothing while it
            cannot send, and each session that it joins is one that it sends.
        wait_for: names of nodes that must have joined before the first message.
        hold: while it returns true, no session is joined.
        on_begin: called with each :class:`Session` before it is joined (``topics`` are those that
            it has); may add inputs.
    """

    def __init__(self, node: Node, *, listens: bool = True, relays: bool = False,
                 wait_for: Collection[str] = (), hold: Callable[[], bool] = lambda: False,
                 on_begin: Callable[[Session], None] = lambda session: None) -> None:
        self.problems: list[str] = []  # texts: why the exit code is 1
        self._node, self._listens, self._relays = node, listens, relays
        own = f"{node.get_fully_qualified_name()}{MARK}i{uuid.uuid4().hex[:12]}"
        self._publisher, gid = made(node.get_publishers_info_by_topic, own, lambda: (
            node.create_publisher(DiagnosticArray, own, STATE_QOS, event_callbacks=SILENT)))
        self.peers = Peers(node, own, self._changed, self._problem)
        self.source = Source(
            node, self.peers, own, gid[:PARTICIPANT], wait_for=wait_for, say=self._say,
            upstream=(lambda: self.sink.company()) if relays else None, problem=self._problem)
        self.sink = Sink(
            node, self.peers, own, gid[:PARTICIPANT], hold=hold, on_begin=on_begin,
            on_join=self._join, gate=lambda: not relays or self.source.ready(),
            may_answer=lambda: not relays or (
                self.source.is_settled() and self.sink.company() <= self.source.company),
            say=self._say,
            problem=self._problem)
        self._said: State | None = None
        self._poll = _POLL
        self._say()
        steady_timer(node, _LOOK_EVERY, self._look)

    def output(self, msg_type: type, topic: str, qos: QoSProfile | None = None) -> Output:
        """A publisher."""
        return self.source.output(msg_type, topic, qos)

    def input(self, msg_type: type, topic: str, qos: QoSProfile | None = None) -> Input:
        """A subscription; ``qos`` is that outside sessions."""
        return self.sink.input(msg_type, topic, qos)

    def send(self) -> bool:
        """Send what waits; whether more may be made now."""
        self.source.advance()
        return not self._relays or self.source.ready()

    def take(self) -> Turn:
        """All that waits on all inputs, and what has become of the sessions."""
        turn = self.sink.take()
        if self._relays:
            self.source.lost += turn.lost
            for session in turn.over:
                if session.late:
                    self._problem(f"joined {session.source} late: {session.late} of its messages "
                                  "are not in what was made of them")
        return turn

    def finish(self, turn: Turn) -> None:
        """What the turn has brought is processed and published."""
        if self._relays and turn.event:
            self.source.end(turn.event)
        self.sink.done(turn.over)

    def pause(self, idle: float) -> float:
        """Seconds until the next turn, unless something comes."""
        if any(not i.is_empty for i in self.sink.inputs.values() if i.sessions) and (
                not self._relays or self.source.ready()):
            return 0.0
        if not self.source.is_shut():
            self._poll = _POLL
            return idle
        self._poll = min(2.0 * self._poll, _POLL_AT_MOST)
        return min(idle, self._poll)

    def close(self) -> None:
        """The node stops: whoever listens is told that nothing more comes, and time to hear it."""
        if self._relays and any(not session.has_ended for session in self.sink.feeding()):
            self.source.lost += 1  # at least: its senders go on
        self.source.end(END)
        self.sink.leave()
        deadline = time.monotonic() + _LAST_WORDS
        while not self._publisher.wait_for_all_acked(AT_ONCE) and time.monotonic() < deadline:
            time.sleep(_POLL)

    def _join(self):
        if self._relays:
            if len(self.sink.feeding()) == 1:
                self.source.begin()
            else:
                self.source.look()

    def _changed(self):
        self.sink.follow()
        if self._relays:
            self.source.look()  # those whom our senders know may be more
        self.source.advance()
        self._say()

    def _look(self):
        self.peers.look()
        self.sink.follow()
        self.sink.report()
        self.source.look()

    def _say(self):
        state = State(self._listens, self.source.sending(), self.sink.joined())
        if state != self._said:
            self._said = state
            self._publisher.publish(state.message())

    def _problem(self, text):
        self.problems.append(text)
        self._node.get_logger().error(text)
