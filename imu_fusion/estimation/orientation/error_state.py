"""Error-state algebra of the fusion kernel: prediction, scalar updates, their adjoints.

The error state, in the order of the offsets below; attitude, velocity, position
and field errors are in world axes, so that between corrections they couple through
few terms:

    dtheta' = R (dS gyr_raw - dbias + dexcess)      attitude, rad
    dv'     = -[R f]x dtheta - R dacc_bias          velocity, m/s
    dp'     = dv                                    position, m

Gyroscope model: rate = gyr_raw + S gyr_raw - bias + excess, excess only on axes at
their limit; there dexcess' = dsurge, dsurge' = -dsurge / time (Singer 1970).
Magnetometer model, relative to the field's norm: ``m_true = m - C m - offset`` and
``R m_true = field + local``, ``local`` being what distinguishes the place from its
surroundings.

A prediction is described by a few blocks instead of its full matrix (MOVE below);
predictions and updates can be written to a tape, which the smoother reads backwards.
"""

import numpy as np
from imu_fusion.kernels import njit

ATT, BIAS, SCALE, VEL, POS, FIELD, LOCAL, OFFSET, ACC_BIAS, LAG, SOFT, EXCESS, SURGE = (
    0, 3, 6, 15, 18, 21, 24, 27, 30, 33, 34, 43, 46)
N = 49

# One prediction: integrals over the block, as one float array.
MOVE_TIME = 0
MOVE_ROTATION = 1      # (3, 3) integral of R dt
MOVE_SCALE = 10        # (3, 9) of R[:, i] gyr_raw[j] dt
MOVE_FORCE = 37        # (3,) of R f dt
MOVE_EXCESS = 40       # (3, 3) of R dt over axes at their limit
MOVE_LOCAL_KEEP = 49   # factor that LOCAL keeps
MOVE_EXCESS_KEEP = 50  # (3,) 1 where the axis was at its limit before, else 0
MOVE_SURGE_KEEP = 53   # factor that SURGE keeps
MOVE_SURGE_GAIN = 54   # s, of EXCESS per SURGE at the block's end
MOVE_SURGE_MEAN = 55   # s, the same on average over the block
MOVE_STATES = 56       # EXCESS if no axis is at its limit, else N: what comes later is zero
MOVE_NOISE = 57        # (N,) diagonal of the process noise
MOVE_SIZE = MOVE_NOISE + N

# One scalar update on the tape: count, indices, coefficients, gain, variance, residual.
OP_WIDTH = 24          # largest number of coefficients
OP_INDEX = 1
OP_COEFFICIENT = OP_INDEX + OP_WIDTH
OP_GAIN = OP_COEFFICIENT + OP_WIDTH
OP_VARIANCE = OP_GAIN + N
OP_RESIDUAL = OP_VARIANCE + 1
OP_SIZE = OP_RESIDUAL + 1
MAX_OPS = 16

# One block on the tape.
TAPE_OPS = 0
TAPE_TURNED = 1        # 1 where the world's axes were turned: nothing passes back
TAPE_MOVE = 2
TAPE_COV = TAPE_MOVE + MOVE_SIZE
TAPE_OP = TAPE_COV + N * N
TAPE_SIZE = TAPE_OP + MAX_OPS * OP_SIZE


# States whose rows Phi, and Phi', change; those of axes at their limit come last.
_MOVED = np.array([*range(ATT, BIAS), *range(VEL, FIELD), *range(LOCAL, OFFSET), *range(EXCESS, N)])
_MOVED_BACK = np.array([*range(ATT, POS), *range(LOCAL, OFFSET), *range(ACC_BIAS, LAG),
                        *range(EXCESS, N)])
_LIMIT_STATES = N - EXCESS


@njit
def _add(out, factor, row, width):
    for c in range(width):
        out[c] += factor * row[c]


