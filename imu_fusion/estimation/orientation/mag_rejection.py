"""Magnetometer samples that cannot be used: broken, too late, or at the end of the sensor's range,
which is given or found from flat tops (samples.flat_tops).
"""

import numpy as np

from imu_fusion.estimation.orientation.imu_rejection import is_within
from imu_fusion.estimation.orientation.rows import FLAG_MAG_SATURATED
from imu_fusion.kernels import njit
from imu_fusion.samples.flat_tops import (
    FLAT_TOPS,
    LIMIT_TOLERANCE,
    MAG_FLOOR,
    find_flat_tops,
    start_flat_tops,
)

_WILD_FIELD = 1e6          # T: what no sensor reports, whatever its unit
_NO_FIELD = 1e-9           # T: zeros of a magnetometer that is not there; rooms shield to more


@njit
def is_mag_sample(mag):
    """Whether (3,) tesla are numbers that a sensor can report."""
    return is_within(mag, _WILD_FIELD) and not is_within(mag, _NO_FIELD)


@njit
def is_no_field(mag):
    """Whether (3,) tesla are those of a magnetometer that is not there."""
    return is_within(mag, _NO_FIELD)


@njit
def is_refused(s, p, stamp, mag):
    """Whether a sample (3,) tesla, as the sensor reports it, is of no use; counts why."""
    if not is_mag_sample(mag) or not s.started:
        s.counts.mag_rejected += 1
        return True
    if is_saturated(s.mag_limit, p.sensor.mag_range, mag):
        s.counts.mag_saturated += 1
        s.waiting_flags |= FLAG_MAG_SATURATED
        return True
    if s.stamp - stamp > p.mag.max_latency * 1e9:
        s.counts.mag_late += 1
        return True
    return False


@njit
def start_limit(found, ranges):
    """Begin a search for the magnetometer's range; ``ranges`` (3,) tesla, nan: to be found."""
    start_flat_tops(found, ranges, LIMIT_TOLERANCE)


@njit
def is_saturated(found, ranges, mag):
    """Whether a sample has an axis at its limit; learns the limits that are not given.

    Args:
        found: FLAT_TOPS, what was learnt so far; changed.
        ranges: (3,) tesla, nan for an axis whose limit is to be found.
        mag: (3,) tesla, finite, as the sensor reports it, in order of arrival.
    """
    return find_flat_tops(found, ranges, MAG_FLOOR, True, mag) != 0


def new_limit(par: np.ndarray) -> np.ndarray:
    """A search with its first sample to come, (1,) FLAT_TOPS. par: of kernel_parameters."""
    found = np.zeros(1, FLAT_TOPS)
    _start(found, par)
    return found


@njit
def _start(found, par):
    start_limit(found[0], par[0].sensor.mag_range)


@njit
def are_saturated(found, par, mags):
    """:func:`is_saturated` of each row of (m, 3), with the range of the parameters.

    found: (1,) of :func:`new_limit`; par: parameters of kernel_parameters.
    """
    result = np.empty(len(mags), dtype=np.bool_)
    for i in range(len(mags)):
        result[i] = is_saturated(found[0], par[0].sensor.mag_range, mags[i])
    return result
