"""The smoother between its topics: a collection of samples in, a trajectory out.

The node collects while a bag plays or a robot runs; batch reads whole logs. Both
end in :func:`smooth`, and so in the same messages.
"""

import json
import math
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import EstimationError, MessageError, ParameterError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.estimation.orientation.recovered import recover
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.params import SurfaceContact
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.estimation.smoother.state import BLOCKS
from imu_fusion.messages.convert import SAMPLE_TYPES, fix_messages
from imu_fusion.messages.diagnostics import DIAGNOSTICS_TYPE, diagnostics_message, diagnostics_value
from imu_fusion.messages.layouts import (
    FIX,
    IMU,
    MAG,
    NANOSECONDS,
    ODOMETRY,
    POSE_COVARIANCE,
    TWIST,
)
from imu_fusion.messages.transforms import TF_TOPIC, TF_TYPE, transform_messages
from imu_fusion.messages.typestore import TYPES
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.blocks import Samples, joined
from imu_fusion.sensors.linear_calibration import ImuCalibration
from imu_fusion.streams.stage import Stage, check_logs
from imu_fusion.streams.stream import (
    FIX_TOPIC,
    IMU_TOPIC,
    MAG_TOPIC,
    VELOCITY_TOPIC,
    Conclusion,
    EstimatorNodeParams,
    Messages,
    Stream,
)
from imu_fusion.surfaces.file import load_surface

INPUTS = {topic: SAMPLE_TYPES[layout.msgtype] for topic, layout in (
    (IMU_TOPIC, IMU), (MAG_TOPIC, MAG), (FIX_TOPIC, FIX), (VELOCITY_TOPIC, TWIST))}
_REQUIRED = (IMU_TOPIC, FIX_TOPIC)

ODOMETRY_TOPIC, SMOOTHED_IMU_TOPIC = "smoother/odometry", "smoother/imu"
SMOOTHED_FIX_TOPIC, POSE_TOPIC = "smoother/fix", "smoother/pose"
PATH_TOPIC, RESULTS_TOPIC = "smoother/path", "smoother/results"
PATH_TYPE = "nav_msgs/msg/Path"
OUTPUTS = {ODOMETRY_TOPIC: ODOMETRY.msgtype, SMOOTHED_IMU_TOPIC: IMU.msgtype,
           SMOOTHED_FIX_TOPIC: FIX.msgtype, POSE_TOPIC: POSE_COVARIANCE.msgtype,
           PATH_TOPIC: PATH_TYPE, RESULTS_TOPIC: DIAGNOSTICS_TYPE}
ONCE = (PATH_TOPIC, RESULTS_TOPIC)

_NAME = "smoother"
_SLICE = 1000  # samples whose messages are made at once


@dataclass(frozen=True)
class SurfaceFile(SurfaceContact):
    """Which surface, and how the body is held on it."""

    file: str | None = param(
        None, path=True, doc="Surface that the body moves on: a name in config/surfaces or the "
        "path of a YAML file; unset: none.")


@dataclass(frozen=True)
class Frames(Parameters):
    """``frame.*``: names in what is published; nothing is transformed by them."""

    world: str = param("world", doc="East-north-up frame of the trajectory. Name it map, as REP "
                       "105 has it, where a robot's frames hang below it.")
    body: str | None = param(None, doc="Frame of the Imu; unset: the frame_id of its messages. "
                             "Name it as your robot does where its driver does not.")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, frame in (("world", self.world), ("body", self.body)):
            if frame is not None and (not frame or frame.startswith("/")):
                raise ParameterError(f"parameter 'frame.{name}': '{frame}' is no frame of tf2; "
                                     "give a name without a leading slash")
        if self.world == self.body:
            raise ParameterError(f"parameter 'frame.body': '{self.body}' is the name of "
                                 "frame.world, too; give them two names")


