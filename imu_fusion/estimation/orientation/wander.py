"""Innovations that wander: what the filter states is then too small.

Innovations of a filter that knows its errors are white. Where they keep a sign for seconds an
error that is no state, or larger than was said, moves the estimate: a scale or bias of the
gyroscope beyond belief, acceleration that lasts, a field that turns with the place. The
low-passed innovation is then larger than that of white ones, and the estimate's error exceeds what
is stated by more than that: the filter follows what lasts, so that the innovation keeps a part of
it only. A power of its mean square widens the attitude's covariance on output; gains stay.
"""

import math

from imu_fusion.estimation.orientation.error_state import UNIFORM_VARIANCE
from imu_fusion.kernels import njit

_TIME = 5.0            # s, of the low-pass: slower than the motion, faster than the tilt forgets
_MEMORY = 10.0         # s, over which its square is judged
_PRIOR = 2.0           # s, that white innovations count for before there are any
LOST = 9.0             # mean square of the tilt's above which nothing that is linear describes it
TILT, HEADING = 0, 1   # of the mean squares
# Powers of the mean square by which standard deviations grow: 0.5 where innovations keep all of an
# error. Tilt is followed fast, heading slowly. Chosen on the phones of benchmarks/orientation_sets.
_TILT_POWER, _HEADING_POWER = 1.0, 0.625


@njit
def low_passed(value, innovation, time):
    """A low-passed unit innovation after another one of ``time`` s: of unit variance if white."""
    keep = math.exp(-time / _TIME)
    return keep * value + math.sqrt(1.0 - keep * keep) * innovation


@njit
def judge(wander, time):
    """Mean squares after a block of ``time`` s, whose innovations are in."""
    if time == 0.0:
        return
    if wander.time == 0.0:
        wander.recent[:] = 1.0
        wander.overall[:] = 1.0
    wander.time += time
    # A low-pass that has just begun at zero shows less than it will.
    settled = 1.0 - math.exp(-2.0 * wander.time / _TIME)
    begun = wander.time + _PRIOR
    for kind in range(2):
        if kind == TILT:
            square = 0.5 * (wander.velocity[0] ** 2 + wander.velocity[1] ** 2)
        else:
            square = wander.field ** 2
        excess = square / settled
        wander.overall[kind] += time / begun * (excess - wander.overall[kind])
        wander.recent[kind] += time / min(begun, _MEMORY) * (excess - wander.recent[kind])


@njit
def shown(wander):
    """Mean squares by which live estimates are widened: what innovations do now, and at least what
    they have done so far, which can come back at any time."""
    return (max(wander.recent[TILT], wander.overall[TILT]),
            max(wander.recent[HEADING], wander.overall[HEADING]))


@njit
def widen(cov_world, squares, overall):
    """Widen an attitude's covariance (3, 3), world axes, in place, by mean squares (2,). Where the
    filter is lost by what they were ``overall``, its heading may be any: a needle that was far off
    at the start, say."""
    tilt, heading = max(squares[TILT], 1.0), max(squares[HEADING], 1.0)
    if tilt == 1.0 and heading == 1.0:
        return
    factor = (tilt ** _TILT_POWER, tilt ** _TILT_POWER, heading ** _HEADING_POWER)
    for i in range(3):
        for j in range(3):
            cov_world[i, j] *= factor[i] * factor[j]
    if overall[TILT] > LOST:
        cov_world[2, 2] += UNIFORM_VARIANCE
