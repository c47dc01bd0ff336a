"""Orientation from gyroscope, accelerometer and magnetometer: an error-state filter.

The attitude is carried on by every rate; about every ``block`` seconds a Kalman
update corrects it. What is observed:

- Velocity and position stay bounded: zero-mean pseudo-measurements with the standard
  deviations and correlation times of the motion. Gravity's direction follows from
  that, without ever taking the specific force for gravity.
- The field in world axes is constant but for a drift, and for a local part
  that is frozen while the sensor rests and forgotten as it moves. Samples weigh less
  the more their norm deviates.
- At rest, velocity and rate are zero.

Slow states beside the attitude: gyroscope bias, scale and misalignment, accelerometer
bias, the magnetometer's offset, matrix and lag. A gyroscope axis at its limit gets a
state for what it does not show, driven by white angular acceleration, zero
again when the axis comes back.
"""

import math

import numpy as np
from numba import njit

from imu_fusion.estimation import orientation_error_state as es
from imu_fusion.estimation import orientation_state as st
from imu_fusion.estimation.orientation_state import push_mag
from imu_fusion.geometry.rotation import (
    quat_exp, quat_multiply, quat_normalize, quat_rotate, quat_rotate_inverse, quat_to_matrix)

N = es.N
# Float state.
S = st.X_COMMON            # (N,) nominal values of the slow states, velocity, position; attitude unused
COV = S + N                # (N, N)
NORM = COV + N * N         # field norm, tesla; 0 before the first sample
GRAVITY = NORM + 1         # m/s^2
HEADING_VAR = NORM + 2     # rad^2, of a heading that no magnetometer has fixed
ACC_LAST = NORM + 3        # (3,)
MEAN_RATE = NORM + 6       # (3,) low-passed raw rate, for the rest detector
MEAN_FORCE = NORM + 9      # (3,)
MOVE = NORM + 12           # the block being collected
MAG_SUM = MOVE + es.MOVE_SIZE   # (3,) of z in world axes; then lag (3,), offset (9,), matrix (27,)
MAG_ROWS = 42
LIMIT = MAG_SUM + MAG_ROWS  # (3,) gyroscope limits found
REPEATED = LIMIT + 3       # (3,) last value of each axis
ENTRY = REPEATED + 3       # (3,) step with which it was reached
LARGEST = ENTRY + 3        # (3,) largest rate seen
X_SIZE = LARGEST + 3

# Integer state.
BLOCK_MAGS = st.K_COMMON
REST_SINCE = BLOCK_MAGS + 1
CLIPPED = BLOCK_MAGS + 2   # bit per axis at its limit
WAS_CLIPPED = BLOCK_MAGS + 3  # the same in the block before
REPEATS = BLOCK_MAGS + 4   # (3,) how often each axis repeated its largest value
WORLD_TURNED = REPEATS + 3  # the heading was fixed in this block
K_SIZE = WORLD_TURNED + 1

# Parameters.
(P_BLOCK, P_ACC_WALK, P_VEL_SD, P_VEL_TIME, P_POS_SD, P_POS_TIME, P_LOCAL_SD, P_LOCAL_TIME,
 P_FIELD_WALK, P_MAG_RELATIVE, P_NORM_FACTOR, P_REST_RATE, P_REST_FORCE, P_REST_TIME,
 P_REST_RATE_SD, P_EXCESS_WALK, P_ESTIMATE_BIAS, P_SCALE_SD, P_OFFSET_SD, P_SOFT_SD,
 P_LAG_SD, P_FOLLOW_FIELD, P_HEADING_SD, P_USE_ACC) = range(st.P_COMMON, st.P_COMMON + 24)
P_SIZE = st.P_COMMON + 24

_REST_MEMORY = 0.25        # s, of the means that the rest detector compares with
_REST_SPEED_SD = 0.003     # m/s, over 20 ms: a sensor that rests in a quiet hand
_BACK_SD = 0.1             # rad/s: excess of an axis that has just come back from its limit
_REST_TURN = 1.5e-3         # rad/s per axis: slower turning than 0.5 deg/s passes as rest
_FIRST_FIELD_SD = 2e-3     # relative: noise of the field that the alignment averages
_BURST_SHARE = 0.5         # of the block, while an axis is at its limit
_REPEATS_AT_LIMIT = 4      # equal largest values in a row that make a flat top
_ENTRY_SHARE = 2e-3        # a flat top is run into; a quantised smooth peak is not
_LIMIT_FLOOR = 1.0         # rad/s: no gyroscope has a smaller range


