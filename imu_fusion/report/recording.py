"""The report of a recording: what it holds, and how good what is made from it is."""

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.evaluation.orientation_error import (
    OrientationErrors,
    moving_at,
    orientation_errors,
)
from imu_fusion.parameters.file import ParamsFile
from imu_fusion.report.acceleration_field import field_sections
from imu_fusion.report.avalanche import slope_of, slope_section
from imu_fusion.report.contents import (
    FIX_TOPIC,
    MAGNETOMETER,
    RAW,
    REFERENCE,
    VELOCITY_TOPIC,
    Contents,
    make_estimates,
    read_contents,
    read_recorded,
    smoothed_of,
)
from imu_fusion.report.field_data import FieldData, read_field
from imu_fusion.report.figures import Shade, intervals
from imu_fusion.report.gnss import gnss_section
from imu_fusion.report.html import Block, Notes, Numbers, Section, Text, write_report
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
from imu_fusion.report.trajectory_data import smoothing_params
from imu_fusion.samples import AttitudeLog, MagLog, seconds
from imu_fusion.surfaces.file import load_surface


class Written(NamedTuple):
    """What a report was made of: ``smoothed`` None if there is no trajectory; ``complete``:
    nothing of the recording was lost; its ``sections``."""

    smoothed: Smoothed | None
    complete: bool
    sections: list[Section]


@dataclass(frozen=True, eq=False)
class _Material:
    """All that the sections tell of; None where there is no such thing.

    ``source``: where the estimates come from, in words; ``obstacle``: why there is no
    trajectory; ``held``: topics of the recording with the estimates, and its ``losses``;
    ``warnings``: of the recordings and the smoother.
    """

    contents: Contents
    source: str
    estimate: AttitudeLog | None
    status: Status
    smoothed: Smoothed | None
    obstacle: str | None
    held: list[str]
    losses: list[str]
    field: FieldData | None
    warnings: list[str]

    @property
    def raw(self):
        """ImuLog of the recording."""
        return self.contents.log(RAW)

    @property
    def reference(self):
        """PoseLog to compare with."""
        return self.contents.log(self.contents.reference_name)

    @property
    def is_truth(self):
        """Whether the reference is better than any estimate."""
        return self.contents.reference_name == REFERENCE

    @cached_property
    def clock(self):
        """Stamps (n,) ns that stand for the whole recording."""
        return next((log.stamp for log in (self.raw, self.estimate, self.contents.log(FIX_TOPIC))
                     if log is not None and len(log)), None)

    @property
    def origin(self):
        """int ns, zero of the time axes."""
        return self.contents.start if self.clock is None else int(self.clock[0])

    @cached_property
    def errors(self) -> OrientationErrors | None:
        """Of the orientation against the reference."""
        if self.estimate is None or self.reference is None:
            return None
        return orientation_errors(self.estimate.stamp, self.estimate.quat_world_imu,
                                  self.reference, self.estimate.cov_attitude)

    @cached_property
    def moving(self):
        """(n,) bool, in which errors the sensor was moving."""
        if self.errors is None or self.contents.changes is None:
            return None
        return moving_at(self.errors.stamp, *self.contents.changes)

    @cached_property
    def shades(self):
        """Spans of movement and of what the estimator said about itself."""
        shades = []
        if self.contents.changes is not None and self.clock is not None:
            shades = [Shade("in movement", tuple(intervals(
                seconds(self.clock, self.origin),
                moving_at(self.clock, *self.contents.changes))))]
        if self.estimate is not None:
            shades += status_shades(self.status, self.origin, int(self.estimate.stamp[-1]),
                                    with_rest=not shades)
        return shades


def write_recording_report(bag: str | Path, estimates: str | Path | None, path: str | Path,
                           params_file: ParamsFile = None,
                           remap: Mapping[str, str] | None = None) -> Written:
    """Write the HTML report of a recording.

    Args:
        bag: recording with sensor topics and perhaps ``reference/pose``; another PoseStamped
            topic is used in its place if there is no such topic.
        estimates: recording with what the estimators have written, may be the same; the report
            says what it lacks. None: those in ``bag``, and what it lacks of orientation and
            trajectory as ``process`` would make it.
        path: HTML file to write.
        params_file: ParamsFile of the estimators; None: defaults.
        remap: topic names of ours to those in ``bag``.

    Returns:
        Written.

    Raises:
        BagError, TopicError: a recording cannot be read, or holds nothing to report about.
        ImuFusionError: parameters are not usable, or the file cannot be written.
    """
    material = _gather(bag, estimates, params_file, remap)
    contents = material.contents
    sections = [_summary(material), overview_section(contents.topics, material.origin),
                *_estimates(material), *_measurements(material)]
    date = datetime.datetime.fromtimestamp(contents.start * 1e-9, datetime.UTC)
    write_report(path, Path(bag).resolve().name, sections,
                 f"{bag}, starts {date:%Y-%m-%d %H:%M:%S} UTC by its stamps")
    return Written(material.smoothed, not (contents.damaged or material.losses), sections)


