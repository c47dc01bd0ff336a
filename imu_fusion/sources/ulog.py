"""PX4's ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html), read by pyulog.

PX4's body axes are forward, right, down and its world north, east, down; samples are given forward,
left, up and east, north, up. Times count from boot; where the receiver knew UTC they are brought
to it, else they count from :data:`~imu_fusion.sources.source.EPOCH`.
"""

import contextlib
import io
from collections.abc import Mapping

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import FixLog, MagLog, PoseLog, VelocityLog
from imu_fusion.sources.pairing import Pairing
from imu_fusion.sources.source import (
    EPOCH,
    FIX_TOPIC,
    FIXED,
    IMU_TOPIC,
    MAG_TOPIC,
    NO_FIX,
    VELOCITY_TOPIC,
    Block,
    WholeSource,
    named,
)

MAGIC = b"ULog\x01\x12\x35"
ONBOARD_TOPIC = "onboard_ekf/pose"
_FLU_FRD = np.array([1.0, -1.0, -1.0])
_ENU_NED = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
_FRD_FLU = np.array([1.0, 0.0, 0.0, 0.0])    # half a turn about forward
_NO_FORCE = 0x7FFFFFFF    # as accelerometer_timestamp_relative
_GAUSS = 1e-4
_FIX_3D = 3
_UTC = 1_000_000_000_000_000, 9_000_000_000_000_000    # us, of a receiver that knows it
_READS = 200_000     # more than a step back of a message takes, byte by byte
_WANTED = ["sensor_combined", "sensor_accel", "sensor_gyro", "vehicle_magnetometer", "sensor_mag",
           "vehicle_gps_position", "sensor_gps", "vehicle_attitude"]

Sets = Mapping[str, Mapping[str, np.ndarray]]
"""Fields by topic; of several sensors of a kind those of the first."""


class _StuckError(Exception):
    """Not an error that pyulog catches."""


class _Bytes(io.BytesIO):
    """Ends a reader that goes in circles: after damage pyulog steps back, at a cut end for ever."""

    _furthest = _reads = 0

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        self._reads += 1
        if self.tell() > self._furthest:
            self._furthest, self._reads = self.tell(), 0
        elif self._reads > _READS:
            raise _StuckError("no message begins where one should")
        return data


class Ulog(WholeSource):
    """A whole log."""

    def finish(self) -> list[Block]:
        part, data = next(iter(self.parts.items()), ("", bytearray()))
        try:
            from pyulog import ULog
        except ImportError:
            raise SampleError(f"{part}: reading ULog needs pyulog: pip install "
                              "'imu_fusion[devices]'") from None
        try:
            with contextlib.redirect_stdout(io.StringIO()):    # where it says what is damaged
                log = ULog(_Bytes(data), _WANTED)
        except Exception as error:    # of the library: damage shows in any way
            raise SampleError(f"{part}: damaged beyond reading ({type(error).__name__}: "
                              f"{error})") from None
        if log.file_corruption:
            self.lost["parts of the log that are damaged"] += 1
        if log.dropouts:
            gone = sum(d.duration for d in log.dropouts) * 1e-3
            self.remark(f"the logger dropped out {len(log.dropouts)} times, {gone:.1f} s in all")
        self.device = f"PX4 {log.msg_info_dict.get('ver_hw', '')}"[:80]
        sets: dict[str, Mapping[str, np.ndarray]] = {}
        for dataset in log.data_list:
            if len(dataset.data.get("timestamp", ())):
                sets.setdefault(dataset.name, dataset.data)
        return self._blocks(sets, part)

    @np.errstate(over="ignore", invalid="ignore")    # of damaged numbers, which the guards refuse
    def _blocks(self, sets: Sets, part: str) -> list[Block]:
        gps = sets.get("vehicle_gps_position") or sets.get("sensor_gps")
        missing: list[str] = []
        blocks: list[Block] = []
        try:
            zero = self._zero(gps)
        except LookupError:    # told where the fixes are read
            zero = self._zero(None)
        for read in (self._imu, _mag, _gnss, _attitude):
            try:
                blocks += read(sets, zero)
            except LookupError as error:
                missing.append(f"there is no {error}")
        if not blocks:
            raise SampleError(f"{part}: " + (
                f"its definitions are damaged: {'; '.join(missing)}" if missing else
                f"none of {', '.join(_WANTED)} was logged"))
        for text in missing:
            self.lost[f"topics whose definition is not as it should be: {text}"] += 1
        return blocks

    def _imu(self, sets: Sets, zero: int) -> list[Block]:
        """Rates, with the forces at their stamps."""
        imu = sets.get("sensor_combined")
        if imu is not None:
            stamp = _stamps(imu["timestamp"], zero)
            late = imu["accelerometer_timestamp_relative"].astype(np.int64)
            there = late != _NO_FORCE
            forces = (stamp + 1000 * late)[there], _vector(imu, "accelerometer_m_s2")[there]
            rates = stamp, _vector(imu, "gyro_rad")
        elif "sensor_accel" in sets and "sensor_gyro" in sets:
            forces, rates = ((_stamps(data["timestamp"], zero), _xyz(data))
                             for data in (sets["sensor_accel"], sets["sensor_gyro"]))
        else:
            return []
        pairing = Pairing()
        paired = [pairing.add((forces[0], forces[1] * _FLU_FRD), (rates[0], rates[1] * _FLU_FRD)),
                  pairing.finish()]
        for text in pairing.remarks():
            self.remark(text)
        return [block for log in paired for block in named({IMU_TOPIC: log})]

    def _zero(self, gps: Mapping[str, np.ndarray] | None) -> int:
        """UTC of boot in ns."""
        if gps is not None:
            utc, boot = (gps[n].astype(np.int64) for n in ("time_utc_usec", "timestamp"))
            known = (utc > _UTC[0]) & (utc < _UTC[1]) & (boot >= 0) & (boot < _UTC[0])
            if known.any():
                return int(np.median(utc[known] - boot[known])) * 1000
        self.remark("the receiver never knew UTC: stamps begin at an arbitrary instant")
        return EPOCH


