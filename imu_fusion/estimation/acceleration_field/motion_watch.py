"""Is the motion as smooth as its densities say? Asked of every sample before it is used (numba).

Errors of mounting are in proportion to what is felt, so they hide how a motion goes on from sample
to sample in no way; but the filter, whose innovations may be as large as these errors, does not see
it, and would in the end blame the mounting for a motion that its densities do not allow. So each
component of the fit of a and alpha to the readings is followed on its own, by a Kalman filter of
two states that knows the noise and the densities and nothing else. Where its innovations are
larger than they should be, the densities are, too (see :mod:`.adaptation`), from that sample on.
"""

import numpy as np

from imu_fusion.estimation.acceleration_field.adaptation import (
    alternates,
    factor,
    note,
    summed,
)
from imu_fusion.estimation.acceleration_field.measurement import noise_variance
from imu_fusion.estimation.acceleration_field.motion_model import (
    ACC,
    ALPHA,
    OMEGA,
    add_motion_noise,
)
from imu_fusion.kernels import njit

# Columns of ADAPTATION's ``tracked``: a component, its rate, variances of both, their covariance,
# and its own summed excess, beyond _ALONE.
_VALUE, _RATE, _VV, _RR, _VR, _EXCESS = range(6)
_ALONE = 30.0   # how much more one component must exceed: chance makes it large more often than six


@njit
def watch_motion(state, p, channels, reading, at, step, work):
    """Follow the fit of a sample, and widen the covariance of the predicted State by what the
    motion is found to be wilder.

    Args:
        state: State, predicted to the sample.
        p: record of the parameters, channels: (m,) CHANNEL, reading: (m,),
            at: (N,) where they are linearised.
        step: the Step to this sample, of no length at the first one and after gaps.
        work: Workspace, after the cross-check.
    """
    fit, adaptation = work.fit, state.adaptation[0]
    if fit.redundancy[0] < 0:
        state.fitted[:] = False
        return
    values, variances = np.zeros(6), np.zeros(6)
    _fit_readings(state, p, channels, reading, at, work, values, variances)
    tracked = adaptation.tracked
    goes_on = step.dt[0] > 0.0
    for c in range(len(channels)):
        goes_on &= state.fitted[c] == fit.used[c]
        state.fitted[c] = fit.used[c]
    for i in range(6):
        if goes_on:
            _go_on(tracked[i], i, step)
            _add(tracked[i], i, p, step, factor(adaptation.motion))
        else:
            _start(tracked[i], i, state, p, values[i], work)
    if step.dt[0] > 0.0:
        _judge(state, p, step, values, variances)
    for i in range(6):
        _correct(tracked[i], values[i], variances[i])


@njit
def _start(own, i, state, p, value, work):
    """Begin to follow component i, whose fit is ``value``, where the filter predicts it."""
    at, unit = (ACC + i, 1.0) if i < 3 else (ALPHA + i - 3, p.radius)
    own[_VALUE], own[_RATE] = value, unit * state.x[at + 3]
    own[_VV] = unit * unit * state.cov[at, at]
    own[_VR] = unit * unit * state.cov[at, at + 3]
    own[_RR] = unit * unit * state.cov[at + 3, at + 3]
    for c in range(len(work.innovation)):
        own[_VALUE] -= work.fit.solve[i, c] * work.innovation[c]
        own[_VV] += work.fit.solve[i, c] * work.fit.solve[i, c] * work.variance[c]


