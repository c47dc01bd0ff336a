"""Gravity that does not turn as the gyroscope says, where no other axes and no degrees explain it.

Accelerations are felt beside gravity whatever the gyroscope says. How large they are, their share
along gravity tells: the force's length. Only where that stands still a delay shows.
"""

import numpy as np

from imu_fusion.samples.findings import Finding
from imu_fusion.samples.logs import ImuLog
from imu_fusion.samples.turning import Windows, is_better, spread

_FEWEST = 3             # windows that prove anything
_MOST = 20              # that are looked at
_GRAVITY = 9.81
_NEAR_GRAVITY = 0.1     # of it, by which the force's length may differ where nothing accelerates,
_CALM = 0.05            # and scatter within a window
_LATEST = 0.3           # s between the two sensors
_LATE = 0.02            # s: less is a matter of filters
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
    if len(windows) < _FEWEST:
        return []
    windows.keep(np.arange(min(len(windows), _MOST)))
    left, recorded = _left(windows)
    norm = np.linalg.norm(windows.vectors, axis=2)
    felt = 3.0 * np.mean((norm - _GRAVITY) ** 2, axis=1)
    if left > _FITS:
        found = _other_scale(windows, recorded, name)
        if found:
            return found
        if left > _NOT_AT_ALL and np.median(recorded / felt) > _BEYOND:
            return [Finding(
                "axes", f"{name}: gravity does not turn as the gyroscope says: {min(left, 1.0):.0%}"
                " of its turning is left unexplained. Are both on one body, in the same axes, of "
                "one time, and do all axes work?")]
    windows.keep(np.flatnonzero((np.abs(norm.mean(axis=1) / _GRAVITY - 1.0) < _NEAR_GRAVITY)
                                & (norm.std(axis=1) < _CALM * _GRAVITY)))
    if len(windows) < _FEWEST:
        return []
    late, by_delay, at_once = _best_delay(windows)
    if abs(late) > _LATE and is_better(by_delay, at_once):
        return [Finding(
            "stamp", f"{name}: gravity turns as if the gyroscope were {abs(late) * 1e3:.0f} ms "
            f"{'later' if late > 0.0 else 'earlier'} than the accelerometer: give both the stamps "
            "of their measurements, or take them from one sensor")]
    left, recorded = _left(windows)
    return _other_scale(windows, recorded, name) if left > _FITS_CALMLY else []


def _left(windows):
    """What share of the turning of gravity the rates leave, in the median, and what of its mean
    square (w,)."""
    turns = windows.turns()
    recorded = spread(turns, windows.vectors)
    still = spread(np.broadcast_to(np.eye(3), turns.shape), windows.vectors)
    return float(np.median(recorded / still)), recorded


def _other_scale(windows, recorded, name):
    """A finding if rates of another scale fit far better."""
    scale, scaled = _best_scale(windows)
    if max(scale, 1.0 / scale) < _SCALED or not is_better(scaled, recorded):
        return []
    return [Finding(
        "unit", f"{name}: gravity turns {scale:.2g} times as fast as the gyroscope says: check its "
        "unit, range and scale, and whether samples were lost and the stamps hide it")]


def _best_scale(windows):
    """The factor on the rates that leaves least of the spread (w,), and that."""
    best, least = 1.0, np.empty(0)
    for scales in (_SCALES, _FINER):
        found = {float(best * scale): spread(windows.turns(best * scale), windows.vectors)
                 for scale in scales}
        best = min(found, key=lambda each: float(found[each].sum()))
        least = found[best]
    return best, least


def _best_delay(windows):
    """By how much (s) the rates are late, what that leaves of the spread (w,), and what none
    leaves."""
    turns = windows.turns()
    n = turns.shape[1]
    most = min(int(round(_LATEST / windows.step)), n // 4)
    middle = windows.vectors[:, most:n - most]
    found = {k: spread(turns[:, most + k:n - most + k], middle) for k in range(-most, most + 1)}
    best = min(found, key=lambda k: float(found[k].sum()))
    return best * windows.step, found[best], found[0]
