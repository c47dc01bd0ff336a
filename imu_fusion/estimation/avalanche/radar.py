"""A trajectory as a Doppler radar sees it: Winkler 2025, sections 2 and 6, Fig. 19.

A radar tells ranges, in gates some 25 m long, and velocities of the front along its beam. On the
slope secant, the straight line from the first place to the last, both can be compared with a ball.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from imu_fusion.errors import EstimationError


@dataclass(frozen=True)
class RadarLog:
    """What a radar saw of a front: ``time`` (n,) s, ``range`` (n,) m, of the middle of the range
    gate, ``velocity`` (n,) m/s, nan where it is not known."""

    time: np.ndarray
    range: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True)
class Secant:
    """The slope secant: ``start`` (3,) m from the radar, ``direction`` (3,) of length one."""

    start: np.ndarray
    direction: np.ndarray

    @classmethod
    def through(cls, position: np.ndarray) -> Self:
        """From the first of places (n, 3) m, relative to the radar, to the last.

        Raises:
            EstimationError: they are the same.
        """
        way = position[-1] - position[0]
        length = float(np.linalg.norm(way))
        if not length > 1.0:
            raise EstimationError(f"the trajectory ends {length:.2f} m from where it begins: there "
                                  "is no slope secant to project on")
        return cls(position[0], way / length)

    def distance(self, position: np.ndarray) -> np.ndarray:
        """How far down the secant places (n, 3) are, (n,) m."""
        return (position - self.start) @ self.direction

    def project(self, range_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ranges (n,) m on the secant.

        Of the two places of a range that is meant which lies on the start's side of the secant's
        nearest point to the radar.

        Returns:
            distance (n,) m down the secant, and cos delta (n,) of the angle between secant and
            beam, by which a velocity along the beam is divided; nan nearer than the secant comes.
        """
        nearest = -float(self.start @ self.direction)
        off = float(np.linalg.norm(self.start + nearest * self.direction))
        along = np.sqrt(np.where(range_ >= off, range_ ** 2 - off ** 2, np.nan))
        return nearest - np.copysign(along, nearest), along / range_


@dataclass(frozen=True)
class Gate:
    """One range gate: ``range`` m of its middle, ``time`` s at which something was first seen in
    it, ``velocity`` m/s (nan: none), the median in it."""

    range: float
    time: float
    velocity: float


def gates_of(log: RadarLog, length: float) -> list[Gate]:
    """The gates of a RadarLog, of ``length`` m each, in the order in which something came."""
    number = np.floor(log.range / length).astype(int)
    found = []
    for k in np.unique(number):
        inside = number == k
        velocity = log.velocity[inside & np.isfinite(log.velocity)]
        found.append(Gate((k + 0.5) * length if inside.sum() > 1 else float(log.range[inside][0]),
                          float(log.time[inside].min()),
                          float(np.median(velocity)) if len(velocity) else np.nan))
    return sorted(found, key=lambda gate: gate.time)


def range_differences(time: np.ndarray, position: np.ndarray, log: RadarLog) -> np.ndarray:
    """Ranges of places (n, 3) m, relative to the radar, at times (n,) s less those of a RadarLog,
    (m,) m; nan where the trajectory does not reach."""
    return np.interp(log.time, time, np.linalg.norm(position, axis=1), np.nan, np.nan) - log.range
