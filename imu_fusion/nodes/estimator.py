"""What the nodes of all streaming estimators share: a Stream between DDS topics."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from imu_fusion.kernels import announced_compiling
from imu_fusion.nodes.base import Node, message_class
from imu_fusion.nodes.flow import Relay, reliable_qos, sensor_qos
from imu_fusion.samples.guard import Verdict
from imu_fusion.streams.stream import EstimatorNodeParams, Stream


class EstimatorNode(Node):
    """A node around a :class:`imu_fusion.streams.stream.Stream`; also the relay's processor."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self._announcing = ExitStack()
        self._announcing.enter_context(announced_compiling(self.get_logger().info))

    def close(self) -> None:
        self._announcing.close()
        super().close()

    def attach(self, stream: Stream, outputs: Mapping[str, str]) -> None:
        """Subscribe to the stream's inputs and advertise ``outputs`` (topic to type name)."""
        self._stream: Any = stream  # of the kind that the subclass has made
        self._relay = Relay(self, self)
        self._outputs = {topic: self._relay.publisher(message_class(msgtype), topic)
                         for topic, msgtype in outputs.items()}
        qos = {"reliable": reliable_qos, "sensor_data": sensor_qos}[
            self.params(EstimatorNodeParams).qos]()
        self._names = {}  # resolved name -> ours
        for topic, kind in stream.inputs.items():
            inbox = self._relay.subscribe(message_class(kind.layout.msgtype), topic,
                                          lambda cdr, _, topic=topic: stream.push(topic, cdr), qos)
            self._names[inbox.topic] = topic
        self.start_diagnostics(self._status)

    def emit(self, topic: str, stamp: int, cdr: bytes) -> None:
        """Publish what the stream has made."""
        self._outputs[topic].publish(cdr)

    def summary(self) -> dict:
        """Values of the estimator for diagnostics; subclasses add theirs."""
        return {}

    # The processor of the relay: see nodes/flow/relay.py.

    def reset(self, topics: Sequence[str]) -> None:
        self._stream.reset([self._names[topic] for topic in topics])

    def step(self) -> bool:
        return self._stream.step()

    def topic_ended(self, topic: str) -> None:
        self._stream.topic_ended(self._names[topic])

    def finish(self) -> None:
        self._stream.finish()

    def stop(self) -> None:
        self._relay.close()
        super().stop()

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
