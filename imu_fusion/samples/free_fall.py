"""Free fall: where a body feels nothing, and so stands on nothing."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are first used
from numpy.typing import ArrayLike

#: Largest specific force, g, and shortest time, s, of what counts as free fall.
FREE_FALL, FLIGHT_TIME = 0.25, 0.12

_GAP = 3.0    # usual steps


class Fall(NamedTuple):
    """Samples from ``start`` to ``end``, the first that is none, or the last before a gap."""

    start: int
    end: int


def free_falls(time: np.ndarray, force: np.ndarray, gravity: float, largest: float = FREE_FALL,
               shortest: float = FLIGHT_TIME) -> list[Fall]:
    """Intervals in which only gravity acts; a gap in the samples ends one, since nobody knows.

    Args:
        time: (n,) s. force: (n, 3) m/s^2, of the body's centre (:func:`force_at`): at a rate of 35
            rad/s a sensor 35 mm off it feels 4 g in flight. gravity: m/s^2.
        largest: specific force, g. shortest: s.
    """
    size = scipy.ndimage.median_filter(np.linalg.norm(force, axis=1), 3, mode="nearest")
    free = np.concatenate([[False], size < largest * gravity, [False]])
    edges = np.flatnonzero(np.diff(free.astype(int))).reshape(-1, 2)
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > _GAP * np.median(steps)) + 1
    found = []
    for a, b in edges:
        inside = gaps[(gaps > a) & (gaps <= b)]
        for begin, end in zip([a, *inside], [*(inside - 1), min(b, len(time) - 1)]):
            found.append(Fall(int(begin), int(end)))
    return [fall for fall in found if time[fall.end] - time[fall.start] >= shortest]


def force_at(point: ArrayLike, time: np.ndarray, force: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Specific force (n, 3) m/s^2 at a point (3,) m from the accelerometers, in their axes: Winkler
    2025, bracket of eq. (18), with central differences of the rates, eq. (19), one-sided at the
    ends.

    Args:
        time: (n,) s. force: (n, 3) m/s^2. rate: (n, 3) rad/s.
    """
    arm, n = np.asarray(point, dtype=float), len(time)
    after, before = np.minimum(np.arange(n) + 1, n - 1), np.maximum(np.arange(n) - 1, 0)
    change = (rate[after] - rate[before]) / (time[after] - time[before])[:, None]
    return force + np.cross(change, arm) + np.cross(rate, np.cross(rate, arm))
