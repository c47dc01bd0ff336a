"""The acceleration field estimator between its topics, live and in batch."""

import math
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_fusion.errors import EstimationError, ParameterError, SampleError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.impact_metrics import (
    UNITS,
    ImpactParams,
    corner_frequency,
    find_peaks,
    measure_impacts,
)
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    parse_configuration,
)
from imu_fusion.estimation.acceleration_field.rows import LEFT_OUT, MISSING, SATURATED
from imu_fusion.estimation.acceleration_field.sensor_faults import FIT_UNITS
from imu_fusion.geometry.rotation import quat_to_matrix
from imu_fusion.kernels import njit
from imu_fusion.messages.convert import SampleType, imu_messages
from imu_fusion.messages.layouts import ACCEL, IMU
from imu_fusion.messages.point_cloud import POINT_CLOUD_TYPE, cloud_messages
from imu_fusion.parameters.declare import Parameters, flatten, param
from imu_fusion.parameters.file import ParamsFile, node_values, source_of
from imu_fusion.samples import AccelerometerLog, ImuLog, checks
from imu_fusion.samples.blocks import Samples
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.matching import SampleMatcher
from imu_fusion.streams.stage import Stage
from imu_fusion.streams.stream import Conclusion, EstimatorNodeParams, Messages, Stream

NODE = "acceleration_field_estimator"
GYROSCOPE_TOPIC = "imu/data_raw"
IMU_TOPIC = "acceleration_field/imu"
ACCEL_TOPIC = "acceleration_field/accel"
POINTS_TOPIC = "acceleration_field/points"
OUTPUTS = {IMU_TOPIC: IMU.msgtype, ACCEL_TOPIC: ACCEL.msgtype, POINTS_TOPIC: POINT_CLOUD_TYPE}
# Names below these belong to single sensors, however many there are.
SENSOR_PREFIXES = ("accelerometers.",)
_INCOMPLETE = 0.1   # of the samples, that is worth a remark
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
    rows_of: str = param(
        "", doc="Name of an accelerometer: estimates come at its stamps alone. Empty: at every "
                "stamp, which are several per instant where accelerometers are not stamped alike.")


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
                       lambda stamp, gyr, frame: ImuLog(
                           stamp, gyr, np.full_like(gyr, np.nan), frame))


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
        rows_of = stream.match.rows_of
        if rows_of and rows_of not in accelerometers:
            raise ParameterError(f"parameter 'match.rows_of': no accelerometer '{rows_of}'; there "
                                 f"are: {', '.join(accelerometers)}")
        for name in ("linear_class", "angular_class"):
            channel_class = getattr(stream.impact, name)
            if channel_class is not None:
                try:
                    corner_frequency(channel_class, field.sample_rate)
                except SampleError as error:
                    raise ParameterError(f"parameter 'impact.{name}': {error}; the rate is that of "
                                         "the parameter sample_rate") from None
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

    def findings(self, logs: Mapping[str, Any]) -> list[Finding]:
        """What looks wrong with whole logs as recorded, by topic."""
        found: list[Finding] = []
        for topic, log in logs.items():
            found += (checks.check_imu(log, topic) if topic == GYROSCOPE_TOPIC else
                      checks.check_accelerometer(log, topic, self.feels_gravity))
        return found

    @property
    def feels_gravity(self) -> bool:
        """Whether the accelerometers, which all report the same, do."""
        return self.field.gravity > 0.0 and all(
            own.reports == "specific_force" for own in self.accelerometers.values())

    def make_estimator(self) -> AccelerationFieldEstimator:
        """The estimator of these parameters."""
        return AccelerationFieldEstimator(self.field, self.accelerometers)

    def make_matcher(self) -> SampleMatcher:
        """What makes one sample of those of all inputs."""
        match = self.stream.match
        return SampleMatcher(len(self.inputs), 3, int(round(match.tolerance * 1e9)),
                             int(round(match.hold * 1e9)))


