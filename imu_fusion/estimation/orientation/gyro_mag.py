"""Orientation from gyroscope and magnetometer alone: Winkler 2025, eqs. (5)-(11).

Per sample, the rotation over the step is the least-squares solution of the
midpoint rule for the rates (6) and of the constancy of the field (8), solved by
Gauss-Newton. A covariance of [attitude error in world axes, gyroscope bias,
field error relative to its norm] goes alongside: the gain of the paper is not the
optimal one, so the covariance is updated in the form that holds for any gain.

That is the method as printed: ``estimate_bias: false``. With ``estimate_bias`` (the
default) the same two sets of rows are weighted by their covariances instead of by 2
and w, and solved together with the slow states of gyroscope and magnetometer: that is
the error-state filter of orientation_fusion without its accelerometer. Which of the
two runs is settled by the parameters at the start.
"""

import math
from dataclasses import replace

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.orientation import fusion
from imu_fusion.estimation.orientation.detect import find_limits, start_limits
from imu_fusion.estimation.orientation.fusion_layout import LIMIT, P_ESTIMATE_BIAS, P_REST_FORCE
from imu_fusion.estimation.orientation.state import (
    ALIGN_UNTIL, FIELD, FLAG_ALIGNING, FLAG_GAP, FLAG_MAG_USED, FLAG_NO_HEADING,
    FLAG_SATURATED, SATURATED_AXES_SHIFT, GAPS, GYR_BIAS, GYR_LAST, HEADING_KNOWN, LAST_STAMP, MAG_USED,
    P_ACC_BIAS_SD, P_ACC_DENSITY, P_BIAS_WALK, P_GAP_RATE_SD, P_GYR_DENSITY,
    P_MAG_SD, P_MAX_GAP, P_RELIABILITY, PENDING_COUNT, Q, SATURATED, STARTED,
    TAKEN_WORDS, U, UNIFORM_VARIANCE, is_newer, mag_flags, push_mag, push_rotation,
    take_mags, write_row)
from imu_fusion.geometry.rotation import (
    quat_exp, quat_multiply, quat_normalize, quat_rotate, quat_rotate_inverse, quat_to_matrix,
    right_jacobian, skew)

COV = fusion.X_SIZE            # (9, 9): attitude, bias, relative field
N = 9
X_SIZE = COV + N * N
AS_PRINTED = fusion.K_SIZE     # 1: Winkler (9) and nothing else
WAS_CLIPPED = AS_PRINTED + 1   # bits of the axes at their limit at the step's start
K_SIZE = AS_PRINTED + 2
P_FIELD_SD, P_FIELD_TIME = fusion.P_SIZE, fusion.P_SIZE + 1
P_SIZE = P_FIELD_TIME + 1

# Gauss-Newton converges quadratically from the gyroscope's own rotation; the
# limit is reached only by steps of more than a radian.
_ITERATIONS = 8
# Weight of a gyroscope row that is left out. The field's rows outweigh it but within half a
# degree of the field's own direction.
_DROPPED = 0.01


def pack(par, params):
    """Write this kernel's own parameters (OrientationParams) behind the common ones."""
    fusion.pack(par, replace(params, use_acc=False))
    par[P_REST_FORCE] = math.inf   # rest, too, is judged without the accelerometer
    par[P_FIELD_SD] = params.field_sd
    par[P_FIELD_TIME] = params.field_time


def initialise(x, k, par, alignment):
    """Start from an Alignment. x, k: zeroed state."""
    if par[P_ESTIMATE_BIAS]:
        fusion.initialise(x, k, par, alignment)
        return
    start_limits(x, par)
    k[AS_PRINTED] = 1
    x[Q:Q + 4] = alignment.quat_world_imu
    x[U:U + 4] = 0.0, 0.0, 0.0, 1.0
    x[GYR_BIAS:GYR_BIAS + 3] = alignment.gyr_bias
    k[HEADING_KNOWN] = alignment.has_heading
    cov = x[COV:COV + N * N].reshape(N, N)
    cov[:3, :3] = alignment.cov_attitude_world
    cov[3:6, 3:6] = np.eye(3) * alignment.gyr_bias_sd ** 2
    if alignment.has_heading:
        x[FIELD:FIELD + 3] = alignment.field_world
        # The field was turned to world axes by the initial attitude and shares its error:
        # the residual [b]x dtheta + d is zero at the start.
        b = skew(alignment.field_world / alignment.field_norm)
        cov[6:, 6:] = b @ cov[:3, :3] @ b.T
        cov[6:, :3] = -b @ cov[:3, :3]
        cov[:3, 6:] = cov[6:, :3].T


