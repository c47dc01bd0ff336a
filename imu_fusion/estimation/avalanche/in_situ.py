"""Accelerometer calibration from the avalanche itself: Winkler 2025, section 5, eqs. (28)-(55).

The ball stays near the terrain, so velocity or position along the terrain's normal is small. That
tells the errors of the accelerometer, which a ball that turns shows in ever other directions:
``a = (I + C) a~ + g b0 + g tau b1`` (28), linear in C, b0 and b1. The stacked systems (54) and (55)
are solved, with the signs of (28) throughout: (31) has the biases with the other one.

Rest says more: there the calibrated force is gravity's, (30). Its norm is a row; its direction is
that of the first attitude, which was found from the very force that is calibrated. So the attitudes
follow the parameters (``realign``), by Gauss-Newton, where the paper turns them once afterwards.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import CalibrationError
from imu_fusion.estimation.avalanche.dead_reckoning import BallSamples, dead_reckon, integrate

#: Error models of section 5.2.2 and their numbers of parameters.
MODELS = {1: 9, 2: 12, 3: 15}
LEVELS = ("position", "velocity")

_ITERATIONS = 20
_HALVINGS = 8
_TOLERANCE = 1e-9
_DIFFERENCE = 1e-6       # of a parameter, for the turn of the first attitude


@dataclass(frozen=True)
class InSituCalibration:
    """``a = matrix @ a~ + bias + tau * drift`` (28), tau from 0 to 1 over the samples.

    matrix (3, 3); bias, drift (3,) m/s^2; turn (4,) quaternion, of the first attitude, in world
    axes (none without ``realign``); condition: of the stacked system, and of the constraint alone;
    violation: RMS of what the constraint keeps small, m or m/s; objective: minimum of (52) or (53).
    """

    matrix: np.ndarray
    bias: np.ndarray
    drift: np.ndarray
    turn: np.ndarray
    condition: float
    condition_constraint: float
    violation: float
    objective: float

    def apply(self, samples: BallSamples) -> BallSamples:
        """The samples with calibrated forces and turned attitudes."""
        force = (samples.force @ self.matrix.T + self.bias
                 + _tau(samples.time)[:, None] * self.drift)
        rotation = scipy.spatial.transform.Rotation
        quat = (rotation.from_quat(self.turn) * rotation.from_quat(samples.quat)).as_quat()
        return replace(samples, force=force, quat=quat)

    @property
    def parameters(self) -> tuple[np.ndarray, np.ndarray]:
        """b (6,) without g's unit and c (9,), column by column, as (33) has them; g = 1 m/s^2."""
        return (np.concatenate([self.bias, self.drift]),
                (self.matrix - np.eye(3)).ravel(order="F"))


@dataclass(frozen=True)
class Constraint:
    """What the calibration is to keep small, and how.

    normal: (3,) k, the terrain's, upwards. gravity: m/s^2, of the place. level: ``position`` (45)
    or ``velocity`` (44). model: 1 without bias, 2 with it, 3 with its drift. rho: of Tikhonov's
    rows. rest_force: (3,) mean force at rest, for (30), or None.
    """

    normal: np.ndarray
    gravity: float
    level: str = "position"
    model: int = 2
    rho: float = 1.0
    rest_force: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.level not in LEVELS or self.model not in MODELS or not self.rho >= 0.0:
            raise CalibrationError(
                f"in situ calibration: level {self.level!r}, model {self.model!r}, rho "
                f"{self.rho!r}; known are {LEVELS}, {tuple(MODELS)} and a rho of at least 0")


def _tau(time):
    """Dimensionless time of eq. (29)."""
    return (time - time[0]) / (time[-1] - time[0])


def design(samples: BallSamples, gravity: float, model: int) -> np.ndarray:
    """(A'', B'') of eqs. (36)-(38), (n, 3, k): what each parameter adds to the acceleration.

    Columns: b0 (3) and b1 (3) where the model has them, then C column by column: that of C_ij is
    ``R[:, i] a~_j``.
    """
    turn, tau = samples.rotations, _tau(samples.time)
    columns = {1: [], 2: [gravity * turn],
               3: [gravity * turn, gravity * tau[:, None, None] * turn]}[model]
    columns += [turn * samples.force[:, j, None, None] for j in range(3)]
    return np.concatenate(columns, axis=2)


