"""Parameters of the acceleration field estimator, in groups."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from imu_fusion.errors import LayoutError, ParameterError
from imu_fusion.parameters.declare import Parameters, flatten, param
from imu_fusion.sensors.params import sensor

AXIS_NAMES = ("x", "y", "z")


@dataclass(frozen=True)
class Sensor(Parameters):
    """``sensor.*``: the gyroscope, and what holds of every accelerometer that does not say
    otherwise below ``accelerometers.<name>``."""

    acc_noise_density: float = sensor(
        "acc_noise_density", 1e-3, "The sd of one sample is this times sqrt(sample_rate).")
    acc_range: tuple[float, ...] | None = sensor(
        "acc_range", None, "A reading of this magnitude or more is saturated and not used.")
    acc_bias_sd: float = sensor("acc_bias_sd", 0.2)
    acc_bias_walk: float = sensor("acc_bias_walk", 0.0)
    acc_position_sd: float = sensor(
        "acc_position_sd", 1e-3, "A ruler gives a millimetre; give 0 for a simulation, less for a "
        "printed circuit.")
    acc_axes_sd: float = sensor(
        "acc_axes_sd", 0.035, "Two degrees are what glue and a headform leave; give 0 for a "
        "simulation, less after a calibration.")
    acc_scale_sd: float = sensor(
        "acc_scale_sd", 0.01, "A percent is what data sheets leave; give 0 for a simulation, less "
        "after a calibration.")
    gyro_axes: tuple[float, ...] = sensor(
        "gyro_axes", (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    gyro_axes_sd: float = sensor("gyro_axes_sd", 0.035)
    gyro_scale_sd: float = sensor("gyro_scale_sd", 0.01)
    gyro_noise_density: float = sensor("gyro_noise_density", 1e-3)
    gyro_range: tuple[float, ...] | None = sensor(
        "gyro_range", None, "A rate of this magnitude or more is clipped and not used: the "
        "accelerometers fill in.")
    gyro_bias_sd: float = sensor("gyro_bias_sd", 0.02)
    gyro_bias_walk: float = sensor("gyro_bias_walk", 0.0)


@dataclass(frozen=True)
class Accelerometers(Parameters):
    """``accelerometers.*`` beside the accelerometers themselves."""

    names: tuple[str, ...] = param(
        (), doc="Names of the accelerometers: each has the topic accelerometers/<name> and is "
                "described below accelerometers.<name>.")


@dataclass(frozen=True)
class AccelerometerParams(Parameters):
    """One accelerometer; in files and ROS below ``accelerometers.<name>.``"""

    position: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="m", length=3,
        doc="Position in body coordinates. Errors act like errors of the readings, in proportion "
            "to angular acceleration and rate squared; position_sd says how large they may be.")
    axes: tuple[float, ...] = param(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), length=9, low=-1, high=1,
        doc="Sensor axes in body coordinates, row by row; orthonormal, either handedness.")
    measured_axes: tuple[str, ...] = param(
        AXIS_NAMES, choices=AXIS_NAMES,
        doc="Sensor axes that are measured. Leave out those that the sensor does not have.")
    reports: str = param(
        "specific_force", choices=("specific_force", "acceleration"),
        doc="Specific force, as real accelerometers do, or coordinate acceleration, as "
            "simulations may. The same for all accelerometers.")
    noise_density: float | None = param(
        None, unit="m/s^2/sqrt(Hz)", low=1e-9, high=10.0,
        doc="White noise; unset: sensor.acc_noise_density. Give it where sensors differ.")
    range: tuple[float, ...] | None = param(
        None, unit="m/s^2", low=1e-3, length=(1, 3),
        doc="Readings of this magnitude or more are saturated and not used, one value or one per "
            "axis; unset: sensor.acc_range.")
    bias_sd: float | None = param(
        None, unit="m/s^2", low=0.0, high=10.0,
        doc="Standard deviation of the constant bias of each axis; unset: sensor.acc_bias_sd.")
    bias_walk: float | None = param(
        None, unit="m/s^2/sqrt(s)", low=0.0, high=10.0,
        doc="Random walk of the bias of each axis; unset: sensor.acc_bias_walk.")
    position_sd: float | None = param(
        None, unit="m", low=0.0, high=0.1,
        doc="Standard deviation of each coordinate of position; unset: sensor.acc_position_sd.")
    axes_sd: float | None = param(
        None, unit="rad", low=0.0, high=0.5,
        doc="Standard deviation of a turn of axes about each of them; unset: sensor.acc_axes_sd.")
    scale_sd: float | None = param(
        None, low=0.0, high=0.5,
        doc="Standard deviation of the scale error of each axis; unset: sensor.acc_scale_sd.")

    def completed(self, common: Sensor) -> "AccelerometerParams":
        """With what is unset from the parameters of all."""
        own = {name: getattr(common, f"acc_{name}")
               for name in ("noise_density", "range", "bias_sd", "bias_walk", "position_sd",
                            "axes_sd", "scale_sd")
               if getattr(self, name) is None}
        return self.replace(**own)


@dataclass(frozen=True)
class Initial(Parameters):
    """``initial.*``: what is known of the body at the first sample."""

    mode: str = param(
        "rest", choices=("rest", "given"),
        doc="rest: wait until the body is still, and find tilt and biases from that; given: "
            "orientation and angular velocity as below, for recordings that begin in motion.")
    duration: float = param(
        0.5, unit="s", low=1e-3,
        doc="rest: how long the body must be still. Longer gives better biases; the recording "
            "must have it.")
    still_sd: float = param(
        0.3, unit="m/s^2", low=1e-6,
        doc="rest: largest standard deviation of a still accelerometer beyond its noise. Raise it "
            "for a body that trembles.")
    orientation: tuple[float, ...] = param(
        (0.0, 0.0, 0.0, 1.0), length=4,
        doc="Orientation of the body in the world, x y z w; rest takes only its heading. Change it "
            "to name the world's axes.")
    orientation_sd: float = param(
        0.0, unit="rad", low=0.0,
        doc="given: standard deviation of the orientation, each axis. At 0 it names the world, and "
            "later errors are relative to it.")
    angular_velocity: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="rad/s", length=3, doc="given: angular velocity, body axes.")
    angular_velocity_sd: float = param(
        0.01, unit="rad/s", low=0.0,
        doc="Standard deviation of the initial angular velocity, each axis; rest: how much a still "
            "gyroscope may vary beyond its noise. Raise it for a guess.")


@dataclass(frozen=True)
class Motion(Parameters):
    """``motion.*``: how fast accelerations change, method rigid_body."""

    jerk_density: float = param(
        5e4, unit="rad/s^3/sqrt(s)", low=1e-12,
        doc="White noise that drives the rate of the angular acceleration. Raise it if impacts "
            "come out rounded, lower it if the estimate is noisy, or use maximum_likelihood.")
    rate: float = param(
        0.0, unit="1/s", low=0.0,
        doc="How fast the angular acceleration forgets itself (Matern process); at 0 it keeps its "
            "value (integrated Wiener process). Set it for motions that last, such as a hand's.")
    acceleration_rate_density: float = param(
        3e3, unit="m/s^3/sqrt(s)", low=1e-12,
        doc="White noise that drives the rate of the linear acceleration. As jerk_density.")


@dataclass(frozen=True)
class Gap(Parameters):
    """``gap.*``: samples that are missing altogether."""

    max: float = param(
        0.1, unit="s", low=1e-6,
        doc="Across longer intervals nothing is integrated: rate and attitude are held, with an "
            "uncertainty that says so. Raise it for slow sampling.")


@dataclass(frozen=True)
class Iteration(Parameters):
    """``iteration.*``: Gauss-Newton of mode smoothed."""

    max: int = param(
        4, low=1, high=100,
        doc="Most iterations of the smoother. Raise it if the body turns fast between samples.")


@dataclass(frozen=True)
class AccelerationFieldParams(Parameters):
    """Parameters of the estimator, apart from the single accelerometers."""

    OLD_NAMES: ClassVar[Mapping[str, str]] = {
        "max_gap": "gap.max", "smoother.iterations": "iteration.max",
        **{f"gyroscope.{name}": f"sensor.gyro_{name}"
           for name in ("axes", "noise_density", "range", "bias_sd", "bias_walk")}}

    method: str = param(
        "rigid_body", choices=("rigid_body", "ao", "sqrt_ao"),
        doc="rigid_body: estimator on the rigid-body model, for any array of three or more; ao and "
            "sqrt_ao: the algorithms of Rahaman 2019 and Wan 2022, for comparison with them.")
    mode: str = param(
        "causal", choices=("causal", "smoothed"),
        doc="causal, or smoothed over the whole recording: better, and only at its end.")
    sample_rate: float = param(
        1000.0, unit="Hz", low=1e-3,
        doc="Rate of the readings, turns noise densities into the noise of a sample. Set it to "
            "that of the recording.")
    points: tuple[float, ...] = param(
        (), unit="m", doc="Query points x y z in body coordinates, one after another: where the "
                          "field is published and impacts are measured.")
    use_gyro: bool = param(
        False, doc="Whether the rates of a gyroscope on the body are used too (method rigid_body). "
                   "Set it if there is one: with it three accelerometers hold for long.")
    integration: str = param(
        "paper", choices=("paper", "high_order"),
        doc="ao and sqrt_ao: trapezoid and Lie-Stoermer-Verlet as published, or third and fourth "
            "order.")
    noise_scale: float = param(
        1.0, low=1e-6,
        doc="rigid_body: factor on all noise densities, for errors of the model such as flexing. "
            "Raise it if residual_rms stays above one.")
    maximum_likelihood: str = param(
        "off", choices=("off", "motion", "motion_and_noise"),
        doc="Mode smoothed: fit motion.* (and noise_scale) to the recording first. Use it on a "
            "motion of which nothing is known.")
    max_condition: float = param(
        1e3, low=1.0,
        doc="An array whose fit has a larger condition number is refused. Raise it to use a flat "
            "array all the same.")
    gravity: float = param(
        9.80665, unit="m/s^2", low=0.0, doc="Gravity at the place. 0 for simulations without.")
    sensor: Sensor = Sensor()
    accelerometers: Accelerometers = Accelerometers()
    initial: Initial = Initial()
    motion: Motion = Motion()
    gap: Gap = Gap()
    iteration: Iteration = Iteration()

    def idle(self) -> dict[str, str]:
        idle: dict[str, str] = {}
        if self.method != "rigid_body":
            why = f"with method '{self.method}' (rigid_body has it)"
            idle |= dict.fromkeys(
                ("mode", "use_gyro", "noise_scale", "motion.", "sensor.acc_bias_walk"), why)
        else:
            idle["integration"] = "with method 'rigid_body'"
        if self.mode == "causal":
            idle |= dict.fromkeys(("maximum_likelihood", "iteration."), "with mode 'causal'")
        if not self.use_gyro:
            idle |= {f"sensor.{info.name}": "without a gyroscope (use_gyro: true)"
                     for info in Sensor.infos() if info.name.startswith("gyro_")}
        unused = (("duration", "still_sd") if self.initial.mode == "given"
                  else ("orientation_sd", "angular_velocity"))
        return idle | {f"initial.{name}": f"with initial.mode '{self.initial.mode}'"
                       for name in unused}


def parse_configuration(values: Mapping[str, Any], source: str = "") -> tuple[
        AccelerationFieldParams, dict[str, AccelerometerParams]]:
    """Parameters of the estimator and of its accelerometers from a mapping, nested or dotted.

    Raises:
        ParameterError, LayoutError: with the name of what is wrong.
    """
    flat = flatten(values)
    names = flat.get("accelerometers.names", ())
    groups = [f"accelerometers.{name}." for name in names]
    params = AccelerationFieldParams.from_mapping(flat, source, ignore=groups)
    sensors = {name: AccelerometerParams.from_mapping(
        {k[len(group):]: v for k, v in flat.items() if k.startswith(group)},
        source=(source + ": " if source else "") + group[:-1])
        for name, group in zip(names, groups)}
    if len(sensors) < len(names):
        raise LayoutError(f"accelerometers.names {list(names)} names one accelerometer twice")
    idle = params.idle().get("sensor.acc_bias_walk")
    for name, own in sensors.items():
        if idle and own.bias_walk:
            raise ParameterError(f"parameter 'accelerometers.{name}.bias_walk': does nothing "
                                 f"{idle}; leave it out")
    return params, sensors
