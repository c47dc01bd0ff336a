"""A bank of hypotheses: the same filter under each, and what they say together.

What is not known of a recording beforehand, such as how much the field of a place differs from its
surroundings, is no number to be tuned but a few hypotheses that the samples decide between: each
has a state and parameters of its own, is handed the same samples, and keeps the log likelihood of
its measurements (multiple-model estimation: Bar-Shalom, Li, Kirubarajan 2001, 11.6, with models
that do not switch). What comes out is the mixture with its mean and its covariance, so that a
disagreement between hypotheses that are about as likely is part of the covariance.
"""

import math

import numpy as np

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import fusion, hard_iron
from imu_fusion.estimation.orientation.rows import FLAG_NO_HEADING, ORIENTATION_DTYPE
from imu_fusion.geometry.rotation import (
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_to_matrix,
)
from imu_fusion.kernels import njit

# Innovations repeat each other: blocks of 20 ms are taken as white by the filter, while what moves
# the innovations lasts for seconds (the sum of their autocorrelation is 1 to 4 s on a hand, a phone
# and a robot). The log likelihood counts what repeats within 3 s once.
_REPEATS = 150.0
# Weight in the covariance of going round after a start in motion, where nothing tells against it.
_DOUBT = 1.0 / 3.0
_NEGLIGIBLE = 1e-6         # weight of a hypothesis that changes nothing any more
_NO_TAPE = np.empty(0, es.TAPE)


@njit
def step(state, par, stamp, sample, row):
    """:func:`fusion.step` of every hypothesis; ``row`` gets their mixture.

    Args:
        state, par: (k,), one element per hypothesis; state in place.
        stamp, sample: of fusion.step.
        row: the output row.
    """
    used = len(state)
    if state[0].field_norm == 0.0 and state[0].queue.count == 0:
        # Without a magnetometer the hypotheses of the field are one.
        used = par[0].without_field
    else:
        part(state, par)
    if used == 1:
        result = fusion.step(state[0], par[0], stamp, sample, row, _NO_TAPE)
        _look_for_iron(state, par, used)
        return result
    rows = np.empty(used, ORIENTATION_DTYPE)
    result = 0
    for k in range(used):
        result = fusion.step(state[k], par[k], stamp, sample, rows[k], _NO_TAPE)
    if result > 0:
        weight = weights(state, par)
        mix(rows, weight, doubts(state, par, weight), row)
    _look_for_iron(state, par, used)
    return result


@njit
def _look_for_iron(state, par, used):
    """Where the magnetometer has shown hard iron, the heading is unsure under all hypotheses."""
    s = state[0]
    if s.iron_shown:
        s.iron_shown = False
        if hard_iron.judge(s.hard_iron, par[0].fusion.mag_offset_sd):
            hard_iron.doubt_heading(s.hard_iron, s.field_norm * math.hypot(s.field[0], s.field[1]))
            for k in range(1, used):
                state[k].hard_iron = s.hard_iron


@njit
def part(state, par):
    """Let hypotheses go on from the one of another field that they were one with so far."""
    for k in range(par[0].without_field, len(state)):
        if state[k].stamp != state[0].stamp:
            state[k] = state[k - par[0].without_field]


@njit
def weights(state, par):
    """Weights (k,) of the hypotheses by what was measured so far; the sum is 1, those that are
    negligible, or still one with another, are 0.

    A hand that is carried further than it was said to be looks like laps: where accelerations last,
    positions are as likely as under the likeliest other hypothesis.
    """
    out = np.full(len(state), -math.inf)
    placed, best = 0.0, -math.inf
    for lasting in (False, True):
        for k in range(len(state)):
            if (_takes_part(state, k) and (par[k].lasting_acc_sd > 0.0) == lasting
                    and not _is_doubt(state, par, k)):
                positions = placed if lasting else state[k].position_likelihood
                out[k] = (state[k].log_likelihood + positions) / _REPEATS + par[k].log_prior
                if not lasting and out[k] > best:
                    placed, best = positions, out[k]
    largest = out.max()
    total = 0.0
    for k in range(len(state)):
        weight = math.exp(out[k] - largest)
        out[k] = weight if weight > _NEGLIGIBLE else 0.0
        total += out[k]
    return out / total


@njit
def _takes_part(state, k):
    return state[k].started and state[k].stamp == state[0].stamp


@njit
def _is_doubt(state, par, k):
    """Whether a hypothesis takes part in the covariance alone. After a start in motion, where tilt
    and bias begin unknown, lasting accelerations explain what there is, a hand's translations too:
    samples can tell against them, and not for them."""
    return state[k].began_in_motion and par[k].lasting_acc_sd > 0.0


@njit
def doubts(state, par, weight):
    """Weights (k,), beside those of :func:`weights`, by which hypotheses that the mean does not
    follow are part of its covariance."""
    out = np.zeros(len(state))
    best = likeliest(weight)
    most = state[best].log_likelihood / _REPEATS + par[best].log_prior
    for k in range(len(state)):
        if _takes_part(state, k) and _is_doubt(state, par, k):
            out[k] = _DOUBT * math.exp(min(state[k].log_likelihood / _REPEATS - most, 0.0))
    return out


@njit
def likeliest(weight):
    """Index of the largest weight."""
    best = 0
    for k in range(1, len(weight)):
        if weight[k] > weight[best]:
            best = k
    return best


