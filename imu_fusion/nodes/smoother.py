"""The smoother as a node: collects, smooths in a child process when asked, publishes."""

import multiprocessing
import sys
import time

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy
from rclpy.task import Future
from std_srvs.srv import Trigger

from imu_fusion.compiling import announced_compiling
from imu_fusion.errors import ImuFusionError
from imu_fusion.messages import smoothing
from imu_fusion.messages.smoothing import (INPUTS, OUTPUTS, Collection, SmootherNodeParams,
                                           SmoothingParams)
from imu_fusion.nodes.base import IDLE, Node, message_class, run_node
from imu_fusion.nodes.flow import FlowSink, FlowSource, reliable_qos, sensor_qos

_LATCHED = 100_000  # messages per topic that late subscribers still get
_POLL = 0.002  # s between callbacks while a child smooths, see work()


def _smooth_in_child(connection, params, logs):
    """Entry point of the child process: sends (summary, messages) or (None, reason)."""
    try:
        with announced_compiling(lambda text: print(f"smoother: {text}", file=sys.stderr)):
            result = smoothing.smooth(params, logs)
        frame_id = logs[smoothing.IMU_TOPIC][0].frame_id
        connection.send(("; ".join([result.summary(), *result.remarks()]),
                         list(smoothing.messages(result, frame_id, params.path_rate))))
    except ImuFusionError as error:
        connection.send((None, str(error)))
    except KeyboardInterrupt:
        pass  # the parent is ending, too


class SmootherNode(Node):
    """Trajectory from imu/data_raw, imu/mag, fix and fix_velocity, when smoother/smooth is called.

    Services (std_srvs/Trigger): ~/smooth, ~/clear.
    """

    NAME = "smoother"
    PARAMETERS = (SmootherNodeParams, SmoothingParams)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        p = self.params(SmootherNodeParams)
        self._collection = Collection(p.memory_limit * 1e6, self.get_logger().warning)
        self._sink = FlowSink(self, on_begin=self._on_begin)
        qos = {"reliable": reliable_qos, "sensor_data": sensor_qos}[p.qos]()
        for topic, kind in INPUTS.items():
            self._sink.subscribe(message_class(kind.layout.msgtype), topic,
                                 lambda cdr, _, topic=topic: self._collection.push(topic, cdr), qos)
        self._source = FlowSource(self)
        latched = reliable_qos(_LATCHED, DurabilityPolicy.TRANSIENT_LOCAL)
        self._outputs = {topic: self._source.publisher(message_class(msgtype), topic, latched)
                         for topic, msgtype in OUTPUTS.items()}
        self._child = self._answer = self._pipe = None
        # Reentrant: a second call is answered while the first one still waits.
        self.create_service(Trigger, "~/smooth", self._on_smooth,
                            callback_group=ReentrantCallbackGroup())
        self.create_service(Trigger, "~/clear", self._on_clear)
        self.start_diagnostics(self._status)

    def work(self):
        """See :meth:`Node.work`."""
        if self._answer is None:
            return IDLE
        # The executor polls the coroutine of a waiting service without rest.
        time.sleep(_POLL)
        if self._answer.done():
            pass
        elif self._pipe.poll():
            self._child_answered()
        elif not self._child.is_alive() and not self._pipe.poll():
            self._answer.set_result((None, "the smoothing process ended without an answer (exit "
                                     f"code {self._child.exitcode}): out of memory?"))
        return 0.0

    def close(self):
        """End the child, if there is one."""
        if self._child is not None and self._child.is_alive():
            self._child.kill()
            self._child.join()

    def stop(self):
        self._source.end()
        super().stop()

    def _on_begin(self, session):
        if session.topics.keys() & {self.resolve_topic_name(topic) for topic in INPUTS}:
            self._collection.clear()

    async def _on_smooth(self, request, response):
        if self._answer is not None:
            response.success, response.message = False, "refused: smoothing is already running"
            return response
        try:
            logs = self._collection.logs()
            smoothing.newest_epoch(logs)
        except ImuFusionError as error:
            response.success, response.message = False, str(error)
            return response
        spawn = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawn.Pipe(duplex=False)
        self._child = spawn.Process(target=_smooth_in_child, daemon=True,
                                    args=(theirs, self.params(SmoothingParams), logs))
        self._answer = Future()
        self._child.start()
        theirs.close()
        counts = ", ".join(f"{len(log)} {topic}" for topic, (log, _) in logs.items())
        self.get_logger().info(f"smoothing {counts}")
        summary, outcome = await self._answer
        self._child.join()
        self._child = self._answer = None
        self._pipe.close()
        response.success = summary is not None
        response.message = summary if response.success else outcome
        if response.success:
            self._publish(outcome)
        self.get_logger().info(response.message)
        return response

    def _child_answered(self):
        try:
            self._answer.set_result(self._pipe.recv())
        except EOFError:
            self._answer.set_result((None, "the smoothing process ended without an answer"))

    def _publish(self, messages):
        self._source.begin()
        for topic, _, cdr in messages:
            self._outputs[topic].publish(cdr)
        self._source.end()

    def _on_clear(self, request, response):
        self._collection.clear()
        response.success, response.message = True, "the collection is empty"
        return response

    def _status(self):
        collection = self._collection
        values = {f"{topic} collected": n for topic, n in collection.counts().items()}
        values |= {f"{topic} {why}": n for topic, guard in collection.guards.items()
                   for why, n in guard.refused().items()}
        values |= {"megabytes": round(collection.bytes / 1e6, 1), "dropped": collection.dropped,
                   "bad_messages": collection.bad_messages}
        if collection.dropped:
            return DiagnosticStatus.ERROR, "memory_limit reached, samples are dropped", values
        if self._answer is not None:
            return DiagnosticStatus.OK, "smoothing", values
        return DiagnosticStatus.OK, "collecting", values


def main(args=None):
    """Entry point of the executable."""
    return run_node(SmootherNode, args)
