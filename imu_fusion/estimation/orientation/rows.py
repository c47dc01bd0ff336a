"""What comes out, one row per Imu sample: layout, flags, and how rows are written."""

import math

import numpy as np

from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_to_matrix,
)
from imu_fusion.kernels import njit

ORIENTATION_DTYPE = np.dtype([
    ("stamp", "<i8"), ("quat_world_imu", "<f8", 4), ("cov_attitude", "<f8", (3, 3)),
    ("gyr", "<f8", 3), ("cov_gyr", "<f8", (3, 3)), ("acc", "<f8", 3),
    ("cov_acc", "<f8", (3, 3)), ("gyr_bias", "<f8", 3), ("gyr_bias_sd", "<f8", 3),
    ("mag_world", "<f8", 3), ("reliability", "<f8"), ("flags", "<u4"), ("mag_count", "<u4")],
    align=True)
"""One row per Imu sample.

stamp (ns); quat_world_imu (xyzw); cov_attitude of the local error dtheta_imu
(rad^2); gyr, recovered and bias-corrected (rad/s), and its covariance; acc,
calibrated specific force (m/s^2), and its covariance; gyr_bias and its standard
deviation (rad/s); mag_world, the last magnetometer sample in world axes (tesla,
nan if none came since the previous row); reliability, the weight of Winkler
(10) of that sample (nan if none); flags, a sum of the FLAG constants; mag_count,
the magnetometer samples taken in by this row.
"""

FLAG_STILL = 1          # the sensor is at rest
FLAG_MAG_USED = 2       # a magnetometer sample took part in this row
FLAG_MAG_DISTURBED = 4  # a magnetometer sample was refused as disturbed
FLAG_SATURATED = 8      # a gyroscope axis is at its limit
FLAG_GAP = 16           # samples are missing before this one
FLAG_ALIGNING = 32      # inside the interval from which the initial orientation was found
FLAG_NO_HEADING = 64    # no magnetometer sample has fixed the heading yet
FLAG_MAG_SATURATED = 128  # a magnetometer sample was refused: an axis is at its limit
FLAG_HELD = 2048          # a rate or force like nothing before: the one before stands in for it
# Beside FLAG_SATURATED, one bit for each axis at its limit, x first: 256, 512, 1024.
SATURATED_AXES_SHIFT = 8


@njit
def clipped_axes(flags):
    """Bits of the gyroscope axes at their limit, x first, of a row's flags."""
    return (np.int64(flags) >> SATURATED_AXES_SHIFT) & 7


@njit
def raise_to_limits(rate, clipped, limits):
    """Raise a rate (3,), in place, to the limits of the axes (bits) that are at theirs: what the
    gyroscope does not show lies beyond."""
    for i in range(3):
        if (clipped >> i) & 1 and abs(rate[i]) < limits[i] < math.inf:
            rate[i] = math.copysign(limits[i], rate[i])


@njit
def write_cov_attitude(row, p, cov_world, r, dt):
    """Covariance of the attitude's error, imu axes, from that in world axes (3, 3).

    It gets what no filter on these sensors can see: their axes in the case, and a delay of
    the rates, by which a turn of ``row.gyr`` is late. Whether a rate is that at its stamp or the
    mean of the step before or after, nobody knows either: half a step, evenly distributed.
    r (3, 3): from imu to world axes. dt: s, the step before the row.
    """
    rate, cov = row.gyr, row.cov_attitude
    delay2 = p.gyro_delay_sd ** 2
    if delay2 > 0.0:
        delay2 += min(dt, p.gap.max) ** 2 / 12.0
    for j in range(3):
        a = cov_world[0, 0] * r[0, j] + cov_world[0, 1] * r[1, j] + cov_world[0, 2] * r[2, j]
        b = cov_world[1, 0] * r[0, j] + cov_world[1, 1] * r[1, j] + cov_world[1, 2] * r[2, j]
        c = cov_world[2, 0] * r[0, j] + cov_world[2, 1] * r[1, j] + cov_world[2, 2] * r[2, j]
        late = delay2 * rate[j]
        for i in range(3):
            cov[i, j] = r[0, i] * a + r[1, i] * b + r[2, i] * c + rate[i] * late
        cov[j, j] += p.sensor.axes_sd ** 2


@njit
def write_attitude(row, p, quat, cov_world, mag, dt):
    """Attitude and field of a row whose ``gyr`` is written.

    Args:
        quat: (4,) of gyroscope time, world ENU; the row's is carried on by the gyroscope's delay at
            the present rate, and in the published world axes.
        cov_world: (3, 3) of the attitude's error in world axes.
        mag: (3,) tesla, imu axes, nan if none.
        dt: s, the step before the row.
    """
    frame = p.frame_from_enu
    ahead = quat_multiply(quat, quat_exp(row.gyr, p.gyro_delay))
    row.quat_world_imu[:] = quat_normalize(quat_multiply(frame, ahead))
    write_cov_attitude(row, p, cov_world, quat_to_matrix(ahead), dt)
    row.mag_world[:] = quat_rotate(frame, quat_rotate(quat, mag))


@njit
def finish(row, s, p, var_acc, cov_world):
    """The rest of a row that has rates with their variances and the biases' sds, after the step of
    a state. var_acc: of the force; cov_world: of :func:`write_attitude`."""
    step = s.step
    row.stamp = s.stamp
    for i in range(3):
        row.acc[i] = step.acc[i]
        if p.lasting_acc_sd == 0.0:    # else it is mostly motion
            row.acc[i] -= s.acc_bias[i]
        row.gyr_bias[i] = s.gyro_bias[i]
        for j in range(3):
            row.cov_acc[i, j] = 0.0
            if i != j:
                row.cov_gyr[i, j] = 0.0
        row.cov_acc[i, i] = var_acc
    write_attitude(row, p, s.quat_world_imu, cov_world, step.mag, step.dt)
    row.reliability = step.reliability
    row.mag_count = step.mag_count
    if not s.heading_known:
        step.flags |= FLAG_NO_HEADING
    if s.stamp <= s.align_until:
        step.flags |= FLAG_ALIGNING
    row.flags = step.flags
