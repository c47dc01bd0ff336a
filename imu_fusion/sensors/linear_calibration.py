"""The one form of calibrations: ``x = A x~ + b`` (Winkler 2025, appendix A), and how good it is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.parameters.declare import Parameters, param

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class LinearCalibration:
    """``x = matrix @ x~ + bias`` of readings x~.

    matrix (3, 3); bias (3,) in the sensor's unit; cov (12, 12) of the matrix row by row and the
    bias; residual (p,): what each pose or turn leaves, in ``unit``; method: in words; coverage:
    share of the directions that were seen; condition: of the scaled Jacobian.
    """

    matrix: np.ndarray
    bias: np.ndarray
    cov: np.ndarray
    residual: np.ndarray
    unit: str
    method: str
    coverage: float
    condition: float

    @property
    def sd(self) -> np.ndarray:
        """(12,) standard deviations of the matrix row by row and the bias."""
        return np.sqrt(np.maximum(self.cov.diagonal(), 0.0))

    @property
    def rms(self) -> float:
        """Of the residuals, in ``unit``."""
        return float(np.sqrt(np.mean(self.residual ** 2)))

    def apply(self, values: ArrayLike) -> np.ndarray:
        """Calibrated readings (..., 3)."""
        return np.asarray(values) @ self.matrix.T + self.bias


@dataclass(frozen=True)
class ImuCalibration(Parameters):
    """``calibration.*``: what is done to every Imu sample before anybody sees it."""

    gyro_matrix: tuple[float, ...] = param(
        _IDENTITY, length=9, doc="A of the gyroscope, row by row: its rates become A x + b.")
    gyro_bias: tuple[float, ...] = param(_ZERO, unit="rad/s", length=3, doc="b of the gyroscope.")
    acc_matrix: tuple[float, ...] = param(
        _IDENTITY, length=9, doc="A of the accelerometer, row by row: its forces become A x + b.")
    acc_bias: tuple[float, ...] = param(_ZERO, unit="m/s^2", length=3,
                                        doc="b of the accelerometer.")

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        return self == ImuCalibration()

    def apply(self, values: np.ndarray) -> np.ndarray:
        """Rates and forces (n, 6), calibrated; a force of zero is one that is absent, and stays."""
        gyr, acc = values[:, :3], values[:, 3:]
        # By rows, so that the last bit does not depend on how samples were cut into blocks.
        calibrated = np.hstack([
            np.einsum("ij,nj->ni", np.reshape(self.gyro_matrix, (3, 3)), gyr) + self.gyro_bias,
            np.einsum("ij,nj->ni", np.reshape(self.acc_matrix, (3, 3)), acc) + self.acc_bias])
        calibrated[~acc.any(axis=1), 3:] = 0.0
        return calibrated


def covariance(jacobian: np.ndarray, residual: np.ndarray, least: float) -> np.ndarray:
    """Covariance (k, k) of least squares with rows (m, k): by the scatter of the residuals (m,),
    but at least that of a row's standard deviation ``least``."""
    m, k = jacobian.shape
    scatter = float(np.sum(residual ** 2)) / max(m - k, 1)
    return np.linalg.inv(jacobian.T @ jacobian) * max(scatter, least ** 2)


def condition_of(jacobian: np.ndarray) -> float:
    """Condition number of rows (m, k) whose columns are scaled to length one."""
    return float(np.linalg.cond(jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)))
