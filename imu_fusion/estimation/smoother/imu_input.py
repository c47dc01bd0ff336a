"""From logs to what the smoother starts from: where the world is, Imu samples with gaps bridged and
clipped readings flagged."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_fusion.errors import EstimationError, SampleError
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.flat_tops import ACC_FLOOR
from imu_fusion.samples.logs import FixLog, ImuLog
from imu_fusion.samples.motion_span import last_rest
from imu_fusion.samples.repeated_extremes import range_shown
from imu_fusion.surfaces.constraint import Surface

_FAR = 50e3   # m from the origin of a surface, where its plane of axes no longer describes it
_LEAST = 10   # Imu samples: of fewer, steps and noise of a sample have no meaning
#: m/s: who states less of the first speed says that the body rests.
AT_REST = 0.05
_BEFORE = 2.0      # s of rest, from which on a recording that begins in motion is smoothed
_FULL_SCALE = 0.999   # of a range from which on a reading counts as clipped: logs round it


def first_place(fix: FixLog | None, given: Sequence[float] | None) -> tuple[float, ...]:
    """Latitude, longitude (degrees) and height (m) of the start: as given, or the first usable
    fix.

    Raises:
        EstimationError: there is neither.
    """
    if given is not None:
        return tuple(given)
    if fix is None or not fix.usable.any():
        raise EstimationError("no valid GNSS fix: give the start (initial.position), or the "
                              "position cannot be estimated. Orientation alone is the job of the "
                              "orientation estimator")
    i = np.flatnonzero(fix.usable)[0]
    return float(fix.latitude_deg[i]), float(fix.longitude_deg[i]), float(fix.height[i])


def reference_frame(surface: Surface | None, first: tuple[float, ...]) -> LocalFrame:
    """The surface's frame, or one at the :func:`first_place`.

    Raises:
        EstimationError: the surface is elsewhere.
    """
    if surface is None:
        return LocalFrame(*first)
    away = float(np.linalg.norm(surface.origin.to_enu(*first)))
    if away > _FAR:
        raise EstimationError(
            f"the surface's origin is {away / 1e3:.0f} km from the start (latitude "
            f"{first[0]:.5f}, longitude {first[1]:.5f}): the surface is not that of this "
            "recording, or its origin is mistyped")
    return surface.origin


def from_start(imu: ImuLog, params: SmootherParams) -> ImuLog:
    """The Imu samples from ``initial.start`` on, or from the rest that is found in its place.

    Raises:
        SampleError: it lies behind them.
    """
    if params.initial.start is not None:
        begin = int(np.searchsorted(imu.stamp, imu.stamp[:1] + round(
            params.initial.start * 1e9))[0]) if len(imu) else 0
    elif params.initial.speed_sd < AT_REST:
        begin = last_rest(imu, _BEFORE)
    else:
        begin = 0
    if begin and begin > len(imu) - _LEAST:
        raise SampleError(f"initial.start: {params.initial.start} s lies at the end of the Imu "
                          "samples or behind it")
    return imu[begin:]


@dataclass(frozen=True)
class ImuInput:
    """Samples with gaps bridged: ``recorded`` (N,) tells the bridges, ``clipped`` (N, 6) the rates
    and forces out of range. ``noise`` (N - 1, 6): variance densities of the intervals.
    ``acc_range`` (3,) m/s^2, infinite where none was given and nothing shows one."""

    log: ImuLog
    recorded: np.ndarray
    clipped: np.ndarray
    noise: np.ndarray
    acc_range: np.ndarray

    @property
    def steps(self) -> np.ndarray:
        """dt (N - 1,) s."""
        return np.diff(self.log.stamp) * 1e-9

    @property
    def means(self) -> np.ndarray:
        """Mean rates and forces of the intervals (N - 1, 6)."""
        both = np.concatenate([self.log.gyr, self.log.acc], axis=1)
        return 0.5 * (both[1:] + both[:-1])


def prepare_imu(imu: ImuLog, params: SmootherParams) -> ImuInput:
    """Check the Imu samples, bridge gaps, flag what was clipped.

    Samples that are not finite are left out, and so is the second of two with one stamp.

    Raises:
        SampleError: stamps that go backwards, fewer than ten samples.
    """
    back = np.flatnonzero(np.diff(imu.stamp) < 0)
    if len(back):
        raise SampleError(f"Imu stamps go backwards after {imu.stamp[back[0]]} ns: sort the "
                          "recording or cut it there")
    good = np.isfinite(imu.gyr).all(axis=1) & np.isfinite(imu.acc).all(axis=1)
    good[1:] &= np.diff(imu.stamp) > 0
    imu = imu[good]
    if len(imu) < _LEAST:
        raise SampleError(f"{len(imu)} usable Imu samples: the smoother needs at least {_LEAST}")
    sensor, gap = params.sensor, params.gap
    acc_range = (range_shown(imu.acc, ACC_FLOOR) if sensor.acc_range is None
                 else np.broadcast_to(sensor.acc_range, 3))
    imu, recorded = _bridged(imu, params.gap.max)
    noise, clipped = [], []
    for values, limit, density, unknown in (
            (imu.gyr, sensor.gyro_range, sensor.gyro_noise_density, gap.gyro_noise_density),
            (imu.acc, acc_range, sensor.acc_noise_density, gap.acc_noise_density)):
        lost = np.repeat(~recorded[:, None], 3, axis=1)
        if limit is not None:
            lost |= np.abs(values) >= _FULL_SCALE * np.array(limit)
        clipped.append(lost & recorded[:, None])
        either = lost[1:] | lost[:-1]
        noise.append(np.where(either, unknown, density) ** 2)
    risen = _still_rising(imu.acc, clipped[1])
    steps = np.diff(imu.stamp)[:, None] * 1e-9
    noise[1] = np.maximum(noise[1], np.maximum(risen[1:], risen[:-1]) ** 2 * steps)
    if imu.gyr_sd is not None:
        sd = np.maximum(imu.gyr_sd[1:], imu.gyr_sd[:-1])
        noise[0] = np.maximum(noise[0], sd ** 2 * np.diff(imu.stamp)[:, None] * 1e-9)
    return ImuInput(imu, recorded, np.concatenate(clipped, axis=1), np.concatenate(noise, axis=1),
                    acc_range)


def _still_rising(acc: np.ndarray, clipped: np.ndarray) -> np.ndarray:
    """(n, 3) m/s^2: by how much forces may have been beyond the range in samples that were clipped,
    had they gone on to rise until the middle of them as they came; 0 elsewhere."""
    risen = np.zeros_like(acc)
    for i in range(3):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], clipped[:, i], [False]])))
        for first, end in edges.reshape(-1, 2):
            beside = acc[[max(first - 1, 0), min(end, len(acc) - 1)], i]
            step = np.abs(acc[first, i] - beside).max()
            risen[first:end, i] = 0.5 * (end - first + 1) * step
    return risen


def _bridged(imu: ImuLog, longest: float) -> tuple[ImuLog, np.ndarray]:
    """The log with samples at the usual step in its gaps (steps of more than ``longest`` s), on
    straight lines; mask of those recorded."""
    steps = np.diff(imu.stamp)
    nominal = int(np.median(steps))
    gaps = np.flatnonzero(steps > max(longest * 1e9, 1.5 * nominal))
    recorded = np.ones(len(imu), bool)
    if not len(gaps):
        return imu, recorded
    added = np.concatenate([
        np.arange(imu.stamp[g] + nominal, imu.stamp[g + 1] - nominal // 2, nominal) for g in gaps])
    stamp = np.concatenate([imu.stamp, added])
    order = np.argsort(stamp, kind="stable")
    recorded = np.concatenate([recorded, np.zeros(len(added), bool)])[order]
    since = stamp[order] - imu.stamp[0]

    def bridged(values: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(since, imu.stamp - imu.stamp[0], v) for v in values.T])

    sd = None if imu.gyr_sd is None else bridged(imu.gyr_sd)
    return replace(imu, stamp=stamp[order], gyr=bridged(imu.gyr), acc=bridged(imu.acc),
                   gyr_sd=sd), recorded
