"""The accelerometer-only algorithm (AO) of Rahaman 2019 and its variant sqrt-AO, as a kernel.

Per sample, (a, alpha, S) are fitted to the readings by weighted least squares, which for four
tri-axial accelerometers is eq. (3.4)-(3.9). AO integrates alpha to the angular velocity
(3.12)-(3.13); sqrt-AO takes the angular velocity from S, which for a rigid body is
``[omega]x^2`` (Wan, Fawzi, Kesari 2022, arXiv 2101.10405). The orientation follows by the
Lie-Stoermer-Verlet step (3.15)-(3.17) or, with higher order, from the rates at both ends.
"""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.acceleration_field.kernel import gap_variance
from imu_fusion.estimation.acceleration_field.rows import (GAP, HELD, MISSING, SATURATED, VALUES,
                                                           put_row, rigid_gradient)
from imu_fusion.geometry.rotation import (quat_exp, quat_multiply, quat_normalize, quat_to_matrix,
                                          right_jacobian, skew)

AO, SQRT_AO = 0, 1
# Layout of the state vector: quaternion, omega, alpha of this and of the previous sample, a,
# previous step in s, samples since the start or a gap.
QUAT, RATE, ALPHA, ALPHA_BEFORE, ACC, STEP, COUNT = 0, 4, 7, 10, 13, 16, 17
STATE = 18


@njit
def fit_operator(design, weight, used, max_condition):
    """(12, m) operator of the least-squares fit with the channels used, its (12, 12) covariance
    for unit weights and whether it determines a and alpha.

    design: (m, 12) with columns scaled to comparable size, weight: (m,) 1/sd, used: (m,) bool.
    """
    m = len(weight)
    scaled = np.zeros((m, 12))
    for c in range(m):
        if used[c]:
            scaled[c] = design[c] * weight[c]
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    inverse = np.zeros((12, len(s)))
    free = np.zeros(12)
    for k in range(len(s)):
        if s[k] * max_condition > s[0]:
            for i in range(12):
                inverse[i, k] = vt[k, i] / s[k]
                free[i] += vt[k, i] * vt[k, i]
    # free[i] is the squared share of unknown i that the readings determine: 1 or less.
    determined = True
    for i in range(6):
        if 1.0 - free[i] > 1.0 / max_condition:
            determined = False
    operator = inverse @ np.ascontiguousarray(u.T)
    for c in range(m):
        operator[:, c] *= weight[c]
    full = len(s) == 12 and s[-1] * max_condition > s[0]
    return operator, inverse @ inverse.T, determined, full


@njit
def square_root_rate(symmetric, towards):
    """Angular velocity whose [omega]x^2 is nearest to a symmetric matrix (3, 3), on the side of
    ``towards`` (3,): the two signs cannot be told apart by S.

    ``omega omega' = S - tr(S) / 2``, of which the largest eigenpair is taken.
    """
    outer = symmetric - 0.5 * (symmetric[0, 0] + symmetric[1, 1] + symmetric[2, 2]) * np.eye(3)
    values, vectors = np.linalg.eigh(outer)
    rate = math.sqrt(max(values[2], 0.0)) * vectors[:, 2]
    if rate[0] * towards[0] + rate[1] * towards[1] + rate[2] * towards[2] < 0.0:
        rate = -rate
    return rate


@njit
def _integrate_rate(state, alpha, dt, high_order):
    """omega at the new sample; alpha (3,) there."""
    before = state[ALPHA:ALPHA + 3]
    if not high_order or state[COUNT] < 2.0:
        return state[RATE:RATE + 3] + 0.5 * dt * (before + alpha)
    # Parabola through the last three alpha, integrated over the last step (Adams-Moulton with
    # unequal steps).
    ratio = dt / state[STEP]
    slope = (alpha - before) - ratio * (before - state[ALPHA_BEFORE:ALPHA_BEFORE + 3])
    return (state[RATE:RATE + 3] + 0.5 * dt * (before + alpha)
            - dt * ratio / (6.0 * (1.0 + ratio)) * slope)


