"""Fixed-interval smoothing of the fusion filter: modified Bryson-Frazier (Bierman 1973).

The same kernel runs forward; its predictions and updates are read backwards, which
needs no inverse of a covariance. To keep memory small on long recordings only
snapshots are kept on the way forward; each segment between two snapshots is run again
with its tape when its turn comes.
"""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import fusion
from imu_fusion.estimation.orientation import state as st
from imu_fusion.geometry.rotation import (
    quat_conjugate, quat_exp, quat_multiply, quat_normalize, quat_rotate, quat_to_matrix)

N = es.N
_SEGMENT = 128      # blocks between snapshots
# Of the error state, what rows report: attitude, bias, accelerometer bias, excess.
_REPORTED = np.array([0, 1, 2, 3, 4, 5, 30, 31, 32, 43, 44, 45])


def smooth(x, k, par, stamps, samples, mag_stamps, mags, rows, rows_int):
    """Smoothed rows of a whole recording.

    Args:
        x, k, par: initialised state of the fusion kernel; ends as the causal filter's.
        stamps (n,), samples (n, 6), mag_stamps (m,), mags (m, 3): as for run_loop.
        rows, rows_int: views of the output.

    Returns:
        Number of rows written.
    """
    tapes = np.zeros((_SEGMENT, es.TAPE_SIZE))
    block_of_row = np.zeros(len(stamps), dtype=np.int64)
    block_stamps = np.zeros(_SEGMENT, dtype=np.int64)
    snapshots = []
    i = j = written = 0
    while i < len(stamps):
        snapshots.append((x.copy(), k.copy(), i, j, written))
        i, j, written, _ = _forward(x, k, par, stamps, samples, mag_stamps, mags, i, j, written,
                                    rows, rows_int, tapes, block_stamps, block_of_row)
    while j < len(mag_stamps):
        fusion.push_mag(x, k, par, mag_stamps[j], mags[j])
        j += 1
    adjoint = np.zeros(N)
    information = np.zeros((N, N))
    end = written
    for x0, k0, i, j, first in reversed(snapshots):
        cov0, stamp0 = x0[fusion.COV:fusion.COV + N * N].copy(), k0[fusion.BLOCK_START]
        _, _, _, blocks = _forward(x0, k0, par, stamps, samples, mag_stamps, mags, i, j, first,
                                   rows, rows_int, tapes, block_stamps, block_of_row)
        _backward(tapes, blocks, cov0, stamp0, block_stamps, block_of_row, first, end,
                  adjoint, information, par, x[fusion.HEADING_VAR],
                  x[fusion.LIMIT:fusion.LIMIT + 3], rows, rows_int)
        end = first
    return written


@njit
def _forward(x, k, par, stamps, samples, mag_stamps, mags, i, j, written, rows, rows_int,
             tapes, block_stamps, block_of_row):
    """The filter until all tapes are full. Returns i, j, written, blocks on tape."""
    blocks = 0
    while i < len(stamps) and blocks < len(tapes):
        while j < len(mag_stamps) and mag_stamps[j] <= stamps[i]:
            fusion.push_mag(x, k, par, mag_stamps[j], mags[j])
            j += 1
        result = fusion.advance(x, k, par, stamps[i], samples[i], rows[written],
                                rows_int[written], tapes[blocks])
        if result:
            block_of_row[written] = blocks
            written += 1
        if result == 2:
            block_stamps[blocks] = stamps[i]
            blocks += 1
        i += 1
    return i, j, written, blocks


