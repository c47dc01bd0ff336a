"""The report of a recording: what it holds, and how good the orientation made from it is."""

import datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.errors import TopicError
from imu_fusion.estimation.orientation_error import moving_at, orientation_errors
from imu_fusion.messages.bag import find_topic, open_bag
from imu_fusion.messages.convert import attitude_log, bool_value, read_log
from imu_fusion.messages.inspect import inspect_topics
from imu_fusion.messages.layouts import BOOL_TYPE, IMU, MAG, POSE
from imu_fusion.report.figures import intervals
from imu_fusion.report.html import Section, Text, write_report
from imu_fusion.report.orientation import (
    error_section, field_section, key_numbers, motion_section, orientation_section)
from imu_fusion.report.overview import overview_section

RAW, MAGNETOMETER, ESTIMATES = "imu/data_raw", "imu/mag", "imu/data"
REFERENCE, MOVING = "reference/pose", "reference/moving"


def write_orientation_report(bag, estimates, path):
    """Write the HTML report of a recording.

    Args:
        bag: recording with sensor topics and perhaps ``reference/pose``; another PoseStamped
            topic is used in its place if there is no such topic.
        estimates: recording with ``imu/data``, may be the same; if it has none, the report is
            about the recording alone.
        path: HTML file to write.

    Raises:
        BagError, TopicError: a recording cannot be read, or holds nothing to report about.
        ImuFusionError: the file cannot be written.
    """
    with open_bag(bag) as reader:
        topics = inspect_topics(reader)
        logs = {name: read_log(reader, name) for name, msgtype in
                ((RAW, IMU.msgtype), (MAGNETOMETER, MAG.msgtype)) if _has(reader, name, msgtype)}
        reference_name = _reference(reader)
        reference = read_log(reader, reference_name) if reference_name else None
        changes = _moving(reader)
        warnings = list(reader.warnings)
        start = reader.start_time
        duration = (reader.end_time - start) * 1e-9
    with open_bag(estimates) as reader:
        estimate = None
        if _has(reader, ESTIMATES, IMU.msgtype):
            estimate = read_log(reader, ESTIMATES, attitude_log)
    if not topics:
        raise TopicError(f"{bag}: no topics to report about")

    raw, mag = logs.get(RAW), logs.get(MAGNETOMETER)
    stamps = {t.topic: log.stamp for name, log in logs.items()
              for t in topics if t.topic.lstrip("/") == name}
    clock = raw if raw is not None else estimate
    origin = int(clock.stamp[0]) if clock is not None and len(clock) else start
    errors = moving = None
    shaded = ()
    if changes is not None and clock is not None:
        shaded = intervals((clock.stamp - origin) * 1e-9, moving_at(clock.stamp, *changes))
    if estimate is not None and reference is not None:
        errors = orientation_errors(estimate.stamp, estimate.quat_world_imu, reference,
                                    estimate.cov_attitude)
        moving = None if changes is None else moving_at(estimate.stamp, *changes)

    rate = next((t.rate for t in topics if t.topic.lstrip("/") == RAW), None)
    findings = sum(len(t.findings) for t in topics) + len(warnings)
    blocks = [key_numbers(duration, np.nan if rate is None else rate, errors, moving, findings)]
    blocks += [Text(warning) for warning in warnings]
    if estimate is None:
        blocks.append(Text(f"{Path(estimates).name} holds no estimates on {ESTIMATES}: this "
                           "report is about the recording alone. imu_fusion process makes them."))
    sections = [Section("Summary", tuple(blocks)), overview_section(topics, stamps, origin)]
    if estimate is not None:
        sections.append(orientation_section(
            estimate.stamp, estimate.quat_world_imu, estimate.cov_attitude, origin, reference,
            reference_name or "", shaded))
    if errors is not None:
        sections.append(error_section(errors, origin, moving, reference_name, shaded))
    if estimate is not None and mag is not None and len(mag):
        sections.append(field_section(mag.stamp, carry(mag, estimate), origin, shaded))
    if raw is not None or estimate is not None:
        sections.append(motion_section(
            raw, estimate, origin, shaded))
    date = datetime.datetime.fromtimestamp(start * 1e-9, datetime.timezone.utc)
    write_report(path, f"{Path(bag).resolve().name}", sections,
                 f"{Path(bag)}, starts {date:%Y-%m-%d %H:%M:%S} UTC by its stamps")


def carry(mag, estimate):
    """Magnetometer samples turned into the world by the nearest estimate before them.

    Args:
        mag: MagLog; estimate: a log with ``stamp`` and ``quat_world_imu``.

    Returns:
        (n, 3) tesla, NaN ahead of the first estimate and beyond a second after one.
    """
    result = np.full(mag.mag.shape, np.nan)
    row = np.searchsorted(estimate.stamp, mag.stamp, side="right") - 1
    usable = row >= 0
    usable[usable] &= mag.stamp[usable] - estimate.stamp[row[usable]] < 1_000_000_000
    usable &= np.isfinite(mag.mag).all(axis=1)
    result[usable] = Rotation.from_quat(estimate.quat_world_imu[row[usable]]).apply(
        mag.mag[usable])
    return result


def _has(reader, topic, msgtype):
    name = find_topic(reader.topics, topic)
    return name is not None and reader.topics[name].msgtype == msgtype \
        and bool(reader.topics[name].count)


def _reference(reader):
    """The topic to compare with: the reference, else the first other pose, else None."""
    if _has(reader, REFERENCE, POSE.msgtype):
        return REFERENCE
    poses = sorted(t.name for t in reader.topics.values() if t.msgtype == POSE.msgtype and t.count)
    return poses[0] if poses else None


def _moving(reader):
    """(stamps, values) of the movement mask's changes, or None."""
    if not _has(reader, MOVING, BOOL_TYPE):
        return None
    name = find_topic(reader.topics, MOVING)
    pairs = [(log_time, bool_value(cdr)) for _, _, log_time, cdr in reader.messages([name])]
    return tuple(np.array(column) for column in zip(*pairs))