def pack(par, p):
    """Write this kernel's own parameters (OrientationParams) behind the common ones."""
    par[st.P_COMMON:P_SIZE] = (
        p.block, p.velocity_walk, p.velocity_sd, p.velocity_time, p.position_sd,
        p.position_time, p.local_field_sd, p.local_field_time, p.field_walk, p.mag_sd,
        p.norm_deviation_factor, p.rest_rate, p.rest_force, p.rest_time, p.rest_rate_sd,
        p.saturation_walk, p.estimate_bias, p.gyr_scale_sd, p.mag_offset_sd, p.mag_matrix_sd,
        p.mag_delay_sd if p.mag_delay is None else 0.0, p.heading_anchor == "field",
        math.radians(p.heading_sd_deg), p.use_acc)


def initialise(x, k, par, a):
    """Start from an Alignment. x, k: zeroed state."""
    x[st.Q:st.Q + 4] = a.quat_world_imu
    x[st.U:st.U + 4] = 0.0, 0.0, 0.0, 1.0
    x[S + es.BIAS:S + es.BIAS + 3] = x[st.GYR_BIAS:st.GYR_BIAS + 3] = a.gyr_bias
    x[S + es.LAG] = x[st.LAG]
    x[GRAVITY] = a.gravity
    x[HEADING_VAR] = st.UNIFORM_VARIANCE
    x[MEAN_RATE:MEAN_RATE + 3] = a.gyr_bias
    x[LIMIT:LIMIT + 3] = np.where(np.isnan(par[st.P_RANGE:st.P_RANGE + 3]), np.inf,
                                  par[st.P_RANGE:st.P_RANGE + 3])
    sd = np.zeros(N)
    sd[es.ATT:es.ATT + 2] = math.sqrt(a.cov_attitude_world[0, 0])
    sd[es.BIAS:es.SCALE] = max(a.gyr_bias_sd, 2e-4)
    sd[es.SCALE:es.VEL] = par[P_SCALE_SD]
    sd[es.VEL:es.POS] = 0.01 if a.at_rest else par[P_VEL_SD]
    sd[es.POS:es.FIELD] = 0.01 if a.at_rest else par[P_POS_SD]
    sd[es.OFFSET:es.ACC_BIAS] = par[P_OFFSET_SD]
    sd[es.ACC_BIAS:es.LAG] = par[st.P_ACC_BIAS_SD]
    sd[es.LAG] = par[P_LAG_SD]
    sd[es.SOFT:es.EXCESS] = par[P_SOFT_SD]
    x[COV:COV + N * N] = np.diag(sd ** 2).ravel()
    if a.field_world is not None:
        follow = 1.0 if par[P_FOLLOW_FIELD] or not a.at_rest else 0.0
        _start_field(x, k, par, a.field_world, a.has_heading, follow)


@njit(cache=True)
def _start_field(x, k, par, z, has_heading, follow):
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
        x[HEADING_VAR] = par[P_HEADING_SD] ** 2 * (1.0 - follow)
        k[st.HEADING_KNOWN] = 1
    quat = x[st.Q:st.Q + 4]
    r = quat_to_matrix(quat)
    m = quat_rotate_inverse(quat, b)
    index = np.empty(es.OP_WIDTH, dtype=np.int64)
    row = np.empty(es.OP_WIDTH)
    error = np.zeros(N)
    for i in range(3):
        _mag_row(i, b, index, row)
        row[4] = 0.0
        for c in range(3):
            row[5 + c] = r[i, c] * follow
            for d in range(3):
                row[8 + 3 * c + d] = r[i, c] * m[d] * follow
        es.update(cov, error, 17, index, row, 0.0, _FIRST_FIELD_SD ** 2, np.empty(0))
    if has_heading and follow:
        for c in range(2):
            index[c], index[2 + c] = es.FIELD + c, es.LOCAL + c
        row[0] = row[2] = math.cos(par[st.P_DECLINATION])
        row[1] = row[3] = -math.sin(par[st.P_DECLINATION])
        es.update(cov, error, 4, index, row, 0.0, _FIRST_FIELD_SD ** 2, np.empty(0))


