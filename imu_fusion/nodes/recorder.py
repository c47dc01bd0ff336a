"""The recorder: any topics into a rosbag2 MCAP directory, bytes as they came."""

import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from imu_fusion.errors import BagError, ParameterError, TopicError
from imu_fusion.nodes.base import IDLE, Node, message_class
from imu_fusion.nodes.flow import DEPTH, NAP_LIVE, NAP_PATIENT, NEXT, Flow, steady_timer
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.losses import write_losses
from imu_fusion.recordings.qos import qos_profile


@dataclass(frozen=True)
class RecorderParams(Parameters):
    """Parameters of the recorder node."""

    out: str = param("", doc="directory to write; its parent directories are made")
    topics: tuple[str, ...] = param((), doc="topics to record; empty: all, or those of `regex`")
    regex: str | None = param(None, doc="record topics that this regular expression matches")
    exclude: tuple[str, ...] = param(
        ("/rosout", "/parameter_events", ".*/_flow/.*"),
        doc="regular expressions of topics that are not recorded unless listed in `topics`")
    compression: str = param("zstd", doc="compression of chunks", choices=("zstd", "lz4", "none"))
    chunk_size: int = param(256 * 1024, doc="size of a chunk: what a crash can lose", unit="bytes",
                            low=1024, high=2**28)
    overwrite: bool = param(False, doc="replace a recording that is there already")
    whole: bool = param(
        False, doc="let the recording appear when its sources have ended, or, if the recorder is "
        "ended before, not at all")
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
    # What is latched comes at once, however much: more than any depth.
    return QoSProfile(
        depth=DEPTH, history=HistoryPolicy.KEEP_ALL if latched else HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))


class Recorder(Node):
    """Record topics into a rosbag2 MCAP directory.

    The log time of a message is its time of receipt (the time of /clock with
    use_sim_time), its publish time is the sender's; header stamps stay inside.
    """

    NAME = "recorder"
    PARAMETERS = (RecorderParams,)

    def _set_up(self):
        p = self._p = self.params(RecorderParams)
        if not p.out:
            raise ParameterError("parameter 'out' of node recorder: no directory given; "
                                 "add -p out:=DIRECTORY")
        self._named = {self.resolve_topic_name(topic) for topic in p.topics}
        self._regex = _compile("regex", p.regex) if p.regex is not None else None
        self._excluded = [_compile("exclude", pattern) for pattern in p.exclude]
        self._skipped, self._unclear = set(), set()
        self._expected = {f"/{name.lstrip('/')}" for name in p.expected_sources}
        self._sim_time = self.get_parameter("use_sim_time").value
        self._writer = BagWriter(p.out, compression=p.compression, chunk_size=p.chunk_size,
                                 overwrite=p.overwrite, whole=p.whole)
        self._is_wanted = not p.whole
        # Under use_sim_time nothing is asked for before there is a time to record it at.
        self._flow = Flow(self, on_begin=self._on_begin,
                          nap=NAP_LIVE if self._sim_time else NAP_PATIENT,
                          hold=lambda: self._sim_time and not self._now())
        self.problems = self._flow.problems
        self._inputs = self._flow.sink.inputs
        self._msgtypes: dict[str, str] = {}
        self._has_ended = False  # a session of which something was recorded
        steady_timer(self, 0.2, self._discover)
        self.start_diagnostics("recording", lambda: (b"\0", "recording", dict(self._writer.counts)))

    def work(self) -> float:
        """One turn: take all that waits, write it. See :meth:`Node.work`."""
        turn = self._flow.take()
        for topic, messages in turn.blocks.items():
            self._write(topic, messages)
        self._flow.finish(turn)
        for session in turn.over:
            self._has_ended = True
            if session.event != NEXT:
                self._expected.discard(session.source)
        if (self._p.end_with_sources and self._has_ended and not self._expected
                and not self._flow.sink.feeding() and not self._flow.sink.promised()):
            self.finished = self._is_wanted = True
        return self._flow.pause(IDLE)

    def close(self) -> None:
        """Close the recording and say what is in it."""
        self._flow.close()
        if not self._is_wanted:
            self._writer.abandon()
            return
        recorded = dict(self._writer.counts)
        notes = {topic: _notes(self._inputs[topic]) for topic in recorded if topic in self._inputs}
        if self.problems:
            write_losses(self._writer, self._now() or time.time_ns(), self.problems, {
                topic: ", ".join([f"{count} messages", *notes.get(topic, ())])
                for topic, count in recorded.items()})
        self._writer.close()
        print(f"recorder: wrote {self._p.out}", file=sys.stderr)
        for topic, count in sorted(recorded.items()):
            print(f"  {topic}: " + ", ".join([f"{count} messages", *notes.get(topic, ())]),
                  file=sys.stderr)
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
        for topic, sent in session.said.topics.items():
            if topic in self._inputs:
                self._write(topic, self._inputs[topic].take())  # what came before the session
            else:
                self._subscribe(topic, [sent.msgtype])

    def _discover(self):
        for topic, msgtypes in self.get_topic_names_and_types():
            if topic not in self._inputs and self.count_publishers(topic):
                self._subscribe(topic, msgtypes)

    def _subscribe(self, topic, msgtypes):
        if topic in self._inputs or topic in self._skipped or not self._selects(topic):
            return
        if len(msgtypes) > 1:    # somebody is mistaken, and may see it
            if topic not in self._unclear:
                self._unclear.add(topic)
                self.get_logger().warning(f"{topic} is not recorded while it has several types: "
                                          + ", ".join(msgtypes))
            return
        try:
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

        self._msgtypes[topic] = msgtype
        self._flow.input(cls, topic, adapted_qos(infos))

    def _now(self):
        return self.get_clock().now().nanoseconds

    def _write(self, topic, messages):
        msgtype, now = self._msgtypes[topic], self._now() if self._sim_time else 0
        try:
            for cdr, info in messages:
                received = now or info["received_timestamp"] or time.time_ns()
                self._writer.write(topic, msgtype, cdr, received,
                                   info["source_timestamp"] or received)
        except BagError:
            self._is_wanted = False
            raise


def _notes(taken):
    """What must be said of a topic beside the number of its messages."""
    return [f"{words} {count}" if words.endswith("after") else f"{count} {words}"
            for words, count in (("joined after", taken.missed), ("LOST", taken.lost),
                                 ("not of the sessions", taken.unexpected)) if count]


def _compile(name, pattern):
    try:
        return re.compile(pattern)
    except re.error as error:
        raise ParameterError(f"parameter '{name}' of node recorder: '{pattern}' is not a regular "
                             f"expression ({error})") from None
