"""Magnetometer samples that cannot be used: broken, too late, or at the end of the sensor's range,
which is given or found from flat tops.

A field component that peaks smoothly in steps of q stays on its largest value for n
samples only if it came there by a step of about 4 q / n (a parabola of quantised values):
a value that repeats four times and was reached by a step of more than four q is no
smooth peak but a top cut off. Since a sensor that comes to rest abruptly looks the same, a
repeat counts only while another axis still moves by more than four of its steps.
"""

import math

import numpy as np

from imu_fusion.estimation.orientation.imu_rejection import is_within
from imu_fusion.estimation.orientation.rows import FLAG_MAG_SATURATED
from imu_fusion.kernels import njit

_WILD_FIELD = 1e6          # T: what no sensor reports, whatever its unit
_NO_FIELD = 1e-9           # T: zeros of a magnetometer that is not there; rooms shield to more
_REPEATS_AT_LIMIT = 4      # equal largest values that make a flat top
_STEPS = 4.0               # see above
_EARTH_FIELD = 70e-6       # T: a range below the Earth's field (up to 67 uT) is not searched for
TOLERANCE = 1e-3          # the two ends of a range differ by a step, but by no more than this


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
def is_saturated(found, ranges, mag):
    """Whether a sample has an axis at its limit; learns the limits that are not given.

    Args:
        found: state.MAG_LIMIT, what was learnt so far; changed.
        ranges: (3,) tesla, nan for an axis whose limit is to be found.
        mag: (3,) tesla, finite, as the sensor reports it, in order of arrival.

    The samples of the first flat top that come before the fourth are not recognised. A
    larger value than a limit found shows that it was none: the search starts anew.
    """
    first = not found.seen
    found.seen = True
    # A driver that repeats whole samples says nothing.
    held = (not first and mag[0] == found.last[0] and mag[1] == found.last[1]
            and mag[2] == found.last[2])
    saturated = False
    for i in range(3):
        size = abs(mag[i])
        if not math.isnan(ranges[i]):
            saturated = saturated or size >= ranges[i]
            continue
        if first:
            found.step[i] = math.inf
        elif not held:
            _look_at(found, mag, i)
        found.largest[i] = max(found.largest[i], size)
        limit = found.limit[i]
        if limit > 0.0:
            slack = min(1.5 * found.step[i], TOLERANCE * limit)
            if size > limit + slack:
                found.limit[i] = 0.0
            elif size >= limit - slack:
                saturated = True
    for i in range(3):
        found.last[i] = mag[i]
    return saturated


@njit
def _look_at(found, mag, i):
    """Axis i of a sample that is not a repetition: does a flat top go on, or end?"""
    move = abs(mag[i] - found.last[i])
    if move > 0.0:
        found.step[i] = min(found.step[i], move)
        found.entry_step[i] = move
        found.repeats[i] = 0
        return
    turning = False
    for j in range(3):
        turning = turning or abs(mag[j] - found.last[j]) > _STEPS * found.step[j]
    if not turning:
        return
    found.repeats[i] += 1
    size = abs(mag[i])
    if (found.repeats[i] >= _REPEATS_AT_LIMIT - 1 and size >= found.largest[i]
            and size > _EARTH_FIELD and found.entry_step[i] > _STEPS * found.step[i]):
        found.limit[i] = size


@njit
def are_saturated(found, par, mags):
    """:func:`is_saturated` of each row of (m, 3), with the range of the parameters.

    found: (1,) state.MAG_LIMIT; par: parameters of kernel_parameters.
    """
    result = np.empty(len(mags), dtype=np.bool_)
    for i in range(len(mags)):
        result[i] = is_saturated(found[0], par[0].sensor.mag_range, mags[i])
    return result
