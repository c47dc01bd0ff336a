"""Gyroscope axes at the end of their range, which is given or found from flat tops."""

import numpy as np

from imu_fusion.kernels import njit
from imu_fusion.samples.flat_tops import (
    BAND,
    FLAT_TOPS,
    GYRO_FLOOR,
    find_flat_tops,
    mark_flat_tops,
    start_flat_tops,
)

_ALIKE = 0.05        # of a limit: what calibrations let those of the axes of one sensor differ by


@njit
def start(found, ranges):
    """Limits that were given, (3,) rad/s; those to be found (nan) are infinite until then."""
    # A range from a data sheet is that before calibration.
    start_flat_tops(found, ranges, BAND)


@njit
def find(found, ranges, gyr):
    """Learn each axis' limit from flat tops, unless given; mark the axes at theirs.

    Args:
        found: FLAT_TOPS, what was learnt so far; changed.
        ranges: (3,) rad/s, nan for an axis whose limit is to be found.
        gyr: (3,) rad/s, in order.

    Returns:
        int, bits of the axes at their limit, x first.
    """
    return find_flat_tops(found, ranges, GYRO_FLOOR, False, gyr)


@njit
def _find_all(found, par, gyr):
    ranges = par[0].sensor.gyro_range
    start(found[0], ranges)
    mark_flat_tops(found, ranges, GYRO_FLOOR, False, gyr)


def ranges_of(gyr: np.ndarray, par: np.ndarray) -> np.ndarray:
    """Limits (3,) rad/s as :func:`limits_of` finds them, infinite where no axis has one."""
    limits = limits_of(gyr, par)["limit"][0]
    return np.minimum(limits, limits[np.isfinite(limits)].max(initial=0.0) or np.inf)


def limits_of(gyr: np.ndarray, par: np.ndarray) -> np.ndarray:
    """What rates (n, 3) rad/s show of the gyroscope's limits, (1,) FLAT_TOPS: its ``limit`` is
    given, found or infinite.

    An axis that reaches the limit of the others and does not pass it has that one, too: behind a
    calibration that mixes axes its tops are not flat, and it may have been there too seldom.

    par: parameters of kernel_parameters.
    """
    found = np.zeros(1, FLAT_TOPS)
    _find_all(found, par, np.ascontiguousarray(gyr))
    limit, largest = found["limit"][0], found["largest"][0]
    known = np.isfinite(limit)
    if known.any() and np.isnan(par["sensor"]["gyro_range"]).any():
        shared = limit[known].max()
        alike = ~known & (np.abs(largest / shared - 1.0) < _ALIKE)
        limit[alike], found["tolerance"][0, alike] = shared, _ALIKE
    return found
