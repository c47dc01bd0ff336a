"""What a report needs of recordings: their logs, estimates and what was wrong with them."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from imu_fusion.batch import estimate
from imu_fusion.errors import MessageError, TopicError
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.messages.convert import attitude_log, bool_value
from imu_fusion.messages.layouts import BOOL_TYPE, FIX, IMU, MAG, POSE, TWIST, Layout
from imu_fusion.messages.orientation_status import FLAGS_TYPE, flags_value
from imu_fusion.parameters.file import ParamsFile
from imu_fusion.recordings.bag_reader import Reader, find_topic, open_bag
from imu_fusion.recordings.inspect import TopicReport, inspect_topics
from imu_fusion.recordings.logs import readable_messages
from imu_fusion.report.orientation_status import Status
from imu_fusion.report.smoother import Smoothed
from imu_fusion.report.trajectory_data import read_result
from imu_fusion.samples import AttitudeLog
from imu_fusion.samples.guard import usable_part
from imu_fusion.samples.logs import Log
from imu_fusion.streams.orientation_messages import BIAS_TOPIC, FLAGS_TOPIC
from imu_fusion.streams.stage import StageReport
from imu_fusion.surfaces.file import load_surface

RAW, MAGNETOMETER, ESTIMATES = "imu/data_raw", "imu/mag", "imu/data"
FIX_TOPIC, VELOCITY_TOPIC = "fix", "fix_velocity"
REFERENCE, MOVING = "reference/pose", "reference/moving"
ORIENTATION, SMOOTHER = "orientation_estimator", "smoother"

# Types, and what reads them.
_ESTIMATES: dict[str, tuple[str, Layout | Callable[[bytes], object]]] = {
    ESTIMATES: (IMU.msgtype, IMU), FLAGS_TOPIC: (FLAGS_TYPE, flags_value),
    BIAS_TOPIC: (TWIST.msgtype, TWIST)}


@dataclass(frozen=True, eq=False)
class Contents:
    """What a report needs of a recording.

    Attributes:
        topics: of every topic, its TopicReport.
        logs: topic to the log of its usable samples.
        reference_name: topic of the poses to compare with, or None.
        changes: (stamps, values) of the movement mask, or None.
        warnings: texts on what was left out.
        start: int ns, log time of the first message; ``duration_s`` up to the last one.
        damaged: whether parts of the recording are lost.
    """

    topics: list[TopicReport]
    logs: Mapping[str, Log]
    reference_name: str | None
    changes: tuple[np.ndarray, np.ndarray] | None
    warnings: tuple[str, ...]
    start: int
    duration_s: float
    damaged: bool

    def log(self, topic: str | None) -> Any:
        """The log of a topic, or None."""
        return self.logs.get(topic) if topic else None


def read_contents(path: str | Path, remap: Mapping[str, str] | None = None) -> Contents:
    """Read a recording for a report. remap: topic names of ours to those in it.

    Raises:
        BagError, TopicError: it cannot be read, or holds no messages.
    """
    with open_bag(path, remap=remap) as reader:
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
                        reader.start_time, (reader.end_time - reader.start_time) * 1e-9,
                        reader.damaged)


@dataclass(frozen=True, eq=False)
class Estimates:
    """What is drawn of an orientation: its log (None: there is none), Status, and texts on what
    was left out."""

    log: AttitudeLog | None
    status: Status
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a recording holds of estimates: of the orientation; of the smoother, or else why there
    is none; its ``remarks``, and those of others beside the recording; names of its ``topics``;
    what of it is lost, in words."""

    orientation: Estimates
    trajectory: SmootherResult | None
    obstacle: str
    remarks: list[str]
    topics: list[str]
    losses: list[str]


def read_recorded(path: str | Path, remap: Mapping[str, str] | None = None) -> Recorded:
    """The estimates in a recording; remap: topic names of ours to those in it."""
    with open_bag(path, remap=remap) as reader:
        found = {name: readable_messages(reader, name, form)
                 for name, (msgtype, form) in _ESTIMATES.items() if _has(reader, name, msgtype)}
        orientation = _estimates({name: cdrs for name, cdrs in found.items() if cdrs})
        trajectory, remarks, obstacle = read_result(reader)
        return Recorded(orientation, trajectory, obstacle,
                        [f"{SMOOTHER}: {remark}" for remark in remarks], list(reader.topics),
                        reader.losses)


def make_estimates(bag: str | Path, params_file: ParamsFile, with_orientation: bool,
                   remap: Mapping[str, str] | None = None) -> tuple[Estimates, StageReport]:
    """What ``process`` would say of a recording: Estimates, and the smoother's StageReport.

    Args:
        bag: recording.
        params_file: ParamsFile; None: defaults.
        with_orientation: whether the orientation is estimated, too.
        remap: topic names of ours to those in the recording.
    """
    nodes = [SMOOTHER, *([ORIENTATION] if with_orientation else [])]
    reports, made = estimate(bag, nodes, params_file, _ESTIMATES, remap)
    found = _estimates({topic: cdrs for topic, cdrs in made.items() if cdrs})
    return replace(found, warnings=[
        *(text for node in nodes for text in (*reports[node].warnings, *reports[node].remarks)),
        *found.warnings]), reports[SMOOTHER]


def smoothed_of(report: StageReport, origin: int) -> tuple[Smoothed | None, str | None]:
    """(Smoothed, None) of the smoother's report, or (None, why not in words).

    Args:
        report: of the smoother. origin: int ns, zero of the time axes.
    """
    if report.detail is None:
        return None, report.skipped
    result, logs = report.detail
    (params,) = report.params
    surface = load_surface(params.surface.file) if params.surface.file else None
    return Smoothed(result, params, surface, logs.get(FIX_TOPIC), logs.get(VELOCITY_TOPIC),
                    origin), None


def _estimates(cdrs):
    warnings: list[str] = []
    log = None
    if ESTIMATES in cdrs:
        log = _usable(attitude_log(cdrs[ESTIMATES]), ESTIMATES, warnings)
    status = Status.from_messages(cdrs.get(FLAGS_TOPIC, ()), cdrs.get(BIAS_TOPIC, ()))
    return Estimates(log if log is not None and len(log) else None, status, warnings)


def moving_changes(reader: Reader) -> tuple[np.ndarray, np.ndarray] | None:
    """(stamps, values) of the movement mask's changes, or None."""
    if not _has(reader, MOVING, BOOL_TYPE):
        return None
    pairs = []
    for _, _, log_time, cdr in reader.messages([reader.require(MOVING).name]):
        with contextlib.suppress(MessageError):
            pairs.append((log_time, bool_value(cdr)))
    if not pairs:
        return None
    stamps, values = zip(*pairs)
    return np.array(stamps), np.array(values)


def _usable(log, name, warnings):
    """The samples of a log that can be drawn: what the guard lets pass, with unit quaternions,
    up to where the clock was set back."""
    if hasattr(log, "quat_world_imu"):
        absent = np.linalg.norm(log.quat_world_imu, axis=1) < 0.5
        if absent.any():
            warnings.append(f"{name}: {absent.sum()} orientations are zero and left out")
            log = log[~absent]
    log, texts = usable_part(log, name)
    warnings += texts
    return log


def _has(reader, topic, msgtype):
    name = find_topic(reader.topics, topic)
    return name is not None and reader.topics[name].msgtype == msgtype \
        and bool(reader.topics[name].count)
