"""The other instances of our nodes, as the graph shows them, and what they say."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from imu_fusion.nodes.flow.qos import PARTICIPANT, full_name, gid
from imu_fusion.nodes.flow.state import MARK, STATE_QOS, State

PATIENCE = 10.0  # s, for one that says nothing, or two that say it; longer than a lease


class Peer:
    """Another instance; ``state`` is what it has said and is believed."""

    def __init__(self, instance: str) -> None:
        self.instance = instance
        self.name = instance.partition(MARK)[0]
        self.writer = ""  # gid of who speaks
        self.state: State | None = None
        self.heard: State | None = None  # not yet believed,
        self.heard_at = 0.0  # since then
        self.subscription = None
        self.since = time.monotonic()
        self.doubted: float | None = None  # since when there are two writers
        self.complained = self.is_gone = False

    @property
    def is_silent(self) -> bool:
        """Whether it may still say something for the first time."""
        return self.state is None and time.monotonic() - self.since < PATIENCE


class Peers(dict[str, Peer]):
    """By instance. :meth:`look` compares them with the graph.

    Args:
        own: topic of this node's own state.
        changed: called when somebody has said something, has come or has gone.
        problem: called with a text for the user.
    """

    def __init__(self, node: Node, own: str, changed: Callable[[], None],
                 problem: Callable[[str], None]) -> None:
        super().__init__()
        self._node, self._own = node, own
        self._changed, self._problem = changed, problem
        self._given_up: set[str] = set()

    def look(self) -> None:
        """Find who has come and gone; believe what can be believed now."""
        for topic, _ in self._node.get_topic_names_and_types():
            if (MARK in topic and topic != self._own and topic not in self
                    and topic not in self._given_up and self._writers(topic)):
                peer = self[topic] = Peer(topic)
                self._listen(peer)
        for peer in list(self.values()):
            if not peer.is_gone:  # what changes may call look, too
                self._examine(peer)

    def _writers(self, topic):
        return {gid(info) for info in self._node.get_publishers_info_by_topic(topic)}

    def _listen(self, peer):
        if peer.subscription is not None:
            self._node.destroy_subscription(peer.subscription)
        peer.subscription = self._node.create_subscription(
            DiagnosticArray, peer.instance, lambda message: self._hear(peer, message), STATE_QOS)

    def _forget(self, peer):
        """It has gone: hear its last words first."""
        peer.is_gone = True
        if peer.state is not None and peer.doubted is None:
            last, handle = peer.heard, peer.subscription.handle
            with handle:
                while (taken := handle.take_message(DiagnosticArray, False)) is not None:
                    with suppress(ValueError):
                        last = State.of(taken[0])
            if last is not None:
                peer.state = replace(peer.state, joined=last.joined)
            self._changed()
        self._node.destroy_subscription(peer.subscription)
        del self[peer.instance]
        self._changed()

    def _examine(self, peer):
        writers = self._writers(peer.instance)
        if len(writers) == 1 and not peer.writer:
            peer.writer, = writers
        if not writers or (peer.writer and peer.writer not in writers):
            self._given_up |= {peer.instance} if writers else set()
            self._forget(peer)
        elif len(writers) > 1:
            peer.doubted = peer.doubted or time.monotonic()
            if time.monotonic() - peer.doubted > PATIENCE:
                self._given_up.add(peer.instance)
                self._problem(f"two publishers of {peer.instance}: neither is believed")
                self._forget(peer)
        elif peer.doubted is not None:
            peer.doubted = peer.heard = None
            self._listen(peer)  # what was said last may be of the other one
        elif peer.heard is not None:
            self._believe(peer)
        elif peer.state is None and not peer.is_silent:
            self._complain(peer, "says nothing that can be believed")

    def _hear(self, peer, message):
        if peer.is_gone:
            return
        if peer.heard is None:
            peer.heard_at = time.monotonic()
        try:
            peer.heard = State.of(message)
        except ValueError as error:
            self._complain(peer, error)
            return
        self._examine(peer)

    def _believe(self, peer):
        """Take what was heard for true, if the data that it speaks of are those of its node."""
        for topic, sent in peer.heard.sending.topics.items():
            if not any(gid(info) == sent.writer and full_name(info) == peer.name
                       and sent.writer[:PARTICIPANT] == peer.writer[:PARTICIPANT]
                       for info in self._node.get_publishers_info_by_topic(topic)):
                if time.monotonic() - peer.heard_at > PATIENCE:
                    self._complain(peer, f"does not publish {topic}, as it says")
                return
        peer.state, peer.heard = peer.heard, None
        self._changed()

    def _complain(self, peer, what):
        if not peer.complained:
            peer.complained = True
            self._node.get_logger().warning(f"{peer.instance} is ignored: {what}")
