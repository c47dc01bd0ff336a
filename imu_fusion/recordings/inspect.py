"""What is in a recording, topic by topic: rates, gaps, ranges, and what looks wrong."""

import struct
from dataclasses import dataclass, field, replace

import numpy as np

from imu_fusion.errors import MessageError
from imu_fusion.messages.convert import SAMPLE_TYPES
from imu_fusion.messages.layouts import NANOSECONDS
from imu_fusion.messages.orientation_status import FLAGS_TYPE
from imu_fusion.recordings.bag_reader import Reader
from imu_fusion.recordings.logs import read_log
from imu_fusion.samples import FixLog, ImuLog, MagLog, PoseLog, VelocityLog, checks
from imu_fusion.samples.logs import Log

_HEADER = "std_msgs/msg/Header"


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
    ``findings`` about it, and its ``log`` if there is one for its type."""

    topic: str
    msgtype: str
    stamp: np.ndarray = field(repr=False, compare=False)
    ranges: tuple[Range, ...] = ()
    findings: tuple[checks.Finding, ...] = ()
    stamped: bool = True
    log: Log | None = field(default=None, repr=False, compare=False)
    timing: checks.Timing = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "timing", checks.timing(self.stamp))

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


def inspect_topics(reader: Reader) -> list[TopicReport]:
    """Inspect every topic of an open recording.

    Args:
        reader: what :func:`imu_fusion.recordings.bag_reader.open_bag` returned.

    Returns:
        list of TopicReport, in order of their names.
    """
    reports = []
    for name, info in sorted(reader.topics.items()):
        if info.msgtype in SAMPLE_TYPES and info.count:
            try:
                report = inspect_log(name, info.msgtype, read_log(reader, name))
            except MessageError as error:
                report = TopicReport(name, info.msgtype, np.empty(0, np.int64), (), (
                    checks.Finding("type", f"{name}: {error}"),))
        else:
            report = _inspect_stamps(reader, name, info)
        reports.append(report)
    imus = [report.log for report in reports if isinstance(report.log, ImuLog)]
    return [_with_axes(report, imus) for report in reports]


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
    return TopicReport(name, msgtype, log.stamp,
                       tuple(r for r in ranges if r is not None), tuple(findings), log=log)


def _with_axes(report, imus):
    """Add how a magnetometer turns against the only Imu of the recording."""
    if not isinstance(report.log, MagLog) or len(imus) != 1:
        return report
    return replace(report, findings=(*report.findings,
                                     *checks.check_axes(imus[0], report.log, report.topic)))


def _inspect_stamps(reader, name, info):
    """TopicReport of a topic whose contents are not looked at."""
    fields = reader.typestore.fielddefs.get(info.msgtype, ((), ()))[1]
    stamped = bool(fields) and fields[0][1][1] == _HEADER
    times = []
    for _, _, log_time, cdr in reader.messages([name]):
        if stamped and len(cdr) >= 12:
            sec, nanosec = struct.unpack_from("<iI" if cdr[1] else ">iI", cdr, 4)
            times.append(sec * NANOSECONDS + nanosec)
        else:
            times.append(log_time)
    stamps = np.array(times, dtype=np.int64)
    # Messages without a header, or about changes, are sent at any time: gaps mean nothing.
    findings = [finding for finding in checks.check_stamps(stamps, name)
                if stamped and (finding.kind != "gap" or info.msgtype != FLAGS_TYPE)]
    return TopicReport(name, info.msgtype, stamps, (), tuple(findings), stamped)


def _norm(vectors):
    return np.linalg.norm(vectors, axis=1)


def _range(quantity, unit, values):
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    return Range(quantity, unit, float(values.min()), float(values.max()))
