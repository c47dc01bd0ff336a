"""Parameters of the smoother, in groups."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.sensors.params import sensor

_LOSSES = ("cauchy", "squared")


def _loss(of: str) -> str:
    return param("cauchy", choices=_LOSSES, doc=(
        f"How {of} far from the trajectory count. cauchy: as Student's t has it, so that outliers "
        "pull little; squared: as normal errors, for data known to be free of outliers."))


def _loss_scale() -> float:
    return param(6.0, low=0.1, high=1e3, doc=(
        "Deviation at which the Cauchy loss lets go, in standard deviations. Lower it where many "
        "readings are outliers."))


@dataclass(frozen=True)
class Sensor(Parameters):
    """Noise and errors of the Imu and the magnetometer. Defaults: tables 3 to 5 of Fang et al.
    2020 (a phone)."""

    gyro_noise_density: float = sensor("gyro_noise_density", 1.75e-3)
    gyro_bias_sd: float = sensor("gyro_bias_sd", 0.0873, low=1e-6)
    gyro_bias_walk: float = sensor(
        "gyro_bias_walk", 0.0, "0: it stands still; raise it for recordings of many minutes.")
    gyro_scale_sd: float = sensor("gyro_scale_sd", 0.0)
    gyro_range: tuple[float, ...] | None = sensor(
        "gyro_range", None, "Rates beyond it are recovered from the smoothed motion.")
    acc_noise_density: float = sensor(
        "acc_noise_density", 1e-2, "Raise it where the sensor is shaken.")
    acc_bias_sd: float = sensor("acc_bias_sd", 0.2, low=1e-6)
    acc_bias_walk: float = sensor(
        "acc_bias_walk", 0.0, "0: it stands still; raise it for recordings of many minutes.")
    acc_matrix_sd: float = sensor("acc_matrix_sd", 0.0)
    acc_range: tuple[float, ...] | None = sensor(
        "acc_range", None, "Found where the largest readings repeat exactly. Forces beyond it are "
        "recovered from the smoothed motion.")
    mag_noise_sd: float = sensor(
        "mag_noise_sd", 5e-6, "Raise it beside motors: an error that n samples in a row repeat "
        "counts as sqrt(n) times as large.")
    mag_offset: tuple[float, ...] = sensor("mag_offset", (0.0, 0.0, 0.0))
    mag_matrix: tuple[float, ...] = sensor(
        "mag_matrix", (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    mag_bias_sd: float = sensor("mag_bias_sd", 5e-6)
    mag_scale_sd: float = sensor("mag_scale_sd", 0.1)
    mag_axes_sd: float = sensor("mag_axes_sd", 0.0)


@dataclass(frozen=True)
class Gap(Parameters):
    """What is assumed of the motion where the Imu says nothing."""

    max: float = param(
        0.1, unit="s", low=1e-3, doc="Longest step between Imu samples that counts as sampled (or "
        "1.5 times the usual one, if longer); longer ones are bridged. Raise it for slow sensors "
        "that drop samples.")
    gyro_noise_density: float = param(
        0.1, unit="rad/s/sqrt(Hz)", low=1e-3, doc="Noise of the rate where it was clipped or not "
        "recorded. Raise it for motion wilder than a ski jumper's.")
    acc_noise_density: float = param(
        2.0, unit="m/s^2/sqrt(Hz)", low=1e-3, doc="Noise of the specific force where it was "
        "clipped or not recorded. Raise it for impacts beyond the range.")


@dataclass(frozen=True)
class Gnss(Parameters):
    """Fixes and velocities of a receiver. Three numbers are east, north, up. Defaults: table 5 of
    Fang et al. 2020 (a logger)."""

    fix_sd: tuple[float, ...] = param(
        (3.0, 3.0, 5.0), unit="m", low=1e-4, length=3, doc="Standard deviation of a position. "
        "Counts where a fix carries no covariance, or with covariances: false.")
    velocity_sd: tuple[float, ...] = param(
        (0.1, 0.1, 0.3), unit="m/s", low=1e-4, length=3, doc="Standard deviation of a velocity, "
        "where it carries no covariance, or with covariances: false.")
    covariances: bool = param(
        True, doc="Whether to believe the covariances that fixes and velocities carry; false where "
        "a receiver states more than it keeps.")
    loss: str = _loss("fixes and velocities")
    loss_scale: float = _loss_scale()
    position_error_sd: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="m", low=0.0, length=3, doc="Wandering (Gauss-Markov) error of the "
        "position, as states; 0: white errors only. Set it for GNSS without RTK: multipath and "
        "atmosphere do not average out.")
    position_error_tau: float = param(
        30.0, unit="s", low=0.1, doc="Correlation time of the wandering position error.")
    velocity_error_sd: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="m/s", low=0.0, length=3, doc="Wandering (Gauss-Markov) error of the "
        "velocity, as states; 0: white errors only. Set it where the innovations of velocities "
        "are correlated: receivers filter them.")
    velocity_error_tau: float = param(
        1.0, unit="s", low=0.01, doc="Correlation time of the wandering velocity error.")
    even_stamps: bool = param(
        False, doc="Whether to put stamps back on an even rate; true where a logger stamps fixes "
        "as they arrive, so that they jitter.")
    min_interval: float = param(
        0.0, unit="s", low=0.0, doc="Fixes and velocities that follow the last one used by less "
        "are left out; 0: all are used. Raise it where neighbours repeat each other's errors.")
    time_offset_sd: float = param(
        0.0, unit="s", low=0.0, high=2.0, doc="Standard deviation of the delay of all GNSS stamps, "
        "as a state; 0: none. 0.2 finds that of most loggers, if the motion changes its speed.")
    velocity_time_offset_sd: float = param(
        0.0, unit="s", low=0.0, high=2.0, doc="Standard deviation of a further delay of velocities "
        "alone, as a state; 0: none. For receivers that difference positions: half a period.")
    lever_arm: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="m", length=3, doc="Antenna in the imu frame.")
    lever_arm_sd: float = param(
        0.0, unit="m", low=0.0, doc="Standard deviation of each component of lever_arm, as states; "
        "0: as given. Set it where it was not measured, and the body turns.")


@dataclass(frozen=True)
class Mag(Parameters):
    """How magnetometer samples count; their errors are among those of the sensor."""

    loss: str = _loss("magnetometer samples")
    loss_scale: float = _loss_scale()


@dataclass(frozen=True)
class AtRest(Parameters):
    """What is known of a body at rest."""

    found: bool = param(
        False, doc="Whether the velocity is zero where the Imu shows nothing but its noise, "
        "gravity and its bias, unless the receiver says that the body moves. true for a body that "
        "lies still at times and never rides as smoothly: a ball in an avalanche.")
    shortest: float = param(
        1.0, unit="s", low=1.0, doc="Time for which it has to rest.")
    velocity_sd: float = param(
        0.01, unit="m/s", low=1e-5, doc="Standard deviation of the velocity at rest, anew every "
        "tenth of a second.")


@dataclass(frozen=True)
class SurfaceContact(Parameters):
    """How the body is held on a surface."""

    body_height: float = param(
        0.0, unit="m", doc="Height above the surface of the sensor, or of the point at lever_arm.")
    body_height_sd: float = param(
        0.0, unit="m", low=0.0, doc="Standard deviation of body_height, as a state; 0: as given. "
        "Set it with fixes good to decimetres, which alone can tell.")
    lever_arm: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="m", length=3, doc="Point that is held on the surface (skis, wheels) "
        "in the imu frame, on the same rigid body as the sensor.")
    lever_arm_sd: float = param(
        0.0, unit="m", low=0.0, doc="Standard deviation of each component of lever_arm, as states; "
        "0: as given.")
    interval: float = param(
        0.01, unit="s", low=1e-4, high=100.0, doc="Time after which a deviation from the surface "
        "counts as a new one: sigma is that of rows so far apart, and what they say per second "
        "does not depend on the rate of the Imu. Raise it for deviations that last: a weaker "
        "surface.")
    windows: tuple[float, ...] = param(
        (), unit="s", low=0.0, doc="Times since the first Imu sample in which the surface holds, "
        "start and stop of each window in turn; empty: always (hills: before take-off and after "
        "touch-down).")


@dataclass(frozen=True)
class Jump(Parameters):
    """Take-off and touch-down, where the surface is a hill."""

    takeoff: float | None = param(
        None, unit="s", low=0.0, doc="Take-off, since the first Imu sample; unset: detected. "
        "Refined in either case. Give it where the detection takes another bump.")
    touchdown: float | None = param(
        None, unit="s", low=0.0, doc="Touch-down, since the first Imu sample; unset: detected. "
        "Refined in either case.")
    event_margin: float = param(
        0.3, unit="s", low=0.0, doc="Time before take-off and after touch-down in which the height "
        "above the profile is free: jumpers push off and sink.")


@dataclass(frozen=True)
class Initial(Parameters):
    """How far the first state may be from what is taken from the data. Smaller values claim to
    know it: a first attitude (Smoother.run), a body at rest."""

    start: float | None = param(
        None, unit="s", low=0.0, doc="Where to begin, since the first Imu sample; samples before "
        "it are left out, and other times count from there. Unset: with the first, or, where "
        "speed_sd says that the body is at rest then and it is not, with the last rest before the "
        "most violent motion.")
    attitude_sd: float = param(
        0.5, unit="rad", low=1e-3, high=3.2, doc="Standard deviation of the first attitude.")
    position: tuple[float, ...] | None = param(
        None, length=3, doc="Latitude, longitude (degrees) and ellipsoidal height (m) of the first "
        "sample; unset: the first fix. With it no fix is needed; set position_sd beside it.")
    position_sd: float = param(
        100.0, unit="m", low=1e-2, doc="Standard deviation of the first position, about the first "
        "fix or the position given.")
    speed_sd: float = param(
        30.0, unit="m/s", low=1e-3, doc="Standard deviation of the first velocity, about the first "
        "GNSS velocity or zero. Lower it for slow bodies without GNSS velocities.")


@dataclass(frozen=True)
class Iteration(Parameters):
    """When the iterated smoother ends."""

    max: int = param(25, low=1, high=200, doc="Most Gauss-Newton steps from one first attitude.")
    tolerance: float = param(
        1e-3, low=1e-9, doc="Converged when no position (m), velocity (m/s) and attitude (rad) "
        "moves by more.")
    cost_tolerance: float = param(
        0.05, low=0.0, doc="Converged as well when the cost (half a sum of squared standard "
        "deviations) changes by less. Lower it to compare costs.")


#: Groups and parameters that the paper's method has from its tables 3 and 5, or does not know.
#: Prefixes end in a dot.
_NOT_IN_THE_PAPER = (
    "maximum_likelihood",
    "sensor.gyro_bias_sd", "sensor.gyro_bias_walk", "sensor.gyro_scale_sd", "sensor.acc_bias_sd",
    "sensor.acc_bias_walk", "sensor.acc_matrix_sd", "sensor.mag_noise_sd", "sensor.mag_offset",
    "sensor.mag_matrix", "sensor.mag_bias_sd",
    "sensor.mag_scale_sd", "sensor.mag_axes_sd", "gnss.fix_sd", "gnss.velocity_sd",
    "gnss.covariances", "gnss.loss", "gnss.loss_scale", "gnss.position_error_sd",
    "gnss.position_error_tau",
    "gnss.velocity_error_sd", "gnss.velocity_error_tau", "gnss.time_offset_sd",
    "gnss.velocity_time_offset_sd", "gnss.lever_arm", "gnss.lever_arm_sd", "mag.",
    "surface.body_height", "surface.body_height_sd", "surface.lever_arm", "surface.lever_arm_sd",
    "surface.interval", "rest.", "jump.event_margin", "initial.", "iteration.")


@dataclass(frozen=True)
class SmootherParams(Parameters):
    """Noise, priors, optional states and the iteration. A prior of zero leaves an optional
    state out."""

    OLD_NAMES: ClassVar[Mapping[str, str]] = {
        **{name: f"sensor.{name}" for name in (
            "gyro_noise_density", "acc_noise_density", "gyro_bias_sd", "acc_bias_sd",
            "gyro_bias_walk", "acc_bias_walk", "gyro_scale_sd", "acc_matrix_sd", "gyro_range",
            "acc_range", "mag_bias_sd", "mag_scale_sd")},
        "mag_sd": "sensor.mag_noise_sd",
        "max_gap": "gap.max", "unknown_gyro_density": "gap.gyro_noise_density",
        "unknown_acc_density": "gap.acc_noise_density",
        "fix_sd": "gnss.fix_sd", "velocity_sd": "gnss.velocity_sd",
        "fix_loss_scale": "gnss.loss_scale", "mag_loss_scale": "mag.loss_scale",
        "velocity_time_offset_sd": "gnss.velocity_time_offset_sd",
        **{f"gnss_{name}": f"gnss.{name}" for name in (
            "covariances", "position_error_sd", "position_error_tau", "velocity_error_sd",
            "velocity_error_tau", "even_stamps", "min_interval", "time_offset_sd", "lever_arm",
            "lever_arm_sd")},
        **{f"surface_{name}": f"surface.{name}" for name in (
            "lever_arm", "lever_arm_sd", "interval", "windows")},
        "body_height": "surface.body_height", "body_height_sd": "surface.body_height_sd",
        "takeoff": "jump.takeoff", "touchdown": "jump.touchdown",
        "event_margin": "jump.event_margin", "attitude_sd": "initial.attitude_sd",
        "position_sd": "initial.position_sd", "speed_sd": "initial.speed_sd",
        "max_iterations": "iteration.max", "tolerance": "iteration.tolerance",
        "cost_tolerance": "iteration.cost_tolerance"}

    method: str = param(
        "iterated", choices=("iterated", "extended_rts"), doc="iterated: Gauss-Newton over the "
        "whole recording; extended_rts: the single pass of Fang et al. 2020 as published, for "
        "comparison with the paper.")
    gravity: float | None = param(
        None, unit="m/s^2", low=9.5, high=10.0,
        doc="Gravity at the origin; unset: that of WGS84 at the first fix or the surface's origin. "
            "Set it where it was measured.")
    magnetic_field: tuple[float, ...] | None = param(
        None, unit="T", length=3, doc="Magnetic field east, north, up; unset: that of the World "
        "Magnetic Model at the origin and the first stamp. Set it where iron bends the field of "
        "the whole site.")
    maximum_likelihood: str = param(
        "misfit", choices=("off", "misfit"), doc="misfit: where innovations are not white or "
        "larger than stated, delays, walks of biases, wandering errors of the receiver and the "
        "noise of all are fitted to the recording, and a remark names what was taken; off: never.")
    sensor: Sensor = Sensor()
    gap: Gap = Gap()
    gnss: Gnss = Gnss()
    mag: Mag = Mag()
    rest: AtRest = AtRest()
    surface: SurfaceContact = SurfaceContact()
    jump: Jump = Jump()
    initial: Initial = Initial()
    iteration: Iteration = Iteration()

    def __post_init__(self) -> None:
        super().__post_init__()
        windows, jump = self.surface.windows, self.jump
        if len(windows) % 2 or any(b <= a for a, b in zip(windows, windows[1:])):
            raise ParameterError(f"parameter 'surface.windows': {list(windows)} s are not pairs of "
                                 "start and stop that ascend")
        if (jump.takeoff is not None and jump.touchdown is not None
                and jump.touchdown <= jump.takeoff):
            raise ParameterError(f"parameter 'jump.touchdown': {jump.touchdown:g} s is not after "
                                 f"the take-off at {jump.takeoff:g} s")

    def idle(self) -> dict[str, str]:
        if self.method == "extended_rts":
            return dict.fromkeys(_NOT_IN_THE_PAPER, "with method 'extended_rts'")
        idle = {} if self.rest.found else dict.fromkeys(
            ("rest.shortest", "rest.velocity_sd"), "without rest.found")
        for group, of in (("gnss", self.gnss), ("mag", self.mag)):
            if of.loss == "squared":
                idle[f"{group}.loss_scale"] = f"with {group}.loss 'squared'"
        for what, sd in (("position", self.gnss.position_error_sd),
                         ("velocity", self.gnss.velocity_error_sd)):
            if not any(sd):
                idle[f"gnss.{what}_error_tau"] = f"without gnss.{what}_error_sd"
        return idle
