"""A smoothed trajectory as a recording holds it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.jump_result import JumpResult
from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.messages.layouts import IMU, ODOMETRY
from imu_fusion.parameters.file import ParamsFile
from imu_fusion.recordings.bag_reader import Reader
from imu_fusion.recordings.logs import readable_messages
from imu_fusion.streams.registry import STAGES
from imu_fusion.streams.smoother_messages import (
    ODOMETRY_TOPIC,
    RESULTS_TOPIC,
    SMOOTHED_IMU_TOPIC,
    results_value,
)


def read_result(reader: Reader) -> tuple[SmootherResult | None, list[str], str]:
    """What the smoother has written into a recording.

    Returns:
        (SmootherResult, remarks, ''), or (None, [], why there is none). Biases of the sensors are
        not in a recording: NaN; nor are innovations: none.
    """
    odometry, imu, results = (
        readable_messages(reader, topic, form) if reader.find(topic) else [] for topic, form in (
            (ODOMETRY_TOPIC, ODOMETRY), (SMOOTHED_IMU_TOPIC, IMU), (RESULTS_TOPIC, results_value)))
    found = results_value(results[-1]) if results else {}
    felt = found.get("acc_density") is None    # by an Imu
    if not odometry or not results or (felt and not imu):
        return None, [], f"{reader.path.name} holds no trajectory on {ODOMETRY_TOPIC}"
    if "origin" not in found:
        return None, [], (f"{reader.path.name} does not say where its trajectory begins; an older "
                          "imu_fusion has written it: process the recording again")
    try:
        samples = samples_of(odometry, imu if felt else None)
        if len(samples) == 0:
            raise ValueError(f"no stamps that {ODOMETRY_TOPIC} and {SMOOTHED_IMU_TOPIC} share")
        jump = JumpResult(**found["jump"]) if "jump" in found else None
        return SmootherResult(
            samples, LocalFrame(**found["origin"]), _states(found["states"], len(samples)), {},
            (found["cost"],), found["iterations"], found["converged"], jump=jump,
            events=None if jump is None else JumpEvents(jump.takeoff_stamp, jump.touchdown_stamp),
            gnss_lag=found["gnss_lag"], acc_density=found.get("acc_density")), found["remarks"], ""
    except (LookupError, TypeError, ValueError, AttributeError) as error:    # of somebody else
        return None, [], f"{reader.path.name} holds a trajectory that cannot be read ({error!r})"


def samples_of(odometry: list[bytes], imu: list[bytes] | None) -> np.ndarray:
    """Samples (SAMPLE) of messages on smoother/odometry and smoother/imu (None: there was no Imu);
    what is not in them is NaN.

    Undoes what :mod:`imu_fusion.streams.smoother` does to write them.
    """
    stamp, _, values = ODOMETRY.decode_many(odometry)
    forces = np.full((len(stamp), IMU.size), np.nan)
    if imu is not None:
        imu_stamp, _, forces = IMU.decode_many(imu)
        stamp, own, of_imu = np.intersect1d(stamp, imu_stamp, return_indices=True)
        values, forces = values[own], forces[of_imu]
    rows = np.zeros(len(stamp), SAMPLE)
    for name in ("gyr_bias", "acc_bias", "gyr_bias_sd", "acc_bias_sd"):
        rows[name] = np.nan
    rows["acc"] = forces[:, IMU["linear_acceleration"]]
    rows["acc_sd"] = np.sqrt(forces[:, IMU["linear_acceleration_covariance"]][:, ::4])
    rows["stamp"], rows["position_world"] = stamp, values[:, ODOMETRY["position"]]
    rows["quat_world_imu"], rows["gyr"] = (values[:, ODOMETRY[name]]
                                           for name in ("orientation", "angular"))
    pose, twist = (values[:, ODOMETRY[name]].reshape(-1, 6, 6)
                   for name in ("pose_covariance", "twist_covariance"))
    rotation = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    back = rotation.transpose(0, 2, 1)
    vel_imu = values[:, ODOMETRY["linear"]]
    turned = np.cross(np.eye(3), vel_imu[:, None, :]) * (imu is not None)
    rows["vel_world"] = np.einsum("nij,nj->ni", rotation, vel_imu)
    rows["cov_position"] = pose[:, :3, :3]
    rows["cov_attitude"] = back @ pose[:, 3:, 3:] @ rotation
    rows["cov_velocity"] = rotation @ (
        twist[:, :3, :3] - turned @ rows["cov_attitude"] @ turned.transpose(0, 2, 1)) @ back
    rows["gyr_sd"] = np.sqrt(twist[:, (3, 4, 5), (3, 4, 5)])
    return rows


def smoothing_params(params_file: ParamsFile) -> Any:
    """The SmoothingParams in parameter files."""
    (params,) = STAGES["smoother"].prepare(params_file)[1]
    return params


def _states(constant: Mapping[str, Mapping[str, list]], count: int
            ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {name: (np.tile(state["value"], (count, 1)), np.tile(state["sd"], (count, 1)))
            for name, state in constant.items()}
