"""What is wrong with recorded samples: stamps, units, saturation, values that are no numbers.

Nothing here changes a sample. A :class:`Finding` says what was seen, where, and what to do
about it; nodes log it, the command line and the report print it.

Units are told by magnitude: the Earth's field has 22 to 67 microtesla (WMM), gravity 9.78 to
9.83 m/s^2, and both are always there.
"""

from dataclasses import dataclass

import numpy as np

from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, seconds

# Longer than this many usual intervals: at least one sample is missing.
GAP_FACTOR = 1.8
# At rest, consumer accelerometers are within a few percent of gravity.
_GRAVITY = 9.81
_GRAVITY_TOLERANCE = 0.15
_AS_QUIET = 1.5   # times the least spread, which scatters by a tenth in half a second at 100 Hz
# Median norms of a field measured on Earth, with room for magnets and lost calibrations.
_FIELD_T = (5e-6, 500e-6)
_EARTH_T = (20e-6, 70e-6)
# A flat top lasts three times as long as the values that the axis otherwise repeats (because
# its steps are coarse, or because a slow sensor is read too often); an axis with fewer
# distinct values than this is too coarse to tell.
_FLAT_TOP = 3
_DISTINCT = 20


@dataclass(frozen=True)
class Finding:
    """One thing worth knowing: ``kind`` (stamp, gap, nan, unit, axes, saturation, held, fix)
    and ``text`` for people."""

    kind: str
    text: str


@dataclass(frozen=True)
class Timing:
    """The stamps of one stream, in the order given.

    ``interval_s`` is the median of the positive intervals, ``jitter_s`` half the width of the
    central 68 % of them; ``gaps`` are intervals above GAP_FACTOR times the median.
    """

    count: int
    duration_s: float
    rate_hz: float
    interval_s: float
    jitter_s: float
    gaps: int
    longest_gap_s: float
    repeated: int
    backwards: int


@dataclass(frozen=True)
class FlatTop:
    """Samples of one axis that stand still at its extreme value ``limit``."""

    axis: int
    limit: float
    samples: int
    runs: int


def timing(stamp: np.ndarray) -> Timing:
    """Timing of a stream.

    Args:
        stamp: (n,) int64 ns in order of arrival.
    """
    stamp = np.asarray(stamp, dtype=np.int64)
    if len(stamp) < 2:
        return Timing(len(stamp), 0.0, np.nan, np.nan, np.nan, 0, np.nan, 0, 0)
    step = np.diff(stamp)
    forward = step[step > 0] * 1e-9
    duration = float(seconds(stamp.max(), stamp.min()))
    if len(forward) == 0:
        return Timing(len(stamp), duration, np.nan, np.nan, np.nan, 0, np.nan,
                      int(np.sum(step == 0)), int(np.sum(step < 0)))
    interval = float(np.median(forward))
    low, high = np.percentile(forward, [16, 84])
    gaps = forward[forward > GAP_FACTOR * interval]
    return Timing(
        count=len(stamp), duration_s=duration,
        rate_hz=(len(stamp) - 1) / duration, interval_s=interval,
        jitter_s=float(high - low) / 2, gaps=len(gaps),
        longest_gap_s=float(forward.max()), repeated=int(np.sum(step == 0)),
        backwards=int(np.sum(step < 0)))


def check_stamps(stamp: np.ndarray, name: str) -> list[Finding]:
    """Findings about the order, repetition and gaps of stamps (n,) int64 ns."""
    stamp = np.asarray(stamp, dtype=np.int64)
    result = []
    if len(stamp) and not stamp.any():
        return [Finding("stamp", f"{name}: all stamps are zero; the source does not set "
                                 "header.stamp, and nothing can be estimated from it")]
    times = timing(stamp)
    if times.backwards:
        first = int(np.flatnonzero(np.diff(stamp) < 0)[0]) + 1
        result.append(Finding("stamp", f"{name}: stamps go backwards {times.backwards} "
                                       f"time{_s(times.backwards)}, first at sample {first} "
                                       f"(stamp {stamp[first]} after {stamp[first - 1]})"))
    if times.repeated:
        first = int(np.flatnonzero(np.diff(stamp) == 0)[0]) + 1
        result.append(Finding("stamp", f"{name}: {times.repeated} stamp{_s(times.repeated)} "
                                       f"repeat the one before, first at sample {first}"))
    if times.gaps:
        result.append(Finding("gap", f"{name}: {times.gaps} gap{_s(times.gaps)} longer than "
                                     f"{GAP_FACTOR:g} usual intervals "
                                     f"({times.interval_s * 1e3:.4g} ms), the longest "
                                     f"{times.longest_gap_s:.3g} s"))
    return result


