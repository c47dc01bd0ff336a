"""Velocity and position from forces and attitudes alone: Winkler 2025, eqs. (15)-(21)."""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used
from numpy.typing import ArrayLike

from imu_fusion.samples.free_fall import force_at


@dataclass(frozen=True)
class BallSamples:
    """What dead reckoning starts from, n samples from the entrainment on.

    ``time`` (n,) s; ``quat`` (n, 4) world from ball; ``force`` (n, 3) m/s^2 and ``rate`` (n, 3)
    rad/s in the ball's axes, the rates recovered where the gyroscope was at its limit;
    ``lever_arm`` (3,) m, of the accelerometers from the ball's centre, eq. (17).
    """

    time: np.ndarray
    quat: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    lever_arm: ArrayLike = (0.0, 0.0, 0.0)

    @property
    def rotations(self) -> np.ndarray:
        """R_n (n, 3, 3)."""
        return scipy.spatial.transform.Rotation.from_quat(self.quat).as_matrix()


@dataclass(frozen=True)
class Track:
    """Kinematic acceleration, velocity and position (n, 3) of the ball's centre in world axes,
    from rest at the origin."""

    acc: np.ndarray
    vel: np.ndarray
    position: np.ndarray


def integrate(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Integral from the first sample, eqs. (20), (21) and (43): trapezoidal; (n, ...)."""
    return scipy.integrate.cumulative_trapezoid(values, time, axis=0, initial=0.0)


def central_force(samples: BallSamples) -> np.ndarray:
    """Specific force (n, 3) of the centre, in the ball's axes: the bracket of eq. (18), with
    central differences of the rates, eq. (19), one-sided at the ends."""
    return force_at(-np.asarray(samples.lever_arm, dtype=float), samples.time, samples.force,
                    samples.rate)


def dead_reckon(samples: BallSamples, gravity: float) -> Track:
    """Eqs. (18), (20), (21).

    Args:
        samples: BallSamples.
        gravity: m/s^2; eq. (16) takes the norm of the force at rest, eq. (30) that of the place.
            A calibrated sensor makes them equal; which one is meant is the caller's to say.
    """
    acc = np.einsum("nij,nj->ni", samples.rotations, central_force(samples))
    acc[:, 2] -= gravity
    vel = integrate(samples.time, acc)
    return Track(acc, vel, integrate(samples.time, vel))
