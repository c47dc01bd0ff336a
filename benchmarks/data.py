"""Where the real recordings are: IMU_FUSION_DATA, or ../shared/data beside the repository."""

import os
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.evaluation.orientation_error import split_angles
from imu_fusion.parameters.file import parameters_for
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.streams.smoother_params import SmoothingParams


def config(name, **changes):
    """SmoothingParams of a file in config/, with changes."""
    file = Path(__file__).resolve().parents[1] / "config" / f"{name}.yaml"
    return parameters_for((SmoothingParams,), "smoother", file)[0].replace(**changes)


def data_path(name):
    """Path of a recording, file or folder; may not exist."""
    root = os.environ.get("IMU_FUSION_DATA")
    base = Path(root) if root else Path(__file__).resolve().parents[2] / "shared" / "data"
    return base / name


def broad_trials():
    """Files of the BROAD trials at hand, sorted; empty where there are none."""
    return sorted(data_path("broad").glob("*.npz"))


def load_broad(path):
    """One BROAD trial (Laidig et al. 2021, CC BY 4.0).

    Returns:
        ImuLog, MagLog, reference quat_world_imu (n, 4) xyzw (nan where unknown),
        movement mask (n,).
    """
    d = np.load(path)
    stamp = np.round(np.arange(len(d["gyr"])) * (1e9 / float(d["fs"]))).astype(np.int64)
    quat = d["quat"].astype(float)[:, [1, 2, 3, 0]]
    return (ImuLog(stamp, d["gyr"], d["acc"]), MagLog(stamp, d["mag"] * 1e-6), quat, d["mov"])


def broad_errors(quat, reference, mask):
    """BROAD's metric: RMSE in degrees of total, heading and inclination error.

    quat, reference: (n, 4) xyzw; mask: (n,) bool, the samples that count.
    """
    keep = mask & np.isfinite(reference).all(axis=1)
    error = Rotation.from_quat(quat[keep]) * Rotation.from_quat(reference[keep]).inv()
    return tuple(float(np.degrees(np.sqrt(np.mean(angle ** 2))))
                 for angle in split_angles(error.as_quat()))
