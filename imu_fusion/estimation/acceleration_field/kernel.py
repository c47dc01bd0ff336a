"""Kernels of the rigid-body estimator of acceleration fields (numba).

State of n = 18 + m numbers, for m measured channels:

    0:3    theta   local attitude error, q_true = quat * Exp(theta)
    3:6    omega   angular velocity, body axes
    6:9    alpha   angular acceleration, body axes
    9:12   its rate
    12:15  a       acceleration (or specific force) at the reference point, body axes
    15:18  its rate
    18:    bias    one per channel

An accelerometer channel along the unit vector u at the position r from the reference point
reads ``u . (a + alpha x r + omega x (omega x r)) + bias`` (Rahaman 2019, eq. (2.33) in body
axes), a gyroscope channel ``u . omega + bias``. alpha is a Matern process (or, with rate zero,
an integrated Wiener process), the rate of a is a Wiener process.
Measurements enter one channel at a time, so that no matrix is inverted; each touches at most
ten states.
"""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.acceleration_field.rows import (GAP, HELD, MISSING, SATURATED, put_row,
                                                           rigid_gradient)
from imu_fusion.geometry.rotation import (quat_exp, quat_multiply, quat_normalize, quat_to_matrix,
                                          right_jacobian)

OMEGA, ALPHA, ACC, BIAS = 3, 6, 12, 18
# States that one channel touches: omega, alpha, a and its own bias.
TOUCHED = 10


# Gauss-Legendre rule on [0, 1]: exact for the degree that a chain of four integrators needs.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


@njit
def _generate(v, rate):
    """Time derivative of the chain (angle, omega, alpha, jerk) v (4,), without noise."""
    return np.array([v[1], v[2], v[3], -rate * rate * v[2] - 2.0 * rate * v[3]])


@njit
def _propagate(v, rate, dt):
    """v (4,) after dt, by its Taylor series; for rate * dt up to one half."""
    total, term = v.copy(), v.copy()
    for k in range(1, 16):
        term = _generate(term, rate) * (dt / k)
        total = total + term
    return total


@njit
def motion_step(dt, rate):
    """Transition (4, 4) and unit-noise covariance (4, 4) of one axis over dt, exactly.

    The chain is angle, omega, alpha, jerk with ``jerk' = -rate^2 alpha - 2 rate jerk + noise``:
    alpha is a Matern process of smoothness 3/2; with rate 0 the jerk is a Wiener process. Short
    steps by quadrature, long ones by doubling them, so that any gap is fine.
    """
    doublings = 0
    while rate * dt > 0.5 * 2.0 ** doublings:
        doublings += 1
    h = dt / 2.0 ** doublings
    step = np.zeros((4, 4))
    for k in range(4):
        unit = np.zeros(4)
        unit[k] = 1.0
        step[:, k] = _propagate(unit, rate, h)
    noise = np.zeros((4, 4))
    for k in range(len(_NODES)):
        response = _propagate(np.array([0.0, 0.0, 0.0, 1.0]), rate, h * _NODES[k])
        noise += (h * _WEIGHTS[k]) * np.outer(response, response)
    for _ in range(doublings):
        noise = step @ noise @ step.T + noise
        step = step @ step
    return step, noise


@njit
def mean_rotation(dt, step, x):
    """Rotation vector (3,) over a step of the mean x, by the Magnus expansion to the fourth
    order (Iserles et al. 2000): the integral of the body rate and the commutator of its ends."""
    w = x[3:6]
    integral = step[0, 1] * w + step[0, 2] * x[6:9] + step[0, 3] * x[9:12]
    last = w + step[1, 2] * x[6:9] + step[1, 3] * x[9:12]
    return integral + (dt * dt / 12.0) * np.cross(w, last)


@njit
def transition(phi):
    """Blocks of the transition matrix of theta: (Exp(-phi), right Jacobian). Both (3, 3)."""
    return np.ascontiguousarray(quat_to_matrix(quat_exp(phi)).T), right_jacobian(phi)


