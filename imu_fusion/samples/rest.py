"""Rests of a sensor: where neither its rates nor its forces say more than their noise."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.samples.logs import ImuLog, seconds

_WINDOW = 0.5        # s, over which scatter is taken
_QUIET = 5.0         # %, of the windows that are taken for still
_FACTOR = 2.5        # times their scatter is still, too
# What hands and motors leave of stillness: m/s^2, rad/s.
_LEAST_FORCE, _LEAST_RATE = 0.02, 0.002
_LEAST_TURNING = 0.02   # rad/s: a slow even turn scatters no more than a rest
_TRIM = 0.1          # s, of each end, in which a rest is only beginning or ending


class Rest(NamedTuple):
    """Samples [start, stop)."""

    start: int
    stop: int


def find_rests(imu: ImuLog, shortest: float = 1.0) -> list[Rest]:
    """Rests of at least ``shortest`` s, in order.

    What is still is told from the quietest twentieth of the recording: a recording for a
    calibration holds more rest than that.
    """
    if len(imu) < 3:
        return []
    time = seconds(imu.stamp, imu.stamp[0])
    step = float(np.median(np.diff(time)))
    width = max(int(round(_WINDOW / step)), 3)
    still = np.ones(len(imu), bool)
    for values, least in ((imu.gyr, _LEAST_RATE), (imu.acc, _LEAST_FORCE)):
        scatter = _scatter(values, width)
        still &= scatter < np.maximum(_FACTOR * np.percentile(scatter, _QUIET), least)
    if not still.any():
        return []
    mean = scipy.ndimage.uniform_filter1d(imu.gyr, width, axis=0, mode="nearest")
    level = np.median(mean[still], axis=0)
    still &= np.linalg.norm(mean - level, axis=1) < _LEAST_TURNING
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]]))).reshape(-1, 2)
    # A window that is still holds still samples on both sides of its middle.
    wider = width // 2 - int(round(_TRIM / step))
    return [Rest(max(int(a) - wider, 0), min(int(b) + wider, len(imu))) for a, b in edges
            if (b - a + 2 * wider) * step >= shortest]


def _scatter(values, width):
    """(n,) standard deviation of values (n, 3) in a window around each sample, all axes."""
    centred = values - np.median(values, axis=0)
    mean = scipy.ndimage.uniform_filter1d(centred, width, axis=0, mode="nearest")
    square = scipy.ndimage.uniform_filter1d(centred ** 2, width, axis=0, mode="nearest")
    return np.sqrt(np.maximum(square - mean ** 2, 0.0).sum(axis=1))
