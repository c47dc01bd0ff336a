"""Parameters of the orientation estimator, and the record of them that its kernels read."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.parameters.record import record
from imu_fusion.sensors.params import sensor

# Before there is a sample: one recording in ten is near iron; what is stated of the gyroscope, or
# that accelerations come and go, is given up where the samples are a thousand times likelier
# without it.
_LOG_ODDS_IRON, _LOG_ODDS_GIVEN_UP = math.log(0.1), math.log(0.001)
# Vehicles vibrate: by how much the gyroscope is noisier where accelerations last (a car: 3e-3).
_VIBRATION = 10.0
# Rotation from ENU to the world frame that is published, xyzw.
_WORLD_FRAMES = {
    "enu": (0.0, 0.0, 0.0, 1.0),
    "nwu": (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5)),
    "ned": (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
}


@dataclass(frozen=True)
class SensorParams(Parameters):
    """``sensor.*``: the defaults are those of a consumer's MEMS sensor, calibrated."""

    gyro_noise_density: float = sensor("gyro_noise_density", 3e-4)
    gyro_bias_sd: float = sensor("gyro_bias_sd", 0.01, "Counts where the start is not at rest.")
    gyro_bias_walk: float = sensor("gyro_bias_walk", 2e-5)
    gyro_scale_sd: float = sensor("gyro_scale_sd", 0.005, "With misalignments, nine states.")
    gyro_range: tuple[float, ...] | None = sensor("gyro_range", None)
    gyro_delay: float | None = sensor(
        "gyro_delay", None, "These sensors alone cannot tell; give it where an outside reference "
        "has. Unset: 0, give or take gyro_delay_sd.")
    gyro_delay_sd: float = sensor("gyro_delay_sd", 0.004, "It is part of the attitude's covariance "
                                  "while turning.")
    acc_noise_density: float = sensor("acc_noise_density", 2e-3, "Here only of the published "
                                      "force: what the filter adds is fusion.velocity_walk.")
    acc_bias_sd: float = sensor("acc_bias_sd", 0.05, "Raise it for a sensor that was never "
                                "calibrated (0.2).")
    axes_sd: float = sensor("axes_sd", 0.005, "It is part of the attitude's covariance.")
    mag_range: tuple[float, ...] | None = sensor("mag_range", None)
    mag_noise_sd: float = sensor("mag_noise_sd", 1e-6)
    mag_offset: tuple[float, ...] = sensor("mag_offset", (0.0, 0.0, 0.0))
    mag_matrix: tuple[float, ...] = sensor(
        "mag_matrix", (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    mag_delay: float | None = sensor(
        "mag_delay", None, "Unset: estimated, except by Winkler's method as printed, which takes "
        "that of the gyroscope.")
    mag_delay_sd: float = sensor("mag_delay_sd", 0.01, "The estimate is believed within three of "
                                 "these.")


@dataclass(frozen=True)
class AlignmentParams(Parameters):
    """``alignment.*``: the start."""

    start: float | None = param(
        None, unit="s", low=0.0,
        doc="Where the first interval begins, since the first Imu sample; samples before it are "
            "left out. Unset: with the first, or, where a recording is smoothed without "
            "fusion.use_acc and begins in motion, with the last rest before the most violent "
            "motion, which alone tells the tilt. Set it where a body is carried to where it lies.")
    duration: float = param(
        1.0, unit="s", low=0.05, high=60,
        doc="First interval, from which the orientation starts; rows come once it is over. "
            "Lengthen it for a sensor that lies still anyhow: the bias is better known then.")
    heading_anchor: str = param(
        "rest", choices=("rest", "field"),
        doc="rest: heading is what the magnetometer shows in the first interval; field: it follows "
            "the magnetometer's calibration as that becomes known. Choose field for an "
            "uncalibrated magnetometer in a field that is the same everywhere.")
    heading_sd_deg: float = param(
        1.0, unit="deg", low=0, high=180,
        doc="Uncertainty of the heading that the first interval shows, and of north where the "
            "heading follows the field. Raise it beside iron and in buildings.")
    yaw_offset_deg: float = param(
        0.0, unit="deg", low=-360, high=360,
        doc="Turns the orientation about the vertical, counter-clockwise from above: for a world "
            "whose x does not point east.")


@dataclass(frozen=True)
class GapParams(Parameters):
    """``gap.*``: Imu samples that are missing."""

    max: float = param(
        0.1, unit="s", low=1e-3,
        doc="A longer step between Imu samples is a gap: it is flagged, and what may have happened "
            "in it is added to the covariance. Raise it for sensors slower than 10 Hz.")
    restart: float = param(
        1.0, unit="s", low=1e-2,
        doc="After a longer one the attitude is anybody's guess: the estimator aligns anew. Raise "
            "it for a sensor that cannot turn unseen.")
    rate_sd: float = param(
        1.0, unit="rad/s", low=0,
        doc="Rate that may have gone unseen in a gap. Set it to what the body turns at.")


@dataclass(frozen=True)
class MagParams(Parameters):
    """``mag.*``: which magnetometer samples count, with either method."""

    max_latency: float = param(
        0.1, unit="s", low=0, high=10,
        doc="Samples that arrive later than this after an Imu sample of their time are dropped and "
            "counted; others are used at their own time. Raise it for a slow bus or a network.")
    reliability: float = param(
        5.0, low=0,
        doc="p of the weight (10) of Winkler 2025, which falls as the field's norm deviates: the "
            "weight of a sample in gyro_mag as printed; below a half a sample is flagged as "
            "disturbed by all. Lower it where norms deviate without harm.")


@dataclass(frozen=True)
class FusionParams(Parameters):
    """``fusion.*``: the error-state filter, with method gyro_mag without its accelerometer."""

    block: float = param(
        0.02, unit="s", low=1e-3, high=1,
        doc="Time between corrections, which cost most of the time. Raise it for slow bodies on "
            "slow computers, lower it for more than 20 rad/s.")
    use_acc: bool = param(
        True, doc="Whether the accelerometer is used after the start. False for impacts and free "
                  "fall, where it says nothing of gravity.")
    estimate_bias: bool = param(
        True, read_only=False,
        doc="Whether gyroscope bias and scale are estimated; false holds them, those of each "
            "hypothesis. Switch it off while a motion is known to mislead it.")
    velocity_walk: float = param(
        0.14, unit="m/s^2/sqrt(Hz)", low=0,
        doc="What the specific force does not tell of the motion. Raise it for vibration and "
            "impacts: gravity is then averaged over a longer time.")
    velocity_sd: float = param(
        0.6, unit="m/s", low=1e-3,
        doc="Velocity of the motion, per axis, about its mean. A hand's; 10 for a vehicle.")
    velocity_time: float = param(
        0.3, unit="s", low=1e-3, doc="Its correlation time. A hand's; 10 for a vehicle.")
    position_sd: float = param(
        0.6, unit="m", low=1e-3,
        doc="Extent of the motion, per axis, about its mean. A hand's; 100 for a vehicle.")
    position_time: float = param(
        0.3, unit="s", low=1e-3, doc="Its correlation time. A hand's; 10 for a vehicle.")
    local_field_sd: tuple[float, ...] = param(
        (0.01, 0.1), low=0, high=1, length=(1, 2),
        doc="What distinguishes the field of a place from its surroundings, relative to its norm. "
            "Two values are two hypotheses that the samples decide between; gyro_mag takes the "
            "first. Raise the second near iron.")
    gyro_factor: tuple[float, ...] = param(
        (1.0, 5.0), low=1e-3, high=1e3, length=(1, 2),
        doc="By how much sensor.gyro_bias_sd, sensor.gyro_bias_walk and sensor.gyro_scale_sd are "
            "larger than stated. Two values are two hypotheses, each with each of the local "
            "field; gyro_mag takes the first. Set it to 1 for a gyroscope that was calibrated.")
    lasting_acc_sd: float = param(
        1.0, unit="m/s^2", low=0, high=100,
        doc="Acceleration that lasts in the sensor's axes, as in turns of vehicles and walkers: "
            "one more hypothesis, after a start at rest, with the gyroscope as stated and near "
            "iron. Raise it for an aeroplane; 0: none.")
    local_field_time: float = param(
        0.3, unit="s", low=1e-3,
        doc="Time in which a moving sensor leaves that behind. Lengthen it for slow motion.")
    field_walk: float = param(
        1e-4, unit="1/sqrt(s)", low=0, high=1,
        doc="Drift of the field, relative to its norm. Raise it for a body that crosses terrain or "
            "carries currents.")
    mag_disturbance_sd: float = param(
        0.03, low=1e-4, high=1,
        doc="Disturbance of the field in motion, relative to its norm. Raise it near iron: the "
            "gyroscope then holds the heading for longer.")
    norm_deviation_factor: float = param(
        3.0, low=0,
        doc="That disturbance grows by this times the deviation of the norm. Lower it for a "
            "magnetometer whose norm deviates by poor calibration.")
    mag_offset_sd: float = param(
        0.03, low=0, high=1,
        doc="Hard iron left over by calibration, relative to the norm. Raise it for a magnetometer "
            "that was not calibrated.")
    mag_matrix_sd: float = param(
        0.02, low=0, high=1,
        doc="Soft iron and misalignment left over by calibration. Raise it likewise.")
    rest_rate: float = param(
        0.04, unit="rad/s", low=0,
        doc="Largest deviation of the rate from its mean at rest. Raise it for a noisy gyroscope.")
    rest_force: float = param(
        0.5, unit="m/s^2", low=0,
        doc="Largest deviation of the specific force from its mean at rest. Raise it for a noisy "
            "accelerometer or a running engine.")
    rest_time: float = param(
        0.5, unit="s", low=0,
        doc="Time after which rest counts. Lengthen it for motion with short pauses.")
    rest_rate_sd: float = param(
        0.006, unit="rad/s", low=1e-6,
        doc="Rate of a hand or table at rest. Lower it for a sensor that is bolted down.")
    angular_acc_sd: float = param(
        200.0, unit="rad/s^2", low=0,
        doc="Angular acceleration of an axis beyond its gyroscope's range (Singer 1970). Raise it "
            "for blows.")
    angular_acc_time: float = param(
        0.04, unit="s", low=1e-3,
        doc="Its correlation time: how long the slope that ran into the limit goes on. Shorten it "
            "for blows.")


@dataclass(frozen=True)
class GyroMagParams(Parameters):
    """``gyro_mag.*``: Winkler's method."""

    as_printed: bool = param(
        False, doc="True: Winkler 2025 as printed, to reproduce the paper. False: the same two "
                   "sensors in the error-state filter, with bias, scale and delay estimated.")
    field_sd: float = param(
        0.05, low=0, high=1,
        doc="As printed: wander of the local field, relative to its norm. It keeps the covariance "
            "from becoming smaller than the field allows; raise it near iron.")
    field_time: float = param(
        20.0, unit="s", low=1e-3,
        doc="As printed: time constant of that wander. Shorten it for fast motion between places.")


_MOTION = ("fusion.velocity_walk", "fusion.velocity_sd", "fusion.velocity_time",
           "fusion.position_sd", "fusion.position_time", "fusion.lasting_acc_sd")


@dataclass(frozen=True)
class OrientationParams(Parameters):
    """What the orientation estimator can be told."""

    OLD_NAMES: ClassVar[Mapping[str, str]] = {
        "yaw_offset_deg": "alignment.yaw_offset_deg", "heading_anchor": "alignment.heading_anchor",
        "heading_sd_deg": "alignment.heading_sd_deg", "alignment_duration": "alignment.duration",
        "max_gap": "gap.max", "restart_gap": "gap.restart", "gap_rate_sd": "gap.rate_sd",
        "max_mag_lag": "mag.max_latency", "mag_reliability": "mag.reliability",
        "field_sd": "gyro_mag.field_sd", "field_time": "gyro_mag.field_time",
        "estimate_bias": "fusion.estimate_bias' or, for Winkler's method as printed, "
                         "'gyro_mag.as_printed",
        "mag_sd": "fusion.mag_disturbance_sd", "surge_sd": "fusion.angular_acc_sd",
        "surge_time": "fusion.angular_acc_time",
        **{name: f"sensor.{name}" for name in (
            "gyro_noise_density", "gyro_bias_sd", "gyro_bias_walk", "gyro_range", "gyro_delay",
            "gyro_delay_sd", "gyro_scale_sd", "acc_noise_density", "acc_bias_sd", "axes_sd",
            "mag_range", "mag_noise_sd", "mag_offset", "mag_matrix", "mag_delay", "mag_delay_sd")},
        **{name: f"fusion.{name}" for name in (
            "block", "use_acc", "velocity_walk", "velocity_sd", "velocity_time", "position_sd",
            "position_time", "local_field_sd", "local_field_time", "field_walk",
            "norm_deviation_factor", "mag_offset_sd", "mag_matrix_sd", "rest_rate", "rest_force",
            "rest_time", "rest_rate_sd")},
    }

    method: str = param(
        "fusion", choices=("fusion", "gyro_mag"),
        doc="fusion: error-state filter over all three sensors; gyro_mag: gyroscope and "
            "magnetometer alone after the start, for motion whose specific force says nothing of "
            "gravity, and with gyro_mag.as_printed Winkler 2025.")
    mode: str = param(
        "causal", choices=("causal", "smoothed"),
        doc="smoothed: run() on a whole recording also looks ahead (fusion only). For recordings, "
            "whenever nothing has to come live.")
    lag: float | None = param(
        None, unit="s", low=0.01, high=10,
        doc="Rows come once more, corrected by what is seen one to two times this later (fusion, "
            "causal). Set it to solve bursts beyond the gyroscope's range live; unset: they come "
            "once.")
    world_frame: str = param(
        "enu", choices=("enu", "ned", "nwu"),
        doc="World axes of the published orientation. Change it for consumers of other axes.")
    declination_deg: float | None = param(
        None, unit="deg", low=-180, high=180,
        doc="Magnetic declination, positive east. Set it to refer to true north; unset: a field "
            "model's at the first fix, without one north is magnetic north.")
    sensor: SensorParams = SensorParams()
    alignment: AlignmentParams = AlignmentParams()
    gap: GapParams = GapParams()
    mag: MagParams = MagParams()
    fusion: FusionParams = FusionParams()
    gyro_mag: GyroMagParams = GyroMagParams()

    def idle(self) -> dict[str, str]:
        idle: dict[str, str] = {}

        def add(why: str, *names: str) -> None:
            idle.update((name, why) for name in names if name not in idle)

        if self.method == "fusion":
            add("with method 'fusion'", "gyro_mag.")
        else:
            add("with method 'gyro_mag'", "mode", "lag", "fusion.use_acc", "fusion.rest_force",
                *_MOTION)
            if self.gyro_mag.as_printed:
                add("with gyro_mag.as_printed", "fusion.", "sensor.gyro_scale_sd",
                    "sensor.mag_delay_sd", "alignment.heading_anchor", "alignment.heading_sd_deg")
            else:
                add("without gyro_mag.as_printed", "gyro_mag.field_sd", "gyro_mag.field_time")
        if self.mode == "smoothed":
            add("with mode 'smoothed'", "lag")
        if not self.fusion.use_acc:
            add("without fusion.use_acc", *_MOTION)
        if self.sensor.gyro_delay is not None:
            add("with sensor.gyro_delay given", "sensor.gyro_delay_sd")
        if self.sensor.mag_delay is not None:
            add("with sensor.mag_delay given", "sensor.mag_delay_sd")
        return idle

    @property
    def is_as_printed(self) -> bool:
        """Whether Winkler's method runs as printed instead of the error-state filter."""
        return self.method == "gyro_mag" and self.gyro_mag.as_printed


def kernel_parameters(params: OrientationParams) -> np.ndarray:
    """Parameters as the kernels read them: a structured array, an element for each hypothesis.

    Those that differ without a magnetometer come first: of the gyroscope, all with the first one of
    the field, and of lasting acceleration. Beside the parameters under their names it has, at the
    top level, what follows from them: log_prior, local_field_sd, gyro_factor and lasting_acc_sd of
    the hypothesis, how many differ without_field, gyro_delay,
    gyro_delay_sd, mag_delay_sd (s; zero where a delay is taken as known), declination, heading_sd
    (rad), frame_from_enu (4,), use_acc and rest_force (m/s^2; with gyro_mag neither the filter nor
    its rest detector looks at the accelerometer), follows_field, as_printed; seeks_iron: the filter
    looks for hard iron, which is the same under all hypotheses, and smoothed is looked for before.
    """
    f = params.fusion
    fields, factors = f.local_field_sd, f.gyro_factor
    if params.method != "fusion":
        return _hypothesis(params, fields[0], factors[0], 0.0, 1)
    first = [(fields[0], factor, 0.0) for factor in factors]
    if f.use_acc and f.lasting_acc_sd > 0.0:
        first.append((fields[-1], factors[0], f.lasting_acc_sd))
    rest = [(field, factor, 0.0) for field in fields[1:] for factor in factors]
    out = np.concatenate([_hypothesis(params, *each, len(first)) for each in first + rest])
    out["seeks_iron"][1:] = False
    return out


def _hypothesis(params: OrientationParams, local_field_sd: float, gyro_factor: float,
                lasting_acc_sd: float, without_field: int) -> np.ndarray:
    s, f = params.sensor, params.fusion
    log_prior = (_LOG_ODDS_GIVEN_UP if lasting_acc_sd > 0.0 else
                 _LOG_ODDS_IRON * (local_field_sd != f.local_field_sd[0])
                 + _LOG_ODDS_GIVEN_UP * (gyro_factor != f.gyro_factor[0]))
    noise = _VIBRATION if lasting_acc_sd > 0.0 else 1.0
    params = replace(params, sensor=replace(
        s, gyro_noise_density=noise * s.gyro_noise_density,
        gyro_bias_sd=gyro_factor * s.gyro_bias_sd,
        gyro_bias_walk=gyro_factor * s.gyro_bias_walk, gyro_scale_sd=gyro_factor * s.gyro_scale_sd))
    with_acc = params.method == "fusion"
    return record(
        params,
        log_prior=log_prior,
        without_field=without_field,
        local_field_sd=local_field_sd,
        gyro_factor=gyro_factor,
        lasting_acc_sd=lasting_acc_sd,
        gyro_delay=s.gyro_delay or 0.0,
        gyro_delay_sd=s.gyro_delay_sd if s.gyro_delay is None else 0.0,
        mag_delay_sd=s.mag_delay_sd if s.mag_delay is None else 0.0,
        declination=math.radians(params.declination_deg or 0.0),
        heading_sd=math.radians(params.alignment.heading_sd_deg),
        frame_from_enu=_WORLD_FRAMES[params.world_frame],
        use_acc=with_acc and params.fusion.use_acc,
        rest_force=params.fusion.rest_force if with_acc else math.inf,
        seeks_iron=params.mode == "causal",
        follows_field=params.alignment.heading_anchor == "field",
        as_printed=params.is_as_printed)
