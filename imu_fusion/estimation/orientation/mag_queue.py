"""Magnetometer samples between their arrival and the Imu sample that passes them."""

import math

import numpy as np

from imu_fusion.estimation.orientation import mag_rejection, rotation_history
from imu_fusion.estimation.orientation.mag_repeats import is_stale
from imu_fusion.estimation.orientation.state import QUEUE_LENGTH
from imu_fusion.kernels import njit

TAKEN = np.dtype([
    ("field", "f8", 3),     # T, calibrated, imu axes at its own time
    ("rate", "f8", 3),      # rad/s, of turn at that time
    ("turn", "f8", 4),      # rotation from there to the newest Imu sample
], align=True)
"""A sample that the newest Imu sample has passed."""


@njit
def push(s, p, stamp, mag):
    """Take one magnetometer sample (tesla, imu axes), in any order of arrival.

    It belongs to ``stamp`` less the magnetometer's lag behind the Imu. Refused ones are counted
    (mag_rejection); of more than QUEUE_LENGTH waiting ones the oldest goes, counted as rejected.
    """
    if mag_rejection.is_refused(s, p, stamp, mag):
        return
    queue, offset, matrix = s.queue, p.sensor.mag_offset, p.sensor.mag_matrix
    calibrated = np.empty(3)
    for i in range(3):
        calibrated[i] = 0.0
        for j in range(3):
            calibrated[i] += matrix[3 * i + j] * (mag[j] - offset[j])
    if mag_rejection.is_no_field(calibrated):
        s.counts.mag_rejected += 1
        return
    if is_stale(s.mag_repeats, stamp, calibrated, s.history.quat, p.sensor.mag_noise_sd):
        s.counts.mag_repeated += 1
        return
    if queue.count == QUEUE_LENGTH:
        # A magnetometer far faster than the Imu.
        s.counts.mag_rejected += 1
        for i in range(QUEUE_LENGTH - 1):
            _copy(queue, i, i + 1)
        queue.count -= 1
    queue.stamps[queue.count] = stamp - np.int64(math.floor(s.mag_lag * 1e9 + 0.5))
    for i in range(3):
        queue.field[queue.count, i] = calibrated[i]
    queue.count += 1


@njit
def take(s, taken):
    """The waiting samples that the newest Imu sample has passed.

    Writes a TAKEN for each to ``taken`` (s.queue.count,); returns how many. Those that the history
    of rotations does not reach back to are counted as late.
    """
    queue = s.queue
    count = 0
    kept = 0
    for i in range(queue.count):
        if queue.stamps[i] > s.stamp:
            _copy(queue, kept, i)
            kept += 1
        elif rotation_history.look_back(s.history, queue.stamps[i], taken[count]):
            for j in range(3):
                taken[count].field[j] = queue.field[i, j]
            count += 1
        else:
            s.counts.mag_late += 1
    queue.count = kept
    return count


@njit
def _copy(queue, to, source):
    queue.stamps[to] = queue.stamps[source]
    for j in range(3):
        queue.field[to, j] = queue.field[source, j]
