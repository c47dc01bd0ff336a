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
from numba import njit

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

ROW_WORDS = ORIENTATION_DTYPE.itemsize // 8
_STAMP, _QUAT, _COV, _GYR, _COV_GYR, _ACC, _COV_ACC, _BIAS, _BIAS_SD, _MAG, _REL, _FLAGS = (
    ORIENTATION_DTYPE.fields[name][1] // 8 for name in ORIENTATION_DTYPE.names[:-1])

# Float state common to all kernels.
Q = 0              # quat_world_imu of the estimate, in gyroscope time
U = 4              # the same without corrections: the chain of gyroscope rotations
GYR_LAST = 8       # last raw rate
GYR_BIAS = 11
FIELD = 14         # local magnetic field in world axes, tesla
MAG = 17           # magnetometer samples since the last row: sum in present imu axes
MAG_WEIGHT = 20    # sum of their reliabilities
HISTORY = 24       # ring of U
HISTORY_LENGTH = 256
PENDING = HISTORY + 4 * HISTORY_LENGTH   # samples that wait for the Imu to pass them
PENDING_LENGTH = 8
X_COMMON = PENDING + 3 * PENDING_LENGTH

# Integer state common to all kernels.
LAST_STAMP = 0
STARTED = 1
HISTORY_COUNT = 2
PENDING_COUNT = 3
MAG_COUNT = 4      # magnetometer samples since the last row
HEADING_KNOWN = 5
LAST_MAG_STAMP = 6
IMU_USED, IMU_REJECTED, MAG_USED, MAG_REJECTED, MAG_LATE, MAG_DISTURBED = 7, 8, 9, 10, 11, 12
GAPS, SATURATED = 13, 14
ALIGN_UNTIL = 15   # stamp of the end of the alignment interval
HISTORY_STAMPS = 16
PENDING_STAMPS = HISTORY_STAMPS + HISTORY_LENGTH
K_COMMON = PENDING_STAMPS + PENDING_LENGTH

# Parameters common to all kernels, one float64 array.
P_GYR_DELAY, P_MAG_DELAY, P_MAX_LAG, P_MAX_GAP, P_GYR_DENSITY, P_ACC_DENSITY = range(6)
P_ACC_BIAS_SD, P_MAG_SD, P_RELIABILITY, P_GAP_RATE_SD, P_BIAS_WALK = range(6, 11)
P_RANGE = 11       # (3,) gyroscope limit, inf if none
P_FRAME = 14       # (4,) rotation from ENU to the published world frame
P_IRON_OFFSET = 18  # (3,) tesla
P_IRON_MATRIX = 21  # (9,) row by row
P_COMMON = 30


@njit(cache=True)
def is_finite3(v):
    """Whether the three elements of v are finite numbers."""
    return math.isfinite(v[0]) and math.isfinite(v[1]) and math.isfinite(v[2])


@njit(cache=True)
def push_rotation(x, k, stamp, phi):
    """Turn the gyroscope chain by phi (rad, imu axes) and remember it at ``stamp``."""
    u = quat_normalize(quat_multiply(x[U:U + 4], quat_exp(phi)))
    x[U:U + 4] = u
    slot = k[HISTORY_COUNT] % HISTORY_LENGTH
    x[HISTORY + 4 * slot:HISTORY + 4 * slot + 4] = u
    k[HISTORY_STAMPS + slot] = stamp
    k[HISTORY_COUNT] += 1


@njit(cache=True)
def rotation_since(x, k, stamp, out):
    """Rotation from the imu axes at ``stamp`` to those of the newest Imu sample.

    Writes the quaternion q with ``v_imu_now = rotate(q, v_imu_then)`` to ``out`` (4,).
    Returns False where the history does not reach back that far.
    """
    count = k[HISTORY_COUNT]
    reach = min(count, HISTORY_LENGTH)
    newer = -1
    for back in range(reach):
        slot = (count - 1 - back) % HISTORY_LENGTH
        here = k[HISTORY_STAMPS + slot]
        if here <= stamp:
            u = x[HISTORY + 4 * slot:HISTORY + 4 * slot + 4].copy()
            if newer >= 0 and here < stamp:
                u_newer = x[HISTORY + 4 * newer:HISTORY + 4 * newer + 4]
                part = (stamp - here) / (k[HISTORY_STAMPS + newer] - here)
                step = quat_log(quat_multiply(quat_conjugate(u), u_newer))
                u = quat_multiply(u, quat_exp(part * step))
            out[:] = quat_multiply(quat_conjugate(x[U:U + 4]), u)
            return True
        newer = slot
    return False


@njit(cache=True)
def push_mag(x, k, par, stamp, mag):
    """Take one magnetometer sample (tesla, imu axes), in any order of arrival.

    It belongs to ``stamp`` less the magnetometer's delay; samples older than the
    permitted lag are counted and dropped.
    """
    if not is_finite3(mag) or not k[STARTED]:
        k[MAG_REJECTED] += 1
        return
    delay = par[P_MAG_DELAY] - par[P_GYR_DELAY]
    if k[LAST_STAMP] - stamp > par[P_MAX_LAG] * 1e9:
        k[MAG_LATE] += 1
        return
    calibrated = np.empty(3)
    for i in range(3):
        calibrated[i] = 0.0
        for j in range(3):
            calibrated[i] += (par[P_IRON_MATRIX + 3 * i + j]
                              * (mag[j] - par[P_IRON_OFFSET + j]))
    if k[PENDING_COUNT] == PENDING_LENGTH:
        # A magnetometer far faster than the Imu: the oldest waiting sample goes.
        k[MAG_REJECTED] += 1
        for i in range(PENDING_LENGTH - 1):
            k[PENDING_STAMPS + i] = k[PENDING_STAMPS + i + 1]
            for j in range(3):
                x[PENDING + 3 * i + j] = x[PENDING + 3 * i + 3 + j]
        k[PENDING_COUNT] -= 1
    slot = k[PENDING_COUNT]
    k[PENDING_STAMPS + slot] = stamp - np.int64(math.floor(delay * 1e9 + 0.5))
    x[PENDING + 3 * slot:PENDING + 3 * slot + 3] = calibrated
    k[PENDING_COUNT] += 1


@njit(cache=True)
def take_mags(x, k, par):
    """Carry the waiting samples that the newest Imu sample has passed into its axes.

    Adds them to the running sum at MAG; returns how many were added.
    """
    taken = 0
    kept = 0
    turn = np.empty(4)
    for i in range(k[PENDING_COUNT]):
        when = k[PENDING_STAMPS + i]
        sample = x[PENDING + 3 * i:PENDING + 3 * i + 3].copy()
        if when > k[LAST_STAMP]:
            k[PENDING_STAMPS + kept] = when
            x[PENDING + 3 * kept:PENDING + 3 * kept + 3] = sample
            kept += 1
        elif rotation_since(x, k, when, turn):
            now = quat_rotate(turn, sample)
            for j in range(3):
                x[MAG + j] += now[j]
            taken += 1
        else:
            k[MAG_LATE] += 1
    k[PENDING_COUNT] = kept
    k[MAG_COUNT] += taken
    return taken


@njit(cache=True)
def write_row(row, row_int, par, stamp, quat, cov_world, gyr, var_gyr, acc, var_acc,
              bias, bias_var, mag, reliability, flags, mag_count):
    """Write one ORIENTATION_DTYPE row through its float and integer views.

    quat is that of gyroscope time; the row's is carried on by the gyroscope's
    delay at the present rate. cov_world (3, 3) is that of the error in world axes.
    mag (3,) is in imu axes, nan if none. Flags and mag_count share a 64-bit word.
    """
    frame = par[P_FRAME:P_FRAME + 4]
    ahead = quat_multiply(quat, quat_exp(par[P_GYR_DELAY] * gyr))
    row_int[_STAMP] = stamp
    row[_QUAT:_QUAT + 4] = quat_normalize(quat_multiply(frame, ahead))
    r = quat_to_matrix(ahead)
    for i in range(3):
        for j in range(3):
            total = 0.0
            for m in range(3):
                for n in range(3):
                    total += r[m, i] * cov_world[m, n] * r[n, j]
            row[_COV + 3 * i + j] = total
            row[_COV_GYR + 3 * i + j] = var_gyr[i] if i == j else 0.0
            row[_COV_ACC + 3 * i + j] = var_acc if i == j else 0.0
    for i in range(3):
        row[_GYR + i] = gyr[i]
        row[_ACC + i] = acc[i]
        row[_BIAS + i] = bias[i]
        row[_BIAS_SD + i] = math.sqrt(max(bias_var[i], 0.0))
    row[_MAG:_MAG + 3] = quat_rotate(frame, quat_rotate(quat, mag))
    row[_REL] = reliability
    row_int[_FLAGS] = flags + (mag_count << 32)
