"""The acceleration field estimator between its topics, live and in batch."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.impact_metrics import ImpactParams, measure_impacts
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    parse_configuration,
)
from imu_fusion.estimation.acceleration_field.rows import MISSING, SATURATED, field_at
from imu_fusion.geometry.rotation import quat_to_matrix
from imu_fusion.messages.convert import SampleType, imu_message
from imu_fusion.messages.layouts import ACCEL, IMU
from imu_fusion.messages.point_cloud import POINT_CLOUD_TYPE, cloud_message
from imu_fusion.parameters.declare import Parameters, flatten, param
from imu_fusion.parameters.file import node_values
from imu_fusion.samples import AccelerometerLog, ImuLog
from imu_fusion.samples.matching import SampleMatcher
from imu_fusion.samples.merge import merge_order
from imu_fusion.streams.stage import Stage
from imu_fusion.streams.stream import EstimatorNodeParams, Stream

NODE = "acceleration_field_estimator"
GYROSCOPE_TOPIC = "imu/data_raw"
IMU_TOPIC = "acceleration_field/imu"
ACCEL_TOPIC = "acceleration_field/accel"
POINTS_TOPIC = "acceleration_field/points"
OUTPUTS = {IMU_TOPIC: IMU.msgtype, ACCEL_TOPIC: ACCEL.msgtype, POINTS_TOPIC: POINT_CLOUD_TYPE}
# Names below these belong to single sensors, however many there are.
SENSOR_PREFIXES = ("accelerometers.",)
_FIELDS = ("x", "y", "z", "ax", "ay", "az", "magnitude")


@dataclass(frozen=True)
class MatchParams(Parameters):
    """``match.*``: how samples of several accelerometers become one."""

    tolerance: float = param(
        1e-4, unit="s", low=0.0,
        doc="Stamps that differ by no more belong to one sample. Raise it for clocks that are not "
            "synchronised, to less than half a sample interval.")
    hold: float = param(
        0.02, unit="s", low=0.0,
        doc="A sample waits no longer, in stamps of the others, for a missing accelerometer. Raise "
            "it for late networks.")


@dataclass(frozen=True)
class FieldStreamParams(Parameters):
    """What surrounds the estimator."""

    body_frame: str = param(
        "body", doc="frame_id of the body in everything published. Name it as your robot does.")
    match: MatchParams = MatchParams()
    impact: ImpactParams = ImpactParams()

    def idle(self) -> dict[str, str]:
        return {} if self.impact.detect else {
            f"impact.{info.name}": "with impact.detect false" for info in ImpactParams.infos()
            if info.name != "detect"}


def _acc_values(values):
    return values[..., IMU["linear_acceleration"]]


def _gyr_values(values):
    return values[..., IMU["angular_velocity"]]


ACCELEROMETER = SampleType(IMU, 3, _acc_values, AccelerometerLog)
GYROSCOPE = SampleType(IMU, 3, _gyr_values,
                       lambda stamp, gyr, frame: ImuLog(stamp, gyr, None, frame))


@dataclass(frozen=True)
class FieldConfiguration:
    """Parameters of the estimator, its accelerometers by name, and what surrounds it."""

    field: AccelerationFieldParams
    stream: FieldStreamParams
    accelerometers: dict[str, AccelerometerParams]

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], source: str = "") -> "FieldConfiguration":
        """From ROS parameter names and values, without those of the node itself.

        Raises:
            ParameterError, LayoutError: with the name of what is wrong.
        """
        flat = flatten(values)
        own = {info.name for info in FieldStreamParams.infos()}
        stream = FieldStreamParams.from_mapping({k: v for k, v in flat.items() if k in own}, source)
        field, accelerometers = parse_configuration(
            {k: v for k, v in flat.items() if k not in own}, source)
        return cls(field, stream, accelerometers)

    @staticmethod
    def names() -> set[str]:
        """Parameter names, without those of single sensors."""
        return {info.name for cls in NODE_PARAMETERS for info in cls.infos()}

    @property
    def inputs(self) -> dict[str, SampleType]:
        """Topics and what arrives on them."""
        inputs = {f"accelerometers/{name}": ACCELEROMETER for name in self.accelerometers}
        if self.field.use_gyro:
            inputs[GYROSCOPE_TOPIC] = GYROSCOPE
        return inputs

    def make_estimator(self) -> AccelerationFieldEstimator:
        """The estimator of these parameters."""
        return AccelerationFieldEstimator(self.field, self.accelerometers)

    def make_matcher(self) -> SampleMatcher:
        """What makes one sample of those of all inputs."""
        match = self.stream.match
        return SampleMatcher(len(self.inputs), 3, int(round(match.tolerance * 1e9)),
                             int(round(match.hold * 1e9)))

    def add(self, estimator: AccelerationFieldEstimator, stamp: int,
            readings: np.ndarray) -> np.ndarray:
        """Give one row of the matcher to the estimator; return its rows."""
        count = len(self.accelerometers)
        gyr = readings[count] if self.field.use_gyro else None
        return estimator.add(stamp, readings[:count], gyr)


def messages(config: FieldConfiguration, rows: np.ndarray) -> Iterator[tuple[str, int, bytes]]:
    """Yield (topic, stamp, cdr) of rows of the estimator."""
    gravity, frame = config.field.gravity, config.stream.body_frame
    points = np.reshape(config.field.points, (-1, 3))
    bodies = field_at(rows, points, gravity)[1] if len(points) and len(rows) else None
    for n, row in enumerate(rows):
        stamp = int(row["stamp"])
        turn = quat_to_matrix(row["quat"])
        yield IMU_TOPIC, stamp, imu_message(
            stamp, frame, row["omega"], row["specific_force"], row["quat"],
            turn @ row["cov_attitude"] @ turn.T, row["cov_omega"], row["cov_specific_force"])
        cov = np.zeros((6, 6))
        cov[:3, :3] = turn.T @ row["cov_acceleration_world"] @ turn
        cov[3:, 3:] = row["cov_alpha"]
        yield ACCEL_TOPIC, stamp, ACCEL.encode(stamp, frame, np.concatenate(
            [turn.T @ row["acceleration_world"], row["alpha"], cov.ravel()]))
        if bodies is not None:
            magnitude = np.linalg.norm(bodies[n], axis=1)
            yield POINTS_TOPIC, stamp, cloud_message(
                stamp, frame, _FIELDS, np.column_stack([points, bodies[n], magnitude]))


class AccelerationFieldStream(Stream):
    """See :class:`imu_fusion.streams.stream.Stream`; config: FieldConfiguration."""

    def __init__(self, config, emit=None, warn=lambda text: None):
        self.config = config
        self.estimator = config.make_estimator()
        self._index = {topic: k for k, topic in enumerate(config.inputs)}
        super().__init__(config.inputs, emit, warn)

    def restart(self):
        self.estimator.reset()
        self.matcher = self.config.make_matcher()
        self.saturated = self.missing = 0
        self.residual_rms = float("nan")

    def take(self, topic, stamp, sample):
        self._give(self.matcher.add(self._index[topic], stamp, sample))

    def flush(self):
        self._give(self.matcher.flush())
        self.smooth()

    def smooth(self):
        """Emit what mode smoothed has held back; returns the number of samples."""
        try:
            rows = self.estimator.finish()
        except EstimationError as error:
            self.warn(str(error))
            return 0
        self._write(rows)
        return len(rows)

    def summary(self):
        """Values for diagnostics."""
        return {"condition number": f"{self.estimator.condition_number:.3g}",
                "residual rms in units of noise": f"{self.residual_rms:.3g}",
                "saturated samples": self.saturated, "samples with a channel missing": self.missing,
                "late": self.matcher.late, "duplicates": self.matcher.duplicates,
                "incomplete": self.matcher.incomplete}

    def _give(self, matched):
        for stamp, readings in matched:
            self._write(self.config.add(self.estimator, stamp, readings))

    def _write(self, rows):
        if len(rows):
            self.residual_rms = float(rows["residual_rms"][-1])
            self.saturated += int(np.sum(rows["flags"] & SATURATED > 0))
            self.missing += int(np.sum(rows["flags"] & MISSING > 0))
            for message in messages(self.config, rows):
                self.emit(*message)


def process_logs(logs, report, config):
    """The messages that :class:`AccelerationFieldStream` emits for a session, from whole logs.

    The metrics of impacts, where there are any, go into the report's results.

    Args:
        config: FieldConfiguration.
        logs: dict of input topic to (log, epochs) of guarded samples; a topic may lack.
        report: StageReport.

    Yields:
        (topic, stamp, cdr)
    """
    topics = [topic for topic in config.inputs if topic in logs]
    index = {topic: k for k, topic in enumerate(config.inputs)}
    impacts = []
    samples = [logs[topic][0].flat() for topic in topics]
    epochs = [logs[topic][1] for topic in topics]
    for epoch in np.unique(np.concatenate(epochs)):
        keep = [np.flatnonzero(e == epoch) for e in epochs]
        stamps = [logs[topic][0].stamp[k] for topic, k in zip(topics, keep)]
        which, number = merge_order(stamps)
        matcher, estimator = config.make_matcher(), config.make_estimator()
        matched = []
        for k, i in zip(which.tolist(), number.tolist()):
            matched += matcher.add(index[topics[k]], int(stamps[k][i]), samples[k][keep[k][i]])
        matched += matcher.flush()
        if not matched:
            continue
        readings = np.array([r for _, r in matched])
        count = len(config.accelerometers)
        rows = estimator.run(np.array([s for s, _ in matched], dtype=np.int64),
                             readings[:, :count],
                             readings[:, count] if config.field.use_gyro else None)
        impacts += _impacts(config, rows)
        yield from messages(config, rows)
    if impacts:
        report.results["impacts"] = impacts
    if config.stream.impact.detect:
        number = len({impact["stamp"] for impact in impacts})
        report.summary = f"{number} impacts above {config.stream.impact.trigger:g} m/s^2"


def _impacts(config, rows):
    return measure_impacts(rows, config.field.points, config.field.gravity, config.stream.impact)


NODE_PARAMETERS = (EstimatorNodeParams, AccelerationFieldParams, FieldStreamParams)


def read_configuration(params_file: str | Path | None) -> FieldConfiguration:
    """The FieldConfiguration in a parameter file (or None).

    Raises:
        ParameterError, LayoutError: with the name of what is wrong.
    """
    old = AccelerationFieldParams.OLD_NAMES.keys()
    values = node_values(NODE, params_file, FieldConfiguration.names() | old)
    for info in EstimatorNodeParams.infos():
        values.pop(info.name, None)
    return FieldConfiguration.from_mapping(values, str(params_file or ""))


def _configure(stage, params_file):
    config = read_configuration(params_file)
    required = tuple(topic for topic in config.inputs if topic != GYROSCOPE_TOPIC)
    return replace(
        stage, inputs=config.inputs, required=required, unusable="" if config.accelerometers else
        "no accelerometers described; set accelerometers.names in a parameter file"), [config]


# Its topics are those of the accelerometers that a parameter file describes.
STAGE = Stage(NODE, (FieldConfiguration,), (EstimatorNodeParams,), {}, (), OUTPUTS, process_logs,
              configure=_configure)
