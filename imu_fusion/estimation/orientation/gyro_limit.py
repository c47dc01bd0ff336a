"""Gyroscope axes at the end of their range, which is given or found from flat tops."""

import math

import numpy as np

from imu_fusion.estimation.orientation.state import GYRO_LIMIT
from imu_fusion.kernels import njit
from imu_fusion.sensors.saturation import LIMIT_TOLERANCE

_REPEATS_AT_LIMIT = 4      # equal largest values in a row that make a flat top
# A flat top is run into by a step of more than this share of its size. A smooth peak that repeats
# four times was reached by about one step of quantisation: 5e-4 of full scale for 12 bits.
_ENTRY_SHARE = 2e-3
_LIMIT_FLOOR = 1.0         # rad/s: no gyroscope has a smaller range


@njit
def start(found, ranges):
    """Limits that were given, (3,) rad/s; those to be found (nan) are infinite until then."""
    for i in range(3):
        found.limit[i] = math.inf if math.isnan(ranges[i]) else ranges[i]


@njit
def find(found, ranges, gyr):
    """Learn each axis' limit from flat tops, unless given; mark the axes at theirs.

    Args:
        found: state.GYRO_LIMIT, what was learnt so far; changed.
        ranges: (3,) rad/s, nan for an axis whose limit is to be found.
        gyr: (3,) rad/s, in order.

    Returns:
        int, bits of the axes at their limit, x first.
    """
    clipped = 0
    # A driver that repeats whole samples makes no flat tops.
    held = (gyr[0] == found.last[0] and gyr[1] == found.last[1] and gyr[2] == found.last[2])
    for i in range(3):
        size = abs(gyr[i])
        if math.isnan(ranges[i]):
            if held:
                pass
            elif gyr[i] == found.last[i]:
                found.repeats[i] += 1
                if (found.repeats[i] >= _REPEATS_AT_LIMIT - 1
                        and size >= found.largest[i] * (1.0 - LIMIT_TOLERANCE)
                        and found.entry_step[i] > _ENTRY_SHARE * size
                        > _ENTRY_SHARE * _LIMIT_FLOOR):
                    found.limit[i] = min(found.limit[i], size)
            else:
                found.repeats[i] = 0
                found.entry_step[i] = abs(gyr[i] - found.last[i])
            # Two samples in a row: a single wild one neither hides nor disproves a limit.
            lasting = min(size, abs(found.last[i]))
            found.largest[i] = max(found.largest[i], lasting)
            if lasting > found.limit[i] * (1.0 + LIMIT_TOLERANCE):
                found.limit[i] = np.inf    # a repeated value that was no limit
            found.last[i] = gyr[i]
        if size >= found.limit[i] * (1.0 - LIMIT_TOLERANCE):
            clipped |= 1 << i
    return clipped


@njit
def _find_all(found, par, gyr):
    ranges = par[0].sensor.gyro_range
    start(found[0], ranges)
    for i in range(len(gyr)):
        find(found[0], ranges, gyr[i])


def limits_of(gyr: np.ndarray, par: np.ndarray) -> np.ndarray:
    """Limits (3,) rad/s that are given or that rates (n, 3) show by flat tops, else infinite.

    par: parameters of kernel_parameters.
    """
    found = np.zeros(1, GYRO_LIMIT)
    _find_all(found, par, np.ascontiguousarray(gyr))
    return found["limit"][0]