@njit
def mix(rows, weight, doubt, row):
    """Write the mixture of rows (k,) ORIENTATION_DTYPE with weights and doubts (k, or more that are
    zero) to ``row``.

    Attitude and numbers are means, covariances those of the mixture: the mean one and the spread
    of the means, with that of doubted ones about them. Stamp, flags and what belongs to the sample
    are the likeliest row's. Without a heading the spread is that of the verticals, and so is that
    of doubted ones.
    """
    best = likeliest(weight)
    row.stamp, row.flags = rows[best].stamp, rows[best].flags
    row.mag_count, row.reliability = rows[best].mag_count, rows[best].reliability
    for i in range(4):
        row.quat_world_imu[i] = rows[best].quat_world_imu[i]
    for i in range(3):
        row.gyr[i], row.acc[i] = rows[best].gyr[i], rows[best].acc[i]
        row.gyr_bias[i], row.gyr_bias_sd[i] = rows[best].gyr_bias[i], rows[best].gyr_bias_sd[i]
        row.mag_world[i] = rows[best].mag_world[i]
        for j in range(3):
            row.cov_attitude[i, j] = rows[best].cov_attitude[i, j]
            row.cov_gyr[i, j] = rows[best].cov_gyr[i, j]
            row.cov_acc[i, j] = rows[best].cov_acc[i, j]
    if weight[best] < 1.0 or doubt.max() > 0.0:
        _mix_attitude(rows, weight, doubt, best, row)
        _mix_bias(rows, weight, doubt, row)


@njit
def _mix_attitude(rows, weight, doubt, best, row):
    """Mean attitude and its covariance, about the likeliest row's."""
    back = quat_conjugate(rows[best].quat_world_imu)
    off = np.empty((len(rows), 3))
    mean = np.zeros(3)
    for k in range(len(rows)):
        if weight[k] + doubt[k] == 0.0:
            continue
        if doubt[k] > 0.0 or rows[best].flags & FLAG_NO_HEADING:
            apart = _leaned(rows[best].quat_world_imu, rows[k].quat_world_imu)
        else:
            apart = quat_log(quat_normalize(quat_multiply(back, rows[k].quat_world_imu)))
        for i in range(3):
            off[k, i] = apart[i]
            mean[i] += weight[k] * apart[i]
    cov = np.zeros((3, 3))
    for k in range(len(rows)):
        if weight[k] + doubt[k] == 0.0:
            continue
        # From the axes of this row to those of the mean.
        r = quat_to_matrix(quat_exp((off[k, 0] - mean[0], off[k, 1] - mean[1],
                                     off[k, 2] - mean[2]), 1.0))
        own = rows[k].cov_attitude
        for i in range(3):
            for j in range(3):
                part = 0.0
                for a in range(3):
                    for b in range(3):
                        part += r[i, a] * own[a, b] * r[j, b]
                cov[i, j] += weight[k] * part + (weight[k] + doubt[k]) * (
                    (off[k, i] - mean[i]) * (off[k, j] - mean[j]))
    row.quat_world_imu[:] = quat_normalize(quat_multiply(rows[best].quat_world_imu,
                                                         quat_exp(mean, 1.0)))
    row.cov_attitude[:] = cov


@njit
def _leaned(quat, other):
    """Rotation vector, imu axes of ``quat``, by which another attitude leans: no turn about up."""
    up = quat_rotate(quat_conjugate(other), (0.0, 0.0, 1.0))
    down = quat_rotate(quat_conjugate(quat), (0.0, 0.0, 1.0))
    across = (up[1] * down[2] - up[2] * down[1], up[2] * down[0] - up[0] * down[2],
              up[0] * down[1] - up[1] * down[0])
    sine = math.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2)
    cosine = up[0] * down[0] + up[1] * down[1] + up[2] * down[2]
    scale = math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0
    return (across[0] * scale, across[1] * scale, across[2] * scale)


@njit
def _mix_bias(rows, weight, doubt, row):
    """Mean bias, and the rates and forces that follow from it, with their variances."""
    for i in range(3):
        bias = rate = force = 0.0
        for k in range(len(rows)):
            bias += weight[k] * rows[k].gyr_bias[i]
            rate += weight[k] * rows[k].gyr[i]
            force += weight[k] * rows[k].acc[i]
        variance = var_rate = var_force = 0.0
        for k in range(len(rows)):
            off = rows[k].gyr_bias[i] - bias
            both = weight[k] + doubt[k]
            variance += weight[k] * rows[k].gyr_bias_sd[i] ** 2 + both * off * off
            var_rate += weight[k] * rows[k].cov_gyr[i, i] + both * (rows[k].gyr[i] - rate) ** 2
            var_force += weight[k] * rows[k].cov_acc[i, i] + both * (rows[k].acc[i] - force) ** 2
        row.gyr_bias[i], row.gyr[i], row.acc[i] = bias, rate, force
        row.gyr_bias_sd[i] = math.sqrt(variance)
        row.cov_gyr[i, i], row.cov_acc[i, i] = var_rate, var_force


@njit
def mix_all(rows, weight, doubt, out):
    """:func:`mix` of rows (k, n) with the same weights and doubts (k,), to ``out`` (n,)."""
    here = np.empty(len(rows), ORIENTATION_DTYPE)
    for n in range(len(out)):
        for k in range(len(rows)):
            here[k] = rows[k, n]
        mix(here, weight, doubt, out[n])
