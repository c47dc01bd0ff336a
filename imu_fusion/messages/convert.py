"""Samples and estimates to and from the bytes of ROS messages.

Nodes and batch call the same functions, so that both write the same messages.

Covariances: zeros mean unknown, a first element of -1 means that the quantity
is absent (sensor_msgs/Imu). The orientation covariance of a published Imu is
about the fixed axes of the world, as geometry_msgs/PoseWithCovariance words it;
estimators keep it about the axes of the sensor.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts are loaded where they are first used
from numpy.typing import ArrayLike

from imu_fusion.errors import MessageError, TopicError
from imu_fusion.geometry.rotation import quat_to_matrix
from imu_fusion.geometry.rotation_arrays import rpy_angles
from imu_fusion.kernels import njit
from imu_fusion.messages.layouts import (
    BOOL_TYPE,
    FIX,
    IMU,
    LITTLE,
    MAG,
    POSE,
    TWIST,
    VECTOR3,
    Layout,
    string,
)
from imu_fusion.samples import AttitudeLog, FixLog, ImuLog, MagLog, PoseLog, VelocityLog
from imu_fusion.samples.logs import Log

UNKNOWN = np.zeros((3, 3))
ABSENT = np.zeros((3, 3))
ABSENT[0, 0] = -1.0
_COVARIANCE_KNOWN = 3

# Of a decoded Imu: the first elements of the covariances of rates and specific force.
_FIRST_COVARIANCES = [IMU[f"{name}_covariance"].start
                      for name in ("angular_velocity", "linear_acceleration")]


def imu_message(stamp: int, frame_id: str, gyr: ArrayLike | None, acc: ArrayLike | None,
                quat: ArrayLike | None = None, cov_orientation: ArrayLike = UNKNOWN,
                cov_gyr: ArrayLike = UNKNOWN, cov_acc: ArrayLike = UNKNOWN) -> bytes:
    """CDR bytes of a sensor_msgs/Imu.

    Args:
        stamp: int nanoseconds.
        gyr, acc: (3,) rad/s and m/s^2 (specific force), or None where absent.
        quat: (4,) xyzw world <- sensor, or None where absent.
        cov_orientation: (3, 3) rad^2 about world axes; cov_gyr, cov_acc: (3, 3).
    """
    values = np.zeros(IMU.size)
    for field, value, cov in (("orientation", quat, cov_orientation),
                              ("angular_velocity", gyr, cov_gyr),
                              ("linear_acceleration", acc, cov_acc)):
        if value is None:
            cov = ABSENT
        else:
            values[IMU[field]] = value
        values[IMU[field + "_covariance"]] = np.reshape(cov, 9)
    if quat is None:
        values[IMU["orientation"]] = (0.0, 0.0, 0.0, 1.0)
    return IMU.encode(stamp, frame_id, values)


def mag_message(stamp: int, frame_id: str, mag: ArrayLike, cov: ArrayLike = UNKNOWN) -> bytes:
    """CDR bytes of a sensor_msgs/MagneticField. mag: (3,) tesla, cov: (3, 3) tesla^2."""
    return MAG.encode(stamp, frame_id, np.concatenate([np.asarray(mag, float), np.reshape(cov, 9)]))


def fix_message(stamp: int, frame_id: str, latitude_deg: float, longitude_deg: float,
                height: float, cov_enu: ArrayLike | None = None, status: int = 0,
                service: int = 1) -> bytes:
    """CDR bytes of a sensor_msgs/NavSatFix. height: ellipsoidal m, cov_enu: (3, 3) m^2 or None."""
    cov = np.zeros(9) if cov_enu is None else np.reshape(cov_enu, 9)
    return FIX.encode(stamp, frame_id, [status, service, latitude_deg, longitude_deg, height, *cov,
                                        0 if cov_enu is None else _COVARIANCE_KNOWN])


def fix_messages(stamp: np.ndarray, frame_id: str, values: np.ndarray) -> list[bytes]:
    """CDR bytes of n sensor_msgs/NavSatFix: stamp (n,), values (n, 12): latitude, longitude
    (degrees), height (m), covariance (m^2) row by row."""
    full = np.empty((len(stamp), FIX.size))
    full[:, 0], full[:, 1], full[:, -1] = 0, 1, _COVARIANCE_KNOWN
    full[:, 2:-1] = values
    return FIX.encode_block(stamp, frame_id, full)


def velocity_message(stamp: int, frame_id: str, vel_world: ArrayLike,
                     cov_world: ArrayLike | None = None) -> bytes:
    """CDR bytes of a geometry_msgs/TwistWithCovarianceStamped. vel_world: (3,) m/s ENU."""
    cov = np.zeros((6, 6))
    if cov_world is not None:
        cov[:3, :3] = cov_world
    cov[3, 3] = -1.0  # no angular velocity here
    return TWIST.encode(stamp, frame_id,
                        np.concatenate([np.asarray(vel_world, float), np.zeros(3), cov.ravel()]))


def pose_message(stamp: int, frame_id: str, quat_world_imu: Sequence[float] | np.ndarray,
                 position_world: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> bytes:
    """CDR bytes of a geometry_msgs/PoseStamped."""
    return POSE.encode(stamp, frame_id, [*position_world, *quat_world_imu])


def imu_messages(stamp: np.ndarray, frame_id: str, gyr: np.ndarray, cov_gyr: np.ndarray,
                 acc: np.ndarray, cov_acc: np.ndarray, quat: np.ndarray, cov_attitude: np.ndarray,
                 has_force: np.ndarray) -> list[bytes]:
    """CDR bytes of n sensor_msgs/Imu with estimates.

    Args:
        stamp: (n,) int64 ns. frame_id: of all of them.
        gyr, acc: (n, 3); quat: (n, 4); the covariances: (n, 3, 3), that of the attitude about the
            axes of the sensor: it is written about those of the world.
        has_force: (n,) bool, whether acc is there; where not it is marked as absent.
    """
    values = np.zeros((len(stamp), IMU.size))
    _fill_imu(values, gyr, cov_gyr, acc, cov_acc, quat, cov_attitude, has_force)
    return IMU.encode_block(stamp, frame_id, values)


@njit
def _fill_imu(values, gyr, cov_gyr, acc, cov_acc, quat, cov_attitude, has_force):
    for k in range(len(values)):
        row = values[k]
        row[:4] = quat[k]
        turn = quat_to_matrix(quat[k])
        for i in range(3):
            row[13 + i] = gyr[k, i]
            row[25 + i] = acc[k, i] if has_force[k] else 0.0
            for j in range(3):
                row[16 + 3 * i + j] = cov_gyr[k, i, j]
                row[28 + 3 * i + j] = cov_acc[k, i, j] if has_force[k] else 0.0
                for m in range(3):
                    for n in range(3):
                        row[4 + 3 * i + j] += turn[i, m] * cov_attitude[k, m, n] * turn[j, n]
        if not has_force[k]:
            row[28] = -1.0


def orientation_messages(rows: np.ndarray, frame_id: str, has_force: np.ndarray) -> list[bytes]:
    """CDR bytes of the sensor_msgs/Imu of rows (n,) of the orientation estimator.

    has_force: (n,) bool, whether the sensor measures specific force; where not it is absent.
    """
    return imu_messages(rows["stamp"], frame_id, rows["gyr"], rows["cov_gyr"], rows["acc"],
                        rows["cov_acc"], rows["quat_world_imu"], rows["cov_attitude"], has_force)


def rpy_messages(rows: np.ndarray, frame_id: str) -> list[bytes]:
    """CDR bytes of the geometry_msgs/Vector3Stamped with roll, pitch, yaw (rad) of rows (n,)."""
    return VECTOR3.encode_block(rows["stamp"], frame_id, rpy_angles(rows["quat_world_imu"]))


def bool_message(value: bool) -> bytes:
    """CDR bytes of a std_msgs/Bool."""
    return LITTLE + bytes([value])


def bool_value(cdr: bytes) -> bool:
    """The value of a CDR std_msgs/Bool.

    Raises:
        MessageError: the bytes are no such message.
    """
    if len(cdr) < 5:
        raise MessageError(f"{BOOL_TYPE}: {len(cdr)} bytes are too few")
    return cdr[4] == 1


def string_message(text: str) -> bytes:
    """CDR bytes of a std_msgs/String."""
    return LITTLE + string(text)


def string_value(cdr: bytes) -> str:
    """The text of a CDR std_msgs/String."""
    (length,) = struct.unpack_from("<I" if cdr[1] else ">I", cdr, 4)
    return bytes(cdr[8:8 + length - 1]).decode()


def imu_values(values: np.ndarray) -> np.ndarray:
    """Rates and specific force (n, 6) of decoded sensor_msgs/Imu values, NaN where absent."""
    return _measured(values, np.nan)


def gyroscope_first_values(values: np.ndarray) -> np.ndarray:
    """As imu_values, but specific force is zero where absent: a gyroscope alone is enough."""
    return _measured(values, 0.0)


def _measured(values, absent_force):
    return _without_absent(values, IMU["angular_velocity"].start, IMU["linear_acceleration"].start,
                           *_FIRST_COVARIANCES, absent_force)


@njit
def _without_absent(values, gyr, acc, gyr_cov, acc_cov, absent_force):
    result = np.empty((len(values), 6))
    for k in range(len(values)):
        for i in range(3):
            result[k, i] = np.nan if values[k, gyr_cov] == -1.0 else values[k, gyr + i]
            result[k, 3 + i] = absent_force if values[k, acc_cov] == -1.0 else values[k, acc + i]
    return result


def mag_values(values: np.ndarray) -> np.ndarray:
    """Field (n, 3) of decoded sensor_msgs/MagneticField values."""
    return np.ascontiguousarray(values[:, MAG["magnetic_field"]])


def fix_values(values: np.ndarray) -> np.ndarray:
    """Latitude, longitude, height, covariance row by row, status (..., 13) of NavSatFix values.

    A covariance whose type is unknown, or that is not finite, becomes zeros: unknown."""
    cov = _known(values[..., FIX["position_covariance"]] * (values[..., -1:] != 0))
    return np.concatenate([values[..., 2:5], cov, values[..., :1]], axis=-1)


def velocity_values(values: np.ndarray) -> np.ndarray:
    """Velocity, covariance row by row (..., 12) of TwistWithCovarianceStamped values."""
    cov = values[..., TWIST["covariance"]].reshape(*values.shape[:-1], 6, 6)[..., :3, :3]
    return np.concatenate([values[..., TWIST["linear"]],
                           _known(cov.reshape(*values.shape[:-1], 9))], axis=-1)


def _known(cov):
    """Covariances (..., 9), zeros where they are not finite."""
    return np.where(np.isfinite(cov).all(axis=-1, keepdims=True), cov, 0.0)


def pose_values(values: np.ndarray) -> np.ndarray:
    """Orientation, position (..., 7) of PoseStamped values."""
    return np.concatenate([values[..., POSE["orientation"]], values[..., POSE["position"]]],
                          axis=-1)


def _imu_log(stamp, samples, frame_id):
    return ImuLog(stamp, samples[:, :3], samples[:, 3:], frame_id)


def _fix_log(stamp, samples, frame_id):
    return FixLog(stamp, samples[:, 0], samples[:, 1], samples[:, 2],
                  samples[:, 3:12].reshape(-1, 3, 3), samples[:, 12], frame_id)


def _velocity_log(stamp, samples, frame_id):
    return VelocityLog(stamp, samples[:, :3], samples[:, 3:].reshape(-1, 3, 3), frame_id)


def _pose_log(stamp, samples, frame_id):
    return PoseLog(stamp, samples[:, :4], samples[:, 4:], frame_id)


@dataclass(frozen=True)
class SampleType:
    """How one message type becomes samples.

    ``values`` picks them from the decoded numbers, (size,) -> (width,) or
    (n, size) -> (n, width); ``log`` makes the typed log of stamps (n,), samples
    (n, width) and a frame id.
    """

    layout: Layout
    width: int
    values: Callable[[np.ndarray], np.ndarray]
    log: Callable[[np.ndarray, np.ndarray, str], Log]

    def read(self, messages: Sequence[bytes]) -> Log:
        """The log of a list of CDR messages, in the order given; the frame of the first."""
        stamp, frames, values = self.layout.decode_many(messages)
        return self.log(stamp, self.values(values), frames[0] if frames else "")


SAMPLE_TYPES = {kind.layout.msgtype: kind for kind in (
    SampleType(IMU, 6, imu_values, _imu_log), SampleType(MAG, 3, mag_values, MagLog),
    SampleType(FIX, 13, fix_values, _fix_log),
    SampleType(TWIST, 12, velocity_values, _velocity_log),
    SampleType(POSE, 7, pose_values, _pose_log))}


GYROSCOPE_FIRST = replace(SAMPLE_TYPES[IMU.msgtype], values=gyroscope_first_values)
"""The SampleType of estimators that can do without specific force."""


def attitude_log(messages: Sequence[bytes]) -> AttitudeLog:
    """AttitudeLog of a list of CDR sensor_msgs/Imu with orientation, such as imu/data; NaN where
    one of them says that it carries none.

    Raises:
        TopicError: all of them say so.
    """
    stamp, frames, values = IMU.decode_many(messages)
    cov_world = values[:, IMU["orientation_covariance"]].reshape(-1, 3, 3)
    absent = cov_world[:, 0, 0] == -1.0
    if len(absent) and absent.all():
        raise TopicError("these sensor_msgs/Imu carry no orientation (covariance[0] is -1): they "
                         "are raw data, not estimates")
    quat = values[:, IMU["orientation"]]
    # Zeros: a source that left them unset. Such an orientation is not a number.
    known = ((np.linalg.norm(quat, axis=1) > 0.5) & ~absent)[:, None]
    rotation = np.empty((0, 3, 3))
    if len(quat):
        rotation = scipy.spatial.transform.Rotation.from_quat(
            np.where(known, quat, [0.0, 0.0, 0.0, 1.0])).as_matrix()
    quat = np.where(known, quat, np.nan)
    samples = imu_values(values)
    return AttitudeLog(stamp, quat, rotation.transpose(0, 2, 1) @ cov_world @ rotation,
                       samples[:, :3], samples[:, 3:], frames[0] if frames else "")
