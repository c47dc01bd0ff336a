"""What a phone and a GNSS logger record of a simulated jump."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.simulation.noise_gnss import GnssErrors, gnss_errors
from imu_fusion.simulation.ski_jump import SkiJump

EPOCH = 1_529_400_000 * 10**9  # 2018-06-19, the summer of the paper's measurements
_INSIDE = 10   # values in a sampling period, of which a reading is the mean


@dataclass(frozen=True)
class PhoneErrors(Parameters):
    """Errors of a phone's sensors. Defaults: Fang 2020, tables 3 (biases) and 4, 5 (noise of
    one sample)."""

    rate: float = param(100.0, doc="Sampling rate of inertial sensors and magnetometer",
                        unit="Hz", low=10)
    gyr_sd: float = param(0.0175, doc="Gyroscope noise of one sample", unit="rad/s", low=0)
    acc_sd: float = param(0.1, doc="Accelerometer noise of one sample", unit="m/s^2", low=0)
    mag_sd: float = param(5e-6, doc="Magnetometer noise of one sample", unit="T", low=0)
    gyr_bias_sd: float = param(0.0873, doc="Gyroscope bias", unit="rad/s", low=0)
    acc_bias_sd: float = param(0.2, doc="Accelerometer bias", unit="m/s^2", low=0)
    mag_bias_sd: float = param(5e-6, doc="Magnetometer bias", unit="T", low=0)
    mag_scale_sd: float = param(0.1, doc="Magnetometer scale error", low=0)
    gyr_range: float = param(0.0, doc="Gyroscope range; 0: unlimited", unit="rad/s", low=0)


@dataclass(frozen=True)
class Recording:
    """Logs of a jump, its truth at the Imu stamps and the errors that were drawn."""

    imu: ImuLog
    mag: MagLog
    fix: FixLog
    velocity: VelocityLog
    motion: object
    gyr_bias: np.ndarray
    acc_bias: np.ndarray
    mag_bias: np.ndarray
    mag_scale: np.ndarray


def period_means(jump: SkiJump, times: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """What an inertial sensor reads: the means over its sampling periods.

    The filter of a real sensor leaves these; single values of a force that steps, as it does at
    take-off and on landing, would not add up to the change of velocity.

    Args:
        jump: the jump. times: (n,) s, middles of the periods. period: s.

    Returns:
        Rates rad/s and specific forces m/s^2 in sensor axes, (n, 3) each.
    """
    inside = (np.arange(_INSIDE) + 0.5) / _INSIDE - 0.5
    motion = jump.at((times[:, None] + period * inside).ravel())
    rate, force = (v.reshape(len(times), _INSIDE, 3).mean(axis=1)
                   for v in (jump.rate(motion), jump.specific_force(motion)))
    return rate, force


def record(jump: SkiJump, rng: np.random.Generator, phone: PhoneErrors = PhoneErrors(),
           gnss: GnssErrors = GnssErrors(), gnss_rate: float = 10.0, epoch: int = EPOCH,
           outages: Sequence[tuple[float, float]] = ()) -> Recording:
    """Record a :class:`~imu_fusion.simulation.ski_jump.SkiJump`.

    Args:
        jump: the jump.
        rng: numpy Generator.
        phone, gnss: errors.
        gnss_rate: Hz.
        epoch: stamp of t = 0, ns.
        outages: (start, stop) pairs, s, without GNSS.

    Returns:
        Recording.
    """
    ticks = np.arange(int(jump.params.duration * phone.rate) + 1)
    motion = jump.at(ticks / phone.rate)
    stamp = epoch + np.round(ticks * (1e9 / phone.rate)).astype(np.int64)
    n = len(ticks)
    origin = jump.hill.origin
    field = magnetic_field_world(origin.latitude_deg, origin.longitude_deg, origin.height,
                                 decimal_year(epoch))
    biases = [sd * rng.standard_normal(3) for sd in (
        phone.gyr_bias_sd, phone.acc_bias_sd, phone.mag_bias_sd, phone.mag_scale_sd)]
    gyr_bias, acc_bias, mag_bias, mag_scale = biases
    rate, force = period_means(jump, ticks / phone.rate, 1.0 / phone.rate)
    gyr = rate + gyr_bias + phone.gyr_sd * rng.standard_normal((n, 3))
    if phone.gyr_range > 0.0:
        gyr = np.clip(gyr, -phone.gyr_range, phone.gyr_range)
    acc = force + acc_bias + phone.acc_sd * rng.standard_normal((n, 3))
    mag_imu = Rotation.from_quat(motion.quat_world_imu).inv().apply(field)
    mag = ((1.0 + mag_scale) * mag_imu + mag_bias + phone.mag_sd * rng.standard_normal((n, 3)))

    times = np.arange(int((jump.params.duration - 0.2) * gnss_rate) + 1) / gnss_rate
    times = times[[not any(a <= t < b for a, b in outages) for t in times]]
    truth = jump.at(times)
    position_error, velocity_error = gnss_errors(times, gnss, rng)
    fix_stamp = epoch + np.round((times + gnss.time_offset) * 1e9).astype(np.int64)
    latitude, longitude, height = origin.to_geodetic(truth.position_world + position_error)
    cov = np.broadcast_to(np.diag(np.square(gnss.position_sd)), (len(times), 3, 3))
    cov_vel = np.broadcast_to(np.diag(np.square(gnss.velocity_sd)), (len(times), 3, 3))
    return Recording(
        imu=ImuLog(stamp=stamp, gyr=gyr, acc=acc), mag=MagLog(stamp=stamp, mag=mag),
        fix=FixLog(stamp=fix_stamp, latitude_deg=latitude, longitude_deg=longitude, height=height,
                   cov_enu=cov, status=np.zeros(len(times))),
        velocity=VelocityLog(stamp=fix_stamp, vel_world=truth.vel_world + velocity_error,
                             cov_world=cov_vel),
        motion=motion, gyr_bias=gyr_bias, acc_bias=acc_bias, mag_bias=mag_bias,
        mag_scale=mag_scale)
