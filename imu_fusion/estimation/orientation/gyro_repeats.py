"""A gyroscope that is stuck: it repeats one value for far longer than ever while the force turns.

Three axes show the same bits for long where a body rests, where the sensor is coarse, or where it
is simulated without noise; but then they did so before, or the force is where the rates carry it.
Of a stuck one nothing is known of how the body turns: as in a gap (:mod:`.forgetting`), to its end.
"""

from imu_fusion.estimation.orientation import forgetting
from imu_fusion.geometry.rotation import quat_conjugate, quat_multiply, quat_rotate
from imu_fusion.kernels import njit

_FEWEST = 100       # samples of one value, after as many others,
_SHORTEST = 500_000_000    # ns of it: three axes at their limits repeat, too
_LONGER = 20        # times the longest run so far that was none
_OFF = 0.35         # of gravity, by which the mean force is elsewhere than the rates carry it


@njit
def is_stuck(s):
    """Whether the newest sample, which nothing has been compared with yet, is of a stuck one."""
    kept, gyr, last = s.gyro_repeats, s.step.gyr, s.gyro_limit.last
    if gyr[0] != last[0] or gyr[1] != last[1] or gyr[2] != last[2]:
        if kept.count > 0:
            if not kept.is_stuck:
                kept.longest = max(kept.longest, kept.count)
            kept.count = 0
            kept.is_stuck = False
        return False
    kept.count += 1
    if kept.count == 1:
        kept.since = s.stamp
        for i in range(3):
            kept.force[i] = s.rest.mean_force[i]
        for i in range(4):
            kept.quat[i] = s.history.quat[i]
    others = s.counts.imu_used - kept.count
    if (not kept.is_stuck and kept.count >= max(_FEWEST, _LONGER * kept.longest)
            and others >= _FEWEST and s.stamp - kept.since >= _SHORTEST and _contradicts(s, kept)):
        kept.is_stuck = True
        kept.begun = s.stamp
    return kept.is_stuck


@njit
def allow_for(s, p):
    """Put no turn in the place of a stuck sample, and forget how the body turns."""
    kept = s.gyro_repeats
    lasted = (s.stamp - kept.since) * 1e-9
    forgetting.allow_for_stuck(s, p, lasted, kept.begun == s.stamp)
    kept.stuck = max(kept.stuck, s.stamp - kept.since)
    for i in range(3):
        s.step.gyr[i] = s.gyr_last[i] = s.gyro_bias[i]


@njit
def _contradicts(s, kept):
    """Whether the mean force is far from where the repeated rates carry that of before."""
    turn = quat_multiply(quat_conjugate(s.history.quat), kept.quat)
    carried = quat_rotate(turn, kept.force)
    off2 = size2 = 0.0
    for i in range(3):
        off2 += (s.rest.mean_force[i] - carried[i]) ** 2
        size2 += kept.force[i] ** 2
    return off2 > _OFF ** 2 * size2
