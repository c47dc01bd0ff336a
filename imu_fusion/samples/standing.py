"""Axes of an Imu that stand still while the body turns: dead, stuck, or not measured."""

import numpy as np

from imu_fusion.samples.equal_runs import equal_runs
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.logs import ImuLog
from imu_fusion.samples.turning import gravity_follows

_LONGER = 20      # times the usual run of equal values
_FEWEST = 100     # samples: a turn takes longer
_COARSE = 20      # values that an axis has at least: else its steps may be longer than its noise
_TURNED = 0.35    # rad by which gravity must turn meanwhile,
_MOVED = 2.0      # or m/s^2 by which another axis of an accelerometer must change


def check_standing(imu: ImuLog, name: str) -> list[Finding]:
    """A finding each about the gyroscope and the accelerometer, if axes of it stand still for long
    while gravity turns; none where it turns exactly as the gyroscope says, or about the one axis
    that the gyroscope knows: a body that is simulated without noise may turn about few axes."""
    known = np.isfinite(imu.gyr).all(axis=1) & np.isfinite(imu.acc).all(axis=1)
    gyr, acc = imu.gyr[known], imu.acc[known]
    if len(gyr) < _FEWEST or not gyr.any() or not acc.any():
        return []    # check_parts says so
    result = []
    for values, quantity, unit in ((gyr, "angular velocity", "rad/s"),
                                   (acc, "acceleration", "m/s^2")):
        stands = [(axis, found) for axis in range(3)
                  if (found := _longest_stand(values[:, axis])) is not None]
        stands = [(axis, part) for axis, part in stands
                  if (_turned(acc[part], _changing(gyr[part])) > _TURNED if values is gyr else
                      set(_changing(gyr[part])) - {axis}
                      and _moved(np.delete(acc[part], axis, axis=1)) > _MOVED)
                  and not gravity_follows(imu.stamp[known][part], gyr[part], acc[part])]
        if stands:
            part = stands[0][1]
            axes = ", ".join("xyz"[axis] for axis, _ in stands)
            at = ", ".join(f"{values[part.start, axis]:.4g}" for axis, _ in stands)
            result.append(Finding(
                "held", f"{name}: {quantity} {axes} stands still at {at} {unit} from sample "
                f"{np.flatnonzero(known)[part.start]} on, for {part.stop - part.start} samples, "
                "while gravity turns: dead, stuck or not measured; what is estimated from there on "
                "is wrong", unusable=True))
    return result


def _longest_stand(column):
    """Slice of the longest run of equal values (n,), if it is far longer than usual and not at
    the end of the range; of all of them, if they never change."""
    starts, lengths = equal_runs(column)
    if len(starts) == 1:
        return slice(0, len(column))
    k = int(np.argmax(lengths))
    first, length = int(starts[k]), int(lengths[k])
    usual = int(np.percentile(np.delete(lengths, k), 95))
    if (length < max(_LONGER * usual, _FEWEST) or len(np.unique(column)) < _COARSE
            or abs(column[first]) >= np.abs(column).max()):
        return None
    return slice(first, first + length)


def _changing(values):
    """Axes of (n, 3) that do not stand still. A body that is simulated without noise may turn about
    one alone: then the rates about the others, and its part of gravity, rightly stand."""
    return np.flatnonzero(np.ptp(values, axis=0))


def _turned(acc, about):
    """By how much (rad) directions turn, of means over tenths of (n, 3); where the body turns about
    a single axis (``about``), by how much more than that explains."""
    means = np.array([part.mean(axis=0) for part in np.array_split(acc, 10)])
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)
    if len(about) == 1:
        return float(np.ptp(np.arccos(np.clip(means[:, about[0]], -1.0, 1.0))))
    return float(np.arccos(np.clip((means @ means.T).min(), -1.0, 1.0)))


def _moved(values):
    """By how much (n, k) vary, of means over tenths."""
    means = np.array([part.mean(axis=0) for part in np.array_split(values, 10)])
    return float(np.ptp(means, axis=0).max())
