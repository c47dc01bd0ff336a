"""The other instances of our nodes, as the graph shows them, and what they say."""

import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from imu_fusion.nodes.flow.qos import (
    AT_ONCE,
    PARTICIPANT,
    SILENT,
    Endpoints,
    full_name,
    gid,
    made,
)
from imu_fusion.nodes.flow.state import MARK, STATE_QOS, State

PATIENCE = 10.0  # s, for one that says nothing, or two that say it; longer than a lease
_LAST_WORDS = 0.5  # s


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
    """By instance. :meth:`look` compares them with the graph, :meth:`say` tells them of us.

    Attributes: ``own``, the topic of this node's state: its instance; ``participant``, how its
    gids begin; ``problems``, texts: why the exit code is 3.

    Args:
        state: returns what there is to say.
        changed: called when somebody has said something, has come or has gone.
    """

    def __init__(self, node: Node, state: Callable[[], State],
                 changed: Callable[[], None]) -> None:
        super().__init__()
        self.node, self._state, self._changed = node, state, changed
        self.own = f"{node.get_fully_qualified_name()}{MARK}i{uuid.uuid4().hex[:12]}"
        self._publisher, own_gid = made(node.get_publishers_info_by_topic, self.own, lambda: (
            node.create_publisher(DiagnosticArray, self.own, STATE_QOS, event_callbacks=SILENT)))
        self.participant = own_gid[:PARTICIPANT]
        self._publishers = Endpoints(node.count_publishers, node.get_publishers_info_by_topic)
        self.problems: list[str] = []
        self._said: State | None = None
        self._given_up: set[str] = set()

    def say(self) -> None:
        """Publish this node's state, if it is news."""
        state = self._state()
        if state != self._said:
            self._said = state
            self._publisher.publish(state.message())

    def problem(self, text: str) -> None:
        """Say what makes the exit code 3."""
        self.problems.append(text)
        self.node.get_logger().error(text)

    def part(self) -> None:
        """Give those who listen time to hear the last words."""
        deadline = time.monotonic() + _LAST_WORDS
        while not self._publisher.wait_for_all_acked(AT_ONCE) and time.monotonic() < deadline:
            time.sleep(0.002)

    def look(self) -> None:
        """Find who has come and gone; believe what can be believed now."""
        for topic, _ in self.node.get_topic_names_and_types():
            if (MARK in topic and topic != self.own and topic not in self
                    and topic not in self._given_up and self._writers(topic)):
                peer = self[topic] = Peer(topic)
                self._listen(peer)
        for peer in list(self.values()):
            if not peer.is_gone:  # what changes may call look, too
                self._examine(peer)

    def _writers(self, topic):
        return {gid(info) for info in self._publishers[topic]}

    def _listen(self, peer):
        if peer.subscription is not None:
            self.node.destroy_subscription(peer.subscription)
        peer.subscription = self.node.create_subscription(
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
        self.node.destroy_subscription(peer.subscription)
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
                self.problem(f"two publishers of {peer.instance}: neither is believed")
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
                       for info in self.node.get_publishers_info_by_topic(topic)):
                if time.monotonic() - peer.heard_at > PATIENCE:
                    self._complain(peer, f"does not publish {topic}, as it says")
                return
        peer.state, peer.heard = peer.heard, None
        self._changed()

    def _complain(self, peer, what):
        if not peer.complained:
            peer.complained = True
            self.node.get_logger().warning(f"{peer.instance} is ignored: {what}")
