"""Stamps of the receiver that lie whole seconds beside those of the Imu.

GPS time taken for UTC is 18 s ahead, a logger that stamps on arrival is late by a second. A state
of the delay finds what is within its prior; this finds the rest: turns and changes of velocity as
fixes and velocities tell them are compared with those that the Imu felt at shifted times.
"""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, VelocityLog

_LARGEST = 30.0       # s, on either side
_GRID = 0.1           # s
_PARABOLA = 21        # points of the grid, of which a velocity is told from fixes
_SPAN = 10            # steps of the grid, over which changes are compared
_FEWEST = 20          # changes
_GAP = 3.0            # periods of the receiver, or the span, after which it says nothing between
_UPRIGHT = 0.5        # length of the mean of the vertical in the body's axes: less has tumbled
_MOVING = 1.0         # m/s, from which on a velocity has a course
_CORRELATION = 0.8    # at the best shift, at least
_BETTER = 0.5         # of the unexplained squares at no shift, that the best may leave at most
_APART = 0.5          # s: what is nearer is for the state of the delay (receivers: 0.1 to 0.3)


def find_lags(samples: np.ndarray, frame: LocalFrame, fix: FixLog | None,
              velocity: VelocityLog | None) -> tuple[float, float]:
    """Seconds by which the stamps of fixes and of velocities are late, 0 where no other shift fits
    far better. What tells none has that of the other.

    Args:
        samples: of a SmootherResult: attitudes, rates and forces at the stamps of the Imu. A wrong
            lag tilts the attitudes until the forces fit; turns about the vertical hardly feel it.
        frame: of the result. fix: FixLog or None. velocity: VelocityLog or None.
    """
    told = None
    if fix is not None and fix.usable.any():
        fix = fix[fix.usable]
        told = _slopes(fix.stamp, frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height))
    later = np.nan_to_num(_later(velocity, told))
    of_velocities = _lag(samples, velocity)
    if np.isnan(of_velocities):
        of_velocities = np.nan_to_num(_lag(samples, told)) + later
    of_fixes = of_velocities - later
    # Forces tell lags to some tenths of a second, fixes and velocities those between them better.
    if later and abs(of_fixes) <= _APART:
        return 0.0, float(later)
    if later and abs(of_velocities) <= _APART:
        return -float(later), 0.0
    return float(of_fixes), float(of_velocities)


def _slopes(stamp, place):
    """VelocityLog of the slopes of parabolas through places (n, 3) m at stamps (n,) ns, about each
    point of a grid; None of too few."""
    at = (stamp - stamp[0]) * 1e-9
    if len(stamp) < _FEWEST or np.any(np.diff(at) <= 0.0) or at[-1] < 2 * _PARABOLA * _GRID:
        return None
    grid = np.arange(0.0, at[-1], _GRID)
    slope = scipy.signal.savgol_filter(
        np.column_stack([np.interp(grid, at, c) for c in place.T]), _PARABOLA, 2, deriv=1,
        delta=_GRID, axis=0)
    step = np.diff(at)[np.clip(np.searchsorted(at, grid, side="right") - 1, 0, len(at) - 2)]
    known = step <= max(_GAP * np.median(np.diff(at)), _SPAN * _GRID)
    return VelocityLog(stamp[0] + np.round(1e9 * grid[known]).astype(np.int64), slope[known],
                       np.zeros((int(known.sum()), 3, 3)))


def _later(velocity, of_fixes):
    """Seconds by which velocities are later than those that fixes tell; NaN: it is not told."""
    if velocity is None or of_fixes is None or len(velocity) < 3:
        return np.nan
    steps = np.diff(velocity.stamp)[:, None] * 1e-9
    place = np.vstack([np.zeros(3), np.cumsum(
        0.5 * (velocity.vel_world[1:] + velocity.vel_world[:-1]) * steps, axis=0)])
    velocity = _slopes(velocity.stamp, place)
    if velocity is None:
        return np.nan
    start = of_fixes.stamp[0]
    at, told_at = ((log.stamp - start) * 1e-9 for log in (velocity, of_fixes))
    grid = np.arange(min(at[0], told_at[0]), max(at[-1], told_at[-1]) + _GRID, _GRID)
    return _best(_told(grid, told_at, of_fixes.vel_world), _told(grid, at, velocity.vel_world))[1]


