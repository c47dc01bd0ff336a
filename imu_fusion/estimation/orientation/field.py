"""The magnetometer in the fusion filter: first field, heading, samples of a block."""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import state as st
from imu_fusion.estimation.orientation.fusion_layout import (
    BLOCK_MAGS, COV, HEADING_VAR, MAG_SUM, MOVE, N, NORM, P_HEADING_SD, P_LOCAL_SD,
    P_MAG_RELATIVE, P_NORM_FACTOR, P_OFFSET_SD, P_SOFT_SD, S, WORLD_TURNED)
from imu_fusion.geometry.rotation import (
    quat_exp, quat_multiply, quat_rotate, quat_rotate_inverse, quat_to_matrix)

_FIRST_FIELD_SD = 2e-3     # relative: noise of the field that the alignment averages
_MAG_STATES = 17           # attitude (2), field, local, lag, offset (3), matrix (9)
# Degrees of freedom of the residual's distribution. Few, since the errors of a field indoors
# are no Gaussian's; from 3 to 9 nothing depends on it.
_TAIL_DOF = 5.0


@njit
def start_field(x, k, par, z, has_heading, follow):
    """Begin the field states with ``z`` (3,) tesla, measured here and now, world axes.

    The first sample makes the field share the tilt's error. With ``has_heading`` the
    heading has no error but a constant one, or with ``follow`` = 1 one that is known as well
    as tilt and calibration, and is corrected when these are.
    """
    cov = x[COV:COV + N * N].reshape(N, N)
    x[NORM] = math.sqrt(z[0] ** 2 + z[1] ** 2 + z[2] ** 2)
    b = z / x[NORM]
    x[S + es.FIELD:S + es.FIELD + 3] = b
    for i in range(es.FIELD, es.OFFSET):
        cov[i, :] = 0.0
        cov[:, i] = 0.0
        cov[i, i] = 1.0 if i < es.LOCAL else par[P_LOCAL_SD] ** 2
    if has_heading:
        cov[es.ATT + 2, es.ATT + 2] += follow
        # What is left of hard and soft iron turns the needle and stays in the heading.
        iron = ((par[P_OFFSET_SD] ** 2 + par[P_SOFT_SD] ** 2)
                / max(b[0] ** 2 + b[1] ** 2, 1e-4))
        x[HEADING_VAR] = min(par[P_HEADING_SD] ** 2 + iron, st.UNIFORM_VARIANCE) * (1.0 - follow)
        k[st.HEADING_KNOWN] = 1
    quat = x[st.Q:st.Q + 4]
    r = quat_to_matrix(quat)
    m = quat_rotate_inverse(quat, b)
    index = np.empty(_MAG_STATES, dtype=np.int64)
    row = np.empty(_MAG_STATES)
    error = np.zeros(N)
    states = len(error)
    for i in range(3):
        _mag_row(i, b, index, row)
        row[4] = 0.0
        for c in range(3):
            row[5 + c] = r[i, c] * follow
            for d in range(3):
                row[8 + 3 * c + d] = r[i, c] * m[d] * follow
        es.update(cov, error, states, index, row, 0.0, _FIRST_FIELD_SD ** 2, np.empty(0))
    if has_heading and follow:
        for c in range(2):
            index[c], index[2 + c] = es.FIELD + c, es.LOCAL + c
        row[0] = row[2] = math.cos(par[st.P_DECLINATION])
        row[1] = row[3] = -math.sin(par[st.P_DECLINATION])
        es.update(cov, error, states, index[:4], row[:4], 0.0, _FIRST_FIELD_SD ** 2, np.empty(0))


@njit
def _mag_row(i, field, index, row):
    """Row i of the magnetometer's measurement: attitude, field and local; indices of all."""
    j, m = (i + 1) % 3, (i + 2) % 3
    index[0], row[0] = es.ATT + m, field[j]
    index[1], row[1] = es.ATT + j, -field[m]
    index[2], row[2] = es.FIELD + i, 1.0
    index[3], row[3] = es.LOCAL + i, 1.0
    index[4] = es.LAG
    for c in range(3):
        index[5 + c] = es.OFFSET + c
    for c in range(9):
        index[8 + c] = es.SOFT + c


@njit
def _fix_heading(x, k, par, z):
    """Turn the world about up so that ``z`` (3,) tesla, world axes, points magnetic north."""
    k[WORLD_TURNED] = 1
    horizontal = math.hypot(z[0], z[1])
    norm = math.sqrt(horizontal ** 2 + z[2] ** 2)
    known = horizontal >= 0.02 * norm
    # The needle points to azimuth D: east sin D, north cos D.
    angle = 0.5 * math.pi - par[st.P_DECLINATION] - math.atan2(z[1], z[0]) if known else 0.0
    turn = quat_exp((0.0, 0.0, angle))
    x[st.Q:st.Q + 4] = quat_multiply(turn, x[st.Q:st.Q + 4])
    cov = x[COV:COV + N * N].reshape(N, N)
    for group in (es.ATT, es.VEL, es.POS):
        x[S + group:S + group + 3] = quat_rotate(turn, x[S + group:S + group + 3])
        for j in range(N):
            cov[group:group + 3, j] = quat_rotate(turn, cov[group:group + 3, j])
        for j in range(N):
            cov[j, group:group + 3] = quat_rotate(turn, cov[j, group:group + 3])
    # The sensor may be moving: what it shows now is no anchor.
    start_field(x, k, par, np.array(quat_rotate(turn, z)), known, 1.0 if known else 0.0)


