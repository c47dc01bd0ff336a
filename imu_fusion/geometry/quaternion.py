"""Quaternions and vectors as tuples, for hot loops: nothing is allocated (numba, scalar).

Hamilton, active, ``x, y, z, w``. Arguments may be tuples or one-dimensional arrays; results are
tuples of floats. :mod:`imu_fusion.geometry.rotation` has the same as arrays.
"""

import math

from imu_fusion.kernels import njit

# Below this angle the truncated series are exact to float64 rounding:
# the first neglected term is of the order angle^6 / 5040 of the value.
_SMALL = 1e-3


@njit
def multiply(p, q):
    """Hamilton product p * q."""
    return (p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1],
            p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0],
            p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3],
            p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2])


@njit
def conjugate(q):
    """Inverse of a unit quaternion."""
    return -q[0], -q[1], -q[2], q[3]


@njit
def normalize(q):
    """q, not zero, scaled to unit length."""
    size = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / size, q[1] / size, q[2] / size, q[3] / size


@njit
def rotate(q, v):
    """v turned by the unit quaternion q."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    return (v[0] + w * tx + y * tz - z * ty,
            v[1] + w * ty + z * tx - x * tz,
            v[2] + w * tz + x * ty - y * tx)


@njit
def exp(phi, scale):
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
def log(q):
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