@njit(cache=True)
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


@njit(cache=True)
def _fix_heading(x, k, par, z):
    """Turn the world about up so that ``z`` (3,) tesla, world axes, points magnetic north."""
    k[WORLD_TURNED] = 1
    horizontal = math.hypot(z[0], z[1])
    norm = math.sqrt(horizontal ** 2 + z[2] ** 2)
    if horizontal < 0.02 * norm:
        _start_field(x, k, par, z, False, 0.0)
        return
    # The needle points to azimuth D: east sin D, north cos D.
    angle = 0.5 * math.pi - par[st.P_DECLINATION] - math.atan2(z[1], z[0])
    turn = quat_exp(np.array([0.0, 0.0, angle]))
    x[st.Q:st.Q + 4] = quat_multiply(turn, x[st.Q:st.Q + 4])
    cov = x[COV:COV + N * N].reshape(N, N)
    for group in (es.ATT, es.VEL, es.POS):
        x[S + group:S + group + 3] = quat_rotate(turn, x[S + group:S + group + 3])
        for j in range(N):
            cov[group:group + 3, j] = quat_rotate(turn, cov[group:group + 3, j].copy())
        for j in range(N):
            cov[j, group:group + 3] = quat_rotate(turn, cov[j, group:group + 3].copy())
    # The sensor may be moving: what it shows now is no anchor.
    _start_field(x, k, par, quat_rotate(turn, z), True, 1.0)


@njit(cache=True)
def _find_limits(x, k, par, gyr):
    """Learn each axis' limit from flat tops, unless given; mark the axes at theirs."""
    clipped = 0
    # A driver that repeats whole samples makes no flat tops.
    held = (gyr[0] == x[REPEATED] and gyr[1] == x[REPEATED + 1] and gyr[2] == x[REPEATED + 2])
    for i in range(3):
        size = abs(gyr[i])
        if math.isnan(par[st.P_RANGE + i]):
            if held:
                pass
            elif gyr[i] == x[REPEATED + i]:
                k[REPEATS + i] += 1
                if (k[REPEATS + i] >= _REPEATS_AT_LIMIT - 1 and size >= x[LARGEST + i]
                        and x[ENTRY + i] > _ENTRY_SHARE * size > _ENTRY_SHARE * _LIMIT_FLOOR):
                    x[LIMIT + i] = min(x[LIMIT + i], size)
            else:
                k[REPEATS + i] = 0
                x[ENTRY + i] = abs(gyr[i] - x[REPEATED + i])
            x[LARGEST + i] = max(x[LARGEST + i], size)
            if size > x[LIMIT + i]:
                x[LIMIT + i] = np.inf    # a repeated value that was no limit
            x[REPEATED + i] = gyr[i]
        if size >= x[LIMIT + i] * (1.0 - 1e-6):
            clipped |= 1 << i
    return clipped


@njit(cache=True)
def _rate(x, gyr):
    """Rate of turn (3,) from a raw one, with bias, scale and excess."""
    rate = np.empty(3)
    for i in range(3):
        rate[i] = gyr[i] - x[S + es.BIAS + i] + x[S + es.EXCESS + i]
        for j in range(3):
            rate[i] += x[S + es.SCALE + 3 * i + j] * gyr[j]
    return rate


