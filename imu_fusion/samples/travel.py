"""Do fixes and velocities of a receiver tell of one motion?

Over some seconds the place changes by what the velocity adds up to. Both are compared under other
hypotheses as well: velocities north, east, down, or in knots; degrees and minutes written as one
number; a clock of their own. The one under which most of the difference goes away is right. Nothing
of the body has to be known, and nothing of the Imu.
"""

from typing import NamedTuple

import numpy as np

from imu_fusion.samples.findings import Finding
from imu_fusion.samples.logs import FixLog, VelocityLog, seconds

_SPANS = (2.0, 5.0, 10.0, 20.0)   # s, over which places are compared: the shortest that tells
_FEWEST = 8             # spans that prove anything
_MOVED = 3.0            # standard deviations of a span, by the noise of the fixes
_NOISY = 4.0            # times their variance: what is less is noise
_LEAST = 1.0            # m of motion in a span
_WANDERS = 0.5          # m/s, with which places of a body at rest may wander
_GAP = 3.0              # usual intervals, after which a velocity says nothing of what is between
_ALIKE = 1.05           # of the least squares: the simpler of two such
_BETTER = 0.25          # of the squares: what the right hypothesis leaves of them at most
_SHARE = 0.8            # of the spans in which it is better
_FITS = 0.05            # of the motion's squares is left where nothing is wrong
_LAGS = 0.1 * np.arange(-50, 51)   # s
_APART = 0.3            # s: what is less is for the state of the delay
_SECOND_SD = np.sqrt(6.0)          # of a second difference, by that of a reading
_DEGREE = 111.2e3       # m, of a great circle
_MAD = 1.4826           # standard deviations of a normal distribution in a median deviation
_ALTERNATE = 0.5        # standard deviations of a second difference, and
_REPEATED = 0.1         # share of fixes that are the one before, of which this tells nothing
_CERTAIN = 6.0          # of its mean, by which two receivers are apart

_SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_DOWN = np.diag([1.0, 1.0, -1.0])
_FRAMES = (
    ("", np.eye(3)),
    ("north, east, down, not east, north, up", _DOWN @ _SWAPPED),
    ("north, east, up, not east, north, up", _SWAPPED),
    ("east, north, down, not east, north, up", _DOWN),
    ("reversed", -np.eye(3)))
_UNITS = (("", 1.0), ("in km/h, not m/s; divide by 3.6", 3.6),
          ("in knots, not m/s; multiply by 0.514444", 1.0 / 0.514444),
          ("in mph, not m/s; multiply by 0.44704", 1.0 / 0.44704),
          ("in ft/s, not m/s; multiply by 0.3048", 1.0 / 0.3048),
          ("in cm/s, not m/s; divide by 100", 100.0), ("in mm/s, not m/s; divide by 1000", 1e3))


class _Spans(NamedTuple):
    """Changes of place (w, 3) m between fixes ``first`` and ``last`` (w,), and what the velocities
    add up to (w, 3)."""

    first: np.ndarray
    last: np.ndarray
    moved: np.ndarray
    told: np.ndarray


def check_travel(fix: FixLog, velocity: VelocityLog, name: str) -> list[Finding]:
    """A finding if velocities do not lead from fix to fix.

    Args:
        fix: FixLog. velocity: VelocityLog. name: of the velocities' topic.
    """
    fix = fix[fix.usable]
    velocity = velocity[np.isfinite(velocity.vel_world).all(axis=1)]
    if (len(fix) < 2 * _FEWEST or len(velocity) < 2 * _FEWEST
            or np.any(np.diff(fix.stamp) <= 0) or np.any(np.diff(velocity.stamp) <= 0)):
        return []
    place = _places(fix)
    noise = 2.0 * _noise(place) ** 2
    for span in _SPANS:
        spans = _spans(fix.stamp, place, velocity, span)
        moved = _squares(spans.moved)
        use = moved > max(_LEAST, _MOVED ** 2 * noise)
        if use.sum() < _FEWEST:
            continue
        spans = _Spans(*(part[use] for part in spans))
        recorded = np.median(_squares(spans.moved - spans.told))
        if recorded < _NOISY * noise:
            return []
        found = None
        if recorded > _FITS * np.median(moved[use]):
            found = _other_frame(fix, velocity, spans, np.sqrt(np.median(moved[use])) / span)
        found = found or _other_time(fix, velocity, spans)
        return [Finding("travel", f"{name}: {found[0]}", unusable=found[1])] if found else []
    return []


