"""Rest and motion: when the ball was entrained, and when it stopped.

Winkler 2025 (section 4.1.1) aligns with the last 0.2 s before the entrainment. A recording has
more than one rest: the ball was carried there and is dug out later. The avalanche is what lies
between two rests and is the most violent.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import EstimationError
from imu_fusion.samples.logs import ImuLog, seconds

_WINDOW = 0.2        # s, that must be quiet around a sample at rest
_SHORTEST = 0.5      # s, of a rest
# Range of what is quiet within a window: four to five standard deviations of noise, so that of
# the sensors of the paper passes, and less than a body in motion shows.
_QUIET_RATE = 0.15   # rad/s
_QUIET_FORCE = 3.0   # m/s^2
# Free flight and steady sliding are quiet, too. At rest the force is gravity but for what an
# accelerometer errs by before it is calibrated, and the rate is a gyroscope's bias.
_FORCE_OFF = 1.5     # m/s^2
_RATE_OFF = 0.2      # rad/s
# The ball moves where the mean of a few samples deviates from the rest by more than this.
_ONSET_SDS = 5.5
_ONSET_FORCE = 0.15  # m/s^2, and at least by that
_ONSET_RATE = 0.02   # rad/s
_DYING_RATE = 0.5    # rad/s, from which on a spin is taken to die away
_MEAN_OFF = 0.2      # s, by which a mean that tells the stop may be off
_TIMES = np.geomspace(0.02, 2.0, 200)[:, None]   # s, in which it does
_STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class MotionSpan:
    """First sample of the motion, first of the rest after it (its end where there is none), and
    the rest before it as samples [rest_start, start); gyr_bias (3,) rad/s and force (3,) m/s^2,
    its means; ``begins_recording``: whether the recording begins with that rest."""

    rest_start: int
    start: int
    stop: int
    gyr_bias: np.ndarray
    force: np.ndarray
    begins_recording: bool = False


def find_motion(imu: ImuLog) -> MotionSpan:
    """The most violent motion between two rests.

    Args:
        imu: ImuLog, n samples.

    Raises:
        EstimationError: no rest, or nothing but rest.
    """
    time = seconds(imu.stamp, imu.stamp[0])
    step = float(np.median(np.diff(time)))
    width = max(int(round(_WINDOW / step)), 3)
    still = np.ones(len(imu), bool)
    for values, limit in ((imu.gyr, _QUIET_RATE), (imu.acc, _QUIET_FORCE)):
        high = scipy.ndimage.maximum_filter1d(values, width, axis=0, mode="nearest")
        low = scipy.ndimage.minimum_filter1d(values, width, axis=0, mode="nearest")
        still &= (high - low).max(axis=1) < limit
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    rests = [(a, b) for a, b in edges.reshape(-1, 2) if (b - a) * step >= _SHORTEST
             and abs(np.linalg.norm(imu.acc[a:b].mean(axis=0)) - _STANDARD_GRAVITY) < _FORCE_OFF
             and np.linalg.norm(imu.gyr[a:b].mean(axis=0)) < _RATE_OFF]
    if not rests:
        raise EstimationError(f"no rest of {_SHORTEST} s in the recording (still, force within "
                              f"{_FORCE_OFF} m/s^2 of gravity, rate below {_RATE_OFF} rad/s): the "
                              "ball's first attitude is not known; begin the recording before it "
                              "moves, calibrate what reads otherwise at rest")
    violence = np.concatenate([[0.0], np.cumsum(
        (np.linalg.norm(imu.acc, axis=1) - _STANDARD_GRAVITY) ** 2)])
    begins, ends = [b for _, b in rests], [a for a, _ in rests[1:]] + [len(imu)]
    which = int(np.argmax([violence[e] - violence[b] for b, e in zip(begins, ends)]))
    if begins[which] >= len(imu):
        raise EstimationError("nothing but rest in the recording: where is the motion?")
    rest_start, quiet_until, stop = rests[which][0], begins[which], ends[which]
    level = slice(max(rest_start, quiet_until - 10 * width), quiet_until)
    away = _away(imu, level, slice(quiet_until, stop), 3)
    start = quiet_until + int(np.argmax(away)) if away.any() else stop
    if which + 1 < len(rests):
        # What is quiet can still be coming to rest, ever more slowly: a longer mean tells when. And
        # it has been at rest for as long as its window reaches back.
        begin, end = rests[which + 1]
        rest, begin = slice((begin + end) // 2, end), max(start, begin - width // 2 - 1)
        away = _away(imu, rest, slice(begin, end), 3 * width // 2)
        slow = np.flatnonzero(away[:rest.start - begin])
        stop = _spin_ends(time, imu.gyr - imu.gyr[rest].mean(axis=0), begin,
                          begin + int(slow[-1]) + 1 if len(slow) else begin, end)
    return MotionSpan(level.start, start, stop, imu.gyr[level].mean(axis=0),
                      imu.acc[level].mean(axis=0), rest_start <= width)


def last_rest(imu: ImuLog, duration: float) -> int:
    """The sample from which on ``duration`` s of rest precede the most violent motion; 0 where the
    recording begins with that rest, or shows none."""
    good = np.flatnonzero(np.isfinite(imu.gyr).all(axis=1) & np.isfinite(imu.acc).all(axis=1))
    imu = imu[good]
    if len(imu) < 2:
        return 0
    try:
        motion = find_motion(imu)
    except EstimationError:
        return 0
    if motion.begins_recording:
        return 0
    begin = int(np.searchsorted(imu.stamp, imu.stamp[motion.start] - round(duration * 1e9)))
    return int(good[max(begin, motion.rest_start)])


def _spin_ends(time, rate, first, stop, end):
    """Sample at which a spin is down to the least rate that counts.

    There it is smaller than the noise of a sample. Drag takes a spin away in proportion to it, dry
    friction evenly: the likelier of both, about any axis, is fitted where it is larger, too.
    ``stop``, by a mean, stays where that is no explanation.

    Args:
        time: (n,) s. rate: (n, 3) rad/s, less that of the rest. first, end: samples within which
            the rest begins.
    """
    fast = np.flatnonzero(np.linalg.norm(rate[:end], axis=1) > _DYING_RATE)
    begin = min(int(fast[-1]) + 1, first) if len(fast) else first
    since, seen = time[begin:end] - time[begin], rate[begin:end]
    shapes = np.concatenate([np.exp(-since / _TIMES), np.maximum(1.0 - since / _TIMES, 0.0)])
    weight = np.sum(shapes ** 2, axis=1)
    size = np.linalg.norm(shapes @ seen, axis=1) / weight
    best = int(np.argmax(size ** 2 * weight))     # of the squares, what a shape explains
    larger = max(size[best] / _ONSET_RATE, 1.0)
    left = np.log(larger) if best < len(_TIMES) else 1.0 - 1.0 / larger
    ends = time[begin] + float(_TIMES[best % len(_TIMES), 0] * left)
    return int(np.searchsorted(time, ends)) if abs(ends - time[stop]) < _MEAN_OFF else stop


def _away(imu, level, part, width):
    """Mask of the samples of a part (slice) that deviate from the mean of a rest (slice ``level``),
    in the mean of ``width`` samples."""
    away = np.zeros(part.stop - part.start, bool)
    for values, least in ((imu.gyr, _ONSET_RATE), (imu.acc, _ONSET_FORCE)):
        mean, sd = values[level].mean(axis=0), values[level].std(axis=0)
        smooth = scipy.ndimage.uniform_filter1d(values[part] - mean, width, axis=0)
        limit = max(_ONSET_SDS * float(sd.max()) / np.sqrt(width), least)
        away |= np.linalg.norm(smooth, axis=1) > limit
    return away