@njit(cache=True)
def _collect_mags(x, k, par, samples, count):
    """Add magnetometer samples to the block; returns the reliability (10) of their mean.

    samples: rows of take_mags. The mean in present imu axes goes to samples[0, :3], tesla.
    """
    lag_row, offset_row, soft_row = MAG_SUM + 3, MAG_SUM + 6, MAG_SUM + 15
    mean = np.zeros(3)
    quat = x[st.Q:st.Q + 4]
    if x[NORM] == 0.0 and count > 0:
        _fix_heading(x, k, par, quat_rotate(quat_multiply(quat, samples[0, 6:10]),
                                            samples[0, :3]))
        quat = x[st.Q:st.Q + 4]
    norm = x[NORM]
    for s in range(count):
        raw = samples[s, :3] / norm
        m = raw.copy()
        for i in range(3):
            m[i] -= x[S + es.OFFSET + i]
            for j in range(3):
                m[i] -= x[S + es.SOFT + 3 * i + j] * raw[j]
        rate = samples[s, 3:6]
        r = quat_to_matrix(quat_multiply(quat, samples[s, 6:10]))
        drag = np.array([rate[1] * m[2] - rate[2] * m[1], rate[2] * m[0] - rate[0] * m[2],
                         rate[0] * m[1] - rate[1] * m[0]])
        for i in range(3):
            for j in range(3):
                x[MAG_SUM + i] += r[i, j] * m[j]
                x[lag_row + i] += r[i, j] * drag[j]
                x[offset_row + 3 * i + j] += r[i, j]
                for c in range(3):
                    x[soft_row + 9 * i + 3 * j + c] += r[i, j] * raw[c]
        mean += quat_rotate(samples[s, 6:10], m) / count
        k[BLOCK_MAGS] += 1
    samples[0, :3] = mean * norm
    size = math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    return math.exp(-(par[st.P_RELIABILITY] * (1.0 - size)) ** 2)


@njit(cache=True)
def _update_mag(x, k, par, error, still, tape):
    """The block's mean magnetometer sample against the field."""
    cov = x[COV:COV + N * N].reshape(N, N)
    count = k[BLOCK_MAGS]
    z = x[MAG_SUM:MAG_SUM + 3] / count
    lag_row, offset_row, soft_row = MAG_SUM + 3, MAG_SUM + 6, MAG_SUM + 15
    expected = x[S + es.FIELD:S + es.FIELD + 3] + x[S + es.LOCAL:S + es.LOCAL + 3]
    deviation = abs(math.sqrt(z[0] ** 2 + z[1] ** 2 + z[2] ** 2) - 1.0)
    time = x[MOVE + es.MOVE_TIME]
    sd = par[P_MAG_RELATIVE] + par[P_NORM_FACTOR] * deviation
    # White over 20 ms: faster sampling of the same disturbance is no news.
    variance = sd * sd * max(0.02 / time, 1.0 / count) + (par[st.P_MAG_SD] / x[NORM]) ** 2 / count
    index = np.empty(es.OP_WIDTH, dtype=np.int64)
    row = np.empty(es.OP_WIDTH)
    for i in range(3):
        _mag_row(i, expected, index, row)
        row[4] = x[lag_row + i] / count
        for c in range(3):
            row[5 + c] = x[offset_row + 3 * i + c] / count
        for c in range(9):
            row[8 + c] = x[soft_row + 9 * i + c] / count
        es.update(cov, error, 17, index, row, z[i] - expected[i], variance, tape)


