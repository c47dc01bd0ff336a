"""What the nodes of all streaming estimators share: a Stream between DDS topics."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile

from imu_fusion.kernels import announced_compiling
from imu_fusion.nodes.base import IDLE, Node, message_class, output_class
from imu_fusion.nodes.flow import NAP_LIVE, Flow, Turn, live_qos
from imu_fusion.samples.guard import Verdict
from imu_fusion.streams.stream import EstimatorNodeParams, Messages, Stream


class EstimatorNode(Node):
    """A node around a :class:`imu_fusion.streams.stream.Stream`.

    Class attribute ``TASK``: what its diagnostics are of.
    """

    TASK = "samples"

    def _set_up(self):
        self._announcing = ExitStack()
        self._announcing.enter_context(announced_compiling(self.get_logger().info))
        self._stopping = False

    def close(self) -> None:
        self._flow.close()
        self._announcing.close()
        super().close()

    def attach(self, stream: Stream, outputs: Mapping[str, str], qos: QoSProfile | None = None,
               **options: Any) -> None:
        """Subscribe to the stream's inputs and advertise ``outputs`` (topic to type name).

        Args:
            qos: of the outputs, if it is not the usual one.
            options: of the Flow, where they are not those of a node that answers each sample.
        """
        # What is refused is refused before others see a reader of ours and wait for its answer.
        types = {topic: output_class(msgtype) for topic, msgtype in outputs.items()}
        woken_by = stream.answered or stream.inputs.keys()
        nap = NAP_LIVE if len(woken_by) > 1 else 0.0
        self._stream: Any = stream  # of the kind that the subclass has made
        self._flow = Flow(self, **{"relays": True, "nap": nap} | options)
        self.problems = self._flow.problems
        self._outputs = {topic: self._flow.output(msg_type, topic, qos)
                         for topic, msg_type in types.items()}
        self._names = {}  # resolved name -> ours
        for topic, kind in stream.inputs.items():
            taken = self._flow.input(
                message_class(kind.layout.msgtype), topic,
                live_qos(self.params(EstimatorNodeParams).qos), topic in woken_by)
            self._names[taken.topic] = topic
        self.start_diagnostics(self.TASK, self._status)

    def work(self) -> float:
        """One turn: take all that waits, one call, publish. See :meth:`Node.work`."""
        if self._flow.send() and not self._stopping:  # nothing waits to leave
            turn = self._flow.take()
            self.publish(self.through(turn))
            self._flow.finish(turn)
        self.finished = self._stopping and self._flow.source.drained()
        return self._flow.pause(IDLE)

    def through(self, turn: Turn) -> Iterator[Messages]:
        """What the stream makes of a turn."""
        if turn.begun is not None:
            self._stream.reset([self._names[topic] for topic in turn.begun])
        if turn.blocks:
            yield from self._stream.answer({self._names[topic]: [cdr for cdr, _ in messages]
                                          for topic, messages in turn.blocks.items()})
        if turn.ended:
            yield from self._stream.end([self._names[topic] for topic in turn.ended])
        if turn.event:
            yield from self._stream.finish()

    def publish(self, made: Iterable[Messages]) -> None:
        """Publish what the stream has made."""
        for part in made:
            self._outputs[part.topic].publish(*part.cdrs)

    def stop(self) -> None:
        """End the session, so that whoever listens knows."""
        self._stopping = True
        self._flow.close()

    def restart(self) -> str:
        """The service ~/reset."""
        self._stream.restart()
        return "the estimator starts anew with the next sample"

    def summary(self) -> dict:
        """Values of the estimator for diagnostics; subclasses add theirs."""
        return {}

    def _status(self):
        stream = self._stream
        values = dict(self.summary(), held_for_merging=stream.held)
        refused = {topic: stream.refused(topic) for topic in stream.inputs}
        taken = {topic: guard.counts[Verdict.OK] for topic, guard in stream.guards.items()}
        for topic, count in taken.items():
            values[f"{topic} taken"] = count
            values |= {f"{topic} {why}": n for why, n in refused[topic].items()}
        if not any(taken.values()):
            return DiagnosticStatus.WARN, "no samples yet on " + ", ".join(taken), values
        remarks = [*stream.findings, *stream.remarks()]
        values |= {f"remark {k + 1}": text for k, text in enumerate(remarks)}
        if any(refused.values()):
            return DiagnosticStatus.WARN, "samples were left out", values
        if remarks:
            return DiagnosticStatus.WARN, "running; see the remarks", values
        return DiagnosticStatus.OK, "running", values
