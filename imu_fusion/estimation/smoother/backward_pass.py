"""The pass back, which inverts no covariance (numba).

The modified Bryson-Frazier form (Bierman, *Factorization Methods for Discrete Sequential
Estimation*, ch. X): an adjoint vector and matrix run backwards, so singular process noise and
exactly known states do no harm.
"""

from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.smoother.forward_filter import Storage
from imu_fusion.estimation.smoother.motion import put_decay
from imu_fusion.estimation.smoother.records import Recording, Scratch
from imu_fusion.estimation.smoother.state import ATT, POS, SLOW, VEL
from imu_fusion.estimation.smoother.transition import adjoint_rows, slow_noise
from imu_fusion.kernels import njit

#: Variances of the slow states are computed for every so many samples: they hardly change from one
#: to the next.
THINNING = 16


class Adjoint(NamedTuple):
    """What all later rows say of a sample: ``vector`` (n,), ``matrix`` (n, n)."""

    vector: np.ndarray
    matrix: np.ndarray


class Smoothed(NamedTuple):
    """Results: deviations ``step`` (S, n) of a segment; covariances ``cov`` (N, 3, 3, 3) of
    position, velocity, attitude and variances ``var`` (N, n - 9) of the slow states, of every
    THINNING-th sample and the last. For no sample: covariances are not computed."""

    step: np.ndarray
    cov: np.ndarray
    var: np.ndarray


@njit
def smooth_segment(first: int, last: int, adjoint: Adjoint, recording: Recording, storage: Storage,
                   smoothed: Smoothed, scratch: Scratch) -> float:
    """Pass back over first <= k < last; the adjoint is that at ``last`` before its rows on entry,
    at ``first`` before its rows on return.

    Returns:
        Sum of the squared normalised process noise.
    """
    n, total, with_cov = len(adjoint.vector), len(recording.intervals) + 1, len(smoothed.cov) > 0
    step, model = scratch.step[0], recording.model[0]
    cost = 0.0
    for k in range(last - 1, first - 1, -1):
        i = k - first
        if k < total - 1:
            step.dt = recording.intervals[k].dt
            put_decay(step.dt, model, step, n)
            step.f_vel[:, :n], step.f_att[:, :n] = storage.f_vel[i], storage.f_att[i]
            step.spread[:] = storage.spread[i]
            cost = _add_process_noise(cost, adjoint.vector, recording.intervals[k].gyr_noise, step,
                                      model)
            _through_interval(adjoint, with_cov, scratch, step, model)
        _deviation(storage.delta[i], storage.cov[i], adjoint.vector, smoothed.step[i])
        if with_cov:
            slow_too = k % THINNING == 0 or k == total - 1
            _smoothed_cov(storage.cov[i], adjoint.matrix, slow_too, scratch.matrix, smoothed.cov[k],
                          smoothed.var[k])
        for r in range(storage.row_start[i + 1] - 1, storage.row_start[i] - 1, -1):
            _through_row(r, adjoint, with_cov, storage, scratch.vector)
    return cost


@njit
def _add_process_noise(cost, adjoint, gyr_noise, step, model):
    """``cost`` with the squared normalised noise of an interval, term by term: in another order
    the sum would round differently."""
    dt, spread = step.dt, step.spread
    for i in range(3):
        cost += gyr_noise[i] * dt * adjoint[ATT + i] ** 2
        for j in range(3):
            cost += (spread[i, j] * (adjoint[VEL + i] + 0.5 * dt * adjoint[POS + i])
                     * (adjoint[VEL + j] + 0.5 * dt * adjoint[POS + j]))
    for i in range(SLOW, len(adjoint)):
        cost += slow_noise(i, step, model) * adjoint[i] ** 2
    return cost


@njit
def _through_interval(adjoint, with_cov, scratch, step, model):
    """The adjoint of the sample before an interval, from that behind it."""
    scratch.column[:, 0] = adjoint.vector
    adjoint_rows(scratch.column, scratch.carried, step, model)
    adjoint.vector[:] = scratch.carried[:, 0]
    if with_cov:
        adjoint_rows(adjoint.matrix, scratch.matrix, step, model)
        for i in range(len(scratch.matrix)):
            for j in range(len(scratch.matrix)):
                scratch.transposed[j, i] = scratch.matrix[i, j]
        adjoint_rows(scratch.transposed, adjoint.matrix, step, model)


@njit
def _deviation(delta, cov, adjoint, step):
    """step (n,) = delta + cov @ adjoint."""
    n = len(delta)
    for i in range(n):
        step[i] = delta[i]
    for j in range(n):
        a = adjoint[j]
        for i in range(n):
            step[i] += cov[j, i] * a


@njit
def _through_row(r, adjoint, with_cov, storage, u):
    """The adjoint before row r of the storage, from that behind it; u: (n,) scratch."""
    vector, matrix, n = adjoint.vector, adjoint.matrix, len(u)
    gain, entries, states = storage.gain[r], storage.entries[r], storage.states[r]
    value, length = storage.value[r], storage.length[r]
    for i in range(n):
        value -= gain[i] * vector[i]
    quadratic = 1.0
    if with_cov:
        for i in range(n):
            u[i] = 0.0
        for j in range(n):
            g = gain[j]
            for i in range(n):
                u[i] += g * matrix[j, i]
        for i in range(n):
            quadratic += gain[i] * u[i]
    for e in range(length):
        c, v = states[e], entries[e]
        vector[c] += v * value
        if with_cov:
            # h' u + u' h, then the corner that both contain.
            for i in range(n):
                matrix[c, i] -= v * u[i]
                matrix[i, c] -= v * u[i]
    if with_cov:
        for e in range(length):
            for f in range(length):
                matrix[states[e], states[f]] += entries[e] * entries[f] * quadratic


@njit
def _smoothed_cov(cov, adjoint, slow_too, work, cov_out, var_out):
    """Blocks of P - P L P that are reported."""
    n = len(cov)
    for i in range(n if slow_too else SLOW):
        for j in range(n):
            work[i, j] = 0.0
        for m in range(n):
            v = cov[i, m]
            if v != 0.0:
                for j in range(n):
                    work[i, j] += v * adjoint[m, j]
    for b in range(3):
        for i in range(3):
            for j in range(i + 1):
                total = cov[3 * b + i, 3 * b + j]
                for m in range(n):
                    total -= work[3 * b + i, m] * cov[m, 3 * b + j]
                cov_out[b, i, j] = total
                cov_out[b, j, i] = total
    if not slow_too:
        return
    for i in range(SLOW, n):
        total = cov[i, i]
        for m in range(n):
            total -= work[i, m] * cov[m, i]
        var_out[i - SLOW] = total