@njit
def multiply_transition(m, dt, step, turn, jac):
    """m <- F m in place, m: (n, c)."""
    for c in range(m.shape[1]):
        t0, t1, t2 = m[0, c], m[1, c], m[2, c]
        d0 = step[0, 1] * m[3, c] + step[0, 2] * m[6, c] + step[0, 3] * m[9, c]
        d1 = step[0, 1] * m[4, c] + step[0, 2] * m[7, c] + step[0, 3] * m[10, c]
        d2 = step[0, 1] * m[5, c] + step[0, 2] * m[8, c] + step[0, 3] * m[11, c]
        for i in range(3):
            m[i, c] = (turn[i, 0] * t0 + turn[i, 1] * t1 + turn[i, 2] * t2
                       + jac[i, 0] * d0 + jac[i, 1] * d1 + jac[i, 2] * d2)
            alpha, jerk = m[6 + i, c], m[9 + i, c]
            m[3 + i, c] += step[1, 2] * alpha + step[1, 3] * jerk
            m[6 + i, c] = step[2, 2] * alpha + step[2, 3] * jerk
            m[9 + i, c] = step[3, 2] * alpha + step[3, 3] * jerk
            m[12 + i, c] += dt * m[15 + i, c]


@njit
def multiply_transition_transposed(m, dt, step, turn, jac):
    """m <- F' m in place, m: (n, c)."""
    for c in range(m.shape[1]):
        t0, t1, t2 = m[0, c], m[1, c], m[2, c]
        for i in range(3):
            d = jac[0, i] * t0 + jac[1, i] * t1 + jac[2, i] * t2
            omega, alpha, jerk = m[3 + i, c], m[6 + i, c], m[9 + i, c]
            m[i, c] = turn[0, i] * t0 + turn[1, i] * t1 + turn[2, i] * t2
            m[3 + i, c] = omega + step[0, 1] * d
            m[6 + i, c] = (step[0, 2] * d + step[1, 2] * omega + step[2, 2] * alpha
                           + step[3, 2] * jerk)
            m[9 + i, c] = (step[0, 3] * d + step[1, 3] * omega + step[2, 3] * alpha
                           + step[3, 3] * jerk)
            m[15 + i, c] += dt * m[12 + i, c]


@njit
def predict(x, cov, quat, dt, step, noise, jerk_density, acc_density, bias_walk):
    """Move state (n,), covariance (n, n) and quaternion (4,) on by dt, in place.

    step, noise: of :func:`motion_step`. jerk_density, acc_density: densities of the noise that
    drives the rates of alpha and a. bias_walk: (m,) densities of the random walks of the biases.
    Returns the mean rotation (3,).
    """
    phi = mean_rotation(dt, step, x)
    turn, jac = transition(phi)
    quat[:] = quat_normalize(quat_multiply(quat, quat_exp(phi)))
    for i in range(3):
        alpha, jerk = x[6 + i], x[9 + i]
        x[3 + i] += step[1, 2] * alpha + step[1, 3] * jerk
        x[6 + i] = step[2, 2] * alpha + step[2, 3] * jerk
        x[9 + i] = step[3, 2] * alpha + step[3, 3] * jerk
        x[12 + i] += dt * x[15 + i]
    multiply_transition(cov, dt, step, turn, jac)
    half = np.ascontiguousarray(cov.T)
    multiply_transition(half, dt, step, turn, jac)
    for i in range(len(x)):
        for j in range(i, len(x)):
            mean = 0.5 * (half[i, j] + half[j, i])
            cov[i, j] = mean
            cov[j, i] = mean
    q = acc_density * acc_density
    for i in range(3):
        for k in range(4):
            for l in range(4):
                cov[3 * k + i, 3 * l + i] += jerk_density * jerk_density * noise[k, l]
        cov[12 + i, 12 + i] += q * dt ** 3 / 3.0
        cov[12 + i, 15 + i] += 0.5 * q * dt * dt
        cov[15 + i, 12 + i] += 0.5 * q * dt * dt
        cov[15 + i, 15 + i] += q * dt
    for c in range(len(bias_walk)):
        cov[18 + c, 18 + c] += bias_walk[c] * bias_walk[c] * dt
    return phi


@njit
def gap_variance(omega, dt):
    """Variances (attitude, omega) that a gap adds: the body may have stopped or turned twice as
    fast, and turned to anywhere."""
    speed2 = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
    return min(speed2 * dt * dt, math.pi * math.pi), speed2


@njit
def reopen(x, cov, dt, spread):
    """After a gap: omega and attitude are held, wider by :func:`gap_variance`; accelerations and
    their rates are as unknown as at the start, with standard deviations ``spread`` (4,) of
    alpha, its rate, a and its rate; biases stay. In place."""
    turned, speed2 = gap_variance(x[3:6], dt)
    kept = cov[3:6, 3:6].copy()
    cov[3:18, :] = 0.0
    cov[:, 3:18] = 0.0
    cov[3:6, 3:6] = kept
    for i in range(3):
        cov[i, i] += turned
        cov[3 + i, 3 + i] += speed2
        for k in range(4):
            x[6 + 3 * k + i] = 0.0
            cov[6 + 3 * k + i, 6 + 3 * k + i] = spread[k] * spread[k]


