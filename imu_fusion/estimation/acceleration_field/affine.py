"""The accelerometer-only algorithm (AO) of Rahaman 2019 and its variant sqrt-AO, as a kernel.

Per sample, (a, alpha, S) are fitted to the readings by weighted least squares, which for four
tri-axial accelerometers is eq. (3.4)-(3.9). AO integrates alpha to the angular velocity
(3.12)-(3.13); sqrt-AO takes the angular velocity from S, which for a rigid body is
``[omega]x^2`` (Wan, Fawzi, Kesari 2022, arXiv 2101.10405). The orientation follows by the
Lie-Stoermer-Verlet step (3.15)-(3.17) or, with higher order, from the rates at both ends.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.kernel_params import kernel_params
from imu_fusion.estimation.acceleration_field.measurement import unused_flags
from imu_fusion.estimation.acceleration_field.motion_model import (
    ACC,
    ACC_RATE,
    ALPHA,
    BIAS,
    JERK,
    OMEGA,
    THETA,
    gap_variance,
)
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.rows import (
    GAP,
    HELD,
    ROW,
    put_row,
    rigid_gradient,
)
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.start import Start
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    right_jacobian,
    skew,
)
from imu_fusion.kernels import njit

#: What is carried from sample to sample, body axes: quaternion of the world from the body; omega,
#: alpha and acc of the latest sample, alpha of the one before; length of the step between them, s;
#: samples since the start or a gap; stamp, ns, negative before the first. ``cov`` is that of the
#: state of motion_model, but for alpha and acc of the latest fit alone.
STATE = np.dtype([
    ("quat", "f8", 4), ("omega", "f8", 3), ("alpha", "f8", 3), ("alpha_before", "f8", 3),
    ("acc", "f8", 3), ("step", "f8"), ("count", "i8"), ("last", "i8"),
    ("cov", "f8", (BIAS, BIAS))])


class Operator(NamedTuple):
    """The least-squares fit of the twelve unknowns (a, alpha, S) with certain channels."""

    matrix: np.ndarray   # (12, m), unknowns from readings
    cov: np.ndarray      # (12, 12) of the unknowns
    determined: bool     # whether a and alpha are
    full: bool           # whether all unknowns are


@njit
def fit_operator(design, weight, used, max_condition):
    """The :class:`Operator` of the channels used.

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
    return Operator(operator, inverse @ inverse.T, determined, full)


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
def _integrate_rate(s, alpha, dt, high_order):
    """omega at the new sample; s: the STATE before it, alpha: (3,) there."""
    if not high_order or s.count < 2:
        return s.omega + 0.5 * dt * (s.alpha + alpha)
    # Parabola through the last three alpha, integrated over the last step (Adams-Moulton with
    # unequal steps).
    ratio = dt / s.step
    slope = (alpha - s.alpha) - ratio * (s.alpha - s.alpha_before)
    return (s.omega + 0.5 * dt * (s.alpha + alpha)
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
    """Covariance of theta and omega over a step of rotation phi (3,); alpha's errors are white."""
    f = np.eye(ALPHA)
    f[:OMEGA, :OMEGA] = quat_to_matrix(quat_exp(phi)).T
    f[:OMEGA, OMEGA:] = dt * right_jacobian(phi)
    cov[:ALPHA, :ALPHA] = f @ cov[:ALPHA, :ALPHA].copy() @ f.T
    cov[OMEGA:ALPHA, OMEGA:ALPHA] += dt * dt * cov_alpha


@njit
def _fit(operator, design, sd, used, reading, unknowns):
    """Fit the twelve unknowns (scaled as the design is), in place; returns the rms of what they
    leave over in units of the noise, NaN where nothing can be left over."""
    unknowns[:] = 0.0
    for c in range(len(sd)):
        if used[c]:
            for i in range(12):
                unknowns[i] += operator.matrix[i, c] * reading[c]
    misfit, count = 0.0, 0
    for c in range(len(sd)):
        if used[c]:
            count += 1
            expected = 0.0
            for i in range(12):
                expected += design[c, i] * unknowns[i]
            misfit += ((reading[c] - expected) / sd[c]) ** 2
    return math.sqrt(misfit / (count - 12)) if count > 12 else math.nan


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
def advance(state, par, channels, design, stamp, readings, rows):
    """Take n samples in order, in place; one of ``rows`` (n,) ROW each.

    state: (1,) STATE, par: (1,) record of :func:`kernel_params`, channels: (m,) CHANNEL, design:
    (m, 12), its columns multiplied by ``scale`` of par. stamp: (n,) int64 ns. readings: (n, m),
    NaN for missing, inf for saturated ones, -inf for those that stand still.
    """
    s, p = state[0], par[0]
    m = len(channels)
    sd = np.empty(m)
    for c in range(m):
        sd[c] = channels[c].density * math.sqrt(p.sample_rate)
    used = np.ones(m, np.bool_)
    operator = fit_operator(design, 1.0 / sd, used, p.max_condition)
    current = used.copy()
    unknowns = np.empty(12)
    for n in range(len(stamp)):
        row = rows[n]
        row.stamp = stamp[n]
        row.flags = _find_used(readings[n], used)
        if np.any(used != current):
            current[:] = used
            operator = fit_operator(design, 1.0 / sd, used, p.max_condition)
        dt = 0.0 if s.last < 0 else (stamp[n] - s.last) * 1e-9
        if dt > p.gap.max:
            row.flags |= GAP
            _cross_gap(s, dt)
            dt = 0.0
        row.residual_rms = math.nan
        if operator.determined:
            row.residual_rms = _fit(operator, design, sd, used, readings[n], unknowns)
            unknowns *= p.scale
        else:
            row.flags |= HELD
        _move(s, p, operator, unknowns, dt)
        s.last = stamp[n]
        if operator.determined and operator.full:
            gradient = _symmetric_part(unknowns) + skew(s.alpha)
        else:
            gradient = rigid_gradient(s.omega, s.alpha)
        # Whole slices: plain arrays, for which put_row is compiled in any case.
        put_row(row, p, s.quat[:], s.omega[:], s.alpha[:], s.acc[:], s.cov[:], gradient)


@njit
def _find_used(reading, used):
    """Which channels of a sample can be used, in place; returns the flags of the others."""
    flags = 0
    for c in range(len(used)):
        used[c] = math.isfinite(reading[c])
        flags |= unused_flags(reading[c], used[c])
    return flags


@njit
def _cross_gap(s, dt):
    """Nothing is integrated across a gap."""
    turned, speed2 = gap_variance(s.omega, dt)
    for i in range(3):
        s.cov[THETA + i, THETA + i] += turned
        s.cov[OMEGA + i, OMEGA + i] += speed2
    s.count = 0


@njit
def _move(s, p, operator, unknowns, dt):
    """Take the STATE to the next sample, dt s later, of which the twelve unknowns were fitted."""
    cov = s.cov[:]
    alpha, acc = s.alpha.copy(), s.acc.copy()
    if operator.determined:
        acc, alpha = unknowns[0:3].copy(), unknowns[3:6].copy()
        scale = p.scale[3:6]
        cov[ACC:ACC_RATE, ACC:ACC_RATE] = operator.cov[0:3, 0:3]
        cov[ALPHA:JERK, ALPHA:JERK] = operator.cov[3:6, 3:6] * np.outer(scale, scale)
    omega = s.omega.copy()
    if s.count > 0:
        omega = _integrate_rate(s, alpha, dt, p.high_order)
    by_root = p.square_root and operator.determined and operator.full
    if by_root:
        omega = square_root_rate(_symmetric_part(unknowns), omega)
    if s.count > 0:
        phi = _rotation(dt, s.omega, omega, s.alpha, alpha, p.high_order)
        s.quat[:] = quat_normalize(quat_multiply(s.quat, quat_exp(phi)))
        _grow(cov, dt, phi, cov[ALPHA:JERK, ALPHA:JERK])
    if by_root:
        _set_rate_covariance(cov, omega, operator.cov, p.scale)
    s.alpha_before[:] = s.alpha
    s.alpha[:] = alpha
    s.omega[:] = omega
    s.acc[:] = acc
    s.step = dt
    s.count += 1


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
    cov[OMEGA:ALPHA, :ALPHA] = 0.0
    cov[:ALPHA, OMEGA:ALPHA] = 0.0
    for i in range(3):
        cov[OMEGA + i, OMEGA + i] = variance


class AffineFilter:
    """AO or sqrt-AO with a start: biases are subtracted, attitude and rate are integrated."""

    def __init__(self, params: AccelerationFieldParams, array: SensorArray, start: Start):
        self._par = kernel_params(params, array)
        self._channels = array.channels
        self._bias = start.x[BIAS:BIAS + len(array.channels)]
        self._design = np.ascontiguousarray(array.design * self._par["scale"][0])
        self.state = np.zeros(1, STATE)
        self.state["quat"] = start.quat
        self.state["omega"] = start.x[OMEGA:ALPHA]
        self.state["last"] = -1
        self.state["cov"][0, :ALPHA, :ALPHA] = start.cov[:ALPHA, :ALPHA]

    def get_state(self) -> np.ndarray:
        """A copy of the memory, for :meth:`set_state`."""
        return self.state.copy()

    def set_state(self, state: np.ndarray) -> None:
        """Go on from where :meth:`get_state` was called."""
        self.state = state.copy()

    def process(self, stamp: np.ndarray, readings: np.ndarray) -> np.ndarray:
        """Rows (n,) ROW of samples: stamp (n,), readings (n, m), nan where there is
        none and inf where they are saturated."""
        rows = np.empty(len(stamp), ROW)
        advance(self.state, self._par, self._channels, self._design, stamp, readings - self._bias,
                rows)
        return rows
