"""The whole method of Winkler 2025 on a recording: sections 4 and 5 in order."""

import math
from dataclasses import dataclass, replace

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.avalanche.dead_reckoning import BallSamples, Track, dead_reckon
from imu_fusion.estimation.avalanche.field_check import FieldCheck, check_field
from imu_fusion.estimation.avalanche.in_situ import (
    Constraint,
    InSituCalibration,
    calibrate_in_situ,
)
from imu_fusion.estimation.avalanche.slope import fall_line, slope_axes
from imu_fusion.estimation.orientation.estimator import OrientationEstimator
from imu_fusion.estimation.orientation.gyro_limit import ranges_of
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.flat_tops import BAND
from imu_fusion.samples.logs import ImuLog, MagLog, seconds
from imu_fusion.samples.motion_span import MotionSpan, find_motion
from imu_fusion.sensors.magnetometer_calibration import MagCalibration, calibrate_magnetometer
from imu_fusion.sensors.saturation import recover_rates, saturated_axes
from imu_fusion.surfaces.constraint import Surface

_FASTEST = 100.0   # rad/s: no ball turns faster
_GAP = 3.0   # usual steps: a longer one cannot be integrated over


@dataclass(frozen=True)
class TrackParams(Parameters):
    """The ball and the method. Defaults: the paper's."""

    lever_arm: tuple[float, ...] = param(
        (0.012, -0.031, -0.012), unit="m", length=3, doc="Accelerometers from the ball's centre, "
        "eq. (17).")
    gyro_range: float | None = param(
        None, unit="rad/s", low=1e-3, doc="Rate at which the gyroscope clips; unset: found from "
        "the data.")
    duration: float | None = param(
        None, unit="s", low=0.5, doc="Time after the entrainment that is integrated; unset: up to "
        "the first gap or the end of the motion.")
    alignment: float = param(
        0.2, unit="s", low=0.02, doc="Time before the entrainment whose means are the first "
        "attitude.")
    secant: float = param(
        120.0, unit="m", low=1.0, doc="Horizontal distance in which the slope secant meets the "
        "terrain again.")
    level: str = param("position", choices=("position", "velocity"),
                       doc="What the terrain constrains, eq. (45) or (44).")
    model: int = param(2, low=1, high=3, doc="Error model of section 5.2.2: 1 without bias, 2 "
                       "with a constant one, 3 with its drift.")
    rho: float = param(1.0, low=0.0, doc="Regularisation, eqs. (54) and (55).")
    realign: bool = param(
        True, doc="Whether the attitudes follow the calibrated force at rest, whose norm is that "
        "of gravity, eq. (30); false: as printed, without rows of the rest.")


@dataclass(frozen=True)
class BallTrack:
    """``samples`` as calibrated in the laboratory and ``track`` from them; ``calibration`` in situ,
    ``improved`` samples and ``improved_track`` after it. ``axes``: slope frame Q_s. ``field``:
    check of the attitudes. ``motion``: span in the log. ``mag``: calibration in situ."""

    motion: MotionSpan
    samples: BallSamples
    track: Track
    calibration: InSituCalibration
    improved: BallSamples
    improved_track: Track
    axes: np.ndarray
    field: FieldCheck
    mag: MagCalibration


def clipped(gyr: np.ndarray, gyro_range: float | None) -> np.ndarray:
    """Mask (n, 3) of rates (n, 3) rad/s of a whole recording that are at their limit.

    gyro_range: rad/s; None: found from flat tops.
    """
    if gyro_range is None:
        limits = ranges_of(gyr, kernel_parameters(OrientationParams()))
    else:
        limits = np.full(3, gyro_range)
    # Behind a calibration what was clipped is no longer flat.
    return saturated_axes(gyr, (1.0 - 2.0 * BAND) * limits)


def _at(mag, stamp):
    """Samples (n, 3) T of a log at stamps (n,) ns, on straight lines."""
    since, at = seconds(mag.stamp, stamp[0]), seconds(stamp, stamp[0])
    return np.column_stack([np.interp(at, since, mag.mag[:, i]) for i in range(3)])


def _bridged(stamp, rate):
    """Rates (n, 3) with those that (B.3) cannot tell, a missing axis along the field, on straight
    lines between their neighbours."""
    since = seconds(stamp, stamp[0])
    known = np.isfinite(rate) & (np.abs(rate) < _FASTEST)
    return np.column_stack([np.interp(since, since[known[:, i]], rate[known[:, i], i])
                            for i in range(3)])


