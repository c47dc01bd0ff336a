"""Forward filter and inverse-free backward pass over a linearised trajectory (numba).

The forward pass is a Kalman filter of the deviation from a nominal trajectory, with
scalar updates of whitened rows. The backward pass is the modified Bryson-Frazier form
(Bierman, *Factorization Methods for Discrete Sequential Estimation*, ch. X): an adjoint
vector and matrix run backwards, and neither needs a covariance to be inverted, so
singular process noise and exactly known states do no harm.

Memory: the filter keeps the deviation and covariance at the first sample of each
segment only; the backward pass runs each segment forward once more to get what it
needs. Both runs execute the same operations, so they agree bit for bit.
"""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.smoother.model import (ATT, BLOCKS, BODY_HEIGHT, CORE, FIX,
                                                  LEVER_ARM, POS, SURFACE_ARM, VEL, VELOCITY,
                                                  interval, predict_fix, predict_mag,
                                                  predict_velocity)
from imu_fusion.estimation.smoother.transition import (adjoint_rows, apply_step, boxminus,
                                                       boxplus, interval_noise, propagate_cov,
                                                       propagate_rows, slow_noise)

#: Longest list of non-zero entries of a row: all states, should one not be finite.
MAX_ENTRIES = CORE + sum(width for _, width in BLOCKS)

#: Samples kept at once by the backward pass.
SEGMENT = 128

#: Variances of the slow states are computed for every so many samples.
THINNING = 16


