"""Does the Earth's field turn as the gyroscope says? As :mod:`.turning`, of a magnetometer."""

import numpy as np

from imu_fusion.samples.disagreement import check_field_agreement, field_windows
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.logs import ImuLog, MagLog, seconds
from imu_fusion.samples.turning import (
    EXPLAINED,
    FEWEST,
    LEAST_TURN,
    TURNED,
    Verdict,
    Windows,
    best_rotation,
    is_better,
    signed_permutations,
    spread,
)

_STUCK = 0.02           # of the field: a magnetometer that turned by 30 deg and did not change
_SCATTER = 0.3          # of its mean, by which the norm of a field may scatter while turning


def check_axes(imu: ImuLog, mag: MagLog, name: str) -> list[Finding]:
    """A finding if the field does not turn against the gyroscope as it must."""
    if len(imu) < 3 or len(mag) < 3 or not mag.mag.any() or np.any(np.diff(imu.stamp) <= 0):
        return []    # check_stamps and check_field have said so
    slope, correlation = _field_slope(imu, mag)
    if correlation > 0.5 and 0.5 < np.degrees(slope) < 2.0:
        return [Finding("unit", f"{name}: the field turns {slope:.3g} times as fast as the "
                                "gyroscope says: angular velocity in deg/s; multiply by pi/180",
                        unusable=True)]
    if correlation < -0.5:
        return [Finding("axes", f"{name}: the field turns with the gyroscope instead of against "
                                "it: one of them has its sign or axes reversed", unusable=True)]
    stuck = _stuck(imu, mag, name)
    if stuck:
        return stuck
    verdict = field_verdict(imu, mag)
    if verdict.kind == "axes":
        return [_other_axes(_northern(verdict, imu, mag), name)]
    return check_field_agreement(imu, mag, name) or _scatter(imu, mag, name)


def field_verdict(imu: ImuLog, mag: MagLog) -> Verdict:
    """Whether the field turns as the gyroscope says, for a magnetometer in other axes; ``axes`` of
    the verdict are those of the field."""
    windows = field_windows(imu, mag)
    if len(windows) < FEWEST:
        return Verdict("unknown")
    turns = windows.turns()
    recorded = spread(turns, windows.vectors, with_bias=True)
    still = np.broadcast_to(np.eye(3), turns.shape)
    if np.median(recorded / spread(still, windows.vectors)) < EXPLAINED:
        return Verdict("fits")
    found = [(spread(turns, windows.vectors @ axes.T, with_bias=True), axes)
             for axes in signed_permutations()]
    best, axes = min(found, key=lambda each: each[0].sum())
    if not is_better(best, recorded):
        best, axes = best_rotation(
            lambda axes: spread(turns, windows.vectors @ axes.T, with_bias=True), axes)
    if not is_better(best, recorded):
        return Verdict("unknown")
    verdict = Verdict("axes", axes)
    return Verdict("unknown") if verdict.angle < LEAST_TURN else verdict


def _northern(verdict, imu, mag):
    """The Verdict with the signs with which the field points down, as on the northern hemisphere:
    reversed, it stands still as well."""
    time, measured = seconds(imu.stamp, imu.stamp[0]), seconds(mag.stamp, imu.stamp[0])
    up = np.column_stack([np.interp(measured, time, imu.acc[:, i]) for i in range(3)])
    upwards = float(np.nanmean(np.sum((mag.mag @ verdict.axes.T) * up, axis=1)))
    return Verdict(verdict.kind, -verdict.axes) if upwards > 0.0 else verdict


def _other_axes(verdict, name):
    """Finding on a magnetometer in axes other than the gyroscope's."""
    matrix = ", ".join(f"{v:.3g}" for v in (verdict.axes + 0.0).ravel())
    how = (f"it fits if x, y, z of the Imu are ({verdict.letters}) of the magnetometer"
           if verdict.letters else
           "it fits if the magnetometer is turned" + (
               " and mirrored" if np.isnan(verdict.angle) else
               f" by {np.degrees(verdict.angle):.0f} deg"))
    if verdict.letters == "y, x, -z":
        how += " (an AK8963, as inside of an MPU-9250)"
    return Finding("axes", f"{name}: the field does not turn as the gyroscope says, {how}; on "
                           "the southern hemisphere with all signs reversed: turn it in the "
                           f"driver, or set sensor.mag_matrix: [{matrix}]", unusable=True)