@njit
def _moved(move, p, width, out):
    """Rows _MOVED of Phi p. p (N, width or more); out (len(_MOVED), width or more)."""
    time = move[MOVE_TIME]
    for i in range(len(_MOVED)):
        for c in range(width):
            out[i, c] = p[_MOVED[i], c]
    at_limit = move[MOVE_STATES] > EXCESS
    for i in range(3):
        turn, speed, place = out[i], out[3 + i], out[6 + i]
        push = np.zeros(width)
        for j in range(3):
            r = move[MOVE_ROTATION + 3 * i + j]
            _add(turn, -r, p[BIAS + j], width)
            _add(push, -r, p[ACC_BIAS + j], width)
            if at_limit:
                r = move[MOVE_EXCESS + 3 * i + j] * move[MOVE_EXCESS_KEEP + j]
                _add(turn, r, p[EXCESS + j], width)
                _add(turn, r * move[MOVE_SURGE_MEAN], p[SURGE + j], width)
        for j in range(9):
            _add(turn, move[MOVE_SCALE + 9 * i + j], p[SCALE + j], width)
        # -[F]x p
        after, before = (i + 1) % 3, (i + 2) % 3
        _add(push, -move[MOVE_FORCE + after], p[ATT + before], width)
        _add(push, move[MOVE_FORCE + before], p[ATT + after], width)
        _add(place, time, p[VEL + i], width)
        _add(place, 0.5 * time, push, width)
        _add(speed, 1.0, push, width)
        keep = move[MOVE_EXCESS_KEEP + i]
        for c in range(width):
            out[9 + i, c] *= move[MOVE_LOCAL_KEEP]
            out[12 + i, c] = keep * (out[12 + i, c] + move[MOVE_SURGE_GAIN] * p[SURGE + i, c])
            out[15 + i, c] *= keep * move[MOVE_SURGE_KEEP]


@njit
def _moved_back(move, p, width, out):
    """Rows _MOVED_BACK of Phi' p. p (N, width or more); out (len(_MOVED_BACK), width or more)."""
    time = move[MOVE_TIME]
    for i in range(len(_MOVED_BACK)):
        for c in range(width):
            out[i, c] = p[_MOVED_BACK[i], c]
    push = np.empty((3, width))
    for i in range(3):
        for c in range(width):
            push[i, c] = p[VEL + i, c] + 0.5 * time * p[POS + i, c]
        _add(out[15 + i], time, p[POS + i], width)
    for j in range(3):
        # (-[F]x)' p = [F]x p
        after, before = (j + 1) % 3, (j + 2) % 3
        _add(out[j], move[MOVE_FORCE + after], push[before], width)
        _add(out[j], -move[MOVE_FORCE + before], push[after], width)
        turn = np.zeros(width)
        for i in range(3):
            r = move[MOVE_ROTATION + 3 * i + j]
            _add(out[3 + j], -r, p[ATT + i], width)
            _add(out[21 + j], -r, push[i], width)
            _add(turn, move[MOVE_EXCESS + 3 * i + j], p[ATT + i], width)
        keep = move[MOVE_EXCESS_KEEP + j]
        for c in range(width):
            out[18 + j, c] *= move[MOVE_LOCAL_KEEP]
            out[27 + j, c] = keep * (move[MOVE_SURGE_KEEP] * p[SURGE + j, c]
                                     + move[MOVE_SURGE_GAIN] * p[EXCESS + j, c]
                                     + move[MOVE_SURGE_MEAN] * turn[c])
            out[24 + j, c] = keep * (p[EXCESS + j, c] + turn[c])
    for j in range(9):
        for i in range(3):
            _add(out[6 + j], move[MOVE_SCALE + 9 * i + j], p[ATT + i], width)


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
def predict(cov, move):
    """cov = Phi cov Phi' + noise, in place. cov (N, N) symmetric."""
    states = int(move[MOVE_STATES])
    count = len(_MOVED)
    rows = np.empty((count, N))
    corner = np.empty((count, count))
    _moved(move, cov, states, rows)
    _moved(move, np.ascontiguousarray(rows.T), count, corner)
    _put(cov, rows, corner, _MOVED, states)
    for i in range(states):
        cov[i, i] += move[MOVE_NOISE + i]


