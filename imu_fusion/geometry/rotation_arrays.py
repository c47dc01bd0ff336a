"""Rotations of whole logs, by the same kernels as single ones."""

import numpy as np

from imu_fusion.geometry.rotation import (
    quat_multiply,
    quat_rotate_inverse,
    quat_to_matrix,
    quat_to_rpy,
)
from imu_fusion.kernels import njit


@njit
def rotation_matrices(quat):
    """:func:`quat_to_matrix` of each row of (n, 4). Returns (n, 3, 3)."""
    out = np.empty((len(quat), 3, 3))
    for i in range(len(quat)):
        out[i] = quat_to_matrix(quat[i])
    return out


@njit
def rpy_angles(quat):
    """:func:`quat_to_rpy` of each row of (n, 4). Returns (n, 3) rad."""
    out = np.empty((len(quat), 3))
    for i in range(len(quat)):
        roll, pitch, yaw = quat_to_rpy(quat[i])
        out[i, 0] = roll
        out[i, 1] = pitch
        out[i, 2] = yaw
    return out


@njit
def in_sensor_axes(quat, v):
    """One world vector v (3,) in the axes of each sensor of (n, 4). Returns (n, 3)."""
    out = np.empty((len(quat), 3))
    for i in range(len(quat)):
        x, y, z = quat_rotate_inverse(quat[i], v)
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = z
    return out


@njit
def turned_by(turn, quat):
    """``turn * q`` for each row q of (n, 4); turn (4,). Returns (n, 4)."""
    out = np.empty((len(quat), 4))
    for i in range(len(quat)):
        x, y, z, w = quat_multiply(turn, quat[i])
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = z
        out[i, 3] = w
    return out