@njit
def _calibrated(x, raw):
    """A sample relative to the field's norm, less offset and soft iron as known so far: a tuple."""
    offset, soft = S + es.OFFSET, S + es.SOFT
    return (raw[0] - x[offset] - x[soft] * raw[0] - x[soft + 1] * raw[1] - x[soft + 2] * raw[2],
            raw[1] - x[offset + 1] - x[soft + 3] * raw[0] - x[soft + 4] * raw[1]
            - x[soft + 5] * raw[2],
            raw[2] - x[offset + 2] - x[soft + 6] * raw[0] - x[soft + 7] * raw[1]
            - x[soft + 8] * raw[2])


@njit
def collect_mags(x, k, par, samples, count):
    """Add magnetometer samples to the block; returns the reliability (10) of their mean.

    samples: rows of take_mags. The mean in present imu axes goes to samples[0, :3], tesla.
    """
    lag_row, offset_row, soft_row = MAG_SUM + 3, MAG_SUM + 6, MAG_SUM + 15
    quat = x[st.Q:st.Q + 4]
    if x[NORM] == 0.0 and count > 0:
        _fix_heading(x, k, par, quat_rotate(quat_multiply(quat, samples[0, 6:10]),
                                            samples[0, :3]))
        quat = x[st.Q:st.Q + 4]
    norm = x[NORM]
    mean = (0.0, 0.0, 0.0)
    for s in range(count):
        raw = (samples[s, 0] / norm, samples[s, 1] / norm, samples[s, 2] / norm)
        m = _calibrated(x, raw)
        rate = samples[s, 3:6]
        r = quat_to_matrix(quat_multiply(quat, samples[s, 6:10]))
        drag = (rate[1] * m[2] - rate[2] * m[1], rate[2] * m[0] - rate[0] * m[2],
                rate[0] * m[1] - rate[1] * m[0])
        for i in range(3):
            for j in range(3):
                x[MAG_SUM + i] += r[i, j] * m[j]
                x[lag_row + i] += r[i, j] * drag[j]
                x[offset_row + 3 * i + j] += r[i, j]
                for c in range(3):
                    x[soft_row + 9 * i + 3 * j + c] += r[i, j] * raw[c]
        now = quat_rotate(samples[s, 6:10], m)
        mean = (mean[0] + now[0] / count, mean[1] + now[1] / count, mean[2] + now[2] / count)
        k[BLOCK_MAGS] += 1
    for i in range(3):
        samples[0, i] = mean[i] * norm
    size = math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    return math.exp(-(par[st.P_RELIABILITY] * (1.0 - size)) ** 2)


@njit
def update_mag(x, k, par, error, still, tape):
    """The block's mean magnetometer sample against the field.

    Its noise is Student's t: the further the sample is from what was expected, the less
    it weighs, however its norm may look.
    """
    cov = x[COV:COV + N * N].reshape(N, N)
    count = k[BLOCK_MAGS]
    z = x[MAG_SUM:MAG_SUM + 3] / count
    lag_row, offset_row, soft_row = MAG_SUM + 3, MAG_SUM + 6, MAG_SUM + 15
    expected = x[S + es.FIELD:S + es.FIELD + 3] + x[S + es.LOCAL:S + es.LOCAL + 3]
    deviation = abs(math.sqrt(z[0] ** 2 + z[1] ** 2 + z[2] ** 2) - 1.0)
    time = x[MOVE + es.MOVE_TIME]
    states = int(x[MOVE + es.MOVE_STATES])
    sd = par[P_MAG_RELATIVE] + par[P_NORM_FACTOR] * deviation
    # White over 20 ms: faster sampling of the same disturbance is no news.
    variance = sd * sd * max(0.02 / time, 1.0 / count) + (par[st.P_MAG_SD] / x[NORM]) ** 2 / count
    index = np.empty((3, _MAG_STATES), dtype=np.int64)
    row = np.empty((3, _MAG_STATES))
    distance = 0.0
    for i in range(3):
        _mag_row(i, expected, index[i], row[i])
        row[i, 4] = x[lag_row + i] / count
        for c in range(3):
            row[i, 5 + c] = x[offset_row + 3 * i + c] / count
        for c in range(9):
            row[i, 8 + c] = x[soft_row + 9 * i + c] / count
        distance += _distance(cov, error, index[i], row[i], z[i] - expected[i], variance)
    variance *= (_TAIL_DOF + distance) / (_TAIL_DOF + 3.0)
    for i in range(3):
        es.update(cov, error, states, index[i], row[i], z[i] - expected[i], variance, tape)


@njit
def _distance(cov, error, index, row, residual, variance):
    """Squared innovation of one row over its variance."""
    for a in range(_MAG_STATES):
        residual -= row[a] * error[index[a]]
        for b in range(_MAG_STATES):
            variance += row[a] * row[b] * cov[index[a], index[b]]
    return residual * residual / variance
