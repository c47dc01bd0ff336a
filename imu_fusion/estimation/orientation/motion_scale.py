"""How much more the body moves than was said: a vehicle is not held by a hand."""

import math

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.kernels import njit

_HIGH_PASS_TIME = 5.0      # s: velocity changes faster than this show
_MOTION_TIME = 30.0        # s: over which the size of the motion is judged
_MOTION_SDS2 = 4.0         # squared standard deviations beyond which it is believed at once


@njit
def motion_scale(s, p):
    """Factor by which velocities exceed the stated ones, at least 1.

    A body that moves more than was said is believed. Judged by the axis that moves most, less
    what gravity adds at a wrong tilt. Large motion is believed at once, before it can turn the
    vertical; moderate motion if it lasts.
    """
    motion, block = s.motion, s.block
    time = block.time
    keep = math.exp(-time / _HIGH_PASS_TIME)
    ratio = 0.0
    for i in range(3):
        change = block.force[i] - (s.gravity * time if i == 2 else 0.0)
        motion.velocity[i] = keep * motion.velocity[i] + p.use_acc * change
        by_tilt = 0.0
        if i < 2:
            tilt = es.ATTITUDE + 1 - i
            by_tilt = s.cov[tilt, tilt] * (s.gravity * _HIGH_PASS_TIME) ** 2
        ratio = max(ratio, (motion.velocity[i] ** 2 - by_tilt) / p.fusion.velocity_sd ** 2)
    motion.ratio += min(time / _MOTION_TIME, 1.0) * (ratio - motion.ratio)
    return math.sqrt(max(motion.ratio, ratio / _MOTION_SDS2, 1.0))
