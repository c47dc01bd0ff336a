"""Fixed-interval smoothing of the fusion filter: modified Bryson-Frazier (Bierman 1973).

The same kernel runs forward; its predictions and updates are read backwards, which
needs no inverse of a covariance. To keep memory small on long recordings only
snapshots are kept on the way forward; each segment between two snapshots is run again
with its tape when its turn comes.
"""

import math

import numpy as np

from imu_fusion.estimation.orientation import bank, wander
from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.kernel import CURSOR, forward
from imu_fusion.estimation.orientation.rows import clipped_axes, raise_to_limits, write_cov_attitude
from imu_fusion.geometry.rotation import (
    quat_conjugate,
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_to_matrix,
)
from imu_fusion.kernels import njit

# Blocks between snapshots. A snapshot is about as large as a tape: the memory of n blocks,
# n / 128 snapshots and 128 tapes, is smallest near sqrt(n), 2.5 s for five minutes of 20 ms blocks.
_SEGMENT = 128
# Of the error state, what rows report: attitude, bias, accelerometer bias, clipped rate.
_REPORTED = np.array([*range(es.ATTITUDE, es.GYRO_SCALE), *range(es.ACC_BIAS, es.MAG_LAG),
                      *range(es.CLIPPED_RATE, es.ANGULAR_ACC)])
_BIAS, _CLIPPED = 3, 9    # in _REPORTED


def smooth(state: np.ndarray, par: np.ndarray, stamps: np.ndarray, samples: np.ndarray,
           mag_stamps: np.ndarray, mags: np.ndarray, rows: np.ndarray) -> int:
    """Smoothed rows of a whole recording: the mixture of what its hypotheses give, with the weights
    that they have at its end.

    Args:
        state, par: (k,), initialised; ends as the causal filter's.
        stamps (n,), samples (n, 6), mag_stamps (m,), mags (m, 3): as for kernel.forward.
        rows: (n,) ORIENTATION_DTYPE, zeros.

    Returns:
        Number of rows written.
    """
    logs = stamps, samples, mag_stamps, mags
    tapes = np.zeros(_SEGMENT, es.TAPE)
    bank.part(state, par)
    parted = len(mags) > 0 or state["field_norm"][0] > 0.0
    used = len(state) if parted else int(par["without_field"][0])
    own = [rows, *(np.zeros_like(rows) for _ in range(1, used))]
    passes = [_forward(state[k:k + 1], par[k:k + 1], logs, own[k], tapes)
              for k in range(len(own))]
    weight = bank.weights(state, par)
    doubt = bank.doubts(state, par, weight)
    kept = np.flatnonzero(weight + doubt)
    for k in kept:
        _smooth(state[k:k + 1], par[k:k + 1], logs, own[k], tapes, passes[k])
    written = int(passes[0][-1][1]["row"][0])
    if used > 1:
        bank.mix_all(np.stack([own[k][:written] for k in kept]), weight[kept], doubt[kept], rows)
    return written


_Pass = list[tuple[np.ndarray, np.ndarray]]    # state and cursor before each segment and at the end


def _forward(state: np.ndarray, par: np.ndarray, logs: tuple[np.ndarray, ...], rows: np.ndarray,
             tapes: np.ndarray) -> _Pass:
    """The filter of one hypothesis over the recording. A rest that refutes a bias takes seconds to
    do so: it is run again, knowing of that rest from its beginning."""
    start, known = state.copy(), state["rest"]["refuting"].copy()
    while True:
        cursor = np.zeros(1, CURSOR)
        snapshots = []
        while cursor["imu"][0] < len(logs[0]):
            snapshots.append((state.copy(), cursor.copy()))
            forward(state, par, *logs, cursor, rows, tapes)
        if (state["rest"]["refuting"] == known).all():
            return [*snapshots, (state, cursor)]
        known = state["rest"]["refuting"].copy()
        state[:] = start
        state["rest"]["refuting"] = known


def _smooth(state: np.ndarray, par: np.ndarray, logs: tuple[np.ndarray, ...], rows: np.ndarray,
            tapes: np.ndarray, passed: _Pass) -> None:
    """Correct the rows of one hypothesis, segment by segment from the last on."""
    *snapshots, (_, cursor) = passed
    end = int(cursor["row"][0])
    adjoint = np.zeros(es.N)
    information = np.zeros((es.N, es.N))
    for before, cursor in reversed(snapshots):
        first = int(cursor["row"][0])
        blocks = forward(before.copy(), par, *logs, cursor, rows, tapes)
        _backward(tapes[:blocks], before, state, par, rows[first:end], first, adjoint, information)
        end = first


