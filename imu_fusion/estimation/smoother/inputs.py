"""From logs to the arrays of the kernel: gaps bridged, saturation flagged, measurements
attached to samples and whitened, constraints evaluated."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError, SampleError
from imu_fusion.estimation.smoother.model import FIX, MAG, VELOCITY
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import ImuLog

_NO_FIX = ("no valid GNSS fix: position cannot be estimated. Orientation alone is the job of the "
           "orientation estimator")
_FAR = 50e3   # m from the origin of a surface, where its plane of axes no longer describes it
_MICRO = 1e6  # magnetic states and rows are kept in microtesla, near one in size


def reference_frame(surface, fix):
    """The surface's frame, or one at the first valid fix.

    Raises:
        EstimationError: no valid fix, or the surface is elsewhere.
    """
    valid = np.flatnonzero(valid_fixes(fix)) if fix is not None else ()
    if not len(valid):
        raise EstimationError(_NO_FIX)
    i = valid[0]
    first = float(fix.latitude_deg[i]), float(fix.longitude_deg[i]), float(fix.height[i])
    if surface is None:
        return LocalFrame(*first)
    away = float(np.linalg.norm(surface.origin.to_enu(*first)))
    if away > _FAR:
        raise EstimationError(
            f"the surface's origin is {away / 1e3:.0f} km from the first fix (latitude "
            f"{first[0]:.5f}, longitude {first[1]:.5f}): the surface is not that of this "
            "recording, or its origin is mistyped")
    return surface.origin


def valid_fixes(fix):
    """Mask (m,) of the fixes of a FixLog that say where they are."""
    return ((fix.status >= 0) & np.isfinite(fix.latitude_deg) & np.isfinite(fix.longitude_deg)
            & np.isfinite(fix.height))


@dataclass(frozen=True)
class ImuInput:
    """Samples with gaps bridged: ``recorded`` (N,) tells the bridges, ``clipped`` (N, 6) the rates
    and forces out of range. ``noise`` (N - 1, 6): variance densities of the intervals."""

    log: ImuLog
    recorded: np.ndarray
    clipped: np.ndarray
    noise: np.ndarray

    @property
    def steps(self):
        """dt (N - 1,) s."""
        return np.diff(self.log.stamp) * 1e-9

    @property
    def means(self):
        """Mean rates and forces of the intervals (N - 1, 6)."""
        both = np.concatenate([self.log.gyr, self.log.acc], axis=1)
        return 0.5 * (both[1:] + both[:-1])


def prepare_imu(imu, params):
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
    if len(imu) < 10:
        raise SampleError(f"{len(imu)} usable Imu samples: the smoother needs at least 10")
    steps = np.diff(imu.stamp)
    nominal = int(np.median(steps))
    gaps = np.flatnonzero(steps > max(params.gap.max * 1e9, 1.5 * nominal))
    recorded = np.ones(len(imu), bool)
    if len(gaps):
        extra = [np.arange(imu.stamp[g] + nominal, imu.stamp[g + 1] - nominal // 2, nominal)
                 for g in gaps]
        added = np.concatenate(extra)
        stamp = np.concatenate([imu.stamp, added])
        order = np.argsort(stamp, kind="stable")
        recorded = np.concatenate([recorded, np.zeros(len(added), bool)])[order]
        since = stamp[order] - imu.stamp[0]
        columns = [np.column_stack([np.interp(since, imu.stamp - imu.stamp[0], v[:, i])
                                    for i in range(3)]) for v in (imu.gyr, imu.acc)]
        imu = ImuLog(stamp=stamp[order], gyr=columns[0], acc=columns[1], frame_id=imu.frame_id)
    sides, clipped = [], []
    for values, limit, density, unknown in (
            (imu.gyr, params.sensor.gyro_range, params.sensor.gyro_noise_density,
             params.gap.gyro_noise_density),
            (imu.acc, params.sensor.acc_range, params.sensor.acc_noise_density,
             params.gap.acc_noise_density)):
        lost = np.repeat(~recorded[:, None], 3, axis=1)
        if limit is not None:
            # One part in a thousand below the limit: rounding of logged full-scale values.
            lost |= np.abs(values) >= 0.999 * np.array(limit)
        clipped.append(lost & recorded[:, None])
        either = lost[1:] | lost[:-1]
        sides.append(np.where(either, unknown, density) ** 2)
    return ImuInput(imu, recorded, np.concatenate(clipped, axis=1),
                    np.concatenate(sides, axis=1))


@dataclass(frozen=True)
class Measurements:
    """GNSS and magnetometer readings with whitening matrices; sorted when attached."""

    stamp: np.ndarray
    kind: np.ndarray
    value: np.ndarray
    whiten: np.ndarray
    loss: np.ndarray

    def bind(self, imu_stamp, fix_late, velocity_late):
        """Bind each reading to the sample before it.

        Args:
            imu_stamp: (N,) ns.
            fix_late, velocity_late: s by which the stamps of fixes and velocities are late.

        Returns:
            order (m,) of the readings used, start (N + 1,) where those of each sample begin.
        """
        stamp = self._taken(fix_late, velocity_late)
        inside = (stamp >= imu_stamp[0]) & (stamp <= imu_stamp[-1])
        order = np.flatnonzero(inside)
        order = order[np.lexsort((self.kind[order], stamp[order]))]
        sample = np.searchsorted(imu_stamp, stamp[order], side="right") - 1
        sample = np.minimum(sample, len(imu_stamp) - 2)
        return order, np.searchsorted(sample, np.arange(len(imu_stamp) + 1))

    def since(self, imu_stamp, order, start, fix_late, velocity_late):
        """Times (m,) s of bound readings after their samples."""
        sample_stamp = np.repeat(imu_stamp, np.diff(start))
        return (self._taken(fix_late, velocity_late)[order] - sample_stamp) * 1e-9

    def _taken(self, fix_late, velocity_late):
        late = np.zeros(3, np.int64)
        late[FIX], late[VELOCITY] = round(fix_late * 1e9), round(velocity_late * 1e9)
        return self.stamp - late[self.kind]


def _roots(given, default_sd, params, what):
    """Lower roots (m, 3, 3) of covariances: of the default where they are all zeros or not to be
    taken.

    Raises:
        SampleError: a covariance that is not positive definite.
    """
    cov = given.copy()
    unknown = ~np.any(cov, axis=(1, 2)) | (not params.gnss.covariances)
    cov[unknown] = np.diag(np.square(default_sd))
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise SampleError(f"a covariance of {what} is not positive definite (gnss.covariances: "
                          "false takes those of the parameters instead)") from None


def even_stamps(stamp):
    """Stamps on a straight line through those of readings taken at an even rate.

    A logger stamps a fix when it arrives; the receiver takes it at its own even epochs.

    Args:
        stamp: (m,) ns, ascending; epochs may be missing.

    Returns:
        (m,) ns. The mean lateness stays: it is the constant delay of the receiver.

    Raises:
        SampleError: a stamp lies half a period or more off the line.
    """
    if len(stamp) < 3:
        return stamp
    seconds = (stamp - stamp[0]) * 1e-9
    # A mean of the shorter half of the steps would be biased; jitter cancels over many steps.
    lag = min(10, len(stamp) - 1)
    period = float(np.median(seconds[lag:] - seconds[:-lag])) / lag
    epoch = np.empty(len(stamp))
    count, line = 0, 0.0
    for i, late in enumerate(seconds):
        count += max(1, round((late - line) / period)) if i else 0
        # The line follows slowly, since a single stamp jitters.
        expected = late if not i else line + (count - epoch[i - 1]) * period
        line = expected + 0.1 * (late - expected)
        epoch[i] = count
    slope, start = np.polyfit(epoch, seconds, 1)
    even = start + slope * epoch
    off = float(np.abs(even - seconds).max())
    if off >= 0.5 * slope:
        raise SampleError(f"GNSS stamps lie up to {off:.2f} s off even steps of {slope:.3f} s: "
                          "they are not taken at an even rate (gnss.even_stamps: false)")
    return stamp[0] + np.round(even * 1e9).astype(np.int64)


def spaced(stamp, interval):
    """Mask (m,) of readings that follow the last one taken by at least ``interval`` s.

    stamp: (m,) ns, ascending. The first reading is taken.
    """
    step = round(interval * 1e9)
    keep = np.zeros(len(stamp), bool)
    i = 0
    while i < len(stamp):
        keep[i] = True
        i = max(i + 1, int(np.searchsorted(stamp, stamp[i] + step)))
    return keep


def _gnss_readings(log, params):
    """Readings (FixLog or VelocityLog) to use, and their stamps (m,) ns."""
    stamp = even_stamps(log.stamp) if params.gnss.even_stamps else log.stamp
    keep = spaced(stamp, params.gnss.min_interval)
    return log[keep], stamp[keep]


def prepare_measurements(frame, mag, fix, velocity, params):
    """All readings as :class:`Measurements`; those that are not finite are left out.

    Raises:
        EstimationError: no fix at all.
    """
    parts = []
    if fix is not None:
        fix = fix[valid_fixes(fix)]
    if fix is None or len(fix) == 0:
        raise EstimationError(_NO_FIX)
    eye = np.eye(3)
    fix, stamp = _gnss_readings(fix, params)
    root = _roots(fix.cov_enu, params.gnss.fix_sd, params, "the fixes")
    parts.append((stamp, FIX, frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height),
                  root, params.gnss))
    if velocity is not None:
        velocity, stamp = _gnss_readings(
            velocity[np.isfinite(velocity.vel_world).all(axis=1)], params)
        root = _roots(velocity.cov_world, params.gnss.velocity_sd, params, "the velocities")
        parts.append((stamp, VELOCITY, velocity.vel_world, root, params.gnss))
    if mag is not None:
        mag = mag[np.isfinite(mag.mag).all(axis=1)]
        root = np.broadcast_to(params.sensor.mag_noise_sd * _MICRO * eye, (len(mag), 3, 3))
        parts.append((mag.stamp, MAG, mag.mag * _MICRO, root, params.mag))
    whiten = np.concatenate([np.linalg.inv(p[3]) for p in parts])
    return Measurements(
        stamp=np.concatenate([p[0] for p in parts]),
        kind=np.concatenate([np.full(len(p[0]), p[1]) for p in parts]),
        value=np.concatenate([p[2] for p in parts]), whiten=np.tril(whiten),
        loss=np.concatenate([np.full(len(p[0]), p[4].loss_scale ** 2 if p[4].loss == "cauchy" else np.inf)
                             for p in parts]))


def surface_points(position_world, quat_world_imu, lever_imu):
    """Points (N, 3) m that are held on the surface: p + R l.

    Args:
        position_world: (N, 3) m, of the sensor.
        quat_world_imu: (N, 4).
        lever_imu: l, (3,) or (N, 3) m. Zeros give ``position_world`` itself.
    """
    if not np.any(lever_imu):
        return position_world
    return position_world + Rotation.from_quat(quat_world_imu).apply(np.array(lever_imu))


def lever_gradient(start, gradient, quat_world_imu, lever_imu):
    """Derivatives of constraint rows at p + R l to the attitude and to the lever arm l.

    With a = R' g for a gradient g: a . (dtheta x l) = dtheta . (l x a), and a . dl.

    Args:
        start: (N + 1,) where the rows of each sample begin. gradient: (r, 3).
        quat_world_imu: (N, 4). lever_imu: (3,) or (N, 3) m.

    Returns:
        (r, 3) m/rad, of the rotation vector in imu axes, and (r, 3).
    """
    sample = np.repeat(np.arange(len(quat_world_imu)), np.diff(start))
    along = Rotation.from_quat(quat_world_imu[sample]).inv().apply(gradient)
    lever = np.broadcast_to(lever_imu, quat_world_imu[:, :3].shape)[sample]
    return np.cross(lever, along), along


def holds(constraint, stamp, events, windows, margin):
    """Mask (N,) of the samples at which a constraint holds: its phase of a jump, and the windows.

    Args:
        constraint, stamp, events: as of :func:`evaluate_constraints`.
        windows: s since the first stamp, start and stop in turn; empty: always.
        margin: s around the events in which heights are free.
    """
    late = np.int64(round(margin * 1e9)) if constraint.height else np.int64(0)
    active = np.ones(len(stamp), bool)
    if constraint.phase == "in_run":
        active = stamp <= events.takeoff - late
    elif constraint.phase == "landing":
        active = stamp >= events.touchdown + late
    if windows:
        # An odd number of bounds passed: inside of a window.
        bounds = np.round(np.array(windows) * 1e9).astype(np.int64)
        active = active & (np.searchsorted(bounds, stamp - stamp[0], side="right") % 2 == 1)
    return active


def evaluate_constraints(constraints, position_world, stamp, events, params):
    """Rows of all constraints on the samples where they hold.

    A row of every sample says as much per second at any rate of the Imu: the standard deviation
    of a constraint is that of rows ``surface.interval`` apart.

    Args:
        constraints: of the surface.
        position_world: (N, 3) m, in the frame of the surface, of the points held on it.
        stamp: (N,) ns.
        events: take-off and touch-down, or None when no constraint needs them.
        params: SmootherParams; ``jump.event_margin`` around the events heights are free.

    Returns:
        start (N + 1,), residual (r,), gradient (r, 3), sigma (r,), height (r,).
    """
    pieces = []
    # Samples beside a gap do not speak for it.
    step = np.gradient(stamp - stamp[0])
    step = np.minimum(step, max(params.gap.max * 1e9, 1.5 * np.median(step)))
    share = np.sqrt(params.surface.interval * 1e9 / step)
    for constraint in constraints:
        sample = np.flatnonzero(holds(constraint, stamp, events, params.surface.windows,
                                      params.jump.event_margin))
        if not len(sample):
            continue
        residual, gradient = constraint.evaluate(position_world[sample])
        keep = np.isfinite(residual)
        pieces.append((sample[keep], residual[keep], gradient[keep],
                       constraint.sigma * share[sample[keep]],
                       np.full(keep.sum(), constraint.height)))
    if not pieces:
        return (np.zeros(len(stamp) + 1, np.int64), np.empty(0), np.empty((0, 3)), np.empty(0),
                np.empty(0, bool))
    sample, *columns = (np.concatenate(c) for c in zip(*pieces))
    order = np.argsort(sample, kind="stable")
    start = np.searchsorted(sample[order], np.arange(len(stamp) + 1))
    return start, *(np.ascontiguousarray(c[order]) for c in columns)