def _lag(samples, velocity):
    """That of velocities; NaN where they tell none."""
    if velocity is None or len(velocity) < 3:
        return np.nan
    t = (samples["stamp"] - samples["stamp"][0]) * 1e-9
    at = (velocity.stamp - samples["stamp"][0]) * 1e-9
    turn = scipy.spatial.transform.Rotation.from_quat(samples["quat_world_imu"])
    vel = velocity.vel_world
    course = np.unwrap(np.arctan2(vel[:, 1], vel[:, 0]))
    grid = np.arange(min(t[0], at[0]), max(t[-1], at[-1]) + _GRID, _GRID)
    # Of the forces gravity is a mean, which is put aside.
    felt = _felt(grid, t, np.column_stack([turn.apply(samples["gyr"])[:, 2],
                                           turn.apply(samples["acc"])]))
    told = _told(grid, at, np.column_stack([course, vel]))
    moving = np.interp(grid, at, np.linalg.norm(vel[:, :2], axis=1)) > _MOVING
    told[~(moving[_SPAN:] & moving[:-_SPAN]), 0] = np.nan
    vertical = turn.inv().apply([0.0, 0.0, 1.0]).mean(axis=0)
    if np.linalg.norm(vertical) < _UPRIGHT:
        # The course of a body that tumbles does not turn with it.
        return _best(felt[:, 1:], told[:, 1:])[1]
    return max(_best(felt[:, :1], told[:, :1]), _best(felt[:, 1:], told[:, 1:]))[1]


def _felt(grid, t, rate):
    """Integrals of a rate (n, k) over a span behind each point of the grid, NaN outside."""
    sums = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t)[:, None], axis=0)
    sums = np.vstack([np.zeros(rate.shape[1]), sums])
    sums = np.column_stack([np.interp(grid, t, s, np.nan, np.nan) for s in sums.T])
    return sums[_SPAN:] - sums[:-_SPAN]


def _told(grid, at, values):
    """Changes of values (m, k) over a span behind each point of the grid, NaN outside and in
    gaps."""
    between = np.clip(np.searchsorted(at, grid), 1, len(at) - 1)
    gap = at[between] - at[between - 1] > max(_GAP * np.median(np.diff(at)), _SPAN * _GRID)
    values = np.column_stack([np.interp(grid, at, v, np.nan, np.nan) for v in values.T])
    values[gap] = np.nan
    return values[_SPAN:] - values[:-_SPAN]


def _best(felt, told):
    """Correlation and lag (s) of the shift at which what was told (n, k) fits what was felt; the
    lag is NaN unless it fits well there, and far worse without."""
    most = min(round(_LARGEST / _GRID), len(felt) // 2)
    fits = {}
    for lag in range(-most, most + 1):
        # What was told at i + lag was felt at i.
        a, b = (felt[:len(felt) - lag], told[lag:]) if lag >= 0 else (felt[-lag:], told[:lag])
        fits[lag] = _compare(a, b, 0.3 * np.isfinite(told[:, 0]).sum())
    best = max(fits, key=lambda lag: fits[lag][0])
    if fits[best][0] <= _CORRELATION:
        return fits[best][0], np.nan
    if abs(best) * _GRID <= _APART:
        return fits[best][0], 0.0
    return fits[best][0], best * _GRID if fits[best][1] < _BETTER * fits[0][1] else np.nan


def _compare(felt, told, fewest):
    """Correlation of two series of changes (n, k), their means aside, and the mean square that is
    not explained."""
    both = np.isfinite(felt[:, 0]) & np.isfinite(told).all(axis=1)
    if both.sum() < max(_FEWEST, fewest):
        return 0.0, np.inf
    felt, told = felt[both], told[both]
    felt, told = felt - felt.mean(axis=0), told - told.mean(axis=0)
    size = np.sqrt(np.sum(felt ** 2) * np.sum(told ** 2))
    return (float(np.sum(felt * told) / size) if size > 0.0 else 0.0,
            float(np.mean((felt - told) ** 2)))
