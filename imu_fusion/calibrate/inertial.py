"""Accelerometer and gyroscope calibrated from a recording with rests and turns between them."""

from pathlib import Path

import numpy as np

from imu_fusion.calibrate.files import parameter_text, read_topic
from imu_fusion.errors import CalibrationError
from imu_fusion.geometry.gravity import normal_gravity
from imu_fusion.recordings.bag_reader import Lose
from imu_fusion.samples.flat_tops import GYRO_FLOOR, flat_tops
from imu_fusion.samples.logs import ImuLog, seconds
from imu_fusion.samples.rest import Rest, find_rests
from imu_fusion.sensors.accelerometer_calibration import calibrate_accelerometer
from imu_fusion.sensors.gyroscope_calibration import Turn, calibrate_gyroscope
from imu_fusion.sensors.linear_calibration import LinearCalibration

_IMU = "imu/data_raw"
_STANDARD_GRAVITY = 9.80665
_COVERAGE = 0.06     # of the directions: six sides
_LEAST_NOISE = 2e-3  # m/s^2, of a mean: what a table leaves of stillness
#: Prefixes of the parameters of :class:`imu_fusion.sensors.linear_calibration.SensorCalibration`.
_SHORT = {"accelerometer": "acc", "gyroscope": "gyro"}
_UNITS = {"accelerometer": "m/s\u00b2", "gyroscope": "rad/s"}


def calibrate_recorded_accelerometer(bag: str | Path, topic: str = _IMU,
                                     lose: Lose = lambda text: None
                                     ) -> tuple[LinearCalibration, list[str]]:
    """From the rests of a recording: the six sides up, or a dozen other poses.

    Args:
        lose: called with texts on what of it cannot be read.

    Returns:
        LinearCalibration, and texts on what makes it doubtful.

    Raises:
        TopicError: no such topic. CalibrationError: rests that do not determine it, or contradict
            each other.
    """
    imu, fix, remarks = read_topic(bag, topic, lose)
    if fix is None:
        gravity = _STANDARD_GRAVITY
        remarks.append(f"no fix tells the gravity of the place: {gravity} m/s^2 is taken, and "
                       "the scale errs by up to 0.3 % (add a topic fix)")
    else:
        gravity = normal_gravity(float(fix.latitude_deg[0]), float(fix.height[0]))
    rests = _rests(imu, bag)
    found = _accelerometer(imu, rests, gravity)
    if found.coverage < _COVERAGE:
        remarks.append(f"{100 * found.coverage:.0f} % of the directions were seen: hold it to all "
                       "sides")
    return found, remarks


def calibrate_recorded_gyroscope(bag: str | Path, topic: str = _IMU,
                                 angle_deg: float | None = None,
                                 lose: Lose = lambda text: None
                                 ) -> tuple[LinearCalibration, list[str]]:
    """From the turns between the rests of a recording.

    Args:
        angle_deg: by which every turn went, about one axis; None: not known.
        lose: called with texts on what of it cannot be read.

    Returns, Raises:
        As :func:`calibrate_recorded_accelerometer`.
    """
    imu, _, remarks = read_topic(bag, topic, lose)
    rests = _rests(imu, bag)
    if flat_tops(imu.gyr, GYRO_FLOOR):
        raise CalibrationError(f"{bag}: the rates reach the end of the gyroscope's range: turn "
                               "it more slowly")
    force = imu.acc
    try:
        force = _accelerometer(imu, rests, _STANDARD_GRAVITY).apply(force)
    except CalibrationError as error:
        remarks.append(f"forces are used as recorded ({error})")
    time = seconds(imu.stamp, imu.stamp[0])
    still = [imu.gyr[r.start:r.stop] for r in rests]
    means = np.array([rates.mean(axis=0) for rates in still])
    turns = [Turn(time[a.stop:b.start], imu.gyr[a.stop:b.start], force[a.start:a.stop].mean(axis=0),
                  force[b.start:b.stop].mean(axis=0)) for a, b in zip(rests, rests[1:])]
    # From rest to rest the offset wanders by more than the noise of a mean.
    found = calibrate_gyroscope(turns, np.concatenate(still).mean(axis=0),
                                means.std(axis=0) / np.sqrt(len(rests)),
                                None if angle_deg is None else np.radians(angle_deg))
    if angle_deg is None:
        remarks.append("no angle is known (--angle): the scale rests on turns about axes that are "
                       "not vertical")
    return found, remarks


def _rests(imu: ImuLog, bag) -> list[Rest]:
    rests = find_rests(imu)
    if not rests:
        raise CalibrationError(f"{bag}: no rest of a second: lay the sensor down between poses")
    return rests


def _accelerometer(imu, rests, gravity):
    poses = np.array([imu.acc[r.start:r.stop].mean(axis=0) for r in rests])
    noise = max(np.sqrt(np.mean([np.mean(imu.acc[r.start:r.stop].var(axis=0)) / (r.stop - r.start)
                                 for r in rests])), _LEAST_NOISE)
    return calibrate_accelerometer(poses, gravity, float(noise))


def linear_report(sensor: str, found: LinearCalibration) -> list[tuple[str, str]]:
    """What a calibration says of itself: (name, value with its unit)."""
    sd = found.sd
    rows = [(f"A, row {axis}", ", ".join(f"{v:.5f} \u00b1 {s:.5f}" for v, s in zip(
        found.matrix[i], sd[3 * i:3 * i + 3]))) for i, axis in enumerate("xyz")]
    rows.append((f"b, {_UNITS[sensor]}", ", ".join(
        f"{v:.5f} \u00b1 {s:.5f}" for v, s in zip(found.bias, sd[9:]))))
    return [*rows, ("method", found.method),
            (f"residuals, {found.unit}", ", ".join(f"{v:.3f}" for v in found.residual)),
            (f"residuals, RMS, {found.unit}", f"{found.rms:.4f}"),
            ("directions seen, %", f"{100 * found.coverage:.0f}"),
            ("condition", f"{found.condition:.1f}")]


def linear_parameters(sensor: str, found: LinearCalibration, bag: str | Path) -> str:
    """A ROS 2 parameter file (YAML) for all nodes, with where it is from."""
    short = _SHORT[sensor]
    values = {f"calibration.{short}_matrix": [float(v) for v in found.matrix.ravel()],
              f"calibration.{short}_bias": [float(v) for v in found.bias]}
    return parameter_text(
        sensor, values, bag,
        [f"x = A x~ + b, by {found.method};",
         f"residuals {found.rms:.4f} {found.unit} (RMS), condition {found.condition:.1f}"],
        {"method": found.method, "residuals": [float(v) for v in found.residual],
         "residual_unit": found.unit, "coverage": found.coverage, "condition": found.condition,
         "covariance": [float(v) for v in found.cov.ravel()]})
