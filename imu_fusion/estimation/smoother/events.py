"""Take-off and touch-down of a ski jump, and what is read off the jump."""

from dataclasses import asdict, dataclass

import numpy as np

from imu_fusion.errors import EstimationError

_MIN_SPEED = 10.0   # m/s, Fang 2020, appendix A
_SEPARATION = 1.5   # s between the two peaks, ibid.
_LEAD = 0.05        # s by which touch-down precedes the second peak, ibid.


@dataclass(frozen=True)
class JumpEvents:
    """Stamps of take-off and touch-down, ns."""

    takeoff: int
    touchdown: int


def find_jump(imu, velocity, takeoff=None, touchdown=None):
    """Take-off and touch-down, as given or else detected.

    Args:
        imu: ImuLog. velocity: VelocityLog or None, not needed when both are given.
        takeoff, touchdown: s since the first Imu sample, or None.

    Returns:
        JumpEvents.

    Raises:
        EstimationError: not within the recording, not in this order, or not detected.
    """
    length = (imu.stamp[-1] - imu.stamp[0]) * 1e-9
    for name, at in (("takeoff", takeoff), ("touchdown", touchdown)):
        if at is not None and at > length:
            raise EstimationError(f"{name} is given as {at:g} s, but the Imu samples end at "
                                  f"{length:.1f} s")
    stamps = [None if at is None else int(imu.stamp[0]) + round(at * 1e9)
              for at in (takeoff, touchdown)]
    if None in stamps:
        found = detect_jump(imu, velocity)
        stamps = [detected if given is None else given
                  for given, detected in zip(stamps, (found.takeoff, found.touchdown))]
    if stamps[1] <= stamps[0]:
        raise EstimationError("the touch-down that was detected is before the take-off that was "
                              "given, or the reverse: give both (jump.takeoff, jump.touchdown)")
    return JumpEvents(*stamps)


def detect_jump(imu, velocity):
    """Take-off and touch-down from peaks of the specific force (Fang 2020, appendix A).

    Args:
        imu: ImuLog.
        velocity: VelocityLog; its speed limits the search to the fast part. What is not finite
            is left out.

    Returns:
        JumpEvents.

    Raises:
        EstimationError: no fast part, or no two peaks.
    """
    if velocity is not None:
        velocity = velocity[np.isfinite(velocity.vel_world).all(axis=1)]
    if velocity is None or len(velocity) < 2:
        raise EstimationError("take-off and touch-down cannot be detected without GNSS "
                              "velocities: give them (jump.takeoff and jump.touchdown)")
    origin = imu.stamp[0]
    speed = np.interp(imu.stamp - origin, velocity.stamp - origin,
                      np.linalg.norm(velocity.vel_world, axis=1))
    force = np.linalg.norm(imu.acc, axis=1)
    fast = (speed > _MIN_SPEED) & np.isfinite(force)
    if not fast.any():
        raise EstimationError(f"no take-off: the speed never exceeds {_MIN_SPEED:g} m/s "
                              "(jump.takeoff and jump.touchdown give it)")
    candidates = np.where(fast, force, -np.inf)
    first = int(np.argmax(candidates))
    # (A2), with the sense of the inequality that the text describes.
    apart = np.abs(imu.stamp - imu.stamp[first]) > _SEPARATION * 1e9
    candidates[~apart] = -np.inf
    second = int(np.argmax(candidates))
    if not np.isfinite(candidates[second]):
        raise EstimationError("no take-off and touch-down: only one peak of the specific force "
                              "at speed (jump.takeoff and jump.touchdown give them)")
    early, late = sorted((int(imu.stamp[first]), int(imu.stamp[second])))
    return JumpEvents(early, late - int(_LEAD * 1e9))


def impact_onset(imu, touchdown, search=0.4):
    """Stamp at which the force of the impact sets in, near a first guess.

    The magnitude of the specific force does not feel how the sensor turns, and in the air it
    varies slowly. The impact is the last rise from that level to the largest peak nearby; a
    parabola through its first three samples dates the onset by its root, between the last
    quiet sample and the first loud one.

    Args:
        imu: ImuLog.
        touchdown: first guess, ns.
        search: s around it in which the peak lies.

    Returns:
        Stamp (ns) and its standard deviation (s), or None when nothing stands out.
    """
    near = imu.between(touchdown - int(search * 1e9), touchdown + int(search * 1e9))
    if len(near) < 3:
        return None
    peak_stamp = near.stamp[np.argmax(np.linalg.norm(near.acc, axis=1))]
    # The quiet level: the air before the rise, which takes less than 0.1 s (Fang: 0.05 s).
    window = imu.between(peak_stamp - 300_000_000, peak_stamp + 50_000_000)
    t = (window.stamp - peak_stamp) * 1e-9
    quiet = t < -0.1
    if quiet.sum() < 5:
        return None
    force = np.linalg.norm(window.acc, axis=1)
    level = np.median(force[quiet])
    rise = force - level
    peak = int(np.searchsorted(t, 0.0))
    floor = max(6.0 * np.median(np.abs(rise[quiet])), 0.1 * rise[peak])
    below = np.flatnonzero(rise[:peak + 1] <= floor)
    if not len(below) or rise[peak] <= 3.0 * floor or below[-1] + 3 >= len(t):
        return None
    i = int(below[-1]) + 1
    step = t[i] - t[i - 1]
    roots = np.polynomial.Polynomial.fit(t[i:i + 3], rise[i:i + 3], 2).convert().roots()
    roots = roots[np.isreal(roots)].real
    roots = roots[roots <= t[i]]
    onset = np.clip(roots.max() if len(roots) else t[i] - 0.5 * step, t[i - 1], t[i])
    return int(peak_stamp + round(onset * 1e9)), step / np.sqrt(12.0)