def attitudes(imu: ImuLog, rate: np.ndarray, mag: MagLog, alignment: float, declination_deg: float
              ) -> np.ndarray:
    """Attitudes (n, 4) by eqs. (5)-(14) from recovered rates (n, 3) and a calibrated field; the
    first ``alignment`` s are at rest."""
    params = OrientationParams(method="gyro_mag", declination_deg=declination_deg).replace(
        **{"gyro_mag.as_printed": True, "alignment.duration": alignment,
           "sensor.gyro_delay": 0.0, "sensor.mag_delay": 0.0, "sensor.gyro_range": (1e3,),
           "sensor.gyro_bias_sd": 0.0})
    estimator = OrientationEstimator(params)
    rows = estimator.run(ImuLog(imu.stamp, rate, imu.acc), mag)
    rows = np.concatenate([rows, estimator.finish()])
    if len(rows) != len(imu):
        raise EstimationError(f"{len(imu) - len(rows)} of {len(imu)} samples have no attitude: "
                              "stamps that repeat or values that are not finite")
    return rows["quat_world_imu"]


def _window(imu, span, params):
    """Samples [start, stop) to integrate."""
    end = imu.stamp[span.start] + int((params.duration or 1e6) * 1e9)
    stop = min(span.stop, int(np.searchsorted(imu.stamp, end, side="right")))
    steps = np.diff(imu.stamp[span.start:stop])
    gaps = np.flatnonzero(steps > _GAP * np.median(np.diff(imu.stamp)))
    if len(gaps):
        stop = span.start + int(gaps[0]) + 1
    return span.start, stop


def track_ball(imu: ImuLog, mag: MagLog, surface: Surface, field_world: np.ndarray,
               gravity: float, params: TrackParams = TrackParams()) -> BallTrack:
    """Calibrate the magnetometer, find the start, integrate, calibrate the accelerometer.

    Args:
        imu, mag: logs, from rest to rest.
        surface: the terrain; the ball's first place is its origin.
        field_world: (3,) T, of the field model: norm and declination.
        gravity: m/s^2, of the place.
        params: TrackParams.

    Raises:
        EstimationError: no rest, no motion.
        CalibrationError: directions that do not determine a calibration.
        LayoutError: a surface without a fall line.
    """
    span = find_motion(imu)
    start, stop = _window(imu, span, params)
    first = int(np.searchsorted(imu.stamp, imu.stamp[start] - int(params.alignment * 1e9)))
    moving = mag.between(int(imu.stamp[start]), int(imu.stamp[span.stop - 1]) + 1)
    mag_calibration = calibrate_magnetometer(moving.mag, float(np.linalg.norm(field_world)))
    mag = replace(mag, mag=mag_calibration.apply(mag.mag))
    near = slice(first, stop)
    rate, _ = recover_rates(imu.stamp[near], imu.gyr[near] - span.gyr_bias,
                            _at(mag, imu.stamp[near]), clipped(imu.gyr, params.gyro_range)[near])
    rate = _bridged(imu.stamp[near], rate)
    quat = attitudes(imu[near], rate, mag.between(int(imu.stamp[first]), int(imu.stamp[stop - 1])
                                                  + 1), params.alignment,
                     math.degrees(math.atan2(field_world[0], field_world[1])))
    used = slice(start - first, None)
    time = seconds(imu.stamp[near], imu.stamp[start])[used]
    samples = BallSamples(time, quat[used], imu.acc[near][used], rate[used], params.lever_arm)
    at_rest = imu.acc[first:start].mean(axis=0)
    axes = slope_axes(fall_line(surface, np.zeros(3), params.secant))
    mags = _at(mag, imu.stamp[near][used])
    constraint = Constraint(axes[:, 2], gravity, params.level, params.model, params.rho,
                            span.force if params.realign else None)
    still = mag.between(int(imu.stamp[first]), int(imu.stamp[start]) + 1).mag.mean(axis=0)
    calibration = calibrate_in_situ(samples, constraint, still if params.realign else None)
    improved = calibration.apply(samples)
    return BallTrack(span, samples, dead_reckon(samples, float(np.linalg.norm(at_rest))),
                     calibration, improved, dead_reckon(improved, gravity), axes,
                     check_field(samples.quat, mags), mag_calibration)