def calibrate_in_situ(samples: BallSamples, constraint: Constraint,
                      realign: np.ndarray | None = None) -> InSituCalibration:
    """Solve (54) or (55).

    Args:
        samples: BallSamples, from rest on.
        constraint: Constraint.
        realign: (3,) magnetic field at rest, in the ball's axes: the attitudes follow the
            calibrated force at rest (needs ``constraint.rest_force``), with the heading that the
            field shows; None: the attitudes stay, as the paper solves it.

    Raises:
        CalibrationError: too few samples, or none that tell the parameters.
    """
    count = MODELS[constraint.model]
    if len(samples.time) < 2 * count:
        raise CalibrationError(f"in situ calibration: {len(samples.time)} samples for {count} "
                               "parameters")
    if realign is not None and constraint.rest_force is None:
        raise CalibrationError("in situ calibration: to realign it needs the force at rest")
    p = np.zeros(count)
    rows, residual, plain = _system(samples, constraint, p, realign)
    for _ in range(_ITERATIONS if realign is not None else 1):
        step = np.linalg.lstsq(rows, -residual, rcond=None)[0]
        p, system = _descend(samples, constraint, p, step, realign, residual)
        if system is None:
            break
        if realign is not None:
            rows, residual, plain = system
        if np.abs(step).max() < _TOLERANCE:
            break
    return _result(samples, constraint, p, realign, rows, plain)


def _descend(samples, constraint, p, step, realign, residual):
    """Parameters after a step, and their system; the step is halved until the sum of squares falls.

    Turned attitudes make the system nonlinear: full steps can run away from a ball whose attitudes
    are wrong. Without ``realign`` it is linear, and a step is right. (p, None): no step helps.
    """
    before = np.sum(residual ** 2)
    for _ in range(_HALVINGS):
        system = _system(samples, constraint, p + step, realign)
        if realign is None or np.sum(system[1] ** 2) < before:
            return p + step, system
        step = 0.5 * step
    return p, None


def _unpack(p, model, gravity):
    """matrix, bias, drift of parameters in the order of :func:`design`."""
    slow = MODELS[model] - 9
    b = np.concatenate([p[:slow], np.zeros(6 - slow)]) * gravity
    return np.eye(3) + p[slow:].reshape(3, 3, order="F"), b[:3], b[3:]


def _turn(p, constraint, realign):
    """Rotation of the world by which the calibrated force at rest is vertical again, and the field
    at rest keeps its azimuth; identity without ``realign``."""
    rotation = scipy.spatial.transform.Rotation
    if realign is None:
        return rotation.identity()
    matrix, bias, _ = _unpack(p, constraint.model, constraint.gravity)
    before = _triad(constraint.rest_force, realign)
    return rotation.from_matrix(_triad(matrix @ constraint.rest_force + bias, realign) @ before.T)


def _triad(force, field):
    """Eqs. (12) and (14): rows east, north, up in the ball's axes, of magnetic north. The
    declination turns both triads alike, and cancels but for second order in the tilt."""
    up = force / np.linalg.norm(force)
    east = np.cross(field, up)
    east /= np.linalg.norm(east)
    return np.array([east, np.cross(up, east), up])


def _along_normal(samples, constraint, p, realign):
    """What the constraint keeps small, (N,) without the first sample, at parameters p."""
    matrix, bias, drift = _unpack(p, constraint.model, constraint.gravity)
    turn = _turn(p, constraint, realign)
    calibration = InSituCalibration(matrix, bias, drift, turn.as_quat(), 0.0, 0.0, 0.0, 0.0)
    track = dead_reckon(calibration.apply(samples), constraint.gravity)
    return (getattr(track, "position" if constraint.level == "position" else "vel")
            @ constraint.normal)[1:]


