"""What the nodes of all streaming estimators share: a Stream between DDS topics."""

import heapq
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from imu_fusion.kernels import announced_compiling
from imu_fusion.messages.layouts import NANOSECONDS
from imu_fusion.nodes.base import IDLE, Node, message_class
from imu_fusion.nodes.flow import Flow, reliable_qos, sensor_qos
from imu_fusion.samples.guard import Verdict
from imu_fusion.streams.stream import EstimatorNodeParams, Stream

_FAREWELL = 2.0  # s, in which a node that was asked to stop ends its session

Messages = tuple[str, Sequence[int], list[bytes]]
"""Topic, stamps, CDR bytes."""


class Blocks:
    """A Stream that takes blocks and returns what it makes."""

    def __init__(self, stream: Stream) -> None:
        self._stream: Any = stream
        self._made: list[Messages] = []
        stream.emit = lambda topic, stamp, cdr: self._made.append((topic, [stamp], [cdr]))

    def reset(self, session_topics: Sequence[str] | None) -> None:
        """See :meth:`Stream.reset`."""
        self._stream.reset(session_topics)

    def take(self, blocks: Mapping[str, Sequence[bytes]]) -> list[Messages]:
        """Messages of each topic in the order in which they came."""
        def stamps(rank, topic):
            for cdr in blocks[topic]:
                yield (int.from_bytes(cdr[4:8], "little", signed=True) * NANOSECONDS
                       + int.from_bytes(cdr[8:12], "little")), rank, topic, cdr

        topics = [topic for topic in self._stream.inputs if topic in blocks]
        for _, _, topic, cdr in heapq.merge(*(stamps(i, t) for i, t in enumerate(topics))):
            self._stream.push(topic, cdr)
            while self._stream.step():
                pass
        return self._take()

    def end(self, topics: Iterable[str]) -> list[Messages]:
        """Nothing more comes on these topics in this session."""
        for topic in topics:
            self._stream.topic_ended(topic)
        while self._stream.step():
            pass
        return self._take()

    def finish(self) -> list[Messages]:
        """All that is held back."""
        self._stream.finish()
        return self._take()

    def _take(self):
        made, self._made = self._made, []
        return made


class EstimatorNode(Node):
    """A node around a :class:`imu_fusion.streams.stream.Stream`."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self._announcing = ExitStack()
        self._announcing.enter_context(announced_compiling(self.get_logger().info))
        self._deadline: float | None = None  # of an end that was asked for

    def close(self) -> None:
        self._flow.close()
        self._announcing.close()
        super().close()

    def attach(self, stream: Stream, outputs: Mapping[str, str]) -> None:
        """Subscribe to the stream's inputs and advertise ``outputs`` (topic to type name)."""
        self._stream: Any = stream  # of the kind that the subclass has made
        self._blocks = Blocks(stream)
        self._flow = Flow(self, relays=True)
        self.problems = self._flow.problems
        self._outputs = {topic: self._flow.output(message_class(msgtype), topic)
                         for topic, msgtype in outputs.items()}
        qos = {"reliable": reliable_qos, "sensor_data": sensor_qos}[
            self.params(EstimatorNodeParams).qos]()
        inputs = {topic: self._flow.input(message_class(kind.layout.msgtype), topic, qos)
                  for topic, kind in stream.inputs.items()}
        self._names = {taken.topic: topic for topic, taken in inputs.items()}  # resolved -> ours
        self.start_diagnostics(self._status)

    def work(self) -> float:
        """One turn: take all that waits, one call, publish. See :meth:`Node.work`."""
        if self._flow.send() and self._deadline is None:  # nothing waits to leave
            turn = self._flow.take()
            if turn.begun is not None:
                self._blocks.reset([self._names[topic] for topic in turn.begun])
            self.publish(self._blocks.take({
                self._names[topic]: [cdr for cdr, _ in messages]
                for topic, messages in turn.blocks.items()}))
            if turn.ended:
                self.publish(self._blocks.end([self._names[topic] for topic in turn.ended]))
            if turn.event:
                self.publish(self._blocks.finish())
            self._flow.finish(turn)
        if self._deadline is not None:
            self.finished = self._flow.source.drained() or time.monotonic() > self._deadline
        return self._flow.pause(IDLE)

    def publish(self, made: Iterable[Messages]) -> None:
        """Publish what the stream has made."""
        for topic, _, cdrs in made:
            output = self._outputs[topic]
            for cdr in cdrs:
                output.publish(cdr)

    def stop(self) -> None:
        """End the session, so that whoever listens knows; wait for that only briefly."""
        self._deadline = time.monotonic() + _FAREWELL
        self._flow.close()

    def summary(self) -> dict:
        """Values of the estimator for diagnostics; subclasses add theirs."""
        return {}

    def _status(self):
        guards = self._stream.merged.guards
        values = dict(self.summary(), held_for_merging=self._stream.merged.held,
                      bad_messages=self._stream.bad_messages)
        for topic, guard in guards.items():
            values[f"{topic} taken"] = guard.counts[Verdict.OK]
            values |= {f"{topic} {why}": count for why, count in guard.refused().items()}
        if not any(guard.counts[Verdict.OK] for guard in guards.values()):
            return DiagnosticStatus.WARN, "no samples yet on " + ", ".join(guards), values
        if any(guard.refused() for guard in guards.values()) or self._stream.bad_messages:
            return DiagnosticStatus.WARN, "samples were left out", values
        return DiagnosticStatus.OK, "running", values
