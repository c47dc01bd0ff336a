"""The error state of the fusion filter and its algebra: prediction, scalar updates, adjoints.

Attitude, velocity, position and field errors are in world axes, so that between corrections
they couple through few terms:

    dtheta' = R (dS gyr_raw - dbias + dclipped)     attitude, rad
    dv'     = -[R f]x dtheta - R dacc_bias          velocity, m/s
    dp'     = dv                                    position, m

Gyroscope model: rate = gyr_raw + S gyr_raw - bias + clipped. The clipped rate is what an axis at
its limit does not show; there dclipped' = dacc, dacc' = -dacc / time with the angular
acceleration acc (Singer 1970). Magnetometer model, relative to the field's norm:
``m_true = m - C m - offset`` and ``R m_true = field + local field``, the local field being what
distinguishes the place from its surroundings.

A prediction is described by a few blocks instead of its full matrix (PREDICTION);
predictions and updates can be written to a tape, which the smoother reads backwards.
"""

import math

import numpy as np

from imu_fusion.kernels import njit

# The first index of each part; the nominal values are fields of state.STATE.
(ATTITUDE,      # (3,) rad, world axes
 GYRO_BIAS,     # (3,) rad/s
 GYRO_SCALE,    # (3, 3) row by row
 VELOCITY,      # (3,) m/s, world axes
 POSITION,      # (3,) m, world axes
 FIELD,         # (3,) relative to the norm, world axes
 LOCAL_FIELD,   # (3,) likewise
 MAG_OFFSET,    # (3,) relative to the norm, imu axes
 ACC_BIAS,      # (3,) m/s^2
 MAG_LAG,       # s
 MAG_MATRIX,    # (3, 3) row by row
 CLIPPED_RATE,  # (3,) rad/s
 ANGULAR_ACC,   # (3,) rad/s^2
 N) = (0, 3, 6, 15, 18, 21, 24, 27, 30, 33, 34, 43, 46, 49)

UNIFORM_VARIANCE = math.pi ** 2 / 3.0   # rad^2, of an angle about which nothing is known
ROW_WIDTH = 17     # most coefficients of one row: those of the magnetometer
MAX_UPDATES = 15   # most updates of one block: three axes each of five measurements

PREDICTION = np.dtype([
    ("time", "f8"),                      # s, of the block
    ("rotation", "f8", (3, 3)),          # integral of R dt
    ("rotation_gyr", "f8", (3, 9)),      # of R[:, i] gyr_raw[j] dt
    ("force", "f8", 3),                  # of R f dt
    ("clipped_rotation", "f8", (3, 3)),  # of R dt over axes at their limit
    ("local_field_keep", "f8"),          # factor that the local field keeps
    ("stays_clipped", "f8", 3),          # 1 where the axis was at its limit before, else 0
    ("acc_bias_keep", "f8"),             # and that the accelerometer's bias keeps
    ("acc_keep", "f8"),                  # factor that the angular acceleration keeps
    ("rate_gain", "f8"),                 # s, of clipped rate per angular acceleration at the end
    ("rate_mean", "f8"),                 # s, the same on average over the block
    ("states", "i8"),   # CLIPPED_RATE if no axis is at its limit, else N: what follows is zero
    ("noise", "f8", N),                  # diagonal of the process noise
], align=True)
"""One prediction: integrals over a block."""

ROW = np.dtype([
    ("count", "i8"),                     # coefficients in use
    ("index", "i8", ROW_WIDTH),          # of the error state
    ("coefficient", "f8", ROW_WIDTH),
    ("residual", "f8"),                  # measured less predicted from the nominal state
    ("variance", "f8"),                  # of the noise
], align=True)
"""One scalar measurement: residual = sum_a coefficient[a] error[index[a]] + noise."""

TAPE = np.dtype([
    ("stamp", "i8"),                     # ns, of the block's end
    ("row_end", "i8"),                   # output rows written up to there
    ("turned", "?"),                     # the world's axes were turned: nothing passes back
    ("prediction", PREDICTION),
    ("cov", "f8", (N, N)),               # after the updates
    ("count", "i8"),                     # updates in use, of each:
    ("row", ROW, MAX_UPDATES),
    ("gain", "f8", (MAX_UPDATES, N)),
    ("total", "f8", MAX_UPDATES),        # variance of the innovation
    ("innovation", "f8", MAX_UPDATES),
], align=True)
"""One block, for the smoother."""

# States whose rows Phi, and Phi', change; those of axes at their limit come last.
_MOVED = np.array([*range(ATTITUDE, GYRO_BIAS), *range(VELOCITY, FIELD),
                   *range(LOCAL_FIELD, MAG_OFFSET), *range(CLIPPED_RATE, N)])
_MOVED_BACK = np.array([*range(ATTITUDE, POSITION), *range(LOCAL_FIELD, MAG_OFFSET),
                        *range(ACC_BIAS, MAG_LAG), *range(CLIPPED_RATE, N)])
_LIMIT_STATES = N - CLIPPED_RATE