@njit
def _inverse3(m):
    """Inverse of a (3, 3) matrix by its adjugate."""
    c = np.empty((3, 3))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            e, f = (j + 1) % 3, (j + 2) % 3
            c[j, i] = m[a, e] * m[b, f] - m[a, f] * m[b, e]
    det = m[0, 0] * c[0, 0] + m[0, 1] * c[1, 0] + m[0, 2] * c[2, 0]
    return c / det


@njit
def solve_step(rate, rate_next, dt, field, mag, weight, keep, gain):
    """Rotation over one step in the axes of its start: Winkler 2025 (9), Gauss-Newton.

    The paper writes (9) in world axes; turned into those of the step's start it
    is the same least-squares problem with R_n = I. There a gyroscope axis is a row, which
    ``keep`` can leave out where the axis is at its limit (appendix B).

    Args:
        rate, rate_next: (3,) rad/s at both ends, each in its own imu axes.
        dt: s.
        field: (3,) expected field / B0, in the axes of the start.
        mag: (3,) measured field / B0, in the axes of the end.
        weight: w of (10), 0 without a sample.
        keep: (3,) weight of each gyroscope axis: 1, or next to nothing. Not 0: a missing axis
            along the field is in no other row.
        gain: (3, 3) out, attitude correction (axes of the start) per magnetic residual.

    Returns:
        (3,) rotation vector, rad.
    """
    phi = 0.5 * dt * (rate + rate_next)
    normal = np.empty((3, 3))
    rhs = np.empty(3)
    inverse = np.eye(3)
    j_mag = np.zeros((3, 3))
    for _ in range(_ITERATIONS):
        turn = quat_exp(phi)
        rate_end = quat_rotate(turn, rate_next)
        mag_start = quat_rotate(turn, mag)
        left = right_jacobian(-phi)
        # d(Exp(phi) v) = -[Exp(phi) v]x J_left dphi
        j_gyr = np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                a, b = (i + 1) % 3, (i + 2) % 3
                j_gyr[i, j] = -dt * keep[i] * (rate_end[a] * left[b, j] - rate_end[b] * left[a, j])
                j_mag[i, j] = -weight * (mag_start[a] * left[b, j] - mag_start[b] * left[a, j])
            j_gyr[i, i] -= 2.0 * keep[i]
        for i in range(3):
            rhs[i] = 0.0
            for m in range(3):
                f_gyr = keep[m] * (dt * (rate_end[m] + rate[m]) - 2.0 * phi[m])
                f_mag = weight * (mag_start[m] - field[m])
                rhs[i] -= j_gyr[m, i] * f_gyr + j_mag[m, i] * f_mag
            for j in range(3):
                normal[i, j] = 0.0
                for m in range(3):
                    normal[i, j] += j_gyr[m, i] * j_gyr[m, j] + j_mag[m, i] * j_mag[m, j]
        inverse = _inverse3(normal)
        size = 0.0
        for i in range(3):
            step = inverse[i, 0] * rhs[0] + inverse[i, 1] * rhs[1] + inverse[i, 2] * rhs[2]
            phi[i] += step
            size = max(size, abs(step))
        if size < 1e-12:
            break
    for i in range(3):
        for j in range(3):
            gain[i, j] = 0.0
            for m in range(3):
                gain[i, j] -= inverse[i, m] * j_mag[j, m]
    return phi


