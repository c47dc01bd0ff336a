"""Parameters of sensors: in every estimator the same names, units and meanings.

An estimator's own class ``Sensor`` picks from :data:`SENSOR` what it uses, with its defaults:

    @dataclass(frozen=True)
    class Sensor(Parameters):
        gyro_noise_density: float = sensor("gyro_noise_density", 3e-4)
"""

from typing import Any

from imu_fusion.parameters.declare import param

#: name: what all estimators agree on.
SENSOR: dict[str, dict[str, Any]] = {
    "gyro_noise_density": dict(
        unit="rad/s/sqrt(Hz)", low=1e-9, high=10.0,
        doc="Gyroscope white noise. Raise it for vibration that the sampling cannot follow."),
    "gyro_bias_sd": dict(
        unit="rad/s", low=0.0, high=1.0,
        doc="Standard deviation of the gyroscope's bias at the start."),
    "gyro_bias_walk": dict(
        unit="rad/s/sqrt(s)", low=0.0, high=1.0, doc="Random walk of the gyroscope's bias."),
    "gyro_axes": dict(
        length=9, low=-1.0, high=1.0,
        doc="The gyroscope's axes in body coordinates, row by row; orthonormal."),
    "gyro_scale_sd": dict(
        low=0.0, high=0.5, doc="Standard deviation of the gyroscope's scale errors, as states; 0: "
        "calibrated, no states."),
    "gyro_range": dict(
        unit="rad/s", low=1e-3, length=(1, 3),
        doc="Largest rate that the gyroscope reports, one value or one per axis; unset: found from "
            "the data where the estimator can, else taken as never reached."),
    "gyro_delay": dict(
        unit="s", low=-0.1, high=0.1, doc="How late rates and specific forces are stamped."),
    "gyro_delay_sd": dict(
        unit="s", low=0.0, high=0.1,
        doc="Standard deviation of a gyroscope delay that is not given."),
    "acc_noise_density": dict(
        unit="m/s^2/sqrt(Hz)", low=1e-9, high=10.0,
        doc="White noise of the accelerometer, with the motion that the sampling cannot follow."),
    "acc_bias_sd": dict(
        unit="m/s^2", low=0.0, high=10.0,
        doc="Standard deviation of the accelerometer's bias at the start."),
    "acc_bias_walk": dict(
        unit="m/s^2/sqrt(s)", low=0.0, high=10.0, doc="Random walk of the accelerometer's bias."),
    "acc_matrix_sd": dict(
        low=0.0, high=0.5, doc="Standard deviation of the accelerometer's scale errors and "
        "misalignments (nine, Winkler's C), as states; 0: calibrated, no states."),
    "acc_range": dict(
        unit="m/s^2", low=1e-3, length=(1, 3),
        doc="Largest specific force that the accelerometer reports, one value or one per axis; "
            "unset: found from the data where the estimator can, else taken as never reached."),
    "acc_position_sd": dict(
        unit="m", low=0.0, high=0.1,
        doc="Standard deviation of an accelerometer's place, each coordinate, as states; 0: known "
            "exactly, no states."),
    "acc_axes_sd": dict(
        unit="rad", low=0.0, high=0.5,
        doc="Standard deviation of how an accelerometer is turned, about each axis, as states; 0: "
            "known exactly, no states."),
    "acc_scale_sd": dict(
        low=0.0, high=0.5, doc="Standard deviation of the scale error of each axis of an "
        "accelerometer, as states; 0: calibrated, no states."),
    "gyro_axes_sd": dict(
        unit="rad", low=0.0, high=0.5,
        doc="Standard deviation of how the gyroscope is turned, about each axis, as states; 0: "
            "known exactly, no states."),
    "axes_sd": dict(
        unit="rad", low=0.0, high=1.0, doc="Uncertainty of the sensor's axes in its case."),
    "mag_noise_sd": dict(
        unit="T", low=1e-12, high=1e-3, doc="Noise of one magnetometer sample."),
    "mag_bias_sd": dict(
        unit="T", low=1e-9, high=1e-2,
        doc="Standard deviation of the magnetometer's bias (hard iron), as states."),
    "mag_scale_sd": dict(
        low=1e-6, high=1.0,
        doc="Standard deviation of the magnetometer's scale errors, as states."),
    "mag_axes_sd": dict(
        unit="rad", low=0.0, high=0.5,
        doc="Standard deviation of how the magnetometer is turned against the Imu, about each "
            "axis, as states; 0: known exactly, no states. An ellipsoid does not show it."),
    "mag_range": dict(
        unit="T", low=1e-6, length=(1, 3),
        doc="Largest field that the magnetometer reports, one value or one per axis, before "
            "mag_offset and mag_matrix; unset: found from the data where the estimator can."),
    "mag_offset": dict(unit="T", length=3, doc="Hard iron, subtracted from every sample."),
    "mag_matrix": dict(
        length=9, doc="Soft iron, row by row; multiplies the sample after the offset."),
    "mag_delay": dict(
        unit="s", low=-0.1, high=0.1, doc="How late a magnetometer sample is stamped."),
    "mag_delay_sd": dict(
        unit="s", low=0.0, high=0.1,
        doc="Standard deviation of a magnetometer delay that is not given."),
}


def sensor(name: str, default: Any, doc: str = "", **changes: Any) -> Any:
    """The dataclass field of a parameter of :data:`SENSOR`.

    Args:
        name: key of SENSOR. default: the estimator's own.
        doc: a further sentence on what this estimator makes of it.
        changes: tighter bounds.
    """
    declared = SENSOR[name] | changes
    declared["doc"] = f"{declared['doc']} {doc}".strip()
    return param(default, **declared)
