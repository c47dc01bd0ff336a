"""Typed logs: the samples of one sensor as arrays, in order of their stamps.

A log checks shapes and types when it is made and nothing else; which samples
are fit for use is decided by :mod:`imu_fusion.samples.guard`.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self, TypeVar

import numpy as np

from imu_fusion.errors import SampleError

AnyLog = TypeVar("AnyLog", bound="Log")


def seconds(stamp: np.ndarray, origin: int) -> np.ndarray:
    """Float seconds of integer nanosecond stamps since ``origin``: subtract, then convert."""
    return (np.asarray(stamp, dtype=np.int64) - np.int64(origin)) * 1e-9


def _column(shape, default=None):
    return field(default=default, metadata={"shape": shape})


@dataclass(frozen=True, eq=False)
class Log:
    """Base of the logs: ``stamp`` (n,) int64 nanoseconds beside columns of n rows."""

    stamp: np.ndarray

    def __post_init__(self) -> None:
        stamp = np.ascontiguousarray(self.stamp)
        if stamp.ndim != 1 or not (np.issubdtype(stamp.dtype, np.integer) or stamp.size == 0):
            raise SampleError(f"{type(self).__name__}: stamps must be a one-dimensional array "
                              f"of integer nanoseconds, not {stamp.dtype} {stamp.shape}")
        object.__setattr__(self, "stamp", stamp.astype(np.int64))
        for name, shape in self._columns():
            value = getattr(self, name)
            if value is None:
                continue
            value = np.ascontiguousarray(value, dtype=np.float64)
            if value.size == 0:
                value = value.reshape((0, *shape))
            if value.shape != (len(stamp), *shape):
                raise SampleError(f"{type(self).__name__}.{name} has shape {value.shape}, "
                                  f"expected {(len(stamp), *shape)}")
            object.__setattr__(self, name, value)

    @classmethod
    def _columns(cls):
        return [(f.name, f.metadata["shape"]) for f in dataclasses.fields(cls)
                if "shape" in f.metadata]

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, index: Any) -> Self:
        """The rows that a slice, mask or index array selects, as a log of the same type."""
        if isinstance(index, (int, np.integer)):
            index = slice(index, index + 1 or None)
        changes = {name: getattr(self, name)[index] for name, _ in self._columns()
                   if getattr(self, name) is not None}
        return dataclasses.replace(self, stamp=self.stamp[index], **changes)

    def flat(self) -> np.ndarray:
        """All columns side by side: (n, k) float64, without the stamps."""
        columns = [getattr(self, name).reshape(len(self), int(np.prod(shape)))
                   for name, shape in self._columns() if getattr(self, name) is not None]
        return np.concatenate([np.empty((len(self), 0)), *columns], axis=1)

    @staticmethod
    def joined(logs: "Sequence[AnyLog]") -> "AnyLog":
        """Logs of one type that follow each other, at least one, as one; the frame of the first."""
        first = logs[0]
        if len(logs) == 1:
            return first
        columns = {name: np.concatenate([getattr(log, name) for log in logs])
                   for name, _ in first._columns() if getattr(first, name) is not None}
        return dataclasses.replace(
            first, stamp=np.concatenate([log.stamp for log in logs]), **columns)

    def between(self, start: int, stop: int) -> Self:
        """The rows with ``start <= stamp < stop`` (int nanoseconds)."""
        return self[(self.stamp >= start) & (self.stamp < stop)]


@dataclass(frozen=True, eq=False)
class ImuLog(Log):
    """Gyroscope ``gyr`` (n, 3) rad/s and specific force ``acc`` (n, 3) m/s^2.

    ``gyr_sd`` (n, 3) rad/s: standard deviation of rates that were recovered, as white noise that
    does as much; zero where a rate was measured. None: all were.
    """

    gyr: np.ndarray = _column((3,))
    acc: np.ndarray = _column((3,))
    frame_id: str = "imu_link"
    gyr_sd: np.ndarray | None = _column((3,))


@dataclass(frozen=True, eq=False)
class MagLog(Log):
    """Magnetic flux density ``mag`` (n, 3) tesla."""

    mag: np.ndarray = _column((3,))
    frame_id: str = "imu_link"


@dataclass(frozen=True, eq=False)
class AccelerometerLog(Log):
    """One accelerometer of an array: ``acc`` (n, 3) m/s^2 in its own axes."""

    acc: np.ndarray = _column((3,))
    frame_id: str = ""


@dataclass(frozen=True, eq=False)
class FixLog(Log):
    """GNSS positions on WGS84: ``latitude_deg``, ``longitude_deg`` (n,), ellipsoidal
    ``height`` (n,) m, ``cov_enu`` (n, 3, 3) m^2 (zeros: unknown), ``status`` (n,) as in
    sensor_msgs/NavSatStatus (-1: no fix; -2: not set by the driver)."""

    latitude_deg: np.ndarray = _column(())
    longitude_deg: np.ndarray = _column(())
    height: np.ndarray = _column(())
    cov_enu: np.ndarray = _column((3, 3))
    status: np.ndarray = _column(())
    frame_id: str = "gnss"

    @property
    def usable(self) -> np.ndarray:
        """Mask (n,) of the fixes that say where they are: on Earth, finite, not those at 0 deg,
        0 deg that a receiver gives before it knows, and not said to be none."""
        known = (np.isfinite(self.height) & (np.abs(self.latitude_deg) <= 90.0)
                 & (np.abs(self.longitude_deg) <= 180.0))
        null = (self.latitude_deg == 0.0) & (self.longitude_deg == 0.0)
        return known & ~null & (self.status != -1)


@dataclass(frozen=True, eq=False)
class VelocityLog(Log):
    """GNSS velocities ``vel_world`` (n, 3) m/s east, north, up; ``cov_world`` (n, 3, 3)
    (zeros: unknown)."""

    vel_world: np.ndarray = _column((3,))
    cov_world: np.ndarray = _column((3, 3))
    frame_id: str = "world"


@dataclass(frozen=True, eq=False)
class PoseLog(Log):
    """Reference poses: ``quat_world_imu`` (n, 4) xyzw and ``position_world`` (n, 3) m."""

    quat_world_imu: np.ndarray = _column((4,))
    position_world: np.ndarray = _column((3,))
    frame_id: str = "world"


@dataclass(frozen=True, eq=False)
class AttitudeLog(Log):
    """Estimates as published on imu/data: ``quat_world_imu`` (n, 4), ``cov_attitude``
    (n, 3, 3) rad^2 of the local error, ``gyr`` (n, 3) rad/s and ``acc`` (n, 3) m/s^2."""

    quat_world_imu: np.ndarray = _column((4,))
    cov_attitude: np.ndarray = _column((3, 3))
    gyr: np.ndarray = _column((3,))
    acc: np.ndarray = _column((3,))
    frame_id: str = "imu_link"
