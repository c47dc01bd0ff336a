"""The smoother of the rigid-body model: modified Bryson-Frazier, iterated."""

from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.kernel_params import kernel_params
from imu_fusion.estimation.acceleration_field.measurement import (
    TOUCHED,
    Trace,
    channel_row,
    make_trace,
    noise_variance,
)
from imu_fusion.estimation.acceleration_field.motion_model import (
    ALPHA,
    BIAS,
    motion_step,
    multiply_transition_transposed,
    parts,
    transition,
)
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.rigid_body_filter import RigidBodyFilter
from imu_fusion.estimation.acceleration_field.rows import (
    GAP,
    MISSING,
    ROW,
    SATURATED,
    put_row,
    rigid_gradient,
)
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.start import Start
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize
from imu_fusion.kernels import njit

#: Samples whose covariances are kept at a time; others are filtered again when needed.
CHUNK = 256


class Adjoint(NamedTuple):
    """What the samples after the present one say of the state (Bierman 1977), in place."""

    vector: np.ndarray        # (N, 1)
    information: np.ndarray   # (N, N)


@njit
def backward(adjoint, par, channels, trace, smoothed, smoothed_cov):
    """Smooth the n samples of a Trace, from the last to the first. It inverts nothing, so
    constant biases and exact starts need no care.

    adjoint: :class:`Adjoint`, carries on from the samples after these and ends before these.
    smoothed: (n, N); its theta is relative to the predicted attitude. smoothed_cov:
    (n, 18, 18).
    """
    p = par[0]
    vector, information = adjoint.vector, adjoint.information
    for n in range(len(trace.x) - 1, -1, -1):
        # With the filtered covariance rather than the predicted one: the difference of two
        # small numbers keeps the digits that a wide prior would cost.
        smoothed[n] = trace.x[n] - (trace.cov[n] @ vector)[:, 0]
        part = np.ascontiguousarray(trace.cov[n][:BIAS])
        smoothed_cov[n] = part[:, :BIAS] - part @ information @ part.T
        _before_update(adjoint, channels, trace, n)
        if trace.dt[n] < 0.0:
            # Across a gap, only attitude, omega and biases are the same state.
            vector[ALPHA:BIAS] = 0.0
            information[ALPHA:BIAS, :] = 0.0
            information[:, ALPHA:BIAS] = 0.0
        if trace.dt[n] > 0.0:
            chain, _ = motion_step(trace.dt[n], p.motion.rate)
            f = transition(trace.dt[n], chain, trace.phi[n])
            multiply_transition_transposed(vector, f)
            multiply_transition_transposed(information, f)
            half = np.ascontiguousarray(information.T)
            multiply_transition_transposed(half, f)
            information[:] = 0.5 * (half + half.T)


@njit
def _before_update(adjoint, channels, trace, n):
    """Take the Adjoint from behind the updates of sample n to before them."""
    vector, information = adjoint.vector, adjoint.information
    index = np.empty(TOUCHED, np.int64)
    unused = np.empty(TOUCHED)
    for c in range(len(channels) - 1, -1, -1):
        total = trace.total[n, c]
        if total == 0.0:
            continue
        count, _ = channel_row(channels[c], c, unused, index, unused)
        row = trace.row[n, c]
        gain = trace.column[n, c] / total
        spread = information @ gain
        quadratic = 1.0 / total + np.dot(gain, spread)
        pull = trace.innovation[n, c] / total
        for j in range(len(gain)):
            pull += gain[j] * vector[j, 0]
        for k in range(count):
            i, h = index[k], row[k]
            vector[i, 0] -= h * pull
            for j in range(len(gain)):
                information[i, j] -= h * spread[j]
                information[j, i] -= h * spread[j]
        for k in range(count):
            for j in range(count):
                information[index[k], index[j]] += row[k] * row[j] * quadratic