@njit(cache=True)
def _end_block(x, k, par, still, back, tape):
    """Prediction and updates over the collected block.

    still: at rest. back: bits of the axes that came back from their limit.
    """
    cov = x[COV:COV + N * N].reshape(N, N)
    move = x[MOVE:MOVE + es.MOVE_SIZE]
    time = move[es.MOVE_TIME]
    rate = 1e-3 if still else 1.0 / par[P_LOCAL_TIME]
    keep = math.exp(-time * rate)
    move[es.MOVE_LOCAL_KEEP] = keep
    noise = move[es.MOVE_NOISE:]
    for i in range(3):
        active = (k[CLIPPED] >> i) & 1
        move[es.MOVE_EXCESS_KEEP + i] = active & (k[WAS_CLIPPED] >> i)
        noise[es.ATT + i] += par[st.P_GYR_DENSITY] ** 2 * time
        noise[es.BIAS + i] = par[st.P_BIAS_WALK] ** 2 * time
        noise[es.VEL + i] = par[P_ACC_WALK] ** 2 * time
        noise[es.FIELD + i] = par[P_FIELD_WALK] ** 2 * time
        noise[es.LOCAL + i] = par[P_LOCAL_SD] ** 2 * (1.0 - keep * keep)
        noise[es.EXCESS + i] = active * par[P_EXCESS_WALK] ** 2 * time
        if active:
            noise[es.ATT + i] += par[P_EXCESS_WALK] ** 2 * time ** 3 / 3.0
        x[S + es.LOCAL + i] *= keep
    if len(tape):
        tape[es.TAPE_OPS] = 0
        tape[es.TAPE_MOVE:es.TAPE_MOVE + es.MOVE_SIZE] = move
    es.predict(cov, move)

    error = np.zeros(N)
    index = np.empty(es.OP_WIDTH, dtype=np.int64)
    row = np.ones(es.OP_WIDTH)
    for i in range(3):
        if (back >> i) & 1:
            index[0] = es.EXCESS + i
            es.update(cov, error, 1, index, row, -x[S + es.EXCESS + i], _BACK_SD ** 2, tape)
    for i in range(3):
        index[0] = es.VEL + i
        variance = (_REST_SPEED_SD ** 2 * 0.02 / time if still
                    else par[P_VEL_SD] ** 2 * max(par[P_VEL_TIME] / time, 1.0))
        es.update(cov, error, 1, index, row, -x[S + es.VEL + i], variance, tape)
        if still:
            index[0] = es.BIAS + i
            es.update(cov, error, 1, index, row, _mean_rate(x, i) - x[S + es.BIAS + i],
                      par[P_REST_RATE_SD] ** 2 * _REST_MEMORY / time, tape)
        index[0] = es.POS + i
        es.update(cov, error, 1, index, row, -x[S + es.POS + i],
                  par[P_POS_SD] ** 2 * max(par[P_POS_TIME] / time, 1.0), tape)
    if k[BLOCK_MAGS] > 0:
        _update_mag(x, k, par, error, still, tape)

    x[st.Q:st.Q + 4] = quat_normalize(quat_multiply(quat_exp(error[:3].copy()),
                                                    x[st.Q:st.Q + 4]))
    for i in range(3, N):
        if par[P_ESTIMATE_BIAS] or i < es.BIAS or i >= es.VEL:
            x[S + i] += error[i]
    for i in range(3):
        x[st.GYR_BIAS + i] = x[S + es.BIAS + i]
        if (back >> i) & 1:
            x[S + es.EXCESS + i] = 0.0
    x[st.LAG] = x[S + es.LAG]
    if len(tape):
        tape[es.TAPE_COV:es.TAPE_COV + N * N] = x[COV:COV + N * N]
        tape[es.TAPE_TURNED] = k[WORLD_TURNED]
    k[WORLD_TURNED] = 0
    x[MOVE:MOVE + es.MOVE_SIZE] = 0.0
    x[MAG_SUM:MAG_SUM + MAG_ROWS] = 0.0
    k[BLOCK_MAGS] = 0
    k[WAS_CLIPPED] = k[CLIPPED] & ~back


@njit(cache=True)
def _mean_rate(x, i):
    """Low-passed rate of axis i, scaled, with its bias."""
    rate = x[MEAN_RATE + i]
    for j in range(3):
        rate += x[S + es.SCALE + 3 * i + j] * x[MEAN_RATE + j]
    return rate


@njit(cache=True)
def _is_still(x, k, par, stamp, dt, gyr, acc):
    """Rest: rate and force have kept to their short-term means, and the mean rate is bias.

    Slow turning is told from rest by the bias' own uncertainty.
    """
    part = min(dt / _REST_MEMORY, 1.0)
    rate2 = 0.0
    force2 = 0.0
    mean2 = 0.0
    limit2 = 0.0
    for i in range(3):
        x[MEAN_RATE + i] += part * (gyr[i] - x[MEAN_RATE + i])
        x[MEAN_FORCE + i] += part * (acc[i] - x[MEAN_FORCE + i])
        rate2 += (gyr[i] - x[MEAN_RATE + i]) ** 2
        force2 += (acc[i] - x[MEAN_FORCE + i]) ** 2
        mean2 += (x[MEAN_RATE + i] - x[S + es.BIAS + i]) ** 2
        slot = COV + (es.BIAS + i) * (N + 1)
        limit2 += x[slot] + _REST_TURN ** 2
    if (rate2 > par[P_REST_RATE] ** 2 or force2 > par[P_REST_FORCE] ** 2
            or mean2 > 9.0 * limit2):
        k[REST_SINCE] = stamp
    return stamp - k[REST_SINCE] > par[P_REST_TIME] * 1e9