def check_finite(values: np.ndarray, name: str, quantity: str) -> list[Finding]:
    """A finding about rows (n, ...) that are not numbers."""
    values = np.asarray(values)
    values = values.reshape(len(values), int(np.prod(values.shape[1:])))
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad) == 0:
        return []
    return [Finding("nan", f"{name}: {len(bad)} of {len(values)} samples of {quantity} are not "
                           f"finite, first at sample {bad[0]}; they are left out")]


def flat_tops(values: np.ndarray, limit: float | None = None) -> list[FlatTop]:
    """Where axes stand still at their extreme: the mark of a saturated sensor.

    Args:
        values: (n, k).
        limit: the sensor's range, if it is known; without it, a run of samples at exactly the
            greatest or least value of the axis counts if it is three times as long as the runs
            of equal values that the axis has anyway, and the signal enters or leaves it by
            more than two of the axis's smallest steps (a round peak does not).

    Returns:
        list of FlatTop, negative ``limit`` for the lower end.
    """
    values = np.asarray(values, dtype=np.float64)
    result = []
    for axis in range(values.shape[1]):
        column = values[:, axis][np.isfinite(values[:, axis])]
        if len(column) == 0 or (limit is None and len(np.unique(column)) < _DISTINCT):
            continue
        if limit is None:
            step = np.diff(np.unique(column)).min()
            shortest = _FLAT_TOP * usual_run(column)
        for sign in (1.0, -1.0):
            signed = sign * column
            top = signed.max() if limit is None else limit
            starts, lengths = _runs(signed >= top)
            if limit is None:
                padded = np.concatenate([[top], signed, [top]])
                edge = top - np.minimum(padded[starts], padded[starts + lengths + 1])
                lengths = lengths[(lengths >= shortest) & (edge > 2 * step)]
            if len(lengths):
                result.append(FlatTop(axis, float(sign * top), int(lengths.sum()), len(lengths)))
    return result


def usual_run(values: np.ndarray) -> int:
    """How many times values (n,) or rows (n, k) usually stand before they change: 1 for a
    sensor that is read at its own rate, 3 for one that is read three times per measurement."""
    values = np.asarray(values).reshape(len(values), -1)
    changes = np.flatnonzero(np.any(values[1:] != values[:-1], axis=1))
    if len(changes) < 2:
        return 1
    # The 95th percentile is beyond the beat of two rates, and below rare flat tops.
    return max(int(np.percentile(np.diff(changes), 95)), 1)


def check_held(values: np.ndarray, stamp: np.ndarray, name: str) -> list[Finding]:
    """A finding if samples (n, k) are mostly repetitions of the one before."""
    values = np.asarray(values)
    if len(values) < 3:
        return []
    share = float(np.mean(np.any(values[1:] != values[:-1], axis=1)))
    if share > 0.6 or share == 0.0:
        return []
    return [Finding("held", f"{name}: only {share:.0%} of the samples differ from the one before: "
                            f"the sensor updates at about {timing(stamp).rate_hz * share:.3g} Hz")]


def check_saturation(values: np.ndarray, name: str, quantity: str, unit: str,
                     limit: float | None = None) -> list[Finding]:
    """Findings about flat tops of ``values`` (n, 3)."""
    return [Finding("saturation",
                    f"{name}: {quantity} {'xyz'[top.axis]} stands at {top.limit:.6g} {unit} for "
                    f"{top.samples} samples in {top.runs} run{_s(top.runs)}: saturated")
            for top in flat_tops(values, limit)]


