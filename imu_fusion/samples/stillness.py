"""When a body rests on the Earth, told from a steady ride by what vibrates.

No Imu tells rest from a straight ride at a constant speed; but whatever rides is shaken, and
slowly: a vehicle, a lift, a hand sway at a few hertz or less, where a sensor at rest has its white
noise alone. So the means over a tenth of a second are compared with what white noise of the
samples leaves of them (von Neumann 1941: the mean square of successive differences).
"""

from typing import NamedTuple

import numpy as np

from imu_fusion.samples.logs import ImuLog

_FAST = 0.02         # s, over which samples are averaged first: filters colour their noise
_BLOCK = 5           # such means in a tenth of a second
_WINDOW = 10         # blocks, in which scatter is taken
_TRIM = 2            # blocks at an end, in which a motion may begin or end unseen
_WHITE = 3.0         # variance of blocks in a window, by what white noise leaves of them
_REST = 2.0          # and of the windows of a rest, the median
_LOUD = 1.5          # times the stated noise, that a sensor at rest may have
_LOUDER = 2.0        # and times that of the quietest rest of the recording:
_QUIETEST = 5.0      # %, of what may be rest
_STEP = 1.0          # noise of a fiftieth of a second, by which means of a second may differ
# Scatter that passes whatever the noise: what digits and a table leave of it; rad/s, m/s^2.
_LEAST_RATE, _LEAST_FORCE = 5e-4, 5e-3
_TURNING = 0.02      # rad/s, by which mean rates of rests differ, for all that biases wander
_GRAVITY = 9.81
_FORCE = 0.15        # of gravity, by which a force at rest may differ from it


class Still(NamedTuple):
    """Samples [start, stop) at rest, and how unlike white noise they are: variance of blocks by
    that which white noise leaves, of the sensor for which it is largest."""

    start: int
    stop: int
    unrest: float


def find_still(imu: ImuLog, noise: tuple[float, float], shortest: float = 1.0) -> list[Still]:
    """Rests of at least ``shortest`` s, in order.

    Args:
        imu: ImuLog, finite, stamps ascending. noise: densities of rates and forces that the sensors
            have at most.
    """
    if len(imu) < 2:
        return []
    step = float(np.median(np.diff(imu.stamp))) * 1e-9
    fast = max(int(round(_FAST / step)), 1)
    quick = max(int(round(_BLOCK * _FAST / (fast * step))), 2)
    count = len(imu) // (fast * quick)
    if count < _WINDOW:
        return []
    means, scatter, level, quiet = [], [], [], np.ones(count - _WINDOW + 1, bool)
    for values, density, least in ((imu.gyr, noise[0], _LEAST_RATE),
                                   (imu.acc, noise[1], _LEAST_FORCE)):
        fine = values[:count * quick * fast].reshape(count, quick, fast, 3).mean(axis=2)
        expected = _windows(0.5 * np.square(np.diff(fine, axis=1)).mean(axis=1)).mean(axis=-1)
        quiet &= (expected < (_LOUD * density) ** 2 / (fast * step) + least ** 2).all(axis=1)
        level.append(np.sqrt(expected.mean(axis=1)) + least)
        means.append(_windows(fine.mean(axis=1)))
        # A constant axis is digits: it shows nothing.
        scatter.append((np.maximum(means[-1].var(axis=-1, ddof=1), least ** 2)
                        / np.maximum(expected / quick, least ** 2)).mean(axis=1))
    unrest = np.maximum(*scatter)
    rate, force = (each.mean(axis=-1) for each in means)
    quiet &= (unrest < _WHITE) & (
        np.abs(np.linalg.norm(force, axis=1) - _GRAVITY) < _FORCE * _GRAVITY)
    if not quiet.any():
        return []
    quiet &= np.linalg.norm(rate - np.median(rate[quiet], axis=0), axis=1) < _TURNING
    for each in level if quiet.any() else ():
        quiet &= each < _LOUDER * np.percentile(each[quiet], _QUIETEST)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], quiet.astype(int), [0]])))
    runs: list[tuple[int, int]] = []
    for first, last in edges.reshape(-1, 2):
        # A window that by chance is not quiet interrupts no rest; a step of the force does.
        if runs and first - runs[-1][1] < _WINDOW and np.linalg.norm(
                force[first] - force[runs[-1][1] - 1]) < _STEP * level[1][first]:
            runs[-1] = runs[-1][0], last
        else:
            runs.append((first, last))
    rests: list[Still] = []
    size = fast * quick
    for first, last in runs:
        begin = 0 if first == 0 else int(first) + _TRIM
        end = int(last) + _WINDOW - 1 - (_TRIM if last < len(unrest) else 0)
        begin = max(begin, rests[-1].stop // size if rests else 0)
        typical = float(np.median(unrest[first:last]))
        if (end - begin) * size * step >= shortest and typical < _REST:
            rests.append(Still(begin * size, end * size, typical))
    return rests


def _windows(values):
    """(k, 3, _WINDOW) of blocks (n, 3)."""
    return np.lib.stride_tricks.sliding_window_view(values, _WINDOW, axis=0)
