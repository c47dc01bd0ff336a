"""Calibration of an array of accelerometers on one board from still poses.

Each accelerometer gets a symmetric scale-and-misalignment matrix and a bias from the fact that
a still accelerometer feels exactly gravity; then all are turned into the axes of the first one,
since all feel the same vector. What static poses cannot tell, positions and gyroscopes, stays
as given.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used
from numpy.typing import ArrayLike

from imu_fusion.errors import CalibrationError

# Nine unknowns per sensor, of which each pose determines one combination.
_FEWEST_POSES = 12


@dataclass(frozen=True, eq=False)
class ArrayCalibration:
    """``body = matrix @ (reading - bias)`` per sensor: matrix (N, 3, 3), bias (N, 3) m/s^2.

    ``residual`` (N,) rms deviation of the still norm from gravity, ``disagreement`` (N,) rms
    deviation from the first sensor, m/s^2.
    """

    matrix: np.ndarray
    bias: np.ndarray
    residual: np.ndarray
    disagreement: np.ndarray

    def apply(self, readings: np.ndarray) -> np.ndarray:
        """Readings (n, N, 3) in the sensors' axes to the axes of the first sensor."""
        return np.einsum("kij,nkj->nki", self.matrix, readings - self.bias)


def calibrate_array(poses: ArrayLike, gravity: float = 9.80665) -> ArrayCalibration:
    """Calibrate from the mean readings of still poses.

    Args:
        poses: (p, N, 3) m/s^2, each a mean over a still period, in the sensors' own axes.
        gravity: m/s^2.

    Returns:
        ArrayCalibration.

    Raises:
        CalibrationError: too few poses, or poses that leave a parameter undetermined.
    """
    poses = np.asarray(poses, dtype=float)
    if len(poses) < _FEWEST_POSES:
        raise CalibrationError(f"accelerometer array: {len(poses)} still poses, need at least "
                               f"{_FEWEST_POSES} in different directions")
    matrices, biases, residuals, disagreements, first = [], [], [], [], None
    for k in range(poses.shape[1]):
        matrix, bias, residual = _calibrate_one(poses[:, k], gravity, k)
        felt = (poses[:, k] - bias) @ matrix.T
        if first is None:
            first = felt
        turn, _ = scipy.linalg.orthogonal_procrustes(felt, first)
        matrices.append(turn.T @ matrix)
        biases.append(bias)
        residuals.append(residual)
        disagreements.append(np.sqrt(np.mean((felt @ turn - first) ** 2)))
    return ArrayCalibration(np.array(matrices), np.array(biases), np.array(residuals),
                            np.array(disagreements))


def _calibrate_one(poses, gravity, number):
    upper = np.triu_indices(3)

    def matrix_of(p):
        matrix = np.zeros((3, 3))
        matrix[upper] = p[:6]
        return matrix + np.triu(matrix, 1).T

    def residual(p):
        return np.linalg.norm((poses - p[6:]) @ matrix_of(p).T, axis=1) - gravity

    # A pose that was not quite still must not bend the fit: linear loss beyond 0.3 % of gravity.
    found = scipy.optimize.least_squares(
        residual, np.r_[1, 0, 0, 1, 0, 1, 0, 0, 0], loss="soft_l1", f_scale=3e-3 * gravity)
    condition = np.linalg.cond(found.jac / np.linalg.norm(found.jac, axis=0))
    if condition > 1e3:
        raise CalibrationError(f"accelerometer {number}: the still poses do not determine scale "
                               f"and bias (condition number {condition:.2g}); turn the board to "
                               "all sides")
    return matrix_of(found.x), found.x[6:], float(np.sqrt(np.mean(found.fun ** 2)))
