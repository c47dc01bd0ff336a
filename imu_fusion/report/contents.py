"""What a report needs of recordings: their logs, estimates and what was wrong with them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imu_fusion.errors import EstimationError, SampleError, TopicError
from imu_fusion.messages.convert import attitude_log, bool_value
from imu_fusion.messages.layouts import BOOL_TYPE, FIX, IMU, MAG, POSE, TWIST
from imu_fusion.messages.orientation_status import FLAGS_TYPE
from imu_fusion.recordings.bag_reader import Reader, find_topic, open_bag
from imu_fusion.recordings.inspect import TopicReport, inspect_topics
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.orientation_status import Status
from imu_fusion.report.smoother import Smoothed
from imu_fusion.samples import AttitudeLog
from imu_fusion.samples.guard import guard_log
from imu_fusion.samples.logs import Log
from imu_fusion.streams import smoother as smoothing
from imu_fusion.streams.orientation import BIAS_TOPIC, FLAGS_TOPIC
from imu_fusion.streams.registry import STAGES
from imu_fusion.surfaces.file import load_surface

RAW, MAGNETOMETER, ESTIMATES = "imu/data_raw", "imu/mag", "imu/data"
FIX_TOPIC, VELOCITY_TOPIC = "fix", "fix_velocity"
REFERENCE, MOVING = "reference/pose", "reference/moving"


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
    """

    topics: list[TopicReport]
    logs: Mapping[str, Log]
    reference_name: str | None
    changes: tuple[np.ndarray, np.ndarray] | None
    warnings: tuple[str, ...]
    start: int
    duration_s: float

    def log(self, topic: str | None) -> Any:
        """The log of a topic, or None."""
        return self.logs.get(topic) if topic else None

    def samples(self, topics: Iterable[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """dict of topic to (stamps, values), as a Stream uses them."""
        return {topic: (self.logs[topic].stamp, self.logs[topic].flat())
                for topic in topics if topic in self.logs and len(self.logs[topic])}


def read_contents(path: str | Path) -> Contents:
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


def read_estimates(path: str | Path) -> tuple[AttitudeLog | None, Status, list[str]]:
    """(log of imu/data or None, Status, warnings) of a recording."""
    warnings: list[str] = []
    with open_bag(path) as reader:
        cdrs = {name: [cdr for _, _, _, cdr in reader.messages([reader.require(name).name])]
                for name, msgtype in ((FLAGS_TOPIC, FLAGS_TYPE), (BIAS_TOPIC, TWIST.msgtype))
                if _has(reader, name, msgtype)}
        status = Status.from_messages(cdrs.get(FLAGS_TOPIC, ()), cdrs.get(BIAS_TOPIC, ()))
        if not _has(reader, ESTIMATES, IMU.msgtype):
            return None, status, warnings
        log = _usable(read_log(reader, ESTIMATES, attitude_log), ESTIMATES, warnings)
        return log, status, warnings


def estimate_orientation(contents: Contents, params_file: str | Path | None = None
                         ) -> tuple[AttitudeLog | None, Status]:
    """What the orientation estimator says of a recording's own samples; no log without
    imu/data_raw."""
    if RAW not in contents.logs:
        return None, Status.from_messages((), ())
    stage, params = STAGES["orientation_estimator"].prepare(params_file)
    stream = stage.stream(*params)
    stream.frame_ids = {topic: getattr(contents.logs[topic], "frame_id", "")
                        for topic in stage.inputs
                        if topic in contents.logs}
    made = stream.use(contents.samples(stage.inputs)) + stream.flush()
    cdrs = {topic: [cdr for part in made if part.topic == topic for cdr in part.cdrs]
            for topic in (ESTIMATES, FLAGS_TOPIC, BIAS_TOPIC)}
    return (attitude_log(cdrs[ESTIMATES]),
            Status.from_messages(cdrs[FLAGS_TOPIC], cdrs[BIAS_TOPIC]))


def smooth_recording(contents: Contents, params_file: str | Path | None = None
                     ) -> tuple[Smoothed | None, str | None]:
    """The smoothed trajectory of a recording.

    Returns:
        (Smoothed, None), or (None, why not in words); (None, None) without Imu or fixes.
    """
    if not set(smoothing.REQUIRED) <= contents.logs.keys():
        return None, None
    _, (params,) = STAGES["smoother"].prepare(params_file)
    try:
        result = smoothing.smooth(params, {
            topic: contents.logs[topic] for topic in smoothing.INPUTS if topic in contents.logs})
    except (EstimationError, SampleError) as error:
        return None, f"There is no smoothed trajectory: {error}"
    surface = load_surface(params.surface.file) if params.surface.file else None
    return Smoothed(result, params, surface, contents.log(FIX_TOPIC), contents.log(VELOCITY_TOPIC),
                    int(contents.log(RAW).stamp[0])), None


def moving_changes(reader: Reader) -> tuple[np.ndarray, np.ndarray] | None:
    """(stamps, values) of the movement mask's changes, or None."""
    if not _has(reader, MOVING, BOOL_TYPE):
        return None
    name = reader.require(MOVING).name
    pairs = [(log_time, bool_value(cdr)) for _, _, log_time, cdr in reader.messages([name])]
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