@dataclass(frozen=True)
class SmoothingParams(SmootherParams):
    """The smoother's parameters and what surrounds it."""

    OLD_NAMES: ClassVar[Mapping[str, str]] = {**SmootherParams.OLD_NAMES,
                                              "surface": "surface.file"}

    recover_rates: bool = param(
        False, doc="First recover rates beyond the gyroscope's range from the magnetometer, as the "
        "orientation estimator does on a whole recording, and take them with their covariance. "
        "Set it for a body that tumbles beyond the range.")
    calibration: ImuCalibration = ImuCalibration()
    surface: SurfaceFile = SurfaceFile()
    frame: Frames = Frames()
    path_rate: float = param(10.0, unit="Hz", low=0.01, high=1000.0,
                             doc="Rate of smoother/pose and of the poses of smoother/path. Lower "
                                 "it for long recordings.")
    publish_tf: bool = param(
        False, doc="Also write the trajectory to /tf, from frame.world to the frame of the Imu. "
        "Not where another node publishes a parent of that frame. The node needs tf2_msgs.")

    def idle(self) -> dict[str, str]:
        idle = super().idle()
        if self.surface.file is None:
            idle |= dict.fromkeys(("surface.", "jump."), "without surface.file")
        return idle


@dataclass(frozen=True)
class SmootherNodeParams(Parameters):
    """What concerns the node, not the trajectory."""

    smooth_at_end: bool = param(
        False, doc="Smooth when a replay has ended, as if smoother/smooth were called. A refusal, "
        "and a replay that plays not enough or breaks off, end the node with code 1.")
    memory_limit: float = param(1000.0, unit="MB", low=1.0, high=100000.0,
                                doc="Collected samples may take this much; then no more are "
                                    "taken, and smoothing is refused until smoother/clear. Imu "
                                    "and magnetometer at 100 Hz take 32 MB an hour; smoothing "
                                    "takes more (docs/smoother.md).")


def required_of(params: SmootherParams) -> tuple[str, ...]:
    """Topics without which there is nothing to smooth: fixes are not, where the start is given."""
    return _REQUIRED if params.initial.position is None else (IMU_TOPIC,)


def outputs_of(params: SmoothingParams) -> dict[str, str]:
    """Topics and types of what is published under these parameters."""
    return OUTPUTS | ({TF_TOPIC: TF_TYPE} if params.publish_tf else {})


