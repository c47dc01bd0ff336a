"""How far an estimated orientation is from a reference, and how far it said it would be.

The error is the rotation in the world frame that carries the reference into the
estimate, ``q_error = q_estimate * inv(q_reference)``. As in BROAD (Laidig et al.,
Data 6(7):72, 2021, section 3.5), it is split into a heading part about the vertical,
``2 atan|z / w|``, and an inclination part about a horizontal axis,
``2 acos sqrt(w^2 + z^2)``; the total is ``2 acos|w|``. All three are written here with
atan2, which keeps its digits near zero.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import PoseLog

# Share of a Gaussian within 1, 2 and 3 standard deviations.
GAUSSIAN_SHARES = (0.682689, 0.954500, 0.997300)


@dataclass(frozen=True, eq=False)
class OrientationErrors:
    """Errors of n estimates, NaN where there is no reference.

    ``rotation_world`` (n, 3) rad is the rotation vector of the error (east, north: tilt;
    up: heading) and ``sd_world`` (n, 3) rad the standard deviations that the estimator
    stated for it (NaN: unknown). ``total``, ``heading``, ``inclination`` (n,) rad are
    BROAD's angles, never negative. ``nees`` (n,) is the normalised squared error, of mean
    3 for an honest covariance.
    """

    stamp: np.ndarray
    rotation_world: np.ndarray
    sd_world: np.ndarray
    total: np.ndarray
    heading: np.ndarray
    inclination: np.ndarray
    nees: np.ndarray

    def __len__(self) -> int:
        return len(self.stamp)


@dataclass(frozen=True)
class ErrorStatistics:
    """Summary of one error angle; angles in degrees, ``count`` samples."""

    name: str
    count: int
    rmse_deg: float
    median_deg: float
    p95_deg: float
    maximum_deg: float


def quaternions_at(stamp: np.ndarray, reference_stamp: np.ndarray, reference_quat: np.ndarray,
                   max_gap: int | None = None) -> np.ndarray:
    """Reference orientations at other stamps, along the shortest rotation between neighbours.

    Args:
        stamp: (n,) int64 ns where the reference is wanted.
        reference_stamp: (m,) int64 ns, increasing.
        reference_quat: (m, 4) xyzw; rows with NaN count as absent.
        max_gap: longest interval in ns that is bridged; default 1.5 median intervals.
            A stamp that the reference has itself needs no bridge.

    Returns:
        (n, 4) unit quaternions xyzw, NaN where there is no reference.
    """
    stamp = np.asarray(stamp, dtype=np.int64)
    result = np.full((len(stamp), 4), np.nan)
    present = np.isfinite(reference_quat).all(axis=1)
    ref_stamp = np.asarray(reference_stamp, dtype=np.int64)[present]
    ref_quat = np.asarray(reference_quat, dtype=np.float64)[present]
    if len(ref_stamp) == 0:
        return result
    if np.any(np.diff(ref_stamp) <= 0):
        raise SampleError("the stamps of the reference do not increase: sort them and drop "
                          "repeated ones")
    if max_gap is None:
        max_gap = int(1.5 * np.median(np.diff(ref_stamp))) if len(ref_stamp) > 1 else 0
    left = np.searchsorted(ref_stamp, stamp, side="right") - 1
    inside = left >= 0
    left = np.clip(left, 0, len(ref_stamp) - 1)
    right = np.minimum(left + 1, len(ref_stamp) - 1)
    exact = inside & (ref_stamp[left] == stamp)
    interval = ref_stamp[right] - ref_stamp[left]
    between = inside & ~exact & (right > left) & (interval <= max_gap)
    result[exact] = ref_quat[left[exact]]
    if between.any():
        before, after = left[between], right[between]
        fraction = (stamp[between] - ref_stamp[before]) / interval[between]
        start = Rotation.from_quat(ref_quat[before])
        turn = (start.inv() * Rotation.from_quat(ref_quat[after])).as_rotvec()
        result[between] = (start * Rotation.from_rotvec(fraction[:, None] * turn)).as_quat()
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def moving_at(stamp: np.ndarray, change_stamp: np.ndarray, moving: np.ndarray,
              before: bool = False) -> np.ndarray:
    """A movement mask from its changes: each value holds until the next one.

    Args:
        stamp: (n,) int64 ns where the mask is wanted.
        change_stamp: (m,) int64 ns of the changes, increasing.
        moving: (m,) bool, the value from each change on.
        before: value ahead of the first change.

    Returns:
        (n,) bool.
    """
    held = np.concatenate([[before], np.asarray(moving, dtype=bool)])
    return held[np.searchsorted(np.asarray(change_stamp, np.int64), np.asarray(stamp, np.int64),
                                side="right")]


def orientation_errors(stamp: np.ndarray, quat_world_imu: np.ndarray, reference: PoseLog,
                       cov_attitude: np.ndarray | None = None,
                       max_gap: int | None = None) -> OrientationErrors:
    """Errors of estimated orientations against a reference.

    Args:
        stamp: (n,) int64 ns of the estimates.
        quat_world_imu: (n, 4) estimates, xyzw.
        reference: PoseLog (or anything with ``stamp`` and ``quat_world_imu``).
        cov_attitude: (n, 3, 3) rad^2 of the local error (``q_true = q_est *
            Exp(dtheta_imu)``); None or not positive definite: unknown.
        max_gap: see :func:`quaternions_at`.

    Returns:
        OrientationErrors.

    Raises:
        SampleError: shapes do not fit, or reference stamps that do not increase.
    """
    stamp = np.asarray(stamp, dtype=np.int64)
    quat = np.asarray(quat_world_imu, dtype=np.float64)
    if quat.shape != (len(stamp), 4):
        raise SampleError(f"estimated quaternions have shape {quat.shape}, "
                          f"expected {(len(stamp), 4)}")
    truth = quaternions_at(stamp, reference.stamp, reference.quat_world_imu, max_gap)
    n = len(stamp)
    known = np.isfinite(truth).all(axis=1) & np.isfinite(quat).all(axis=1)
    rotation_world = np.full((n, 3), np.nan)
    angles = np.full((n, 3), np.nan)
    sd_world = np.full((n, 3), np.nan)
    nees = np.full(n, np.nan)
    if known.any():
        estimate = Rotation.from_quat(quat[known])
        error = estimate * Rotation.from_quat(truth[known]).inv()
        rotation_world[known] = error.as_rotvec()
        angles[known] = np.column_stack(split_angles(error.as_quat()))
        if cov_attitude is not None:
            cov_world = attitude_cov_world(quat[known], np.asarray(cov_attitude)[known])
            usable = np.isfinite(cov_world).all(axis=(1, 2))
            rows = np.flatnonzero(known)[usable]
            cov_world = cov_world[usable]
            sd_world[rows] = np.sqrt(np.diagonal(cov_world, axis1=1, axis2=2))
            residual = rotation_world[rows][:, :, None]
            nees[rows] = (residual * np.linalg.solve(cov_world, residual)).sum(axis=(1, 2))
    return OrientationErrors(stamp=stamp, rotation_world=rotation_world, sd_world=sd_world,
                             total=angles[:, 0], heading=angles[:, 1],
                             inclination=angles[:, 2], nees=nees)


def attitude_cov_world(quat_world_imu: np.ndarray, cov_attitude: np.ndarray) -> np.ndarray:
    """Attitude covariances about the axes of the world, NaN where they are unknown.

    The error in the world is minus the local one, turned by the estimate: same covariance,
    turned.

    Args:
        quat_world_imu: (n, 4) xyzw.
        cov_attitude: (n, 3, 3) rad^2 of the local error.

    Returns:
        (n, 3, 3) rad^2 about east, north and up; NaN where ``cov_attitude`` is not positive
        definite (zeros, -1 and NaN mean unknown).
    """
    matrix = Rotation.from_quat(quat_world_imu).as_matrix()
    cov_world = matrix @ np.asarray(cov_attitude, dtype=np.float64) @ matrix.transpose(0, 2, 1)
    cov_world[~_positive_definite(cov_world)] = np.nan
    return cov_world


def split_angles(quat_error_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Total, heading and inclination angle of error quaternions (n, 4) xyzw.

    Returns:
        three arrays (n,) rad, from 0 to pi (BROAD, section 3.5).
    """
    x, y, z, w = np.moveaxis(np.asarray(quat_error_world, dtype=np.float64), -1, 0)
    total = 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))
    heading = 2.0 * np.arctan2(np.abs(z), np.abs(w))
    inclination = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
    return total, heading, inclination