def _other_frame(fix, velocity, spans, speed) -> tuple[str, bool] | None:
    """What the readings are in, in words, if it is not what they should be in; and whether nothing
    can be made of them. speed: m/s, of the fixes."""
    if not np.any(velocity.vel_world):
        return None if speed < _WANDERS else (
            "all velocities are zero while the fixes move: leave them out", True)
    so = "the velocities lead from fix to fix if "
    found = [(spans.moved - spans.told @ np.linalg.inv(scale * axes).T,
              f"{so}they are " + " and ".join(part for part in (unit, frame) if part))
             for frame, axes in _FRAMES for unit, scale in _UNITS if frame or unit]
    for change, how in _OF_FIXES:
        place = _places(change(fix))
        found.append((place[spans.last] - place[spans.first] - spans.told, so + how))
    recorded = spans.moved - spans.told
    squares = [_squares(left) for left, _ in found]
    least = min(np.median(left) for left in squares)
    for left, (_, text) in zip(squares, found):
        if np.median(left) <= _ALIKE * least and _is_better(left, _squares(recorded)):
            return text, True
    far = [np.linalg.norm(part[:, :2], axis=1) for part in (spans.moved, spans.told)]
    if _is_better((far[0] - far[1]) ** 2, _squares(recorded[:, :2])):
        return ("the velocities are as large as the fixes' motion and point elsewhere: of the "
                "axes of the body, or of another frame", True)
    return None


def _other_time(fix, velocity, spans) -> tuple[str, bool] | None:
    """The lag of the velocities that explains them, likewise."""
    recorded = _squares(spans.moved - spans.told)
    left = [_squares(spans.moved - _told(fix.stamp, velocity, spans, lag)) for lag in _LAGS]
    i = int(np.argmin([np.nanmedian(each) for each in left]))
    if not (abs(_LAGS[i]) > _APART and _is_better(left[i], recorded)):
        return None
    return (f"their stamps are {abs(_LAGS[i]):.1f} s {'late' if _LAGS[i] > 0 else 'early'} against "
            "those of the fixes: see that both are of the time of measurement", False)


def _is_better(left, recorded):
    """Whether a hypothesis leaves so much less of the squares (w,), span by span, that a few wild
    readings do not make it."""
    known = np.isfinite(left)
    left, recorded = left[known], recorded[known]
    return bool(len(left) >= _FEWEST and np.median(left) < _BETTER * np.median(recorded)
                and left.sum() < _BETTER * recorded.sum() and np.mean(left < recorded) >= _SHARE)


def _squares(vectors):
    return np.sum(vectors ** 2, axis=1)


def _places(fix):
    """East, north, up (n, 3) m of the first fix, on a sphere: to a percent, near it."""
    east = (fix.longitude_deg - fix.longitude_deg[0] + 180.0) % 360.0 - 180.0
    return np.column_stack([
        _DEGREE * np.cos(np.radians(fix.latitude_deg[0])) * east,
        _DEGREE * (fix.latitude_deg - fix.latitude_deg[0]), fix.height - fix.height[0]])


def _noise(place):
    """Standard deviation (m) of a fix, all axes, by how much it lies off its neighbours."""
    second = np.linalg.norm(place[2:] - 2.0 * place[1:-1] + place[:-2], axis=1)
    return float(np.median(second)) / _SECOND_SD


