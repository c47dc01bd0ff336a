"""Axes that stand still while all others move: dead, stuck or disconnected.

A sensor's noise changes its reading again and again, however still the body is. An axis that was
seen to change and then repeats one value many times longer than it ever does as a rule has lost
its sensor. Where readings have no noise, as in simulations, several sensors stand still together:
only what is confined to one of them is judged.
"""

import math

import numpy as np

from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.kernels import njit

_LONGER = 20      # times the usual run of equal values
_SAMPLES = 10     # that are worth a remark

#: What is kept of one channel: its ``last`` reading, how often it came in a row, ``same``; finite
#: ``samples`` and ``changes`` before that; samples that were left out, ``out``.
STANDING = np.dtype([("last", "f8"), ("same", "i8"), ("samples", "i8"), ("changes", "i8"),
                     ("out", "i8")], align=True)


class StandingAxes:
    """Which channels of an array stand still, by their samples so far: ``found`` (m,) STANDING."""

    def __init__(self, array: SensorArray) -> None:
        self._channels = array.channels
        self.found = np.zeros(len(array.channels), STANDING)
        self.found["last"] = np.nan

    def mark(self, readings: np.ndarray) -> np.ndarray:
        """Readings (n, m) of the channels, with -inf, in place, for those that stand still."""
        _mark(self.found, self._channels, readings)
        return readings

    def texts(self, names: list[str]) -> dict[int, str]:
        """What to say, by the number of the sensor; the gyroscope comes after the ``names``."""
        said = {}
        for number in np.unique(self._channels["sensor"][self.found["out"] >= _SAMPLES]):
            own = (self._channels["sensor"] == number) & (self.found["out"] >= _SAMPLES)
            is_gyro = number == len(names)
            axes = ", ".join("xyz"[column % 3] for column in self._channels["column"][own])
            values = ", ".join(f"{value:.4g}" for value in self.found["last"][own])
            who = "the gyroscope" if is_gyro else f"accelerometer '{names[number]}'"
            said[int(number)] = (
                f"{who} stands still at {values} {'rad/s' if is_gyro else 'm/s^2'} ({axes}) while "
                f"the others move, and was left out there in {self.found['out'][own].max()} "
                "samples: it is dead, stuck or disconnected")
        return said


@njit
def _mark(found, channels, readings):
    """Set what stands still to -inf, in place: readings (n, m)."""
    stands = np.empty(len(found), np.bool_)
    for n in range(len(readings)):
        sensor, confined = -1, True
        for c in range(len(found)):
            own, value = found[c], readings[n, c]
            stands[c] = False
            if not math.isfinite(value):
                continue
            if value == own.last:
                own.same += 1
                stands[c] = own.changes > 0 and own.same * own.changes >= _LONGER * own.samples
            elif math.isnan(own.last):
                own.last = value
            else:
                own.changes += 1
                own.samples += own.same + 1
                own.last, own.same = value, 0
            if stands[c]:
                confined &= sensor < 0 or sensor == channels[c].sensor
                sensor = channels[c].sensor
        for c in range(len(found)):
            if confined and stands[c]:
                readings[n, c] = -math.inf
                found[c].out += 1
