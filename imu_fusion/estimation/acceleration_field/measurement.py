"""What a channel measures, and how a sample corrects the state of the rigid-body model (numba).

An accelerometer channel along the unit vector u at the position r from the reference point
reads ``u . (a + alpha x r + omega x (omega x r)) + bias`` (Rahaman 2019, eq. (2.33) in body
axes), a gyroscope channel ``u . omega + bias``. Measurements enter one channel at a time, so
that no matrix is inverted; each touches at most ten states.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.motion_model import ACC, ALPHA, BIAS, OMEGA
from imu_fusion.estimation.acceleration_field.rows import MISSING, SATURATED
from imu_fusion.kernels import njit

# States that one channel touches: omega, alpha, a and its own bias.
TOUCHED = 10


class Trace(NamedTuple):
    """What the smoother needs of a stretch of n samples; N = 18 + m states."""

    x: np.ndarray            # (n, N) mean after the sample
    cov: np.ndarray          # (n, N, N) after the sample
    phi: np.ndarray          # (n, 3) rotation of the step to it, rad
    dt: np.ndarray           # (n,) s, that step; negative across a gap, 0 for the first sample
    column: np.ndarray       # (n, m, N) covariance of the state with the channel's innovation
    total: np.ndarray        # (n, m) variance of the innovation; 0 marks an unused channel
    innovation: np.ndarray   # (n, m)
    row: np.ndarray          # (n, m, TOUCHED) of the measurement matrix


class Innovations(NamedTuple):
    """What all channels of a sample say together."""

    squares: float          # sum of their normalised squares
    log_likelihood: float
    used: int               # channels
    flags: int              # MISSING, SATURATED


def make_trace(samples: int, channels: int) -> Trace:
    """An empty :class:`Trace`."""
    n, size = samples, BIAS + channels
    return Trace(np.zeros((n, size)), np.zeros((n, size, size)), np.zeros((n, 3)), np.zeros(n),
                 np.zeros((n, channels, size)), np.zeros((n, channels)),
                 np.zeros((n, channels)), np.zeros((n, channels, TOUCHED)))


@njit
def noise_variance(channel, p):
    """Variance of the noise of one sample of a CHANNEL; p: record of the parameters."""
    sd = p.noise_scale * channel.density
    return sd * sd * p.sample_rate


@njit
def channel_row(channel, c, omega, index, h):
    """Indices and values of the row of channel number c, linearised at omega (3,).

    Returns (number of entries, constant): the reading is h . x[index] + constant.
    """
    u, r = channel.direction, channel.lever
    if channel.is_gyro:
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
def update(state, p, channels, reading, at, trace, n):
    """Correct the State by all channels of one sample, linearised at the angular velocity ``at``
    (3,), in place.

    p: record of the parameters, channels: (m,) CHANNEL, reading: (m,) with NaN for missing
    channels; a channel at its range is not used. The Trace gets sample n. Returns
    :class:`Innovations`.
    """
    index = np.empty(TOUCHED, np.int64)
    row = np.empty(TOUCHED)
    squares, log_likelihood, used, flags = 0.0, 0.0, 0, 0
    for c in range(len(channels)):
        channel = channels[c]
        trace.total[n, c] = 0.0
        if math.isnan(reading[c]):
            flags |= MISSING
            continue
        if abs(reading[c]) >= channel.range:
            flags |= SATURATED
            continue
        count, constant = channel_row(channel, c, at, index, row)
        innovation = reading[c] - constant
        for k in range(count):
            innovation -= row[k] * state.x[index[k]]
        total = scalar_update(state.x, state.cov, index, row, count, innovation,
                              noise_variance(channel, p), trace.column[n, c])
        trace.total[n, c] = total
        trace.innovation[n, c] = innovation
        trace.row[n, c] = row
        squares += innovation * innovation / total
        log_likelihood -= 0.5 * (math.log(2.0 * math.pi * total) + innovation * innovation / total)
        used += 1
    return Innovations(squares, log_likelihood, used, flags)