def _gather(bag, estimates, params_file, remap) -> _Material:
    contents = read_contents(bag, remap)
    source = bag if estimates is None else estimates
    recorded = read_recorded(source, remap if estimates is None else None)
    drawn, smoothed = recorded.orientation, None
    obstacle: str | None = recorded.obstacle
    warnings = [*contents.warnings, *drawn.warnings, *recorded.remarks]
    raw = contents.log(RAW)
    origin = int(raw.stamp[0]) if raw is not None and len(raw) else contents.start
    own = drawn.log is None and estimates is None
    if recorded.trajectory is not None:
        params = smoothing_params(params_file)
        surface = load_surface(params.surface.file) if params.surface.file else None
        smoothed = Smoothed(recorded.trajectory, params, surface, contents.log(FIX_TOPIC),
                            contents.log(VELOCITY_TOPIC), origin)
    if estimates is None and (own or smoothed is None):
        made, smoother = make_estimates(bag, params_file, own, remap)
        drawn = made if own else drawn
        warnings += made.warnings
        if smoothed is None:
            smoothed, obstacle = smoothed_of(smoother, origin)
    field = read_field(bag, source, params_file, remap)
    losses = [*recorded.losses, *(() if field is None else field.losses)]
    return _Material(contents, "this report's own run" if own else str(source), drawn.log,
                     drawn.status, smoothed, obstacle, recorded.topics, losses, field,
                     list(dict.fromkeys([*warnings, *losses])))


def _summary(material) -> Section:
    """Key numbers, and what to know before the figures."""
    m, contents = material, material.contents
    rate = next((t.rate for t in contents.topics if t.topic.lstrip("/") == RAW), None)
    rate = np.nan if rate is None else rate
    findings = sum(len(t.findings) for t in contents.topics) + len(m.warnings)
    if m.smoothed is None:
        numbers = key_numbers(contents.duration_s, rate, m.errors, m.moving, findings, m.is_truth)
    else:  # the orientation alone is no longer what counts most
        numbers = key_numbers(contents.duration_s, rate, findings=findings)
        numbers = Numbers((*smoother_numbers(m.smoothed.result), *numbers.items))
    blocks: list[Block] = [numbers]
    if m.warnings:
        blocks.append(Notes(tuple(m.warnings)))
    if m.estimate is None and m.field is None and m.smoothed is None:
        held = ", ".join(sorted(m.held)) or "nothing"
        blocks.append(Text(f"{Path(m.source).name} holds no estimates, but {held}: this report is "
                           "about the recording alone. imu_fusion process makes them."))
    elif m.errors is not None:
        blocks.append(Text(f"Orientation from {m.source} against {contents.reference_name} of "
                           "the recording" + ("." if m.is_truth else ", which is somebody's "
                                              "estimate too: what follows are differences, not "
                                              "errors.")))
    if m.smoothed is None:
        blocks.append(Text(f"There is no smoothed trajectory: {m.obstacle}."))
    return Section("Summary", tuple(blocks))


def _estimates(material) -> list[Section]:
    """Trajectory, orientation with its errors and biases, acceleration field."""
    m, contents = material, material.contents
    sections = []
    if m.smoothed is not None:
        # Positions of the reference count from the origin of the surface.
        in_world = m.is_truth and m.smoothed.surface is not None \
            and np.any(m.reference.position_world)
        sections += smoother_sections(m.smoothed, m.reference if in_world else None)
        slope = slope_of(m.smoothed, m.raw)
        if slope is not None:
            sections.insert(1, slope_section(slope, contents.log(MAGNETOMETER)))
    if m.estimate is not None:
        sections.append(orientation_section(m.estimate, m.origin, m.reference,
                                            contents.reference_name or "", m.shades))
    if m.errors is not None:
        sections.append(error_section(m.errors, m.origin, m.moving, contents.reference_name,
                                      m.is_truth, m.shades))
    if len(m.status.bias):
        sections.append(bias_section(m.status, m.origin, m.shades))
    if m.field is not None:
        sections += field_sections(m.field, m.origin)
    return sections


def _measurements(material) -> list[Section]:
    """What the sensors measured: magnetic field, motion, GNSS."""
    m, contents = material, material.contents
    sections = []
    mag = contents.log(MAGNETOMETER)
    if m.estimate is not None and mag is not None:
        sections.append(field_section(mag.stamp, carry(mag, m.estimate), m.origin, m.shades))
    if m.raw is not None or m.estimate is not None:
        sections.append(motion_section(m.raw, m.estimate, m.origin, m.shades))
    if FIX_TOPIC in contents.logs:
        sections.append(gnss_section(contents.log(FIX_TOPIC), contents.log(VELOCITY_TOPIC),
                                     m.origin))
    return sections


def carry(mag: MagLog, estimate: AttitudeLog) -> np.ndarray:
    """Magnetometer samples turned into the world by the nearest estimate before them.

    Args:
        mag: samples; estimate: a log with ``stamp`` and ``quat_world_imu``.

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
