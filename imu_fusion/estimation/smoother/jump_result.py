"""What is read off a smoothed ski jump: length, speeds, angle, and how sure they are."""

from dataclasses import asdict, dataclass

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.jump_events import LEAD, JumpEvents, impact_onset
from imu_fusion.samples.logs import ImuLog
from imu_fusion.surfaces.hill import Hill

_IN_RUN = 10.0   # m before the edge, over which light barriers measure the in-run speed


@dataclass(frozen=True)
class JumpResult:
    """What is reported of a jump: m, m/s, degrees, s; ``*_sd`` are standard deviations.

    ``in_run_speed`` is None where the recording begins behind the in-run."""

    takeoff_stamp: int
    touchdown_stamp: int
    in_run_speed: float | None
    in_run_speed_sd: float | None
    takeoff_speed: float
    takeoff_speed_sd: float
    takeoff_angle_deg: float
    takeoff_angle_sd_deg: float
    flight_time: float
    flight_time_sd: float
    length: float
    length_sd: float
    landing_speed: float
    landing_speed_sd: float

    def to_mapping(self) -> dict[str, float]:
        """Names and values, for JSON."""
        return asdict(self)


def _in_air(samples, event, after):
    """Velocity (3,) m/s and acceleration (3,) m/s^2 of the air's side of an event, where the
    velocity has a kink: from the two samples after it or before it; and the sample between."""
    stamp = samples["stamp"]
    i = int(np.searchsorted(stamp, event)) if after else int(
        np.searchsorted(stamp, event, side="right")) - 2
    i = min(max(i, 0), len(stamp) - 2)
    near = i if after else i + 1
    vel = samples["vel_world"]
    acc = (vel[i + 1] - vel[i]) / ((stamp[i + 1] - stamp[i]) * 1e-9)
    return vel[near] + acc * ((event - stamp[near]) * 1e-9), acc, near


def _sd(direction, cov, timing, acc):
    """Standard deviation of the component of a velocity along a direction (3,), with
    covariance (3, 3), at an event dated to ``timing`` s with acceleration (3,)."""
    return float(np.hypot(np.sqrt(direction @ cov @ direction), timing * (direction @ acc)))


def _interpolate(stamp, samples, name):
    since = samples["stamp"] - samples["stamp"][0]
    at = stamp - samples["stamp"][0]
    return np.array([np.interp(at, since, column) for column in samples[name].T])


def _in_run_speed(hill, samples, takeoff):
    """Mean speed over the last metres before the edge and its standard deviation, None where
    nothing is recorded there."""
    before = samples[samples["stamp"] < takeoff]
    table = before[hill.to_hill(before["position_world"])[:, 0] > -_IN_RUN]
    if not len(table):
        return None, None
    speed = np.linalg.norm(table["vel_world"], axis=1)
    # Errors of the velocity hardly change over 0.4 s.
    i = len(table) // 2
    return float(speed.mean()), _sd(table["vel_world"][i] / speed[i], table["cov_velocity"][i],
                                    0.0, np.zeros(3))


def jump_result(hill: Hill, samples: np.ndarray, imu: ImuLog, events: JumpEvents,
                misfit: float = 1.0, profile_sd: float = 0.0) -> JumpResult:
    """Read the results of a jump off the smoothed samples.

    The length is that of the landing profile up to the touch-down; its standard deviation
    joins the position's along the profile, the date's times the speed, and that of the profile,
    whose errors are no noise: they are the same for all of a landing, and move the touch-down by
    about as much as the heights. The take-off angle
    is that of the velocity at the edge, upwards positive; the in-run speed is the mean over
    the last 10 m before the edge, as light barriers measure it.

    Args:
        hill: Hill.
        samples: structured array of the smoother.
        imu: ImuLog.
        events: JumpEvents.
        misfit: factor of the standard deviations at the touch-down.
        profile_sd: m, of the heights of the landing profile.

    Raises:
        EstimationError: the touch-down is not beyond the table.
    """
    cov_velocity = samples["cov_velocity"]
    takeoff, off_acc, edge = _in_air(samples, events.takeoff, after=True)
    landing, down_acc, touch = _in_air(samples, events.touchdown, after=False)
    x, _, _ = hill.to_hill(_interpolate(events.touchdown, samples, "position_world"))
    if x <= 0.0:
        raise EstimationError(f"at touch-down the smoothed trajectory is {-x:.1f} m before the "
                              "edge of the table: take-off and touch-down are taken wrongly "
                              "(jump.takeoff and jump.touchdown give them), or the hill is "
                              "another one")
    onset = impact_onset(imu, events.touchdown)
    timing = onset[1] if onset is not None else LEAD

    # On the profile dL = sqrt(1 + slope^2) dx.
    slope = float(hill.landing(x)[1])
    forward = hill.axes[0]
    cov_x = np.einsum("i,nij,j->n", forward, samples["cov_position"], forward)
    length_sd = np.hypot(misfit * np.hypot(1.0, slope) * np.hypot(
        np.sqrt(cov_x[touch]), timing * (forward @ landing)), profile_sd)
    edge_timing = np.sqrt(cov_x[edge]) / (forward @ takeoff)
    takeoff_speed, landing_speed = np.linalg.norm(takeoff), np.linalg.norm(landing)
    horizontal = np.hypot(*takeoff[:2])
    raised = np.array([*(-takeoff[2] * takeoff[:2] / horizontal), horizontal])
    in_run, in_run_sd = _in_run_speed(hill, samples, events.takeoff)
    return JumpResult(
        takeoff_stamp=events.takeoff, touchdown_stamp=events.touchdown,
        in_run_speed=in_run, in_run_speed_sd=in_run_sd, takeoff_speed=float(takeoff_speed),
        takeoff_speed_sd=_sd(takeoff / takeoff_speed, cov_velocity[edge], edge_timing, off_acc),
        takeoff_angle_deg=float(np.degrees(np.arctan2(takeoff[2], horizontal))),
        takeoff_angle_sd_deg=float(np.degrees(
            _sd(raised / takeoff_speed ** 2, cov_velocity[edge], edge_timing, off_acc))),
        flight_time=(events.touchdown - events.takeoff) * 1e-9,
        flight_time_sd=float(np.hypot(timing, edge_timing)),
        length=float(hill.jump_length(x)), length_sd=float(length_sd),
        landing_speed=float(landing_speed), landing_speed_sd=misfit * _sd(
            landing / landing_speed, cov_velocity[touch], timing, down_acc))
