"""What the sensor ball of Winkler 2025 records: ADIS16355, HMC1043, a GNSS receiver, and the errors
of a calibration in the laboratory years later."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.simulation.avalanche import ROWS_PER_SECOND, Avalanche
from imu_fusion.simulation.noise_gnss import GnssErrors, gnss_errors

EPOCH = 1_358_935_200 * 10**9    # 2013-01-23 10:00, the day of the experiment
RATE = 150                       # Hz
LEVER_ARM = (0.012, -0.031, -0.012)   # m, of the accelerometers from the ball's centre, eq. (17)
_FULL_SCALE = 2 ** 13            # of 14 bits
#: u-blox LEA-4T, whose fixes the paper averages over minutes (figures from memory).
LEA_4T = GnssErrors(position_sd=(2.1, 2.1, 4.0), position_tau=40.0, velocity_sd=(0.1, 0.1, 0.2),
                    velocity_tau=0.0)
#: The AvaNode's receiver, 10 Hz (scatter of nine runs at rest in the snow).
AVANODE = GnssErrors(position_sd=(1.5, 1.5, 4.0), position_tau=15.0,
                     velocity_sd=(0.06, 0.06, 0.09), velocity_tau=0.8)


@dataclass(frozen=True)
class BallErrors(Parameters):
    """Errors of the ball's sensors. Ranges and resolution are the paper's; noise and biases are
    those of data sheets quoted from memory, of the sensor's whole bandwidth: 150 Hz alias it."""

    gyr_sd: float = param(0.0105, doc="Gyroscope noise of one sample", unit="rad/s", low=0)
    gyr_bias_sd: float = param(0.017, doc="Gyroscope bias", unit="rad/s", low=0)
    gyr_matrix_sd: float = param(0.003, doc="Errors of the gyroscope's matrix that its "
                                 "calibration leaves", low=0)
    gyr_calibration_sd: float = param(0.005, doc="What its calibration changes: the recorded "
                                      "rates were clipped before", low=0)
    gyr_range: float = param(6.0, doc="Rate at which the gyroscope clips", unit="rad/s", low=1)
    gyr_lsb: float = param(1.279e-3, doc="Its resolution", unit="rad/s", low=0)
    acc_sd: float = param(0.343, doc="Accelerometer noise of one sample", unit="m/s^2", low=0)
    acc_bias_sd: float = param(0.2, doc="Accelerometer bias", unit="m/s^2", low=0)
    acc_matrix_sd: float = param(0.03, doc="Errors of the accelerometer's matrix", low=0)
    acc_lsb: float = param(0.02473, doc="Its resolution; 14 bits make its range", unit="m/s^2",
                           low=0)
    mag_sd: float = param(3e-7, doc="Magnetometer noise of one sample", unit="T", low=0)
    mag_offset_sd: float = param(2e-5, doc="Hard iron", unit="T", low=0)
    mag_matrix_sd: float = param(0.05, doc="Soft iron and scale errors: a symmetric matrix, "
                                 "which an ellipsoid shows", low=0)
    mag_axes_sd: float = param(0.01, doc="Misalignment of its axes against the gyroscope's, which "
                               "it does not", unit="rad", low=0)
    gap: tuple[float, ...] = param((9.0, 9.5), doc="Times since the entrainment between which "
                                   "nothing was recorded", unit="s", length=2)

    @classmethod
    def none(cls) -> "BallErrors":
        """Perfect sensors that sample at :data:`RATE`."""
        return cls(gyr_sd=0.0, gyr_bias_sd=0.0, gyr_matrix_sd=0.0, gyr_calibration_sd=0.0,
                   gyr_range=1e3, gyr_lsb=0.0, acc_sd=0.0, acc_bias_sd=0.0, acc_matrix_sd=0.0,
                   acc_lsb=0.0, mag_sd=0.0, mag_offset_sd=0.0, mag_matrix_sd=0.0,
                   mag_axes_sd=0.0, gap=(0.0, 0.0))


@dataclass(frozen=True)
class BallRecording:
    """Logs, and what was drawn: recorded force = ``acc_matrix`` @ true + ``acc_bias``, recorded
    field = ``mag_matrix`` @ true + ``mag_offset``, rates likewise. ``rows``: of the motion, at the
    Imu samples. ``field_world`` (3,) T."""

    imu: ImuLog
    mag: MagLog
    fix: FixLog
    velocity: VelocityLog
    rows: np.ndarray
    field_world: np.ndarray
    acc_matrix: np.ndarray
    acc_bias: np.ndarray
    gyr_matrix: np.ndarray
    gyr_bias: np.ndarray
    mag_matrix: np.ndarray
    mag_offset: np.ndarray


def _matrix(rng, sd):
    return np.eye(3) + sd * rng.standard_normal((3, 3))


