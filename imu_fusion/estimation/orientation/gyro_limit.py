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

_QUIET = 0.3         # of the noise of a sample: what moves less is clipped
_LASTING = 16        # bends between samples of a flat top that is the only one
_WINDOW = 16         # samples, of which the quietest show the noise
_MIXED = 0.1         # of another axis: no calibration mixes more
_ROUNDS = 4
_KEPT = 0.85         # of them: the others lead to the top and from it
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
    given = par["sensor"]["gyro_range"][0]
    for i in range(3):
        if np.isnan(given[i]) and np.isinf(limit[i]) and largest[i] > GYRO_FLOOR:
            level = _quiet_top(gyr, i, largest[i])
            if level:
                limit[i], found["tolerance"][0, i] = level, 2.0 * BAND
    known = np.isfinite(limit)
    if known.any() and np.isnan(given).any():
        shared = limit[known].max()
        alike = ~known & (np.abs(largest / shared - 1.0) < _ALIKE)
        limit[alike], found["tolerance"][0, alike] = shared, _ALIKE
    return found


def _quiet_top(gyr, i, largest):
    """Level (rad/s) of a flat top of axis i that comes once in a recording, 0 where there is none:
    near its largest value an axis has less than its noise, but for what a calibration mixes in of
    the other axes. No motion does that."""
    size = np.abs(gyr[:, i])
    at_top = size >= (1.0 - BAND) * largest
    away = size < (1.0 - _ALIKE) * largest
    bends = np.diff(gyr, n=2, axis=0)    # which motion hardly has
    new = np.diff(gyr, axis=0).any(axis=1)    # a driver that repeats whole samples is not quiet
    new = new[1:] & new[:-1]
    top, elsewhere = (new & m[2:] & m[1:-1] & m[:-2] for m in (at_top, away))
    if np.count_nonzero(top) < _LASTING or np.count_nonzero(elsewhere) < _WINDOW:
        return 0.0
    windows = np.abs(bends[elsewhere, i])
    noise = windows[:len(windows) // _WINDOW * _WINDOW].reshape(-1, _WINDOW).mean(axis=1).min()
    own, others = bends[top, i], np.delete(bends[top], i, axis=1)
    left = np.abs(own)
    for _ in range(_ROUNDS):    # the way to the top and from it is among them
        kept = left <= max(3.0 * float(np.median(left)), noise)
        shares = np.linalg.lstsq(others[kept], own[kept], rcond=None)[0]
        if np.abs(shares).max() > _MIXED:    # another axis that is clipped, too, shows this one
            break
        left = np.abs(own - others @ shares)
    quiet = kept.mean() > _KEPT and left[kept].mean() < _QUIET * noise
    return float(np.median(size[at_top])) if quiet else 0.0