def _stamps(boot: np.ndarray, zero: int) -> np.ndarray:
    return zero + 1000 * boot.astype(np.int64)


def _vector(data: Mapping[str, np.ndarray], name: str, size: int = 3) -> np.ndarray:
    return np.column_stack([data[f"{name}[{k}]"] for k in range(size)]).astype(np.float64)


def _xyz(data: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.column_stack([data[axis] for axis in "xyz"]).astype(np.float64)


def _mag(sets: Sets, zero: int) -> list[Block]:
    mag = sets.get("vehicle_magnetometer")
    if mag is not None:
        values = _vector(mag, "magnetometer_ga")
    elif "sensor_mag" in sets:
        mag = sets["sensor_mag"]
        values = _xyz(mag)
    else:
        return []
    return named({MAG_TOPIC: MagLog(_stamps(mag["timestamp"], zero), values * _FLU_FRD * _GAUSS)})


def _attitude(sets: Sets, zero: int) -> list[Block]:
    """What the autopilot has estimated."""
    attitude = sets.get("vehicle_attitude")
    if attitude is None:
        return []
    quat = _vector(attitude, "q", 4)[:, [1, 2, 3, 0]]
    fine = np.linalg.norm(quat, axis=1) > 0.5
    world, ned, body = map(scipy.spatial.transform.Rotation.from_quat,
                           (_ENU_NED, quat[fine], _FRD_FLU))
    found = (world * ned * body).as_quat()
    return named({ONBOARD_TOPIC: PoseLog(_stamps(attitude["timestamp"], zero)[fine], found,
                                         np.zeros((len(found), 3)))})


def _gnss(sets: Sets, zero: int) -> list[Block]:
    """Fixes and velocities, with the accuracies that the receiver reports."""
    gps = sets.get("vehicle_gps_position") or sets.get("sensor_gps")
    if gps is None:
        return []
    stamp = _stamps(gps["timestamp"], zero)
    if "latitude_deg" in gps:    # from PX4 1.14 on
        lat, lon, height = (gps[n] for n in ("latitude_deg", "longitude_deg",
                                             "altitude_ellipsoid_m"))
    else:
        lat, lon, height = gps["lat"] * 1e-7, gps["lon"] * 1e-7, gps["alt_ellipsoid"] * 1e-3
    fixed = gps["fix_type"] >= _FIX_3D
    sd = np.column_stack([gps["eph"], gps["eph"], gps["epv"]]).astype(np.float64)
    cov = np.zeros((len(stamp), 3, 3))
    known = np.isfinite(sd).all(axis=1) & (sd > 0).all(axis=1)
    cov[known] = sd[known, :, None] ** 2 * np.eye(3)
    vel = np.column_stack([gps["vel_e_m_s"], gps["vel_n_m_s"], -gps["vel_d_m_s"]])
    speed_sd = gps["s_variance_m_s"].astype(np.float64)    # a standard deviation, despite its name
    cov_vel = np.where(speed_sd > 0, speed_sd, 0.0)[:, None, None] ** 2 * np.eye(3)
    return named({FIX_TOPIC: FixLog(stamp, lat, lon, height, cov,
                                    np.where(fixed, FIXED, NO_FIX)),
                  VELOCITY_TOPIC: VelocityLog(stamp, vel, cov_vel)[fixed]})
