"""The one form of calibrations: ``x = A x~ + b`` (Winkler 2025, appendix A), and how good it is."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.declare import Parameters, param

#: Matrix and bias that change nothing.
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
ZERO = (0.0, 0.0, 0.0)


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
class SensorCalibration(Parameters):
    """``calibration.*``: what is done to every sample, in one form for all sensors."""

    gyro_matrix: tuple[float, ...] = param(
        IDENTITY, length=9, doc="A of the gyroscope, row by row: its rates become A x + b.")
    gyro_bias: tuple[float, ...] = param(ZERO, unit="rad/s", length=3, doc="b of the gyroscope.")
    acc_matrix: tuple[float, ...] = param(
        IDENTITY, length=9, doc="A of the accelerometer, row by row: its forces become A x + b.")
    acc_bias: tuple[float, ...] = param(ZERO, unit="m/s^2", length=3,
                                        doc="b of the accelerometer.")
    mag_matrix: tuple[float, ...] = param(
        IDENTITY, length=9, doc="A of the magnetometer, row by row: its field becomes A x + b. "
        "In place of sensor.mag_matrix and sensor.mag_offset, which are the older form A (x - o).")
    mag_bias: tuple[float, ...] = param(ZERO, unit="T", length=3, doc="b of the magnetometer.")

    @property
    def keeps_imu(self) -> bool:
        """Whether it changes nothing of an Imu's samples."""
        return (self.gyro_matrix == self.acc_matrix == IDENTITY
                and self.gyro_bias == self.acc_bias == ZERO)

    def apply(self, values: np.ndarray) -> np.ndarray:
        """Rates and forces (n, 6), calibrated; a force of zero is one that is absent, and stays."""
        gyr, acc = values[:, :3], values[:, 3:]
        # By rows, so that the last bit does not depend on how samples were cut into blocks.
        calibrated = np.hstack([
            np.einsum("ij,nj->ni", np.reshape(self.gyro_matrix, (3, 3)), gyr) + self.gyro_bias,
            np.einsum("ij,nj->ni", np.reshape(self.acc_matrix, (3, 3)), acc) + self.acc_bias])
        calibrated[~acc.any(axis=1), 3:] = 0.0
        return calibrated

    def of_magnetometer(self, sensor: Any) -> dict[str, tuple[float, ...]]:
        """``sensor.mag_matrix`` and ``sensor.mag_offset`` that say the same, empty where nothing is
        said: estimators find the end of the magnetometer's range in what it reports.

        Args:
            sensor: the parameters of these names, which then are to be as they were.

        Raises:
            ParameterError: both were given, or a matrix that has no inverse.
        """
        if self.mag_matrix == IDENTITY and self.mag_bias == ZERO:
            return {}
        if tuple(sensor.mag_matrix) != IDENTITY or any(sensor.mag_offset):
            raise ParameterError(
                "parameters 'calibration.mag_matrix', 'calibration.mag_bias' and "
                "'sensor.mag_matrix', 'sensor.mag_offset' are two calibrations of one "
                "magnetometer: give one of them")
        try:
            offset = -np.linalg.solve(np.reshape(self.mag_matrix, (3, 3)), self.mag_bias)
        except np.linalg.LinAlgError:
            raise ParameterError(f"parameter 'calibration.mag_matrix': {list(self.mag_matrix)} has "
                                 "no inverse") from None
        return {"sensor.mag_matrix": self.mag_matrix,
                "sensor.mag_offset": tuple(float(v) for v in offset)}


def covariance(jacobian: np.ndarray, residual: np.ndarray, least: float) -> np.ndarray:
    """Covariance (k, k) of least squares with rows (m, k): by the scatter of the residuals (m,),
    but at least that of a row's standard deviation ``least``."""
    m, k = jacobian.shape
    scatter = float(np.sum(residual ** 2)) / max(m - k, 1)
    return np.linalg.inv(jacobian.T @ jacobian) * max(scatter, least ** 2)


def condition_of(jacobian: np.ndarray) -> float:
    """Condition number of rows (m, k) whose columns are scaled to length one."""
    return float(np.linalg.cond(jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)))