def _digital(values, lsb):
    """Rounded to steps of ``lsb`` and cut at 14 bits; 0: as they are."""
    if lsb == 0.0:
        return values
    return lsb * np.clip(np.round(values / lsb), -_FULL_SCALE, _FULL_SCALE - 1)


def record_ball(avalanche: Avalanche, rng: np.random.Generator, errors: BallErrors = BallErrors(),
                gnss: GnssErrors = LEA_4T, gnss_rate: float = 4.0, epoch: int = EPOCH,
                outages: Sequence[tuple[float, float]] = ((0.0, 71.0),)) -> BallRecording:
    """Record an :class:`~imu_fusion.simulation.avalanche.Avalanche`.

    The inertial sensor's band is wider than half the sampling rate, so that a reading is that of
    an instant. What its axes report (scale, misalignment, bias, noise) is clipped and digitised,
    and the laboratory's calibration comes after that.

    Args:
        avalanche: Avalanche. rng: numpy Generator. errors, gnss: errors.
        gnss_rate: Hz. epoch: stamp of the entrainment, ns.
        outages: (start, stop) s since the entrainment, without GNSS: under snow, or tumbling.

    Returns:
        BallRecording.
    """
    motion = avalanche.motion
    rows = np.arange(0, len(motion.time), ROWS_PER_SECOND // RATE)
    time = motion.time[rows]
    rows = rows[(time < errors.gap[0]) | (time >= errors.gap[1])]
    n, turn = len(rows), Rotation.from_quat(motion.quat[rows]).inv()
    rate = motion.omega[rows] + turn.apply(avalanche.earth_rate)
    force = motion.specific_force(LEVER_ARM)[rows]
    origin = avalanche.origin
    field = magnetic_field_world(origin.latitude_deg, origin.longitude_deg, origin.height,
                                 decimal_year(epoch))

    # What the gyroscope's axes see is clipped, and then multiplied by the calibration.
    gyr_matrix, calibration = _matrix(rng, errors.gyr_matrix_sd), _matrix(
        rng, errors.gyr_calibration_sd)
    gyr_bias = errors.gyr_bias_sd * rng.standard_normal(3)
    seen = (rate @ gyr_matrix.T + gyr_bias
            + errors.gyr_sd * rng.standard_normal((n, 3))) @ np.linalg.inv(calibration).T
    seen = np.clip(_digital(seen, errors.gyr_lsb), -errors.gyr_range, errors.gyr_range)
    acc_matrix = _matrix(rng, errors.acc_matrix_sd)
    acc_bias = errors.acc_bias_sd * rng.standard_normal(3)
    acc = _digital(force @ acc_matrix.T + acc_bias + errors.acc_sd * rng.standard_normal((n, 3)),
                   errors.acc_lsb)
    soft = errors.mag_matrix_sd * rng.standard_normal((3, 3))
    turned = Rotation.from_rotvec(errors.mag_axes_sd * rng.standard_normal(3))
    mag_matrix = (np.eye(3) + 0.5 * (soft + soft.T)) @ turned.as_matrix()
    mag_offset = errors.mag_offset_sd * rng.standard_normal(3)
    mag = turn.apply(field) @ mag_matrix.T + mag_offset + errors.mag_sd * rng.standard_normal(
        (n, 3))
    stamp = epoch + np.round(motion.time[rows] * 1e9).astype(np.int64)
    fix, velocity = _record_gnss(avalanche, rng, gnss, gnss_rate, epoch, outages)
    return BallRecording(ImuLog(stamp, seen @ calibration.T, acc), MagLog(stamp, mag), fix,
                         velocity, rows, field, acc_matrix, acc_bias, gyr_matrix, gyr_bias,
                         mag_matrix, mag_offset)


def _record_gnss(avalanche, rng, gnss, gnss_rate, epoch, outages):
    """FixLog and VelocityLog of the ball's centre."""
    motion = avalanche.motion
    rows = np.arange(0, len(motion.time), int(ROWS_PER_SECOND / gnss_rate))
    time = motion.time[rows]
    rows = rows[[not any(a <= t < b for a, b in outages) for t in time]]
    position_error, velocity_error = gnss_errors(motion.time[rows], gnss, rng)
    stamp = epoch + np.round(motion.time[rows] * 1e9).astype(np.int64)
    latitude, longitude, height = avalanche.origin.to_geodetic(
        motion.position[rows] + position_error)
    cov, cov_vel = (np.broadcast_to(np.diag(np.square(sd)), (len(rows), 3, 3))
                    for sd in (gnss.position_sd, gnss.velocity_sd))
    return (FixLog(stamp=stamp, latitude_deg=latitude, longitude_deg=longitude, height=height,
                   cov_enu=cov, status=np.zeros(len(rows))),
            VelocityLog(stamp=stamp, vel_world=motion.vel[rows] + velocity_error,
                        cov_world=cov_vel))