def messages(config: FieldConfiguration, rows: np.ndarray) -> list[Messages]:
    """Messages of rows of the estimator."""
    if not len(rows):
        return []
    frame, stamp = config.stream.body_frame, np.ascontiguousarray(rows["stamp"])
    points = np.reshape(np.asarray(config.field.points, float), (-1, 3))
    accel = np.zeros((len(rows), ACCEL.size))
    cloud = np.empty((len(rows), len(points), len(_FIELDS)))
    _fill(rows, points, config.field.gravity, accel, cloud)
    made = [
        Messages(IMU_TOPIC, stamp, imu_messages(
            stamp, frame, rows["omega"], rows["cov_omega"], rows["specific_force"],
            rows["cov_specific_force"], rows["quat"], rows["cov_attitude"],
            np.ones(len(rows), dtype=bool))),
        Messages(ACCEL_TOPIC, stamp, ACCEL.encode_block(stamp, frame, accel))]
    if len(points):
        made.append(Messages(POINTS_TOPIC, stamp, cloud_messages(stamp, frame, _FIELDS, cloud)))
    return made


@njit
def _fill(rows, points, gravity, accel, cloud):
    """Numbers of the messages of rows, in place: accel (n, 42) as in ACCEL, cloud (n, p, 7) as in
    _FIELDS, of body points (p, 3); see :func:`~.rows.field_at`. gravity: m/s^2."""
    for n in range(len(rows)):
        row = rows[n]
        turn = quat_to_matrix(row.quat)
        back = np.ascontiguousarray(turn.T)
        cov = back @ row.cov_acceleration_world @ turn
        accel[n, :3] = back @ row.acceleration_world
        accel[n, 3:6] = row.alpha
        for i in range(3):
            for j in range(3):
                accel[n, 6 + 6 * i + j] = cov[i, j]
                accel[n, 27 + 6 * i + j] = row.cov_alpha[i, j]
        for p in range(len(points)):
            change = row.gradient @ points[p]
            square = 0.0
            for i in range(3):
                body = row.specific_force[i] + change[i] - gravity * turn[2, i]
                cloud[n, p, i] = points[p, i]
                cloud[n, p, 3 + i] = body
                square += body * body
            cloud[n, p, 6] = math.sqrt(square)


