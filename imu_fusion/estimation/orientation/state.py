"""What every orientation kernel shares: state layout, rotation history, output rows.

A kernel keeps its numbers in two flat arrays, ``x`` (float64) and ``k`` (int64),
so that one compiled call per sample needs few arguments and a snapshot is two
copies. Names below are offsets into them.

Magnetometer samples are used at the time they belong to. A history of the last
rotations, integrated from the gyroscope alone (no corrections, hence no jumps),
carries a sample from its own time to the newest Imu sample: that is how sensor
delays, late arrival and different rates are all handled by one mechanism.
"""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.orientation import mag_limit as limit
from imu_fusion.geometry.rotation import (
    quat_conjugate, quat_exp, quat_log, quat_multiply, quat_normalize, quat_rotate,
    quat_to_matrix)

ORIENTATION_DTYPE = np.dtype([
    ("stamp", "<i8"), ("quat_world_imu", "<f8", 4), ("cov_attitude", "<f8", (3, 3)),
    ("gyr", "<f8", 3), ("cov_gyr", "<f8", (3, 3)), ("acc", "<f8", 3),
    ("cov_acc", "<f8", (3, 3)), ("gyr_bias", "<f8", 3), ("gyr_bias_sd", "<f8", 3),
    ("mag_world", "<f8", 3), ("reliability", "<f8"), ("flags", "<u4"), ("mag_count", "<u4")])
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
FLAG_HELD = 2048          # a rate that nothing before resembles: the one before stands in for it
# Beside FLAG_SATURATED, one bit for each axis at its limit, x first: 256, 512, 1024.
SATURATED_AXES_SHIFT = 8

UNIFORM_VARIANCE = math.pi ** 2 / 3.0   # rad^2, of an angle about which nothing is known

