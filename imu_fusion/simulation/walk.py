"""A walk with an inertial sensor and a receiver, past iron: exact motion, and what is recorded.

Steps shake the sensor by centimetres and degrees, about twice a second; the path winds at random.
Angles are yaw, pitch and roll, positions those of the sensor, east, north, up.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.geometry.gravity import normal_gravity
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.simulation.jump_sensors import EPOCH
from imu_fusion.simulation.noise import gauss_markov
from imu_fusion.simulation.noise_gnss import GnssErrors, gnss_errors

FRAME = LocalFrame(47.0, 11.0, 600.0)
_FINE = 1e-3         # s, between the points of the path
_STANDS = 4.0        # s at first
_WAVES = 40          # of the field of iron


@dataclass(frozen=True)
class WalkErrors(Parameters):
    """Errors of the sensors. Defaults: a calibrated consumer Imu, RTK."""

    rate: float = param(100.0, doc="Rate of Imu and magnetometer", unit="Hz", low=10)
    gyr_noise_density: float = param(3e-4, doc="Of the gyroscope", unit="rad/s/sqrt(Hz)", low=0)
    acc_noise_density: float = param(3e-3, doc="Of the accelerometer", unit="m/s^2/sqrt(Hz)",
                                     low=0)
    gyr_bias_sd: float = param(0.01, doc="Gyroscope bias", unit="rad/s", low=0)
    acc_bias_sd: float = param(0.1, doc="Accelerometer bias", unit="m/s^2", low=0)
    bias_tau: float = param(200.0, doc="Time over which a tenth of a bias wanders", unit="s", low=1)
    scale_sd: float = param(0.002, doc="Scale error of either, each axis", low=0)
    axes_sd: float = param(0.0035, doc="Axes of either that are not at right angles, each pair",
                           unit="rad", low=0)
    mag_noise_sd: float = param(5e-7, doc="Magnetometer noise of one sample", unit="T", low=0)
    mag_bias_sd: float = param(2e-6, doc="Magnetometer bias", unit="T", low=0)
    iron: float = param(0.0, doc="Field of iron along the path, RMS of a component", unit="T",
                        low=0)
    iron_length: float = param(4.0, doc="Distance over which it changes", unit="m", low=0.1)
    gnss_rate: float = param(5.0, doc="Rate of fixes and velocities", unit="Hz", low=0.1)
    gnss: GnssErrors = GnssErrors(position_sd=(0.015, 0.015, 0.03), velocity_sd=(0.05, 0.05, 0.05))
    stated_sd: tuple[float, ...] = param((0.015, 0.015, 0.03), doc="Of a fix, as the receiver "
                                         "has it", unit="m", low=0, length=3)
    velocity_late: float = param(0.0, doc="Velocities are later than fixes by this", unit="s")
    lever_arm: tuple[float, ...] = param((0.0, 0.0, 0.0), doc="Antenna in the imu frame", unit="m",
                                         length=3)


@dataclass(frozen=True)
class WalkRecording:
    """What is recorded, east-north-up about FRAME."""

    imu: ImuLog
    mag: MagLog
    fix: FixLog
    velocity: VelocityLog


class Walk:
    """Motion of the sensor over ``duration`` s, drawn from ``rng``."""

    def __init__(self, duration: float, rng: np.random.Generator):
        self.duration = duration
        t = np.arange(-1.0, duration + 1.0, _FINE)
        knots = np.arange(-8.0, duration + 16.0, 8.0)
        heading = CubicSpline(knots, rng.uniform(-0.25, 0.25, len(knots))).antiderivative()(t)
        step = 2.0 * np.pi * (0.95 * t + 0.1 * np.sin(0.2 * t))    # phase of a pair of steps
        walks = 1.0 / (1.0 + np.exp(-(t - _STANDS) / 0.3))
        speed = 1.4 * walks * (1.0 + 0.12 * np.sin(2.0 * step))
        forward = np.stack([np.cos(heading), np.sin(heading)])
        left = np.stack([-forward[1], forward[0]])
        level = np.cumsum(speed * forward, axis=1) * _FINE + 0.03 * walks * np.sin(step) * left
        up = 0.03 * walks * np.cos(2.0 * step) + 1.5 * np.sin(0.03 * t)
        self.position = CubicSpline(t, np.stack([*level, up], axis=1))
        self._angles = CubicSpline(t, np.stack([
            heading + np.radians(6.0) * walks * np.sin(step),
            0.1 + np.radians(3.0) * walks * np.sin(2.0 * step + 0.5),
            np.radians(4.0) * walks * np.sin(step + 1.0)], axis=1))

    def attitude(self, t: np.ndarray) -> Rotation:
        """World <- imu at times (n,) s."""
        return Rotation.from_euler("ZYX", self._angles(t))

    def rate(self, t: np.ndarray) -> np.ndarray:
        """(n, 3) rad/s in the imu frame at times (n,) s."""
        (_, pitch, roll), (yaw_rate, pitch_rate, roll_rate) = self._angles(t).T, self._angles(
            t, 1).T
        return np.stack([
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
            yaw_rate * np.cos(pitch) * np.cos(roll) - pitch_rate * np.sin(roll)], axis=1)

    def antenna(self, t: np.ndarray, lever_arm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (n, 3) m and velocity (n, 3) m/s of a point (3,) m of the imu frame."""
        turn, swing = self.attitude(t), np.cross(self.rate(t), lever_arm)
        return self.position(t) + turn.apply(lever_arm), self.position(t, 1) + turn.apply(swing)


