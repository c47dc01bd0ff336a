"""The report of a recording: what it holds, and how good what is made from it is."""

import datetime
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError, SampleError, TopicError
from imu_fusion.evaluation.orientation_error import moving_at, orientation_errors
from imu_fusion.messages.convert import attitude_log, bool_value
from imu_fusion.messages.layouts import BOOL_TYPE, FIX, IMU, MAG, POSE, TWIST
from imu_fusion.messages.orientation_status import FLAGS_TYPE
from imu_fusion.recordings.bag_reader import find_topic, open_bag
from imu_fusion.recordings.inspect import inspect_topics
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.acceleration_field import field_sections
from imu_fusion.report.field_data import read_field
from imu_fusion.report.figures import Shade, intervals
from imu_fusion.report.gnss import gnss_section
from imu_fusion.report.html import Notes, Numbers, Section, Text, write_report
from imu_fusion.report.orientation import (
    error_section,
    field_section,
    key_numbers,
    motion_section,
    orientation_section,
)
from imu_fusion.report.orientation_status import Status, bias_section
from imu_fusion.report.orientation_status import shades as status_shades
from imu_fusion.report.overview import overview_section
from imu_fusion.report.smoother import Smoothed, smoother_numbers, smoother_sections
from imu_fusion.samples import seconds
from imu_fusion.samples.guard import guard_log
from imu_fusion.streams import smoother as smoothing
from imu_fusion.streams.orientation import BIAS_TOPIC, FLAGS_TOPIC
from imu_fusion.streams.registry import STAGES
from imu_fusion.streams.stage import StageReport
from imu_fusion.surfaces.file import load_surface

RAW, MAGNETOMETER, ESTIMATES = "imu/data_raw", "imu/mag", "imu/data"
FIX_TOPIC, VELOCITY_TOPIC = "fix", "fix_velocity"
REFERENCE, MOVING = "reference/pose", "reference/moving"


@dataclass(frozen=True, eq=False)
class Contents:
    """What a report needs of a recording; None where it has no such topic."""

    topics: list
    logs: dict
    reference_name: str | None
    changes: tuple | None
    warnings: tuple
    start: int
    duration_s: float

    def log(self, topic):
        """The log of a topic, or None."""
        return self.logs.get(topic)

    def samples(self, topics):
        """dict of topic to (log, epochs), as a Stage takes it."""
        return {topic: (self.logs[topic], np.zeros(len(self.logs[topic]), np.int64))
                for topic in topics if topic in self.logs and len(self.logs[topic])}


def read_contents(path):
    """Read a recording for a report.

    Raises:
        BagError, TopicError: it cannot be read, or holds no messages.
    """
    with open_bag(path) as reader:
        topics = inspect_topics(reader)
        if not any(t.count for t in topics):
            raise TopicError(f"{path}: no messages to report about")
        found = {t.topic.lstrip("/"): t for t in topics if t.log is not None and t.count}
        poses = [name for name, t in found.items() if t.msgtype == POSE.msgtype]
        reference_name = REFERENCE if REFERENCE in poses else next(iter(poses), None)
        wanted = {RAW: IMU, MAGNETOMETER: MAG, FIX_TOPIC: FIX, VELOCITY_TOPIC: TWIST}
        if reference_name:
            wanted[reference_name] = POSE
        warnings = list(reader.warnings)
        logs = {name: _usable(found[name].log, name, warnings) for name, layout in wanted.items()
                if name in found and found[name].msgtype == layout.msgtype}
        return Contents(topics, logs, reference_name, moving_changes(reader), tuple(warnings),
                        reader.start_time, (reader.end_time - reader.start_time) * 1e-9)


def read_estimates(path):
    """(AttitudeLog of imu/data or None, Status, warnings) of a recording."""
    warnings = []
    with open_bag(path) as reader:
        cdrs = {name: [cdr for _, _, _, cdr in reader.messages([find_topic(reader.topics, name)])]
                for name, msgtype in ((FLAGS_TOPIC, FLAGS_TYPE), (BIAS_TOPIC, TWIST.msgtype))
                if _has(reader, name, msgtype)}
        status = Status.from_messages(cdrs.get(FLAGS_TOPIC, ()), cdrs.get(BIAS_TOPIC, ()))
        if not _has(reader, ESTIMATES, IMU.msgtype):
            return None, status, warnings
        log = _usable(read_log(reader, ESTIMATES, attitude_log), ESTIMATES, warnings)
        return log, status, warnings


