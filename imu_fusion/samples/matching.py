"""Samples of several sensors that belong together, found by their stamps."""

from bisect import bisect_left
from typing import Any

import numpy as np

Row = tuple[int, np.ndarray]
"""Stamp and readings (sensors, width) that belong to it."""


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
            self._left = stamp
            leaving.append((stamp, readings))
        return leaving