@njit
def predict_information(information, move):
    """information = Phi' information Phi, in place. information (N, N) symmetric."""
    states = int(move[MOVE_STATES])
    count = len(_MOVED_BACK)
    rows = np.empty((count, N))
    corner = np.empty((count, count))
    _moved_back(move, information, states, rows)
    _moved_back(move, np.ascontiguousarray(rows.T), count, corner)
    _put(information, rows, corner, _MOVED_BACK, states)


@njit
def move_error(move, error):
    """Phi error, without noise. error (N,). Returns (N,)."""
    states = int(move[MOVE_STATES])
    rows = np.empty((len(_MOVED), 1))
    _moved(move, error.copy().reshape(N, 1), 1, rows)
    out = error.copy()
    out[_MOVED] = rows[:, 0]
    out[states:] = 0.0
    return out


@njit
def move_adjoint(move, adjoint):
    """Phi' adjoint. adjoint (N,). Returns (N,)."""
    states = int(move[MOVE_STATES])
    rows = np.empty((len(_MOVED_BACK), 1))
    _moved_back(move, adjoint.copy().reshape(N, 1), 1, rows)
    out = adjoint.copy()
    out[_MOVED_BACK] = rows[:, 0]
    out[states:] = 0.0
    return out


@njit
def update(cov, error, states, index, coefficient, residual, variance, tape):
    """One scalar measurement of the error state, in place.

    residual = sum_a coefficient[a] error[index[a]] + noise of ``variance``.

    Args:
        cov: (N, N). error: (N,) mean of the error so far.
        states: how many of them there are; the others are zero.
        index, coefficient: (m,) the measurement's row, sparse.
        tape: a block's tape, or an empty array.
    """
    count = len(index)
    spread = np.zeros(N)
    for a in range(count):
        c = coefficient[a]
        if c != 0.0:
            row = cov[index[a]]
            for i in range(states):
                spread[i] += c * row[i]
    total = variance
    innovation = residual
    for a in range(count):
        total += coefficient[a] * spread[index[a]]
        innovation -= coefficient[a] * error[index[a]]
    if len(tape) and tape[TAPE_OPS] < MAX_OPS:
        op = tape[TAPE_OP + int(tape[TAPE_OPS]) * OP_SIZE:]
        op[0] = count
        for a in range(count):
            op[OP_INDEX + a] = index[a]
            op[OP_COEFFICIENT + a] = coefficient[a]
        for i in range(N):
            op[OP_GAIN + i] = spread[i] / total
        op[OP_VARIANCE] = total
        op[OP_RESIDUAL] = innovation
        tape[TAPE_OPS] += 1
    for i in range(states):
        gain = spread[i] / total
        error[i] += gain * innovation
        if gain != 0.0:
            for j in range(states):
                cov[i, j] -= gain * spread[j]


@njit
def unupdate(op, adjoint, information, states):
    """Carry the smoother's adjoint (N,) and information (N, N) back over one update.

    Modified Bryson-Frazier: with A = I - K h, ``l = A' l + h r / s`` and
    ``L = A' L A + h h' / s``. states: as for :func:`update`.
    """
    count = int(op[0])
    gain = op[OP_GAIN:OP_GAIN + N]
    total = op[OP_VARIANCE]
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
    for a in range(count):
        row = int(op[OP_INDEX + a])
        c = op[OP_COEFFICIENT + a]
        if c == 0.0:
            continue
        adjoint[row] += c * (op[OP_RESIDUAL] / total - along)
        for j in range(states):
            information[row, j] -= c * pulled[j]
            information[j, row] -= c * pulled[j]
    for a in range(count):
        row = int(op[OP_INDEX + a])
        for b in range(count):
            column = int(op[OP_INDEX + b])
            information[row, column] += (op[OP_COEFFICIENT + a] * op[OP_COEFFICIENT + b]
                                         * (both + 1.0 / total))
