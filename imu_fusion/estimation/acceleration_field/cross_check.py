"""Do the accelerometers agree on one rigid motion? Asked of every sample before it is used (numba).

With the angular velocity known, a sample of m channels determines a and alpha and leaves m - 6
combinations over that must be as small as noise, biases and mounting allow (parity space: Potter
and Suman 1977; Sturza 1988). Where they are larger, one accelerometer without which all others
agree is left out of that sample; one that is left out time and again stays out until it is right.
What it said against what the others expect of it tells why: see :mod:`.sensor_faults`.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.measurement import (
    TOUCHED,
    innovation_of,
    linearise,
    noise_variance,
)
from imu_fusion.estimation.acceleration_field.motion_model import ACC, ALPHA, OMEGA
from imu_fusion.kernels import njit

#: What is kept of one accelerometer: samples in which it was ``checked``, ``left_out`` of them, and
#: ``doubted`` with all others; ``squares`` of its ``channels`` channel samples, what the fit leaves
#: over in units of what it may leave; ``evidence`` against it, whether it is ``faulty`` now, and
#: ``out`` of the present sample. Sums over samples left out, in its own axes, of what the others
#: ``expected`` e and of the reading y: e e', ``reading`` y e', ``read`` y and ``read_squares`` y^2,
#: ``unexplained`` (y - e)^2; normal equations ``place`` and ``pull`` of the shift of its position
#: that would explain it.
CHECK = np.dtype([
    ("checked", "i8"), ("left_out", "i8"), ("doubted", "i8"), ("squares", "f8"),
    ("channels", "i8"), ("evidence", "f8"), ("faulty", "?"), ("out", "?"),
    ("expected", "f8", (3, 3)), ("reading", "f8", (3, 3)), ("read", "f8", 3),
    ("read_squares", "f8"), ("unexplained", "f8"), ("place", "f8", (3, 3)), ("pull", "f8", 3)],
    align=True)

# Standard deviations by which what is left over may exceed zero.
_GATE = 5.0
_PROOF = 10.0       # samples left out that make an accelerometer faulty
_MOST = 50.0        # beyond which evidence does not grow
_TRUE = 1e-3        # of what it feels: no accelerometer is truer, whatever scale_sd says
_SHARE = 1e-3       # of a channel's reading that must be left over for a check of it
_FAR_BETTER = 10.0  # times smaller variances of a and alpha
_EXCITING = 20.0    # times the noise: what turning must make of readings to tell of the mounting
_LEFT = 0.2         # of the sds of a mounting, to which linearised rows may find it
_FORGET = 0.1       # of a sample's evidence, by one in which a moving sensor agrees


class Fit(NamedTuple):
    """The least-squares fit of a and alpha to certain channels, in place; see :func:`prepare`."""

    used: np.ndarray      # (m,) bool
    solve: np.ndarray     # (6, m) a and alpha (times the radius) of the channels
    rest: np.ndarray      # (m, m) what the fit leaves of the channels
    squared: np.ndarray   # (m, m) its elements squared
    redundancy: np.ndarray   # (1,) int, channels beyond six; negative if they do not determine them


class Workspace(NamedTuple):
    """What one sample is worked on in; says nothing of the sample before."""

    touched: np.ndarray    # (m, TOUCHED) states that the rows of the channels touch
    row: np.ndarray        # (m, TOUCHED) their values, see measurement.linearise; 0 beyond entries
    entries: np.ndarray    # (m,) int, how many of them
    expected: np.ndarray   # (m,) readings where they are linearised
    scratch: np.ndarray    # (3, 3)
    design: np.ndarray     # (m, 6) of a and alpha (times the radius); 0 of gyroscopes
    fit: Fit               # of the channels used last
    trial: Fit             # without one of them
    innovation: np.ndarray   # (m,) reading minus what is expected of it; 0 where there is none
    variance: np.ndarray   # (m,) of it, but for a and alpha
    spun: np.ndarray       # (m,) of it, what errors of the angular velocity make
    left: np.ndarray       # (m,) what the fit leaves over
    use: np.ndarray        # (m,) bool, the answer
    doubt: np.ndarray      # (m,) variance to add to that of the noise
    is_settled: np.ndarray   # (1,) bool, whether the angular velocity was hardly known before, and
    #                          what it is linearised at has been found: see hardly_known_rate
    is_open: np.ndarray      # (1,) bool, whether its sign is open
    vague: np.ndarray        # (3, 3) covariance about it


def make_workspace(channels: np.ndarray) -> Workspace:
    """A :class:`Workspace` of CHANNELs (m,)."""
    m = len(channels)
    lever, direction = channels["lever"], channels["direction"]
    felt = ~channels["is_gyro"]
    radius = max(float(np.sqrt(np.mean(np.sum(lever[felt] ** 2, axis=1)))), 1e-12)
    design = np.hstack([direction, np.cross(lever, direction) / radius]) * felt[:, None]

    def fit():
        return Fit(np.zeros(m, bool), np.zeros((6, m)), np.zeros((m, m)), np.zeros((m, m)),
                   np.full(1, -1, np.int64))
    return Workspace(
        np.zeros((m, TOUCHED), np.int64), np.zeros((m, TOUCHED)), np.zeros(m, np.int64),
        np.zeros(m), np.zeros((3, 3)), design, fit(), fit(), np.zeros(m), np.ones(m), np.zeros(m),
        np.zeros(m), np.zeros(m, bool), np.zeros(m), np.zeros(1, bool), np.zeros(1, bool),
        np.zeros((3, 3)))


@njit
def prepare(fit, design, used, max_condition):
    """Make the :class:`Fit` of the channels ``used`` (m,) bool, in place."""
    fit.used[:] = used
    m = len(used)
    chosen = np.zeros((m, 6))
    count = 0
    for c in range(m):
        if used[c]:
            chosen[c] = design[c]
            count += 1
    fit.redundancy[0] = -1
    if count < 6:
        return
    u, s, vt = np.linalg.svd(chosen, full_matrices=False)
    if s[5] * max_condition < s[0]:
        return
    fit.solve[:] = (vt.T / s) @ np.ascontiguousarray(u.T)
    fit.rest[:] = -chosen @ fit.solve
    for c in range(m):
        if used[c]:
            fit.rest[c, c] += 1.0
    fit.squared[:] = fit.rest * fit.rest
    fit.redundancy[0] = count - 6


@njit
def _worst(fit, work):
    """Largest square of what the fit leaves, in units of its variance; ``work.left`` gets it."""
    worst = 0.0
    m = len(work.left)
    for c in range(m):
        left, allowed = 0.0, 0.0
        rest, squared = fit.rest[c], fit.squared[c]
        for j in range(m):
            left += rest[j] * work.innovation[j]
            allowed += squared[j] * work.variance[j]
        work.left[c] = left
        # What a channel alone determines is never left over.
        if rest[c] > _SHARE:
            worst = max(worst, left * left / allowed)
    return worst


@njit
def cross_check(state, p, channels, reading, at, work):
    """Which channels of a sample can be used, and how far: ``work.use`` and ``work.doubt`` (m,), in
    place.

    Args:
        state: State predicted to the sample; its ``checks`` (K,) CHECK are brought up to date.
        p: record of the parameters, channels: (m,) CHANNEL, reading: (m,) m/s^2, nan or inf where
            there is none; at: (N,) the state that ``work`` is linearised at.
        work: Workspace.
    """
    m = len(channels)
    worst, changed = 0.0, False
    for c in range(m):
        work.use[c] = (math.isfinite(reading[c]) and not channels[c].is_gyro
                       and not state.checks[channels[c].sensor].faulty)
        changed |= work.use[c] != work.fit.used[c]
    if changed:
        prepare(work.fit, work.design, work.use, p.max_condition)
    for c in range(m):
        work.innovation[c] = 0.0
        if math.isfinite(reading[c]):
            work.innovation[c] = innovation_of(
                reading[c], work.expected[c], work.entries[c], work.touched[c], work.row[c],
                state.x, at)
            if work.is_settled[0]:    # there it is known
                for i in range(3):
                    work.innovation[c] += work.row[c, i] * (state.x[OMEGA + i] - at[OMEGA + i])
    if work.fit.redundancy[0] >= 0:
        _allow(state, p, channels, reading, at, work)
    if work.fit.redundancy[0] > 0:
        worst = _worst(work.fit, work)
        while worst > _GATE * _GATE and _leave_out(state, channels, work, worst, p):
            worst = _worst(work.fit, work)
        _remember(state.checks, channels, reading, work, worst)
    # Where no single one is to blame, all are to be doubted.
    doubt = worst if worst > _GATE * _GATE else 0.0
    for c in range(m):
        work.doubt[c] = doubt * work.variance[c]
        work.use[c] = math.isfinite(reading[c]) and (channels[c].is_gyro or work.fit.used[c]
                                                     or work.fit.redundancy[0] < 0)


@njit
def rate_covariance(state, work):
    """Covariance (3, 3) of the angular velocity about where it is linearised."""
    return work.vague if work.is_settled[0] else state.cov[OMEGA:ALPHA, OMEGA:ALPHA]


@njit
def contradiction(p, channels, work):
    """Mean square of what the fit of a sample leaves over, in units of noise; 1 if it can leave
    nothing."""
    if work.fit.redundancy[0] <= 0:
        return 1.0
    squares = 0.0
    for c in range(len(channels)):
        if work.fit.used[c]:
            squares += work.left[c] * work.left[c] / noise_variance(channels[c], p)
    return squares / work.fit.redundancy[0]


@njit
def linearise_well(state, p, channels, at, work):
    """Linearise again at what the fit of the sample makes of a and alpha, where it is far better
    than the prediction, where ``at`` (N,) is: when an impact begins. Elsewhere its errors, which
    are those of the innovations, would bias the mounting. Then add to ``work.doubt`` products of
    two errors, which no linearisation sees: of the mounting and of what it multiplies, and of the
    angular velocity with itself."""
    cov, fit = state.cov, work.fit
    spin, force, turning = np.trace(rate_covariance(state, work)), 0.0, 0.0
    for i in range(3):
        force += cov[ACC + i, ACC + i]
        turning += cov[ALPHA + i, ALPHA + i]
    if fit.redundancy[0] >= 0:
        by_fit = np.zeros(6)
        for i in range(6):
            for c in range(len(channels)):
                by_fit[i] += fit.solve[i, c] * fit.solve[i, c] * work.variance[c]
        felt = by_fit[0] + by_fit[1] + by_fit[2]
        turned = by_fit[3] + by_fit[4] + by_fit[5]
        if _FAR_BETTER * (felt + turned) < force + p.radius * p.radius * turning:
            force, turning = felt, turned / (p.radius * p.radius)
            for i in range(3):
                for c in range(len(channels)):
                    at[ACC + i] += fit.solve[i, c] * work.innovation[c]
                    at[ALPHA + i] += fit.solve[3 + i, c] * work.innovation[c] / p.radius
            linearise(channels, at, work)
    for c in range(len(channels)):
        channel = channels[c]
        turned, shifted, scaled = 0.0, 0.0, 0.0
        for i in range(3):
            if channel.turn >= 0:
                turned += cov[channel.turn + i, channel.turn + i]
            if channel.shift >= 0:
                shifted += cov[channel.shift + i, channel.shift + i]
        if channel.scale >= 0:
            scaled = cov[channel.scale, channel.scale]
        # Of two isotropic vectors a and b, (a x u) . b has 2/9 of their variances' product, u . b a
        # third of b's.
        r = channel.lever
        lever = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        felt = spin if channel.is_gyro else force + lever * turning
        work.doubt[c] += 2.0 / 9.0 * (turned * felt + shifted * turning) + scaled * felt / 3.0
        if not channel.is_gyro:
            work.doubt[c] += 0.5 * lever * spin * spin


@njit
def learns_mounting(state, p, channels, at, work):
    """Whether a sample tells of the mounting: where a body hardly turns, the rows of its states
    change with the noise of the state that they are linearised at, and would seem to. Beyond a
    share of what was known of it, errors of the linearisation would, too."""
    if work.is_settled[0] or not turns(p, channels, at, _EXCITING):
        return False
    left, first = 0.0, 0.0
    for c in range(len(channels)):
        channel = channels[c]
        for i in range(3):
            if channel.turn >= 0:
                left += state.cov[channel.turn + i, channel.turn + i] / channel.axes_sd ** 2
                first += 1.0
            if channel.shift >= 0:
                left += state.cov[channel.shift + i, channel.shift + i] / channel.position_sd ** 2
                first += 1.0
        if channel.scale >= 0:
            left += state.cov[channel.scale, channel.scale] / channel.scale_sd ** 2
            first += 1.0
    return left > _LEFT * _LEFT * first


@njit
def turns(p, channels, at, times):
    """Whether a body turns as at (N,) so much that it makes so many ``times`` the noise of the
    readings."""
    omega, alpha = at[OMEGA:ALPHA], at[ALPHA:ALPHA + 3]
    speed = omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2]
    turning = alpha[0] * alpha[0] + alpha[1] * alpha[1] + alpha[2] * alpha[2]
    noise = 0.0
    for c in range(len(channels)):
        noise = max(noise, noise_variance(channels[c], p))
    return p.radius * p.radius * (turning + speed * speed) > times * times * noise


@njit
def _allow(state, p, channels, reading, at, work):
    """The variances of the innovations that noise, bias, mounting and angular velocity allow.

    Those of mounting are of what is felt now: predictions come late when an impact begins.
    """
    squares, count = 0.0, 0
    cov = rate_covariance(state, work)
    spin = np.trace(cov)    # where the rate is unknown its square is, too
    for c in range(len(channels)):
        channel = channels[c]
        if channel.is_gyro or not math.isfinite(reading[c]):
            work.variance[c] = 1.0
            work.spun[c] = 0.0
            continue
        h, r = work.row[c], channel.lever
        spun = spin * spin * (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        for i in range(3):
            for j in range(3):
                spun += h[i] * cov[i, j] * h[j]
        work.spun[c] = spun
        work.variance[c] = noise_variance(channel, p) + channel.bias_sd * channel.bias_sd + spun
        squares += reading[c] * reading[c]
        count += 1
    omega = at[OMEGA:ALPHA]
    speed = omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2]
    turning = speed * speed
    for i in range(3):
        alpha = state.x[ALPHA + i]
        for c in range(len(channels)):
            alpha += work.fit.solve[3 + i, c] * work.innovation[c] / p.radius
        turning += alpha * alpha
    for c in range(len(channels)):
        channel = channels[c]
        work.variance[c] += ((channel.axes_sd * channel.axes_sd
                              + channel.scale_sd * channel.scale_sd + _TRUE * _TRUE)
                             * 3.0 * squares / count
                             + channel.position_sd * channel.position_sd * turning)


@njit
def _surprise(state, fit, work, radius):
    """Squares of what a fit changes of the predicted a and alpha, in units of their variances."""
    surprise = 0.0
    for i in range(6):
        change, allowed = 0.0, 0.0
        for c in range(len(work.innovation)):
            change += fit.solve[i, c] * work.innovation[c]
            allowed += fit.solve[i, c] * fit.solve[i, c] * work.variance[c]
        at, unit = (ACC + i, 1.0) if i < 3 else (ALPHA + i - 3, radius)
        surprise += change * change / (allowed + unit * unit * state.cov[at, at])
    return surprise


@njit
def _leave_out(state, channels, work, worst, p):
    """Leave out the accelerometer without which the others agree, and best fit to the prediction:
    three that agree may do so on another motion. If there is none, that without which they agree
    best, where there are enough for a next one. Returns whether one was left out."""
    best, least, chosen = worst, np.inf, -1
    use = np.empty(len(channels), np.bool_)
    for sensor in range(len(state.checks)):
        any_used = False
        for c in range(len(channels)):
            own = channels[c].sensor == sensor
            any_used |= own and work.fit.used[c]
            use[c] = work.fit.used[c] and not own
        if not any_used:
            continue
        prepare(work.trial, work.design, use, p.max_condition)
        if work.trial.redundancy[0] < 1:
            continue
        without = max(_worst(work.trial, work), _GATE * _GATE)
        surprise = _surprise(state, work.trial, work, p.radius)
        if without < best or (without == best and surprise < least):
            best, least, chosen = without, surprise, sensor
    if chosen < 0 or (best > _GATE * _GATE and best > 0.25 * worst):
        return False
    for c in range(len(channels)):
        use[c] = work.fit.used[c] and channels[c].sensor != chosen
    prepare(work.fit, work.design, use, p.max_condition)
    return True


@njit
def _remember(checks, channels, reading, work, worst):
    """Bring the CHECKs up to date, by what the fit of the channels in use expects of all, and the
    ``worst`` of what it leaves over."""
    fit, m = work.fit, len(channels)
    for sensor in range(len(checks)):
        checks[sensor].out = False
    for c in range(m):
        channel = channels[c]
        if channel.is_gyro or not math.isfinite(reading[c]):
            continue
        check = checks[channel.sensor]
        if not fit.used[c]:
            check.out = True
            work.left[c] = work.innovation[c]
            for i in range(6):
                for j in range(m):
                    work.left[c] -= work.design[c, i] * fit.solve[i, j] * work.innovation[j]
        check.squares += work.left[c] * work.left[c] / work.variance[c]
        check.channels += 1
    for sensor in range(len(checks)):
        checks[sensor].checked += 1
        checks[sensor].doubted += worst > _GATE * _GATE
        if checks[sensor].out:
            _add_evidence(checks[sensor], sensor, channels, reading, work)
        elif checks[sensor].evidence > 0.0:
            checks[sensor].evidence -= _FORGET


@njit
def _add_evidence(check, sensor, channels, reading, work):
    """What one sample that was left out says of an accelerometer."""
    expected, read = np.zeros(3), np.zeros(3)
    contradicts, moves = False, False
    for c in range(len(channels)):
        if channels[c].sensor != sensor or not math.isfinite(reading[c]):
            continue
        axis = channels[c].column % 3
        left, limit = work.left[c], _GATE * math.sqrt(work.variance[c])
        read[axis], expected[axis] = reading[c], reading[c] - left
        contradicts |= abs(left) > limit
        moves |= abs(expected[axis]) > 2.0 * limit
        check.unexplained += left * left
        # The derivative by a shift of the sensor stands last in the row, where there is one.
        h = work.row[c, work.entries[c] - 3:work.entries[c]]
        for i in range(3):
            check.pull[i] += h[i] * left
            for j in range(3):
                check.place[i, j] += h[i] * h[j]
    check.left_out += 1
    for i in range(3):
        check.read[i] += read[i]
        check.read_squares += read[i] * read[i]
        for j in range(3):
            check.expected[i, j] += expected[i] * expected[j]
            check.reading[i, j] += read[i] * expected[j]
    if contradicts:
        check.evidence = min(check.evidence + 1.0, _MOST)
    elif moves:
        # At rest a dead sensor agrees, too.
        check.evidence -= _FORGET
    if check.evidence >= _PROOF:
        check.faulty = True
    elif check.evidence < 0.5 * _PROOF:
        check.faulty = False