@njit
def channel_row(is_gyro, u, r, c, omega, index, h):
    """Indices and values of the row of channel c, linearised at omega.

    Returns (number of entries, constant): the reading is h . x[index] + constant.
    """
    if is_gyro:
        for i in range(3):
            index[i] = OMEGA + i
            h[i] = u[i]
        index[3] = BIAS + c
        h[3] = 1.0
        return 4, 0.0
    uw = u[0] * omega[0] + u[1] * omega[1] + u[2] * omega[2]
    rw = r[0] * omega[0] + r[1] * omega[1] + r[2] * omega[2]
    ur = u[0] * r[0] + u[1] * r[1] + u[2] * r[2]
    for i in range(3):
        index[i] = OMEGA + i
        h[i] = u[i] * rw + r[i] * uw - 2.0 * ur * omega[i]
        index[3 + i] = ALPHA + i
        j, k = (i + 1) % 3, (i + 2) % 3
        h[3 + i] = r[j] * u[k] - r[k] * u[j]
        index[6 + i] = ACC + i
        h[6 + i] = u[i]
    index[9] = BIAS + c
    h[9] = 1.0
    # The centripetal part is quadratic, so its value is half its gradient times omega.
    return 10, -0.5 * (h[0] * omega[0] + h[1] * omega[1] + h[2] * omega[2])


@njit
def scalar_update(x, cov, index, h, count, innovation, variance, column):
    """Kalman update by one scalar with a sparse row, in place; ``column`` receives P H'.

    Returns the innovation variance.
    """
    n = len(x)
    for i in range(n):
        s = 0.0
        for k in range(count):
            s += cov[index[k], i] * h[k]
        column[i] = s
    total = variance
    for k in range(count):
        total += h[k] * column[index[k]]
    for i in range(n):
        gain = column[i] / total
        x[i] += gain * innovation
        for j in range(n):
            cov[i, j] -= gain * column[j]
    return total


@njit
def update(x, cov, reading, is_gyro, direction, lever, variance, ranges, at, trace_column,
           trace_total, trace_innovation, trace_row):
    """All channels of one sample, linearised at the angular velocity ``at`` (3,), in place.

    reading: (m,) with NaN for missing channels; a channel at its range is not used. The traces,
    rows of one sample, keep what the smoother needs; a total of zero marks an unused channel.

    Returns (sum of squared normalised innovations, log likelihood, channels used, flags).
    """
    index = np.empty(TOUCHED, np.int64)
    row = np.empty(TOUCHED)
    squares, log_likelihood, used, flag = 0.0, 0.0, 0, 0
    for c in range(len(variance)):
        trace_total[c] = 0.0
        if math.isnan(reading[c]):
            flag |= MISSING
            continue
        if abs(reading[c]) >= ranges[c]:
            flag |= SATURATED
            continue
        count, constant = channel_row(is_gyro[c], direction[c], lever[c], c, at, index, row)
        innovation = reading[c] - constant
        for k in range(count):
            innovation -= row[k] * x[index[k]]
        total = scalar_update(x, cov, index, row, count, innovation, variance[c],
                              trace_column[c])
        trace_total[c] = total
        trace_innovation[c] = innovation
        trace_row[c] = row
        squares += innovation * innovation / total
        log_likelihood -= 0.5 * (math.log(2.0 * math.pi * total) + innovation * innovation / total)
        used += 1
    return squares, log_likelihood, used, flag


