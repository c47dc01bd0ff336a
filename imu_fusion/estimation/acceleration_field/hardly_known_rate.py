"""The angular velocity where it is hardly known: what the squares in one sample say of it (numba).

Readings depend on the angular velocity by its products alone (centripetal part). A linearisation at
the prediction sees nothing of that near zero, and not that the sign is open: between slow samples,
after a gap or in a long rest the angular velocity would become ever more unknown, and with it all
that is read. So where its variance makes more of a reading than noise does, the Gaussian nearest to
the posterior is sought first (variational: Opper and Archambeau 2009; its moments are exact, as the
exponent is a quartic), under what the channels say beyond a and alpha.

Its precision is that before, that of the readings linearised at its mean, and a rest: what their
curvature tells. So the update that follows is linearised there, the curvature enters as a reading
of the angular velocity of its own, and the readings expected get the mean of the squares of its
error. If the solution of the opposite sign is likely, too, the two are taken together (assumed
density: Maybeck 1982, ch. 12), and the update that follows says nothing more of the rate.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.adaptation import factor
from imu_fusion.estimation.acceleration_field.cross_check import prepare
from imu_fusion.estimation.acceleration_field.measurement import (
    RATE_ROWS,
    TOUCHED,
    innovation_of,
    linearise,
    mounted,
    noise_variance,
    put_updates,
    scalar_update,
)
from imu_fusion.estimation.acceleration_field.motion_model import ACC, ALPHA, OMEGA
from imu_fusion.kernels import njit

_ITERATIONS = 30
_MISFIT = 4.0     # mean square of what no angular velocity explains, beyond which that counts less
_UNLIKELY = 1e-4  # share of the solution of the opposite sign that is not considered

# Second derivatives (6, 3, 3) of the symmetric part S = w w' - |w|^2 by w, in the order of
# sensor_array.SYMMETRIC: S_i = w' BEND_i w / 2.
_BEND = np.zeros((6, 3, 3))
for _i, (_j, _k) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
    _BEND[_i, _j, _k] += 1.0
    _BEND[_i, _k, _j] += 1.0
    if _j == _k:
        _BEND[_i] -= 2.0 * np.eye(3)


class Mode(NamedTuple):
    """A Gaussian about one solution."""

    mean: np.ndarray        # (3,)
    cov: np.ndarray         # (3, 3)
    curvature: np.ndarray   # (3, 3) part of its precision
    weight: float           # log of its share


class Squares(NamedTuple):
    """What a sample says of S (6,): its cost is ``least - 2 pull s + s information s``."""

    information: np.ndarray   # (6, 6)
    pull: np.ndarray          # (6,)
    least: float
    redundancy: int


@njit
def is_hardly_known(state, channels, p):
    """Whether the product of two errors of the angular velocity makes more of a reading than noise
    does."""
    spin = 0.0
    for i in range(3):
        spin += state.cov[OMEGA + i, OMEGA + i]
    quietest = np.inf
    for c in range(len(channels)):
        if not channels[c].is_gyro:
            quietest = min(quietest, noise_variance(channels[c], p))
    return 0.5 * p.radius * p.radius * spin * spin > quietest


@njit
def settle_rate(state, p, channels, reading, at, work, trace, n):
    """Find where to linearise the angular velocity, and take in what the update by the channels
    will not see of it. In place.

    Args:
        state: State, predicted to the sample.
        p: record of the parameters, channels: (m,) CHANNEL, reading: (m,), nan or inf where there
            is none.
        at: (N,) the state predicted; its angular velocity becomes that to linearise at.
        work: Workspace, whose ``vague`` becomes the covariance about it; trace: Trace whose sample
            n gets the updates.

    Returns whether the sample told anything.
    """
    for c in range(len(channels)):
        work.use[c] = (math.isfinite(reading[c]) and not channels[c].is_gyro
                       and not state.checks[channels[c].sensor].faulty)
    prepare(work.fit, work.design, work.use, p.max_condition)
    if work.fit.redundancy[0] <= 0:
        return False
    said = _squares(state, p, channels, reading, at, work)
    before = state.x[OMEGA:ALPHA].copy()
    prior = np.ascontiguousarray(state.cov[OMEGA:ALPHA, OMEGA:ALPHA])
    known = _inverse(prior + 1e-12 * np.trace(prior) * np.eye(3))
    start = _solution(said, before)
    said = _believed(said, start)
    first = _mode(said, before, known, start)
    second = _mode(said, before, known, -first.mean)
    apart = second.mean - first.mean
    share = 1.0 / (1.0 + math.exp(max(min(first.weight - second.weight, 700.0), -700.0)))
    work.vague[:] = first.cov
    at[OMEGA:ALPHA] = first.mean
    if share < _UNLIKELY or apart @ np.linalg.solve(first.cov, apart) < 1.0:
        _take_in(state, first.curvature, np.zeros(3), trace, n)
        return True
    mean = (1.0 - share) * first.mean + share * second.mean
    cov = ((1.0 - share) * first.cov + share * second.cov
           + share * (1.0 - share) * np.outer(apart, apart))
    told = _inverse(cov)
    _take_in(state, told - known, told @ mean - known @ before, trace, n)
    work.is_open[0] = True
    return True


@njit
def leave_rate_out(channels, work):
    """Make the rows of the Workspace say nothing of the angular velocity, but doubt for it."""
    for c in range(len(channels)):
        if channels[c].is_gyro:
            continue
        row = work.row[c]
        for i in range(3):
            for j in range(3):
                work.doubt[c] += row[i] * work.vague[i, j] * row[j]
        row[:3] = 0.0


@njit
def _linearise_at_fit(state, p, channels, reading, at, work):
    """Linearise where a and alpha of the sample are, and put its innovations into ``work``."""
    fit = work.fit
    for attempt in range(2):
        linearise(channels, at, work)
        for c in range(len(channels)):
            work.innovation[c] = 0.0
            if fit.used[c]:
                work.innovation[c] = innovation_of(
                    reading[c], work.expected[c], work.entries[c], work.touched[c], work.row[c],
                    state.x, at)
        if attempt == 0:
            for i in range(3):
                for c in range(len(channels)):
                    at[ACC + i] += fit.solve[i, c] * work.innovation[c]
                    at[ALPHA + i] += fit.solve[3 + i, c] * work.innovation[c] / p.radius


@njit
def _shared(state, work, c, d):
    """Covariance of what biases and mounting make of the readings of channels c and d."""
    value = 0.0
    for k in range(9, work.entries[c]):
        for j in range(9, work.entries[d]):
            value += (work.row[c, k] * work.row[d, j]
                      * state.cov[work.touched[c, k], work.touched[d, j]])
    return value


@njit
def _squares(state, p, channels, reading, at, work):
    """The :class:`Squares` of a sample: a and alpha are eliminated, biases and mounting count with
    their covariance."""
    _linearise_at_fit(state, p, channels, reading, at, work)
    used = np.flatnonzero(work.fit.used)
    count = len(used)
    total, linear, squares = np.zeros((count, count)), np.zeros((count, 6)), np.zeros((count, 6))
    left = np.empty(count)
    noisiness = factor(state.adaptation[0].noise)
    u, r = work.scratch[0], work.scratch[1]
    for a in range(count):
        c = used[a]
        mounted(channels[c], at, u, r)
        for i in range(3):
            linear[a, i] = work.row[c, 3 + i] / p.radius
            linear[a, 3 + i] = work.row[c, 6 + i]
            squares[a, i] = u[i] * r[i]
        squares[a, 3] = u[0] * r[1] + u[1] * r[0]
        squares[a, 4] = u[0] * r[2] + u[2] * r[0]
        squares[a, 5] = u[1] * r[2] + u[2] * r[1]
        left[a] = work.innovation[c]
        for b in range(a, count):
            total[a, b] = total[b, a] = _shared(state, work, c, used[b])
        total[a, a] += noisiness * noise_variance(channels[c], p)
    left += squares @ _products(state.x[OMEGA:ALPHA])
    weight = np.ascontiguousarray(np.linalg.inv(total))
    against = weight @ linear
    weight -= against @ np.linalg.solve(linear.T @ against, against.T.copy())
    weighted = weight @ squares
    return Squares(squares.T @ weighted, weighted.T @ left, float(left @ weight @ left),
                   work.fit.redundancy[0])


@njit
def _inverse(matrix):
    """Of a symmetric matrix."""
    found = np.linalg.inv(matrix)
    return np.ascontiguousarray(0.5 * (found + found.T))


@njit
def _products(w):
    """S (6,) of an angular velocity."""
    s = np.empty(6)
    for i in range(6):
        s[i] = 0.5 * (w @ _BEND[i] @ w)
    return s


@njit
def _slope(w):
    """Derivative (6, 3) of S."""
    slope = np.empty((6, 3))
    for i in range(6):
        slope[i] = _BEND[i] @ w
    return slope


@njit
def _solution(said, before):
    """The angular velocity (3,) that fits best: that before, or the solution for S, with the sign
    that is nearer to it."""
    scale = np.trace(said.information) / 6.0
    solved = np.linalg.solve(said.information + 1e-9 * scale * np.eye(6), said.pull)
    # S - tr(S) / 2 is w w'.
    outer = np.empty((3, 3))
    outer[0, 1] = outer[1, 0] = solved[3]
    outer[0, 2] = outer[2, 0] = solved[4]
    outer[1, 2] = outer[2, 1] = solved[5]
    half = 0.5 * (solved[0] + solved[1] + solved[2])
    for i in range(3):
        outer[i, i] = solved[i] - half
    k = int(np.argmax(np.diag(outer)))
    if outer[k, k] <= 0.0:
        return before
    other = outer[k] / math.sqrt(outer[k, k])
    if _cost(said, before) <= _cost(said, other):
        return before
    return other if other @ before >= 0.0 else -other


@njit
def _cost(said, w):
    s = _products(w)
    return said.least - 2.0 * (said.pull @ s) + s @ said.information @ s


@njit
def _believed(said, start):
    """What is said; less, where not even the best solution fits."""
    share = 1.0 / max(1.0, _cost(said, start) / said.redundancy / _MISFIT)
    return Squares(share * said.information, share * said.pull, share * said.least,
                   said.redundancy)


@njit
def _mode(said, before, known, start):
    """The :class:`Mode` about a start (3,), from the mean (3,) and precision (3, 3) before."""
    bent = np.zeros((3, 3, 3, 3))
    strength = 0.0
    for i in range(3):
        left = said.information @ np.ascontiguousarray(_BEND[:, :, i])
        for j in range(3):
            bent[i, j] = np.ascontiguousarray(_BEND[:, :, j]).T @ left
        strength += np.trace(bent[i, i])
    mean = start.copy()
    slope = _slope(mean)
    precision = (known + slope.T @ said.information @ slope
                 + math.sqrt(strength / 9.0) * np.eye(3))
    cov = _inverse(precision)
    spread, curvature = np.zeros(6), np.zeros((3, 3))
    for _ in range(_ITERATIONS):
        for i in range(6):
            spread[i] = 0.5 * np.sum(_BEND[i] * cov)
        curvature[:] = 0.0
        for i in range(3):
            for j in range(3):
                curvature += cov[i, j] * bent[i, j]
        curvature = 0.5 * (curvature + curvature.T)
        slope = _slope(mean)
        # Half way: cov goes with the inverse of what it makes of the curvature.
        precision = 0.5 * (precision + known + slope.T @ said.information @ slope + curvature)
        residual = said.pull - said.information @ (_products(mean) + spread)
        mean = mean + np.linalg.solve(precision, known @ (before - mean) + slope.T @ residual
                                      - curvature @ mean)
        cov = _inverse(precision)
    slope = _slope(mean)
    expected = _products(mean) + spread
    off = mean - before
    cost = (said.least - 2.0 * (said.pull @ expected) + expected @ said.information @ expected
            + np.sum(cov * (slope.T @ said.information @ slope)) + 0.5 * np.sum(cov * curvature)
            + off @ known @ off + np.sum(known * cov))
    return Mode(mean, cov, curvature, 0.5 * (math.log(np.linalg.det(cov)) - cost))


@njit
def _take_in(state, precision, pull, trace, n):
    """Multiply the State by what is told of the angular velocity: its log is
    ``pull w - w' precision w / 2``. By up to three updates, as the smoother knows them, whose
    variance may be negative: two solutions may be further apart than was thought possible."""
    told, turn = np.linalg.eigh(precision)
    index = np.arange(OMEGA, OMEGA + TOUCHED)
    first = trace.total.shape[1] - RATE_ROWS
    for k in range(2, -1, -1):    # the surest first: what is known stays positive
        row = np.zeros(TOUCHED)
        row[:3] = turn[:, k]
        prior, reading = 0.0, 0.0
        for i in range(3):
            reading += turn[i, k] * pull[i]
            for j in range(3):
                prior += row[i] * row[j] * state.cov[OMEGA + i, OMEGA + j]
        if abs(told[k]) * prior < 1e-9:
            continue
        innovation = reading / told[k] - row[:3] @ state.x[OMEGA:ALPHA]
        slot = first + k
        column, total = trace.column[n, slot:slot + 1], trace.total[n, slot:slot + 1]
        scalar_update(state.x, state.cov, index, row, 3, innovation, 1.0 / told[k], column, total,
                      0, len(state.x))
        put_updates(state.cov, column, total, len(state.x))
        trace.innovation[n, slot] = innovation
        trace.row[n, slot] = row
