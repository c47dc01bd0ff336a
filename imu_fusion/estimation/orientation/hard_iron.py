"""Hard iron that nobody has calibrated: what the magnetometer shows of itself as it turns.

While a sensor turns, the field stands still in axes that do not turn, and what the sensor carries
turns with it. Over windows of a few seconds the gyroscope alone says how it turned, so that the
field of one window need not be that of another: with R_n from the axes of each sample to those that
stand still,

    R_n (m_n - offset) = field of the window + e_n

is linear in the offset. Two hypotheses are compared by their evidence: the offset is what a
calibration leaves over, or may be any (of the size of the field). Where the second is a thousand
times likelier it is said. Of a whole recording, and where the estimator aligns anew after a gap,
the offset is then taken off from the first sample on. Live the heading that was begun with it
stays, with a variance that has what the offset does to a needle: that of a moment is no better.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from imu_fusion.estimation.orientation.mag_repeats import REPEATS, is_stale
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize, quat_to_matrix
from imu_fusion.kernels import njit
from imu_fusion.samples.equal_runs import equal_runs
from imu_fusion.sensors.saturation import saturated_axes

if TYPE_CHECKING:
    from imu_fusion.estimation.orientation.params import OrientationParams

_WINDOW = 2.0              # s: the body turns, and a bias adds little
_FEWEST = 5                # samples of a window
_TURNED = 0.02             # share of directions that a window must show (1 - R'R of its mean R)
_UNCALIBRATED_SD = 1.0     # of the field, per axis: a magnetometer as it comes in its case
_EVIDENCE = math.log(1000.0)
# What places do within a window before there are any, of the field, per axis; counted as so many
# windows. Errors within one window count as one: places last.
_USUAL_SD, _USUAL_WINDOWS = 0.1, 4.0
_STANDS = 100              # samples
_FURTHER = 14.156          # squared distance (3 sigma) beyond which an offset is corrected again

HARD_IRON = np.dtype([
    # The window being collected: its beginning, int64 ns, and sums over its samples.
    ("since", "i8"), ("count", "i8"),
    ("turn", "f8", (3, 3)),              # of R
    ("carried", "f8", 3), ("raw", "f8", 3),   # T, of R m and of m
    ("square", "f8"),                    # T^2, of |m|^2
    # Sums of the means of all windows.
    ("windows", "i8"),
    ("normal", "f8", (3, 3)), ("right", "f8", 3),   # of 1 - R'R and m - R'(R m)
    ("spread", "f8"),                    # T^2, of |R m - its mean|^2
    ("mean", "f8", 3), ("size", "f8"),   # T, T^2, of m and |m|^2
    # What was found.
    ("found", "i8"),                     # how many times it was taken off anew
    ("offset", "f8", 3),                 # T, imu axes, beside sensor.mag_offset
    ("cov", "f8", (3, 3)),               # of it, relative to the field's norm
    ("taken_off", "f8", 3),              # T, of samples: what was found before the alignment
    ("heading_var", "f8"),               # rad^2, by what was found since
], align=True)
"""Turning of the magnetometer's samples, and what it says of their offset."""


@njit
def interrupt(iron):
    """Drop the window: how the sensor turned in it is not known."""
    iron.count = 0


@njit
def add(iron, stamp, quat, field):
    """Take one sample (3,) tesla, at an attitude (4,) in axes that stand still; whether a window
    has ended before it."""
    ended = False
    if iron.count > 0 and stamp - iron.since >= _WINDOW * 1e9:
        ended = _close(iron)
    if iron.count == 0:
        iron.since = stamp
        iron.square = 0.0
        for i in range(3):
            iron.carried[i] = iron.raw[i] = 0.0
            for j in range(3):
                iron.turn[i, j] = 0.0
    r = quat_to_matrix(quat)
    for i in range(3):
        for j in range(3):
            iron.turn[i, j] += r[i, j]
            iron.carried[i] += r[i, j] * field[j]
        iron.raw[i] += field[i]
        iron.square += field[i] ** 2
    iron.count += 1
    return ended


@njit
def _close(iron):
    """Take the window into the sums; whether it shows anything."""
    n = iron.count
    iron.count = 0
    if n < _FEWEST:
        return False
    shown = 3.0
    for i in range(3):
        for j in range(3):
            shown -= (iron.turn[i, j] / n) ** 2
    if shown < _TURNED:
        return False
    iron.windows += 1
    iron.size += iron.square / n
    iron.spread += iron.square / n
    for i in range(3):
        back = 0.0
        for j in range(3):
            back += iron.turn[j, i] / n * iron.carried[j] / n
            same = 0.0
            for k in range(3):
                same += iron.turn[k, i] / n * iron.turn[k, j] / n
            iron.normal[i, j] += (1.0 if i == j else 0.0) - same
        iron.right[i] += iron.raw[i] / n - back
        iron.mean[i] += iron.raw[i] / n
        iron.spread -= (iron.carried[i] / n) ** 2
    return True


