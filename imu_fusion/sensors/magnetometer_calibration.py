"""In situ magnetometer calibration: an ellipsoid through the field's measurements.

Winkler 2025, appendix A, eq. (A.1), after Renaudin, Afzal and Lachapelle (2010): while
a sensor turns in a constant field, its calibrated samples lie on a sphere,
``|matrix (m - offset)| = norm``. An algebraic fit starts, a geometric one
(residuals in tesla, robust against disturbed samples) finishes and gives the covariance.

The field's norm does not follow from the samples: without a given one the matrix has
determinant 1. Neither does a rotation of the sensor's axes: the matrix is symmetric.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used
from numpy.typing import ArrayLike

from imu_fusion.errors import CalibrationError

_UPPER = np.triu_indices(3)
_CELLS = 4                 # cells per edge of the cube on which directions are counted
_MIN_SAMPLES = 20
# Above this the weakest combination of the nine parameters rests on noise alone.
_MAX_CONDITION = 1e4
_SPACING = 0.08            # of the field: nearer samples add nothing to a running set
_CAPACITY = 800            # samples kept by a running set: fills a sphere at that spacing


@dataclass(frozen=True)
class MagCalibration:
    """``calibrated = matrix @ (mag - offset)`` and how far to trust it.

    offset (3,) tesla; matrix (3, 3) symmetric; field_norm tesla; cov (9, 9) of offset
    (tesla) and of the matrix' upper triangle row by row; residual_sd: scatter of the
    calibrated norm, tesla, and recorded_sd of the norm as recorded (Winkler 2025, Fig. 9 has both);
    coverage: share of the directions that were seen;
    condition: of the scaled normal equations' Jacobian; samples: how many were used.
    """

    offset: np.ndarray
    matrix: np.ndarray
    field_norm: float
    cov: np.ndarray
    residual_sd: float
    recorded_sd: float
    coverage: float
    condition: float
    samples: int

    @property
    def bias(self) -> np.ndarray:
        """b (3,) tesla of the form that all calibrations share, ``matrix @ mag + b``."""
        return -self.matrix @ self.offset

    def apply(self, mag: ArrayLike) -> np.ndarray:
        """Calibrated field, (..., 3) tesla."""
        return (np.asarray(mag) - self.offset) @ self.matrix.T

    def to_parameters(self) -> dict[str, float | list[float]]:
        """``sensor.mag_offset``, ``sensor.mag_matrix`` and ``fusion.mag_offset_sd`` as
        OrientationParams and YAML take them.

        ``fusion.mag_matrix_sd`` is not among them: an ellipsoid does not show how the
        magnetometer's axes are turned against those of the Imu.
        """
        offset_sd = math.sqrt(np.trace(self.cov[:3, :3]) / 3.0) / self.field_norm
        return {"sensor.mag_offset": [float(v) for v in self.offset],
                "sensor.mag_matrix": [float(v) for v in self.matrix.ravel()],
                "fusion.mag_offset_sd": min(float(offset_sd), 1.0)}


def coverage(directions: ArrayLike) -> float:
    """Share of the cells of a cube around the origin that unit vectors (n, 3) hit."""
    d = np.asarray(directions)
    axis = np.argmax(np.abs(d), axis=1)
    rows = np.arange(len(d))
    face = 2 * axis + (d[rows, axis] < 0)
    # Equal angles per cell, not equal lengths on the face.
    u, v = (np.arctan(d[rows, (axis + shift) % 3] / np.abs(d[rows, axis])) / (math.pi / 2) + 0.5
            for shift in (1, 2))
    cell = np.minimum((np.array([u, v]) * _CELLS).astype(int), _CELLS - 1)
    return len(np.unique((face * _CELLS + cell[0]) * _CELLS + cell[1])) / (6 * _CELLS ** 2)


def _symmetric(values):
    matrix = np.empty((3, 3))
    matrix[_UPPER] = values
    matrix.T[_UPPER] = values
    return matrix


def _algebraic(m):
    """Offset and symmetric shape root of the ellipsoid through m (n, 3) of order 1.

    Raises CalibrationError where the quadric is no ellipsoid.
    """
    # The quadric's constant is put to one: an origin on the ellipsoid, where hard iron is as strong
    # as the field, would have none.
    middle = 0.5 * (m.min(axis=0) + m.max(axis=0))
    x, y, z = (m - middle).T
    design = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z,
                              2 * x, 2 * y, 2 * z])
    p, *_ = np.linalg.lstsq(design, np.ones(len(m)), rcond=None)
    quadric = np.array([[p[0], p[3], p[4]], [p[3], p[1], p[5]], [p[4], p[5], p[2]]])
    if np.linalg.matrix_rank(quadric) == 3:
        centre = -np.linalg.solve(quadric, p[6:])
        shape = quadric / (1.0 + centre @ quadric @ centre)
        values, vectors = np.linalg.eigh(shape)
        if values.min() > 0:
            return centre + middle, (vectors * np.sqrt(values)) @ vectors.T
    raise CalibrationError(
        "magnetometer calibration: the samples fit no ellipsoid; turn the sensor through more "
        "directions, away from iron, and check that the samples are in tesla")


def _fit(m, estimate, radius):
    """Geometric fit of offset and upper triangle (9,), begun at ``estimate``, to m (n, 3).

    A robust fit finds what is disturbed, a plain one of the rest gives the covariance. Returns the
    last scipy result, and the samples (k, 3) that it is of.
    """
    def residual(p, m):
        return np.linalg.norm((m - p[:3]) @ _symmetric(p[3:]), axis=1) - radius

    for loss in ("soft_l1", "soft_l1", "linear"):
        errors = residual(estimate, m)
        scatter = max(float(np.median(np.abs(errors))) / 0.6745, 1e-12)
        kept = m if loss == "soft_l1" else m[np.abs(errors) < 5.0 * scatter]
        fit = scipy.optimize.least_squares(
            residual, estimate, args=(kept,), loss=loss, f_scale=scatter, x_scale="jac",
            xtol=1e-12, ftol=1e-12)
        estimate = fit.x
    return fit, kept


def calibrate_magnetometer(mag: np.ndarray, field_norm: float | None = None) -> MagCalibration:
    """Fit an ellipsoid to magnetometer samples taken while the sensor turned.

    Args:
        mag: (n, 3) tesla; samples that are not finite are left out.
        field_norm: the local field's norm, tesla (field model); unset: the matrix has
            determinant 1.

    Returns:
        MagCalibration.

    Raises:
        CalibrationError: too few samples, or directions that do not determine it.
    """
    mag = np.asarray(mag, dtype=float).reshape(-1, 3)
    mag = mag[np.isfinite(mag).all(axis=1)]
    if len(mag) < _MIN_SAMPLES:
        raise CalibrationError(f"magnetometer calibration: {len(mag)} samples, "
                               f"needed are at least {_MIN_SAMPLES}")
    unit = float(np.median(np.linalg.norm(mag - np.median(mag, axis=0), axis=1)))
    if unit <= 0.0:
        raise CalibrationError("magnetometer calibration: all samples are equal")
    m = mag / unit
    centre, root = _algebraic(m)
    radius = np.linalg.det(root) ** (-1.0 / 3.0)     # geometric mean of the semi-axes

    fit, kept = _fit(m, np.concatenate([centre, (root * radius)[_UPPER]]), radius)
    estimate = fit.x
    jacobian = fit.jac
    scale = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / np.maximum(scale, 1e-300), compute_uv=False)
    condition = float(singular[0] / max(singular[-1], 1e-300))
    matrix = _symmetric(estimate[3:])
    seen = coverage(_directions(kept - estimate[:3], matrix))
    if condition > _MAX_CONDITION or np.linalg.eigvalsh(matrix).min() <= 0:
        raise CalibrationError(
            f"magnetometer calibration: the directions seen ({100 * seen:.0f} % of the sphere) "
            f"do not determine it (condition {condition:.0e}); turn the sensor about all axes")
    spread = math.sqrt(2.0 * fit.cost / max(len(kept) - 9, 1))
    cov = np.linalg.inv(jacobian.T @ jacobian) * spread ** 2

    # To tesla, and to the norm that is wanted.
    factor = (radius * unit if field_norm is None else field_norm) / (radius * unit)
    if field_norm is None:
        factor /= np.linalg.det(matrix) ** (1.0 / 3.0)
    units = np.concatenate([np.full(3, unit), np.full(6, factor)])
    return MagCalibration(
        offset=estimate[:3] * unit, matrix=matrix * factor, field_norm=radius * unit * factor,
        cov=cov * np.outer(units, units), residual_sd=spread * unit * factor,
        recorded_sd=float(np.linalg.norm(kept, axis=1).std()) * unit, coverage=seen,
        condition=condition, samples=len(kept))


def _directions(m, matrix):
    calibrated = m @ matrix
    return calibrated / np.linalg.norm(calibrated, axis=1, keepdims=True)


class MagCalibrator:
    """Running calibration: keeps a spread set of samples, fits on demand.

    A sensor that rests for an hour adds one sample, one that turns adds many: the set
    stays balanced and bounded.
    """

    def __init__(self, field_norm: float | None = None) -> None:
        self._field_norm = field_norm
        self._kept = np.empty((_CAPACITY, 3))
        self._count = 0
        self._norm = 0.0

    def add(self, mag: ArrayLike) -> bool:
        """Offer one sample (3,) tesla. Returns whether it was kept."""
        mag = np.asarray(mag, dtype=float)
        if not np.isfinite(mag).all() or self._count == _CAPACITY:
            return False
        kept = self._kept[:self._count]
        self._norm = max(self._norm, float(np.linalg.norm(mag)))
        if self._count and ((kept - mag) ** 2).sum(axis=1).min() < (_SPACING * self._norm) ** 2:
            return False
        self._kept[self._count] = mag
        self._count += 1
        return True

    def result(self, limit: ArrayLike = np.inf) -> MagCalibration:
        """MagCalibration of what was kept so far. Raises CalibrationError as the batch fit.

        limit: tesla, scalar or (3,): samples with an axis at or beyond it are left out.
        """
        kept = self._kept[:self._count]
        below = (np.abs(kept) < limit).all(axis=1)
        return calibrate_magnetometer(kept[below], self._field_norm)
