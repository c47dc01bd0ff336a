"""Calibration of accelerometers from still poses: Winkler 2025, appendix A.2.

A still accelerometer feels gravity and nothing else. Six poses with each axis up and down, as
the paper has them, say its direction, too; any others, a dozen or more, its size: then the matrix
is symmetric, as a turn of all axes shows in no pose. In an array all feel one vector, by which
their axes are turned into those of the first one; positions stay as given.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used
from numpy.typing import ArrayLike

from imu_fusion.errors import CalibrationError
from imu_fusion.sensors.linear_calibration import LinearCalibration, condition_of, covariance
from imu_fusion.sensors.magnetometer_calibration import coverage

_STANDARD_GRAVITY = 9.80665
_FEWEST_POSES = 12       # nine unknowns, of which each pose determines one combination
_UPPER = np.triu_indices(3)
_ALONG = np.cos(np.radians(20.0))    # of an axis and gravity, for one of the six poses
_CONTRADICTS = 0.02      # of gravity: a sensor that errs by more is not linear, or was not still
_WORST_CONDITION = 1e3
# A pose that was not quite still must not bend the fit: linear loss beyond this share of gravity.
_LOSS_SCALE = 3e-3


@dataclass(frozen=True, eq=False)
class ArrayCalibration:
    """``parts``: a LinearCalibration per sensor, into the axes of the first one; ``disagreement``
    (N,): RMS deviation from the first sensor, m/s^2."""

    parts: tuple[LinearCalibration, ...]
    disagreement: np.ndarray

    def apply(self, readings: np.ndarray) -> np.ndarray:
        """Readings (n, N, 3) in the sensors' axes to the axes of the first sensor."""
        return np.stack([part.apply(readings[:, k]) for k, part in enumerate(self.parts)], axis=1)


def calibrate_accelerometer(poses: ArrayLike, gravity: float = _STANDARD_GRAVITY,
                            noise: float = 1e-3, name: str = "accelerometer"
                            ) -> LinearCalibration:
    """Calibrate from the mean readings of still poses.

    Args:
        poses: (p, 3) m/s^2, each a mean over a rest. gravity: m/s^2, of the place.
        noise: m/s^2, standard deviation of such a mean. name: for messages.

    Raises:
        CalibrationError: too few poses, or poses that leave a parameter undetermined, or that no
            linear sensor can have measured.
    """
    poses = np.asarray(poses, dtype=float)
    if len(poses) >= _FEWEST_POSES:
        found = _by_norm(poses, gravity, noise, name)
    elif _sides(poses, gravity) == 6:
        found = _by_direction(poses, gravity, noise)
    else:
        raise CalibrationError(
            f"{name}: {len(poses)} still poses, {_sides(poses, gravity)} of the six sides up: "
            f"needed are all six, or at least {_FEWEST_POSES} poses in different directions")
    if found.rms > _CONTRADICTS * gravity:
        raise CalibrationError(
            f"{name}: the still poses contradict each other by {found.rms:.2f} m/s^2 (RMS) after "
            "the calibration: it was moved while it seemed still, or its readings are not in "
            "m/s^2, or clipped")
    return found


def calibrate_array(poses: ArrayLike, gravity: float = _STANDARD_GRAVITY) -> ArrayCalibration:
    """Calibrate accelerometers of one board, which feel the same vector.

    Args:
        poses: (p, N, 3) m/s^2, each a mean over a still period, in the sensors' own axes.
        gravity: m/s^2.

    Raises:
        CalibrationError: as :func:`calibrate_accelerometer`.
    """
    poses = np.asarray(poses, dtype=float)
    if len(poses) < _FEWEST_POSES:
        raise CalibrationError(f"accelerometer array: {len(poses)} still poses, need at least "
                               f"{_FEWEST_POSES} in different directions")
    parts, disagreements, first = [], [], None
    for k in range(poses.shape[1]):
        found = calibrate_accelerometer(poses[:, k], gravity, name=f"accelerometer {k}")
        felt = found.apply(poses[:, k])
        first = felt if first is None else first
        turn, _ = scipy.linalg.orthogonal_procrustes(felt, first)
        spread = scipy.linalg.block_diag(np.kron(turn.T, np.eye(3)), turn.T)
        parts.append(LinearCalibration(
            turn.T @ found.matrix, turn.T @ found.bias, spread @ found.cov @ spread.T,
            found.residual, found.unit, found.method, found.coverage, found.condition))
        disagreements.append(np.sqrt(np.mean((felt @ turn - first) ** 2)))
    return ArrayCalibration(tuple(parts), np.array(disagreements))


