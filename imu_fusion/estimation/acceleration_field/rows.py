"""What the estimators of acceleration fields give: one row per sample.

A row describes the whole field: with P and the value at the origin, the field at the body point
X is ``P X + value`` (Rahaman 2019, eq. (2.35)); see :func:`field_at`.
"""

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.geometry.rotation import quat_to_matrix, skew

# Bits of ``flags``.
MISSING = 1      # a channel had no reading
SATURATED = 2    # a channel was at its range
GAP = 4          # the time since the previous sample exceeds max_gap
HELD = 8         # too few channels: carried on without a fit

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
    ("flags", "u4"),
])
# Which of the float columns between stamp and flags each field takes.
_COLUMNS = {}
VALUES = 0
for _name in ROW.names[1:-1]:
    _width = int(np.prod(ROW[_name].shape))
    _COLUMNS[_name] = slice(VALUES, VALUES + _width), ROW[_name].shape
    VALUES += _width


@njit
def put_row(values, gradient, x, cov, quat, reference, gravity, specific_force, residual):
    """Write one row's 71 floats.

    x: the first 18 states of the rigid-body kernel, cov: (18, 18) of them, reference: (3,) body
    coordinates of the point that x[12:15] is the acceleration of, gravity: m/s^2,
    specific_force: whether x[12:15] contains gravity, gradient: (3, 3).
    """
    rotation = quat_to_matrix(quat)
    origin = -reference
    at_origin = x[12:15] + gradient @ origin
    # Derivative of the field at the origin by (omega, alpha, a).
    w = x[3:6]
    turning = np.zeros((3, 18))
    wr = w[0] * origin[0] + w[1] * origin[1] + w[2] * origin[2]
    for i in range(3):
        for j in range(3):
            turning[i, 3 + j] = w[i] * origin[j] - 2.0 * origin[i] * w[j]
        turning[i, 3 + i] += wr
        turning[i, 12 + i] = 1.0
    turning[:, 6:9] = -skew(origin)
    up = gravity * np.ascontiguousarray(rotation[2])
    force_jacobian = turning.copy()
    world_jacobian = turning
    if specific_force:
        force = at_origin
        kinematic = at_origin - up
    else:
        force = at_origin + up
        kinematic = at_origin
        force_jacobian[:, 0:3] = skew(up)
    # The error of gravity in body axes and that of the rotation to the world: what remains is
    # the attitude error times what was rotated.
    world_jacobian[:, 0:3] = -skew(at_origin)
    world_jacobian = rotation @ world_jacobian
    values[0:9] = gradient.copy().reshape(9)
    values[9:12] = force
    values[12:15] = w
    values[15:18] = x[6:9]
    values[18:22] = quat
    values[22:25] = rotation @ kinematic
    values[25:34] = (force_jacobian @ cov @ force_jacobian.T).reshape(9)
    values[34:43] = np.ascontiguousarray(cov[3:6, 3:6]).reshape(9)
    values[43:52] = np.ascontiguousarray(cov[6:9, 6:9]).reshape(9)
    values[52:61] = np.ascontiguousarray(cov[0:3, 0:3]).reshape(9)
    values[61:70] = (world_jacobian @ cov @ world_jacobian.T).reshape(9)
    values[70] = residual


@njit
def rigid_gradient(omega, alpha):
    """P = [alpha]x + [omega]x^2 of a rigid body. Returns (3, 3)."""
    w = skew(omega)
    return skew(alpha) + w @ w


def make_rows(stamp, values, flags):
    """Structured array ROW of stamps (n,), values (n, 71) and flags (n,)."""
    rows = np.empty(len(stamp), ROW)
    rows["stamp"] = stamp
    rows["flags"] = flags
    for name, (columns, shape) in _COLUMNS.items():
        rows[name] = values[:, columns].reshape(-1, *shape)
    return rows


def field_at(rows, points, gravity):
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


@njit
def rotation_matrices(quat):
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4)."""
    out = np.empty((len(quat), 3, 3))
    for i in range(len(quat)):
        out[i] = quat_to_matrix(quat[i])
    return out
