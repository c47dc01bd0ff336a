"""Error-state algebra of the fusion kernel: prediction, scalar updates, their adjoints.

The error state, in the order of the offsets below; attitude, velocity, position
and field errors are in world axes, so that between corrections they couple through
few terms:

    dtheta' = R (dS gyr_raw - dbias + dexcess)      attitude, rad
    dv'     = -[R f]x dtheta - R dacc_bias          velocity, m/s
    dp'     = dv                                    position, m

Gyroscope model: rate = gyr_raw + S gyr_raw - bias + excess, excess only on axes at
their limit; there dexcess' = dsurge, dsurge' = -dsurge / time (Singer 1970). Magnetometer model, relative to the field's norm:
``m_true = m - C m - offset`` and ``R m_true = field + local``, ``local`` being what
distinguishes the place from its surroundings.

A prediction is described by a few blocks instead of its full matrix (MOVE below);
predictions and updates can be written to a tape, which the smoother reads backwards.
"""

import numpy as np
from numba import njit

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
MOVE_NOISE = 56        # (N,) diagonal of the process noise
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


@njit(cache=True)
def _moved(move, column, out):
    """out = Phi column, both (N,)."""
    time = move[MOVE_TIME]
    fx, fy, fz = move[MOVE_FORCE], move[MOVE_FORCE + 1], move[MOVE_FORCE + 2]
    a0, a1, a2 = column[ATT], column[ATT + 1], column[ATT + 2]
    for i in range(N):
        out[i] = column[i]
    for i in range(3):
        turn = 0.0
        push = 0.0
        for j in range(3):
            turn += (move[MOVE_EXCESS + 3 * i + j] * move[MOVE_EXCESS_KEEP + j]
                     * (column[EXCESS + j] + move[MOVE_SURGE_MEAN] * column[SURGE + j])
                     - move[MOVE_ROTATION + 3 * i + j] * column[BIAS + j])
            push -= move[MOVE_ROTATION + 3 * i + j] * column[ACC_BIAS + j]
        for j in range(9):
            turn += move[MOVE_SCALE + 9 * i + j] * column[SCALE + j]
        if i == 0:
            push -= fy * a2 - fz * a1
        elif i == 1:
            push -= fz * a0 - fx * a2
        else:
            push -= fx * a1 - fy * a0
        out[ATT + i] += turn
        out[VEL + i] += push
        out[POS + i] += time * column[VEL + i] + 0.5 * time * push
        out[LOCAL + i] *= move[MOVE_LOCAL_KEEP]
        out[EXCESS + i] += move[MOVE_SURGE_GAIN] * column[SURGE + i]
        out[EXCESS + i] *= move[MOVE_EXCESS_KEEP + i]
        out[SURGE + i] *= move[MOVE_EXCESS_KEEP + i] * move[MOVE_SURGE_KEEP]


@njit(cache=True)
def predict(cov, move):
    """cov = Phi cov Phi' + noise, in place. cov (N, N) symmetric."""
    out = np.empty(N)
    for j in range(N):
        _moved(move, cov[j], out)      # rows: cov is symmetric
        cov[j] = out
    column = np.empty(N)
    for j in range(N):
        for i in range(N):
            column[i] = cov[i, j]
        _moved(move, column, out)
        for i in range(N):
            cov[i, j] = out[i]
    for i in range(N):
        cov[i, i] += move[MOVE_NOISE + i]
        for j in range(i):
            mean = 0.5 * (cov[i, j] + cov[j, i])
            cov[i, j] = mean
            cov[j, i] = mean


@njit(cache=True)
def move_error(move, error):
    """Phi error, without noise. error (N,). Returns (N,)."""
    out = np.empty(N)
    _moved(move, error, out)
    return out


@njit(cache=True)
def move_adjoint(move, adjoint):
    """Phi' adjoint. adjoint (N,). Returns (N,)."""
    time = move[MOVE_TIME]
    fx, fy, fz = move[MOVE_FORCE], move[MOVE_FORCE + 1], move[MOVE_FORCE + 2]
    out = adjoint.copy()
    v = np.empty(3)
    for i in range(3):
        v[i] = adjoint[VEL + i] + 0.5 * time * adjoint[POS + i]
        out[VEL + i] += time * adjoint[POS + i]
        out[LOCAL + i] = adjoint[LOCAL + i] * move[MOVE_LOCAL_KEEP]
    # (-[F]x)' v = [F]x v
    out[ATT] += fy * v[2] - fz * v[1]
    out[ATT + 1] += fz * v[0] - fx * v[2]
    out[ATT + 2] += fx * v[1] - fy * v[0]
    for j in range(3):
        turn = 0.0
        for i in range(3):
            out[BIAS + j] -= move[MOVE_ROTATION + 3 * i + j] * adjoint[ATT + i]
            out[ACC_BIAS + j] -= move[MOVE_ROTATION + 3 * i + j] * v[i]
            turn += move[MOVE_EXCESS + 3 * i + j] * adjoint[ATT + i]
        keep = move[MOVE_EXCESS_KEEP + j]
        out[EXCESS + j] = keep * (adjoint[EXCESS + j] + turn)
        out[SURGE + j] = keep * (move[MOVE_SURGE_KEEP] * adjoint[SURGE + j]
                                 + move[MOVE_SURGE_GAIN] * adjoint[EXCESS + j]
                                 + move[MOVE_SURGE_MEAN] * turn)
    for j in range(9):
        for i in range(3):
            out[SCALE + j] += move[MOVE_SCALE + 9 * i + j] * adjoint[ATT + i]
    return out


@njit(cache=True)
def update(cov, error, count, index, coefficient, residual, variance, tape):
    """One scalar measurement of the error state, in place.

    residual = sum_a coefficient[a] error[index[a]] + noise of ``variance``.

    Args:
        cov: (N, N). error: (N,) mean of the error so far.
        count, index, coefficient: the measurement's row, sparse.
        tape: a block's tape, or an empty array.
    """
    spread = np.zeros(N)
    for a in range(count):
        c = coefficient[a]
        if c != 0.0:
            row = cov[index[a]]
            for i in range(N):
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
    for i in range(N):
        gain = spread[i] / total
        error[i] += gain * innovation
        if gain != 0.0:
            for j in range(N):
                cov[i, j] -= gain * spread[j]


@njit(cache=True)
def unupdate(op, adjoint, information):
    """Carry the smoother's adjoint (N,) and information (N, N) back over one update.

    Modified Bryson-Frazier: with A = I - K h, ``l = A' l + h r / s`` and
    ``L = A' L A + h h' / s``.
    """
    count = int(op[0])
    gain = op[OP_GAIN:OP_GAIN + N]
    total = op[OP_VARIANCE]
    along = 0.0
    pulled = np.zeros(N)
    for i in range(N):
        along += gain[i] * adjoint[i]
        g = gain[i]
        if g != 0.0:
            for j in range(N):
                pulled[j] += g * information[i, j]
    both = 0.0
    for i in range(N):
        both += pulled[i] * gain[i]
    for a in range(count):
        row = int(op[OP_INDEX + a])
        c = op[OP_COEFFICIENT + a]
        if c == 0.0:
            continue
        adjoint[row] += c * (op[OP_RESIDUAL] / total - along)
        for j in range(N):
            information[row, j] -= c * pulled[j]
            information[j, row] -= c * pulled[j]
    for a in range(count):
        row = int(op[OP_INDEX + a])
        for b in range(count):
            column = int(op[OP_INDEX + b])
            information[row, column] += (op[OP_COEFFICIENT + a] * op[OP_COEFFICIENT + b]
                                         * (both + 1.0 / total))