def _stuck(imu, mag, name):
    """A finding on a magnetometer that does not change while the body turns."""
    if not np.isfinite(mag.mag).any(axis=0).all():
        return []
    norm = np.linalg.norm(np.nanmean(mag.mag, axis=0))
    if not np.nanstd(mag.mag, axis=0).max() < _STUCK * norm:
        return []
    windows = Windows(imu.stamp, imu.gyr, imu.acc)
    if len(windows) < FEWEST:
        return []
    field = np.nanmean(mag.mag, axis=0) / norm
    turned = spread(windows.turns(), np.broadcast_to(field, windows.vectors.shape))
    # Its direction would vary by as much.
    if np.median(turned) < TURNED ** 2 / 12.0:
        return []
    return [Finding("held", f"{name}: the field does not change while the gyroscope turns: stuck, "
                            "or not on the same body; leave it out (remap the topic)",
                    unusable=True)]


def _scatter(imu, mag, name):
    """A finding on a field whose norm scatters while the body turns."""
    rates = np.linalg.norm(imu.gyr, axis=1)
    near = np.clip(np.searchsorted(imu.stamp, mag.stamp), 0, len(imu) - 1)
    norms = np.linalg.norm(mag.mag, axis=1)[rates[near] > TURNED]
    norms = norms[np.isfinite(norms)]
    if len(norms) < 100:
        return []
    middle = float(np.median(norms))
    low, high = np.percentile(norms, [16, 84])
    scatter = float(high - low) / 2.0 / middle
    if scatter < _SCATTER:
        return []
    return [Finding("unit", f"{name}: the field's magnitude scatters by {scatter:.0%} while the "
                            "sensor turns: calibrate the magnetometer (service "
                            "calibrate_magnetometer), or look for iron near it")]


def _field_slope(imu, mag):
    """(slope, correlation) of the measured on the predicted change of the field's direction.

    The direction b of a constant field obeys ``db/dt = b x w`` in sensor axes (Winkler 2025,
    eq. B.3). The slope is 1; degrees per second give pi/180, a gyroscope of opposite sign or other
    axes something else. Both are summed over blocks of a tenth of a second, in which the field
    turns by more than the magnetometer's noise. (nan, nan) where nothing turns.
    """
    step = seconds(mag.stamp[1:], mag.stamp[0]) - seconds(mag.stamp[:-1], mag.stamp[0])
    norm = np.linalg.norm(mag.mag, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = mag.mag / norm[:, None]
    middle = seconds(mag.stamp[:-1], imu.stamp[0]) + 0.5 * step
    time = seconds(imu.stamp, imu.stamp[0])
    if np.any(np.diff(time) <= 0) or np.median(step) <= 0:
        return np.nan, np.nan
    gyr = np.column_stack([np.interp(middle, time, imu.gyr[:, i], left=np.nan, right=np.nan)
                           for i in range(3)])
    predicted = np.cross(0.5 * (direction[1:] + direction[:-1]), gyr) * step[:, None]
    measured = np.diff(direction, axis=0)
    unusable = (step <= 0) | (step > 0.2)
    predicted[unusable] = np.nan
    length = max(int(round(0.1 / np.median(step))), 1)
    blocks = len(step) // length
    predicted, measured = (
        change[:blocks * length].reshape(blocks, length, 3).sum(axis=1)
        for change in (predicted, measured))
    usable = np.isfinite(predicted).all(axis=1) & np.isfinite(measured).all(axis=1)
    predicted, measured = predicted[usable].ravel(), measured[usable].ravel()
    if not predicted.any() or not measured.any():
        return np.nan, np.nan
    product = float(predicted @ measured)
    slope = product / float(predicted @ predicted)
    correlation = product / np.sqrt(float(predicted @ predicted) * float(measured @ measured))
    return slope, correlation
