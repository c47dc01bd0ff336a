"""Samples as messages: the type of message that belongs to each kind of log."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_fusion.messages.convert import ABSENT
from imu_fusion.messages.layouts import FIX, IMU, MAG, NANOSECONDS, POSE, TWIST, Layout
from imu_fusion.samples import FixLog, ImuLog, MagLog, PoseLog, VelocityLog
from imu_fusion.samples.logs import AccelerometerLog, Log

_COVARIANCE_KNOWN = 2     # diagonal
_GPS = 1
_END_OF_TIME = 2**31 * NANOSECONDS
_LAYOUTS: dict[type[Log], Layout] = {
    ImuLog: IMU, AccelerometerLog: IMU, MagLog: MAG, FixLog: FIX, VelocityLog: TWIST,
    PoseLog: POSE}


@dataclass(frozen=True)
class NoiseSd:
    """Standard deviations of one sample of each axis: rad/s, m/s^2, T; 0: unknown."""

    gyr: float = 0.0
    acc: float = 0.0
    mag: float = 0.0


def fits_message(stamp: np.ndarray) -> np.ndarray:
    """(n,) bool: whether a builtin_interfaces/Time can hold stamps (n,) int64 ns (until 2038), and
    they are not below zero, which no sensor is."""
    return np.asarray((stamp >= 0) & (stamp < _END_OF_TIME))


def msgtype_of(log: Log) -> str:
    """The type of the messages of a log."""
    return _LAYOUTS[type(log)].msgtype


def sample_messages(log: Any, noise: NoiseSd = NoiseSd(), frame_id: str | None = None
                    ) -> list[bytes]:
    """CDR bytes of the messages of a log of n samples, in its order.

    Args:
        log: ImuLog (gyr or acc may be None: absent), AccelerometerLog, MagLog, FixLog,
            VelocityLog or PoseLog.
        noise: covariances of what has none of its own.
        frame_id: instead of that of the log.
    """
    layout = _LAYOUTS[type(log)]
    values = np.zeros((len(log), layout.size))
    if layout is IMU:
        _fill_imu(values, getattr(log, "gyr", None), log.acc, noise)
    elif isinstance(log, MagLog):
        values[:, MAG["magnetic_field"]] = log.mag
        values[:, MAG["magnetic_field_covariance"]] = noise.mag ** 2 * np.eye(3).ravel()
    elif isinstance(log, FixLog):
        values[:, 0], values[:, 1] = log.status, _GPS
        values[:, 2:5] = np.column_stack([log.latitude_deg, log.longitude_deg, log.height])
        values[:, FIX["position_covariance"]] = log.cov_enu.reshape(-1, 9)
        values[:, -1] = _COVARIANCE_KNOWN * log.cov_enu.any(axis=(1, 2))
    elif isinstance(log, VelocityLog):
        cov = np.zeros((len(log), 6, 6))
        cov[:, :3, :3] = log.cov_world
        cov[:, 3, 3] = -1.0    # no angular velocity here
        values[:, TWIST["linear"]] = log.vel_world
        values[:, TWIST["covariance"]] = cov.reshape(-1, 36)
    else:
        values[:, POSE["position"]] = log.position_world
        values[:, POSE["orientation"]] = log.quat_world_imu
    return layout.encode_block(log.stamp, log.frame_id if frame_id is None else frame_id, values)


def _fill_imu(values: np.ndarray, gyr: np.ndarray | None, acc: np.ndarray | None,
              noise: NoiseSd) -> None:
    values[:, IMU["orientation"].stop - 1] = 1.0
    values[:, IMU["orientation_covariance"]] = ABSENT.ravel()
    for field, vectors, sd in (("angular_velocity", gyr, noise.gyr),
                               ("linear_acceleration", acc, noise.acc)):
        cov = ABSENT if vectors is None else sd ** 2 * np.eye(3)
        values[:, IMU[field + "_covariance"]] = cov.ravel()
        if vectors is not None:
            values[:, IMU[field]] = vectors
