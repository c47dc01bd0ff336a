"""Estimators between messages: CDR bytes in, CDR bytes out. Nothing here knows rclpy.

A :class:`Stream` takes *blocks*: whatever waits on all its topics, one message while a live node
is idle, thousands in a replay or in batch. It decodes, guards and merges them as arrays; a
subclass says which topics it takes, hands samples to its estimator and makes messages of what
that says. What comes out does not depend on how the samples were cut into blocks. Nodes add
DDS to it, batch adds recordings.
"""

from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from imu_fusion.messages.convert import SampleType
from imu_fusion.messages.layouts import IMU, Decoded
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.blocks import BlockMerger, Samples, joined
from imu_fusion.samples.checks import check_frames
from imu_fusion.samples.guard import Guard, Verdict
from imu_fusion.sensors.linear_calibration import SensorCalibration

IMU_TOPIC, MAG_TOPIC = "imu/data_raw", "imu/mag"
FIX_TOPIC, VELOCITY_TOPIC = "fix", "fix_velocity"


@dataclass(frozen=True)
class EstimatorNodeParams(Parameters):
    """What concerns a node, not its estimate."""

    qos: str = param("sensor_data", choices=("sensor_data", "reliable"),
                     doc="Live subscriptions: sensor_data takes any publisher; reliable asks for "
                         "repeats of what was lost. In a replay they are always reliable.")


class Messages(NamedTuple):
    """Messages of one topic, in order: stamps (n,) int64 ns, a list of CDR bytes."""

    topic: str
    stamp: np.ndarray
    cdrs: list[bytes]


@dataclass(frozen=True)
class Conclusion:
    """What a stream says after the last sample of a whole recording.

    ``made``: further lists of Messages; ``results``: plain numbers; ``summary``: a line of text;
    ``remarks``: texts on what makes the numbers doubtful; ``detail``: what no message carries, for
    those who want to draw it.
    """

    made: Iterable[list[Messages]] = ()
    results: Mapping[str, Any] = field(default_factory=dict)
    summary: str = ""
    remarks: Sequence[str] = ()
    detail: Any = None


def one_by_one(made: Iterable[Messages]) -> Iterator[tuple[str, int, bytes]]:
    """(topic, stamp, cdr) of Messages that belong together, in order of stamps, topics of one stamp
    in the order given."""
    made = list(made)
    rows = [(stamp, k, i) for k, m in enumerate(made) for i, stamp in enumerate(m.stamp.tolist())]
    for stamp, k, i in sorted(rows):
        yield made[k].topic, stamp, made[k].cdrs[i]


# Samples of each topic after which units and axes are looked at, and for the last time.
_LOOK_AT, _LOOK_AGAIN = 500, 5000