def _interpolate(stamp, samples, name):
    since = samples["stamp"] - samples["stamp"][0]
    at = stamp - samples["stamp"][0]
    return np.array([np.interp(at, since, column) for column in samples[name].T])


def table_crossing(hill, samples, near):
    """Stamp (ns) at which the smoothed trajectory passes the table edge (x = 0), near a first
    guess; None when it does not within 2 s."""
    around = np.abs(samples["stamp"] - near) < 2_000_000_000
    stamp = samples["stamp"][around]
    x = hill.to_hill(samples["position_world"][around])[:, 0]
    crossing = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    if not len(crossing):
        return None
    i = int(crossing[0])
    return int(stamp[i] + round((stamp[i + 1] - stamp[i]) * float(-x[i] / (x[i + 1] - x[i]))))


def refine_jump(hill, samples, imu, events):
    """Events from the smoothed trajectory (take-off: the table edge) and the onset of the
    impact (touch-down); the given ones where these fail."""
    takeoff = table_crossing(hill, samples, events.takeoff)
    onset = impact_onset(imu, events.touchdown)
    return JumpEvents(events.takeoff if takeoff is None else takeoff,
                      events.touchdown if onset is None else onset[0])


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

    def to_mapping(self):
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


def jump_result(hill, samples, imu, events):
    """Read the results of a jump off the smoothed samples.

    The length is that of the landing profile up to the touch-down; its standard deviation
    joins the position's along the profile and the date's times the speed. The take-off angle
    is that of the velocity at the edge, upwards positive; the in-run speed is the mean over
    the last 10 m before the edge, as light barriers measure it.

    Args:
        hill: Hill.
        samples: structured array of the smoother.
        imu: ImuLog.
        events: JumpEvents.

    Raises:
        EstimationError: the touch-down is not beyond the table.
    """
    stamp, cov_velocity = samples["stamp"], samples["cov_velocity"]
    takeoff, off_acc, edge = _in_air(samples, events.takeoff, after=True)
    landing, down_acc, touch = _in_air(samples, events.touchdown, after=False)
    x, _, _ = hill.to_hill(_interpolate(events.touchdown, samples, "position_world"))
    if x <= 0.0:
        raise EstimationError(f"at touch-down the smoothed trajectory is {-x:.1f} m before the "
                              "edge of the table: take-off and touch-down are taken wrongly "
                              "(jump.takeoff and jump.touchdown give them), or the hill is "
                              "another one")
    onset = impact_onset(imu, events.touchdown)
    timing = onset[1] if onset is not None else _LEAD

    # On the profile dL = sqrt(1 + slope^2) dx.
    slope = float(hill.landing(x)[1])
    forward = hill.axes[0]
    cov_x = np.einsum("i,nij,j->n", forward, samples["cov_position"], forward)
    length_sd = np.hypot(1.0, slope) * np.hypot(np.sqrt(cov_x[touch]),
                                                timing * (forward @ landing))
    edge_timing = np.sqrt(cov_x[edge]) / (forward @ takeoff)
    speed = np.linalg.norm(samples["vel_world"], axis=1)
    takeoff_speed, landing_speed = np.linalg.norm(takeoff), np.linalg.norm(landing)
    horizontal = np.hypot(*takeoff[:2])
    raised = np.array([*(-takeoff[2] * takeoff[:2] / horizontal), horizontal])
    table = np.flatnonzero((stamp < events.takeoff)
                           & (hill.to_hill(samples["position_world"])[:, 0] > -10.0))
    in_run = in_run_sd = None
    if len(table):
        # Errors of the velocity hardly change over 0.4 s.
        middle = table[len(table) // 2]
        in_run = float(speed[table].mean())
        in_run_sd = _sd(samples["vel_world"][middle] / speed[middle], cov_velocity[middle],
                        0.0, np.zeros(3))
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
        landing_speed=float(landing_speed), landing_speed_sd=_sd(
            landing / landing_speed, cov_velocity[touch], timing, down_acc))
