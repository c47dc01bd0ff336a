"""Magnetometer samples at the end of the sensor's range, given or found from flat tops.

A field component that peaks smoothly in steps of q stays on its largest value for n
samples only if it came there by a step of about 4 q / n (a parabola of quantised values):
a value that repeats four times and was reached by a step of more than four q is no
smooth peak but a top cut off. Since a sensor that comes to rest abruptly looks the same, a
repeat counts only while another axis still moves by more than four of its steps.
"""

import math

from imu_fusion.kernels import njit

# Float state: limits found (0: none yet), last sample, step that led to the present
# value, largest value, smallest step; (3,) each. Integers: repeats (3,), samples seen.
LIMIT, LAST, ENTRY, LARGEST, STEP, FLOATS = 0, 3, 6, 9, 12, 15
SEEN, INTS = 3, 4

_REPEATS_AT_LIMIT = 4      # equal largest values that make a flat top
_STEPS = 4.0               # see above
_EARTH_FIELD = 70e-6       # T: a range below the Earth's field (up to 67 uT) is not searched for
_TOLERANCE = 1e-3          # the two ends of a range differ by a step, but by no more than this


@njit
def is_saturated(floats, ints, ranges, mag):
    """Whether a sample has an axis at its limit; learns the limits that are not given.

    Args:
        floats: (FLOATS,), ints: (INTS,): what was learnt so far, zeros at the start; changed.
        ranges: (3,) tesla, nan for an axis whose limit is to be found.
        mag: (3,) tesla, finite, as the sensor reports it, in order of arrival.

    The samples of the first flat top that come before the fourth are not recognised. A
    larger value than a limit found shows that it was none: the search starts anew.
    """
    first = ints[SEEN] == 0
    ints[SEEN] = 1
    held = not first
    for i in range(3):
        # A driver that repeats whole samples says nothing.
        held = held and mag[i] == floats[LAST + i]
    saturated = False
    for i in range(3):
        size = abs(mag[i])
        if not math.isnan(ranges[i]):
            saturated = saturated or size >= ranges[i]
            continue
        if first:
            floats[STEP + i] = math.inf
        elif not held:
            _look_at(floats, ints, mag, i)
        floats[LARGEST + i] = max(floats[LARGEST + i], size)
        limit = floats[LIMIT + i]
        if limit > 0.0:
            slack = min(1.5 * floats[STEP + i], _TOLERANCE * limit)
            if size > limit + slack:
                floats[LIMIT + i] = 0.0
            elif size >= limit - slack:
                saturated = True
    for i in range(3):
        floats[LAST + i] = mag[i]
    return saturated


@njit
def _look_at(floats, ints, mag, i):
    """Axis i of a sample that is not a repetition: does a flat top go on, or end?"""
    move = abs(mag[i] - floats[LAST + i])
    if move > 0.0:
        floats[STEP + i] = min(floats[STEP + i], move)
        floats[ENTRY + i] = move
        ints[i] = 0
        return
    turning = False
    for j in range(3):
        turning = turning or abs(mag[j] - floats[LAST + j]) > _STEPS * floats[STEP + j]
    if not turning:
        return
    ints[i] += 1
    size = abs(mag[i])
    if (ints[i] >= _REPEATS_AT_LIMIT - 1 and size >= floats[LARGEST + i] and size > _EARTH_FIELD
            and floats[ENTRY + i] > _STEPS * floats[STEP + i]):
        floats[LIMIT + i] = size
