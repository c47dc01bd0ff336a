"""The orientation estimator as a node: decode, one call, encode."""

from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import Trigger

from imu_fusion.estimation.orientation import OrientationParams
from imu_fusion.messages.streams import IMU_TOPIC, OrientationStream
from imu_fusion.nodes.base import Node, message_class, run_node
from imu_fusion.nodes.flow import Relay, reliable_qos, sensor_qos
from imu_fusion.parameters import Parameters, param
from imu_fusion.samples.guard import Verdict


@dataclass(frozen=True)
class OrientationNodeParams(Parameters):
    """What concerns the node, not the estimate."""

    qos: str = param("sensor_data", choices=("sensor_data", "reliable"),
                     doc="Subscriptions: sensor_data takes any publisher (live); reliable asks "
                         "for repeats of what was lost (replay).")


class OrientationEstimatorNode(Node):
    """Orientation from imu/data_raw and imu/mag, published on imu/data."""

    NAME = "orientation_estimator"
    PARAMETERS = (OrientationNodeParams, OrientationParams)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self._stream = OrientationStream(
            self.params(OrientationParams), emit=self._emit, warn=self.get_logger().warning)
        self._relay = Relay(self, self)
        self._outputs = {topic: self._relay.publisher(message_class(msgtype), topic)
                         for topic, msgtype in self._stream.outputs.items()}
        qos = {"reliable": reliable_qos, "sensor_data": sensor_qos}[
            self.params(OrientationNodeParams).qos]()
        self._names = {}  # resolved name -> ours
        for topic, layout in self._stream.inputs.items():
            inbox = self._relay.subscribe(message_class(layout.msgtype), topic,
                                          lambda cdr, _, topic=topic: self._stream.push(topic, cdr),
                                          qos)
            self._names[inbox.topic] = topic
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.start_diagnostics(self._status)

    # The stage of the relay: see nodes/flow.py.

    def reset(self, topics):
        self._stream.reset([self._names[topic] for topic in topics])

    def step(self):
        return self._stream.step()

    def topic_ended(self, topic):
        self._stream.topic_ended(self._names[topic])

    def finish(self):
        self._stream.finish()

    def stop(self):
        self._relay.close()
        super().stop()

    def _emit(self, topic, stamp, cdr):
        self._outputs[topic].publish(cdr)

    def _on_reset(self, request, response):
        self._stream.estimator.reset()
        response.success = True
        response.message = "the estimator starts anew with the next sample"
        return response

    def _status(self):
        guards = self._stream.stream.guards
        values = dict(self._stream.estimator.summary())
        values["held_for_merging"] = self._stream.stream.held
        values["bad_messages"] = self._stream.bad_messages
        for topic, guard in guards.items():
            values[f"{topic} taken"] = guard.counts[Verdict.OK]
            values |= {f"{topic} {why}": count for why, count in guard.refused().items()}
        if not guards[IMU_TOPIC].counts[Verdict.OK]:
            return DiagnosticStatus.WARN, f"no samples on {IMU_TOPIC} yet", values
        if any(guard.refused() for guard in guards.values()) or self._stream.bad_messages:
            return DiagnosticStatus.WARN, "samples were left out", values
        return DiagnosticStatus.OK, "running", values


def main(args=None):
    """Entry point of the executable."""
    return run_node(OrientationEstimatorNode, args)
