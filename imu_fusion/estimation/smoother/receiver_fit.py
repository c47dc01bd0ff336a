"""Whether fixes and velocities show an antenna that is elsewhere, a clock that runs otherwise, or
heights in another unit.

A smooth trajectory takes such errors along and leaves innovations that look white. How the cost
changes with a shift of the readings is what is left of them, times the shift: exactly, as the
trajectory is where the cost is least. How sure that is takes a pass of the filter (a score test:
Rao 1948), and is asked only where it may be more than chance.
"""

from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.measurements.registry import FIX, MOVED_FIX, VELOCITY
from imu_fusion.estimation.smoother.problem import Problem
from imu_fusion.estimation.smoother.state import ATT, GYR_BIAS, POS, VEL, slow_states

_PERHAPS = 1.0     # standard deviations, all that is left taken together: less is no question
_FEWEST = 20       # readings


class Shift(NamedTuple):
    """How large an error seems to be, and by how many standard deviations it is not zero."""

    size: float = 0.0
    sds: float = 0.0


def lever_errors(problem: Problem) -> list[Shift]:
    """Metres along x, y and z of the imu frame, by which the antenna is not where it is said to be.

    Args:
        problem: solved.
    """
    motion = _Motion(problem)
    return _shifts(problem, [motion.of_lever(axis) for axis in np.eye(3)])


def clock_error(problem: Problem) -> Shift:
    """By how much (1: twice as fast) the clock of the receiver runs faster than that of the Imu."""
    return _shifts(problem, [_Motion(problem).of_clock()])[0]


def height_error(problem: Problem) -> Shift:
    """By how much (1: twice as much) heights of the fixes change more than those of the body, which
    goes along with them."""
    return _shifts(problem, [_Motion(problem).of_heights()], perhaps=0.0)[0]


def delay_of_fixes(problem: Problem) -> Shift:
    """Seconds by which fixes are late; a smooth path takes nearly all of it along."""
    return _shifts(problem, [_Motion(problem).of_delay()], perhaps=0.0)[0]


class _Motion:
    """Of the body, at the readings (M,) of the receiver."""

    def __init__(self, problem: Problem):
        x, log = problem.x, problem.imu.log
        sample = np.repeat(np.arange(len(x)), np.diff(problem.reading_start))
        kind = problem.readings["kind"]
        self.place = np.isin(kind, (FIX, MOVED_FIX))[:, None]
        self.speed = (kind == VELOCITY)[:, None]
        self.since = (log.stamp[sample] - log.stamp.mean()) * 1e-9
        self.height = x[sample, POS + 2]
        self.velocity = x[sample, VEL:VEL + 3]
        time = (log.stamp - log.stamp[0]) * 1e-9
        self.acceleration = np.gradient(x[:, VEL:VEL + 3], time, axis=0)[sample]
        self.rate = (log.gyr - slow_states(x, GYR_BIAS, 3))[sample]
        self.attitude = scipy.spatial.transform.Rotation.from_quat(x[sample, ATT:ATT + 4])

    def of_lever(self, lever):
        """What readings (M, 3) change by, if the antenna is a lever (3,) m away."""
        return (self.place * self.attitude.apply(lever)
                + self.speed * self.attitude.apply(np.cross(self.rate, lever)))

    def of_heights(self):
        """What they change by, if heights count twice, from their mean on."""
        mean = self.height.sum() / max(len(self.height), 1)    # without readings there is none
        return self.place * (self.height - mean)[:, None] * [0.0, 0.0, 1.0]

    def of_delay(self):
        """What they change by, if fixes are a second late."""
        return -(self.place * self.velocity)

    def of_clock(self):
        """What they change by, if stamps are of a clock that runs twice as fast, and is right in
        the middle of the recording."""
        return -self.since[:, None] * (self.place * self.velocity
                                       + self.speed * self.acceleration)


def _shifts(problem, changes, perhaps=_PERHAPS):
    """Of errors of which one makes readings larger by each of changes (M, 3); zeros where what is
    left is less than perhaps."""
    # What is unlikely counts less, and by as much as it did.
    weight = problem.weights()[:, None]
    white = [weight * np.einsum("mij,mj->mi", problem.readings["whiten"], change)
             for change in changes]
    slopes = np.array([np.sum(weight * problem.fit["residual"] * each) for each in white])
    # Of readings that no trajectory follows: an upper bound of the curvature.
    most = np.array([[np.sum(one * other) for other in white] for one in white])
    told = np.count_nonzero(white[0].any(axis=1)) >= _FEWEST
    if not told or slopes @ np.linalg.lstsq(most, slopes)[0] < perhaps ** 2:
        return [Shift()] * len(changes)
    curvatures = [problem.curvature(change, slope) for change, slope in zip(changes, slopes)]
    return [Shift(slope / curvature, slope / np.sqrt(curvature)) if curvature > 0.0 else Shift()
            for slope, curvature in zip(slopes, curvatures)]