class Stream:
    """Messages of several topics through an estimator.

    Args:
        inputs: dict of topic to SampleType, in order of rank at equal stamps.
        warn: called with a text when something is wrong with the input.
        calibration: of the Imu: what comes in is calibrated before anything else.

    Subclasses name in ``same_frame`` the topics whose axes must be parallel, in ``one_clock`` those
    whose sensors share a clock (None: all do, see BlockMerger), in ``answered`` those with whose
    samples estimates come (None: with all), and implement ``restart`` (forget everything), ``use``
    (samples of one epoch in, Messages out), ``flush`` (Messages of what is held back), and where
    they have something to say ``look_at`` (texts on first samples), ``remarks`` and ``conclude``.
    """

    same_frame: ClassVar[tuple[str, ...]] = ()
    one_clock: ClassVar[tuple[str, ...] | None] = None
    answered: ClassVar[tuple[str, ...] | None] = None
    #: To be set before the first sample where :meth:`conclude` is to be called: what that needs
    #: is then kept.
    concludes = False

    def __init__(self, inputs: Mapping[str, SampleType],
                 warn: Callable[[str], object] = lambda text: None,
                 calibration: SensorCalibration = SensorCalibration()) -> None:
        self.inputs = inputs
        self._calibration = None if calibration.keeps_imu else calibration
        self.warn = warn
        self.undecodable: Counter[str] = Counter()
        self._merger = BlockMerger(inputs, self._refused, self.one_clock)
        self.reset()

    def reset(self, session_topics: Container[str] | None = None) -> None:
        """Start over: with strict merging of these topics, or live (None)."""
        self._merger.begin(session_topics)
        self.frame_ids: dict[str, str] = {}
        self.findings: list[str] = []   # texts on what looks wrong with the samples
        self._frames: dict[str, dict[str, None]] = {topic: {} for topic in self.inputs}
        self.restarts = 0
        self._first: dict[str, list[Samples]] = {topic: [] for topic in self.inputs}
        self._seen = dict.fromkeys(self.inputs, 0)  # samples so far, until there are enough
        self.restart()

    def take(self, blocks: Mapping[str, Sequence[bytes]]) -> list[Messages]:
        """Take the CDR bytes of messages, by topic in order of arrival."""
        return list(self.answer(blocks))

    def answer(self, blocks: Mapping[str, Sequence[bytes]]) -> Iterator[Messages]:
        """:meth:`take`, with what is waited for first: to be asked for to the end."""
        return self._take({topic: self.inputs[topic].layout.decode_block(cdrs)
                           for topic, cdrs in blocks.items()})

    def take_decoded(self, blocks: Mapping[str, Decoded]) -> list[Messages]:
        """:meth:`take` of messages that have been decoded already."""
        return list(self._take(blocks))

    def end(self, topics: Iterable[str]) -> list[Messages]:
        """Nothing more comes on these topics in this session."""
        return list(self._through(self._merger.end(topics)))

    def finish(self) -> list[Messages]:
        """The end of the session: everything that is held back."""
        return self.end(self.inputs) + self.flush()

    @property
    def guards(self) -> Mapping[str, Guard]:
        """What was taken and refused, by topic."""
        return self._merger.guards

    def refused(self, topic: str) -> dict[str, int]:
        """What was left out of a topic: reasons in words, and how many of each."""
        refused = self.guards[topic].refused()
        if self.undecodable[topic]:
            refused["cannot be decoded"] = self.undecodable[topic]
        return refused

    @property
    def held(self) -> int:
        """Number of samples that wait for another topic."""
        return self._merger.held

    def restart(self) -> None:
        """Forget all samples; parameters stay."""
        raise NotImplementedError

    def use(self, samples: Mapping[str, Samples]) -> Iterable[Messages]:
        """Samples of one epoch, all before those of the next call."""
        raise NotImplementedError

    def flush(self) -> list[Messages]:
        """What is held back for samples that will not come."""
        raise NotImplementedError

    def conclude(self) -> Conclusion:
        """After :meth:`finish`, at the end of a whole recording."""
        return Conclusion()

    def remarks(self) -> list[str]:
        """Texts on what makes the estimates so far doubtful, each with what to do."""
        return []

    def look_at(self, topic: str, logs: Mapping[str, Any]) -> list[str]:
        """Texts about the first samples of ``topic``; ``logs`` maps topics to what there is."""
        return []

    def _take(self, blocks: Mapping[str, Decoded]) -> Iterator[Messages]:
        samples = {}
        for topic, block in blocks.items():
            for reason in block.refused.values():
                self.undecodable[topic] += 1
                if _is_told(self.undecodable[topic]) and not self.concludes:
                    self.warn(f"{topic}: message left out: {reason} "
                              f"({self.undecodable[topic]} so far)")
            if len(block.stamp):
                if topic not in self.frame_ids:
                    self.frame_ids[topic] = block.frame_ids[0]
                    self._compare_frames()
                if not self.concludes and not self._frames[topic].keys() >= set(block.frame_ids):
                    self._frames[topic] |= dict.fromkeys(block.frame_ids)
                    self._tell(f.text for f in check_frames(self._frames[topic], topic))
                values = self.inputs[topic].values(block.values)
                if self._calibration is not None and self.inputs[topic].layout is IMU:
                    values = self._calibration.apply(values)
                samples[topic] = block.stamp, values
                self._look(topic, *samples[topic])
        return self._through(self._merger.add(samples))

    def _through(self, segments) -> Iterator[Messages]:
        for segment in segments:
            if segment.restart:
                self.warn("the clock was set back (or days ahead): the estimator starts anew")
                yield from self.flush()
                self.restarts += 1
                self.restart()
            yield from self.use(segment.samples)

    def _look(self, topic: str, stamp: np.ndarray, values: np.ndarray) -> None:
        """Have the first samples looked at, once there are enough of them, and once again when
        there are more: whoever lies still at first turns later."""
        if self.concludes:
            return    # whole logs are looked at instead
        seen = self._seen[topic]
        if seen >= _LOOK_AGAIN:
            return
        self._seen[topic] += len(stamp)
        self._first[topic].append((stamp[:_LOOK_AGAIN - seen], values[:_LOOK_AGAIN - seen]))
        if any(seen < enough <= self._seen[topic] for enough in (_LOOK_AT, _LOOK_AGAIN)):
            self._tell(self.look_at(topic, self._first_logs()))
        if self._seen[topic] >= _LOOK_AGAIN and min(self._seen.values()) >= _LOOK_AGAIN:
            self._first = {topic: [] for topic in self.inputs}

    def _tell(self, found: Iterable[str]) -> None:
        """Warn of what has not been told yet."""
        for text in found:
            if text not in self.findings:
                self.findings.append(text)
                self.warn(text)

    def _first_logs(self) -> dict[str, Any]:
        return {topic: self.inputs[topic].log(*joined(parts), self.frame_ids[topic])
                for topic, parts in self._first.items() if parts}

    def _refused(self, topic: str, stamps: np.ndarray, verdicts: Sequence[Verdict]) -> None:
        if self.concludes:
            return    # told in the end, in a table
        counts = self._merger.guards[topic].counts
        for verdict in dict.fromkeys(verdicts):
            count, here = counts[verdict], verdicts.count(verdict)
            if any(_is_told(k) for k in range(count - here + 1, count + 1)):
                stamp = int(stamps[verdicts.index(verdict)])
                self.warn(f"{topic}: sample at stamp {stamp} left out: {verdict.value} "
                          f"({count} so far)")

    def _compare_frames(self) -> None:
        frames = {t: f for t, f in self.frame_ids.items() if t in self.same_frame}
        if len(set(frames.values())) > 1:
            named = ", ".join(f"{topic} in '{frame}'" for topic, frame in frames.items())
            self.warn(f"sensors name different frames ({named}): their axes are taken as parallel")


def _is_told(count: int) -> bool:
    """Whether the count-th of equal faults is worth a line: the first ones, then ever fewer."""
    return count in (1, 10, 100) or count % 1000 == 0