def _spans(stamp, place, velocity, span):
    """_Spans of about ``span`` s, one after the other."""
    t = seconds(stamp, stamp[0])
    edges = np.unique(np.searchsorted(t, np.arange(0.0, t[-1], span)))
    first, last = edges[:-1], edges[1:]
    whole = t[last] - t[first] < 1.5 * span
    first, last = first[whole], last[whole]
    spans = _Spans(first, last, place[last] - place[first], np.empty((len(first), 3)))
    told = _told(stamp, velocity, spans, 0.0)
    known = np.isfinite(told).all(axis=1)
    return _Spans(first[known], last[known], spans.moved[known], told[known])


def _told(stamp, velocity, spans, lag):
    """What velocities (taken ``lag`` s earlier than their stamps) add up to in spans, (w, 3) m; NaN
    where some are missing."""
    at = seconds(velocity.stamp, stamp[0]) - lag
    steps = np.diff(at)
    sums = np.vstack([np.zeros(3), np.cumsum(
        0.5 * (velocity.vel_world[1:] + velocity.vel_world[:-1]) * steps[:, None], axis=0)])
    gaps = np.append(0.0, np.cumsum(steps > _GAP * np.median(steps)))
    t = seconds(stamp, stamp[0])
    ends = [np.column_stack([np.interp(t[i], at, s, np.nan, np.nan) for s in sums.T])
            for i in (spans.first, spans.last)]
    told = ends[1] - ends[0]
    told[np.interp(t[spans.first], at, gaps) != np.interp(t[spans.last], at, gaps)] = np.nan
    return told


def _changed(fix, **columns):
    return FixLog(fix.stamp, **{"latitude_deg": fix.latitude_deg, "height": fix.height,
                                "longitude_deg": fix.longitude_deg, "cov_enu": fix.cov_enu,
                                "status": fix.status} | columns)


def _swapped(fix):
    # Beyond 90 deg it is no latitude.
    known = np.abs(fix.longitude_deg).max() <= 90.0
    return _changed(fix, latitude_deg=fix.longitude_deg, longitude_deg=fix.latitude_deg
                    ) if known else fix


def _mirrored(fix):
    return _changed(fix, longitude_deg=-fix.longitude_deg)


def _from_minutes(fix):
    """Degrees of what has minutes after the point."""
    columns = {}
    for name in ("latitude_deg", "longitude_deg"):
        value = getattr(fix, name)
        whole = np.trunc(value)
        columns[name] = whole + (value - whole) / 0.6
    return _changed(fix, **columns)


_OF_FIXES = (
    (_swapped, "latitude and longitude are exchanged"),
    (_mirrored, "the longitude has the other sign: west of Greenwich it is negative"),
    (_from_minutes, "degrees and minutes of the fixes were written as one number"))


def check_alternating(fix: FixLog, name: str) -> list[Finding]:
    """A finding if every second fix lies beside the others, all on one side."""
    fix = fix[fix.usable]
    if len(fix) < 4 * _FEWEST:
        return []
    place = _places(fix)
    if np.mean(np.all(place[1:] == place[:-1], axis=1)) > _REPEATED:
        return []
    beside = place[1:-1] - 0.5 * (place[2:] + place[:-2])
    beside[::2] *= -1.0
    apart = np.median(beside, axis=0)
    sd = _MAD * np.median(np.abs(beside - apart), axis=0)
    if not np.any(np.abs(apart) > np.maximum(
            _ALTERNATE * sd, _CERTAIN * sd / np.sqrt(len(beside))) + 1e-3):
        return []
    return [Finding("fix", f"{name}: every second fix lies " + "/".join(
        f"{v:+.2f}" for v in apart) + " m (east/north/up) beside the line of the others: two "
        "receivers, or two antennas, on one topic; give each one of its own", unusable=True)]