@njit(cache=True)
def advance(x, k, par, stamp, sample, row, row_int, tape):
    """One Imu sample through the filter; see :func:`step_imu`.

    tape: TAPE_SIZE floats for what the smoother needs, or an empty array.

    Returns:
        0 if the sample was refused, 1 if a row was written, 2 if it also ended a block.
    """
    if not st.is_newer(k, stamp, sample):
        return 0
    gyr = sample[:3].copy()
    acc = sample[3:6].copy()
    first = not k[st.STARTED]
    if first:
        x[st.GYR_LAST:st.GYR_LAST + 3] = gyr
        x[ACC_LAST:ACC_LAST + 3] = acc
        x[MEAN_FORCE:MEAN_FORCE + 3] = acc
        k[REST_SINCE] = stamp
        k[st.LAST_STAMP] = stamp
        k[st.STARTED] = 1
    dt = (stamp - k[st.LAST_STAMP]) * 1e-9
    flags = 0
    move = x[MOVE:MOVE + es.MOVE_SIZE]

    clipped = _find_limits(x, k, par, gyr)
    if clipped:
        flags |= st.FLAG_SATURATED
        k[st.SATURATED] += 1
    k[CLIPPED] |= clipped

    # Trapezoidal rates and forces over the step, at the attitude of its middle.
    last = x[st.GYR_LAST:st.GYR_LAST + 3].copy()
    raw = 0.5 * (last + gyr)
    phi = st.rotation_of_step(_rate(x, last), _rate(x, gyr), dt)
    middle = quat_to_matrix(quat_multiply(x[st.Q:st.Q + 4], quat_exp(0.5 * phi)))
    x[st.Q:st.Q + 4] = quat_normalize(quat_multiply(x[st.Q:st.Q + 4], quat_exp(phi)))
    k[st.LAST_STAMP] = stamp
    st.push_rotation(x, k, stamp, phi)
    for i in range(3):
        force = 0.0
        for j in range(3):
            f = 0.5 * (acc[j] + x[ACC_LAST + j]) - x[S + es.ACC_BIAS + j]
            force += middle[i, j] * f
            move[es.MOVE_ROTATION + 3 * i + j] += middle[i, j] * dt
            if (k[CLIPPED] >> j) & 1:
                move[es.MOVE_EXCESS + 3 * i + j] += middle[i, j] * dt
            for c in range(3):
                move[es.MOVE_SCALE + 9 * i + 3 * j + c] += middle[i, j] * raw[c] * dt
        change = 0.0
        if par[P_USE_ACC]:
            move[es.MOVE_FORCE + i] += force * dt
            change = (force - (x[GRAVITY] if i == 2 else 0.0)) * dt
        x[S + es.POS + i] += (x[S + es.VEL + i] + 0.5 * change) * dt
        x[S + es.VEL + i] += change
    move[es.MOVE_TIME] += dt
    x[st.GYR_LAST:st.GYR_LAST + 3] = gyr
    x[ACC_LAST:ACC_LAST + 3] = acc
    if dt > par[st.P_MAX_GAP]:
        flags |= st.FLAG_GAP
        k[st.GAPS] += 1
        k[REST_SINCE] = stamp
        unseen = min((par[st.P_GAP_RATE_SD] * dt) ** 2, st.UNIFORM_VARIANCE)
        for i in range(3):
            # Nothing is known of the motion meanwhile: start velocity and position anew.
            move[es.MOVE_NOISE + es.ATT + i] += unseen
            move[es.MOVE_NOISE + es.VEL + i] += par[P_VEL_SD] ** 2
            move[es.MOVE_NOISE + es.POS + i] += par[P_POS_SD] ** 2
            x[S + es.VEL + i] = 0.0
            x[S + es.POS + i] = 0.0

    samples = np.empty((st.PENDING_LENGTH, st.TAKEN_WORDS))
    taken = st.take_mags(x, k, samples)
    reliability = np.nan
    mag = np.full(3, np.nan)
    if taken > 0:
        reliability = _collect_mags(x, k, par, samples, taken)
        mag = samples[0, :3].copy()
        if reliability < 0.5:
            flags |= st.FLAG_MAG_DISTURBED
            k[st.MAG_DISTURBED] += taken
        else:
            flags |= st.FLAG_MAG_USED
            k[st.MAG_USED] += taken

    still = _is_still(x, k, par, stamp, dt, gyr, acc)
    if still:
        flags |= st.FLAG_STILL
    back = 0 if clipped == k[CLIPPED] or first else k[CLIPPED] & ~clipped
    result = 1
    length = par[P_BLOCK] * (_BURST_SHARE if k[CLIPPED] else 1.0)
    if back or move[es.MOVE_TIME] >= length - 1e-6:
        _end_block(x, k, par, still, back, tape)
        result = 2
        k[CLIPPED] &= ~back
    if not k[st.HEADING_KNOWN]:
        flags |= st.FLAG_NO_HEADING
    if stamp <= k[st.ALIGN_UNTIL]:
        flags |= st.FLAG_ALIGNING
    _write(x, k, par, stamp, dt, gyr, acc, mag, reliability, flags, taken, row, row_int)
    return result


