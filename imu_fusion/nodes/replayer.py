"""The replayer: a recording as live topics, its bytes undecoded, its stamps untouched."""

import fnmatch
import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import cast

from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from imu_fusion.errors import ParameterError, RefusedError, TopicError
from imu_fusion.nodes.base import Node, message_class
from imu_fusion.nodes.flow import DEPTH, END, NEXT, Flow, reliable_qos, steady_timer
from imu_fusion.nodes.progress import Progress
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.recordings.bag_reader import open_bag

_BURST = 200  # messages sent before services and acknowledgements are looked at
_BLOCKED = 0.05  # s, wait of the executor while nothing may be sent; callbacks end it


@dataclass(frozen=True)
class ReplayerParams(Parameters):
    """Parameters of the replayer node."""

    bag: str = param("", doc="recording: rosbag2 directory, .mcap, .db3 or ROS 1 .bag")
    rate: float = param(1.0, doc="speed as a multiple of the recorded pace; 0: as fast as our "
                        "nodes take it, nothing lost", low=0, read_only=False)
    foreign_rate: float = param(
        1.0, doc="speed at rate 0 while nodes that are not ours subscribe: they drop what "
        "their queues cannot hold; 0: do not regard them", low=0)
    seek: float | None = param(
        None, doc="set while playing: jump there, counted from the start of the recording; "
        "estimators start anew", unit="s", low=0, read_only=False)
    start_offset: float = param(0.0, doc="skip this much of the recording", unit="s", low=0)
    duration: float | None = param(None, doc="play this much of the recording", unit="s", low=0)
    loop: bool = param(False, doc="start again at the end")
    topics: tuple[str, ...] = param((), doc="topics to play, by their recorded or their new names, "
                                    "* and ? permitted; empty: all")
    exclude: tuple[str, ...] = param((), doc="topics to leave out, by the names that they are "
                                     "published by, * and ? permitted")
    remap: tuple[str, ...] = param((), doc="renamed topics, each as recorded:=published")
    clock: float = param(0.0, doc="rate of /clock in real time (at rate 0 in recorded time); "
                         "0: no /clock", unit="Hz", low=0)
    wait_for_subscribers: int = param(
        1, doc="number of nodes that must subscribe before the first message", low=0)
    wait_for_nodes: tuple[str, ...] = param(
        (), doc="names of our nodes that must have joined before the first message")
    wait_timeout: float | None = param(
        None, doc="give up waiting for subscribers after this time; unset: never", unit="s", low=0)
    start_paused: bool = param(False, doc="wait for the service resume or step")


