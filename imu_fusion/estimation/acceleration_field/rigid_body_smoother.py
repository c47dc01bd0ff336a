"""The smoother of the rigid-body model: modified Bryson-Frazier, iterated."""

from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.exact_mounting import ask, make_exact, share
from imu_fusion.estimation.acceleration_field.kernel_params import kernel_params
from imu_fusion.estimation.acceleration_field.measurement import (
    RATE_ROWS,
    TOUCHED,
    Trace,
    channel_row,
    make_trace,
    noise_variance,
    unused_flags,
)
from imu_fusion.estimation.acceleration_field.misfit import widening
from imu_fusion.estimation.acceleration_field.motion_model import (
    ALPHA,
    BIAS,
    OMEGA,
    THETA,
    State,
    motion_step,
    multiply_transition_transposed,
    parts,
    put_symmetric,
    transition,
)
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.rigid_body_filter import RigidBodyFilter, copied
from imu_fusion.estimation.acceleration_field.rows import (
    GAP,
    ROW,
    put_rigid_row,
)
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.start import Start
from imu_fusion.estimation.acceleration_field.wrong_start import turn_to_reckon_with
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize
from imu_fusion.kernels import njit

#: Samples whose covariances are kept at a time; others are filtered again when needed.
CHUNK = 256


class Adjoint(NamedTuple):
    """What the samples after the present one say of the state (Bierman 1977), in place."""

    vector: np.ndarray        # (N, 1)
    information: np.ndarray   # (N, N)


class Smoothed(NamedTuple):
    """What :func:`smooth_once` gives of n samples."""

    mean: np.ndarray    # (n, N), moved to that of an exact mounting as far as that is likely
    cov: np.ndarray     # (n, 18, 18)
    used: np.ndarray    # (n, m) bool, which readings
    last: State         # after the last sample


@njit
def backward(adjoint, par, touched, trace, toward, smoothed, smoothed_cov):
    """Smooth the n samples of a Trace, from the last to the first. It inverts nothing, so
    constant biases and exact starts need no care.

    touched: (m, TOUCHED) states of the channels' rows. adjoint: :class:`Adjoint`, carries on from
    the samples after these and ends before these. toward: (N, 1) what the means move along, by
    their covariances; that much further they may be off. smoothed: (n, N); its theta is relative to
    the predicted attitude. smoothed_cov: (n, 18, 18).
    """
    p = par[0]
    moves = np.any(toward != 0.0)
    vector, information = adjoint.vector, adjoint.information
    chain, chain_dt = np.empty((4, 4)), -1.0
    for n in range(len(trace.x) - 1, -1, -1):
        # With the filtered covariance rather than the predicted one: the difference of two
        # small numbers keeps the digits that a wide prior would cost.
        smoothed[n] = trace.x[n] - (trace.cov[n] @ vector)[:, 0]
        part = np.ascontiguousarray(trace.cov[n][:BIAS])
        found = part[:, :BIAS] - part @ information @ part.T
        smoothed_cov[n] = 0.5 * (found + found.T)
        if moves:
            change = (trace.cov[n] @ (toward - information @ (trace.cov[n] @ toward)))[:, 0]
            smoothed[n] -= change
            smoothed_cov[n] += np.outer(change[:BIAS], change[:BIAS])
        _before_update(adjoint, touched, trace, n)
        if trace.dt[n] < 0.0:
            # Across a gap, only attitude, omega and biases are the same state.
            vector[ALPHA:BIAS] = 0.0
            information[ALPHA:BIAS, :] = 0.0
            information[:, ALPHA:BIAS] = 0.0
        if trace.dt[n] > 0.0:
            if trace.dt[n] != chain_dt:
                chain_dt = trace.dt[n]
                chain, _ = motion_step(chain_dt, p.motion.rate)
            f = transition(trace.dt[n], chain, trace.phi[n])
            multiply_transition_transposed(vector, f)
            multiply_transition_transposed(information, f)
            half = np.ascontiguousarray(information[:BIAS, :BIAS].T)
            multiply_transition_transposed(half, f)
            put_symmetric(information, half)


@njit
def _before_update(adjoint, touched, trace, n):
    """Take the Adjoint from behind the updates of sample n to before them.

    An update with the row h and the gain g makes (1 - h g') L (1 - g h') + h h' / total of the
    information L. That is L + h v' + v h' with a vector v; they are added to L all at once.
    """
    vector, information = adjoint.vector, adjoint.information
    updates, size = len(touched), len(vector)
    gains, changes = np.zeros((updates, size)), np.zeros((updates, size))
    for c in range(updates):
        if trace.total[n, c] != 0.0:
            gains[c] = trace.column[n, c] / trace.total[n, c]
    spreads = gains @ information
    total_change = np.zeros((size, size))
    for k in range(updates):
        c = _backward(k, updates)
        if trace.total[n, c] == 0.0:
            continue
        row, index, gain, spread = trace.row[n, c], touched[c], gains[c], spreads[c]
        for behind in range(k):
            _add_change(spread, gain, _backward(behind, updates), touched, trace.row[n], changes)
        pull = trace.innovation[n, c] / trace.total[n, c] + np.dot(gain, vector.ravel())
        half = 0.5 / trace.total[n, c] + 0.5 * np.dot(gain, spread)
        change = changes[c]
        change[:] = -spread
        for j in range(len(row)):
            vector[index[j], 0] -= row[j] * pull
            change[index[j]] += row[j] * half
        for j in range(len(row)):
            total_change[index[j]] += row[j] * change
    information += total_change + total_change.T


@njit
def _backward(k, updates):
    """Updates from the last to the first: channels, then the rows of the rate, which came before
    them."""
    return (updates - RATE_ROWS - 1 - k) % updates


