"""Flat tops: axes at the end of their range, where nobody has said where that is.

Four equal largest values in a row, run into with a step, are a flat top. Behind a calibration
matrix, a filter or a subtracted bias values at the limit are no longer equal: then it is a run
within a narrow band that is longer than a smooth peak's with such steep edges. A parabola is within
a band b for n samples and enters it by a step e with (n - 1) e <= 6 b, whatever its curvature; two
runs of more at one level prove a limit. From e the largest step inside is taken: noise.

A sensor that pauses looks the same on one axis: a run within a band counts only where another axis
moves meanwhile, and so do equal values of sensors that show something large at rest.
"""

import math
from dataclasses import dataclass

import numpy as np

from imu_fusion.kernels import njit

# No accelerometer has a smaller range than +-2 g, no gyroscope and no magnetometer than these: the
# Earth's field has up to 67 uT.
ACC_FLOOR, GYRO_FLOOR, MAG_FLOOR = 19.0, 1.0, 70e-6     # m/s^2, rad/s, T
# The two ends of a range differ by a step (-32768, +32767), of 14 bits at the coarsest,
LIMIT_TOLERANCE = 1.5e-4
_COARSE_TOLERANCE = 1e-3   # or of 11 bits where that step is seen.
# Of the limit: what misalignment, scale and bias of a calibration leave of a flat top's flatness,
BAND = 0.01
_SPREAD = 2.0 * BAND       # and what flat tops at other rates of the other axes differ by
_REPEATS_AT_LIMIT = 4      # equal largest values in a row that make a flat top
# A flat top is run into by a step of more than this share of its size. A smooth peak that repeats
# four times was reached by about one step of quantisation: 5e-4 of full scale for 12 bits.
_ENTRY_SHARE = 2e-3
# A parabola quantised in steps of q stays on its largest value for n samples only if it came there
# by about 4 q / n. An axis that moves by more than as many steps is no noise.
_STEPS = 4.0
_BAND_FLOOR = 1.5          # times the smallest range: a level that a band can prove
_RUN = 4                   # samples of the shortest run that counts: fewer have no shape
_INSIDE = 0.5              # of the step with which a run was reached: the largest inside it
_STEEP = 12.0              # (n - 1) e / b of a run that counts: twice that of a smooth peak

FLAT_TOPS = np.dtype([
    ("limit", "f8", 3),                  # given or found; inf: none
    ("tolerance", "f8", 3),              # share of it by which values at it may fall short
    ("seen", "?"),                       # whether there was a sample
    ("last", "f8", 3),                   # value of the sample before
    ("quantum", "f8", 3),                # smallest change seen
    ("largest", "f8", 3),                # of what lasted two samples
    ("repeats", "i8", 3),                # of the present value
    ("value_step", "f8", 3),             # with which the present value was reached
    ("count", "i8", 3),                  # samples of the present run
    ("low", "f8", 3),                    # of it
    ("high", "f8", 3),
    ("run_step", "f8", 3),               # with which it was reached
    ("inner_step", "f8", 3),             # largest step inside it: noise
    ("others", "f8", (3, 3)),            # all axes at its first sample
    ("moved", "f8", 3),                  # by how much another axis has moved since
    ("counted", "i8", 3),                # 1 if it is a flat top already
    ("level", "f8", 3),                  # of the last flat top; 0: none yet
], align=True)
"""What the search for the limits of three axes remembers."""


@njit
def start_flat_tops(found, ranges, tolerance):
    """Begin a search: limits that were given, (3,); those to be found (nan) are infinite.

    tolerance: share by which values at a limit that was given may fall short of it.
    """
    for i in range(3):
        given = not math.isnan(ranges[i])
        found.limit[i] = ranges[i] if given else math.inf
        found.tolerance[i] = tolerance if given else LIMIT_TOLERANCE
        found.quantum[i] = math.inf


@njit
def find_flat_tops(found, ranges, floor, rests_high, sample):
    """Learn each axis' limit, unless given; mark the axes at theirs.

    Args:
        found: FLAT_TOPS, what was learnt so far; changed.
        ranges: (3,), nan for an axis whose limit is to be found.
        floor: no sensor has a smaller range; what is within a band needs half as much again. The
            unit is the sample's.
        rests_high: whether a sensor at rest may show more than that (a gyroscope does not).
        sample: (3,), finite, as the sensor reports it, in order.

    Returns:
        int, bits of the axes at their limit, x first.
    """
    clipped = 0
    # A driver that repeats whole samples makes no flat tops.
    held = (sample[0] == found.last[0] and sample[1] == found.last[1]
            and sample[2] == found.last[2])
    known = found.seen or not rests_high    # the value of before: at rest a gyroscope's is zero
    for i in range(3):
        size = abs(sample[i])
        if math.isnan(ranges[i]) and not held and known:
            _look_at(found, i, sample, floor, rests_high)
        if size >= found.limit[i] * (1.0 - found.tolerance[i]):
            clipped |= 1 << i
    for i in range(3):
        found.last[i] = sample[i]
    found.seen = True
    return clipped


