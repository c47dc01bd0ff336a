"""Imu samples that cannot be used: broken ones, and those that are not newer than the last."""

import numpy as np

from imu_fusion.kernels import njit

# What no sensor of this world reports, whatever its unit: a broken message.
_WILD_RATE = 1e4        # rad/s
_WILD_FORCE = 1e6       # m/s^2


@njit
def is_within(v, bound):
    """Whether the three elements of v are finite and not larger than ``bound``."""
    return abs(v[0]) <= bound and abs(v[1]) <= bound and abs(v[2]) <= bound


@njit
def is_imu_sample(sample):
    """Whether (6,) rate rad/s and specific force m/s^2 are numbers that a sensor can report."""
    return is_within(sample[:3], _WILD_RATE) and is_within(sample[3:6], _WILD_FORCE)


@njit
def are_imu_samples(samples):
    """:func:`is_imu_sample` of each row of (n, 6)."""
    result = np.empty(len(samples), dtype=np.bool_)
    for i in range(len(samples)):
        result[i] = is_imu_sample(samples[i])
    return result


@njit
def is_refused(s, stamp, sample):
    """Whether an Imu sample is impossible or not newer than the last. Counts it."""
    if not is_imu_sample(sample) or (s.started and stamp <= s.stamp):
        s.counts.imu_rejected += 1
        return True
    s.counts.imu_used += 1
    return False
