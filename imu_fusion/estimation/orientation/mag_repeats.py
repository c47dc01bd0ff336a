"""Magnetometer samples that repeat the one before, though the body has turned: not measured anew.

A driver that asks a slow sensor too often repeats what it got, and one that has lost its sensor
does so for ever. Three axes do not show the same bits again while what they measure turns; at rest
those of a coarse sensor do, and are measured.
"""

import numpy as np

from imu_fusion.geometry.rotation import quat_conjugate, quat_multiply, quat_rotate
from imu_fusion.kernels import njit

_HIDDEN = 1.0              # standard deviations of noise that hide a turn

REPEATS = np.dtype([
    ("value", "f8", 3),                  # of the sample before
    ("quat", "f8", 4),                   # attitude at its first, in axes that stand still
    ("since", "i8"),                     # ns, stamp of its first
    ("is_stale", "?"),                   # the body has turned since then
    ("longest", "i8"),                   # ns, that a value was stale
], align=True)
"""What the search for stale samples remembers; zeros at its beginning."""


@njit
def is_stale(kept, stamp, value, quat, noise_sd):
    """Whether a sample is an old one: bit-equal to those before, though since the first of them the
    body has turned by more than noise hides.

    Args:
        kept: a REPEATS, in place.
        stamp: int64 ns.
        value: (3,) T, imu axes.
        quat: (4,) attitude of the imu in axes that stand still.
        noise_sd: T, per axis.
    """
    if (value[0] != kept.value[0] or value[1] != kept.value[1] or value[2] != kept.value[2]):
        for i in range(3):
            kept.value[i] = value[i]
        for i in range(4):
            kept.quat[i] = quat[i]
        kept.since = stamp
        kept.is_stale = False
        return False
    if not kept.is_stale:
        then = quat_multiply(quat_conjugate(quat), kept.quat)
        turned = quat_rotate(then, value)
        moved2 = ((turned[0] - value[0]) ** 2 + (turned[1] - value[1]) ** 2
                  + (turned[2] - value[2]) ** 2)
        kept.is_stale = moved2 > (_HIDDEN * noise_sd) ** 2
    if kept.is_stale:
        kept.longest = max(kept.longest, stamp - kept.since)
    return kept.is_stale
