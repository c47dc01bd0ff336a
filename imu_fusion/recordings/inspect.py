"""What is in a recording, topic by topic: rates, gaps, ranges, and what looks wrong."""

import math
import re
import struct
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from imu_fusion.messages.convert import SAMPLE_TYPES
from imu_fusion.messages.layouts import NANOSECONDS
from imu_fusion.messages.orientation_status import FLAGS_TYPE
from imu_fusion.recordings.bag_reader import Reader
from imu_fusion.recordings.logs import LogCollector, undecodable
from imu_fusion.samples import FixLog, ImuLog, MagLog, PoseLog, VelocityLog, checks
from imu_fusion.samples.field_turning import check_axes
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.lasting_errors import check_field_errors
from imu_fusion.samples.logs import Log
from imu_fusion.samples.travel import check_travel

_HEADERS = ("std_msgs/Header", "std_msgs/msg/Header", "Header")
_LATEST = 2**63 - 1    # of log times, which MCAP counts to twice as far

STRETCH = 200_000
"""Messages that are looked at together where memory is to be bounded."""


@dataclass(frozen=True)
class Range:
    """Least and greatest value of one quantity over all its axes, in ``unit``."""

    quantity: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class TopicReport:
    """One topic: ``stamp`` (n,) int64 ns of its headers (log times, if it is not ``stamped``
    because its messages have no header) and their ``timing``, ``ranges`` of what it measures,
    ``findings`` about it, and its ``log`` if there is one for its type. Of several stretches there
    are neither ``stamp`` nor ``log``."""

    topic: str
    msgtype: str
    stamp: np.ndarray = field(repr=False, compare=False)
    timing: checks.Timing
    ranges: tuple[Range, ...] = ()
    findings: tuple[Finding, ...] = ()
    stamped: bool = True
    log: Log | None = field(default=None, repr=False, compare=False)

    @property
    def count(self) -> int:
        """Number of messages."""
        return self.timing.count

    @property
    def rate(self) -> float | None:
        """Mean rate in Hz, None with fewer than two stamps or without a header."""
        return self._or_none(self.timing.rate_hz)

    @property
    def longest_gap(self) -> float | None:
        """Longest interval in s, None with fewer than two stamps or without a header."""
        return self._or_none(self.timing.longest_gap_s)

    def _or_none(self, value):
        return None if not self.stamped or np.isnan(value) else value

    @property
    def notes(self) -> list[str]:
        """The findings in words, without the name of the topic."""
        return [finding.text.removeprefix(self.topic + ": ") for finding in self.findings]


def inspect_topics(reader: Reader, most: float = math.inf) -> list[TopicReport]:
    """Inspect every topic of an open recording.

    Args:
        reader: what :func:`imu_fusion.recordings.bag_reader.open_bag` returned.
        most: messages that are held at once. A longer recording is looked at in such stretches, and
            a finding says in how many of them it holds.

    Returns:
        list of TopicReport, in order of their names.
    """
    collectors: dict[str, LogCollector | _Stamps] = {
        name: LogCollector(SAMPLE_TYPES[info.msgtype]) if info.msgtype in SAMPLE_TYPES
        else _Stamps(_begins_with_header(reader.definition(name)))
        for name, info in sorted(reader.topics.items())}
    whole: dict[str, _Stretches] = {name: _Stretches() for name in collectors}
    held = 0
    for topic, _, log_time, cdr in reader.messages():
        if held >= most:
            _conclude(reader, collectors, whole)
            held = 0
        held += 1
        collector = collectors[topic]
        if isinstance(collector, LogCollector):
            collector.add(cdr)
        else:
            collector.add(log_time, cdr)
    _conclude(reader, collectors, whole)
    return [_with_messages(whole[name].report(), collector, reader)
            for name, collector in collectors.items()]


def _conclude(reader: Reader, collectors: "Mapping[str, LogCollector | _Stamps]",
              whole: "Mapping[str, _Stretches]") -> None:
    """Look at what has been collected, and let it go."""
    reports = []
    with np.errstate(over="ignore", invalid="ignore"):    # wild values are told of
        for name, collector in collectors.items():
            msgtype = reader.topics[name].msgtype
            reports.append(inspect_log(name, msgtype, collector.log())
                           if isinstance(collector, LogCollector) else
                           collector.report(name, msgtype))
        imus = [report.log for report in reports
                if isinstance(report.log, ImuLog) and report.count]
        fixes = [report.log for report in reports
                 if isinstance(report.log, FixLog) and report.count]
        for report in reports:
            whole[report.topic].add(_beside(report, imus, fixes))