def check_acceleration(acc: np.ndarray, stamp: np.ndarray, name: str) -> list[Finding]:
    """A finding if specific force (n, 3) is not in m/s^2, or has gravity removed.

    Judged at its quietest half seconds, where mostly gravity acts.
    """
    norm = _quiet_norm(acc, stamp)
    if not np.isfinite(norm):
        return []
    for unit, factor in (("g", _GRAVITY), ("mg", _GRAVITY * 1e-3)):
        if abs(norm * factor - _GRAVITY) < _GRAVITY_TOLERANCE * _GRAVITY:
            return [Finding("unit", f"{name}: acceleration at rest is {norm:.4g}, which is gravity "
                                    f"in {unit}, not in m/s^2; multiply by {factor:.6g}")]
    if norm < 0.3:
        return [Finding("unit", f"{name}: acceleration at rest is {norm:.2g} m/s^2: gravity has "
                                "been removed; record the specific force (Android: "
                                "accelerometer, not linear acceleration)")]
    if abs(norm - _GRAVITY) > _GRAVITY_TOLERANCE * _GRAVITY:
        return [Finding("unit", f"{name}: acceleration at its quietest is {norm:.4g} m/s^2, far "
                                "from gravity: check unit, range and calibration (or it never "
                                "rests)")]
    return []


def check_field(mag: np.ndarray, name: str) -> list[Finding]:
    """A finding if a magnetic flux density (n, 3) is not in tesla, or not like the Earth's."""
    norms = np.linalg.norm(np.asarray(mag, dtype=np.float64), axis=1)
    norms = norms[np.isfinite(norms)]
    if len(norms) == 0:
        return []
    norm = float(np.median(norms))
    if norm == 0.0:
        return [Finding("unit", f"{name}: the magnetic field is zero: no magnetometer behind it")]
    if _FIELD_T[0] <= norm <= _FIELD_T[1]:
        if _EARTH_T[0] <= norm <= _EARTH_T[1]:
            return []
        return [Finding("unit", f"{name}: the median field is {norm * 1e6:.4g} uT, the Earth's is "
                                "22 to 67 uT: calibrate the magnetometer or look for magnets")]
    # Units from large to small numbers; those of different decades cannot be confused.
    for unit, factor in (("microtesla", 1e-6), ("gauss", 1e-4), ("milligauss", 1e-7),
                         ("nanotesla", 1e-9)):
        if _EARTH_T[0] / 2 <= norm * factor <= _EARTH_T[1] * 2:
            return [Finding("unit", f"{name}: the median field is {norm:.4g}, which is the "
                                    f"Earth's in {unit}, not in tesla; multiply by {factor:g}")]
    return [Finding("unit", f"{name}: the median field is {norm:.4g} T, the Earth's is 22e-6 to "
                            "67e-6 T: not a magnetic field in tesla")]


