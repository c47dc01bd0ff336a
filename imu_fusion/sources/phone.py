"""The sensors of a phone: they have one clock and each its own rate, so forces are brought to the
stamps of the gyroscope.

Nothing is made up: a position without a valid accuracy is no fix, a speed without direction no
velocity. Accuracies are taken as standard deviations of each axis (phones mean 68 % of the circle,
or do not say).
"""

import numpy as np

from imu_fusion.samples.logs import FixLog, MagLog, VelocityLog
from imu_fusion.sources.pairing import Pairing
from imu_fusion.sources.source import (
    FIX_TOPIC,
    FIXED,
    IMU_TOPIC,
    MAG_TOPIC,
    NO_FIX,
    VELOCITY_TOPIC,
    Block,
    named,
)
from imu_fusion.sources.table import UNKNOWN_CLIMB_SD

LONGEST = 1e9    # s, of an experiment
UNIX = (1e8, 9e9)    # s, of a clock that has been set
# A phone's ground speed comes without accuracy; receivers are within some 0.5 m/s.
_SPEED_SD = 0.5


class Phone:
    """Readings of a phone's sensors, whose stamps are of one clock, to samples."""

    def __init__(self) -> None:
        self.pairing = Pairing()
        self._seen: set[str] = set()

    def vectors(self, kind: str, stamp: np.ndarray, values: np.ndarray) -> list[Block]:
        """Samples that readings (n, 3) in SI make complete; kind: accelerometer, gyroscope or
        magnetometer."""
        self._seen.add(kind)
        if kind == "magnetometer":
            return named({MAG_TOPIC: MagLog(stamp, values)})
        return named({IMU_TOPIC: self.pairing.add(**{
            "forces" if kind == "accelerometer" else "rates": (stamp, values)})})

    def remarks(self) -> list[str]:
        """What to say of the readings at the end."""
        there = [kind for kind in ("accelerometer", "gyroscope") if kind in self._seen]
        alone = [f"{IMU_TOPIC} needs accelerometer and gyroscope; there is the {there[0]} alone"
                 ] if len(there) == 1 else []
        return alone + self.pairing.remarks()

    def finish(self) -> list[Block]:
        """What waited for more."""
        return named({IMU_TOPIC: self.pairing.finish()})


def locations(stamp: np.ndarray, values: np.ndarray) -> list[Block]:
    """Fixes and velocities of a phone: (n, 7) latitude and longitude in degrees, height m, speed
    m/s, direction deg, accuracy horizontal and vertical m."""
    lat, lon, height, speed, direction, sd_h, sd_v = values.T
    valid = (sd_h > 0) & (sd_v > 0) & np.isfinite(sd_h) & np.isfinite(sd_v)
    cov = np.zeros((len(stamp), 3, 3))
    for k, sd in enumerate((sd_h, sd_h, sd_v)):
        cov[valid, k, k] = sd[valid] ** 2
    there = np.isfinite(values[:, :3]).all(axis=1)
    fixes = FixLog(stamp, lat, lon, height, cov, np.where(valid, FIXED, NO_FIX))[there]
    course = np.radians(direction)    # clockwise from north
    moves = (speed >= 0) & (direction >= 0)
    with np.errstate(invalid="ignore", over="ignore"):    # of an infinite one
        vel = np.column_stack([speed * np.sin(course), speed * np.cos(course), 0.0 * speed])
    cov = np.tile(np.diag([_SPEED_SD, _SPEED_SD, UNKNOWN_CLIMB_SD]) ** 2, (len(stamp), 1, 1))
    return named({FIX_TOPIC: fixes, VELOCITY_TOPIC: VelocityLog(stamp, vel, cov)[moves]})