@njit
def _add_change(spread, gain, c, touched, rows, changes):
    """Add to L @ gain what the change of L by update c, which is none of an unused one, makes of
    it, in place."""
    row, index, change = rows[c], touched[c], changes[c]
    along, across = np.dot(change, gain), 0.0
    for k in range(len(row)):
        across += row[k] * gain[index[k]]
        spread[index[k]] += row[k] * along
    for j in range(len(gain)):
        spread[j] += change[j] * across


def smooth(params: AccelerationFieldParams, array: SensorArray, start: Start,
                    stamp: np.ndarray, readings: np.ndarray) -> tuple[np.ndarray, State]:
    """The iterated smoother: rows (n,) ROW given all samples, and the State after the last one.

    The readings are linearised at the smoothed states of the previous iteration (Gauss-Newton on
    the posterior), until the angular velocity moves by less than a thousandth of its standard
    deviation or ``iteration.max`` are used up. The attitude is the integral of the smoothed
    angular velocity, by Hermite quadrature and the fourth-order Magnus expansion. All that is
    beside the hypothesis that the mounting is exact, see :mod:`.exact_mounting`.

    Args:
        start: before the first sample.
        stamp: (n,) int64 ns.
        readings: (n, m), NaN for missing channels.
    """
    at = np.empty((0, len(start.x)))
    vague = 0
    for iteration in range(params.iteration.max):
        found = smooth_once(params, array, start, stamp, readings, at)
        # Where the filter did not know the rate, iterations may settle on the wrong sign of it.
        vague = max(vague, int(found.last.adaptation["vague"][0]))
        if iteration == 0:
            first = found.last.adaptation
        else:
            moved = parts(found.mean).omega - parts(at).omega
            if np.all(moved ** 2 <= 1e-6 * parts(np.einsum("nii->ni", found.cov)).omega):
                break
        at = found.mean
    rows = np.empty(len(stamp), ROW)
    _put_smoothed(kernel_params(params, array), array.channels, stamp, readings, found.used,
                  found.mean, found.cov, start.quat.copy(),
                  turn_to_reckon_with(start.about, first[0]), rows)
    found.last.adaptation["vague"] = vague
    for name in ("score", "information"):
        found.last.adaptation[name] = first[name]
    return rows, found.last


def smooth_once(params: AccelerationFieldParams, array: SensorArray, start: Start,
                stamp: np.ndarray, readings: np.ndarray,
                at: np.ndarray) -> Smoothed:
    """One iteration; the arguments are those of :func:`smooth`.

    at: (n, N) states to linearise at, or (0, N): at the filter's predictions.
    """
    size, channels = len(start.x), array.channels
    keeper = RigidBodyFilter(params, array, start)
    par = kernel_params(params, array)
    trace = make_trace(min(CHUNK, len(stamp)), len(channels), size)
    bounds = [(i, min(i + CHUNK, len(stamp))) for i in range(0, len(stamp), CHUNK)]
    checkpoints = []
    for i, j in bounds:
        checkpoints.append(keeper.get_state())
        keeper.trace(stamp[i:j], readings[i:j], at[i:j], trace)
    last = copied(keeper.state)
    toward = _toward_exact(array, last)
    mean = np.empty((len(stamp), size))
    cov = np.empty((len(stamp), BIAS, BIAS))
    used = np.empty((len(stamp), len(channels)), bool)
    adjoint = Adjoint(np.zeros((size, 1)), np.zeros((size, size)))
    for (i, j), checkpoint in zip(reversed(bounds), reversed(checkpoints)):
        keeper.set_state(checkpoint)
        part = Trace(*(member[:j - i] for member in trace))
        keeper.trace(stamp[i:j], readings[i:j], at[i:j], part)
        backward(adjoint, par, keeper.touched, part, toward, mean[i:j], cov[i:j])
        used[i:j] = part.total[:, :len(channels)] > 0.0
    return Smoothed(mean, cov, used, last)


def _toward_exact(array, last):
    """What moves means (N, 1) to those of an exact mounting, as far as that is likely by the State
    after the last sample."""
    exact = make_exact(array)
    toward = np.zeros((len(last.x), 1))
    if len(exact.pull):
        ask(exact, last.x, last.cov)
        toward[-len(exact.pull):, 0] = share(exact) * exact.pull
    return toward


@njit
def _put_smoothed(par, channels, stamp, readings, used, mean, cov, quat, turn, rows):
    """One of ``rows`` (n,) ROW for each smoothed mean (n, N) and covariance (n, 18, 18); used:
    (n, m) bool. quat (4,) of the start is changed. turn: (3,) rad/s, by which the body may have
    turned all along."""
    p = par[0]
    doubt = np.zeros(BIAS)
    doubt[OMEGA:ALPHA] = turn
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
        _put_residual(row, p, channels, readings[n], used[n], mean[n])
        own = parts(mean[n])
        doubt[THETA:OMEGA] = turn * ((stamp[n] - stamp[0]) * 1e-9)
        put_rigid_row(row, p, quat, own.omega, own.alpha, own.acc,
                      widening(mean[n], channels) * cov[n], doubt)


@njit
def _put_residual(row, p, channels, reading, use, x):
    """Flags and residual_rms of a sample given its smoothed mean x (N,)."""
    index, h, scratch = np.empty(TOUCHED, np.int64), np.empty(TOUCHED), np.empty((3, 3))
    squares, count = 0.0, 0
    for c in range(len(channels)):
        row.flags |= unused_flags(reading[c], use[c])
        if not use[c]:
            continue
        _, expected = channel_row(channels[c], c, x, index, h, scratch)
        residual = reading[c] - expected
        squares += residual * residual / noise_variance(channels[c], p)
        count += 1
    row.residual_rms = np.sqrt(squares / count) if count > 0 else np.nan