@njit
def _propagate(cov, r, dt, par, gap_variance):
    """Covariance over one step without correction. cov (9, 9) in place; r (3, 3)."""
    keep = math.exp(-dt / par[P_FIELD_TIME])
    f = np.eye(N)
    for i in range(3):
        for j in range(3):
            f[i, 3 + j] = -r[i, j] * dt
        f[6 + i, 6 + i] = keep
    _transform(cov, f)
    attitude = par[P_GYR_DENSITY] ** 2 * dt + gap_variance
    bias = par[P_BIAS_WALK] ** 2 * dt
    field = par[P_FIELD_SD] ** 2 * (1.0 - keep * keep)
    for i in range(3):
        cov[i, i] += attitude
        cov[3 + i, 3 + i] += bias
        cov[6 + i, 6 + i] += field


@njit
def _transform(cov, f):
    """cov = f cov f' in place."""
    half = np.empty((N, N))
    for i in range(N):
        for j in range(N):
            total = 0.0
            for m in range(N):
                total += f[i, m] * cov[m, j]
            half[i, j] = total
    for i in range(N):
        for j in range(i, N):
            total = 0.0
            for m in range(N):
                total += half[i, m] * f[j, m]
            cov[i, j] = total
            cov[j, i] = total


@njit
def _correct(cov, gain, b, weight, noise_sd):
    """Covariance after a correction of the attitude by ``gain`` (3, 3), world axes.

    The residual is ``weight ([b]x dtheta + d) + noise``, b (3,) the field's direction.
    """
    f = np.eye(N)
    for i in range(3):
        for j in range(3):
            a, c = (j + 1) % 3, (j + 2) % 3
            # ([b]x) column j: b x e_j has b_c at row a and -b_a at row c
            f[i, j] -= weight * (gain[i, a] * b[c] - gain[i, c] * b[a])
            f[i, 6 + j] -= weight * gain[i, j]
    _transform(cov, f)
    variance = (weight * noise_sd) ** 2
    for i in range(3):
        for j in range(3):
            for m in range(3):
                cov[i, j] += gain[i, m] * gain[j, m] * variance