class _Stretches:
    """What is found in one stretch after the other of a topic."""

    def __init__(self) -> None:
        self._report: TopicReport | None = None
        self._count, self._last = 0, np.empty(0, np.int64)
        # Words without their numbers: the Finding, in how many stretches, from what stamp on.
        self._found: dict[tuple[str, str], tuple[Finding, int, int]] = {}

    def add(self, report: TopicReport) -> None:
        """The next stretch."""
        if self._report is not None and not report.count:
            return
        for finding in report.findings:
            key = finding.kind, re.sub(r"[-+0-9.e]+", "", finding.text)
            first, times, stamp = self._found.get(key, (finding, 0, report.timing.first))
            self._found[key] = first, times + 1, stamp
        if self._report is None or not self._report.count:
            self._report = report
        else:
            timing = checks.timing(np.concatenate([self._last, report.stamp]))
            ranges = {r.quantity: r for r in self._report.ranges}
            for r in report.ranges:
                known = ranges.get(r.quantity, r)
                ranges[r.quantity] = replace(r, low=min(r.low, known.low),
                                             high=max(r.high, known.high))
            self._report = replace(
                report, stamp=report.stamp[:0], log=None, ranges=tuple(ranges.values()),
                timing=self._report.timing.followed_by(timing))
        self._count += 1
        self._last = report.stamp[-1:].copy()

    def report(self) -> TopicReport:
        """Of all of them."""
        assert self._report is not None
        return replace(self._report, findings=tuple(
            finding if times == self._count else replace(
                finding, text=f"{finding.text} (in {times} of {self._count} stretches of the "
                f"recording, the first of them from stamp {stamp} on)")
            for finding, times, stamp in self._found.values()))


def _with_messages(report: TopicReport, collector: "LogCollector | _Stamps", reader: Reader
                   ) -> TopicReport:
    """Add what is wrong with the messages, not with the samples in them."""
    if not isinstance(collector, LogCollector):
        return report
    findings = [*checks.check_frames(collector.frame_ids, report.topic), *report.findings]
    if collector.refused:
        text = undecodable(report.topic, collector.refused)
        reader.lose(text)
        findings.insert(0, Finding("type", text))
    return replace(report, findings=tuple(findings))


def inspect_log(name: str, msgtype: str, log: Log) -> TopicReport:
    """TopicReport of one log."""
    ranges: tuple[Range | None, ...] = ()
    if isinstance(log, ImuLog):
        findings = checks.check_imu(log, name)
        ranges = (_range("|angular velocity|", "rad/s", _norm(log.gyr)),
                  _range("|specific force|", "m/s²", _norm(log.acc)))
    elif isinstance(log, MagLog):
        findings = checks.check_mag(log, name)
        ranges = (_range("|field|", "µT", _norm(log.mag) * 1e6),)
    elif isinstance(log, FixLog):
        findings = checks.check_fix(log, name)
        ranges = (_range("latitude", "°", log.latitude_deg),
                  _range("longitude", "°", log.longitude_deg),
                  _range("height", "m", log.height))
    elif isinstance(log, VelocityLog):
        findings = [*checks.check_stamps(log.stamp, name),
                    *checks.check_finite(log.vel_world, name, "velocity")]
        ranges = (_range("speed", "m/s", _norm(log.vel_world)),)
    else:
        findings = checks.check_stamps(log.stamp, name)
        if isinstance(log, PoseLog):
            findings += checks.check_finite(log.quat_world_imu, name, "orientation")
    return TopicReport(name, msgtype, log.stamp, checks.timing(log.stamp),
                       tuple(r for r in ranges if r is not None), tuple(findings), log=log)


def _beside(report, imus, fixes):
    """Add whether a sensor has the time of the only Imu of the recording, how a magnetometer turns
    against it, and whether velocities lead from one to another of the only fixes."""
    if report.log is None or isinstance(report.log, ImuLog):
        return report
    found = []
    if len(imus) == 1:
        found += checks.check_clock(report.log.stamp, imus[0].stamp, report.topic)
        if isinstance(report.log, MagLog):
            found += (check_axes(imus[0], report.log, report.topic)
                      or check_field_errors(imus[0], report.log, report.topic))
    if len(fixes) == 1 and isinstance(report.log, VelocityLog):
        found += check_travel(fixes[0], report.log, report.topic)
    return replace(report, findings=(*report.findings, *found))


class _Stamps:
    """Stamps of a topic whose contents are not looked at: of its headers, if it has them."""

    def __init__(self, stamped: bool) -> None:
        self._stamped = stamped
        self._times = array("q")

    def add(self, log_time: int, cdr: bytes) -> None:
        if self._stamped and len(cdr) >= 12:
            sec, nanosec = struct.unpack_from("<iI" if cdr[1] else ">iI", cdr, 4)
            log_time = sec * NANOSECONDS + nanosec
        self._times.append(min(log_time, _LATEST))

    def report(self, name: str, msgtype: str) -> TopicReport:
        stamps, self._times = np.array(self._times, dtype=np.int64), array("q")
        # Messages without a header, or about changes, are sent at any time: gaps mean nothing.
        findings = [finding for finding in checks.check_stamps(stamps, name)
                    if self._stamped and (finding.kind != "gap" or msgtype != FLAGS_TYPE)]
        return TopicReport(name, msgtype, stamps, checks.timing(stamps), (), tuple(findings),
                           self._stamped)


def _begins_with_header(definition):
    """Whether the first field of a definition in ros2msg is a std_msgs/Header."""
    for line in definition[0].splitlines() if definition else ():
        words = line.partition("#")[0].split()
        if words and not any("=" in word for word in words):
            return words[0] in _HEADERS
    return False


def _norm(vectors):
    return np.linalg.norm(vectors, axis=1)


def _range(quantity, unit, values):
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    return Range(quantity, unit, float(values.min()), float(values.max()))
