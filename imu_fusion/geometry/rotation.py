"""Rotations for hot loops (numba, scalar, no broadcasting).

Quaternions are Hamilton, active, ``x, y, z, w``. Quaternions and vectors may be tuples or
one-dimensional arrays, and come back as tuples of floats, so that a chain of them allocates
nothing: assign one to a slice, or write ``np.array(...)`` for arithmetic. Matrices are float64
arrays (3, 3). Whole logs are better served by ``scipy.spatial.transform``.
"""

import math
from collections.abc import Sequence

import numpy as np

from imu_fusion.kernels import njit

Vector = Sequence[float] | np.ndarray   # three or four numbers
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# Below this angle the truncated series are exact to float64 rounding:
# the first neglected term is of the order angle^6 / 5040 of the value.
_SMALL = 1e-3


@njit
def quat_multiply(p: Vector, q: Vector) -> Quaternion:
    """Hamilton product p * q."""
    return (p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1],
            p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0],
            p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3],
            p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2])


@njit
def quat_conjugate(q: Vector) -> Quaternion:
    """Inverse of a unit quaternion."""
    return -q[0], -q[1], -q[2], q[3]


@njit
def quat_normalize(q: Vector) -> Quaternion:
    """q, not zero, scaled to unit length."""
    size = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / size, q[1] / size, q[2] / size, q[3] / size


@njit
def quat_rotate(q: Vector, v: Vector) -> Vector3:
    """v turned by the unit quaternion q."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    return (v[0] + w * tx + y * tz - z * ty,
            v[1] + w * ty + z * tx - x * tz,
            v[2] + w * tz + x * ty - y * tx)


@njit
def quat_rotate_inverse(q: Vector, v: Vector) -> Vector3:
    """v turned by the inverse of the unit quaternion q."""
    return quat_rotate(quat_conjugate(q), v)


@njit
def quat_exp(phi: Vector, scale: float = 1.0) -> Quaternion:
    """Unit quaternion of the rotation vector ``scale * phi``, rad."""
    a, b, c = scale * phi[0], scale * phi[1], scale * phi[2]
    angle2 = a * a + b * b + c * c
    angle = math.sqrt(angle2)
    if angle < _SMALL:
        s = 0.5 - angle2 / 48.0 + angle2 * angle2 / 3840.0
    else:
        s = math.sin(0.5 * angle) / angle
    return s * a, s * b, s * c, math.cos(0.5 * angle)


@njit
def quat_log(q: Vector) -> Vector3:
    """Rotation vector of a unit quaternion, of angle at most pi, rad."""
    n2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    n = math.sqrt(n2)
    sign = 1.0 if q[3] >= 0.0 else -1.0
    w = abs(q[3])
    if n < _SMALL:
        t = n / w
        s = 2.0 / w * (1.0 - t * t / 3.0 + t ** 4 / 5.0)
    else:
        s = 2.0 * math.atan2(n, w) / n
    return sign * s * q[0], sign * s * q[1], sign * s * q[2]


@njit
def quat_to_matrix(q: Vector) -> np.ndarray:
    """Rotation matrix of a unit quaternion. q: (4,). Returns (3, 3)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    m = np.empty((3, 3))
    m[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    m[0, 1] = 2.0 * (x * y - z * w)
    m[0, 2] = 2.0 * (x * z + y * w)
    m[1, 0] = 2.0 * (x * y + z * w)
    m[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    m[1, 2] = 2.0 * (y * z - x * w)
    m[2, 0] = 2.0 * (x * z - y * w)
    m[2, 1] = 2.0 * (y * z + x * w)
    m[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return m


@njit
def quat_from_matrix(m: np.ndarray) -> Quaternion:
    """Unit quaternion of a rotation matrix, by its largest component (Shepperd 1978).

    m: (3, 3). The largest component of the result is not negative.
    """
    q = np.empty(4)
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    largest = 3
    best = trace
    for i in range(3):
        if m[i, i] > best:
            best = m[i, i]
            largest = i
    if largest == 3:
        s = 2.0 * math.sqrt(1.0 + trace)
        q[0] = (m[2, 1] - m[1, 2]) / s
        q[1] = (m[0, 2] - m[2, 0]) / s
        q[2] = (m[1, 0] - m[0, 1]) / s
        q[3] = 0.25 * s
    else:
        i = largest
        j = (i + 1) % 3
        k = (i + 2) % 3
        s = 2.0 * math.sqrt(1.0 + m[i, i] - m[j, j] - m[k, k])
        q[i] = 0.25 * s
        q[j] = (m[j, i] + m[i, j]) / s
        q[k] = (m[k, i] + m[i, k]) / s
        q[3] = (m[k, j] - m[j, k]) / s
    return quat_normalize(q)


@njit
def quat_to_rpy(q: Vector) -> Vector3:
    """Roll, pitch, yaw of a unit quaternion: R = Rz(yaw) Ry(pitch) Rx(roll) (REP 103).

    Rad, pitch within +-pi/2; at pitch = +-pi/2 only roll -+ yaw is defined.
    """
    x, y, z, w = q[0], q[1], q[2], q[3]
    return (math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
            math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


@njit
def skew(v: Vector) -> np.ndarray:
    """Matrix [v]x with ``skew(v) @ u == cross(v, u)``. v: (3,). Returns (3, 3)."""
    m = np.zeros((3, 3))
    m[0, 1] = -v[2]
    m[0, 2] = v[1]
    m[1, 0] = v[2]
    m[1, 2] = -v[0]
    m[2, 0] = -v[1]
    m[2, 1] = v[0]
    return m


@njit
def right_jacobian(phi: Vector) -> np.ndarray:
    """J with ``Exp(phi + d) = Exp(phi) Exp(J d)`` to first order. Returns (3, 3)."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    angle = math.sqrt(angle2)
    if angle < 1e-2:
        # (1 - cos a) / a^2 and (a - sin a) / a^3 cancel badly near zero.
        b = 0.5 - angle2 / 24.0 + angle2 * angle2 / 720.0
        c = 1.0 / 6.0 - angle2 / 120.0 + angle2 * angle2 / 5040.0
    else:
        b = (1.0 - math.cos(angle)) / angle2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    # [phi]x squared is phi phi' - angle^2 I.
    j = np.empty((3, 3))
    for i in range(3):
        for m in range(3):
            j[i, m] = c * phi[i] * phi[m]
        j[i, i] += 1.0 - c * angle2
    j[0, 1] += b * phi[2]
    j[0, 2] -= b * phi[1]
    j[1, 0] -= b * phi[2]
    j[1, 2] += b * phi[0]
    j[2, 0] += b * phi[1]
    j[2, 1] -= b * phi[0]
    return j
