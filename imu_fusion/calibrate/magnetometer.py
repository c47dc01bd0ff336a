"""A magnetometer calibrated in situ, from a recording in which it turned."""

import math
from pathlib import Path

import numpy as np

from imu_fusion.calibrate.files import parameter_text, read_topic
from imu_fusion.errors import ImuFusionError
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.recordings.bag_reader import Lose
from imu_fusion.sensors.magnetometer_calibration import MagCalibration, calibrate_magnetometer

_MAG = "imu/mag"
_SCATTER = 0.05      # of the field, beyond which one ellipsoid does not describe the samples
_COVERAGE = 0.3      # of the directions, below which the fit is one of a ring


def calibrate_recorded_magnetometer(bag: str | Path, topic: str = _MAG,
                                    lose: Lose = lambda text: None
                                    ) -> tuple[MagCalibration, list[str]]:
    """In situ calibration (Winkler 2025, appendix A) of the magnetometer in a recording.

    The field's norm is that of the World Magnetic Model at the first fix; without a fix it is left
    open, and so is a factor of the matrix, which attitudes do not need.

    Args:
        bag: path of a recording in which the sensor turned. topic: its sensor_msgs/MagneticField.
        lose: called with texts on what of it cannot be read.

    Returns:
        MagCalibration, and texts on what makes it doubtful.

    Raises:
        TopicError: no such topic. CalibrationError: directions that do not determine it.
    """
    norm = None
    mag, first, remarks = read_topic(bag, topic, lose)
    if first is not None:
        try:
            norm = float(np.linalg.norm(magnetic_field_world(
                float(first.latitude_deg[0]), float(first.longitude_deg[0]),
                float(first.height[0]), decimal_year(int(first.stamp[0])))))
        except ImuFusionError as error:
            remarks.append(f"the norm of the field is not known: {error}")
    found = calibrate_magnetometer(mag.mag, norm)
    share = found.residual_sd / found.field_norm
    if share > _SCATTER:
        remarks.append(f"the calibrated norm scatters by {100 * share:.0f} %: iron beside the "
                       "sensor's path, or not one rigid body with it")
    if found.coverage < _COVERAGE:
        remarks.append(f"{100 * found.coverage:.0f} % of the directions were seen: turn the sensor "
                       "about all axes")
    return found, remarks


def magnetometer_report(found: MagCalibration) -> list[tuple[str, str]]:
    """What a calibration says of itself: (name, value with its unit)."""
    sd = np.sqrt(found.cov.diagonal())
    offset = ", ".join(f"{1e6 * v:.2f} \u00b1 {1e6 * s:.2f}" for v, s in zip(found.offset, sd))
    return [("offset, \u00b5T", offset),
            ("scales", ", ".join(f"{v:.4f}" for v in np.diag(found.matrix))),
            ("norm of the field, \u00b5T", f"{1e6 * found.field_norm:.2f}"),
            ("scatter of the norm as recorded, \u00b5T", f"{1e6 * found.recorded_sd:.2f}"),
            ("and calibrated, \u00b5T", f"{1e6 * found.residual_sd:.2f}"),
            ("directions seen, %", f"{100 * found.coverage:.0f}"),
            ("condition", f"{found.condition:.1f}"), ("samples", str(found.samples))]


def magnetometer_parameters(found: MagCalibration, bag: str | Path) -> str:
    """A ROS 2 parameter file (YAML) for all nodes, with where it is from."""
    values = {"calibration.mag_matrix": [float(v) for v in found.matrix.ravel()],
              "calibration.mag_bias": [float(v) for v in found.bias]}
    worst = 1e6 * math.sqrt(found.cov.diagonal()[:3].max())
    return parameter_text(
        "magnetometer", values, bag,
        ["x = A x~ + b,",
         f"{found.samples} samples, {100 * found.coverage:.0f} % of the directions, offset good to "
         f"{worst:.2f} uT,", f"norm scatters by {1e6 * found.residual_sd:.2f} uT"],
        {"method": "ellipsoid", "residual_sd": float(found.residual_sd),
         "recorded_sd": float(found.recorded_sd),
         "condition": float(found.condition), "coverage": float(found.coverage),
         "samples": found.samples, "covariance": [float(v) for v in found.cov.ravel()]})
