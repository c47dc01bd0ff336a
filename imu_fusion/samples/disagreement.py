"""Gravity or the field that does not turn as the gyroscope says, where no other axes and no degrees
explain it: rates that are late, of another scale, or of another body.

Accelerations are felt beside gravity whatever the gyroscope says. How large they are, their share
along gravity tells: the force's length. Where that stands still a delay is told the best; else it
must explain so much that accelerations, which follow the turning by no fixed delay, do not. Iron on
the body adds a constant to the field, which is taken out.
"""

import numpy as np

from imu_fusion.samples.findings import Finding
from imu_fusion.samples.logs import ImuLog, MagLog, seconds
from imu_fusion.samples.turning import FEWEST, Windows, is_better, spread

_MOST = 20              # windows that are looked at
_GRAVITY = 9.81
_NEAR_GRAVITY = 0.1     # of it, by which the force's length may differ where nothing accelerates,
_CALM = 0.05            # and scatter within a window
_LATEST = 0.3           # s between the two sensors
_LATE = 0.02            # s: less is a matter of filters
_BY_DELAY = 0.85        # of the spread: what a delay leaves of it beside accelerations,
_EXPLAINED = 0.5        # of what turns, and what it may leave of that,
_SURELY = 1.5           # by so many standard errors
_SCALES = np.geomspace(1.0 / 16.0, 16.0, 17)
_FINER = np.geomspace(0.7, 1.4, 9)
_SCALED = 1.15          # times: less is a matter of calibration
_FITS = 0.1             # of what turns, that is left where the gyroscope is right
_FITS_CALMLY = 0.02     # and where nothing accelerates
_NOT_AT_ALL = 0.7       # of it: the gyroscope explains nothing,
_BEYOND = 3.0           # nor do accelerations, by so many times


def check_agreement(imu: ImuLog, name: str) -> list[Finding]:
    """A finding if gravity turns as a gyroscope says that is late, or of another scale, or not as
    it says at all."""
    windows = Windows(imu.stamp, imu.gyr, imu.acc, _GRAVITY)
    if len(windows) < FEWEST:
        return []
    windows.keep(np.arange(min(len(windows), _MOST)))
    left, recorded = _left(windows)
    norm = np.linalg.norm(windows.vectors, axis=2)
    felt = 3.0 * np.mean((norm - _GRAVITY) ** 2, axis=1)
    if left > _FITS:
        found = (_other_scale(windows, recorded, "gravity", name)
                 or _delay_when_shaken(windows, name))
        if found:
            return found
        if left > _NOT_AT_ALL and np.median(recorded / felt) > _BEYOND:
            return [_not_at_all(left, "gravity", name)]
    windows.keep(np.flatnonzero((np.abs(norm.mean(axis=1) / _GRAVITY - 1.0) < _NEAR_GRAVITY)
                                & (norm.std(axis=1) < _CALM * _GRAVITY)))
    if len(windows) < FEWEST:
        return []
    late, by_delay, at_once = _best_delay(windows)
    if abs(late) > _LATE and is_better(by_delay, at_once):
        return [late_finding(late, "gravity", name)]
    left, recorded = _left(windows)
    return _other_scale(windows, recorded, "gravity", name) if left > _FITS_CALMLY else []


def field_windows(imu: ImuLog, mag: MagLog) -> Windows:
    """Windows in which a field turns, brought to the stamps of the rates; none where stamps do not
    increase."""
    time = seconds(imu.stamp, imu.stamp[0])
    if np.any(np.diff(time) <= 0.0) or len(mag) < 2:
        return Windows(imu.stamp[:0], imu.gyr[:0], imu.acc[:0])
    measured = seconds(mag.stamp, imu.stamp[0])
    fields = np.column_stack([np.interp(time, measured, mag.mag[:, i], left=np.nan, right=np.nan)
                              for i in range(3)])
    return Windows(imu.stamp, imu.gyr, fields)


