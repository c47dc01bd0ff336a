"""The compiled core that live and batch share: samples in, rows out, one loop for both methods.

Every function takes the state (k,) of :data:`state.STATE`, changed in place, and the parameters
(k,) of :func:`params.kernel_parameters`: an element for each hypothesis.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from imu_fusion.estimation.orientation import (
    bank,
    first_state,
    fusion,
    gyro_limit,
    gyro_mag,
    mag_queue,
    mag_rejection,
)
from imu_fusion.estimation.orientation.alignment import Alignment
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE
from imu_fusion.estimation.orientation.state import new_state
from imu_fusion.kernels import entry_point, njit

CURSOR = np.dtype([("imu", "i8"), ("mag", "i8"), ("row", "i8")])
"""How far :func:`forward` is: samples taken of both logs, rows written."""


def initialise(state: np.ndarray, par: np.ndarray, alignment: Alignment,
               before: np.ndarray | None = None) -> None:
    """Start a zeroed state from an Alignment; before: the state that ended in a gap."""
    state["quat_world_imu"] = alignment.quat_world_imu
    state["history"]["quat"] = 0.0, 0.0, 0.0, 1.0
    _start_limits(state, par)
    if par["as_printed"][0]:
        gyro_mag.initialise(state, alignment)
    else:
        if before is not None:
            bank.part(before, par)
        for k in range(len(state)):
            first_state.initialise(state[k:k + 1], par[k:k + 1], alignment,
                                   None if before is None else before[k])


@njit
def _start_limits(state, par):
    for k in range(len(state)):
        gyro_limit.start(state[k].gyro_limit, par[k].sensor.gyro_range)
        mag_rejection.start_limit(state[k].mag_limit, par[k].sensor.mag_range)


@njit
def push_mag(state, par, stamp, mag):
    """Take one magnetometer sample: int64 ns, (3,) tesla as the sensor reports it."""
    for k in range(len(state)):
        mag_queue.push(state[k], par[k], stamp, mag)


@njit
def step_imu(state, par, stamp, sample, rows):
    """One Imu sample: int64 ns, (6,) rate rad/s and specific force m/s^2.

    rows: (1,) ORIENTATION_DTYPE, gets the row. Returns 0 if the sample was refused, else 1 or 2.
    """
    if par[0].as_printed:
        return gyro_mag.step(state[0], par[0], stamp, sample, rows[0])
    return bank.step(state, par, stamp, sample, rows[0])


@cache
def live_calls() -> tuple[Callable, Callable]:
    """:func:`step_imu` and :func:`push_mag` as live streams call them, a sample at a time."""
    par = kernel_parameters(OrientationParams())
    state = new_state(len(par))
    return (entry_point(step_imu, state, par, 0, np.zeros(6), np.zeros(1, ORIENTATION_DTYPE)),
            entry_point(push_mag, state, par, 0, np.zeros(3)))


@njit
def forward(state, par, stamps, samples, mag_stamps, mags, cursor, rows, tapes):
    """Whole logs in merge order: a magnetometer sample before the Imu of the same stamp.

    Args:
        stamps: (n,) int64 ns. samples: (n, 6). mag_stamps: (m,) int64 ns. mags: (m, 3).
        cursor: (1,) CURSOR, where to begin; gets where it ended.
        rows: (n,) ORIENTATION_DTYPE, written from ``cursor.row`` on.
        tapes: (k,) error_state.TAPE, one per block, for the smoother: the filter stops when all
            are full; of the first hypothesis alone. Empty: nothing is recorded, and it goes on to
            the end.

    Returns:
        Blocks on tape.
    """
    at = cursor[0]
    blocks = 0
    while at.imu < len(stamps) and (blocks < len(tapes) or len(tapes) == 0):
        while at.mag < len(mag_stamps) and mag_stamps[at.mag] <= stamps[at.imu]:
            push_mag(state, par, mag_stamps[at.mag], mags[at.mag])
            at.mag += 1
        tape = tapes[blocks:blocks + 1]
        if len(tape) > 0:
            result = fusion.step(state[0], par[0], stamps[at.imu], samples[at.imu], rows[at.row],
                                 tape)
        else:
            result = step_imu(state, par, stamps[at.imu], samples[at.imu],
                              rows[at.row:at.row + 1])
        if result > 0:
            at.row += 1
        if result == 2 and len(tape) > 0:
            tape[0].stamp = stamps[at.imu]
            tape[0].row_end = at.row
            blocks += 1
        at.imu += 1
    if at.imu == len(stamps):
        while at.mag < len(mag_stamps):
            push_mag(state, par, mag_stamps[at.mag], mags[at.mag])
            at.mag += 1
    return blocks