@njit
def _look_at(found, i, sample, floor, rests_high):
    """One value of axis i, whose limit is to be found."""
    value, last = sample[i], found.last[i]
    size, move = abs(value), abs(value - last)
    if move > 0.0:
        found.repeats[i] = 0
        found.value_step[i] = move
        if found.seen:
            found.quantum[i] = min(found.quantum[i], move)
    elif not rests_high or _another_moves(found, i, sample):
        found.repeats[i] += 1
        if (found.repeats[i] >= _REPEATS_AT_LIMIT - 1 and size > floor
                and size >= found.largest[i] * (1.0 - LIMIT_TOLERANCE)
                and found.value_step[i] > max(_ENTRY_SHARE * size, _STEPS * found.quantum[i])):
            # Values that are equal say more than values within a band.
            known = found.limit[i] if found.tolerance[i] < BAND else math.inf
            found.limit[i] = min(known, size)
            found.tolerance[i] = min(max(1.5 * found.quantum[i] / size, LIMIT_TOLERANCE),
                                     _COARSE_TOLERANCE)
    # Two samples in a row: a single wild one neither hides nor disproves a limit.
    lasting = min(size, abs(last))
    found.largest[i] = max(found.largest[i], lasting)
    if lasting > found.limit[i] * (1.0 + found.tolerance[i]):
        found.limit[i] = math.inf    # a value that lasted and was no limit
    if lasting > found.level[i] * (1.0 + _SPREAD):
        found.level[i] = 0.0
    high, low = max(found.high[i], size), min(found.low[i], size)
    # What still approaches its top, or leaves it, is no part of it.
    if (value * last > 0.0 and high - low <= BAND * high
            and move <= max(_INSIDE * found.run_step[i], found.quantum[i])):
        found.high[i], found.low[i] = high, low
        found.count[i] += 1
        found.inner_step[i] = max(found.inner_step[i], move)
        for j in range(3):
            other = abs(sample[j] - found.others[i, j])
            if j != i and other > _STEPS * found.quantum[j]:
                found.moved[i] = max(found.moved[i], other)
        _judge_run(found, i, found.run_step[i], floor)
    else:
        _judge_run(found, i, move, floor)
        found.count[i], found.counted[i] = 1, 0
        found.high[i] = found.low[i] = size
        found.run_step[i] = move
        found.inner_step[i] = found.moved[i] = 0.0
        for j in range(3):
            found.others[i, j] = sample[j]


@njit
def _another_moves(found, i, sample):
    """Whether an axis other than i moves by more than noise."""
    for j in range(3):
        if j != i and abs(sample[j] - found.last[j]) > _STEPS * found.quantum[j]:
            return True
    return False


@njit
def _judge_run(found, i, edge, floor):
    """Whether the present run of axis i, with a step ``edge`` at an end, is a flat top; the second
    at one level proves the limit."""
    level = 0.5 * (found.low[i] + found.high[i])
    steep = edge - max(found.inner_step[i], found.quantum[i])    # a step of rounding is none
    if (found.counted[i] or found.count[i] < _RUN or level < _BAND_FLOOR * floor
            or found.moved[i] < BAND * level
            or found.high[i] < found.largest[i] * (1.0 - _SPREAD)
            or (found.count[i] - 1) * steep < _STEEP * BAND * level):
        return
    found.counted[i] = 1
    if (found.limit[i] == math.inf and found.level[i] > 0.0
            and abs(level - found.level[i]) < BAND * level):
        found.limit[i] = 0.5 * (level + found.level[i])
        found.tolerance[i] = _SPREAD
    found.level[i] = level


@njit
def mark_flat_tops(found, ranges, floor, rests_high, samples):
    """:func:`find_flat_tops` of each row of samples (n, 3); ``found`` (1,) FLAT_TOPS, started.

    Returns:
        (n, 3) bool, the axes at their limit, as far as it was known by then.
    """
    marked = np.empty(samples.shape, dtype=np.bool_)
    for n in range(len(samples)):
        bits = find_flat_tops(found[0], ranges, floor, rests_high, samples[n])
        for i in range(3):
            marked[n, i] = (bits >> i) & 1
    return marked


@dataclass(frozen=True)
class FlatTop:
    """Samples of one axis that stand still at its extreme value ``limit``."""

    axis: int
    limit: float
    samples: int
    runs: int


@njit
def _search(found, floor, rests_high, samples):
    ranges = np.full(3, np.nan)
    start_flat_tops(found[0], ranges, LIMIT_TOLERANCE)
    mark_flat_tops(found, ranges, floor, rests_high, samples)


def flat_tops(values: np.ndarray, floor: float) -> list[FlatTop]:
    """Where the axes of a sensor stand at its limit, as the estimators find it.

    Args:
        values: (n, 3), in the unit of ``floor``: ACC_FLOOR, GYRO_FLOOR or MAG_FLOOR.

    Returns:
        list of FlatTop, negative ``limit`` for the lower end.
    """
    values = np.asarray(values, dtype=np.float64)
    values = np.ascontiguousarray(values[np.isfinite(values).all(axis=1)])
    if not _may_have(values, floor):
        return []
    found = np.zeros(1, FLAT_TOPS)
    _search(found, floor, floor != GYRO_FLOOR, values)
    result = []
    for axis in range(3):
        limit, tolerance = found["limit"][0, axis], found["tolerance"][0, axis]
        for sign in (1.0, -1.0):
            lengths = _runs(sign * values[:, axis] >= limit * (1.0 - tolerance))
            if len(lengths):
                result.append(FlatTop(axis, float(sign * limit), int(lengths.sum()), len(lengths)))
    return result


def _may_have(values, floor):
    """Whether an axis is so long so near to its largest values that it may have a flat top: most
    recordings have none, and nothing needs to be compiled."""
    size = np.abs(values)
    lasting = np.minimum(size[1:], size[:-1]).max(axis=0, initial=0.0)
    near = (size > floor) & (size >= lasting * (1.0 - 2.0 * _SPREAD))
    return any(_runs(column).max(initial=0) >= _RUN for column in near.T)


def _runs(mask):
    """Lengths of the runs of True in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges[1::2] - edges[::2]