ROW_WORDS = ORIENTATION_DTYPE.itemsize // 8
# Offsets of the fields in words.
(ROW_STAMP, ROW_QUAT, ROW_COV, ROW_GYR, ROW_COV_GYR, ROW_ACC, ROW_COV_ACC, ROW_BIAS,
 ROW_BIAS_SD, ROW_MAG, ROW_RELIABILITY, FLAGS_WORD) = (
    ORIENTATION_DTYPE.fields[name][1] // 8 for name in ORIENTATION_DTYPE.names[:-1])

# Float state common to all kernels.
Q = 0              # quat_world_imu of the estimate, in gyroscope time
U = 4              # the same without corrections: the chain of gyroscope rotations
GYR_LAST = 8       # last raw rate
GYR_BIAS = 11
FIELD = 14         # local magnetic field in world axes, tesla
LAG = 17           # how much later magnetometer samples are stamped than rates, s
HISTORY = 18       # ring of U
HISTORY_LENGTH = 256
PENDING = HISTORY + 4 * HISTORY_LENGTH   # samples that wait for the Imu to pass them
PENDING_LENGTH = 128  # at 1 kHz more than the largest delay, 0.1 s
MAG_FLOATS = PENDING + 3 * PENDING_LENGTH  # of orientation_mag_limit
X_COMMON = MAG_FLOATS + limit.FLOATS

# Integer state common to all kernels.
LAST_STAMP = 0
STARTED = 1
HISTORY_COUNT = 2
PENDING_COUNT = 3
HEADING_KNOWN = 4
ALIGN_UNTIL = 5    # stamp of the end of the alignment interval
IMU_USED, IMU_REJECTED, MAG_USED, MAG_REJECTED, MAG_LATE, MAG_DISTURBED = range(6, 12)
GAPS, SATURATED = 12, 13
HISTORY_STAMPS = 14
PENDING_STAMPS = HISTORY_STAMPS + HISTORY_LENGTH
MAG_INTS = PENDING_STAMPS + PENDING_LENGTH  # of orientation_mag_limit
MAG_SATURATED = MAG_INTS + limit.INTS
MAG_FLAGS = MAG_SATURATED + 1               # flags that wait for the next row
RATES_HELD = MAG_FLAGS + 1
K_COMMON = RATES_HELD + 1

# Parameters common to all kernels, one float64 array.
P_GYR_DELAY, P_MAX_LAG, P_MAX_GAP, P_GYR_DENSITY, P_ACC_DENSITY, P_ACC_BIAS_SD = range(6)
P_MAG_SD, P_RELIABILITY, P_GAP_RATE_SD, P_BIAS_WALK, P_DECLINATION = range(6, 11)
P_RANGE = 11       # (3,) gyroscope limit, inf if none, nan if it is to be found
P_FRAME = 14       # (4,) rotation from ENU to the published world frame
P_IRON_OFFSET = 18  # (3,) tesla
P_IRON_MATRIX = 21  # (9,) row by row
P_AXES_SD = 30
P_MAG_RANGE = 31   # (3,) tesla, nan if it is to be found
P_DELAY_SD = 34    # s, of the gyroscope's delay
P_COMMON = 35
TAKEN_WORDS = 10   # per magnetometer sample taken: field (3), rate (3), rotation (4)

# What no sensor of this world reports, whatever its unit: a broken message.
_WILD_RATE = 1e4        # rad/s
_WILD_FORCE = 1e6       # m/s^2
_WILD_FIELD = 1e6       # T
_NO_FIELD = 1e-9        # T: zeros of a magnetometer that is not there; rooms shield to more


@njit
def _is_within(v, bound):
    """Whether the three elements of v are finite and not larger than ``bound``."""
    return abs(v[0]) <= bound and abs(v[1]) <= bound and abs(v[2]) <= bound


@njit
def is_imu_sample(sample):
    """Whether (6,) rate rad/s and specific force m/s^2 are numbers that a sensor can report."""
    return _is_within(sample[:3], _WILD_RATE) and _is_within(sample[3:6], _WILD_FORCE)


@njit
def are_imu_samples(samples):
    """:func:`is_imu_sample` of each row of (n, 6)."""
    result = np.empty(len(samples), dtype=np.bool_)
    for i in range(len(samples)):
        result[i] = is_imu_sample(samples[i])
    return result


@njit
def is_mag_sample(mag):
    """Whether (3,) tesla are numbers that a sensor can report."""
    return _is_within(mag, _WILD_FIELD) and not _is_within(mag, _NO_FIELD)


@njit
def rotation_of_step(rate, rate_next, dt):
    """Rotation vector (3,) of a step over which the rate changes linearly.

    The second term is that of coning: without it the error is of second order in dt
    where the axis of rotation moves.
    """
    mean, coning = 0.5 * dt, dt * dt / 12.0
    a, b = rate, rate_next
    return (mean * (a[0] + b[0]) + coning * (a[1] * b[2] - a[2] * b[1]),
            mean * (a[1] + b[1]) + coning * (a[2] * b[0] - a[0] * b[2]),
            mean * (a[2] + b[2]) + coning * (a[0] * b[1] - a[1] * b[0]))


@njit
def push_rotation(x, k, stamp, turn):
    """Turn the gyroscope chain by a quaternion (4,), imu axes, and remember it at ``stamp``."""
    u = quat_normalize(quat_multiply(x[U:U + 4], turn))
    x[U:U + 4] = u
    slot = k[HISTORY_COUNT] % HISTORY_LENGTH
    x[HISTORY + 4 * slot:HISTORY + 4 * slot + 4] = u
    k[HISTORY_STAMPS + slot] = stamp
    k[HISTORY_COUNT] += 1


@njit
def rotation_since(x, k, stamp, turn, rate):
    """Rotation from the imu axes at ``stamp`` to those of the newest Imu sample.

    Writes the quaternion q with ``v_imu_now = rotate(q, v_imu_then)`` to ``turn`` (4,)
    and the rate of turn at that time, rad/s, to ``rate`` (3,). Returns False where the
    history does not reach back that far.
    """
    count = k[HISTORY_COUNT]
    newer = -1
    for back in range(min(count, HISTORY_LENGTH)):
        slot = (count - 1 - back) % HISTORY_LENGTH
        here = k[HISTORY_STAMPS + slot]
        if here < stamp or (here == stamp and (newer >= 0 or count == 1)):
            since = quat_multiply(quat_conjugate(x[U:U + 4]),
                                  x[HISTORY + 4 * slot:HISTORY + 4 * slot + 4])
            rate[:] = 0.0
            if newer >= 0:
                step = quat_log(quat_multiply(
                    quat_conjugate(x[HISTORY + 4 * slot:HISTORY + 4 * slot + 4]),
                    x[HISTORY + 4 * newer:HISTORY + 4 * newer + 4]))
                span = k[HISTORY_STAMPS + newer] - here
                for i in range(3):
                    rate[i] = step[i] / (span * 1e-9)
                since = quat_multiply(since, quat_exp(step, (stamp - here) / span))
            turn[:] = since
            return True
        newer = slot
    return False


@njit
def push_mag(x, k, par, stamp, mag):
    """Take one magnetometer sample (tesla, imu axes), in any order of arrival.

    It belongs to ``stamp`` less the magnetometer's delay; samples older than the
    permitted lag are counted and dropped, and so are those with an axis at its limit.
    """
    if not is_mag_sample(mag) or not k[STARTED]:
        k[MAG_REJECTED] += 1
        return
    if limit.is_saturated(x[MAG_FLOATS:MAG_FLOATS + limit.FLOATS],
                          k[MAG_INTS:MAG_INTS + limit.INTS],
                          par[P_MAG_RANGE:P_MAG_RANGE + 3], mag):
        k[MAG_SATURATED] += 1
        k[MAG_FLAGS] |= FLAG_MAG_SATURATED
        return
    if k[LAST_STAMP] - stamp > par[P_MAX_LAG] * 1e9:
        k[MAG_LATE] += 1
        return
    calibrated = np.empty(3)
    for i in range(3):
        calibrated[i] = 0.0
        for j in range(3):
            calibrated[i] += (par[P_IRON_MATRIX + 3 * i + j]
                              * (mag[j] - par[P_IRON_OFFSET + j]))
    if _is_within(calibrated, _NO_FIELD):
        k[MAG_REJECTED] += 1
        return
    if k[PENDING_COUNT] == PENDING_LENGTH:
        # A magnetometer far faster than the Imu: the oldest waiting sample goes.
        k[MAG_REJECTED] += 1
        for i in range(PENDING_LENGTH - 1):
            k[PENDING_STAMPS + i] = k[PENDING_STAMPS + i + 1]
            for j in range(3):
                x[PENDING + 3 * i + j] = x[PENDING + 3 * i + 3 + j]
        k[PENDING_COUNT] -= 1
    slot = k[PENDING_COUNT]
    k[PENDING_STAMPS + slot] = stamp - np.int64(math.floor(x[LAG] * 1e9 + 0.5))
    x[PENDING + 3 * slot:PENDING + 3 * slot + 3] = calibrated
    k[PENDING_COUNT] += 1


@njit
def take_mags(x, k, taken):
    """The waiting samples that the newest Imu sample has passed.

    Writes one row of ``taken`` (k[PENDING_COUNT], TAKEN_WORDS) for each: field in imu axes
    at its own time (3), rate of turn then (3), rotation from there to the newest Imu
    sample (4). Returns how many.
    """
    count = 0
    kept = 0
    for i in range(k[PENDING_COUNT]):
        when = k[PENDING_STAMPS + i]
        if when > k[LAST_STAMP]:
            k[PENDING_STAMPS + kept] = when
            for j in range(3):
                x[PENDING + 3 * kept + j] = x[PENDING + 3 * i + j]
            kept += 1
        elif rotation_since(x, k, when, taken[count, 6:10], taken[count, 3:6]):
            taken[count, :3] = x[PENDING + 3 * i:PENDING + 3 * i + 3]
            count += 1
        else:
            k[MAG_LATE] += 1
    k[PENDING_COUNT] = kept
    return count


@njit
def mag_flags(k):
    """FLAG constants of magnetometer samples that were refused since the last row; clears them."""
    flags = k[MAG_FLAGS]
    k[MAG_FLAGS] = 0
    return flags


@njit
def is_newer(k, stamp, sample):
    """Whether an Imu sample can be used: possible, and newer than the last. Counts it."""
    if not is_imu_sample(sample) or (k[STARTED] and stamp <= k[LAST_STAMP]):
        k[IMU_REJECTED] += 1
        return False
    k[IMU_USED] += 1
    return True


@njit
def beyond_limits(rate, clipped, limits):
    """Raise a rate (3,), in place, to the limits of the axes (bits) that are at theirs: what the
    gyroscope does not show lies beyond."""
    for i in range(3):
        if (clipped >> i) & 1 and abs(rate[i]) < limits[i] < math.inf:
            rate[i] = math.copysign(limits[i], rate[i])


@njit
def write_cov_attitude(row, par, cov_world, r, rate):
    """Covariance of the attitude's error, imu axes, from that in world axes (3, 3).

    It gets what no filter on these sensors can see: their axes in the case, and a delay of
    the rates, by which a turn of ``rate`` (3,) is late. r (3, 3): from imu to world axes.
    """
    for j in range(3):
        a = cov_world[0, 0] * r[0, j] + cov_world[0, 1] * r[1, j] + cov_world[0, 2] * r[2, j]
        b = cov_world[1, 0] * r[0, j] + cov_world[1, 1] * r[1, j] + cov_world[1, 2] * r[2, j]
        c = cov_world[2, 0] * r[0, j] + cov_world[2, 1] * r[1, j] + cov_world[2, 2] * r[2, j]
        late = par[P_DELAY_SD] ** 2 * rate[j]
        for i in range(3):
            row[ROW_COV + 3 * i + j] = r[0, i] * a + r[1, i] * b + r[2, i] * c + rate[i] * late
        row[ROW_COV + 4 * j] += par[P_AXES_SD] ** 2


@njit
def write_row(row, row_int, par, stamp, quat, cov_world, gyr, var_gyr, acc, var_acc,
              bias, bias_var, mag, reliability, flags, mag_count):
    """Write one ORIENTATION_DTYPE row through its float and integer views.

    quat is that of gyroscope time; the row's is carried on by the gyroscope's
    delay at the present rate. cov_world (3, 3) is that of the error in world axes.
    mag (3,) is in imu axes, nan if none. Flags and mag_count share a 64-bit word.
    """
    frame = par[P_FRAME:P_FRAME + 4]
    ahead = quat_multiply(quat, quat_exp(gyr, par[P_GYR_DELAY]))
    row_int[ROW_STAMP] = stamp
    row[ROW_QUAT:ROW_QUAT + 4] = quat_normalize(quat_multiply(frame, ahead))
    r = quat_to_matrix(ahead)
    write_cov_attitude(row, par, cov_world, r, gyr)
    for i in range(3):
        for j in range(3):
            row[ROW_COV_GYR + 3 * i + j] = var_gyr[i] if i == j else 0.0
            row[ROW_COV_ACC + 3 * i + j] = var_acc if i == j else 0.0
    for i in range(3):
        row[ROW_GYR + i] = gyr[i]
        row[ROW_ACC + i] = acc[i]
        row[ROW_BIAS + i] = bias[i]
        row[ROW_BIAS_SD + i] = math.sqrt(max(bias_var[i], 0.0))
    row[ROW_MAG:ROW_MAG + 3] = quat_rotate(frame, quat_rotate(quat, mag))
    row[ROW_RELIABILITY] = reliability
    row_int[FLAGS_WORD] = flags + (mag_count << 32)