@njit(cache=True)
def _write(x, k, par, stamp, dt, gyr, acc, mag, reliability, flags, taken, row, row_int):
    """The output row of the present state."""
    cov = x[COV:COV + N * N].reshape(N, N)
    noise_dt = dt if dt > 0.0 else 1e-2
    since = x[MOVE + es.MOVE_TIME]
    cov_world = cov[:3, :3].copy()
    var_gyr = np.empty(3)
    bias_var = np.empty(3)
    force = np.empty(3)
    for i in range(3):
        cov_world[i, i] += par[st.P_GYR_DENSITY] ** 2 * since + x[MOVE + es.MOVE_NOISE + es.ATT + i]
        bias_var[i] = cov[es.BIAS + i, es.BIAS + i]
        var_gyr[i] = par[st.P_GYR_DENSITY] ** 2 / noise_dt + bias_var[i]
        for j in range(3):
            slot = es.SCALE + 3 * i + j
            var_gyr[i] += cov[slot, slot] * gyr[j] ** 2
        if (k[CLIPPED] >> i) & 1:
            var_gyr[i] += (cov[es.EXCESS + i, es.EXCESS + i]
                           + par[P_EXCESS_WALK] ** 2 * (since + noise_dt))
        force[i] = acc[i] - x[S + es.ACC_BIAS + i]
    cov_world[2, 2] += x[HEADING_VAR]
    rate = _rate(x, gyr)
    if flags & st.FLAG_SATURATED:
        for i in range(3):
            limit = x[LIMIT + i]
            if abs(gyr[i]) >= limit * (1.0 - 1e-6):
                rate[i] = math.copysign(max(abs(rate[i]), limit), gyr[i])
    st.write_row(row, row_int, par, stamp, x[st.Q:st.Q + 4], cov_world, rate, var_gyr,
                 force, par[st.P_ACC_DENSITY] ** 2 / noise_dt + cov[es.ACC_BIAS, es.ACC_BIAS],
                 x[S + es.BIAS:S + es.BIAS + 3], bias_var, mag, reliability, flags, taken)


@njit(cache=True)
def step_imu(x, k, par, stamp, sample, row, row_int):
    """One Imu sample through the filter.

    Args:
        x, k, par: state and parameters, in place.
        stamp: int64 ns.
        sample: (6,) rate rad/s, specific force m/s^2.
        row, row_int: float and integer view of the output row.

    Returns:
        0 if the sample was refused (not finite, or not newer than the last), else 1 or 2.
    """
    return advance(x, k, par, stamp, sample, row, row_int, np.empty(0))


@njit(cache=True)
def run_loop(x, k, par, imu_stamps, samples, mag_stamps, mags, rows, rows_int):
    """Whole logs in merge order: a magnetometer sample before the Imu of the same stamp.

    Returns the number of rows written.
    """
    written = 0
    j = 0
    for i in range(len(imu_stamps)):
        while j < len(mag_stamps) and mag_stamps[j] <= imu_stamps[i]:
            push_mag(x, k, par, mag_stamps[j], mags[j])
            j += 1
        if step_imu(x, k, par, imu_stamps[i], samples[i], rows[written], rows_int[written]):
            written += 1
    while j < len(mag_stamps):
        push_mag(x, k, par, mag_stamps[j], mags[j])
        j += 1
    return written
