"""What a smoothed motion says of the descent: its phases, velocities at them, ballistic flights."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.estimation.avalanche.dead_reckoning import BallSamples, central_force
from imu_fusion.estimation.avalanche.phases import (
    Flight,
    PhaseParams,
    Transition,
    find_phases,
    flights,
)
from imu_fusion.samples.logs import ImuLog, seconds
from imu_fusion.samples.motion_span import MotionSpan, find_motion


@dataclass(frozen=True)
class Descent:
    """``motion``: rows of the log; ``entrained``: stamp (ns) from which ``time`` (n,) s counts,
    of the n samples of the motion; ``force`` (n, 3): specific force of the ball's centre, m/s^2, in
    its axes. ``transitions`` and ``flights`` by :mod:`.phases`."""

    motion: MotionSpan
    entrained: int
    time: np.ndarray
    force: np.ndarray
    transitions: tuple[Transition, ...]
    flights: tuple[Flight, ...]

    @property
    def rows(self) -> slice:
        """Those of the motion."""
        return slice(self.motion.start, self.motion.stop)


def read_descent(imu: ImuLog, quat: np.ndarray, lever_arm: np.ndarray, gravity: float,
                 params: PhaseParams = PhaseParams()) -> Descent:
    """The descent of a whole recording.

    Args:
        imu: n calibrated samples with recovered rates, from rest to rest. quat: (n, 4) world from
            ball. lever_arm: (3,) m, of the accelerometers from the ball's centre. gravity: m/s^2.

    Raises:
        EstimationError: no rest, or nothing but rest.
    """
    motion = find_motion(imu)
    rows = slice(motion.start, motion.stop)
    entrained = int(imu.stamp[motion.start])
    time = seconds(imu.stamp[rows], entrained)
    force = central_force(BallSamples(time, quat[rows], imu.acc[rows], imu.gyr[rows], lever_arm))
    stop = float(seconds(imu.stamp[[min(motion.stop, len(imu) - 1)]], entrained)[0])
    return Descent(motion, entrained, time, force,
                   tuple(find_phases(time, force, imu.gyr[rows], stop, gravity, params)),
                   tuple(flights(time, force, gravity, params)))