@njit
def _rotation(dt, omega0, omega1, alpha0, alpha1, high_order):
    if not high_order:
        return dt * (omega0 + 0.5 * dt * alpha0)
    # Hermite quadrature of the rate and the commutator of its ends (Magnus, fourth order).
    return (0.5 * dt * (omega0 + omega1) + (dt * dt / 12.0) * (alpha0 - alpha1)
            + (dt * dt / 12.0) * np.cross(omega0, omega1))


@njit
def _grow(cov, dt, phi, cov_alpha):
    """Covariance of attitude and omega (the first six of cov) over a step, white alpha errors."""
    f = np.eye(6)
    f[:3, :3] = quat_to_matrix(quat_exp(phi)).T
    f[:3, 3:] = dt * right_jacobian(phi)
    cov[:6, :6] = f @ cov[:6, :6].copy() @ f.T
    cov[3:6, 3:6] += dt * dt * cov_alpha


@njit
def _fit(operator, design, sd, used, reading):
    """The twelve unknowns (scaled as the design is) and the rms of what they leave over in units
    of the noise, NaN where nothing can be left over."""
    fit = np.zeros(12)
    for c in range(len(sd)):
        if used[c]:
            fit += operator[:, c] * reading[c]
    misfit, count = 0.0, 0
    for c in range(len(sd)):
        if used[c]:
            count += 1
            misfit += ((reading[c] - np.sum(design[c] * fit)) / sd[c]) ** 2
    return fit, math.sqrt(misfit / (count - 12)) if count > 12 else math.nan


@njit
def _symmetric_part(fit):
    """S (3, 3) from the unknowns, whose last six are xx yy zz xy xz yz."""
    symmetric = np.diag(fit[6:9])
    for i in range(3):
        j, k = min((i + 1) % 3, (i + 2) % 3), max((i + 1) % 3, (i + 2) % 3)
        symmetric[j, k] = fit[11 - i]
        symmetric[k, j] = fit[11 - i]
    return symmetric


@njit
def advance(state, cov, last, stamp, readings, design, scale, density, sample_rate,
            reference, gravity, specific_force, method, high_order, max_gap, max_condition,
            values, flags):
    """Take samples in order; one row of values and flags each.

    state: (18,), cov: (18, 18) as in the rigid-body kernel but for alpha and a of the latest fit
    alone, last: (1,) int64 stamp, all in place.
    readings: (n, m) channels, NaN for missing and inf for saturated ones. design: (m, 12), its
    columns multiplied by scale (12,).
    """
    m = readings.shape[1]
    used = np.ones(m, np.bool_)
    sd = density * math.sqrt(sample_rate)
    operator, covariance, determined, full = fit_operator(
        design, 1.0 / sd, used, max_condition)
    current = used.copy()
    x = np.zeros(18)
    for n in range(len(stamp)):
        flag = 0
        for c in range(m):
            z = readings[n, c]
            used[c] = math.isfinite(z)
            if math.isnan(z):
                flag |= MISSING
            elif not used[c]:
                flag |= SATURATED
        if np.any(used != current):
            current[:] = used
            operator, covariance, determined, full = fit_operator(
                design, 1.0 / sd, used, max_condition)
        dt = 0.0 if last[0] < 0 else (stamp[n] - last[0]) * 1e-9
        if dt > max_gap:
            # Nothing is integrated across a gap.
            flag |= GAP
            turned, speed2 = gap_variance(state[RATE:RATE + 3], dt)
            for i in range(3):
                cov[i, i] += turned
                cov[3 + i, 3 + i] += speed2
            state[COUNT] = 0.0
            dt = 0.0
        first = state[COUNT] == 0.0
        residual = math.nan
        if determined:
            fit, residual = _fit(operator, design, sd, used, readings[n])
            fit *= scale
            alpha = fit[3:6].copy()
            cov_alpha = covariance[3:6, 3:6] * np.outer(scale[3:6], scale[3:6])
        else:
            flag |= HELD
            fit = np.zeros(12)
            alpha = state[ALPHA:ALPHA + 3].copy()
            cov_alpha = cov[6:9, 6:9].copy()
        symmetric = _symmetric_part(fit)
        omega = state[RATE:RATE + 3].copy()
        if not first:
            omega = _integrate_rate(state, alpha, dt, high_order)
        if method == SQRT_AO and determined and full:
            omega = square_root_rate(symmetric, omega)
        if not first:
            phi = _rotation(dt, state[RATE:RATE + 3], omega, state[ALPHA:ALPHA + 3], alpha,
                            high_order)
            state[QUAT:QUAT + 4] = quat_normalize(quat_multiply(state[QUAT:QUAT + 4],
                                                                quat_exp(phi)))
            _grow(cov, dt, phi, cov_alpha)
        if method == SQRT_AO and determined and full:
            _set_rate_covariance(cov, omega, covariance, scale)
        if determined:
            acc = fit[0:3].copy()
            gradient = symmetric + skew(alpha) if full else rigid_gradient(omega, alpha)
            cov[12:15, 12:15] = covariance[0:3, 0:3]
            cov[6:9, 6:9] = cov_alpha
        else:
            acc = state[ACC:ACC + 3].copy()
            gradient = rigid_gradient(omega, alpha)
        state[ALPHA_BEFORE:ALPHA_BEFORE + 3] = state[ALPHA:ALPHA + 3]
        state[ALPHA:ALPHA + 3] = alpha
        state[RATE:RATE + 3] = omega
        state[ACC:ACC + 3] = acc
        state[STEP] = dt
        state[COUNT] += 1.0
        last[0] = stamp[n]
        x[3:6] = omega
        x[6:9] = alpha
        x[12:15] = acc
        put_row(values[n], gradient, x, cov, state[QUAT:QUAT + 4], reference, gravity,
                specific_force, residual)
        flags[n] = flag