def check_axes(imu: ImuLog, mag: MagLog, name: str) -> list[Finding]:
    """A finding if the field does not turn against the gyroscope as it must.

    The direction b of a constant field obeys ``db/dt = b x w`` in sensor axes (Winkler 2025,
    eq. B.3). The slope of the measured on the predicted change is 1; degrees per second give
    pi/180, a gyroscope of opposite sign or other axes something else. Both are summed over
    blocks of a tenth of a second, in which the field turns by more than the magnetometer's noise.
    """
    if len(imu) < 3 or len(mag) < 3:
        return []
    step = seconds(mag.stamp[1:], mag.stamp[0]) - seconds(mag.stamp[:-1], mag.stamp[0])
    norm = np.linalg.norm(mag.mag, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = mag.mag / norm[:, None]
    middle = seconds(mag.stamp[:-1], imu.stamp[0]) + 0.5 * step
    time = seconds(imu.stamp, imu.stamp[0])
    if np.any(np.diff(time) <= 0) or np.median(step) <= 0:
        return []  # check_stamps has said so
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
        return []
    product = float(predicted @ measured)
    slope = product / float(predicted @ predicted)
    correlation = product / np.sqrt(float(predicted @ predicted) * float(measured @ measured))
    if correlation > 0.5 and 0.5 < slope < 2.0:
        return []
    if correlation > 0.5 and 0.5 < np.degrees(slope) < 2.0:
        return [Finding("unit", f"{name}: the field turns {slope:.3g} times as fast as the "
                                "gyroscope says: angular velocity in deg/s; multiply by pi/180")]
    if correlation < -0.5:
        return [Finding("axes", f"{name}: the field turns with the gyroscope instead of against "
                                "it: one of them has its sign or axes reversed")]
    return []


def check_imu(log: ImuLog, name: str = "imu/data_raw") -> list[Finding]:
    """All findings about an ImuLog; that it lacks one of its two parts throughout is none."""
    parts = [(part, what) for part, what in ((log.gyr, "angular velocity"),
                                             (log.acc, "acceleration"))
             if np.isfinite(part).any()] or [(log.acc, "acceleration")]
    return [*check_stamps(log.stamp, name),
            *(finding for part, what in parts for finding in check_finite(part, name, what)),
            *check_acceleration(log.acc, log.stamp, name),
            *check_held(np.hstack([log.gyr, log.acc]), log.stamp, name),
            *check_saturation(log.gyr, name, "angular velocity", "rad/s"),
            *check_saturation(log.acc, name, "acceleration", "m/s^2")]


def check_mag(log: MagLog, name: str = "imu/mag") -> list[Finding]:
    """All findings about a MagLog."""
    return [*check_stamps(log.stamp, name), *check_finite(log.mag, name, "the magnetic field"),
            *check_field(log.mag, name), *check_held(log.mag, log.stamp, name),
            *check_saturation(log.mag, name, "the field", "T")]


def check_fix(log: FixLog, name: str = "fix") -> list[Finding]:
    """All findings about a FixLog."""
    position = np.column_stack([log.latitude_deg, log.longitude_deg, log.height])
    result = [*check_stamps(log.stamp, name)]
    without = int(np.sum(log.status == -1))
    if without:
        result.append(Finding("fix", f"{name}: {without} of {len(log)} messages have no fix "
                                     "(status -1); they are left out"))
    valid = log[log.status != -1]
    result += check_finite(position[log.status != -1], name, "position")
    outside = int(np.sum((np.abs(valid.latitude_deg) > 90) | (np.abs(valid.longitude_deg) > 180)))
    if outside:
        result.append(Finding("fix", f"{name}: {outside} positions lie outside of +-90 deg "
                                     "latitude, +-180 deg longitude; they are left out"))
    null = int(np.sum((valid.latitude_deg == 0) & (valid.longitude_deg == 0)))
    if null:
        result.append(Finding("fix", f"{name}: {null} positions are 0 deg, 0 deg: a receiver "
                                     "without a fix that says it has one; they are left out"))
    return result


def _s(count: int) -> str:
    return "" if count == 1 else "s"


def _runs(mask):
    """(first indices, lengths) of the runs of True in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2] - edges[::2]


def _quiet_norm(values, stamp):
    """Norm of (n, 3) in the half seconds in which it varies least; NaN if too short.

    Noise alone decides which of them is the quietest, and steady braking is as quiet as rest:
    the median of all that are nearly so.
    """
    norm = np.linalg.norm(np.asarray(values, dtype=np.float64), axis=1)
    finite = np.isfinite(norm)
    norm = norm[finite]
    interval = timing(np.asarray(stamp)[finite]).interval_s
    if not np.isfinite(interval):
        return np.nan
    window = max(int(round(0.5 / interval)), 2)
    if len(norm) < window:
        return np.nan
    blocks = norm[:len(norm) // window * window].reshape(-1, window)
    spread = blocks.std(axis=1)
    return float(np.median(blocks[spread <= _AS_QUIET * spread.min()].mean(axis=1)))
