"""The smoothing trigger: waits until a replay has ended, then has it smoothed."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from std_srvs.srv import Trigger

from imu_fusion.errors import EstimationError, TopicError
from imu_fusion.nodes.base import IDLE, Node, message_class, run_node
from imu_fusion.nodes.flow import NEXT, Flow
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.streams.smoother import INPUTS, REQUIRED


@dataclass(frozen=True)
class SmoothingTriggerParams(Parameters):
    """Parameters of the smoothing trigger."""

    service: str = param("smoother/smooth", doc="service to call at the end of the replay")
    wait_timeout: float = param(30.0, doc="give up when the service is absent for so long",
                                unit="s", low=0)


class SmoothingTrigger(Node):
    """Wait for the end of a replay of imu/data_raw and fix, call smoother/smooth, tell the answer.

    Ends with code 0 if the recording was smoothed and with 1 if not.
    """

    NAME = "smoothing_trigger"
    PARAMETERS = (SmoothingTriggerParams,)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self._source = None  # instance whose replay has ended
        self._sent = None
        self._client = self.create_client(Trigger, self.params(SmoothingTriggerParams).service)
        self._seen_at = time.monotonic()
        self._flow = Flow(self, on_begin=self._on_begin)
        self._names = {self.resolve_topic_name(topic): topic for topic in INPUTS}
        for topic, kind in INPUTS.items():
            self._flow.input(message_class(kind.layout.msgtype), topic)

    def work(self) -> float:
        """See :meth:`Node.work`."""
        turn = self._flow.take()
        self._flow.finish(turn)
        for session in turn.over:
            if session.broken:
                raise EstimationError(f"not smoothed: the replay of {session.source} broke off")
            if session.event != NEXT:
                self._source = session.instance
                self._seen_at = time.monotonic()
        if self._source is None:
            return self._flow.pause(IDLE)
        if self._client.service_is_ready():
            self._seen_at = time.monotonic()
        elif time.monotonic() - self._seen_at > self.params(SmoothingTriggerParams).wait_timeout:
            raise TopicError(f"service {self._client.srv_name} is not there: does the smoother "
                             "run?")
        elif self._sent is not None:
            raise EstimationError(f"service {self._client.srv_name} has vanished without an answer")
        if self._sent is None:
            # The source stays until every sink has everything: the smoother may lag behind us.
            if self._client.service_is_ready() and self._source not in self._flow.peers:
                self._sent = self._client.call_async(Trigger.Request())
        elif self._sent.done():
            answer = self._sent.result()
            if not answer.success:
                raise EstimationError(f"not smoothed: {answer.message}")
            print(f"smoothing_trigger: {answer.message}", file=sys.stderr)
            self.finished = True
        return IDLE

    def _on_begin(self, session):
        played = {self._names.get(topic) for topic in session.topics}
        missing = [topic for topic in REQUIRED if topic not in played]
        if played & set(INPUTS) and missing:
            raise TopicError(f"{session.source} plays no {' and no '.join(missing)}: there will be "
                             "nothing to smooth")


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of the executable."""
    return run_node(SmoothingTrigger, args)
