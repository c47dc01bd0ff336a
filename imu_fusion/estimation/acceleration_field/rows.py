"""What the estimators of acceleration fields give: one row per sample.

A row describes the whole field: with P and the value at the origin, the field at the body point
X is ``P X + value`` (Rahaman 2019, eq. (2.35)); see :func:`field_at`.
"""

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.estimation.acceleration_field.motion_model import (
    ACC,
    ALPHA,
    BIAS,
    JERK,
    OMEGA,
    THETA,
)
from imu_fusion.geometry.rotation import quat_to_matrix, skew
from imu_fusion.geometry.rotation_arrays import rotation_matrices
from imu_fusion.kernels import njit

# Bits of ``flags``.
MISSING = 1      # a channel had no reading
SATURATED = 2    # a channel was at its range
GAP = 4          # the time since the previous sample exceeds gap.max
HELD = 8         # too few channels: carried on without a fit
LEFT_OUT = 16    # a sensor contradicts the others or stands still, and was not used

_ASIDE = 0.07    # of a turn about the vertical that is doubted, by what accelerometers are off

ROW = np.dtype([
    ("stamp", "i8"),
    ("gradient", "f8", (3, 3)),          # P of the paper, 1/s^2
    ("specific_force", "f8", 3),         # at the body origin, body axes, m/s^2
    ("omega", "f8", 3),                  # body axes, rad/s
    ("alpha", "f8", 3),                  # body axes, rad/s^2
    ("quat", "f8", 4),                   # world from body, xyzw
    ("acceleration_world", "f8", 3),     # kinematic, at the body origin, m/s^2
    ("cov_specific_force", "f8", (3, 3)),
    ("cov_omega", "f8", (3, 3)),
    ("cov_alpha", "f8", (3, 3)),
    ("cov_attitude", "f8", (3, 3)),      # of the local error, rad^2
    ("cov_acceleration_world", "f8", (3, 3)),
    ("residual_rms", "f8"),              # of what the model does not explain, in units of noise
    ("flags", "i8"),
])


@njit
def put_row(row, p, quat, omega, alpha, acc, cov, gradient):
    """Fill a ROW, but for stamp, residual_rms and flags.

    Args:
        p: record of kernel_params; acc belongs to the body point ``p.reference``.
        quat: (4,) world from body.
        omega, alpha, acc: (3,) as in the state.
        cov: (18, 18) of the state of motion_model.
        gradient: (3, 3).
    """
    rotation = quat_to_matrix(quat)
    origin = -p.reference
    at_origin = acc + gradient @ origin
    force_jacobian = _field_jacobian(omega, origin)
    world_jacobian = force_jacobian.copy()
    up = p.gravity * np.ascontiguousarray(rotation[2])
    if p.specific_force:
        force = at_origin
        kinematic = at_origin - up
    else:
        force = at_origin + up
        kinematic = at_origin
        force_jacobian[:, THETA:OMEGA] = skew(up)
    # The error of gravity in body axes and that of the rotation to the world: what remains is
    # the attitude error times what was rotated.
    world_jacobian[:, THETA:OMEGA] = -skew(at_origin)
    world_jacobian = rotation @ world_jacobian
    row.gradient[:] = gradient
    row.specific_force[:] = force
    row.omega[:] = omega
    row.alpha[:] = alpha
    row.quat[:] = quat
    row.acceleration_world[:] = rotation @ kinematic
    # Where the sensors are as a whole is known but for this.
    shifted = p.common_shift_variance * (gradient @ gradient.T)
    row.cov_specific_force[:] = force_jacobian @ cov @ force_jacobian.T + shifted
    row.cov_omega[:] = cov[OMEGA:ALPHA, OMEGA:ALPHA]
    row.cov_alpha[:] = cov[ALPHA:JERK, ALPHA:JERK]
    row.cov_attitude[:] = cov[THETA:OMEGA, THETA:OMEGA]
    row.cov_acceleration_world[:] = (world_jacobian @ cov @ world_jacobian.T
                                     + rotation @ shifted @ rotation.T)


@njit
def put_rigid_row(row, p, quat, omega, alpha, acc, cov, doubt):
    """:func:`put_row` of a rigid body, whose gradient follows from omega and alpha: its mean, and
    what products of two errors of omega add to the covariance of the field at the origin. ``doubt``
    (18,): one more error of the state, which the mean leaves out, a standard deviation."""
    known = cov[OMEGA:ALPHA, OMEGA:ALPHA]
    spin = known[0, 0] + known[1, 1] + known[2, 2]
    gradient = rigid_gradient(omega, alpha) + known
    lever = 0.0
    for i in range(3):
        gradient[i, i] -= spin
        lever += p.reference[i] * p.reference[i]
    if np.any(doubt):
        cov = cov + np.outer(doubt, doubt)
        turn = doubt[OMEGA] ** 2 + doubt[OMEGA + 1] ** 2 + doubt[OMEGA + 2] ** 2
        for i in range(OMEGA, ALPHA):
            cov[i, i] += _ASIDE * _ASIDE * turn
    put_row(row, p, quat, omega, alpha, acc, cov, gradient)
    for i in range(3):
        row.cov_specific_force[i, i] += 0.5 * lever * spin * spin
        row.cov_acceleration_world[i, i] += 0.5 * lever * spin * spin


@njit
def put_still_rows(par, stamp, quat, omega, alpha, acc, cov, doubt, rows):
    """One of ``rows`` (n,) ROW for each stamp (n,) at which the state was the same; the other
    arguments are those of :func:`put_rigid_row`."""
    for n in range(len(stamp)):
        rows[n].stamp = stamp[n]
        rows[n].flags = 0
        rows[n].residual_rms = np.nan
        put_rigid_row(rows[n], par[0], quat, omega, alpha, acc, cov, doubt)


@njit
def _field_jacobian(w, point):
    """Derivative (3, 18) of the field at a point (3,) from the reference by the state; w: omega."""
    jacobian = np.zeros((3, BIAS))
    wr = w[0] * point[0] + w[1] * point[1] + w[2] * point[2]
    for i in range(3):
        for j in range(3):
            jacobian[i, OMEGA + j] = w[i] * point[j] - 2.0 * point[i] * w[j]
        jacobian[i, OMEGA + i] += wr
        jacobian[i, ACC + i] = 1.0
    jacobian[:, ALPHA:JERK] = -skew(point)
    return jacobian


@njit
def rigid_gradient(omega, alpha):
    """P = [alpha]x + [omega]x^2 of a rigid body. Returns (3, 3)."""
    w = skew(omega)
    return skew(alpha) + w @ w


def field_at(rows: np.ndarray, points: ArrayLike, gravity: float) -> tuple[
        np.ndarray, np.ndarray, np.ndarray]:
    """The acceleration field of ``rows`` (n) at body points (p, 3).

    Args:
        gravity: m/s^2, that of the estimator.

    Returns:
        (specific force in body axes, kinematic acceleration in body axes, kinematic acceleration
        in the world), each (n, p, 3) m/s^2. Magnitudes of the first need no orientation
        (Rahaman 2019, eq. (2.13)).
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    change = np.einsum("nij,pj->npi", rows["gradient"], points)
    rotation = rotation_matrices(rows["quat"])
    force = rows["specific_force"][:, None, :] + change
    body = force - gravity * rotation[:, None, 2, :]
    return force, body, np.einsum("nij,npj->npi", rotation, body)