@njit
def filter_segment(first, last, follow, x, delta, cov, motion, measured, rows, innovation,
                   storage):
    """Filter samples first <= k < last; ``delta`` and ``cov`` are those before the rows of
    ``first`` on entry, before the rows of ``last`` on return.

    Args:
        follow: the nominal trajectory follows the filter (extended Kalman filter, writes x)
            instead of being kept (linear pass about x).
        x: nominal states (N, n + 1).
        motion: steps dt (N - 1,) s; means of gyr and acc (N - 1, 6); their noise variance
            densities (N - 1, 6); gravity; Earth rate (3,); decay rates (n,) and walk variance densities (n,) of
            the slow states; layout; columns of the transition matrix in use; magnetic field
            (3,); lever arm (3,).
        measured: sorted by sample: start (N + 1,), kind, tau, value (M, 3), whitening matrix
            (M, 3, 3), squared scale of the robust loss (inf: squared loss).
        rows: constraints sorted by sample: start (N + 1,), residual, gradient (r, 3), sigma,
            height. Where not the sensor itself is held on the surface, the gradient goes on with
            the derivatives to the attitude (r, 6) and the surface lever arm (r, 9).
        innovation: (M, 3) normalised innovations, result.
        storage: what the backward pass needs (:func:`make_storage`): entries, indices, count,
            gain, value and start of the rows; deviation and covariance after the rows; rows
            of the transition matrix and noise of the interval. Filled unless it was made for
            no sample.

    Returns:
        Sum of the losses of all rows at the nominal trajectory.
    """
    stamps, inputs, noise, gravity, spin, rates, walks, layout, columns, field, lever_arm = motion
    m_start, m_kind, m_tau, m_value, m_whiten, m_loss = measured
    c_start, c_residual, c_gradient, c_sigma, c_height = rows
    (r_entries, r_index, r_count, r_gain, r_value, r_start, s_delta, s_cov, s_vel, s_att,
     s_spread) = storage
    store = len(s_delta) > 0
    n = len(delta)
    n_total = len(x)
    f_vel, f_att = np.zeros((3, n)), np.zeros((3, n))
    x_next, rate, force = np.empty(n + 1), np.empty(3), np.empty(3)
    rotation, middle, spread = np.eye(3), np.eye(3), np.empty((3, 3))
    decay, work = np.ones(n), np.empty((n, n))
    column, column_out, defect = np.empty((n, 1)), np.empty((n, 1)), np.empty(n)
    h, gain, residual = np.zeros((3, n)), np.empty(n), np.empty(3)
    entries, used = np.empty(MAX_ENTRIES), np.empty(MAX_ENTRIES, np.int64)
    lever = lever_arm.copy()
    cost, dt = 0.0, 0.0
    n_rows = 0
    for k in range(first, last):
        has_interval = k < n_total - 1
        if has_interval:
            dt = stamps[k]
            for i in range(9, n):
                decay[i] = 1.0 if rates[i] == 0.0 else math.exp(-rates[i] * dt)
            rotation, middle = interval(x[k], inputs[k, 0:3], inputs[k, 3:6], dt, gravity, spin, decay,
                                        layout, f_vel, f_att, x_next, rate, force)
        if layout[LEVER_ARM] >= 0:
            for i in range(3):
                lever[i] = x[k, layout[LEVER_ARM] + 1 + i]
        if store:
            r_start[k - first] = n_rows
        for m in range(m_start[k], m_start[k + 1]):
            h[:] = 0.0
            kind, tau = m_kind[m], m_tau[m]
            if kind == FIX:
                predicted = predict_fix(x[k], tau, rate, force, rotation, lever, layout, h)
            elif kind == VELOCITY:
                predicted = predict_velocity(x[k], tau, dt, rate, force, rotation, f_vel, columns,
                                             lever, layout, h)
            else:
                predicted = predict_mag(x[k], tau, rate, rotation, field, layout, h)
            # Whitening keeps the rows of one measurement independent.
            squares = 0.0
            for i in range(3):
                residual[i] = 0.0
                for j in range(i + 1):
                    residual[i] += m_whiten[m, i, j] * (m_value[m, j] - predicted[j])
            for i in range(2, -1, -1):
                for c in range(n):
                    total = 0.0
                    for j in range(i + 1):
                        total += m_whiten[m, i, j] * h[j, c]
                    h[i, c] = total
            for i in range(3):
                scale = 1.0
                if follow:
                    # The filter judges an outlier by what it expects, not by the noise alone.
                    for a in range(n):
                        if h[i, a] != 0.0:
                            for b in range(n):
                                scale += h[i, a] * cov[a, b] * h[i, b]
                squares += residual[i] * residual[i] / scale
            weight = 1.0
            if m_loss[m] < np.inf:
                weight = 1.0 / math.sqrt(1.0 + squares / m_loss[m])
                cost += m_loss[m] * math.log(1.0 + squares / m_loss[m])
            else:
                cost += squares
            for i in range(3):
                count = 0
                for c in range(n):
                    if h[i, c] != 0.0:
                        entries[count] = weight * h[i, c]
                        used[count] = c
                        count += 1
                value, root = _update(delta, cov, entries, used, count,
                                      weight * residual[i], gain)
                innovation[m, i] = value
                if store:
                    _store_row(n_rows, entries, used, count, gain, value, root, r_entries,
                               r_index, r_count, r_gain, r_value)
                    n_rows += 1
        for c in range(c_start[k], c_start[k + 1]):
            count = 0
            gap = -c_residual[c]
            for i in range(c_gradient.shape[1]):
                if c_gradient[c, i] != 0.0:
                    entries[count] = c_gradient[c, i] / c_sigma[c]
                    if i < 3:
                        used[count] = POS + i
                    elif i < 6:
                        used[count] = ATT + i - 3
                    else:
                        used[count] = layout[SURFACE_ARM] + i - 6
                    count += 1
            if c_height[c] and layout[BODY_HEIGHT] >= 0:
                gap += x[k, layout[BODY_HEIGHT] + 1]
                entries[count] = -1.0 / c_sigma[c]
                used[count] = layout[BODY_HEIGHT]
                count += 1
            cost += (gap / c_sigma[c]) ** 2
            value, root = _update(delta, cov, entries, used, count, gap / c_sigma[c], gain)
            if store:
                _store_row(n_rows, entries, used, count, gain, value, root, r_entries,
                           r_index, r_count, r_gain, r_value)
                n_rows += 1
        if follow:
            boxplus(x[k], delta)
            delta[:] = 0.0
            if has_interval:
                rotation, middle = interval(x[k], inputs[k, 0:3], inputs[k, 3:6], dt, gravity, spin,
                                            decay, layout, f_vel, f_att, x_next, rate, force)
        if store:
            r_start[k - first + 1] = n_rows
            s_delta[k - first] = delta
            s_cov[k - first] = cov
        if not has_interval:
            continue
        if follow:
            x[k + 1] = x_next
        else:
            boxminus(x_next, x[k + 1], defect)
            column[:, 0] = delta
            propagate_rows(column, column_out, dt, decay, f_vel, f_att, columns)
            for i in range(n):
                delta[i] = column_out[i, 0] + defect[i]
        propagate_cov(cov, work, dt, decay, f_vel, f_att, columns)
        interval_noise(noise[k, 3:6], middle, dt, spread)
        if store:
            s_vel[k - first], s_att[k - first], s_spread[k - first] = f_vel, f_att, spread
        for i in range(3):
            cov[ATT + i, ATT + i] += noise[k, i] * dt
            for j in range(3):
                cov[VEL + i, VEL + j] += spread[i, j]
                cov[POS + i, VEL + j] += 0.5 * dt * spread[i, j]
                cov[VEL + i, POS + j] += 0.5 * dt * spread[i, j]
                cov[POS + i, POS + j] += 0.25 * dt * dt * spread[i, j]
        for i in range(9, n):
            cov[i, i] += slow_noise(walks[i], rates[i], dt, decay[i])
    return cost