def estimate_orientation(contents, params_file=None):
    """(AttitudeLog, Status) of the orientation estimator, from the recording's own samples;
    None if it has no imu/data_raw."""
    if RAW not in contents.logs:
        return None, Status.from_messages((), ())
    stage, params = STAGES["orientation_estimator"].prepare(params_file)
    messages = stage.process_logs(contents.samples(stage.inputs),
                                  StageReport(stage.node, params), *params)
    cdrs = {topic: [] for topic in (ESTIMATES, FLAGS_TOPIC, BIAS_TOPIC)}
    for topic, _, cdr in messages:
        if topic in cdrs:
            cdrs[topic].append(cdr)
    return (attitude_log(cdrs[ESTIMATES]),
            Status.from_messages(cdrs[FLAGS_TOPIC], cdrs[BIAS_TOPIC]))


def smooth_recording(contents, params_file=None):
    """The smoothed trajectory of a recording.

    Returns:
        (Smoothed, None), or (None, why not in words); (None, None) without Imu or fixes.
    """
    if not set(smoothing.REQUIRED) <= contents.logs.keys():
        return None, None
    _, (params,) = STAGES["smoother"].prepare(params_file)
    try:
        result = smoothing.smooth(params, contents.samples(smoothing.INPUTS))
    except (EstimationError, SampleError) as error:
        return None, f"There is no smoothed trajectory: {error}"
    surface = load_surface(params.surface.file) if params.surface.file else None
    return Smoothed(result, params, surface, contents.log(FIX_TOPIC), contents.log(VELOCITY_TOPIC),
                    int(contents.log(RAW).stamp[0])), None