class Replayer(Node):
    """Play a recording on its topics.

    Services (std_srvs/Trigger): ~/pause, ~/resume, ~/step (one message).
    """

    NAME = "replayer"
    PARAMETERS = (ReplayerParams,)

    def _set_up(self):
        p = self.params(ReplayerParams)
        if not p.bag:
            raise ParameterError("parameter 'bag' of node replayer: no recording given; "
                                 "add -p bag:=PATH")
        self._bag = open_bag(p.bag, remap=_remapping(p.remap))
        for warning in self._bag.warnings:
            self.get_logger().warning(warning)
        self._start = self._bag.start_time + round(p.start_offset * 1e9)
        self._stop = self._bag.end_time if p.duration is None else min(
            self._bag.end_time, self._start + round(p.duration * 1e9))
        if self._start >= self._bag.end_time > 0:
            raise ParameterError(
                f"parameter 'start_offset': {p.start_offset} s is beyond the end of {p.bag} "
                f"({(self._bag.end_time - self._bag.start_time) * 1e-9:.3f} s long)")
        self._flow = Flow(self, listens=False, wait_for=p.wait_for_nodes)
        self._source = self._flow.source
        self.problems = self._flow.problems
        self._outputs = self._make_publishers(p)
        self._clock_out = self.create_publisher(
            Clock, "/clock", reliable_qos(10)) if p.clock else None
        self._next_clock = 0
        self._from = self._start  # where the next session begins
        self._seek: int | None = None  # where it is to begin as soon as this one has ended
        self._messages: Iterator[tuple[str, str, int, bytes]] = iter(())
        self._next = None  # of them, not yet sent
        self._phase = self._wait
        self._waiting_since = time.monotonic()
        self._last_event = None
        self._stopping = False
        self._paused = p.start_paused
        self._steps = 0
        self._pace = 1.0
        self._anchor = None  # (monotonic time, log time) from which the pace counts
        self._told, self._told_at = "", 0
        self._progress = Progress("replaying", (self._stop - self._start) * 1e-9)
        self.offer("pause", self._pause)
        self.offer("resume", self._resume)
        self.offer("step", self._step)
        steady_timer(self, 1.0, self._tell)
        self.start_diagnostics("replay", lambda: (b"\0", self._phase.__name__.strip("_"), {
            publisher.topic: publisher.sent for publisher in self._outputs.values()}))

    def work(self) -> float:
        """Do what the present phase asks for; see :meth:`Node.work`."""
        self._flow.send()
        if self._seek is not None:
            self._jump(self._seek)
        return self._flow.pause(self._phase())

    def apply(self, params: Mapping[type[Parameters], Parameters]) -> None:
        """A new ``rate`` counts from the next message on; see :meth:`Node.apply`."""
        seek = cast(ReplayerParams, params[ReplayerParams]).seek
        if seek is None:
            return
        target, zero = self._bag.start_time + round(seek * 1e9), self._bag.start_time
        if not self._start <= target < self._stop:
            raise ParameterError(
                f"parameter 'seek': {seek:g} s is not in what is played, "
                f"{(self._start - zero) * 1e-9:g} to {(self._stop - zero) * 1e-9:g} s")
        if self._stopping or (self._phase == self._drain and self._last_event == END):
            raise ParameterError("parameter 'seek': everything has been played; see loop")
        self._seek = target

    def stop(self) -> None:
        """End the session, so that whoever listens knows."""
        self._stopping = True
        self._next = None
        if self._phase == self._wait:
            self.finished = True
        elif self._phase != self._drain:
            self._end(END)

    def close(self) -> None:
        """Close the recording and say what was sent to whom."""
        self._progress.close()
        if self._bag.damaged:
            self.problems.append("a part of the recording is lost")
        self._bag.close()
        self._flow.close()
        for topic, (sent, lost) in sorted(self._source.report().items()):
            takers = [f"{name}" + (f" ({n} LOST)" if n else "") for name, n in lost.items()]
            takers += [f"{name} (not ours, unchecked)" for name in
                       self._source.foreign.get(topic, ())]
            print(f"  {topic}: {sent} messages to {', '.join(takers) or 'nobody'}",
                  file=sys.stderr)

    def _make_publishers(self, p):
        """Publishers of the selected topics, by name."""
        names = _selected(self._bag, p)
        publishers = {}
        for name in names:
            info = self._bag.topics[name]
            try:
                cls = message_class(info.msgtype)
            except TopicError as error:
                if p.topics:
                    raise
                self.get_logger().warning(f"{name} is not played: {error}")
                continue
            latched = any(q["durability"] == "transient_local" for q in info.qos_profiles)
            publishers[name] = self._flow.output(cls, name, reliable_qos(
                DEPTH, DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))
        if not publishers:
            raise TopicError(f"{p.bag}: nothing to play; it has "
                             + (", ".join(self._bag.topics) or "no topics"))
        return publishers

    def _jump(self, log_time):
        """End this session; the next one begins elsewhere."""
        self._from, self._seek = log_time, None
        self.set_parameters([Parameter("seek", value=math.nan)])  # can be set to the same again
        if self._phase in (self._join, self._play):
            self._end(NEXT)

    # Phases: each does a little and returns the seconds that may pass until its next call.

    def _wait(self):
        """Nobody is played to before the expected subscribers are there."""
        p = self.params(ReplayerParams)
        missing = p.wait_for_subscribers - len(self._subscribers())
        if missing <= 0:
            self._begin()
            return 0.0
        self._give_up_after(p.wait_timeout, f"{missing} more subscribers of "
                            + ", ".join(q.topic for q in self._outputs.values()))
        return _BLOCKED

    def _begin(self):
        # Asked to end after NEXT has been promised: the next session is empty.
        if not self._stopping:
            self._messages = self._bag.messages(list(self._outputs), self._from, self._stop)
            self._next = next(self._messages, None)
        self._source.begin()
        self._anchor = None
        self._next_clock = 0
        self._waiting_since = time.monotonic()
        self._phase = self._join

    def _join(self):
        """All our nodes on the graph must have answered."""
        if self._next is not None:
            self._publish_clock(self._next[2])
            self._next_clock = 0
        if not self._source.ready():
            self._give_up_after(self.params(ReplayerParams).wait_timeout,
                                self._source.waiting_for())
            return _BLOCKED
        self._told = ""
        self._phase = self._play
        return 0.0

    def _play(self):
        """Publish what is due, as far as it may leave; in a pause, as many as were asked for."""
        if self._next is None:
            again = self.params(ReplayerParams).loop and not self._stopping
            self._from = self._start
            self._end(NEXT if again else END)
            return 0.0
        due = self._due(self._next[2])
        for _ in range(self._steps if self._paused else _BURST):
            topic, _, log_time, data = self._next
            if log_time > due:
                return min((log_time - due) * 1e-9 / self._pace, _BLOCKED)
            output = self._outputs[topic]
            if not output.is_open():
                return _BLOCKED
            self._publish_clock(log_time)
            output.publish(data)
            self._steps -= self._paused
            self._next = next(self._messages, None)
            if self._next is None:
                return 0.0
        self._progress.update((self._next[2] - self._start) * 1e-9)
        return _BLOCKED if self._paused else 0.0

    def _drain(self):
        """Everything is sent; our nodes say when they have it."""
        if not self._source.drained():
            return _BLOCKED
        if self._last_event == NEXT:
            self._begin()
        else:
            self.finished = True
        return 0.0

    def _end(self, event):
        self._last_event = event
        self._source.end(event)
        self._phase = self._drain

    def _due(self, log_time):
        """Log time up to which messages are due; ``log_time`` is that of the next one."""
        p = self.params(ReplayerParams)
        if self._paused:
            self._anchor = None
            return math.inf
        pace = p.foreign_rate if p.rate == 0.0 and self._source.foreign else p.rate
        now = time.monotonic()
        if self._anchor is None or pace != self._pace:
            self._anchor, self._pace = (now, log_time), pace
        started, first = self._anchor
        return first + round((now - started) * pace * 1e9) if pace else math.inf

    def _publish_clock(self, log_time):
        if self._clock_out is not None and log_time >= self._next_clock:
            p = self.params(ReplayerParams)
            self._clock_out.publish(Clock(clock=Time(nanoseconds=log_time).to_msg()))
            self._next_clock = log_time + round(1e9 * (p.rate or 1.0) / p.clock)

    def _subscribers(self):
        """Names of the nodes that subscribe to what is played."""
        return {(i.node_namespace, i.node_name) for q in self._outputs.values()
                for i in self.get_subscriptions_info_by_topic(q.topic)}

    def _give_up_after(self, timeout, what):
        if timeout is not None and time.monotonic() - self._waiting_since > timeout:
            raise TopicError(f"waited {timeout:g} s in vain for {what}; "
                             "see wait_for_subscribers, wait_for_nodes and wait_timeout")

    def _tell(self):
        """Say, once each, what has held the replay up since the last look, or slows it down. Whom
        all have left has nobody to play to."""
        if self._phase == self._play and self.problems and not self._subscribers():
            self.get_logger().error("nobody is left to play to")
            self.stop()
        p = self.params(ReplayerParams)
        sent = sum(publisher.sent for publisher in self._outputs.values())
        text = ""
        if self._phase == self._wait:
            text = "waiting for subscribers"
        elif self._phase != self._play or (sent == self._told_at and self._source.is_shut()):
            text = self._source.waiting_for()
        elif p.rate == 0.0 and self._source.foreign and p.foreign_rate:
            names = sorted({n for names in self._source.foreign.values() for n in names})
            text = (f"playing at {p.foreign_rate:g} times the recorded pace, because nodes that "
                    f"may drop messages subscribe: {', '.join(names)}")
        if text and text != self._told:
            self.get_logger().info(text)
        self._told, self._told_at = text, sent

    def _pause(self):
        self._paused = True
        return "paused"

    def _resume(self):
        self._paused, self._steps = False, 0
        return "playing"

    def _step(self):
        if not self._paused:
            raise RefusedError("not paused")
        if self._next is None:
            raise RefusedError("nothing left to play")
        self._steps += 1
        return "one message follows"


def _selected(bag, p):
    """Names of the topics to play.

    Raises:
        TopicError: one that was asked for is not there.
    """
    def matches(patterns, *names):
        return any(fnmatch.fnmatchcase(name.lstrip("/"), pattern.lstrip("/"))
                   for name in names for pattern in patterns)

    def asked(name, patterns):
        return matches(patterns, name, bag.recorded.get(name, name))

    for pattern in p.topics:
        if not any(asked(name, [pattern]) for name in bag.topics):
            bag.require(pattern)
    return [name for name in bag.topics
            if (not p.topics or asked(name, p.topics)) and not matches(p.exclude, name)]


def _remapping(rules):
    """{published name: recorded name}.

    Raises:
        ParameterError: a rule is malformed.
    """
    renamed = {}
    for rule in rules:
        old, separator, new = rule.partition(":=")
        if not (old and separator and new):
            raise ParameterError(f"parameter 'remap': '{rule}' is not recorded:=published")
        renamed[new] = old
    return renamed