@njit
def _update(delta, cov, entries, used, count, residual, gain):
    """Scalar update with unit noise; ``gain`` (n,) becomes P h / sqrt(S).

    Returns the normalised innovation and sqrt(S).
    """
    n = len(delta)
    innovation = residual
    for j in range(n):
        gain[j] = 0.0
    for e in range(count):
        c, v = used[e], entries[e]
        innovation -= v * delta[c]
        for j in range(n):
            gain[j] += v * cov[c, j]
    spread = 1.0
    for e in range(count):
        spread += entries[e] * gain[used[e]]
    root = math.sqrt(spread)
    normal = innovation / root
    for j in range(n):
        gain[j] /= root
    for i in range(n):
        delta[i] += gain[i] * normal
        g = gain[i]
        for j in range(n):
            cov[i, j] -= g * gain[j]
    return normal, root


@njit
def _store_row(at, entries, used, count, gain, value, root, r_entries, r_index, r_count, r_gain,
               r_value):
    for e in range(count):
        r_entries[at, e] = entries[e] / root
        r_index[at, e] = used[e]
    r_count[at] = count
    r_gain[at] = gain
    r_value[at] = value


@njit
def smooth_segment(first, last, x, adjoint, adjoint_cov, motion, storage, with_cov, step,
                   cov_out, var_out):
    """Backward pass over first <= k < last; the adjoints are those at ``last`` before its rows
    on entry, at ``first`` before its rows on return.

    Args:
        motion, storage: as in :func:`filter_segment`.
        step: (last - first, n) smoothed deviations, result.
        cov_out: (N, 3, 3, 3) covariances of position, velocity, attitude, result.
        var_out: (N, n - 9) variances of the other states, result; every THINNING-th sample.

    Returns:
        Sum of the squared normalised process noise.
    """
    stamps, _, noise, _, _, rates, walks, _, columns, _, _ = motion
    (r_entries, r_index, r_count, r_gain, r_value, r_start, s_delta, s_cov, s_vel, s_att,
     s_spread) = storage
    n = len(adjoint)
    decay = np.ones(n)
    column, column_out = np.empty((n, 1)), np.empty((n, 1))
    work, work_t = np.empty((n, n)), np.empty((n, n))
    u, quadratic = np.empty(n), 0.0
    cost = 0.0
    for k in range(last - 1, first - 1, -1):
        if k < len(x) - 1:
            dt = stamps[k]
            for i in range(9, n):
                decay[i] = 1.0 if rates[i] == 0.0 else math.exp(-rates[i] * dt)
            f_vel, f_att, spread = s_vel[k - first], s_att[k - first], s_spread[k - first]
            for i in range(3):
                cost += noise[k, i] * dt * adjoint[ATT + i] ** 2
                for j in range(3):
                    cost += (spread[i, j] * (adjoint[VEL + i] + 0.5 * dt * adjoint[POS + i])
                             * (adjoint[VEL + j] + 0.5 * dt * adjoint[POS + j]))
            for i in range(9, n):
                cost += (slow_noise(walks[i], rates[i], dt, decay[i])
                         * adjoint[i] ** 2)
            column[:, 0] = adjoint
            adjoint_rows(column, column_out, dt, decay, f_vel, f_att, columns)
            adjoint[:] = column_out[:, 0]
            if with_cov:
                adjoint_rows(adjoint_cov, work, dt, decay, f_vel, f_att, columns)
                for i in range(n):
                    for j in range(n):
                        work_t[j, i] = work[i, j]
                adjoint_rows(work_t, adjoint_cov, dt, decay, f_vel, f_att, columns)
        cov, delta = s_cov[k - first], s_delta[k - first]
        for i in range(n):
            step[k - first, i] = delta[i]
        for j in range(n):
            a = adjoint[j]
            for i in range(n):
                step[k - first, i] += cov[j, i] * a
        if with_cov:
            slow = k % THINNING == 0 or k == len(x) - 1
            _smoothed_cov(k, cov, adjoint_cov, slow, work, cov_out, var_out)
        for r in range(r_start[k - first + 1] - 1, r_start[k - first] - 1, -1):
            gain = r_gain[r]
            value = r_value[r]
            for i in range(n):
                value -= gain[i] * adjoint[i]
            if with_cov:
                for i in range(n):
                    u[i] = 0.0
                for j in range(n):
                    g = gain[j]
                    for i in range(n):
                        u[i] += g * adjoint_cov[j, i]
                quadratic = 1.0
                for i in range(n):
                    quadratic += gain[i] * u[i]
            for e in range(r_count[r]):
                c, v = r_index[r, e], r_entries[r, e]
                adjoint[c] += v * value
                if with_cov:
                    # h' u + u' h, then the corner that both contain.
                    for i in range(n):
                        adjoint_cov[c, i] -= v * u[i]
                        adjoint_cov[i, c] -= v * u[i]
            if with_cov:
                for e in range(r_count[r]):
                    for f in range(r_count[r]):
                        adjoint_cov[r_index[r, e], r_index[r, f]] += (
                            r_entries[r, e] * r_entries[r, f] * quadratic)
    return cost


