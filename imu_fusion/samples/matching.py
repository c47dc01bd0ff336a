"""Samples of several sensors that belong together, found by their stamps."""

from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import numpy as np

Row = tuple[int, np.ndarray]
"""Stamp and readings (sensors, width) that belong to it."""

Matched = tuple[np.ndarray, np.ndarray]
"""Stamps (n,) int64 and readings (n, sensors, width); NaN where a sensor is missing."""


class SampleMatcher:
    """Puts samples of like sensors, one topic each, into rows of equal stamps.

    Samples whose stamps differ by at most ``tolerance`` from the first of a row belong to it. A
    row leaves when it is complete and all rows before it have left, or when a sample more than
    ``hold`` later has come; sensors that are missing then are NaN. A sample whose row has left is
    late, one of a sensor that is in the row already is a duplicate: both are left out and
    counted. What leaves depends on stamps alone as long as no sample comes more than ``hold``
    late.

    Args:
        sensors: number of sensors.
        width: numbers in one sample.
        tolerance, hold: int nanoseconds.
    """

    def __init__(self, sensors: int, width: int, tolerance: int, hold: int) -> None:
        self._shape = (sensors, width)
        self._tolerance = tolerance
        self._hold = hold
        self.late = 0
        self.duplicates = 0
        self.incomplete = 0
        self.left = 0    # rows that have left
        self._stamps: list[int] = []   # of the waiting rows, ascending
        self._rows: list[Any] = []     # [readings, number of sensors in it]
        self._newest: int | None = None
        self._left: int | None = None   # stamp of the last row that left

    def add(self, sensor: int, stamp: int, sample: np.ndarray) -> list[Row]:
        """Take one sample; return the list of (stamp, readings (sensors, width)) that leave."""
        if self._left is not None and stamp <= self._left + self._tolerance:
            self.late += 1
            return []
        place = self._find(stamp)
        if place is None:
            place = bisect_left(self._stamps, stamp)
            self._stamps.insert(place, stamp)
            self._rows.insert(place, [np.full(self._shape, np.nan), set()])
        readings, present = self._rows[place]
        if sensor in present:
            self.duplicates += 1
            return []
        readings[sensor] = sample
        present.add(sensor)
        self._newest = stamp if self._newest is None else max(self._newest, stamp)
        return self._leaving(self._newest - self._hold)

    def add_block(self, samples: Mapping[int, tuple[np.ndarray, np.ndarray]]) -> Matched:
        """Take stamps (n,) and values (n, width) of sensors, by number; what leaves of it, as one
        by one in order of stamps, sensors of one stamp in order of their numbers."""
        together = self._together(samples)
        if together is not None:
            return together
        number = np.concatenate([np.full(len(s), k) for k, (s, _) in samples.items()])
        stamp = np.concatenate([s for s, _ in samples.values()])
        values = np.concatenate([v for _, v in samples.values()])
        leaving: list[Row] = []
        for i in np.lexsort([number, stamp]).tolist():
            leaving += self.add(int(number[i]), int(stamp[i]), values[i])
        return self._as_arrays(leaving)

    def flush_block(self) -> Matched:
        """:meth:`flush` as arrays."""
        return self._as_arrays(self.flush())

    def _together(self, samples: Mapping[int, tuple[np.ndarray, np.ndarray]]) -> Matched | None:
        """The usual case, as arrays: every sensor at the same stamps, nothing waiting."""
        first = next(iter(samples.values()))[0]
        if (self._stamps or len(samples) < self._shape[0] or not len(first)
                or not all(len(s) == len(first) and (s == first).all() for s, _ in samples.values())
                or (first[1:] - first[:-1] <= self._tolerance).any()
                or (self._left is not None and first[0] <= self._left + self._tolerance)):
            return None
        self._left = self._newest = int(first[-1])
        self.left += len(first)
        return first, np.stack([samples[k][1] for k in range(self._shape[0])], axis=1)

    def _as_arrays(self, rows: list[Row]) -> Matched:
        if not rows:
            return np.empty(0, np.int64), np.empty((0, *self._shape))
        stamps, readings = zip(*rows)
        return np.array(stamps, dtype=np.int64), np.array(readings)

    def flush(self) -> list[Row]:
        """All rows that still wait, complete or not."""
        return self._leaving(np.inf)

    def _find(self, stamp: int) -> int | None:
        place = bisect_left(self._stamps, stamp - self._tolerance)
        if place < len(self._stamps) and self._stamps[place] <= stamp + self._tolerance:
            return place
        return None

    def _leaving(self, bound: float) -> list[Row]:
        leaving = []
        while self._stamps and (len(self._rows[0][1]) == self._shape[0]
                                or self._stamps[0] < bound):
            stamp = self._stamps.pop(0)
            readings, present = self._rows.pop(0)
            self.incomplete += len(present) < self._shape[0]
            self.left += 1
            self._left = stamp
            leaving.append((stamp, readings))
        return leaving