def statistics(errors: OrientationErrors, mask: np.ndarray | None = None) -> list[ErrorStatistics]:
    """ErrorStatistics of total, heading and inclination over the samples with a reference.

    Args:
        errors: OrientationErrors.
        mask: (n,) bool, the samples that count (BROAD: those in movement); None: all.
    """
    rows = []
    for name in ("total", "heading", "inclination"):
        values = getattr(errors, name)
        keep = np.isfinite(values) if mask is None else np.isfinite(values) & mask
        values = np.degrees(values[keep])
        if len(values) == 0:
            rows.append(ErrorStatistics(name, 0, *[np.nan] * 4))
            continue
        rows.append(ErrorStatistics(
            name=name, count=len(values), rmse_deg=float(np.sqrt(np.mean(values ** 2))),
            median_deg=float(np.median(values)), p95_deg=float(np.percentile(values, 95)),
            maximum_deg=float(values.max())))
    return rows


def shares_within(errors: OrientationErrors,
                  mask: np.ndarray | None = None) -> dict[str, tuple[float, ...]]:
    """Shares of the errors within 1, 2 and 3 stated standard deviations.

    Args:
        errors: OrientationErrors.
        mask: (n,) bool, the samples that count; None: all.

    Returns:
        dict of ``tilt`` (east and north together) and ``heading`` to three shares from 0 to
        1, to be compared with GAUSSIAN_SHARES; NaN without stated standard deviations.
    """
    ratio = np.abs(errors.rotation_world) / errors.sd_world
    if mask is not None:
        ratio = ratio[mask]
    result = {}
    for name, columns in (("tilt", [0, 1]), ("heading", [2])):
        values = ratio[:, columns]
        values = values[np.isfinite(values)]
        result[name] = tuple(float(np.mean(values <= k)) if len(values) else np.nan
                             for k in (1, 2, 3))
    return result


def _positive_definite(matrices: np.ndarray) -> np.ndarray:
    """Which of (n, 3, 3) symmetric matrices are finite and positive definite: (n,) bool."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    minors = [matrices[:, 0, 0],
              matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0],
              np.linalg.det(np.where(finite[:, None, None], matrices, 0.0))]
    return finite & np.all([minor > 0 for minor in minors], axis=0)