@njit
def _smoothed_cov(k, cov, adjoint_cov, slow, work, cov_out, var_out):
    """Blocks of P - P L P that are reported."""
    n = len(cov)
    for i in range(n if slow else 9):
        for j in range(n):
            work[i, j] = 0.0
        for m in range(n):
            v = cov[i, m]
            if v != 0.0:
                for j in range(n):
                    work[i, j] += v * adjoint_cov[m, j]
    for b in range(3):
        for i in range(3):
            for j in range(i + 1):
                total = cov[3 * b + i, 3 * b + j]
                for m in range(n):
                    total -= work[3 * b + i, m] * cov[m, 3 * b + j]
                cov_out[k, b, i, j] = total
                cov_out[k, b, j, i] = total
    if not slow:
        return
    for i in range(9, n):
        total = cov[i, i]
        for m in range(n):
            total -= work[i, m] * cov[m, i]
        var_out[k, i - 9] = total


@njit
def make_storage(n_samples, n_rows, n):
    """Arrays for a segment of n_samples with n_rows rows and n error states."""
    return (np.empty((n_rows, MAX_ENTRIES)), np.empty((n_rows, MAX_ENTRIES), np.int64),
            np.empty(n_rows, np.int64), np.empty((n_rows, n)), np.empty(n_rows),
            np.empty(n_samples + 1, np.int64), np.empty((n_samples, n)),
            np.empty((n_samples, n, n)), np.empty((n_samples, 3, n)),
            np.empty((n_samples, 3, n)), np.empty((n_samples, 3, 3)))


@njit
def solve_linear(x, delta, cov, motion, measured, rows, innovation, with_cov, cov_out, var_out):
    """Solve the problem linearised about x (N, n + 1) and move x to its solution.

    Args:
        delta, cov: prior deviation (n,) and covariance (n, n) of the first sample.
        Others as in :func:`filter_segment` and :func:`smooth_segment`.

    Returns:
        Loss of all rows before the step, squared normalised process noise after it, largest
        changes (3,) of position, velocity and attitude.
    """
    total, n = len(x), len(delta)
    count = (total + SEGMENT - 1) // SEGMENT
    kept_delta, kept_cov = np.empty((count, n)), np.empty((count, n, n))
    most, cost, process = 0, 0.0, 0.0
    # A constant would have the filter compiled a second time for it.
    follow = np.zeros(1, np.bool_)[0]
    nothing = make_storage(0, 0, n)
    for s in range(count):
        first, last = s * SEGMENT, min((s + 1) * SEGMENT, total)
        kept_delta[s], kept_cov[s] = delta, cov
        most = max(most, 3 * (measured[0][last] - measured[0][first])
                   + rows[0][last] - rows[0][first])
        cost += filter_segment(first, last, follow, x, delta, cov, motion, measured, rows,
                               innovation, nothing)
    storage = make_storage(SEGMENT, most, n)
    step, largest = np.empty((SEGMENT, n)), np.zeros(3)
    adjoint, adjoint_cov = np.zeros(n), np.zeros((n, n))
    for s in range(count - 1, -1, -1):
        first, last = s * SEGMENT, min((s + 1) * SEGMENT, total)
        filter_segment(first, last, follow, x, kept_delta[s], kept_cov[s], motion, measured,
                       rows, innovation, storage)
        process += smooth_segment(first, last, x, adjoint, adjoint_cov, motion, storage,
                                  with_cov, step, cov_out, var_out)
        apply_step(x[first:last], step, largest)
    return cost, process, largest
