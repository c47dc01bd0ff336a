"""Rotation kernels for hot loops (numba, scalar, no broadcasting).

Quaternions are Hamilton, active, ``x, y, z, w``. Arrays are float64 and
one-dimensional; whole logs are better served by ``scipy.spatial.transform``. Where an array per
call costs too much, :mod:`imu_fusion.geometry.quaternion` has the same with tuples.
"""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.geometry import quaternion


@njit
def _array(values):
    """A tuple of floats as an array."""
    out = np.empty(len(values))
    for i in range(len(values)):
        out[i] = values[i]
    return out


@njit
def skew(v):
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
def quat_multiply(p, q):
    """Hamilton product p * q. p, q: (4,). Returns (4,)."""
    return _array(quaternion.multiply(p, q))


@njit
def quat_conjugate(q):
    """Inverse of a unit quaternion. q: (4,). Returns (4,)."""
    return _array(quaternion.conjugate(q))


@njit
def quat_normalize(q):
    """q scaled to unit length. q: (4,), not zero. Returns (4,)."""
    return _array(quaternion.normalize(q))


@njit
def quat_to_matrix(q):
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
def quat_from_matrix(m):
    """Unit quaternion of a rotation matrix, by its largest component (Shepperd 1978).

    m: (3, 3). Returns (4,) with a non-negative largest component.
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
def quat_to_rpy(q):
    """Roll, pitch, yaw of a unit quaternion: R = Rz(yaw) Ry(pitch) Rx(roll) (REP 103).

    Returns (3,) rad, pitch within +-pi/2; at pitch = +-pi/2 only roll -+ yaw is defined.
    """
    x, y, z, w = q[0], q[1], q[2], q[3]
    rpy = np.empty(3)
    rpy[0] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    rpy[1] = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    rpy[2] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return rpy


@njit
def quat_rotate(q, v):
    """v turned by the unit quaternion q. q: (4,), v: (3,). Returns (3,)."""
    return _array(quaternion.rotate(q, v))


@njit
def quat_rotate_inverse(q, v):
    """v turned by the inverse of the unit quaternion q. Returns (3,)."""
    return quat_rotate(quat_conjugate(q), v)


@njit
def quat_exp(phi):
    """Unit quaternion of a rotation vector. phi: (3,) rad. Returns (4,)."""
    return _array(quaternion.exp(phi, 1.0))


@njit
def quat_log(q):
    """Rotation vector of a unit quaternion, of angle at most pi. Returns (3,) rad."""
    return _array(quaternion.log(q))


@njit
def so3_exp(phi):
    """Rotation matrix of a rotation vector. phi: (3,) rad. Returns (3, 3)."""
    return quat_to_matrix(quat_exp(phi))


@njit
def so3_log(m):
    """Rotation vector of a rotation matrix. m: (3, 3). Returns (3,) rad."""
    return quat_log(quat_from_matrix(m))


@njit
def right_jacobian(phi):
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


@njit
def right_jacobian_inverse(phi):
    """Inverse of :func:`right_jacobian`, for angles below 2 pi. Returns (3, 3)."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    angle = math.sqrt(angle2)
    if angle < 1e-2:
        c = 1.0 / 12.0 + angle2 / 720.0 + angle2 * angle2 / 30240.0
    else:
        half = 0.5 * angle
        c = (1.0 - half * math.cos(half) / math.sin(half)) / angle2
    k = skew(phi)
    return np.eye(3) + 0.5 * k + c * (k @ k)