def smooth(params: AccelerationFieldParams, array: SensorArray, start: Start, stamp: np.ndarray,
           readings: np.ndarray) -> np.ndarray:
    """The iterated smoother: rows (n,) ROW given all samples.

    The readings are linearised at the smoothed angular velocity of the previous iteration
    (Gauss-Newton on the posterior), until it moves by less than a thousandth of its standard
    deviation or ``iteration.max`` are used up. The attitude is the integral of the smoothed
    angular velocity, by Hermite quadrature and the fourth-order Magnus expansion.

    Args:
        start: before the first sample.
        stamp: (n,) int64 ns.
        readings: (n, m), NaN for missing channels.
    """
    at = np.empty((0, 3))
    before = np.zeros((len(stamp), 3))
    for iteration in range(params.iteration.max):
        mean, cov = smooth_once(params, array, start, stamp, readings, at)
        at = np.ascontiguousarray(parts(mean).omega)
        moved = np.abs(at - before)
        variance = parts(np.einsum("nii->ni", cov)).omega
        if iteration > 0 and np.all(moved ** 2 <= 1e-6 * variance):
            break
        before = at
    rows = np.empty(len(stamp), ROW)
    _put_smoothed(kernel_params(params, array), array.channels, stamp, readings, mean, cov,
                  start.quat.copy(), rows)
    return rows


def smooth_once(params: AccelerationFieldParams, array: SensorArray, start: Start,
                stamp: np.ndarray, readings: np.ndarray,
                at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (n, N) and covariances (n, 18, 18) of one iteration; the arguments are those of
    :func:`smooth`.

    at: (n, 3) angular velocities to linearise at, or (0, 3): at the filter's predictions.
    """
    size, channels = len(start.x), array.channels
    keeper = RigidBodyFilter(params, array, start)
    par = kernel_params(params, array)
    trace = make_trace(min(CHUNK, len(stamp)), len(channels))
    bounds = [(i, min(i + CHUNK, len(stamp))) for i in range(0, len(stamp), CHUNK)]
    checkpoints = []
    for i, j in bounds:
        checkpoints.append(keeper.get_state())
        keeper.trace(stamp[i:j], readings[i:j], at[i:j], trace)
    mean = np.empty((len(stamp), size))
    cov = np.empty((len(stamp), BIAS, BIAS))
    adjoint = Adjoint(np.zeros((size, 1)), np.zeros((size, size)))
    for (i, j), checkpoint in zip(reversed(bounds), reversed(checkpoints)):
        keeper.set_state(checkpoint)
        part = Trace(*(member[:j - i] for member in trace))
        keeper.trace(stamp[i:j], readings[i:j], at[i:j], part)
        backward(adjoint, par, channels, part, mean[i:j], cov[i:j])
    return mean, cov


@njit
def _put_smoothed(par, channels, stamp, readings, mean, cov, quat, rows):
    """One of ``rows`` (n,) ROW for each smoothed mean (n, N) and covariance (n, 18, 18); quat
    (4,) of the start is changed."""
    p = par[0]
    s = parts(mean)
    quat[:] = quat_normalize(quat_multiply(quat, quat_exp(s.theta[0])))
    for n in range(len(stamp)):
        row = rows[n]
        row.stamp = stamp[n]
        row.flags = 0
        if n > 0:
            dt = (stamp[n] - stamp[n - 1]) * 1e-9
            w0, w1 = s.omega[n - 1], s.omega[n]
            if dt > p.gap.max:
                row.flags = GAP
            else:
                phi = (0.5 * dt * (w0 + w1)
                       + dt * dt / 12.0 * (s.alpha[n - 1] - s.alpha[n] + np.cross(w0, w1)))
                quat[:] = quat_normalize(quat_multiply(quat, quat_exp(phi)))
        _put_residual(row, p, channels, readings[n], mean[n])
        own = parts(mean[n])
        put_row(row, p, quat, own.omega, own.alpha, own.acc, cov[n],
                rigid_gradient(own.omega, own.alpha))


@njit
def _put_residual(row, p, channels, reading, x):
    """Flags and residual_rms of a sample given its smoothed mean x (N,)."""
    index = np.empty(TOUCHED, np.int64)
    h = np.empty(TOUCHED)
    squares, used = 0.0, 0
    for c in range(len(channels)):
        if np.isnan(reading[c]):
            row.flags |= MISSING
            continue
        if abs(reading[c]) >= channels[c].range:
            row.flags |= SATURATED
            continue
        count, constant = channel_row(channels[c], c, parts(x).omega, index, h)
        residual = reading[c] - constant
        for k in range(count):
            residual -= h[k] * x[index[k]]
        squares += residual * residual / noise_variance(channels[c], p)
        used += 1
    row.residual_rms = np.sqrt(squares / used) if used > 0 else np.nan