@njit
def _backward(tapes, blocks, cov0, stamp0, block_stamps, block_of_row, first, end, adjoint,
              information, par, heading_var, limits, rows, rows_int):
    """Correct the rows first..end of one segment; carry adjoint and information before it."""
    row = end - 1
    while row >= first and block_of_row[row] == blocks:
        # Behind the last block of the recording: already the best there is.
        st.beyond_limits(rows[row, st.ROW_GYR:st.ROW_GYR + 3], _clipped(rows_int[row]), limits)
        row -= 1
    last = cov0 if blocks == 0 else tapes[blocks - 1, es.TAPE_COV:es.TAPE_COV + N * N]
    after = last.reshape(N, N) @ adjoint
    cov_after = _smoothed_cov(last.reshape(N, N), information)
    for b in range(blocks - 1, -1, -1):
        tape = tapes[b]
        states = int(tape[es.TAPE_MOVE + es.MOVE_STATES])
        move = tape[es.TAPE_MOVE:es.TAPE_MOVE + es.MOVE_SIZE]
        for op in range(int(tape[es.TAPE_OPS]) - 1, -1, -1):
            start = es.TAPE_OP + op * es.OP_SIZE
            es.unupdate(tape[start:start + es.OP_SIZE], adjoint, information, states)
        pushed = adjoint * move[es.MOVE_NOISE:es.MOVE_NOISE + N]
        if tape[es.TAPE_TURNED]:
            adjoint[:] = 0.0
            information[:] = 0.0
        else:
            adjoint[:] = es.move_adjoint(move, adjoint)
            es.predict_information(information, move)
        before_cov = cov0.reshape(N, N)
        before_stamp = stamp0
        if b > 0:
            before_cov = tapes[b - 1, es.TAPE_COV:es.TAPE_COV + N * N].reshape(N, N)
            before_stamp = block_stamps[b - 1]
        before = before_cov @ adjoint
        cov_before = _smoothed_cov(before_cov, information)
        predicted = es.move_error(move, before) + pushed
        span = max(block_stamps[b] - before_stamp, 1)
        while row >= first and block_of_row[row] == b:
            if rows_int[row, 0] == block_stamps[b]:
                error, cov_row = after, cov_after
            else:
                part = (rows_int[row, 0] - before_stamp) / span
                error = (1.0 - part) * before + part * predicted
                cov_row = (1.0 - part) * cov_before + part * cov_after
            _correct_row(rows[row], par, error, cov_row, heading_var, _clipped(rows_int[row]),
                         limits)
            row -= 1
        after, cov_after = before, cov_before


@njit
def _smoothed_cov(cov, information):
    """P - P L P, of the reported states only. Returns (12, 12)."""
    n = len(_REPORTED)
    part = np.empty((n, N))
    for i in range(n):
        part[i] = cov[_REPORTED[i]]
    seen = part @ information
    reduced = seen @ part.T
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = cov[_REPORTED[i], _REPORTED[j]] - 0.5 * (reduced[i, j] + reduced[j, i])
    return out


@njit
def _clipped(row_int):
    """Bits of the gyroscope axes at their limit."""
    return (row_int[st.FLAGS_WORD] >> st.SATURATED_AXES_SHIFT) & 7


@njit
def _correct_row(row, par, error, cov, heading_var, clipped, limits):
    """Apply the error (N,) and its covariance (12, 12) to one output row."""
    frame = par[st.P_FRAME:st.P_FRAME + 4]
    back = quat_conjugate(frame)
    turn = quat_exp(error[es.ATT:es.ATT + 3])
    quat = quat_normalize(quat_multiply(
        turn, quat_multiply(back, row[st.ROW_QUAT:st.ROW_QUAT + 4])))
    row[st.ROW_QUAT:st.ROW_QUAT + 4] = quat_normalize(quat_multiply(frame, quat))
    turn_out = quat_multiply(frame, quat_multiply(turn, back))
    row[st.ROW_MAG:st.ROW_MAG + 3] = quat_rotate(turn_out, row[st.ROW_MAG:st.ROW_MAG + 3])
    rate = row[st.ROW_GYR:st.ROW_GYR + 3].copy()
    for i in range(3):
        row[st.ROW_BIAS + i] += error[es.BIAS + i]
        at_limit = (clipped >> i) & 1
        row[st.ROW_GYR + i] += error[es.EXCESS + i] * at_limit - error[es.BIAS + i]
        for j in range(3):
            row[st.ROW_GYR + i] += error[es.SCALE + 3 * i + j] * rate[j]
        row[st.ROW_ACC + i] -= error[es.ACC_BIAS + i]
        row[st.ROW_BIAS_SD + i] = math.sqrt(max(cov[3 + i, 3 + i], 0.0))
        if at_limit:
            row[st.ROW_COV_GYR + 4 * i] = max(cov[9 + i, 9 + i], 0.0) + cov[3 + i, 3 + i]
    st.beyond_limits(row[st.ROW_GYR:st.ROW_GYR + 3], clipped, limits)
    cov_world = cov[:3, :3].copy()    # other rows share cov
    cov_world[2, 2] += heading_var
    st.write_cov_attitude(row, par, cov_world, quat_to_matrix(quat),
                          row[st.ROW_GYR:st.ROW_GYR + 3])