@njit
def _add(out, factor, row, width):
    for c in range(width):
        out[c] += factor * row[c]


@njit
def _moved(move, p, width, out):
    """Rows _MOVED of Phi p. p (N, width or more); out (len(_MOVED), width or more)."""
    time, local_keep, acc_keep = move.time, move.local_field_keep, move.acc_keep
    rate_gain, rate_mean = move.rate_gain, move.rate_mean
    for i in range(len(_MOVED)):
        for c in range(width):
            out[i, c] = p[_MOVED[i], c]
    at_limit = move.states > CLIPPED_RATE
    for i in range(3):
        turn, speed, place = out[i], out[3 + i], out[6 + i]
        push = np.zeros(width)
        for j in range(3):
            r = move.rotation[i, j]
            _add(turn, -r, p[GYRO_BIAS + j], width)
            _add(push, -r, p[ACC_BIAS + j], width)
            if at_limit:
                r = move.clipped_rotation[i, j] * move.stays_clipped[j]
                _add(turn, r, p[CLIPPED_RATE + j], width)
                _add(turn, r * rate_mean, p[ANGULAR_ACC + j], width)
        for j in range(9):
            _add(turn, move.rotation_gyr[i, j], p[GYRO_SCALE + j], width)
        # -[F]x p
        after, before = (i + 1) % 3, (i + 2) % 3
        _add(push, -move.force[after], p[ATTITUDE + before], width)
        _add(push, move.force[before], p[ATTITUDE + after], width)
        _add(place, time, p[VELOCITY + i], width)
        _add(place, 0.5 * time, push, width)
        _add(speed, 1.0, push, width)
        keep = move.stays_clipped[i]
        for c in range(width):
            out[9 + i, c] *= local_keep
            out[12 + i, c] = keep * (out[12 + i, c] + rate_gain * p[ANGULAR_ACC + i, c])
            out[15 + i, c] *= keep * acc_keep


@njit
def _moved_back(move, p, width, out):
    """Rows _MOVED_BACK of Phi' p. p (N, width or more); out (len(_MOVED_BACK), width or more)."""
    time, local_keep, acc_keep = move.time, move.local_field_keep, move.acc_keep
    rate_gain, rate_mean = move.rate_gain, move.rate_mean
    for i in range(len(_MOVED_BACK)):
        for c in range(width):
            out[i, c] = p[_MOVED_BACK[i], c]
    push = np.empty((3, width))
    for i in range(3):
        for c in range(width):
            push[i, c] = p[VELOCITY + i, c] + 0.5 * time * p[POSITION + i, c]
        _add(out[15 + i], time, p[POSITION + i], width)
    for j in range(3):
        # (-[F]x)' p = [F]x p
        after, before = (j + 1) % 3, (j + 2) % 3
        _add(out[j], move.force[after], push[before], width)
        _add(out[j], -move.force[before], push[after], width)
        turn = np.zeros(width)
        for i in range(3):
            r = move.rotation[i, j]
            _add(out[3 + j], -r, p[ATTITUDE + i], width)
            _add(out[21 + j], -r, push[i], width)
            _add(turn, move.clipped_rotation[i, j], p[ATTITUDE + i], width)
        keep = move.stays_clipped[j]
        for c in range(width):
            out[18 + j, c] *= local_keep
            out[27 + j, c] = keep * (acc_keep * p[ANGULAR_ACC + j, c]
                                     + rate_gain * p[CLIPPED_RATE + j, c]
                                     + rate_mean * turn[c])
            out[24 + j, c] = keep * (p[CLIPPED_RATE + j, c] + turn[c])
    for j in range(9):
        for i in range(3):
            _add(out[6 + j], move.rotation_gyr[i, j], p[ATTITUDE + i], width)


@njit
def _put(matrix, rows, corner, which, states):
    """Rows ``which`` of a congruence F p F' into the symmetric p, in place.

    rows: those of F p. corner: those of F (F p)' at the columns ``which``.
    """
    count = len(which)
    if states < N:
        count -= _LIMIT_STATES
        matrix[states:] = 0.0
        matrix[:, states:] = 0.0
    for a in range(count):
        i = which[a]
        for j in range(states):
            matrix[i, j] = rows[a, j]
            matrix[j, i] = rows[a, j]
    for a in range(count):
        for b in range(a + 1):
            mean = 0.5 * (corner[a, b] + corner[b, a])
            matrix[which[a], which[b]] = mean
            matrix[which[b], which[a]] = mean


@njit
def _fade(matrix, keep):
    """Multiply rows and columns of the accelerometer's bias of (N, N) by ``keep``, in place."""
    if keep != 1.0:
        for i in range(ACC_BIAS, MAG_LAG):
            for j in range(N):
                matrix[i, j] *= keep
            for j in range(N):
                matrix[j, i] *= keep