class SmootherStream(Stream):
    """Collects samples, in compact arrays, until somebody calls :func:`smooth` on ``logs()``.

    One Imu sample takes 56 bytes, one of the magnetometer 32, one fix 112, one velocity
    104: 32 MB an hour for Imu and magnetometer at 100 Hz. When the clock is set back, what was
    collected before is dropped when live; in a replay and in batch the longest stretch is what is
    smoothed, and how much that leaves out is said.

    Args:
        params: SmoothingParams.
        limit: bytes; what comes beyond is counted and dropped.
        warn: called with a text when something is wrong.
    """

    one_clock = (IMU_TOPIC, MAG_TOPIC)

    def __init__(self, params: SmoothingParams = SmoothingParams(), limit: float = math.inf,
                 warn: Callable[[str], object] = lambda text: None) -> None:
        self.params = params
        self.limit = limit
        super().__init__(INPUTS, warn, params.calibration)

    def reset(self, session_topics: Container[str] | None = None) -> None:
        self._collected: dict[str, list[Samples]] = {topic: [] for topic in INPUTS}
        self._longest = self._collected    # of the stretches before
        self._samples = 0                  # of the Imu in them
        super().reset(session_topics)

    def restart(self) -> None:
        if self._merger.strict:
            self._samples += self._length(self._collected)[1]
            self._longest = max(self._longest, self._collected, key=self._length)
        self.dropped = 0
        self.bytes = 0
        self._collected = {topic: [] for topic in INPUTS}

    def use(self, samples: Mapping[str, Samples]) -> list[Messages]:
        for topic, (stamp, values) in samples.items():
            size = 8 * (1 + INPUTS[topic].width)
            room = len(stamp) if math.isinf(self.limit) else min(
                len(stamp), int((self.limit - self.bytes) // size))
            if room < len(stamp):
                if not self.dropped:
                    self.warn(f"the collection has reached its limit of {self.limit / 1e6:g} MB: "
                              "further samples are dropped; see memory_limit and smoother/clear")
                self.dropped += len(stamp) - room
            self.bytes += size * room
            if room:
                self._collected[topic].append((stamp[:room].copy(), values[:room].copy()))
        return []

    def flush(self) -> list[Messages]:
        return []

    def counts(self) -> dict[str, int]:
        """dict of topic to number of samples held."""
        return {topic: sum(len(stamp) for stamp, _ in parts)
                for topic, parts in self._collected.items()}

    def logs(self) -> dict[str, Any]:
        """A snapshot: dict of topic to log, topics without samples left out.

        Raises:
            EstimationError: the limit was reached, so that the data have a hole at the end, or a
                topic that is needed has no samples.
        """
        if self.dropped:
            raise EstimationError(f"{self.dropped} samples were dropped at the limit of "
                                  f"{self.limit / 1e6:g} MB: call smoother/clear, record less or "
                                  "raise memory_limit")
        chosen = max(self._longest, self._collected, key=self._length)
        if self._samples:
            total = self._samples + self._length(self._collected)[1]
            self.warn(f"the clock was set: only the longest stretch, {self._length(chosen)[1]} of "
                      f"{total} Imu samples, is smoothed")
        for parts in chosen.values():
            if len(parts) > 1:    # not again at the next call
                parts[:] = [joined(parts)]
        missing = [topic for topic in required_of(self.params) if not chosen[topic]]
        if missing:
            raise EstimationError(
                f"nothing to smooth: no samples on {' and '.join(missing)}"
                + (" since the clock was set back" if self.restarts else ""))
        return {topic: INPUTS[topic].log(*parts[0], self.frame_ids[topic])
                for topic, parts in chosen.items() if parts}

    def _length(self, stretch):
        """Whether a collection has what is needed, and its number of Imu samples."""
        counts = [sum(len(stamp) for stamp, _ in stretch[topic])
                  for topic in required_of(self.params)]
        return min(counts) > 0, counts[0]

    def conclude(self) -> Conclusion:
        """What the samples of a whole recording make: the smoothed trajectory; its detail is
        (SmootherResult, logs by topic)."""
        logs = self.logs()
        result = smooth(self.params, logs)
        outcome = Outcome.of(result, logs[IMU_TOPIC].frame_id)
        return Conclusion(messages(result.samples, outcome, self.params),
                          outcome.numbers, outcome.summary, outcome.remarks, (result, logs))


def smooth(params: SmoothingParams, logs: Mapping[str, Any]) -> SmootherResult:
    """Smooth collected samples.

    Args:
        params: SmoothingParams.
        logs: dict of topic to log, as SmootherStream.logs gives it.

    Returns:
        SmootherResult

    Raises:
        ImuFusionError: with the reason, if there is no meaningful result.
    """
    surface = load_surface(params.surface.file) if params.surface.file else None
    imu, mag = logs[IMU_TOPIC], logs.get(MAG_TOPIC)
    if params.recover_rates:
        imu = recover(imu, mag, recovery_params(params))
        params = params.replace(**{"sensor.gyro_range": None})
    return Smoother(params, surface).run(imu, mag, logs.get(FIX_TOPIC), logs.get(VELOCITY_TOPIC))


def recovery_params(params: SmootherParams) -> OrientationParams:
    """Parameters of the orientation estimator that recovers rates for the smoother: its sensor, and
    a body in free fall and under blows, whose force says nothing of gravity and whose spin has
    inertia."""
    shared = ("gyro_noise_density", "gyro_bias_sd", "gyro_scale_sd", "gyro_range", "mag_offset",
              "mag_matrix")
    return OrientationParams().replace(**{
        "fusion.use_acc": False, "fusion.angular_acc_sd": 100.0, "fusion.angular_acc_time": 0.1,
        **{f"sensor.{name}": getattr(params.sensor, name) for name in shared}})


_SI = {"µT": "T", "%": "1", "ms": "s", "°": "rad"}    # of units in reports
UNITS = {
    "latitude_deg": "deg", "longitude_deg": "deg", "height": "m", "gnss_lag": "s", "offset": "m",
    "stamp": "ns", "duration": "s",
    **dict.fromkeys(("takeoff_stamp", "touchdown_stamp"), "ns"),
    **dict.fromkeys(("in_run_speed", "takeoff_speed", "landing_speed"), "m/s"),
    "takeoff_angle_deg": "deg", "flight_time": "s", "length": "m",
    **{block.name: _SI.get(block.unit, block.unit) for block in BLOCKS}}
"""Units of an Outcome's numbers and of the values of its states; those of ``<name>_sd``, and of
``sd`` beside a value, are the same. What is not named here is a count or a ratio."""


@dataclass(frozen=True)
class Outcome:
    """What a result says in words and plain numbers: ``summary`` one line, ``numbers`` for JSON,
    ``remarks`` (texts) among them; ``frame`` LocalFrame and ``frame_id`` of the sensor."""

    summary: str
    numbers: dict
    frame: object
    frame_id: str

    @classmethod
    def of(cls, result: SmootherResult, frame_id: str) -> Self:
        """Of a SmootherResult."""
        numbers: dict[str, Any] = {
            "units": UNITS, "samples": len(result.samples), "origin": asdict(result.frame),
            "iterations": result.iterations,
            "converged": result.converged, "cost": float(result.cost[-1]),
            "misfit": result.misfit(), "wander": result.wander, "gnss_lag": result.gnss_lag,
            "adapted": result.adapted, "noise": result.noise,
            "states": {name: {"value": value.tolist(), "sd": sd.tolist()}
                       for name, (value, sd) in constant_states(result.states).items()},
            "outliers": {name: asdict(found) for name, found in result.outliers().items()}}
        if result.gnss_step is not None:
            numbers["gnss_step"] = {"stamp": result.gnss_step.stamp,
                                    "offset": result.gnss_step.offset.tolist(),
                                    "sd": result.gnss_step.sd.tolist()}
        if result.jump is not None:
            numbers["jump"] = result.jump.to_mapping()
        numbers["remarks"] = result.remarks()
        return cls(result.summary(), numbers, result.frame, frame_id)

    @property
    def remarks(self) -> list[str]:
        """Texts on what makes the result doubtful."""
        return self.numbers["remarks"]

    def message(self, stamp: int, world: str) -> bytes:
        """CDR bytes of the diagnostic_msgs/DiagnosticArray on smoother/results; values are JSON.
        world: frame id."""
        return diagnostics_message(
            stamp, world, _NAME, self.summary,
            {key: json.dumps(value) for key, value in self.numbers.items()},
            bool(self.remarks), self.frame_id)


def constant_states(states: Mapping[str, tuple[np.ndarray, np.ndarray]]
                    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name -> value (k,) and standard deviation (k,), in SI units, of the states that stay the same
    over a recording; ``states`` as in a SmootherResult."""
    # They wander by rounding.
    return {name: (values[0], sd[0]) for name, (values, sd) in states.items()
            if len(values) and (np.ptp(values, axis=0) <= 1e-6 * sd.max(axis=0)).all()}


def results_value(cdr: bytes) -> dict[str, Any]:
    """The numbers (dict) of an Outcome in a message of smoother/results.

    Raises:
        MessageError: the bytes are no such message.
    """
    values = diagnostics_value(cdr, _NAME)[1]
    try:
        return {key: json.loads(value) for key, value in values.items()}
    except ValueError as error:
        raise MessageError(f"{RESULTS_TOPIC}: a value cannot be read as JSON ({error})") from None


def messages(samples: np.ndarray, outcome: Outcome, params: SmoothingParams
             ) -> Iterator[list[Messages]]:
    """Yield lists of Messages of a SmootherResult, in order of stamps, the path and the results
    last.

    Odometry is in the world (east-north-up at the result's frame) with the twist in the
    sensor's axes; its orientation covariance is about the fixed axes of the world.

    Args:
        samples: structured array of a SmootherResult. outcome: Outcome. params: SmoothingParams,
            of which names of frames, rate and topics are used.
    """
    world, body = params.frame.world, params.frame.body or outcome.frame_id
    shown = _shown(samples["stamp"], params.path_rate)
    for first in range(0, len(samples), _SLICE):
        rows, of_path = samples[first:first + _SLICE], shown[first:first + _SLICE]
        stamp = np.ascontiguousarray(rows["stamp"])
        odometry, imu, fix = _values(rows, outcome.frame)
        pose = odometry[of_path, :POSE_COVARIANCE.size]
        made = [Messages(ODOMETRY_TOPIC, stamp,
                         ODOMETRY.encode_block(stamp, world, odometry, body)),
                Messages(SMOOTHED_IMU_TOPIC, stamp, IMU.encode_block(stamp, body, imu)),
                Messages(SMOOTHED_FIX_TOPIC, stamp, fix_messages(stamp, body, fix)),
                Messages(POSE_TOPIC, stamp[of_path],
                         POSE_COVARIANCE.encode_block(stamp[of_path], world, pose))]
        if params.publish_tf:
            made.append(Messages(TF_TOPIC, stamp, transform_messages(
                stamp, world, body, rows["position_world"], rows["quat_world_imu"])))
        yield made
    if len(samples):
        last = int(samples["stamp"][-1])
        at = np.array([last])
        yield [Messages(PATH_TOPIC, at, [_path(samples[shown], last, world)]),
               Messages(RESULTS_TOPIC, at, [outcome.message(last, world)])]


def _shown(stamp, rate):
    """(n,) bool: samples at least 1 / rate apart, the first of each slot of that length."""
    slots = (stamp - stamp[:1]) // round(1e9 / rate)
    return np.diff(slots, prepend=-1) > 0


def _values(rows, frame):
    """Values of the messages of samples: Odometry and Imu in the order of their layouts, latitude,
    longitude, height and covariance; (n, size) each."""
    n = len(rows)
    rotation = scipy.spatial.transform.Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    back = rotation.transpose(0, 2, 1)
    vel_imu = np.einsum("nij,nj->ni", back, rows["vel_world"])
    cov_attitude = rotation @ rows["cov_attitude"] @ back
    # A wrong attitude turns the velocity, too; how the two errors go together is not kept.
    turned = np.cross(np.eye(3), vel_imu[:, None, :])
    pose, twist, imu = np.zeros((n, 6, 6)), np.zeros((n, 6, 6)), np.zeros((n, IMU.size))
    pose[:, :3, :3], pose[:, 3:, 3:] = rows["cov_position"], cov_attitude
    twist[:, :3, :3] = (back @ rows["cov_velocity"] @ rotation
                        + turned @ rows["cov_attitude"] @ turned.transpose(0, 2, 1))
    axes = np.arange(3)
    twist[:, axes + 3, axes + 3] = rows["gyr_sd"] ** 2
    odometry = np.zeros((n, ODOMETRY.size))
    for field, value in (("position", rows["position_world"]),
                         ("orientation", rows["quat_world_imu"]), ("linear", vel_imu),
                         ("pose_covariance", pose.reshape(n, 36)), ("angular", rows["gyr"]),
                         ("twist_covariance", twist.reshape(n, 36))):
        odometry[:, ODOMETRY[field]] = value
    for field, value in (("orientation", rows["quat_world_imu"]),
                         ("orientation_covariance", cov_attitude.reshape(n, 9)),
                         ("angular_velocity", rows["gyr"]), ("linear_acceleration", rows["acc"])):
        imu[:, IMU[field]] = value
    for field, name in (("angular_velocity_covariance", "gyr_sd"),
                        ("linear_acceleration_covariance", "acc_sd")):
        imu[:, IMU[field]][:, ::4] = rows[name] ** 2
    place = np.column_stack(frame.to_geodetic(rows["position_world"]))
    return odometry, imu, np.column_stack([place, rows["cov_position"].reshape(n, 9)])


def _path(samples, stamp, world):
    """CDR bytes of a nav_msgs/Path of samples."""
    types = TYPES.types
    header_type, time_type = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]

    def header(stamp):
        sec, nanosec = divmod(int(stamp), NANOSECONDS)
        return header_type(stamp=time_type(sec=sec, nanosec=nanosec), frame_id=world)

    poses = []
    for row in samples:
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](*map(float, row["position_world"])),
            orientation=types["geometry_msgs/msg/Quaternion"](*map(float, row["quat_world_imu"])))
        poses.append(types["geometry_msgs/msg/PoseStamped"](header=header(row["stamp"]), pose=pose))
    path = types[PATH_TYPE](header=header(stamp), poses=poses)
    return bytes(TYPES.serialize_cdr(path, PATH_TYPE))


def _configure(stage, params_file):
    (params,) = stage.read_params(params_file)
    if params.surface.file:
        load_surface(params.surface.file)  # a bad file is refused before anything is read
    return replace(stage, required=required_of(params), outputs=outputs_of(params)), [params]


STAGE = Stage(_NAME, (SmoothingParams,), (EstimatorNodeParams, SmootherNodeParams), INPUTS,
              _REQUIRED, OUTPUTS, SmootherStream, check_logs, _configure)