@njit
def _backward(tapes, before, final, par, rows, first, adjoint, information):
    """Correct the rows of one segment; carry adjoint and information before it.

    Args:
        tapes: (k,) of its blocks. before: (1,) state at its start; final: at the recording's end.
        rows: its rows; first: the index of the first of them in the recording.
        adjoint, information: (N,), (N, N) of what comes later; changed.
    """
    p, s0, limits = par[0], before[0], final[0].gyro_limit.limit
    blocks = len(tapes)
    row = len(rows) - 1
    ended = tapes[blocks - 1].row_end - first if blocks else 0
    while row >= ended:
        # Behind the last block of the recording: already the best there is.
        raise_to_limits(rows[row].gyr, clipped_axes(rows[row].flags), limits)
        row -= 1
    last = tapes[blocks - 1].cov[:] if blocks else s0.cov[:]
    after, cov_after = last @ adjoint, _smoothed_cov(last, information)
    for b in range(blocks - 1, -1, -1):
        tape = tapes[b]
        pushed = _unwind(tape, adjoint, information)
        before_cov = tapes[b - 1].cov[:] if b else s0.cov[:]
        before_stamp = tapes[b - 1].stamp if b else s0.block_start
        begun = tapes[b - 1].row_end - first if b else 0
        error = before_cov @ adjoint
        cov_before = _smoothed_cov(before_cov, information)
        predicted = es.move_error(tape.prediction, error) + pushed
        span = max(tape.stamp - before_stamp, 1)
        while row >= begun:
            dt = (rows[row].stamp - rows[max(row, 1) - 1].stamp) * 1e-9
            if rows[row].stamp == tape.stamp:
                _correct_row(rows[row], p, after, cov_after, final[0], limits, dt)
            else:
                part = (rows[row].stamp - before_stamp) / span
                _correct_row(rows[row], p, (1.0 - part) * error + part * predicted,
                             (1.0 - part) * cov_before + part * cov_after, final[0], limits, dt)
            row -= 1
        after, cov_after = error, cov_before


@njit
def _unwind(tape, adjoint, information):
    """Carry adjoint and information before a block. Returns (N,) the adjoint times its noise."""
    for which in range(tape.count - 1, -1, -1):
        es.unupdate(tape, which, adjoint, information)
    pushed = adjoint * tape.prediction.noise
    if tape.turned:
        adjoint[:] = 0.0
        information[:] = 0.0
    else:
        adjoint[:] = es.move_adjoint(tape.prediction, adjoint)
        es.predict_information(information, tape.prediction)
    return pushed


@njit
def _smoothed_cov(cov, information):
    """P - P L P, of the reported states only. Returns (12, 12)."""
    n = len(_REPORTED)
    part = np.empty((n, es.N))
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
def _correct_row(row, p, error, cov, final, limits, dt):
    """Apply the error (N,) and its covariance (12, 12) to one output row. final: the state at the
    recording's end; dt: s, the step before the row."""
    frame = p.frame_from_enu
    back = quat_conjugate(frame)
    turn = quat_exp(error, 1.0)
    quat = quat_normalize(quat_multiply(turn, quat_multiply(back, row.quat_world_imu)))
    row.quat_world_imu[:] = quat_normalize(quat_multiply(frame, quat))
    turn_out = quat_multiply(frame, quat_multiply(turn, back))
    row.mag_world[:] = quat_rotate(turn_out, row.mag_world)
    clipped = clipped_axes(row.flags)
    gyr = row.gyr
    rate = (gyr[0], gyr[1], gyr[2])
    for i in range(3):
        at_limit = (clipped >> i) & 1
        row.gyr_bias[i] += error[es.GYRO_BIAS + i]
        gyr[i] += error[es.CLIPPED_RATE + i] * at_limit - error[es.GYRO_BIAS + i]
        for j in range(3):
            gyr[i] += error[es.GYRO_SCALE + 3 * i + j] * rate[j]
        if p.lasting_acc_sd == 0.0:
            row.acc[i] -= error[es.ACC_BIAS + i]
        row.gyr_bias_sd[i] = math.sqrt(max(cov[_BIAS + i, _BIAS + i], 0.0))
        if at_limit:
            row.cov_gyr[i, i] = (max(cov[_CLIPPED + i, _CLIPPED + i], 0.0)
                                 + cov[_BIAS + i, _BIAS + i])
    raise_to_limits(gyr, clipped, limits)
    cov_world = cov[:3, :3].copy()    # other rows share cov
    wander.widen(cov_world, final.wander.overall, final.wander.overall)
    cov_world[2, 2] += final.heading_var
    write_cov_attitude(row, p, cov_world, quat_to_matrix(quat), dt)
