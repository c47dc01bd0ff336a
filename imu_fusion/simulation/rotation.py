"""A tumbling body with exact truth, and the sensors that ride on it.

Attitude is ``Rz(a) Ry(b) Rx(c)`` with angles that are sums of sines, position is a
sum of sines: rates and specific force follow in closed form, so the truth has no
integration error at any sampling rate. The motion fades in from rest.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from imu_fusion.samples.logs import ImuLog, MagLog, PoseLog

GRAVITY = 9.80665


def smooth_step(t: np.ndarray, start: float,
                length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth step from 0 at ``start`` to 1 at ``start + length``: value, 1st, 2nd derivative."""
    s = np.clip((t - start) / length, 0.0, 1.0)
    inside = (s > 0) & (s < 1)
    return (s ** 3 * (10 - 15 * s + 6 * s * s),
            np.where(inside, 30 * s * s * (1 - s) ** 2, 0.0) / length,
            np.where(inside, 60 * s * (1 - s) * (1 - 2 * s), 0.0) / length ** 2)


class Motion(Protocol):
    """What :func:`simulate` needs to know of a motion."""

    def truth(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As of :meth:`Tumbling.truth`."""


@dataclass(frozen=True)
class Tumbling:
    """A random tumbling motion, fixed by its seed.

    rate_sd: rad/s, of each Euler angle's rate while moving; frequencies: Hz, lowest and
    highest; travel_sd: m per axis; rest, fade: s of rest before and of fading in;
    quat_start: (4,) attitude at rest, or None for a random one.
    """

    seed: int
    rate_sd: float = 3.0
    frequencies: tuple[float, float] = (0.05, 0.8)
    travel_sd: float = 0.2
    rest: float = 2.0
    fade: float = 2.0
    quat_start: tuple | None = None
    waves: int = 6

    def truth(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Truth at times t (n,) s.

        Returns:
            quat_world_imu (n, 4), rate in imu axes (n, 3) rad/s, position_world (n, 3) m,
            acceleration_world (n, 3) m/s^2.
        """
        rng = np.random.default_rng(self.seed)
        start = (Rotation.random(random_state=rng) if self.quat_start is None
                 else Rotation.from_quat(self.quat_start))
        frequency = 2 * math.pi * rng.uniform(*self.frequencies, (2, 3, self.waves))
        phase = rng.uniform(0, 2 * math.pi, (2, 3, self.waves))
        amplitude = rng.uniform(0.5, 1.5, (2, 3, self.waves)) / math.sqrt(self.waves / 2)
        amplitude[0] *= self.rate_sd / frequency[0]
        amplitude[1] *= self.travel_sd
        fade, fade1, fade2 = (f[:, None] for f in smooth_step(t, self.rest, self.fade))

        def waves(row):
            arg = frequency[row] * t[:, None, None] + phase[row]
            base = amplitude[row] * np.sin(phase[row])
            f0 = (amplitude[row] * np.sin(arg) - base).sum(-1)
            f1 = (amplitude[row] * frequency[row] * np.cos(arg)).sum(-1)
            f2 = (-amplitude[row] * frequency[row] ** 2 * np.sin(arg)).sum(-1)
            return (fade * f0, fade1 * f0 + fade * f1,
                    fade2 * f0 + 2 * fade1 * f1 + fade * f2)

        angle, angle1, _ = waves(0)
        position, _, acceleration = waves(1)
        a, b, c = angle.T
        a1, b1, c1 = angle1.T
        turn = Rotation.from_euler("ZYX", angle)
        # Rates in the axes of Rz Ry Rx, from the Euler angles' rates.
        rate = np.column_stack([
            c1 - a1 * np.sin(b),
            b1 * np.cos(c) + a1 * np.cos(b) * np.sin(c),
            -b1 * np.sin(c) + a1 * np.cos(b) * np.cos(c)])
        attitude = turn * start
        return attitude.as_quat(), start.inv().apply(rate), position, acceleration


@dataclass(frozen=True)
class Sensors:
    """Errors of simulated sensors; the defaults are perfect ones.

    Noise as densities (gyr rad/s/sqrt(Hz), acc m/s^2/sqrt(Hz)) and mag_sd (T per sample);
    gyr_bias (3,) rad/s; gyr_matrix (3, 3): reported = matrix @ true; gyr_walk
    rad/s/sqrt(s); gyr_limit rad/s: rates clip there; acc_bias (3,) m/s^2;
    mag_offset (3,) T and mag_matrix (3, 3): reported = matrix @ true + offset;
    gyr_delay, mag_delay s: reports belong to a time earlier by that; jitter: s, of stamps.
    """

    gyr_density: float = 0.0
    acc_density: float = 0.0
    mag_sd: float = 0.0
    gyr_bias: tuple = (0.0, 0.0, 0.0)
    gyr_matrix: tuple = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    gyr_walk: float = 0.0
    gyr_limit: float = math.inf
    acc_bias: tuple = (0.0, 0.0, 0.0)
    mag_offset: tuple = (0.0, 0.0, 0.0)
    mag_matrix: tuple = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    gyr_delay: float = 0.0
    mag_delay: float = 0.0
    jitter: float = 0.0


def earth_field(norm: float = 48e-6, inclination: float = math.radians(63.0),
                declination: float = 0.0) -> np.ndarray:
    """Magnetic field in world axes (east, north, up), tesla; inclination positive down."""
    horizontal = norm * math.cos(inclination)
    return np.array([horizontal * math.sin(declination), horizontal * math.cos(declination),
                     -norm * math.sin(inclination)])


def simulate(motion: Motion, duration: float, *, rate: float = 200.0,
             mag_rate: float | None = None, sensors: Sensors = Sensors(),
             field_world: ArrayLike | None = None,
             seed: int = 0) -> tuple[ImuLog, MagLog, PoseLog, np.ndarray]:
    """Logs of an IMU and a magnetometer on a tumbling body.

    Args:
        motion: what moves. duration: s. rate, mag_rate: Hz (mag_rate unset: rate).
        sensors: Sensors. field_world: (3,) tesla. seed: of the noise.

    Returns:
        ImuLog, MagLog, PoseLog of the truth at the Imu stamps, true rates (n, 3) rad/s.
    """
    rng = np.random.default_rng(seed)
    field_world = earth_field() if field_world is None else np.asarray(field_world)

    def clock(hz):
        t = np.arange(int(round(duration * hz))) / hz
        t = t + sensors.jitter * rng.uniform(-0.5, 0.5, len(t))
        stamp = np.round(np.maximum(t, 0.0) * 1e9).astype(np.int64)
        return stamp, stamp * 1e-9

    stamp, t = clock(rate)
    quat, omega, position, acceleration = motion.truth(t)
    force = Rotation.from_quat(quat).inv().apply(acceleration + [0.0, 0.0, GRAVITY])
    reported = motion.truth(t - sensors.gyr_delay)[1] @ np.asarray(sensors.gyr_matrix).T
    walk = np.cumsum(rng.normal(0, sensors.gyr_walk / math.sqrt(rate), (len(t), 3)), axis=0)
    reported = (reported + sensors.gyr_bias + walk
                + rng.normal(0, sensors.gyr_density * math.sqrt(rate), (len(t), 3)))
    reported = np.clip(reported, -sensors.gyr_limit, sensors.gyr_limit)
    force = (force + sensors.acc_bias
             + rng.normal(0, sensors.acc_density * math.sqrt(rate), (len(t), 3)))

    mag_stamp, t_mag = clock(mag_rate or rate)
    turn = Rotation.from_quat(motion.truth(t_mag - sensors.mag_delay)[0])
    mag = (turn.inv().apply(field_world) @ np.asarray(sensors.mag_matrix).T + sensors.mag_offset
           + rng.normal(0, sensors.mag_sd, (len(t_mag), 3)))
    return ImuLog(stamp, reported, force), MagLog(mag_stamp, mag), PoseLog(
        stamp, quat, position), omega