@njit
def judge(iron, stated_sd):
    """Whether the windows so far ask for another offset, which is then in ``iron``.

    stated_sd: relative to the field's norm, per axis, what a calibration leaves over.
    """
    if iron.windows == 0 or stated_sd >= _UNCALIBRATED_SD:
        return False
    norm = math.sqrt(iron.size / iron.windows)
    normal, right = iron.normal.copy(), iron.right / norm
    left = iron.spread / norm ** 2 - right @ np.linalg.solve(normal + 1e-6 * np.eye(3), right)
    variance = ((max(left, 0.0) / 3.0 + _USUAL_WINDOWS * _USUAL_SD ** 2)
                / (iron.windows + _USUAL_WINDOWS))
    information, score = normal / variance, right / variance
    evidence = (_evidence(information, score, _UNCALIBRATED_SD)
                - _evidence(information, score, stated_sd))
    if evidence < _EVIDENCE:
        return False
    cov = np.linalg.inv(information + np.eye(3) / _UNCALIBRATED_SD ** 2)
    offset = norm * (cov @ score)
    if iron.found > 0:
        further = (offset - iron.offset) / norm
        if further @ np.linalg.solve(iron.cov + stated_sd ** 2 * np.eye(3), further) < _FURTHER:
            return False
    field = iron.size / iron.windows
    for i in range(3):
        field += offset[i] ** 2 - 2.0 * offset[i] * iron.mean[i] / iron.windows
    iron.offset[:] = offset
    iron.cov[:] = cov * min(norm ** 2 / max(field, 1e-30), 1.0 / _TURNED)
    iron.found += 1
    return True


@njit
def doubt_heading(iron, horizontal):
    """Variance of a heading by an offset that is not taken off. horizontal: T, of the field."""
    left = 0.0
    for i in range(3):
        left += (iron.offset[i] - iron.taken_off[i]) ** 2
    iron.heading_var = left / 3.0 / max(horizontal ** 2, 1e-30)


@njit
def _evidence(information, score, sd):
    """Log evidence of an offset of a standard deviation per axis, less what all have in common."""
    total = information + np.eye(3) / sd ** 2
    return 0.5 * (score @ np.linalg.solve(total, score) - math.log(np.linalg.det(total) * sd ** 6))


def search(iron: np.ndarray, stamps: np.ndarray, gyr: np.ndarray, limits: np.ndarray,
           bias: np.ndarray, mag_stamps: np.ndarray, mags: np.ndarray,
           params: "OrientationParams") -> bool:
    """:func:`judge` of a whole recording.

    Args:
        iron: (k,) HARD_IRON, all equal; changed.
        stamps: (n,) int64 ns; those not newer than the one before are left out. gyr: (n, 3) rad/s.
        limits: (3,) rad/s, of the gyroscope. bias: (3,) rad/s.
        mag_stamps, mags: (m,), (m, 3) tesla, calibrated as far as they are.
        params: OrientationParams.
    """
    if len(mags) == 0:
        return False
    newest = np.maximum.accumulate(stamps)
    kept = np.append(True, newest[1:] > newest[:-1])
    stamps, gyr = stamps[kept], np.ascontiguousarray(gyr[kept])
    lost = (saturated_axes(gyr, limits).any(axis=1) | _stands(gyr)
            | (np.diff(stamps, prepend=stamps[:1]) > params.gap.max * 1e9))
    tried = iron[:1].copy()
    found = bool(_search(tried, np.zeros(1, REPEATS), stamps, gyr - bias, lost, mag_stamps, mags,
                         params.sensor.mag_noise_sd, params.fusion.mag_offset_sd))
    iron[:] = tried
    return found


def _stands(gyr):
    """Mask (n,) of rates (n, 3) that repeat for long: at rest, which shows nothing, or stuck."""
    _, lengths = equal_runs(gyr)
    return np.repeat(lengths >= _STANDS, lengths)


@njit
def _search(tried, repeats, stamps, gyr, lost, mag_stamps, mags, noise_sd, stated_sd):
    """See :func:`search`. repeats: (1,) REPEATS, zeros. lost: (n,) whether how the sensor turned in
    the step before a sample is not known."""
    iron = tried[0]
    quat = (0.0, 0.0, 0.0, 1.0)
    j = 0
    for i in range(1, len(stamps)):
        if lost[i]:
            interrupt(iron)
        while j < len(mags) and mag_stamps[j] < stamps[i]:
            if mag_stamps[j] >= stamps[i - 1] and not lost[i]:
                turn = quat_exp(gyr[i - 1], (mag_stamps[j] - stamps[i - 1]) * 1e-9)
                then = quat_multiply(quat, turn)
                if not is_stale(repeats[0], mag_stamps[j], mags[j], then, noise_sd):
                    add(iron, mag_stamps[j], then, mags[j])
            j += 1
        mean = (0.5 * (gyr[i - 1, 0] + gyr[i, 0]), 0.5 * (gyr[i - 1, 1] + gyr[i, 1]),
                0.5 * (gyr[i - 1, 2] + gyr[i, 2]))
        turn = quat_exp(mean, (stamps[i] - stamps[i - 1]) * 1e-9)
        quat = quat_normalize(quat_multiply(quat, turn))
    if iron.count > 0:
        _close(iron)
    return judge(iron, stated_sd)
