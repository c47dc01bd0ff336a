"""Take-off and touch-down of a ski jump: detected in the specific force, refined on the hill."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.samples.logs import ImuLog, VelocityLog
from imu_fusion.surfaces.hill import Hill

_MIN_SPEED = 10.0   # m/s, Fang 2020, appendix A
_SEPARATION = 1.5   # s between the two peaks, ibid.

#: Touch-down precedes the second peak by so many s, ibid.
LEAD = 0.05

# The onset of an impact; set by hand, and held to by test_jump_events.py.
_SEARCH = 0.4       # s around the first guess in which the peak lies
_AIR = 300_000_000  # ns before the peak: the air, and the rise
_RISE = 0.1         # s that the rise takes at most (Fang: 0.05 s)
_AFTER = 50_000_000   # ns after the peak that are looked at
_QUIET = 5          # least samples of the air, for a median
_DEVIATIONS, _SHARE = 6.0, 0.1   # median deviations, or share of the peak: quiet within
_STANDS_OUT = 3.0   # times what counts as quiet, above which a peak is one

_NEAR_EDGE = 2_000_000_000   # ns from a take-off, within which the table edge is passed


@dataclass(frozen=True)
class JumpEvents:
    """Stamps of take-off and touch-down, ns."""

    takeoff: int
    touchdown: int


def find_jump(imu: ImuLog, velocity: VelocityLog | None, takeoff: float | None = None,
              touchdown: float | None = None) -> JumpEvents:
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
    if takeoff is None or touchdown is None:
        found = detect_jump(imu, velocity)
    origin = int(imu.stamp[0])
    events = JumpEvents(
        found.takeoff if takeoff is None else origin + round(takeoff * 1e9),
        found.touchdown if touchdown is None else origin + round(touchdown * 1e9))
    if events.touchdown <= events.takeoff:
        raise EstimationError("the touch-down that was detected is before the take-off that was "
                              "given, or the reverse: give both (jump.takeoff, jump.touchdown)")
    return events


def detect_jump(imu: ImuLog, velocity: VelocityLog | None) -> JumpEvents:
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
                              "at speed (jump.takeoff and jump.touchdown give them; see that the "
                              "velocities are of the clock of the Imu)")
    early, late = sorted((int(imu.stamp[first]), int(imu.stamp[second])))
    return JumpEvents(early, late - int(LEAD * 1e9))


def impact_onset(imu: ImuLog, touchdown: int) -> tuple[int, float] | None:
    """Stamp at which the force of the impact sets in, near a first guess.

    The magnitude of the specific force does not feel how the sensor turns, and in the air it
    varies slowly. The impact is the last rise from that level to the largest peak nearby; a
    parabola through its first three samples dates the onset by its root, between the last
    quiet sample and the first loud one.

    Args:
        imu: ImuLog.
        touchdown: first guess, ns.

    Returns:
        Stamp (ns) and its standard deviation (s), or None when nothing stands out.
    """
    near = imu.between(touchdown - int(_SEARCH * 1e9), touchdown + int(_SEARCH * 1e9))
    if len(near) < 3:
        return None
    peak_stamp = near.stamp[np.argmax(np.linalg.norm(near.acc, axis=1))]
    window = imu.between(peak_stamp - _AIR, peak_stamp + _AFTER)
    t = (window.stamp - peak_stamp) * 1e-9
    quiet = t < -_RISE
    if quiet.sum() < _QUIET:
        return None
    force = np.linalg.norm(window.acc, axis=1)
    level = np.median(force[quiet])
    rise = force - level
    peak = int(np.searchsorted(t, 0.0))
    floor = max(_DEVIATIONS * np.median(np.abs(rise[quiet])), _SHARE * rise[peak])
    below = np.flatnonzero(rise[:peak + 1] <= floor)
    if not len(below) or rise[peak] <= _STANDS_OUT * floor or below[-1] + 3 >= len(t):
        return None
    i = int(below[-1]) + 1
    step = t[i] - t[i - 1]
    roots = np.polynomial.Polynomial.fit(t[i:i + 3], rise[i:i + 3], 2).convert().roots()
    roots = roots[np.isreal(roots)].real
    roots = roots[roots <= t[i]]
    onset = np.clip(roots.max() if len(roots) else t[i] - 0.5 * step, t[i - 1], t[i])
    return int(peak_stamp + round(onset * 1e9)), step / np.sqrt(12.0)


def table_crossing(hill: Hill, samples: np.ndarray, near: int | None) -> int | None:
    """Stamp (ns) at which the smoothed trajectory passes the table edge (x = 0), within 2 s of a
    first guess, or at its fastest where there is none; None when it does not."""
    stamp = samples["stamp"]
    around = np.ones(len(stamp), bool) if near is None else np.abs(stamp - near) < _NEAR_EDGE
    stamp = stamp[around]
    x = hill.to_hill(samples["position_world"][around])[:, 0]
    crossing = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    if not len(crossing):
        return None
    i = int(crossing[0 if near is not None else np.argmax(x[crossing + 1] - x[crossing])])
    return int(stamp[i] + round((stamp[i + 1] - stamp[i]) * float(-x[i] / (x[i + 1] - x[i]))))


def refine_jump(hill: Hill, samples: np.ndarray, imu: ImuLog, events: JumpEvents) -> JumpEvents:
    """Events from the smoothed trajectory (take-off: the table edge) and the onset of the
    impact (touch-down); the given ones where these fail."""
    takeoff = table_crossing(hill, samples, events.takeoff)
    onset = impact_onset(imu, events.touchdown)
    return JumpEvents(events.takeoff if takeoff is None else takeoff,
                      events.touchdown if onset is None else onset[0])
