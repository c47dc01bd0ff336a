"""What the report needs of an acceleration field: estimates and readings, read from recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.acceleration_field.impact_metrics import measure_impacts
from imu_fusion.estimation.acceleration_field.rows import ROW, SATURATED, field_at, rigid_gradient
from imu_fusion.estimation.acceleration_field.sensor_array import AccelerometerParams
from imu_fusion.messages.convert import attitude_log
from imu_fusion.messages.layouts import ACCEL, IMU
from imu_fusion.parameters.file import ParamsFile, files_of
from imu_fusion.recordings.bag_reader import find_topic, open_bag
from imu_fusion.recordings.logs import read_log, readable_messages
from imu_fusion.recordings.results import read_results, results_of
from imu_fusion.streams.acceleration_field import (
    ACCEL_TOPIC,
    GYROSCOPE_TOPIC,
    IMU_TOPIC,
    NODE,
    FieldConfiguration,
    read_configuration,
)


@dataclass(frozen=True, eq=False)
class FieldData:
    """Estimates of a field as rows (ROW), what was measured, and where.

    ``readings`` maps accelerometers to (n, 3) m/s^2 in their own axes, NaN where there is none;
    ``gyr`` (n, 3) rad/s of the gyroscope in body axes, NaN where there is none, or None.
    ``impacts`` and ``remarks``: what ``process`` has found beside the estimates; ``losses``: what
    of these cannot be read.
    """

    rows: np.ndarray
    config: FieldConfiguration
    readings: dict
    gyr: np.ndarray | None
    impacts: list
    remarks: tuple[str, ...] = ()
    losses: Sequence[str] = ()

    @property
    def points(self) -> np.ndarray:
        """Query points (p, 3) m; the origin if none are named."""
        points = np.reshape(self.config.field.points, (-1, 3))
        return points if len(points) else np.zeros((1, 3))

    @property
    def places(self) -> dict[str, np.ndarray]:
        """dict of accelerometer to its position (3,) m."""
        return {name: np.array(a.position) for name, a in self.config.accelerometers.items()}

    def accelerometer(self, name: str) -> AccelerometerParams:
        """AccelerometerParams of one, completed by those of all."""
        return self.config.accelerometers[name].completed(self.config.field.sensor)

    def field(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """(specific force, kinematic acceleration), each (n, p, 3) m/s^2 in body axes."""
        return field_at(self.rows, points, self.config.field.gravity)[:2]

    def residuals(self, name: str) -> np.ndarray:
        """Readings of an accelerometer minus the estimated field, (n, 3) in its own axes."""
        sensor = self.accelerometer(name)
        force, kinematic = self.field([sensor.position])
        felt = force if sensor.reports == "specific_force" else kinematic
        residual = self.readings[name] - felt[:, 0] @ np.reshape(sensor.axes, (3, 3)).T
        residual[:, [axis not in sensor.measured_axes for axis in "xyz"]] = np.nan
        return residual

    @property
    def clipped(self) -> np.ndarray:
        """(n, 3) whether an axis of the gyroscope was taken to be at its limit."""
        sensor = self.config.field.sensor
        limit = sensor.gyro_range
        if self.gyr is None or limit is None:
            return np.zeros((len(self.rows), 3), dtype=bool)
        axes = np.reshape(sensor.gyro_axes, (3, 3))
        own = np.abs(np.nan_to_num(self.gyr) @ axes.T) >= limit
        return (own.astype(float) @ np.abs(axes)) > 0.5


def read_field(bag: str | Path, estimates: str | Path,
               params_file: ParamsFile = None,
               remap: Mapping[str, str] | None = None) -> FieldData | None:
    """FieldData of a recording and of the one with its estimates; None if it holds none.

    Args:
        bag: recording with the accelerometers.
        estimates: recording with acceleration_field/imu and acceleration_field/accel.
        params_file: ParamsFile of the estimator; None: then nothing is known of the
            accelerometers.
        remap: topic names of ours to those in ``bag``.
    """
    with open_bag(estimates) as reader:
        if any(find_topic(reader.topics, t) is None for t in (IMU_TOPIC, ACCEL_TOPIC)):
            return None
        messages = readable_messages(reader, IMU_TOPIC, IMU)
        imu, covs = attitude_log(messages), _covariances(messages)
        stamps, _, values = ACCEL.decode_many(readable_messages(reader, ACCEL_TOPIC, ACCEL))
        losses = reader.losses
    shared, i, j = np.intersect1d(imu.stamp, stamps, return_indices=True)
    if len(shared) == 0:
        return None
    rows = _rows(shared, imu[i], covs[i], values[j])
    config = read_configuration(params_file)
    readings, gyr = _measured(bag, config, rows["stamp"], remap)
    for name, reading in readings.items():
        limit = config.accelerometers[name].completed(config.field.sensor).range
        if limit is not None:
            with np.errstate(invalid="ignore"):
                rows["flags"][(np.abs(reading) >= limit).any(axis=1)] |= SATURATED
    beside = results_of(estimates, NODE)
    if read_results(estimates) is None and files_of(params_file):
        impacts = measure_impacts(rows, config.field.points, config.field.gravity,
                                  config.stream.impact)
    else:
        impacts = beside.get("impacts", [])
    return FieldData(rows, config, readings, gyr, impacts, tuple(beside.get("remarks", ())), losses)


def _covariances(messages):
    """(n, 2, 3, 3) of rates and specific force as published."""
    _, _, values = IMU.decode_many(messages)
    return np.stack([values[:, IMU[f"{field}_covariance"]].reshape(-1, 3, 3) for field in
                     ("angular_velocity", "linear_acceleration")], axis=1)


def _rows(stamps, imu, covs, accel):
    rows = np.zeros(len(stamps), ROW)
    rows["stamp"], rows["omega"], rows["specific_force"] = stamps, imu.gyr, imu.acc
    rows["quat"], rows["cov_attitude"] = imu.quat_world_imu, imu.cov_attitude
    rows["cov_omega"], rows["cov_specific_force"] = covs[:, 0], covs[:, 1]
    rows["alpha"] = accel[:, ACCEL["angular"]]
    cov = accel[:, ACCEL["covariance"]].reshape(-1, 6, 6)
    turn = Rotation.from_quat(rows["quat"])
    rotation = turn.as_matrix()
    rows["acceleration_world"] = turn.apply(accel[:, ACCEL["linear"]])
    rows["cov_acceleration_world"] = rotation @ cov[:, :3, :3] @ rotation.transpose(0, 2, 1)
    rows["cov_alpha"] = cov[:, 3:, 3:]
    rows["gradient"] = [rigid_gradient(w, a) for w, a in zip(rows["omega"], rows["alpha"])]
    rows["residual_rms"] = np.nan
    return rows


def _measured(bag, config, stamps, remap):
    """Readings of the accelerometers and the gyroscope at the stamps of the estimates."""
    readings, gyr = {}, None
    tolerance = int(round(config.stream.match.tolerance * 1e9))
    with open_bag(bag, remap=remap) as reader:
        for name in config.accelerometers:
            topic = f"accelerometers/{name}"
            if find_topic(reader.topics, topic) is not None:
                log = read_log(reader, topic)
                readings[name] = _at(stamps, log.stamp, log.acc, tolerance)
        if find_topic(reader.topics, GYROSCOPE_TOPIC) is not None:
            log = read_log(reader, GYROSCOPE_TOPIC)
            gyr = _at(stamps, log.stamp, log.gyr, tolerance)
            gyr = gyr @ np.reshape(config.field.sensor.gyro_axes, (3, 3))
    return readings, gyr


def _at(stamps, log_stamps, values, tolerance):
    """Values (n, 3) of the samples within ``tolerance`` ns after ``stamps`` (n,), else NaN."""
    result = np.full((len(stamps), 3), np.nan)
    order = np.argsort(log_stamps, kind="stable")
    place = np.searchsorted(log_stamps[order], stamps - tolerance)
    known = place < len(log_stamps)
    known[known] &= log_stamps[order][place[known]] - stamps[known] <= tolerance
    result[known] = values[order[place[known]]]
    return result