@njit
def _set_rate_covariance(cov, omega, covariance, scale):
    """Covariance of the square-root rate, to first order of ``omega omega' = S - tr(S) / 2``.

    The magnitude follows from the trace, the direction from the off-diagonal rows; at standstill
    the square root has no derivative, so the rate is floored by the noise itself.
    """
    largest = 0.0
    for i in range(6, 12):
        largest = max(largest, covariance[i, i] * scale[i] * scale[i])
    speed2 = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
    variance = largest / (4.0 * max(speed2, 0.5 * math.sqrt(largest)))
    cov[3:6, :6] = 0.0
    cov[:6, 3:6] = 0.0
    for i in range(3):
        cov[3 + i, 3 + i] = variance


class AffineFilter:
    """AO or sqrt-AO with a start: biases are subtracted, attitude and rate are integrated."""

    def __init__(self, params, layout, start):
        x, cov, quat = start
        self._params = params
        self._layout = layout
        self._bias = x[18:]
        self._scale = np.r_[np.ones(3), np.full(9, 1.0 / layout.radius)]
        self._design = np.ascontiguousarray(layout.design * self._scale)
        state = np.zeros(STATE)
        state[QUAT:QUAT + 4] = quat
        state[RATE:RATE + 3] = x[3:6]
        self.state = {"state": state, "cov": np.zeros((18, 18)),
                      "last": np.array([-1], dtype=np.int64)}
        self.state["cov"][:6, :6] = cov[:6, :6]

    def process(self, stamp, readings):
        """Rows' values (n, 71) and flags (n,) of samples: stamp (n,), readings (n, m)."""
        p, l, s = self._params, self._layout, self.state
        values = np.empty((len(stamp), VALUES))
        flags = np.empty(len(stamp), dtype=np.uint32)
        # Saturation is judged on what the sensor said, before its bias is taken off.
        clipped = np.abs(readings) >= l.range
        corrected = np.where(clipped, np.inf, readings - self._bias)
        advance(s["state"], s["cov"], s["last"], stamp, corrected, self._design, self._scale,
                l.density, p.sample_rate, l.reference, p.gravity, l.specific_force,
                SQRT_AO if p.method == "sqrt_ao" else AO, p.integration == "high_order",
                p.max_gap, p.max_condition, values, flags)
        return values, flags