def _system(samples, constraint, p, realign):
    """Rows and residual of the stacked system, linearised at p; rows of the constraint alone."""
    g, k = constraint.gravity, len(p)
    rotation = _turn(p, constraint, realign)
    turned = replace(samples, quat=(rotation * scipy.spatial.transform.Rotation.from_quat(
        samples.quat)).as_quat())
    rows = integrate(samples.time, np.einsum(
        "i,nik->nk", constraint.normal, design(turned, g, constraint.model)))
    if constraint.level == "position":
        rows = integrate(samples.time, rows)
    rows = rows[1:]
    value = _along_normal(samples, constraint, p, realign)
    if realign is not None:
        # Beside what (34) has: the parameters turn all attitudes.
        rows = rows + _by_turning(samples, constraint, p, realign)
    weight = constraint.rho * g * _reach(samples, constraint)
    stacked, residual = [rows, weight * np.eye(k)], [value, weight * p]
    if constraint.rest_force is not None:
        row, error = _rest(constraint, p)
        # As much as all samples of the constraint at the end of the span.
        scale = np.sqrt(len(value)) * _reach(samples, constraint)
        stacked.append(scale * row[None])
        residual.append(scale * error)
    return np.concatenate(stacked), np.concatenate(residual), rows


def _reach(samples, constraint):
    """What an acceleration of 1 m/s^2 makes over the span: T in (54), T^2 / 2 in (55)."""
    span = samples.time[-1] - samples.time[0]
    return span if constraint.level == "velocity" else 0.5 * span ** 2


def _rest(constraint, p):
    """Norm of the force at rest, eq. (30): derivative (k,), and what it exceeds g by (1,) m/s^2."""
    g = constraint.gravity
    matrix, bias, _ = _unpack(p, constraint.model, g)
    still = matrix @ constraint.rest_force + bias
    unit = still / np.linalg.norm(still)
    slow = np.concatenate([g * unit, np.zeros(3)])[:len(p) - 9]
    return (np.concatenate([slow, np.outer(constraint.rest_force, unit).ravel()]),
            np.array([np.linalg.norm(still) - g]))


def _by_turning(samples, constraint, p, realign):
    """Derivative (N, k) of what the constraint keeps small by the turn of the attitudes that each
    parameter brings."""
    base = _turn(p, constraint, realign)
    matrix, bias, drift = _unpack(p, constraint.model, constraint.gravity)
    calibrated = InSituCalibration(matrix, bias, drift, base.as_quat(), 0.0, 0.0, 0.0,
                                   0.0).apply(samples)
    track = dead_reckon(calibrated, 0.0)   # gravity does not turn
    moved = (track.position if constraint.level == "position" else track.vel)[1:]
    columns = np.empty((len(moved), len(p)))
    for i in range(len(p)):
        ahead = p.copy()
        ahead[i] += _DIFFERENCE
        turn = (_turn(ahead, constraint, realign) * base.inv()).as_rotvec() / _DIFFERENCE
        columns[:, i] = np.cross(turn, moved) @ constraint.normal
    return columns


def _result(samples, constraint, p, realign, rows, plain):
    value = _along_normal(samples, constraint, p, realign)
    weight = constraint.rho * constraint.gravity * _reach(samples, constraint)
    matrix, bias, drift = _unpack(p, constraint.model, constraint.gravity)
    return InSituCalibration(
        matrix, bias, drift, _turn(p, constraint, realign).as_quat(), float(np.linalg.cond(rows)),
        float(np.linalg.cond(plain)), float(np.sqrt(np.mean(value ** 2))),
        float(value @ value + weight ** 2 * (p @ p)))


def sweep(samples: BallSamples, constraint: Constraint, rhos: Sequence[float],
          realign: np.ndarray | None = None) -> list[InSituCalibration]:
    """Calibrations over the regularisation parameter, Fig. 14.

    Both the objective and the violation grow with rho, for any data: the paper's smallest minimum
    at rho = 1 cannot be.
    """
    return [calibrate_in_situ(samples, replace(constraint, rho=rho), realign) for rho in rhos]


def relative_difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """delta b and delta c of section 5.2.1: ``(first - second) / (|first| + |second|)``."""
    return (first - second) / (np.linalg.norm(first) + np.linalg.norm(second))
