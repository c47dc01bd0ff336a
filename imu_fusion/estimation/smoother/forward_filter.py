"""The pass forward: a Kalman filter of the deviation from a nominal trajectory (numba).

Rows are whitened, so that updates are scalar. What the pass back needs of a segment of samples
is kept in a :class:`Storage`.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.smoother.measurements.registry import predict
from imu_fusion.estimation.smoother.measurements.surface_contact import put_row
from imu_fusion.estimation.smoother.motion import carry, put_decay
from imu_fusion.estimation.smoother.records import Recording, Scratch
from imu_fusion.estimation.smoother.state import boxminus, boxplus, slow
from imu_fusion.estimation.smoother.transition import (
    add_noise,
    propagate_cov,
    propagate_rows,
    put_spread,
)
from imu_fusion.kernels import njit


class Storage(NamedTuple):
    """Of a segment of samples, for the pass back; for no sample: nothing is kept.

    Rows, in the order of their updates: ``entries`` (R, n) that are not zero, ``length`` (R,) of
    them, divided by the innovation's standard deviation, and their error indices ``states``
    (R, n); ``gain`` (R, n) and normalised innovation ``value`` (R,). Samples: ``row_start``
    (S + 1,); deviation ``delta`` (S, n) and covariance ``cov`` (S, n, n) after the rows;
    ``f_vel``, ``f_att`` (S, 3, n) and ``spread`` (S, 3, 3) of the interval behind.
    """

    entries: np.ndarray
    states: np.ndarray
    length: np.ndarray
    gain: np.ndarray
    value: np.ndarray
    row_start: np.ndarray
    delta: np.ndarray
    cov: np.ndarray
    f_vel: np.ndarray
    f_att: np.ndarray
    spread: np.ndarray


@njit
def make_storage(n_samples: int, n_rows: int, n: int) -> Storage:
    """Storage for a segment of n_samples with n_rows rows and n error states."""
    return Storage(
        np.empty((n_rows, n)), np.empty((n_rows, n), np.int64), np.empty(n_rows, np.int64),
        np.empty((n_rows, n)), np.empty(n_rows), np.empty(n_samples + 1, np.int64),
        np.empty((n_samples, n)), np.empty((n_samples, n, n)), np.empty((n_samples, 3, n)),
        np.empty((n_samples, 3, n)), np.empty((n_samples, 3, 3)))


@njit
def filter_segment(first: int, last: int, follow: bool, x: np.ndarray, delta: np.ndarray,
                   cov: np.ndarray, recording: Recording, fit: np.ndarray, storage: Storage,
                   scratch: Scratch) -> tuple[float, float]:
    """Filter samples first <= k < last; ``delta`` (n,) and ``cov`` (n, n) are those before the rows
    of ``first`` on entry, before the rows of ``last`` on return.

    Args:
        follow: the nominal trajectory follows the filter (extended Kalman filter, writes x)
            instead of being kept (linear pass about x).
        x: nominal states (N, n + 1).
        fit: (M,) of records.FIT, result.
        storage: result. scratch: of n error states.

    Returns:
        Sum of the losses of all rows at the nominal trajectory; negative logarithm of the
        likelihood of the whitened rows, linear about it.
    """
    n, store, model = len(delta), len(storage.delta) > 0, recording.model[0]
    step, rows = scratch.step[0], scratch.rows[0]
    cost, surprise, stored = 0.0, 0.0, 0
    for k in range(first, last):
        has_interval = k < len(x) - 1
        if has_interval:
            put_decay(recording.intervals[k].dt, model, step, n)
            carry(x[k], recording.intervals[k], model, step)
        _put_lever_arm(x[k], model, step)
        if store:
            storage.row_start[k - first] = stored
        for m in range(recording.reading_start[k], recording.reading_start[k + 1]):
            loss, unlikely, stored = _take_reading(recording.readings[m], x[k], follow, delta, cov,
                                                   step, model, rows, fit[m], storage, stored)
            cost += loss
            surprise += unlikely
        for c in range(recording.contact_start[k], recording.contact_start[k + 1]):
            residual = put_row(recording.contacts[c], x[k], model, rows)
            cost += residual ** 2
            value, root = _update(delta, cov, rows, residual)
            surprise += _surprise(value, root)
            stored = _store_row(stored, value, root, rows, storage)
        if follow:
            boxplus(x[k], delta)
            delta[:] = 0.0
            if has_interval:
                carry(x[k], recording.intervals[k], model, step)
        if store:
            storage.row_start[k - first + 1] = stored
            storage.delta[k - first] = delta
            storage.cov[k - first] = cov
        if has_interval:
            _to_next(x[k + 1], follow, delta, cov, recording.intervals[k], model, scratch)
            if store:
                storage.f_vel[k - first] = step.f_vel[:, :n]
                storage.f_att[k - first] = step.f_att[:, :n]
                storage.spread[k - first] = step.spread
    return cost, surprise


@njit
def _take_reading(reading, x, follow, delta, cov, step, model, rows, fit, storage, stored):
    """Update by the rows of a reading; returns its loss, the negative logarithm of its likelihood,
    and how many rows are kept."""
    n = len(delta)
    loss, weight = _linearise(reading, x, follow, cov, step, model, rows)
    # A weighted square touches the loss from above, where the nominal trajectory is.
    surprise = 0.5 * loss
    for i in range(3):
        _put_component(i, weight, n, rows)
        # Readings of fewer than three components have empty rows.
        if rows.length > 0:
            value, root = _update(delta, cov, rows, weight * rows.residual[i])
            surprise += _surprise(value, root) - 0.5 * (weight * rows.residual[i]) ** 2
            fit.innovation[i], fit.residual[i] = value, rows.residual[i]
            stored = _store_row(stored, value, root, rows, storage)
    return loss, surprise, stored


@njit
def _surprise(innovation, root):
    """Negative logarithm of the density of a normalised innovation, before it is divided by the
    root of its variance; without the constant."""
    return 0.5 * innovation * innovation + math.log(root)


@njit
def _put_lever_arm(x, model, step):
    """The antenna in the imu frame: as given, or as the state has it."""
    at = model.blocks.gnss_lever_arm
    for i in range(3):
        step.lever_arm[i] = model.lever_arm[i] if at < 0 else slow(x, at + i)


@njit
def _to_next(x_next, follow, delta, cov, interval, model, scratch):
    """Carry deviation and covariance over an interval; the next nominal state, if it follows."""
    step = scratch.step[0]
    if follow:
        x_next[:] = step.x_next[:len(x_next)]
    else:
        _carry_deviation(x_next, delta, scratch, step, model)
    propagate_cov(cov, scratch.matrix, step, model)
    put_spread(interval.acc_noise, step)
    add_noise(cov, interval.gyr_noise, step, model)


@njit
def _carry_deviation(x_next, delta, scratch, step, model):
    """Carry a deviation over an interval to the nominal state x_next (n + 1,), by what the carried
    state differs from that."""
    n = len(delta)
    boxminus(step.x_next[:n + 1], x_next, scratch.vector)
    scratch.column[:, 0] = delta
    propagate_rows(scratch.column, scratch.carried, step, model)
    for i in range(n):
        delta[i] = scratch.carried[i, 0] + scratch.vector[i]


@njit
def _linearise(reading, x, follow, cov, step, model, rows):
    """Whitened residual and derivative of a reading, into ``rows``; returns its loss and the root
    of its weight, by which both are still to be multiplied."""
    n = len(cov)
    for i in range(3):
        for c in range(n):
            rows.h[i, c] = 0.0
    predict(reading.kind, x, reading.tau, step, model, rows)
    _whiten(reading, n, rows)
    squares = 0.0
    for i in range(3):
        # The filter judges an outlier by what it expects, not by the noise alone.
        scale = _expected(rows.h[i], cov) if follow else 1.0
        squares += rows.residual[i] * rows.residual[i] / scale
    if reading.loss < np.inf:
        return (reading.loss * math.log(1.0 + squares / reading.loss),
                1.0 / math.sqrt(1.0 + squares / reading.loss))
    return squares, 1.0


@njit
def _whiten(reading, n, rows):
    """Residual and derivative times the whitening matrix."""
    h = rows.h
    for i in range(3):
        total = 0.0
        for j in range(i + 1):
            total += reading.whiten[i, j] * (reading.value[j] - rows.predicted[j])
        rows.residual[i] = total
    for i in range(2, -1, -1):
        for c in range(n):
            total = 0.0
            for j in range(i + 1):
                total += reading.whiten[i, j] * h[j, c]
            h[i, c] = total


@njit
def _expected(h, cov):
    """Variance of the innovation of a whitened row h (n,)."""
    n, scale = len(cov), 1.0
    for a in range(n):
        if h[a] != 0.0:
            for b in range(n):
                scale += h[a] * cov[a, b] * h[b]
    return scale


@njit
def _put_component(i, weight, n, rows):
    """Make component i of a reading the row."""
    count = 0
    for c in range(n):
        if rows.h[i, c] != 0.0:
            rows.entries[count] = weight * rows.h[i, c]
            rows.states[count] = c
            count += 1
    rows.length = count


@njit
def _update(delta, cov, rows, residual):
    """Scalar update with unit noise by the row; sets its gain, divided by the root of the
    innovation's variance. Returns the normalised innovation and that root."""
    n, count, entries, states, gain = len(delta), rows.length, rows.entries, rows.states, rows.gain
    innovation = residual
    for j in range(n):
        gain[j] = 0.0
    for e in range(count):
        c, v = states[e], entries[e]
        innovation -= v * delta[c]
        for j in range(n):
            gain[j] += v * cov[c, j]
    variance = 1.0
    for e in range(count):
        variance += entries[e] * gain[states[e]]
    root = math.sqrt(variance)
    normal = innovation / root
    for j in range(n):
        gain[j] /= root
    for i in range(n):
        g = gain[i]
        delta[i] += g * normal
        for j in range(n):
            cov[i, j] -= g * gain[j]
    return normal, root


@njit
def _store_row(at, value, root, rows, storage):
    """Keep the row as number ``at``, if rows are kept; returns how many are."""
    if len(storage.delta) == 0:
        return at
    for e in range(rows.length):
        storage.entries[at, e] = rows.entries[e] / root
        storage.states[at, e] = rows.states[e]
    for j in range(storage.gain.shape[1]):
        storage.gain[at, j] = rows.gain[j]
    storage.length[at], storage.value[at] = rows.length, value
    return at + 1