@njit
def _step_as_printed(x, k, par, stamp, sample, row, row_int):
    """step_imu with the rotation of (9)."""
    if not is_newer(k, stamp, sample):
        return 0
    gyr = sample[:3].copy()
    acc = sample[3:6].copy()
    cov = x[COV:COV + N * N].reshape(N, N)
    bias = x[GYR_BIAS:GYR_BIAS + 3]
    rate_next = gyr - bias
    flags = mag_flags(k)
    dt = 0.0
    rate = rate_next
    if k[STARTED]:
        dt = (stamp - k[LAST_STAMP]) * 1e-9
        rate = x[GYR_LAST:GYR_LAST + 3] - bias
    push_rotation(x, k, stamp, quat_exp(rate + rate_next, 0.5 * dt))
    k[LAST_STAMP] = stamp
    k[STARTED] = 1
    x[GYR_LAST:GYR_LAST + 3] = gyr

    gap_variance = 0.0
    if dt > par[P_MAX_GAP]:
        flags |= FLAG_GAP
        k[GAPS] += 1
        gap_variance = min((par[P_GAP_RATE_SD] * dt) ** 2, UNIFORM_VARIANCE)
    clipped = find_limits(x, k, par, gyr)
    if clipped:
        flags |= FLAG_SATURATED | clipped << SATURATED_AXES_SHIFT
        k[SATURATED] += 1

    # The step: gyroscope alone, or with the magnetometer samples that came.
    samples = np.empty((k[PENDING_COUNT], TAKEN_WORDS))
    taken = take_mags(x, k, samples)
    b0 = math.sqrt(x[FIELD] ** 2 + x[FIELD + 1] ** 2 + x[FIELD + 2] ** 2)
    weight = 0.0
    reliability = np.nan
    mag = np.full(3, np.nan)
    field = np.zeros(3)
    unit_mag = np.zeros(3)
    quat = x[Q:Q + 4].copy()
    if taken > 0:
        mag[:] = 0.0
        for i in range(taken):
            mag += np.array(quat_rotate(samples[i, 6:10], samples[i, :3])) / taken
    if taken > 0 and k[HEADING_KNOWN]:
        norm = math.sqrt(mag[0] ** 2 + mag[1] ** 2 + mag[2] ** 2)
        reliability = math.exp(-(par[P_RELIABILITY] * (b0 - norm) / b0) ** 2)
        weight = reliability
        unit_mag = mag / b0
        field = np.array(quat_rotate_inverse(quat, x[FIELD:FIELD + 3])) / b0
    # A step has two ends, and at either an axis can be at its limit.
    missing = (clipped | k[WAS_CLIPPED]) if weight > 0.0 else 0
    k[WAS_CLIPPED] = clipped
    keep = np.ones(3)
    for i in range(3):
        if (missing >> i) & 1:
            keep[i] = _DROPPED
    gain = np.zeros((3, 3))
    phi = solve_step(rate, rate_next, dt, field, unit_mag, weight, keep, gain)
    r = quat_to_matrix(quat_multiply(quat, quat_exp(phi, 0.5)))
    _propagate(cov, r, dt, par, gap_variance)
    for m in range(3):
        if ((clipped | missing) >> m) & 1:
            # It may be as far beyond its limit as this is from zero.
            unseen = (x[LIMIT + m] * dt) ** 2
            for i in range(3):
                for j in range(3):
                    cov[i, j] += r[i, m] * r[j, m] * unseen
    x[Q:Q + 4] = quat_normalize(quat_multiply(quat, quat_exp(phi)))
    if weight > 0.0:
        flags |= FLAG_MAG_USED
        k[MAG_USED] += taken
        r0 = quat_to_matrix(quat)
        gain_world = np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                for m in range(3):
                    for n in range(3):
                        gain_world[i, j] += r0[i, m] * gain[m, n] * r0[j, n]
        _correct(cov, gain_world, x[FIELD:FIELD + 3] / b0, weight,
                 par[P_MAG_SD] / (b0 * math.sqrt(taken)))
    if not k[HEADING_KNOWN]:
        flags |= FLAG_NO_HEADING
    if stamp <= k[ALIGN_UNTIL]:
        flags |= FLAG_ALIGNING

    noise_dt = dt if dt > 0.0 else 1e-2
    var_gyr = np.empty(3)
    bias_var = np.empty(3)
    for i in range(3):
        bias_var[i] = cov[3 + i, 3 + i]
        var_gyr[i] = par[P_GYR_DENSITY] ** 2 / noise_dt + bias_var[i]
        if (clipped >> i) & 1:
            var_gyr[i] += x[LIMIT + i] ** 2
            if weight > 0.0 and dt > 0.0:
                rate_next[i] = phi[i] / dt
    write_row(row, row_int, par, stamp, x[Q:Q + 4], cov[:3, :3], rate_next, var_gyr, acc,
              par[P_ACC_DENSITY] ** 2 / noise_dt + par[P_ACC_BIAS_SD] ** 2, bias, bias_var,
              mag, reliability, flags, taken)
    return 1


@njit
def step_imu(x, k, par, stamp, sample, row, row_int):
    """One Imu sample through the filter.

    Args:
        x, k, par: state and parameters, in place.
        stamp: int64 ns.
        sample: (6,) rate rad/s, specific force m/s^2.
        row, row_int: float and integer view of the output row.

    Returns:
        1 if a row was written, 0 if the sample was refused (not finite, or not
        newer than the last).
    """
    if not k[AS_PRINTED]:
        return min(fusion.step_imu(x, k, par, stamp, sample, row, row_int), 1)
    return _step_as_printed(x, k, par, stamp, sample, row, row_int)


@njit
def run_loop(x, k, par, imu_stamps, samples, mag_stamps, mags, rows, rows_int):
    """Whole logs in merge order: a magnetometer sample before the Imu of the same stamp.

    Returns the number of rows written.
    """
    written = 0
    j = 0
    for i in range(len(imu_stamps)):
        while j < len(mag_stamps) and mag_stamps[j] <= imu_stamps[i]:
            push_mag(x, k, par, mag_stamps[j], mags[j])
            j += 1
        written += step_imu(x, k, par, imu_stamps[i], samples[i], rows[written],
                            rows_int[written])
    while j < len(mag_stamps):
        push_mag(x, k, par, mag_stamps[j], mags[j])
        j += 1
    return written