def check_field_agreement(imu: ImuLog, mag: MagLog, name: str) -> list[Finding]:
    """As :func:`check_agreement`, of the Earth's field."""
    windows = field_windows(imu, mag)
    if len(windows) < FEWEST:
        return []
    windows.keep(np.arange(min(len(windows), _MOST)))
    late, by_delay, at_once = _best_delay(windows, with_bias=True)
    if abs(late) > _LATE and is_better(by_delay, at_once):
        return [late_finding(late, "the field", name)]
    left, recorded = _left(windows, with_bias=True)
    if left < _FITS_CALMLY:
        return []
    found = _other_scale(windows, recorded, "the field", name, with_bias=True)
    return found or ([_not_at_all(left, "the field", name)] if left > _NOT_AT_ALL else [])


def _delay_when_shaken(windows, name):
    """A finding on a delay that explains, of what turns, more than accelerations could."""
    late, by_delay, at_once = _best_delay(windows)
    gain = np.log(at_once) - np.log(by_delay)
    still = spread(np.broadcast_to(np.eye(3), (*windows.vectors.shape, 3)), windows.vectors)
    if not (_LATE < abs(late) < _LATEST - 2.0 * windows.step
            and by_delay.sum() < _BY_DELAY * at_once.sum()
            and np.median(by_delay / still) < _EXPLAINED
            and gain.mean() * np.sqrt(len(gain)) > _SURELY * gain.std()):
        return []
    return [late_finding(late, "gravity", name)]


def late_finding(late: float, what: str, name: str) -> Finding:
    """A gyroscope that is ``late`` s later than what turns, gravity or the field."""
    other = "accelerometer" if what == "gravity" else "magnetometer"
    return Finding(
        "stamp", f"{name}: {what} turns as if the gyroscope were {abs(late) * 1e3:.0f} ms "
        f"{'later' if late > 0.0 else 'earlier'} than the {other}: give both the stamps of their "
        "measurements, or take them from one sensor")


def _not_at_all(left, what, name):
    return Finding(
        "axes", f"{name}: {what} does not turn as the gyroscope says: {min(left, 1.0):.0%}"
        " of its turning is left unexplained. Are both on one body, in the same axes, of one time, "
        "and do all axes work?")


def _left(windows, with_bias=False):
    """What share of the turning the rates leave, in the median, and what of its mean square
    (w,)."""
    turns = windows.turns()
    recorded = spread(turns, windows.vectors, with_bias)
    still = spread(np.broadcast_to(np.eye(3), turns.shape), windows.vectors)
    return float(np.median(recorded / still)), recorded


def _other_scale(windows, recorded, what, name, with_bias=False):
    """A finding if rates of another scale fit far better."""
    scale, scaled = _best_scale(windows, with_bias)
    if max(scale, 1.0 / scale) < _SCALED or not is_better(scaled, recorded):
        return []
    return [Finding(
        "unit", f"{name}: {what} turns {scale:.2g} times as fast as the gyroscope says: check its "
        "unit, range and scale, and whether samples were lost and the stamps hide it")]


def _best_scale(windows, with_bias):
    """The factor on the rates that leaves least of the spread (w,), and that."""
    best, least = 1.0, np.empty(0)
    for scales in (_SCALES, _FINER):
        found = {scale: spread(windows.turns(scale), windows.vectors, with_bias)
                 for scale in (float(best * each) for each in scales)}
        best = min(found, key=lambda each: float(found[each].sum()))
        least = found[best]
    return best, least


def _best_delay(windows, with_bias=False):
    """By how much (s) the rates are late, what that leaves of the spread (w,), and what none
    leaves."""
    turns = windows.turns()
    n = turns.shape[1]
    most = min(int(round(_LATEST / windows.step)), n // 4)
    middle = windows.vectors[:, most:n - most]
    found = {k: spread(turns[:, most + k:n - most + k], middle, with_bias)
             for k in range(-most, most + 1)}
    best = min(found, key=lambda k: float(found[k].sum()))
    return best * windows.step, found[best], found[0]