def _nearest_side(poses, gravity):
    """(p, 3) unit vectors along the axis that is nearest to vertical, zero where none is near."""
    units = poses / np.maximum(np.linalg.norm(poses, axis=1, keepdims=True), 0.1 * gravity)
    axis = np.argmax(np.abs(units), axis=1)
    rows = np.arange(len(poses))
    sides = np.zeros_like(poses)
    near = np.abs(units[rows, axis]) > _ALONG
    sides[rows[near], axis[near]] = np.sign(units[rows, axis])[near]
    return sides


def _sides(poses, gravity):
    """How many of the six sides were up."""
    sides = _nearest_side(poses, gravity)
    return len(np.unique(sides[sides.any(axis=1)], axis=0))


def _by_direction(poses, gravity, noise):
    """Twelve parameters from poses in which an axis is vertical: linear."""
    sides = _nearest_side(poses, gravity)
    poses, sides = poses[sides.any(axis=1)], sides[sides.any(axis=1)]
    one = np.column_stack([poses, np.ones(len(poses))])
    solved, *_ = np.linalg.lstsq(one, gravity * sides, rcond=None)
    error = one @ solved - gravity * sides
    jacobian = np.kron(np.eye(3), one)           # of each output axis: its row of A, then of b
    cov = covariance(jacobian, error.T.ravel(), noise)
    order = np.array([4 * i + j for i in range(3) for j in range(3)] + [3, 7, 11])
    return LinearCalibration(
        solved[:3].T, solved[3], cov[np.ix_(order, order)], np.linalg.norm(error, axis=1), "m/s^2",
        f"{len(poses)} poses with an axis vertical", coverage(sides), condition_of(one))


def _by_norm(poses, gravity, noise, name):
    """Nine parameters of a symmetric matrix and a bias from the size of gravity."""
    def matrix_of(p):
        matrix = np.zeros((3, 3))
        matrix[_UPPER] = p[:6]
        return matrix + np.triu(matrix, 1).T

    def residual(p):
        return np.linalg.norm(poses @ matrix_of(p).T + p[6:], axis=1) - gravity

    fit = scipy.optimize.least_squares(residual, np.r_[1, 0, 0, 1, 0, 1, 0, 0, 0],
                                       loss="soft_l1", f_scale=_LOSS_SCALE * gravity)
    condition = condition_of(fit.jac)
    if condition > _WORST_CONDITION:
        raise CalibrationError(f"{name}: the still poses do not determine scale and bias "
                               f"(condition number {condition:.2g}); turn it to all sides")
    spread = np.zeros((12, 9))                   # of the nine parameters in matrix and bias
    for i, (a, b) in enumerate(zip(*_UPPER)):
        spread[3 * a + b, i] = spread[3 * b + a, i] = 1.0
    spread[9:, 6:] = np.eye(3)
    cov = covariance(fit.jac, fit.fun, noise)
    matrix = matrix_of(fit.x)
    felt = poses @ matrix.T + fit.x[6:]
    return LinearCalibration(
        matrix, fit.x[6:], spread @ cov @ spread.T, fit.fun, "m/s^2",
        f"size of gravity in {len(poses)} poses, symmetric matrix",
        coverage(felt / np.linalg.norm(felt, axis=1, keepdims=True)), condition)
