"""A smoothed trajectory as messages, and what a result says in words and numbers."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import MessageError
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.estimation.smoother.state import BLOCKS
from imu_fusion.messages.convert import fix_messages
from imu_fusion.messages.diagnostics import DIAGNOSTICS_TYPE, diagnostics_message, diagnostics_value
from imu_fusion.messages.layouts import FIX, IMU, NANOSECONDS, ODOMETRY, POSE_COVARIANCE
from imu_fusion.messages.transforms import TF_TOPIC, TF_TYPE, transform_messages
from imu_fusion.messages.typestore import TYPES
from imu_fusion.streams.smoother_params import SmoothingParams
from imu_fusion.streams.stream import Messages

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


def outputs_of(params: SmoothingParams) -> dict[str, str]:
    """Topics and types of what is published under these parameters."""
    return OUTPUTS | ({TF_TOPIC: TF_TYPE} if params.publish_tf else {})


_SI = {"µT": "T", "%": "1", "ms": "s", "°": "rad"}    # of units in reports
UNITS = {
    "latitude_deg": "deg", "longitude_deg": "deg", "height": "m", "gnss_lag": "s",
    "velocity_lag": "s", "late": "s", "offset": "m", "antenna": "m", "stamp": "ns", "rests": "ns",
    "duration": "s",
    **dict.fromkeys(("takeoff_stamp", "touchdown_stamp"), "ns"),
    **dict.fromkeys(("in_run_speed", "takeoff_speed", "landing_speed"), "m/s"),
    "takeoff_angle_deg": "deg", "flight_time": "s", "length": "m",
    "acc_density": "m/s^2/sqrt(Hz)",
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
    def of(cls, result: SmootherResult, frame_id: str, lever_arm: Sequence[float] = (0.0, 0.0, 0.0)
           ) -> Self:
        """Of a SmootherResult; lever_arm (3,) m that was given of the antenna."""
        # A receiver alone speaks of its antenna.
        given = lever_arm if result.acc_density is None else (0.0, 0.0, 0.0)
        antenna, _ = result.states.get("gnss_lever_arm", (np.array([given]), None))
        numbers: dict[str, Any] = {
            "units": UNITS, "samples": len(result.samples), "origin": asdict(result.frame),
            # All positions and velocities are those of the first; the second is in its axes.
            "point": frame_id, "antenna": [float(v) for v in antenna[0]],
            "iterations": result.iterations,
            "converged": result.converged, "cost": float(result.cost[-1]),
            "misfit": result.misfit(), "wander": result.wander, "gnss_lag": result.gnss_lag,
            "velocity_lag": result.velocity_lag, "late": result.late,
            "clock_rate": result.clock_rate, "height_scale": result.height_scale,
            "repeats": result.repeats,
            "adapted": result.adapted, "noise": result.noise,
            "acc_density": result.acc_density, "left_out": result.left_out,
            "rests": [[rest.first, rest.last] for rest in result.rests],
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
    def attitude_known(self) -> bool:
        """Whether there was an Imu."""
        return self.numbers["acc_density"] is None

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
    sensor's axes; its orientation covariance is about the fixed axes of the world. Where there was
    no Imu, the twist is in the axes of the world, and there is no smoother/imu.

    Args:
        samples: structured array of a SmootherResult. outcome: Outcome. params: SmoothingParams,
            of which names of frames, rate and topics are used.
    """
    world, body = params.frame.world, params.frame.body or outcome.frame_id
    shown = _shown(samples["stamp"], params.path_rate)
    for first in range(0, len(samples), _SLICE):
        rows, of_path = samples[first:first + _SLICE], shown[first:first + _SLICE]
        stamp = np.ascontiguousarray(rows["stamp"])
        odometry, imu, fix = _values(rows, outcome.frame, outcome.attitude_known)
        pose = odometry[of_path, :POSE_COVARIANCE.size]
        made = [Messages(ODOMETRY_TOPIC, stamp,
                         ODOMETRY.encode_block(stamp, world, odometry, body)),
                Messages(SMOOTHED_FIX_TOPIC, stamp, fix_messages(stamp, body, fix)),
                Messages(POSE_TOPIC, stamp[of_path],
                         POSE_COVARIANCE.encode_block(stamp[of_path], world, pose))]
        if outcome.attitude_known:
            made.insert(1, Messages(SMOOTHED_IMU_TOPIC, stamp,
                                    IMU.encode_block(stamp, body, imu)))
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


def _values(rows, frame, attitude_known):
    """Values of the messages of samples: Odometry and Imu in the order of their layouts, latitude,
    longitude, height and covariance; (n, size) each."""
    n = len(rows)
    rotation = scipy.spatial.transform.Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    back = rotation.transpose(0, 2, 1)
    vel_imu = np.einsum("nij,nj->ni", back, rows["vel_world"])
    cov_attitude = rotation @ rows["cov_attitude"] @ back
    # A wrong attitude turns the velocity, too; how the two errors go together is not kept.
    turned = np.cross(np.eye(3), vel_imu[:, None, :]) * attitude_known
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