@njit
def predict(cov, move):
    """cov = Phi cov Phi' + noise, in place. cov (N, N) symmetric; move: a PREDICTION."""
    states = move.states
    count = len(_MOVED)
    rows = np.empty((count, N))
    corner = np.empty((count, count))
    _moved(move, cov, states, rows)
    _moved(move, np.ascontiguousarray(rows.T), count, corner)
    _put(cov, rows, corner, _MOVED, states)
    _fade(cov, move.acc_bias_keep)
    for i in range(states):
        cov[i, i] += move.noise[i]


@njit
def predict_information(information, move):
    """information = Phi' information Phi, in place. information (N, N) symmetric."""
    states = move.states
    count = len(_MOVED_BACK)
    rows = np.empty((count, N))
    corner = np.empty((count, count))
    _fade(information, move.acc_bias_keep)
    _moved_back(move, information, states, rows)
    _moved_back(move, np.ascontiguousarray(rows.T), count, corner)
    _put(information, rows, corner, _MOVED_BACK, states)


@njit
def move_error(move, error):
    """Phi error, without noise. error (N,). Returns (N,)."""
    rows = np.empty((len(_MOVED), 1))
    _moved(move, error.copy().reshape(N, 1), 1, rows)
    out = error.copy()
    out[_MOVED] = rows[:, 0]
    out[ACC_BIAS:MAG_LAG] *= move.acc_bias_keep
    out[move.states:] = 0.0
    return out


@njit
def move_adjoint(move, adjoint):
    """Phi' adjoint. adjoint (N,). Returns (N,)."""
    rows = np.empty((len(_MOVED_BACK), 1))
    out = adjoint.copy()
    out[ACC_BIAS:MAG_LAG] *= move.acc_bias_keep
    _moved_back(move, out.copy().reshape(N, 1), 1, rows)
    out[_MOVED_BACK] = rows[:, 0]
    out[move.states:] = 0.0
    return out


@njit
def put_single(row, index, residual, variance):
    """Make a ROW that measures one element of the error state."""
    row.count = 1
    row.index[0] = index
    row.coefficient[0] = 1.0
    row.residual = residual
    row.variance = variance


@njit
def _record(tape, row, spread, total, innovation):
    """Write one update to a block's tape."""
    which = tape.count
    if which == MAX_UPDATES:
        raise IndexError("more updates in a block than its tape holds: raise MAX_UPDATES")
    tape.row[which] = row
    gain = tape.gain[which]
    for i in range(N):
        gain[i] = spread[i] / total
    tape.total[which] = total
    tape.innovation[which] = innovation
    tape.count = which + 1


@njit
def spread_of(cov, row, states):
    """Covariance (N,) of the error state with what a ROW measures."""
    spread = np.zeros(N)
    for a in range(row.count):
        c = row.coefficient[a]
        if c != 0.0:
            line = cov[row.index[a]]
            for i in range(states):
                spread[i] += c * line[i]
    return spread


@njit
def update(cov, error, states, row, tape):
    """One scalar measurement of the error state, in place.

    Args:
        cov: (N, N). error: (N,) mean of the error so far.
        states: how many of them there are; the others are zero.
        row: a ROW.
        tape: (1,) TAPE of the block, or empty.

    Returns:
        The innovation over its standard deviation, and the measurement's log likelihood, less a
        constant.

    Raises:
        IndexError: the tape is full: MAX_UPDATES is less than the measurements of a block.
    """
    count = row.count
    spread = spread_of(cov, row, states)
    total = row.variance
    innovation = row.residual
    for a in range(count):
        total += row.coefficient[a] * spread[row.index[a]]
        innovation -= row.coefficient[a] * error[row.index[a]]
    if len(tape):
        _record(tape[0], row, spread, total, innovation)
    for i in range(states):
        gain = spread[i] / total
        error[i] += gain * innovation
        if gain != 0.0:
            for j in range(states):
                cov[i, j] -= gain * spread[j]
    normalised = innovation / math.sqrt(total)
    return normalised, -0.5 * (math.log(total) + normalised * normalised)


@njit
def unupdate(tape, which, adjoint, information):
    """Carry the smoother's adjoint (N,) and information (N, N) back over one update.

    Modified Bryson-Frazier: with A = I - K h, ``l = A' l + h r / s`` and
    ``L = A' L A + h h' / s``. tape: a TAPE; which: of its updates.
    """
    states = tape.prediction.states
    measured, gain, total = tape.row[which], tape.gain[which], tape.total[which]
    along = 0.0
    pulled = np.zeros(N)
    for i in range(states):
        along += gain[i] * adjoint[i]
        g = gain[i]
        if g != 0.0:
            for j in range(states):
                pulled[j] += g * information[i, j]
    both = 0.0
    for i in range(states):
        both += pulled[i] * gain[i]
    for a in range(measured.count):
        row = measured.index[a]
        c = measured.coefficient[a]
        if c == 0.0:
            continue
        adjoint[row] += c * (tape.innovation[which] / total - along)
        for j in range(states):
            information[row, j] -= c * pulled[j]
            information[j, row] -= c * pulled[j]
    for a in range(measured.count):
        for b in range(measured.count):
            information[measured.index[a], measured.index[b]] += (
                measured.coefficient[a] * measured.coefficient[b] * (both + 1.0 / total))
