"""The first state: attitude from gravity and the magnetic field, or from a search."""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.measurements.registry import FIX, MAG, REST, VELOCITY
from imu_fusion.estimation.smoother.problem import Problem
from imu_fusion.estimation.smoother.state import POS, VEL
from imu_fusion.samples.logs import MagLog

# ns at the beginning, whose mean force and field are taken: long enough against noise, short
# against motion.
_FIRST = 200_000_000
# First headings tried: quarter turns insure against a disturbed or mounted-over magnetometer;
# without one, steps of 30 deg lead into the right minimum.
_HEADINGS, _HEADINGS_BLIND = 4, 12
_KNOWN_SD = np.pi / 8    # rad: a first attitude known to less is not tried a quarter turn off


def attitude_from_vectors(acc: np.ndarray, mag: np.ndarray | None, field_world: np.ndarray
                          ) -> np.ndarray:
    """Attitude from one pair of directions; the force alone fixes the tilt and the field alone
    the heading, as the factored quaternion algorithm of Fang 2020 does (section 4.1).

    Args:
        acc: (3,) specific force, not zero.
        mag: (3,) field in the sensor's axes, or None: then the heading is arbitrary.
        field_world: (3,) east-north-up.

    Returns:
        Quaternion world_imu (4,).
    """
    up = acc / np.linalg.norm(acc)
    if mag is None:
        side = np.eye(3)[np.argmin(np.abs(up))]
        world_side = np.array([1.0, 0.0, 0.0])
    else:
        side = np.cross(mag, up)
        world_side = np.cross(field_world, [0.0, 0.0, 1.0])
        world_side = world_side / np.linalg.norm(world_side)
    side = side - up * (up @ side)
    side = side / np.linalg.norm(side)
    body = np.stack([side, np.cross(up, side), up])
    world = np.stack([world_side, np.cross([0.0, 0.0, 1.0], world_side), [0.0, 0.0, 1.0]])
    return scipy.spatial.transform.Rotation.from_matrix(world.T @ body).as_quat()


def headings(quat: np.ndarray, count: int) -> np.ndarray:
    """``count`` attitudes (count, 4): ``quat`` turned about the vertical in equal steps."""
    angles = 2.0 * np.pi * np.arange(count)[:, None] / count
    turns = scipy.spatial.transform.Rotation.from_rotvec(angles * [0.0, 0.0, 1.0])
    return (turns * scipy.spatial.transform.Rotation.from_quat(quat)).as_quat()


def first_attitudes(problem: Problem, mag: MagLog | None, initial_quat: np.ndarray | None,
                    start: np.ndarray | None = None) -> np.ndarray:
    """Set the first position and velocity of the problem's prior; attitudes (k, 4) to start from,
    the most plausible first.

    Args:
        problem: not yet solved.
        mag: the magnetometer's samples.
        initial_quat: (4,) a first guess; found from force and field when None.
        start: (3,) m, the first position where it is given; else that of the first fix.

    Raises:
        EstimationError: no start, and no fix within the Imu samples; a force that tells no
            attitude.
    """
    kind, value = problem.readings["kind"], problem.readings["value"]
    if start is None and not np.any(kind == FIX):
        raise EstimationError("no fix lies within the Imu recording: do the stamps belong "
                              "together?")
    problem.mean[POS:POS + 3] = value[kind == FIX][0] if start is None else start
    log = problem.imu.log
    at_rest = problem.readings["stamp"][kind == REST]
    if np.any(kind == VELOCITY) and not np.any(at_rest == log.stamp[0]):
        problem.mean[VEL:VEL + 3] = value[kind == VELOCITY][0]
    beginning = int(np.searchsorted(log.stamp, log.stamp[0] + _FIRST))
    candidates = _HEADINGS if problem.params.initial.attitude_sd > _KNOWN_SD else 1
    if initial_quat is None:
        reading = None
        if mag is not None and np.any(kind == MAG):
            last = log.stamp[min(beginning, len(log) - 1)]    # of a log as short as that, too
            early = mag.between(log.stamp[0], last + 1)
            finite = np.isfinite(early.mag).all(axis=1)
            reading = early.mag[finite].mean(axis=0) if finite.any() else None
        with np.errstate(over="ignore"):
            force = log.acc[:beginning].mean(axis=0)
            known = 0.0 < np.linalg.norm(force) < np.inf
        if not known:
            raise EstimationError(f"the accelerometer reads {force} m/s^2 at the beginning, which "
                                  "tells no attitude")
        initial_quat = attitude_from_vectors(force, reading, problem.around.magnetic_field)
        candidates = _HEADINGS_BLIND if reading is None else _HEADINGS
    return problem.rank(headings(initial_quat, candidates))
