"""The recorder: any topics into a rosbag2 MCAP directory, bytes as they came."""

import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from imu_fusion.errors import BagError, ParameterError, TopicError
from imu_fusion.nodes.base import Node, message_class, run_node
from imu_fusion.nodes.flow import DEPTH, NEXT, FlowSink, steady_timer
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.qos import qos_profile


@dataclass(frozen=True)
class RecorderParams(Parameters):
    """Parameters of the recorder node."""

    out: str = param("", doc="directory to write; its parent directories are made")
    topics: tuple[str, ...] = param((), doc="topics to record; empty: all, or those of `regex`")
    regex: str | None = param(None, doc="record topics that this regular expression matches")
    exclude: tuple[str, ...] = param(
        ("/rosout", "/parameter_events", "/flow/.*"),
        doc="regular expressions of topics that are not recorded unless listed in `topics`")
    compression: str = param("zstd", doc="compression of chunks", choices=("zstd", "lz4", "none"))
    chunk_size: int = param(256 * 1024, doc="size of a chunk: what a crash can lose", unit="bytes",
                            low=1024, high=2**28)
    overwrite: bool = param(False, doc="replace a recording that is there already")
    end_with_sources: bool = param(
        True, doc="close when all sources of recorded topics have said that they ended")
    expected_sources: tuple[str, ...] = param(
        (), doc="names of nodes that may begin later: do not close before they have ended, too")


def offered(info: TopicEndpointInfo) -> dict:
    """The rosbag2 QoS profile of a publisher's endpoint info."""
    qos = info.qos_profile
    return qos_profile(qos.depth, qos.reliability.name.lower(), qos.durability.name.lower(),
                       qos.history.name.lower())


def adapted_qos(infos: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """A subscription QoS that all of these publishers match: as strict as the laxest."""
    reliable = all(i.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT for i in infos)
    latched = bool(infos) and all(
        i.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for i in infos)
    return QoSProfile(
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))


class Recorder(Node):
    """Record topics into a rosbag2 MCAP directory.

    The log time of a message is its time of receipt (the time of /clock with
    use_sim_time), its publish time is the sender's; header stamps stay inside.
    """

    NAME = "recorder"
    PARAMETERS = (RecorderParams,)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        p = self._p = self.params(RecorderParams)
        if not p.out:
            raise ParameterError("parameter 'out' of node recorder: no directory given; "
                                 "add -p out:=DIRECTORY")
        self._named = {self.resolve_topic_name(topic) for topic in p.topics}
        self._regex = _compile("regex", p.regex) if p.regex is not None else None
        self._excluded = [_compile("exclude", pattern) for pattern in p.exclude]
        self._skipped = set()
        self._expected = {f"/{name.lstrip('/')}" for name in p.expected_sources}
        self._sim_time = self.get_parameter("use_sim_time").value
        self._writer = BagWriter(p.out, compression=p.compression, chunk_size=p.chunk_size,
                                 overwrite=p.overwrite)
        self._failed = False
        # Under use_sim_time nothing is asked for before there is a time to record it at.
        self._flow = FlowSink(self, on_begin=self._on_begin, on_end=self._on_end,
                              hold=lambda: self._sim_time and not self._now())
        steady_timer(self, 0.2, self._discover)
        self.start_diagnostics(lambda: (b"\0", "recording", dict(self._writer.counts)))

    def close(self) -> None:
        """Close the recording and say what is in it."""
        if self._failed:
            self._writer.abandon()
            return
        self._writer.close()
        print(f"recorder: wrote {self._p.out}", file=sys.stderr)
        for topic, count in sorted(self._writer.counts.items()):
            inbox = self._flow.inboxes[topic]
            print(f"  {topic}: {count} messages"
                  + (f", joined after {inbox.missed}" if inbox.missed else "")
                  + (f", {inbox.lost} LOST" if inbox.lost else ""), file=sys.stderr)
        for topic in sorted(self._named - self._writer.counts.keys()):
            print(f"  {topic}: never appeared", file=sys.stderr)

    def _selects(self, topic):
        if topic in self._named:
            return True
        if any(pattern.fullmatch(topic) for pattern in self._excluded):
            return False
        if self._regex is not None:
            return self._regex.fullmatch(topic) is not None
        return not self._named

    def _on_begin(self, session):
        # Before the answer: what the source is about to send must find us subscribed.
        for topic, msgtype in session.topics.items():
            self._subscribe(topic, [msgtype])

    def _on_end(self, session):
        if session.event == NEXT:
            return
        self._expected.discard(session.source)
        if self._p.end_with_sources and not self._expected and not self._flow.feeding():
            self.finished = True

    def _discover(self):
        for topic, msgtypes in self.get_topic_names_and_types():
            if topic not in self._flow.inboxes and self.count_publishers(topic):
                self._subscribe(topic, msgtypes)

    def _subscribe(self, topic, msgtypes):
        if topic in self._flow.inboxes or topic in self._skipped or not self._selects(topic):
            return
        try:
            if len(msgtypes) > 1:
                raise TopicError(f"topic {topic} has several types: {', '.join(msgtypes)}")
            msgtype, = msgtypes
            cls = message_class(msgtype)
            infos = self.get_publishers_info_by_topic(topic)
            self._writer.add_topic(topic, msgtype, [offered(i) for i in infos] or None)
        except (TopicError, BagError) as error:
            if topic in self._named:
                raise
            self._skipped.add(topic)
            self.get_logger().warning(f"{topic} is not recorded: {error}")
            return

        def store(cdr, info):
            self._write(topic, msgtype, cdr, info)

        self._flow.subscribe(cls, topic, store, adapted_qos(infos))

    def _now(self):
        return self.get_clock().now().nanoseconds

    def _write(self, topic, msgtype, cdr, info):
        received = self._now() if self._sim_time else info["received_timestamp"] or time.time_ns()
        try:
            self._writer.write(topic, msgtype, cdr, received, info["source_timestamp"] or received)
        except BagError:
            self._failed = True
            raise


def _compile(name, pattern):
    try:
        return re.compile(pattern)
    except re.error as error:
        raise ParameterError(f"parameter '{name}' of node recorder: '{pattern}' is not a regular "
                             f"expression ({error})") from None


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_node(Recorder, args)
