"""A node's part in sessions, as taker, sender or both: :class:`Flow`."""

import time
from collections.abc import Callable, Collection

from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from imu_fusion.nodes.flow.peers import Peers
from imu_fusion.nodes.flow.qos import steady_timer
from imu_fusion.nodes.flow.sink import NAP_LIVE, Input, Session, Sink, Turn
from imu_fusion.nodes.flow.source import Output, Source
from imu_fusion.nodes.flow.state import END, State

_LOOK_EVERY = 0.1  # s
_SERVE_EVERY = 0.1  # s
_POLL = 0.002  # s, between looks whether all is acknowledged


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
        nap: s, live, between the coming of a message and its being taken.
    """

    def __init__(self, node: Node, *, listens: bool = True, relays: bool = False,
                 wait_for: Collection[str] = (), hold: Callable[[], bool] = lambda: False,
                 on_begin: Callable[[Session], None] = lambda session: None,
                 nap: float = NAP_LIVE) -> None:
        self._listens, self._relays = listens, relays
        self.peers = Peers(node, self._state, self._changed)
        self.problems = self.peers.problems
        self.source = Source(self.peers, wait_for)
        self.sink = Sink(self.peers, hold, on_begin, nap)
        if relays:
            self.source.upstream, self.sink.feeds = self.sink.company, self.source
        self._serve_at = 0.0
        self.peers.say()
        steady_timer(node, _LOOK_EVERY, self._look)

    def output(self, msg_type: type, topic: str, qos: QoSProfile | None = None) -> Output:
        """A publisher."""
        return self.source.output(msg_type, topic, qos)

    def input(self, msg_type: type, topic: str, qos: QoSProfile | None = None,
              wakes: bool = True) -> Input:
        """A subscription; outside sessions with ``qos``, and there messages that do not wake the
        node are taken with the next that does, or 100 ms later."""
        return self.sink.input(msg_type, topic, qos, wakes)

    def send(self) -> bool:
        """Send what waits; whether more may be made now."""
        self.source.advance()
        return not self._relays or self.source.ready()

    def take(self) -> Turn:
        """All that waits on all inputs, and what has become of the sessions."""
        turn = self.sink.take()
        if self._relays:
            self.source.lost += turn.lost
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
        return idle

    def wait(self, executor: Executor, seconds: float) -> None:
        """Wait for something to do, at most so long, and let callbacks run.

        A turn of an executor looks at all that a node has, which takes longer than our work on
        a sample. So while messages come these alone are waited for, and the others have a turn
        now and then; so, too, while acknowledgements are waited for, whose coming wakes nobody.
        """
        if time.monotonic() > self._serve_at:
            self._serve_at = time.monotonic() + _SERVE_EVERY
            self.sink.gate.aside = True
            executor.spin_once(timeout_sec=0.0)
            self.sink.gate.aside = False
        if seconds == 0.0:
            return
        if self.source.is_shut():
            time.sleep(min(seconds, _POLL))
        elif not self.sink.wait(min(seconds, _SERVE_EVERY)):
            executor.spin_once(timeout_sec=seconds)

    def close(self) -> None:
        """The node stops: whoever listens is told that nothing more comes, and time to hear it."""
        if self._relays and any(not session.has_ended for session in self.sink.feeding()):
            self.source.lost += 1  # at least: its senders go on
        self.source.end(END)
        self._listens = False  # nobody asks it again
        self.sink.leave()
        self.peers.part()

    def _changed(self):
        self.sink.follow()
        if self._relays:
            self.source.look()  # those whom our senders know may be more
        self.source.advance()
        self.peers.say()

    def _look(self):
        self.peers.look()
        self.sink.follow()
        self.sink.report()
        self.source.look()

    def _state(self):
        return State(self._listens, self.source.sending(), self.sink.joined())
