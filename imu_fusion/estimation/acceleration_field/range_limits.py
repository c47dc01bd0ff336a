"""Readings at the end of a sensor's range, which is given or found from flat tops."""

import numpy as np

from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.kernels import njit
from imu_fusion.samples.flat_tops import (
    ACC_FLOOR,
    FLAT_TOPS,
    GYRO_FLOOR,
    LIMIT_TOLERANCE,
    find_flat_tops,
    start_flat_tops,
)

_LOWER = 0.998    # times a range that is given: a limit that is another one
_NEEDED = 6       # channels that a and alpha take


class RangeLimits:
    """What is known of the ranges of an array's sensors, by their samples so far.

    ``found`` (K,) FLAT_TOPS and ``steps`` (K, 3), the smallest by which an axis has changed; the
    gyroscope last. ``beside`` (K,) FLAT_TOPS as if no range were given: one may be lower than that.
    ``bare`` (2,) int, samples in which limits leave no more channels than are needed, of all.
    """

    def __init__(self, array: SensorArray) -> None:
        number = int(array.channels["sensor"].max()) + 1
        self._ranges = np.full((number, 3), np.nan)
        channels = array.channels[np.isfinite(array.channels["range"])]
        self._ranges.reshape(-1)[channels["column"]] = channels["range"]
        self._is_given = bool(len(channels))
        self._accelerometers = array.accelerometers
        self._felt = array.channels["column"][~array.channels["is_gyro"]]
        self._unknown = np.full((number, 3), np.nan)
        self.found = np.zeros(number, FLAT_TOPS)
        self.beside = np.zeros(number, FLAT_TOPS)
        self.bare = np.zeros(2, np.int64)
        self.steps = np.full((number, 3), np.inf)
        _start(self.found, self._ranges)
        _start(self.beside, self._unknown)

    def get_state(self) -> tuple[np.ndarray, ...]:
        """A copy of what is known, for :meth:`set_state`."""
        return self.found.copy(), self.steps.copy(), self.beside.copy(), self.bare.copy()

    def set_state(self, state: tuple[np.ndarray, ...]) -> None:
        """Go on from where :meth:`get_state` was called."""
        self.found, self.steps, self.beside, self.bare = (part.copy() for part in state)

    def mark(self, readings: np.ndarray) -> np.ndarray:
        """Readings (n, 3 K) of all sensors, with inf for those at a limit.

        A limit that is not known is one after some samples at it. A largest value that comes twice
        in a row is left out even before: no noise is so quiet, and the others fill in.
        """
        marked = readings.copy()
        number = _mark(self.found, self.steps, self._ranges, self._accelerometers,
                       marked.reshape(len(readings), -1, 3))
        if self._is_given:
            others = readings.copy()
            number += _mark(self.beside, self.steps, self._unknown, self._accelerometers,
                            others.reshape(len(readings), -1, 3))
            marked[np.isposinf(others)] = np.inf
        self.bare[1] += len(marked)
        if number:
            felt = marked[:, self._felt]
            self.bare[0] += np.sum(np.isposinf(felt).any(axis=1)
                                   & (np.isfinite(felt).sum(axis=1) <= _NEEDED))
        return marked

    @property
    def learnt(self) -> np.ndarray:
        """Limits (K, 3) that were found, not given; inf where there are none."""
        beside = self.beside["limit"]
        return np.where(np.isnan(self._ranges), self.found["limit"],
                        np.where(beside < _LOWER * self._ranges, beside, np.inf))


@njit
def _start(found, ranges):
    for k in range(len(found)):
        start_flat_tops(found[k], ranges[k], LIMIT_TOLERANCE)


@njit
def _mark(found, steps, ranges, accelerometers, readings):
    """Set what is at a limit to inf, in place: readings (n, K, 3), gyroscopes last. Returns how
    many are inf."""
    sample, last, number = np.empty(3), np.empty(3), 0
    for n in range(len(readings)):
        for k in range(len(found)):
            felt = k < accelerometers
            floor = ACC_FLOOR if felt else GYRO_FLOOR
            for i in range(3):
                number += readings[n, k, i] == np.inf
            if not np.isfinite(readings[n, k]).any():
                continue    # lost: what comes next would seem to have jumped
            for i in range(3):
                value = readings[n, k, i]
                last[i] = found[k].last[i]
                sample[i] = value if np.isfinite(value) else last[i]
                if found[k].seen and sample[i] != last[i]:
                    steps[k, i] = min(steps[k, i], abs(sample[i] - last[i]))
            clipped = find_flat_tops(found[k], ranges[k], floor, felt, sample)
            for i in range(3):
                size = abs(sample[i])
                stands = (sample[i] == last[i] and size > floor and np.isnan(ranges[k, i])
                          and size >= found[k].largest[i])
                if np.isfinite(readings[n, k, i]) and (clipped >> i & 1 or stands):
                    readings[n, k, i] = np.inf
                    number += 1
    return number
