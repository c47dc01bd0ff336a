"""What a channel measures, and how a sample corrects the state of the rigid-body model (numba).

An accelerometer channel along the unit vector u at the position r from the reference point
reads ``u . (a + alpha x r + omega x (omega x r)) + bias`` (Rahaman 2019, eq. (2.33) in body
axes), a gyroscope channel ``u . omega + bias``; u and r are off by the errors of the mounting, of
which that of the scale makes u longer.
Measurements enter one channel at a time, so that no matrix is inverted; each touches few states.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.adaptation import factor
from imu_fusion.estimation.acceleration_field.motion_model import (
    ACC,
    ACC_RATE,
    ALPHA,
    BIAS,
    JERK,
    OMEGA,
)
from imu_fusion.estimation.acceleration_field.rows import LEFT_OUT, MISSING, SATURATED
from imu_fusion.kernels import njit

# States that one channel touches: omega, alpha, a, its own bias and scale, its sensor's mounting.
TOUCHED = 17
#: Updates of the angular velocity that may precede those of the channels: see
#: :mod:`.hardly_known_rate`.
RATE_ROWS = 3


class Trace(NamedTuple):
    """What the smoother needs of a stretch of n samples of N states. The RATE_ROWS follow the m
    channels, but come before them in time."""

    x: np.ndarray            # (n, N) mean after the sample
    cov: np.ndarray          # (n, N, N) after the sample
    phi: np.ndarray          # (n, 3) rotation of the step to it, rad
    dt: np.ndarray           # (n,) s, that step; negative across a gap, 0 for the first sample
    column: np.ndarray       # (n, m + 3, N) covariance of the state with the channel's innovation
    total: np.ndarray        # (n, m + 3) variance of the innovation; 0 marks an unused channel
    innovation: np.ndarray   # (n, m + 3)
    row: np.ndarray          # (n, m + 3, TOUCHED) of the measurement matrix


class Innovations(NamedTuple):
    """What all channels of a sample say together."""

    squares: float          # sum of their normalised squares
    log_likelihood: float
    used: int               # channels
    flags: int              # MISSING, SATURATED, LEFT_OUT
    learnt: bool            # whether the mounting learnt from it


def make_trace(samples: int, channels: int, size: int) -> Trace:
    """An empty :class:`Trace` of a state of ``size`` N."""
    n, updates = samples, channels + RATE_ROWS
    return Trace(np.zeros((n, size)), np.zeros((n, size, size)), np.zeros((n, 3)), np.zeros(n),
                 np.zeros((n, updates, size)), np.zeros((n, updates)),
                 np.zeros((n, updates)), np.zeros((n, updates, TOUCHED)))


@njit
def noise_variance(channel, p):
    """Variance of the noise of one sample of a CHANNEL; p: record of the parameters."""
    sd = p.noise_scale * channel.density
    return sd * sd * p.sample_rate


@njit
def channel_row(channel, c, at, index, h, scratch):
    """Indices and values of the row of channel number c, linearised at a state ``at`` (N,).

    scratch: (3, 3), to work in. Returns (number of entries, reading expected at ``at``).
    """
    u, r, moment = scratch[0], scratch[1], scratch[2]
    mounted(channel, at, u, r)
    omega = at[OMEGA:ALPHA]
    uw = u[0] * omega[0] + u[1] * omega[1] + u[2] * omega[2]
    if channel.is_gyro:
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            index[i] = OMEGA + i
            h[i] = u[i]
            moment[i] = u[j] * omega[k] - u[k] * omega[j]
        index[3] = BIAS + c
        h[3] = 1.0
        return _put_axes(channel, at, uw, moment, index, h, 4), uw + at[BIAS + c]
    alpha, acc = at[ALPHA:JERK], at[ACC:ACC_RATE]
    rw = r[0] * omega[0] + r[1] * omega[1] + r[2] * omega[2]
    ur = u[0] * r[0] + u[1] * r[1] + u[2] * r[2]
    ww = omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2]
    felt = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        index[i] = OMEGA + i
        h[i] = u[i] * rw + r[i] * uw - 2.0 * ur * omega[i]
        index[3 + i] = ALPHA + i
        h[3 + i] = r[j] * u[k] - r[k] * u[j]
        index[6 + i] = ACC + i
        h[6 + i] = u[i]
        felt += u[i] * acc[i] + h[3 + i] * alpha[i] + 0.5 * h[i] * omega[i]
        force_j = acc[j] + alpha[k] * r[i] - alpha[i] * r[k] + omega[j] * rw - r[j] * ww
        force_k = acc[k] + alpha[i] * r[j] - alpha[j] * r[i] + omega[k] * rw - r[k] * ww
        moment[i] = u[j] * force_k - u[k] * force_j
    index[9] = BIAS + c
    h[9] = 1.0
    count = _put_axes(channel, at, felt, moment, index, h, 10)
    if channel.shift >= 0:
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            index[count + i] = channel.shift + i
            h[count + i] = u[j] * alpha[k] - u[k] * alpha[j] + uw * omega[i] - ww * u[i]
        count += 3
    return count, felt + at[BIAS + c]


@njit
def mounted(channel, at, u, r):
    """Direction u (3,), as long as the scale is, and lever r (3,) of a channel as mounted, by the
    state ``at``, in place."""
    d = channel.direction
    u[:] = d
    r[:] = channel.lever
    if channel.turn >= 0:
        # A rotation to the second order: to the first, 2 deg would make it longer by 0.1 %.
        t = at[channel.turn:channel.turn + 3]
        along = t[0] * d[0] + t[1] * d[1] + t[2] * d[2]
        size = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            u[i] += t[j] * d[k] - t[k] * d[j] + 0.5 * (along * t[i] - size * d[i])
    if channel.scale >= 0:
        for i in range(3):
            u[i] *= 1.0 + at[channel.scale]
    if channel.shift >= 0:
        for i in range(3):
            r[i] += at[channel.shift + i]


@njit
def _put_axes(channel, at, felt, moment, index, h, count):
    """Entries of the turn of a sensor's axes and of the scale of this one, from place ``count`` on:
    of the mounted direction and what is measured along it, ``felt`` is the dot product and moment
    (3,) the cross product. Returns the place behind them."""
    if channel.turn >= 0:
        t = at[channel.turn:channel.turn + 3]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            index[count + i] = channel.turn + i
            h[count + i] = moment[i] - 0.5 * (t[j] * moment[k] - t[k] * moment[j])
        count += 3
    if channel.scale >= 0:
        index[count] = channel.scale
        h[count] = felt / (1.0 + at[channel.scale])
        count += 1
    return count


@njit
def scalar_update(x, cov, index, h, count, innovation, variance, columns, totals, c, open_states):
    """Kalman update of the mean by one scalar with a sparse row, in place, as number c of some: of
    those before, the covariance knows nothing yet, see :func:`put_updates`.

    ``columns`` (c + 1, N) and ``totals`` (c + 1,) have P H' and the variance of the innovation of
    each, 0 for none, and get those of this one. Only the first ``open_states`` learn from it; what
    is stated of them includes the others' errors (Schmidt 1966).
    """
    column = columns[c]
    column[:] = 0.0
    for k in range(count):
        row, value = cov[index[k]], h[k]
        for i in range(len(x)):
            column[i] += value * row[i]
    for d in range(c):
        if totals[d] == 0.0:
            continue
        before = columns[d]
        learnt, kept = 0.0, 0.0
        for k in range(count):
            if index[k] < open_states:
                learnt += h[k] * before[index[k]]
            else:
                kept += h[k] * before[index[k]]
        kept = (learnt + kept) / totals[d]
        learnt = learnt / totals[d]
        for i in range(open_states):
            column[i] -= kept * before[i]
        for i in range(open_states, len(x)):
            column[i] -= learnt * before[i]
    total = variance
    for k in range(count):
        total += h[k] * column[index[k]]
    totals[c] = total
    for i in range(open_states):
        x[i] += column[i] * (innovation / total)


@njit
def put_updates(cov, columns, totals, open_states):
    """The covariance (N, N) after all updates by :func:`scalar_update`, in place: four at once, as
    reading and writing it takes longer than computing."""
    used = np.flatnonzero(totals)
    size = len(cov)
    width = (len(used) + 3) // 4 * 4
    moved, shares = np.zeros((width, size)), np.zeros((width, size))
    for k in range(len(used)):
        moved[k] = columns[used[k]]
        shares[k] = columns[used[k]] / totals[used[k]]
    for i in range(size):
        row, last = cov[i], min(i + 1, open_states)
        for k in range(0, width, 4):
            m0, m1, m2, m3 = moved[k, i], moved[k + 1, i], moved[k + 2, i], moved[k + 3, i]
            s0, s1, s2, s3 = shares[k], shares[k + 1], shares[k + 2], shares[k + 3]
            for j in range(last):
                row[j] -= m0 * s0[j] + m1 * s1[j] + m2 * s2[j] + m3 * s3[j]
        for j in range(last):
            cov[j, i] = row[j]


@njit
def linearise(channels, at, work):
    """Put the rows of all channels, linearised at a state ``at`` (N,), and what they expect there
    into the Workspace; with the mean of the squares of an angular velocity that is vague."""
    for c in range(len(channels)):
        work.entries[c], work.expected[c] = channel_row(channels[c], c, at, work.touched[c],
                                                      work.row[c], work.scratch)
        if work.is_settled[0] and not channels[c].is_gyro:
            u, r, vague = work.scratch[0], work.scratch[1], work.vague
            spin = vague[0, 0] + vague[1, 1] + vague[2, 2]
            for i in range(3):
                work.expected[c] += u[i] * (vague[i, 0] * r[0] + vague[i, 1] * r[1]
                                            + vague[i, 2] * r[2] - spin * r[i])


@njit
def innovation_of(reading, expected, count, index, row, x, at):
    """What a channel reads beyond what the state x (N,) expects; its row is linearised at ``at``,
    where ``expected`` is."""
    innovation = reading - expected
    for k in range(count):
        i = index[k]
        innovation -= row[k] * (x[i] - at[i])
    return innovation


@njit
def update(state, p, channels, reading, at, work, trace, n, open_states):
    """Correct the State by the channels in use of one sample, in place.

    Args:
        p: record of the parameters, channels: (m,) CHANNEL, reading: (m,), nan where there is none,
            inf where it is saturated and -inf where it stands still, at: (N,) the state that
            ``work`` is linearised at.
        work: Workspace, whose ``use`` says which channels are in use, and ``doubt`` what is added
            to the variance of their noise.
        trace: Trace that gets sample n.
        open_states: how many states learn, see :func:`scalar_update`.

    Returns :class:`Innovations`.
    """
    squares, log_likelihood, used, flags = 0.0, 0.0, 0, 0
    noisiness = factor(state.adaptation[0].noise)
    columns, totals = trace.column[n], trace.total[n, :len(channels)]
    for c in range(len(channels)):
        totals[c] = 0.0
        if not work.use[c]:
            flags |= unused_flags(reading[c], False)
            continue
        count, index, row = work.entries[c], work.touched[c], work.row[c]
        innovation = innovation_of(reading[c], work.expected[c], count, index, row, state.x, at)
        scalar_update(state.x, state.cov, index, row, count, innovation,
                      noisiness * noise_variance(channels[c], p) + work.doubt[c],
                      columns, totals, c, open_states)
        total = totals[c]
        trace.innovation[n, c] = innovation
        trace.row[n, c] = row
        squares += innovation * innovation / total
        log_likelihood -= 0.5 * (math.log(2.0 * math.pi * total) + innovation * innovation / total)
        used += 1
    put_updates(state.cov, columns, totals, open_states)
    learnt = open_states == len(state.x) or work.is_settled[0]
    return Innovations(squares, log_likelihood, used, flags, learnt)


@njit
def unused_flags(reading, use):
    """Why a channel is not used: MISSING, SATURATED, LEFT_OUT; 0 if it is."""
    if math.isnan(reading):
        return MISSING
    if reading == math.inf:
        return SATURATED
    return 0 if use else LEFT_OUT