def record(walk: Walk, rng: np.random.Generator, errors: WalkErrors | None = None
           ) -> WalkRecording:
    """What sensors with these errors record of a walk."""
    errors = errors or WalkErrors()
    t = np.arange(int(walk.duration * errors.rate)) / errors.rate
    stamp = EPOCH + np.round(1e9 * t).astype(np.int64)
    body = walk.attitude(t).inv()
    weight = np.array([0.0, 0.0, normal_gravity(FRAME.latitude_deg, FRAME.height)])
    imu = ImuLog(stamp,
                 gyr=_read(walk.rate(t), errors, errors.gyr_bias_sd, errors.gyr_noise_density, rng),
                 acc=_read(body.apply(walk.position(t, 2) + weight), errors, errors.acc_bias_sd,
                           errors.acc_noise_density, rng))
    field = magnetic_field_world(FRAME.latitude_deg, FRAME.longitude_deg, FRAME.height,
                                 decimal_year(EPOCH)) + _iron(walk.position(t), errors, rng)
    mag = MagLog(stamp, body.apply(field) + errors.mag_bias_sd * rng.standard_normal(3)
                 + errors.mag_noise_sd * rng.standard_normal((len(t), 3)))

    tg = np.arange(1.0, walk.duration - 1.0, 1.0 / errors.gnss_rate)
    lever = np.array(errors.lever_arm)
    off, off_vel = gnss_errors(tg, errors.gnss, rng)
    late = EPOCH + np.round(1e9 * (tg + errors.gnss.time_offset)).astype(np.int64)
    cov, cov_vel = (np.broadcast_to(np.diag(np.square(sd)), (len(tg), 3, 3))
                    for sd in (errors.stated_sd, errors.gnss.velocity_sd))
    fix = FixLog(late, *FRAME.to_geodetic(walk.antenna(tg, lever)[0] + off), cov,
                 np.zeros(len(tg)))
    velocity = VelocityLog(
        late, walk.antenna(tg - errors.velocity_late, lever)[1] + off_vel, cov_vel)
    return WalkRecording(imu, mag, fix, velocity)


def _read(true, errors, bias_sd, density, rng):
    """Readings (n, 3) of an inertial sensor."""
    matrix = np.eye(3) + errors.axes_sd * rng.standard_normal((3, 3))
    matrix[np.diag_indices(3)] = 1.0 + errors.scale_sd * rng.standard_normal(3)
    wander = gauss_markov(np.arange(len(true)) / errors.rate, [0.1 * bias_sd], errors.bias_tau, rng)
    return (true @ matrix.T + bias_sd * rng.standard_normal(3) + wander
            + density * np.sqrt(errors.rate) * rng.standard_normal(true.shape))


def _iron(place, errors, rng):
    """Field (n, 3) T of iron at places (n, 3) m: waves of random directions and phases."""
    waves = rng.standard_normal((_WAVES, 3)) / errors.iron_length
    phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    amplitudes = errors.iron * rng.standard_normal((_WAVES, 3)) * np.sqrt(2.0 / _WAVES)
    return np.cos(place @ waves.T + phases) @ amplitudes
