"""Axes that stand still while all others move: dead, stuck or disconnected.

A sensor's noise changes its reading again and again, however still the body is. An axis that
repeats one value many times longer than it does as a rule, or has never changed, has lost its
sensor; unless its steps are coarser than its noise, or than what the others have moved by since.
Where readings have no noise, as in simulations, many axes stand still together: only what is
confined to one sensor, or to few axes, is judged.
"""

import math

import numpy as np

from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.kernels import njit

_LONGER = 20      # times the usual run of equal values,
_SLOWEST = 10     # which is this in the beginning: a sensor may be slower than it is read
_FEW = 4          # times as many others must not stand still, where several sensors do
_STEPS = 4.0      # by which half of the others must have moved
_SAMPLES = 10     # that are worth a remark

#: What is kept of one channel: its ``last`` reading, how often it came in a row, ``same``; finite
#: ``samples`` and ``changes`` before that; its smallest ``step``; samples that were left ``out``.
STANDING = np.dtype([("last", "f8"), ("same", "i8"), ("samples", "i8"), ("changes", "i8"),
                     ("step", "f8"), ("out", "i8")], align=True)


class StandingAxes:
    """Which channels of an array stand still, by their samples so far: ``found`` (m,) STANDING and
    ``others`` (m, m), what all read when each of them changed last."""

    def __init__(self, params: AccelerationFieldParams, array: SensorArray) -> None:
        self._channels = array.channels
        self._noise = params.noise_scale * array.channels["density"] * np.sqrt(params.sample_rate)
        self.found = np.zeros(len(array.channels), STANDING)
        self.found["last"] = np.nan
        self.found["step"] = np.inf
        self.others = np.full((len(array.channels),) * 2, np.nan)

    def mark(self, readings: np.ndarray) -> np.ndarray:
        """Readings (n, m) of the channels, with -inf, in place, for those that stand still."""
        _mark(self.found, self.others, self._channels, self._noise, readings)
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
def _mark(found, others, channels, noise, readings):
    """Set what stands still to -inf, in place: readings (n, m), whose noise has sds (m,)."""
    stands = np.empty(len(found), np.bool_)
    for n in range(len(readings)):
        sensor, confined, standing, known = -1, True, 0, 0
        for c in range(len(found)):
            own, value = found[c], readings[n, c]
            stands[c] = False
            if not math.isfinite(value):
                continue
            known += 1
            if value == own.last:
                own.same += 1
                usual = own.samples / own.changes if own.changes > 0 else _SLOWEST
                stands[c] = (own.same >= _LONGER * usual and _others_moved(
                    found, others[c], channels, noise, readings[n], c))
                continue
            if not math.isnan(own.last):
                own.changes += 1
                own.samples += own.same + 1
                own.step = min(own.step, abs(value - own.last))
            own.last, own.same = value, 0
            others[c] = readings[n]
        for c in range(len(found)):
            if stands[c]:
                standing += 1
                confined &= sensor < 0 or sensor == channels[c].sensor
                sensor = channels[c].sensor
        judged = standing < known and (confined or _FEW * standing < known)
        for c in range(len(found)):
            if judged and stands[c]:
                readings[n, c] = -math.inf
                found[c].out += 1


@njit
def _others_moved(found, before, channels, noise, reading, c):
    """Whether half of the others of its kind, from what they read ``before`` (m,), have moved by
    several steps of channel c, which are finer than its noise; if they are not known, by the
    largest that are."""
    step = found[c].step
    if step == math.inf:
        step = 0.0
        for d in range(len(found)):
            if channels[d].is_gyro == channels[c].is_gyro and found[d].step < math.inf:
                step = max(step, found[d].step)
    if step > noise[c]:
        return False
    moved, number = 0, 0
    for d in range(len(found)):
        if d != c and channels[d].is_gyro == channels[c].is_gyro and math.isfinite(reading[d]):
            number += 1
            moved += abs(reading[d] - before[d]) > _STEPS * step
    return 2 * moved >= number > 0