def write_recording_report(bag, estimates, path, params_file=None):
    """Write the HTML report of a recording; its trajectory is smoothed anew for it.

    Args:
        bag: recording with sensor topics and perhaps ``reference/pose``; another PoseStamped
            topic is used in its place if there is no such topic.
        estimates: recording with ``imu/data``, may be the same; if it has none, the report says
            so. None: those in ``bag``, or else made from it. ``acceleration_field/*`` in it
            get their sections, too.
        path: HTML file to write.
        params_file: ROS 2 parameter file of the estimators, or None for defaults.

    Returns:
        Smoothed, or None if there is nothing to smooth.

    Raises:
        BagError, TopicError: a recording cannot be read, or holds nothing to report about.
        ImuFusionError: parameters are not usable, or the file cannot be written.
    """
    contents = read_contents(bag)
    source = bag if estimates is None else estimates
    estimate, status, warnings = read_estimates(source)
    if estimate is None and estimates is None:
        estimate, status = estimate_orientation(contents, params_file)
        estimates = "this report's own run"
    smoothed, reason = smooth_recording(contents, params_file)
    warnings = [*contents.warnings, *warnings]
    if smoothed is not None:
        warnings += smoothed.result.remarks()
    raw, mag = contents.log(RAW), contents.log(MAGNETOMETER)
    reference = contents.log(contents.reference_name)
    is_truth = contents.reference_name == REFERENCE
    clock = next((log for log in (raw, estimate, contents.log(FIX_TOPIC))
                  if log is not None and len(log)), None)
    origin = contents.start if clock is None else int(clock.stamp[0])
    errors = moving = None
    shades = []
    if contents.changes is not None and clock is not None:
        shades = [Shade("in movement", tuple(intervals(
            seconds(clock.stamp, origin), moving_at(clock.stamp, *contents.changes))))]
    if estimate is not None:
        shades += status_shades(status, origin, int(estimate.stamp[-1]), with_rest=not shades)
    if estimate is not None and reference is not None:
        errors = orientation_errors(estimate.stamp, estimate.quat_world_imu, reference,
                                    estimate.cov_attitude)
        if contents.changes is not None:
            moving = moving_at(estimate.stamp, *contents.changes)

    rate = next((t.rate for t in contents.topics if t.topic.lstrip("/") == RAW), None)
    findings = sum(len(t.findings) for t in contents.topics) + len(warnings)
    rate = np.nan if rate is None else rate
    if smoothed is None:
        numbers = key_numbers(contents.duration_s, rate, errors, moving, findings, is_truth)
    else:  # the orientation alone is no longer what counts most
        numbers = key_numbers(contents.duration_s, rate, findings=findings)
        numbers = Numbers((*smoother_numbers(smoothed.result), *numbers.items))
    blocks = [numbers]
    if warnings:
        blocks.append(Notes(tuple(warnings)))
    field = read_field(bag, source, params_file)
    if estimate is None and field is None:
        blocks.append(Text(f"{Path(estimates).name} holds no estimates on {ESTIMATES}: this "
                           "report is about the recording alone. imu_fusion process makes them."))
    elif errors is not None:
        blocks.append(Text(f"Orientation from {estimates} against {contents.reference_name} of "
                           "the recording" + ("." if is_truth else ", which is somebody's "
                                              "estimate too: what follows are differences, not "
                                              "errors.")))
    if reason is not None:
        blocks.append(Text(reason))
    sections = [Section("Summary", tuple(blocks)), overview_section(contents.topics, origin)]
    if smoothed is not None:
        # Positions of the reference count from the origin of the surface.
        in_world = is_truth and smoothed.surface is not None and np.any(reference.position_world)
        sections += smoother_sections(smoothed, reference if in_world else None)
    if estimate is not None:
        sections.append(orientation_section(estimate, origin, reference,
                                            contents.reference_name or "", shades))
    if errors is not None:
        sections.append(error_section(errors, origin, moving, contents.reference_name, is_truth,
                                      shades))
    if len(status.bias):
        sections.append(bias_section(status, origin, shades))
    if field is not None:
        sections += field_sections(field, origin)
    if estimate is not None and mag is not None:
        sections.append(field_section(mag.stamp, carry(mag, estimate), origin, shades))
    if raw is not None or estimate is not None:
        sections.append(motion_section(raw, estimate, origin, shades))
    if FIX_TOPIC in contents.logs:
        sections.append(gnss_section(contents.log(FIX_TOPIC), contents.log(VELOCITY_TOPIC),
                                     origin))
    date = datetime.datetime.fromtimestamp(contents.start * 1e-9, datetime.timezone.utc)
    write_report(path, Path(bag).resolve().name, sections,
                 f"{bag}, starts {date:%Y-%m-%d %H:%M:%S} UTC by its stamps")
    return smoothed


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


def _usable(log, name, warnings):
    """The samples of a log that can be drawn: what the guard lets pass, with unit quaternions,
    up to where the clock was set back."""
    if hasattr(log, "quat_world_imu"):
        absent = np.linalg.norm(log.quat_world_imu, axis=1) < 0.5
        if absent.any():
            warnings.append(f"{name}: {absent.sum()} orientations are zero and left out")
            log = log[~absent]
    log, epochs, guard = guard_log(log)
    for reason, count in guard.refused().items():
        warnings.append(f"{name}: {count} samples left out: {reason}")
    if len(epochs) and epochs[-1] > 0:
        warnings.append(f"{name}: the clock was set back; only what comes before is shown")
        log = log[epochs == 0]
    return log


def _has(reader, topic, msgtype):
    name = find_topic(reader.topics, topic)
    return name is not None and reader.topics[name].msgtype == msgtype \
        and bool(reader.topics[name].count)


def moving_changes(reader):
    """(stamps, values) of the movement mask's changes, or None."""
    if not _has(reader, MOVING, BOOL_TYPE):
        return None
    name = find_topic(reader.topics, MOVING)
    pairs = [(log_time, bool_value(cdr)) for _, _, log_time, cdr in reader.messages([name])]
    return tuple(np.array(column) for column in zip(*pairs))