@njit
def _judge(state, p, step, values, variances):
    """Take the densities to be larger by what the fit (6,), with variances (6,) of its noise, is
    off from what is predicted of it; widen all predictions by that."""
    adaptation = state.adaptation[0]
    tracked = adaptation.tracked
    before = factor(adaptation.motion)
    squares, largest = np.empty(6), np.empty(6)
    for i in range(6):
        square, total = (values[i] - tracked[i, _VALUE]) ** 2, tracked[i, _VV] + variances[i]
        squares[i] = square / total
        largest[i] = max(before + (square - total) / _noise(i, p, step)[0], 1.0)
    # Chance must not hide the onset of an impact.
    if not alternates(adaptation, 2.0):
        adaptation.motion = summed(adaptation.motion, squares.mean(), largest.max(), 0.0)
        # Once all are wider, five that fit would hide one that does not: blows have a direction.
        for i in range(6):
            alone = summed(tracked[i, _EXCESS] - _ALONE, squares[i], largest[i], -_ALONE)
            tracked[i, _EXCESS] = alone + _ALONE
            adaptation.motion = max(adaptation.motion, alone)
        note(adaptation, 1, adaptation.motion)
    wilder = max(factor(adaptation.motion) - before, 0.0)
    if wilder > 0.0:
        add_motion_noise(state.cov, p, step, wilder)
        for i in range(6):
            _add(tracked[i], i, p, step, wilder)


@njit
def _fit_readings(state, p, channels, reading, at, work, values, variances):
    """The fit (6,) of a and alpha (times the radius) to the readings as they are, but for the
    centripetal part, and the variances (6,) of its noise and of that part."""
    w, fit = at[OMEGA:OMEGA + 3], work.fit
    noisiness = factor(state.adaptation[0].noise)
    for c in range(len(channels)):
        if not fit.used[c]:
            continue
        u, r = channels[c].direction, channels[c].lever
        uw = u[0] * w[0] + u[1] * w[1] + u[2] * w[2]
        rw = r[0] * w[0] + r[1] * w[1] + r[2] * w[2]
        ur = u[0] * r[0] + u[1] * r[1] + u[2] * r[2]
        ww = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        value = reading[c] - uw * rw + ur * ww
        noise = noisiness * noise_variance(channels[c], p) + work.spun[c]
        for i in range(6):
            values[i] += fit.solve[i, c] * value
            variances[i] += fit.solve[i, c] * fit.solve[i, c] * noise


@njit
def _go_on(own, i, step):
    """Predict component i by its motion, without its noise."""
    if i < 3:
        vv, vr, rv, rr = 1.0, step.dt[0], 0.0, 1.0
    else:
        vv, vr, rv, rr = step.chain[2, 2], step.chain[2, 3], step.chain[3, 2], step.chain[3, 3]
    value, rate = own[_VALUE], own[_RATE]
    own[_VALUE], own[_RATE] = vv * value + vr * rate, rv * value + rr * rate
    a, b, c = own[_VV], own[_VR], own[_RR]
    own[_VV] = vv * vv * a + 2.0 * vv * vr * b + vr * vr * c
    own[_VR] = vv * rv * a + (vv * rr + vr * rv) * b + vr * rr * c
    own[_RR] = rv * rv * a + 2.0 * rv * rr * b + rr * rr * c


@njit
def _noise(i, p, step):
    """Variances of component i and of its rate, and their covariance, by the noise of a Step."""
    if i < 3:
        dt, q = step.dt[0], p.motion.acceleration_rate_density ** 2
        return q * dt ** 3 / 3.0, q * dt, 0.5 * q * dt * dt
    q = (p.motion.jerk_density * p.radius) ** 2
    return q * step.noise[2, 2], q * step.noise[3, 3], q * step.noise[2, 3]


@njit
def _add(own, i, p, step, wildness):
    """Add the noise of the motion of component i, ``wildness`` times."""
    vv, rr, vr = _noise(i, p, step)
    own[_VV] += wildness * vv
    own[_RR] += wildness * rr
    own[_VR] += wildness * vr


@njit
def _correct(own, value, variance):
    """Correct a component by what the readings say of it."""
    total = own[_VV] + variance
    by_value, by_rate = own[_VV] / total, own[_VR] / total
    innovation = value - own[_VALUE]
    own[_VALUE] += by_value * innovation
    own[_RATE] += by_rate * innovation
    own[_RR] -= by_rate * own[_VR]
    own[_VR] -= by_rate * own[_VV]
    own[_VV] -= by_value * own[_VV]