@njit
def forward(x, cov, quat, last, stamp, readings, is_gyro, direction, lever, variance, ranges,
            bias_walk, jerk_density, motion_rate, acc_density, max_gap, spread, at, fixed_at,
            reference, gravity, specific_force, values, flags, trace):
    """Filter n samples in order, in place; one row of values (n, 71) and flags (n,) each.

    last: (1,) int64 stamp of the previous sample, negative before the first. at: (n, 3)
    angular velocities to linearise at if ``fixed_at``, else each prediction is used. spread: see
    :func:`reopen`. trace: a tuple of arrays (x, cov, phi, dt, columns, totals, innovations,
    rows) of n samples, or of one sample when it is not wanted (then values are written
    instead); dt is negative across a gap.

    Returns the log likelihood of the readings.
    """
    xs, covs, phis, dts, columns, totals, innovations, rows = trace
    step, noise = motion_step(0.0, motion_rate)
    stepped = 0.0
    keep = len(values) == 0
    likelihood = 0.0
    for n in range(len(stamp)):
        k = n if keep else 0
        flag = 0
        dts[k] = 0.0
        if last[0] >= 0:
            dt = (stamp[n] - last[0]) * 1e-9
            if dt > max_gap:
                flag |= GAP
                reopen(x, cov, dt, spread)
                phis[k] = 0.0
                dts[k] = -dt
            else:
                if dt != stepped:
                    step, noise = motion_step(dt, motion_rate)
                    stepped = dt
                phis[k] = predict(x, cov, quat, dt, step, noise, jerk_density, acc_density,
                                  bias_walk)
                dts[k] = dt
        last[0] = stamp[n]
        where = at[n].copy() if fixed_at else x[3:6].copy()
        squares, log_likelihood, used, seen = update(
            x, cov, readings[n], is_gyro, direction, lever, variance, ranges, where,
            columns[k], totals[k], innovations[k], rows[k])
        likelihood += log_likelihood
        if keep:
            xs[k] = x
            covs[k] = cov
        quat[:] = quat_normalize(quat_multiply(quat, quat_exp(x[0:3])))
        x[0:3] = 0.0
        if not keep:
            flag |= seen
            residual = math.nan
            if used > 0:
                residual = math.sqrt(squares / used)
            else:
                flag |= HELD
            put_row(values[n], rigid_gradient(x[3:6], x[6:9]), x[:18],
                    np.ascontiguousarray(cov[:18, :18]), quat, reference, gravity,
                    specific_force, residual)
            flags[n] = flag
    return likelihood


@njit
def backward(adjoint, information, trace, motion_rate, is_gyro, direction, lever, smoothed,
             smoothed_cov):
    """Modified Bryson-Frazier smoother over the n samples of a trace (Bierman 1977), in place.

    adjoint (n_x, 1) and information (n_x, n_x) carry on from the samples after these and end
    before these. It inverts nothing, so constant biases and exact starts need no care.

    smoothed: (n, n_x); its theta is relative to the predicted attitude. smoothed_cov:
    (n, 18, 18).
    """
    xs, covs, phis, dts, columns, totals, innovations, rows = trace
    index = np.empty(TOUCHED, np.int64)
    unused = np.empty(TOUCHED)
    for n in range(len(xs) - 1, -1, -1):
        # With the filtered covariance rather than the predicted one: the difference of two
        # small numbers keeps the digits that a wide prior would cost.
        smoothed[n] = xs[n] - (covs[n] @ adjoint)[:, 0]
        part = np.ascontiguousarray(covs[n][:18])
        smoothed_cov[n] = part[:, :18] - part @ information @ part.T
        for c in range(totals.shape[1] - 1, -1, -1):
            total = totals[n, c]
            if total == 0.0:
                continue
            count, _ = channel_row(is_gyro[c], direction[c], lever[c], c, unused, index, unused)
            row = rows[n, c]
            gain = columns[n, c] / total
            spread = information @ gain
            quadratic = 1.0 / total + np.dot(gain, spread)
            pull = innovations[n, c] / total
            for j in range(len(gain)):
                pull += gain[j] * adjoint[j, 0]
            for k in range(count):
                i, h = index[k], row[k]
                adjoint[i, 0] -= h * pull
                for j in range(len(gain)):
                    information[i, j] -= h * spread[j]
                    information[j, i] -= h * spread[j]
            for k in range(count):
                for l in range(count):
                    information[index[k], index[l]] += row[k] * row[l] * quadratic
        if dts[n] < 0.0:
            # Across a gap, only attitude, omega and biases are the same state.
            adjoint[6:18] = 0.0
            information[6:18, :] = 0.0
            information[:, 6:18] = 0.0
        if dts[n] > 0.0:
            step, _ = motion_step(dts[n], motion_rate)
            turn, jac = transition(phis[n])
            multiply_transition_transposed(adjoint, dts[n], step, turn, jac)
            multiply_transition_transposed(information, dts[n], step, turn, jac)
            half = np.ascontiguousarray(information.T)
            multiply_transition_transposed(half, dts[n], step, turn, jac)
            information[:] = 0.5 * (half + half.T)
