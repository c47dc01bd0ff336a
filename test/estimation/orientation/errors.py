"""Errors of the estimator's rows against the truth."""

import math

import numpy as np
from scipy.spatial.transform import Rotation


def local_errors(rows, truth):
    """(n, 3) rotation vectors from estimate to truth, imu axes, rad."""
    return (Rotation.from_quat(rows["quat_world_imu"]).inv()
            * Rotation.from_quat(truth.quat_world_imu)).as_rotvec()


def rmse_deg(rows, truth):
    return math.degrees(math.sqrt((local_errors(rows, truth) ** 2).sum(axis=1).mean()))


def tilt_errors_deg(rows, truth):
    up = [[0.0, 0.0, 1.0]] * len(rows)
    a = Rotation.from_quat(rows["quat_world_imu"]).inv().apply(up)
    b = Rotation.from_quat(truth.quat_world_imu).inv().apply(up)
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))
