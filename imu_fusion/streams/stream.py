"""Estimators between messages: CDR bytes in, CDR bytes out. Nothing here knows rclpy.

A :class:`Stream` decodes, guards and merges; a subclass says which topics it takes,
hands samples to its estimator and emits what that says. Nodes add DDS to it, batch
adds recordings.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import MessageError
from imu_fusion.messages.convert import SampleType
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.logs import Log
from imu_fusion.samples.merge import RESTART, SampleStream


@dataclass(frozen=True)
class EstimatorNodeParams(Parameters):
    """What concerns a node, not its estimate."""

    qos: str = param("sensor_data", choices=("sensor_data", "reliable"),
                     doc="Live subscriptions: sensor_data takes any publisher; reliable asks for "
                         "repeats of what was lost. In a replay they are always reliable.")


_LOOK_AT = 500  # first samples of each topic whose units and axes are looked at


class Stream:
    """Messages of several topics to an estimator, as samples in order of their stamps.

    Args:
        inputs: dict of topic to SampleType, in order of rank at equal stamps.
        emit: called as ``emit(topic, stamp, cdr)`` with every message made.
        warn: called with a text when something is wrong with the input.

    Subclasses name in ``same_frame`` the topics whose axes must be parallel, and implement
    ``restart`` (forget everything), ``take`` (one sample), ``flush`` (emit what is held back) and
    ``look_at`` (texts about first samples).
    """

    same_frame: tuple[str, ...] = ()

    def __init__(self, inputs: Mapping[str, SampleType],
                 emit: Callable[[str, int, bytes], object],
                 warn: Callable[[str], object] = lambda text: None):
        self.inputs = inputs
        self.emit = emit
        self.warn = warn
        self.bad_messages = 0
        self.merged = SampleStream(inputs, self._refused)
        self._queue: deque[tuple] = deque()
        self.reset()

    def reset(self, session_topics: Sequence[str] | None = None) -> None:
        """Start over: with strict merging of these topics, or live (None)."""
        self.merged.begin(session_topics)
        self._queue.clear()
        self.frame_ids: dict[str, str] = {}
        self._first: dict[str, list] = {topic: [] for topic in self.inputs}
        self.restart()

    def push(self, topic: str, cdr: bytes) -> None:
        """Take the bytes of one message; what may happen now is queued for :meth:`step`."""
        kind = self.inputs[topic]
        try:
            stamp, frame_id, values = kind.layout.decode(cdr)
        except MessageError as error:
            self.bad_messages += 1
            self.warn(f"{topic}: message left out: {error}")
            return
        if topic not in self.frame_ids:
            self.frame_ids[topic] = frame_id
            self._compare_frames()
        sample = kind.values(values)
        if len(self._first[topic]) < _LOOK_AT:
            self._first[topic].append((stamp, sample))
            if len(self._first[topic]) == _LOOK_AT:
                for text in self.look_at(topic, self._first_logs()):
                    self.warn(text)
        self._queue.extend(self.merged.add(topic, stamp, sample))

    def step(self) -> bool:
        """Process one queued event; False if there is none."""
        if not self._queue:
            return False
        topic, stamp, sample = self._queue.popleft()
        if topic == RESTART:
            self.warn("the clock was set back: the estimator starts anew")
            self.flush()
            self.restart()
        else:
            self.take(topic, stamp, sample)
        return True

    def topic_ended(self, topic: str) -> None:
        """Nothing more comes on this topic in this session."""
        self._queue.extend(self.merged.end(topic))

    def finish(self) -> None:
        """The end of the session: everything that is held back is emitted."""
        while self.step():
            pass
        self.flush()

    def restart(self) -> None:
        raise NotImplementedError

    def take(self, topic: str, stamp: int, sample: np.ndarray) -> None:
        raise NotImplementedError

    def flush(self) -> None:
        raise NotImplementedError

    def look_at(self, topic: str, logs: Mapping[str, Log]) -> list[str]:
        """Texts about the first samples of ``topic``; ``logs`` maps topics to what there is."""
        return []

    def _first_logs(self):
        logs = {}
        for topic, rows in self._first.items():
            if rows:
                stamps, samples = zip(*rows)
                logs[topic] = self.inputs[topic].log(np.array(stamps), np.array(samples),
                                                     self.frame_ids[topic])
        return logs

    def _refused(self, topic, stamp, verdict):
        count = self.merged.guards[topic].counts[verdict]
        if count in (1, 10, 100) or count % 1000 == 0:
            self.warn(f"{topic}: sample at stamp {stamp} left out: {verdict.value} "
                      f"({count} so far)")

    def _compare_frames(self):
        frames = {t: f for t, f in self.frame_ids.items() if t in self.same_frame}
        if len(set(frames.values())) > 1:
            named = ", ".join(f"{topic} in '{frame}'" for topic, frame in frames.items())
            self.warn(f"sensors name different frames ({named}): their axes are taken as parallel")
