"""Orientation from gyroscope and magnetometer alone: Winkler 2025, eqs. (5)-(11), as printed.

Per sample, the rotation over the step is the least-squares solution of the
midpoint rule for the rates (6) and of the constancy of the field (8), solved by
Gauss-Newton. A covariance of [attitude error in world axes, gyroscope bias,
field error relative to its norm] goes alongside: the gain of the paper is not the
optimal one, so the covariance is updated in the form that holds for any gain.

That is ``gyro_mag.as_printed``. Without it, method ``gyro_mag`` is the error-state filter (fusion)
without its accelerometer: the same two sets of rows are weighted by their covariances instead of
by 2 and w, and solved together with the slow states of gyroscope and magnetometer.
"""

import math

import numpy as np

from imu_fusion.estimation.orientation import gyro_limit, imu_rejection, mag_queue, rotation_history
from imu_fusion.estimation.orientation.alignment import Alignment
from imu_fusion.estimation.orientation.error_state import UNIFORM_VARIANCE
from imu_fusion.estimation.orientation.rows import (
    FLAG_GAP,
    FLAG_MAG_USED,
    FLAG_SATURATED,
    SATURATED_AXES_SHIFT,
    finish,
)
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_matrix,
    right_jacobian,
    skew,
)
from imu_fusion.kernels import njit

N = 9    # of state.PRINTED: attitude, bias, relative field

# Gauss-Newton converges quadratically from the gyroscope's own rotation; the
# limit is reached only by steps of more than a radian.
_ITERATIONS = 8
# Weight of a gyroscope row that is left out. The field's rows outweigh it but within half a
# degree of the field's own direction.
_DROPPED = 0.01
_FIRST_DT = 1e-2           # s: step that stands in for the one before the first sample


def initialise(state: np.ndarray, alignment: Alignment) -> None:
    """Start from an Alignment. state (1,): zeroed."""
    s, printed = state[0], state[0]["printed"]
    s["gyro_bias"] = alignment.gyr_bias
    s["heading_known"] = alignment.has_heading
    cov = printed["cov"]
    cov[:3, :3] = alignment.cov_attitude_world
    cov[3:6, 3:6] = np.eye(3) * alignment.gyr_bias_sd ** 2
    if alignment.field_world is not None:
        printed["field_world"] = alignment.field_world
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
def _normal_equations(eq, phi, j_mag, normal, rhs):
    """Of (9) linearised at the rotation phi (3,): J'J, -J'f; j_mag gets the field's rows of J."""
    dt, keep, weight = eq.dt, eq.keep, eq.weight
    turn = quat_exp(phi, 1.0)
    rate_end = quat_rotate(turn, eq.rate_next)
    mag_start = quat_rotate(turn, eq.mag)
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
            f_gyr = keep[m] * (dt * (rate_end[m] + eq.rate[m]) - 2.0 * phi[m])
            f_mag = weight * (mag_start[m] - eq.field[m])
            rhs[i] -= j_gyr[m, i] * f_gyr + j_mag[m, i] * f_mag
        for j in range(3):
            normal[i, j] = 0.0
            for m in range(3):
                normal[i, j] += j_gyr[m, i] * j_gyr[m, j] + j_mag[m, i] * j_mag[m, j]


@njit
def solve_step(eq, gain):
    """Rotation over one step in the axes of its start: Winkler 2025 (9), Gauss-Newton.

    Args:
        eq: a state.EQUATION.
        gain: (3, 3) out, attitude correction (axes of the start) per magnetic residual.

    Returns:
        (3,) rotation vector, rad.
    """
    phi = np.empty(3)
    for i in range(3):
        phi[i] = 0.5 * eq.dt * (eq.rate[i] + eq.rate_next[i])
    normal = np.empty((3, 3))
    rhs = np.empty(3)
    inverse = np.eye(3)
    j_mag = np.zeros((3, 3))
    for _ in range(_ITERATIONS):
        _normal_equations(eq, phi, j_mag, normal, rhs)
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
def _propagate(cov, r, dt, p, gap_variance):
    """Covariance over one step without correction. cov (9, 9) in place; r (3, 3)."""
    keep = math.exp(-dt / p.gyro_mag.field_time)
    f = np.eye(N)
    for i in range(3):
        for j in range(3):
            f[i, 3 + j] = -r[i, j] * dt
        f[6 + i, 6 + i] = keep
    _transform(cov, f)
    attitude = p.sensor.gyro_noise_density ** 2 * dt + gap_variance
    bias = p.sensor.gyro_bias_walk ** 2 * dt
    field = p.gyro_mag.field_sd ** 2 * (1.0 - keep * keep)
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
def step(s, p, stamp, sample, row):
    """One Imu sample through the method as printed; see fusion.step. Returns 0 or 1."""
    if imu_rejection.is_refused(s, stamp, sample):
        return 0
    eq = s.printed.equation
    gap_variance = _begin_step(s, p, stamp, sample, eq)
    b0 = _weigh_mags(s, p, eq)
    step, printed = s.step, s.printed
    # A step has two ends, and at either an axis can be at its limit.
    missing = (step.clipped | printed.was_clipped) if eq.weight > 0.0 else 0
    printed.was_clipped = step.clipped
    for i in range(3):
        eq.keep[i] = _DROPPED if (missing >> i) & 1 else 1.0
    gain = np.zeros((3, 3))
    phi = solve_step(eq, gain)
    middle = quat_to_matrix(quat_multiply(s.quat_world_imu, quat_exp(phi, 0.5)))
    _propagate(printed.cov, middle, step.dt, p, gap_variance)
    _allow_for_missing(s, middle, step.clipped | missing)
    if eq.weight > 0.0:
        step.flags |= FLAG_MAG_USED
        s.counts.mag_used += step.mag_count
        _correct_in_world(s, p, gain, eq.weight, b0)
    s.quat_world_imu[:] = quat_normalize(quat_multiply(s.quat_world_imu, quat_exp(phi, 1.0)))
    _write(s, p, row, eq, phi)
    return 1