class AccelerationFieldStream(Stream):
    """See :class:`imu_fusion.streams.stream.Stream`; config: FieldConfiguration."""

    def __init__(self, config: FieldConfiguration,
                 warn: Callable[[str], object] = lambda text: None) -> None:
        self.config = config
        self.estimator = config.make_estimator()
        self._index = {topic: k for k, topic in enumerate(config.inputs)}
        super().__init__(config.inputs, warn)

    def reset(self, session_topics: Container[str] | None = None) -> None:
        self._impacts: list[dict[str, Any]] = []
        self._peaks: list[dict[str, Any]] = []    # of each stretch between restarts
        super().reset(session_topics)

    def restart(self) -> None:
        # Where a clock was set the body may be in any motion.
        self.estimator.reset(start_known=not self.restarts)
        self.matcher = self.config.make_matcher()
        self._rows: list[np.ndarray] = []
        self._asked = np.empty(0, np.int64)    # stamps of rows to come, with match.rows_of
        self.saturated = self.missing = self.left_out = 0
        self.residual_rms = float("nan")

    def use(self, samples: Mapping[str, Samples]) -> list[Messages]:
        return self._give(*self.matcher.add_block(
            {self._index[topic]: part for topic, part in samples.items()}))

    def flush(self) -> list[Messages]:
        made = self._give(*self.matcher.flush_block())
        return made + self.smooth()

    def smooth(self) -> list[Messages]:
        """Messages of what mode smoothed has held back."""
        try:
            made = self._write(self.estimator.finish())
        except EstimationError as error:
            self.warn(str(error))
            return []
        if self._rows:
            rows, field = np.concatenate(self._rows), self.config.field
            self._peaks.append(find_peaks(rows, field.points, field.gravity))
            self._impacts += measure_impacts(rows, field.points, field.gravity,
                                             self.config.stream.impact)
            self._rows = []
        return made

    def look_at(self, topic: str, logs: Mapping[str, Any]) -> list[str]:
        if topic == GYROSCOPE_TOPIC or not self.config.feels_gravity:
            return []
        log = logs[topic]
        return [found.text for found in checks.check_acceleration(log.acc, log.stamp, topic)]

    def conclude(self) -> Conclusion:
        """How the sensors fit, the greatest magnitudes, and the metrics of impacts if there are
        any."""
        results: dict[str, Any] = {}
        fits = self.estimator.sensor_fits()
        if fits or self._peaks:
            results["units"] = UNITS | FIT_UNITS
        if fits:
            results["accelerometers"] = {fit.name: fit.numbers() for fit in fits}
        impact, remarks, summary = self.config.stream.impact, self.remarks(), ""
        if self._peaks:
            peaks = max(self._peaks, key=lambda found: max(found["peak_linear_acceleration"]))
            results["peaks"] = peaks
            first = peaks["peak_linear_acceleration"][0]
            if impact.detect and not self._impacts:
                remarks.append("no impact was measured: the linear acceleration at the first "
                               f"point reaches {first:.3g} m/s^2, impact.trigger is "
                               f"{impact.trigger:.3g} m/s^2; lower it for a light impact, or set "
                               "impact.detect: false where there is none")
        if remarks:
            results["remarks"] = remarks
        if self._impacts:
            results["impacts"] = self._impacts
        if impact.detect:
            number = len({found["stamp"] for found in self._impacts})
            summary = f"{number} impacts above {impact.trigger:g} m/s^2"
        return Conclusion(results=results, remarks=remarks, summary=summary)

    def remarks(self) -> list[str]:
        found = self.estimator.remarks()
        if self.matcher.incomplete > _INCOMPLETE * self.matcher.left:
            match = self.config.stream.match
            found.append(
                f"{self.matcher.incomplete} of {self.matcher.left} samples lack an accelerometer: "
                f"their stamps differ by more than match.tolerance ({match.tolerance:g} s), or "
                "samples are lost; raise match.tolerance to less than half a sample interval, or "
                "set match.rows_of for one estimate per instant")
        return found

    def summary(self) -> dict[str, object]:
        """Values for diagnostics."""
        fits = {f"{fit.name} left out": fit.left_out for fit in self.estimator.sensor_fits()}
        return {"condition number": f"{self.estimator.condition_number:.3g}",
                "residual rms in units of noise": f"{self.residual_rms:.3g}",
                "saturated samples": self.saturated, "samples with a channel missing": self.missing,
                "samples with an accelerometer left out": self.left_out, **fits,
                "late": self.matcher.late, "duplicates": self.matcher.duplicates,
                "incomplete": self.matcher.incomplete}

    def _give(self, stamp, readings):
        if not len(stamp):
            return []
        count = len(self.config.accelerometers)
        gyr = readings[:, count] if self.config.field.use_gyro else None
        if self.config.stream.match.rows_of:
            own = readings[:, self._index[f"accelerometers/{self.config.stream.match.rows_of}"]]
            self._asked = np.append(self._asked, stamp[np.isfinite(own).any(axis=1)])
        return self._write(self.estimator.take(stamp, readings[:, :count], gyr))

    def _write(self, rows):
        if len(rows) and self.config.stream.match.rows_of:
            last = rows["stamp"][-1]
            rows = rows[np.isin(rows["stamp"], self._asked)]
            self._asked = self._asked[self._asked > last]
        if not len(rows):
            return []
        self.residual_rms = float(rows["residual_rms"][-1])
        flags = rows["flags"]
        if flags.any():
            self.saturated += int(np.count_nonzero(flags & SATURATED))
            self.missing += int(np.count_nonzero(flags & MISSING))
            self.left_out += int(np.count_nonzero(flags & LEFT_OUT))
        if self.concludes:
            self._rows.append(rows)
        return messages(self.config, rows)


NODE_PARAMETERS = (EstimatorNodeParams, AccelerationFieldParams, FieldStreamParams)


def read_configuration(params_file: ParamsFile) -> FieldConfiguration:
    """The FieldConfiguration in a ParamsFile.

    Raises:
        ParameterError, LayoutError: with the name of what is wrong.
    """
    old = AccelerationFieldParams.OLD_NAMES.keys()
    values = node_values(NODE, params_file, FieldConfiguration.names() | old)
    for info in EstimatorNodeParams.infos():
        values.pop(info.name, None)
    return FieldConfiguration.from_mapping(values, source_of(params_file))


def _configure(stage, params_file):
    config = read_configuration(params_file)
    required = tuple(topic for topic in config.inputs if topic != GYROSCOPE_TOPIC)
    return replace(
        stage, inputs=config.inputs, required=required, findings=config.findings,
        unusable="" if config.accelerometers else
        "no accelerometers described; set accelerometers.names in a parameter file"), [config]


# Its topics are those of the accelerometers that a parameter file describes.
STAGE = Stage(NODE, (FieldConfiguration,), (EstimatorNodeParams,), {}, (), OUTPUTS,
              AccelerationFieldStream, configure=_configure)