@njit
def _begin_step(s, p, stamp, sample, eq):
    """Fill ``s.step`` with the sample, and the equation's rates. Returns the variance, rad^2, of
    what may have gone unseen in a gap."""
    step = s.step
    step.flags = s.waiting_flags
    s.waiting_flags = 0
    for i in range(3):
        step.gyr[i] = sample[i]
        step.acc[i] = sample[3 + i]
        eq.rate_next[i] = step.gyr[i] - s.gyro_bias[i]
        eq.rate[i] = s.gyr_last[i] - s.gyro_bias[i] if s.started else eq.rate_next[i]
        s.gyr_last[i] = step.gyr[i]
    step.dt = eq.dt = (stamp - s.stamp) * 1e-9 if s.started else 0.0
    twice = (eq.rate[0] + eq.rate_next[0], eq.rate[1] + eq.rate_next[1],
             eq.rate[2] + eq.rate_next[2])
    rotation_history.push(s.history, stamp, quat_exp(twice, 0.5 * step.dt))
    s.stamp = stamp
    s.started = True
    gap_variance = 0.0
    if step.dt > p.gap.max:
        step.flags |= FLAG_GAP
        s.counts.gaps += 1
        gap_variance = min((p.gap.rate_sd * step.dt) ** 2, UNIFORM_VARIANCE)
    step.clipped = gyro_limit.find(s.gyro_limit, p.sensor.gyro_range, step.gyr[:])
    if step.clipped:
        step.flags |= FLAG_SATURATED | step.clipped << SATURATED_AXES_SHIFT
        s.counts.saturated += 1
    return gap_variance


@njit
def _weigh_mags(s, p, eq):
    """The magnetometer samples that came, as the field's part of the equation, with the weight of
    (10). Returns B0, T."""
    step, expected = s.step, s.printed.field_world
    b0 = math.sqrt(expected[0] ** 2 + expected[1] ** 2 + expected[2] ** 2)
    taken = np.empty(s.queue.count, mag_queue.TAKEN)
    count = mag_queue.take(s, taken)
    step.mag_count = count
    step.reliability = np.nan
    eq.weight = 0.0
    for i in range(3):
        step.mag[i] = 0.0 if count > 0 else np.nan
        eq.field[i] = eq.mag[i] = 0.0
    for n in range(count):
        now = quat_rotate(taken[n].turn, taken[n].field)
        for i in range(3):
            step.mag[i] += now[i] / count
    if count > 0 and s.heading_known:
        mag = step.mag
        norm = math.sqrt(mag[0] ** 2 + mag[1] ** 2 + mag[2] ** 2)
        step.reliability = math.exp(-(p.mag.reliability * (b0 - norm) / b0) ** 2)
        eq.weight = step.reliability
        there = quat_rotate_inverse(s.quat_world_imu, expected)
        for i in range(3):
            eq.mag[i] = mag[i] / b0
            eq.field[i] = there[i] / b0
    return b0


@njit
def _allow_for_missing(s, middle, missing):
    """Axes (bits) at their limit may be as far beyond it as it is from zero."""
    cov = s.printed.cov
    for m in range(3):
        if (missing >> m) & 1:
            unseen = (s.gyro_limit.limit[m] * s.step.dt) ** 2
            for i in range(3):
                for j in range(3):
                    cov[i, j] += middle[i, m] * middle[j, m] * unseen


@njit
def _correct_in_world(s, p, gain, weight, b0):
    """:func:`_correct` by a gain (3, 3) in the axes of the step's start."""
    r = quat_to_matrix(s.quat_world_imu)
    gain_world = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for m in range(3):
                for n in range(3):
                    gain_world[i, j] += r[i, m] * gain[m, n] * r[j, n]
    b = s.printed.field_world
    _correct(s.printed.cov, gain_world, (b[0] / b0, b[1] / b0, b[2] / b0), weight,
             p.sensor.mag_noise_sd / (b0 * math.sqrt(s.step.mag_count)))


@njit
def _write(s, p, row, eq, phi):
    """The output row after a step by phi (3,)."""
    step, cov = s.step, s.printed.cov
    noise_dt = step.dt if step.dt > 0.0 else _FIRST_DT
    cov_world = np.empty((3, 3))
    for i in range(3):
        bias_var = cov[3 + i, 3 + i]
        rate = eq.rate_next[i]
        var_gyr = p.sensor.gyro_noise_density ** 2 / noise_dt + bias_var
        if (step.clipped >> i) & 1:
            var_gyr += s.gyro_limit.limit[i] ** 2
            if eq.weight > 0.0 and step.dt > 0.0:
                rate = phi[i] / step.dt
        for j in range(3):
            cov_world[i, j] = cov[i, j]
        row.gyr[i] = rate
        row.cov_gyr[i, i] = var_gyr
        row.gyr_bias_sd[i] = math.sqrt(max(bias_var, 0.0))
    finish(row, s, p, p.sensor.acc_noise_density ** 2 / noise_dt + p.sensor.acc_bias_sd ** 2,
           cov_world)
