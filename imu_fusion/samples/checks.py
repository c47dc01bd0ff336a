"""What is wrong with recorded samples: stamps, units, saturation, values that are no numbers.

Nothing here changes a sample. A :class:`Finding` says what was seen, where, and what to do
about it; nodes log it, the command line and the report print it.

Units are told by magnitude: the Earth's field has 22 to 67 microtesla (WMM), gravity 9.78 to
9.83 m/s^2, and both are always there.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import shown
from imu_fusion.samples.disagreement import check_agreement
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.flat_tops import ACC_FLOOR, GYRO_FLOOR, MAG_FLOOR, flat_tops
from imu_fusion.samples.lasting_errors import check_force_errors
from imu_fusion.samples.logs import AccelerometerLog, FixLog, ImuLog, MagLog
from imu_fusion.samples.standing import check_standing
from imu_fusion.samples.travel import check_alternating
from imu_fusion.samples.turning import check_turning

# Longer than this many usual intervals: at least one sample is missing.
GAP_FACTOR = 1.8
# At rest, consumer accelerometers are within a few percent of gravity.
_GRAVITY = 9.81
_GRAVITY_TOLERANCE = 0.15
_AS_QUIET = 1.5   # times the least spread, which scatters by a tenth in half a second at 100 Hz
# Median norms of a field measured on Earth, with room for magnets and lost calibrations.
_FIELD_T = (5e-6, 500e-6)
_EARTH_T = (20e-6, 70e-6)
_ENOUGH = 20        # samples of which all lack something
_HALVES = 0.2       # share of messages that hold one half alone
_TURNED = 0.2       # rad: more than a sensor at rest does
_UPSIDE_DOWN = 0.9  # share of gravity along -z
_COARSE = 15.0      # m: GNSS under trees or in streets states less


@dataclass(frozen=True)
class Timing:
    """The stamps of one stream, in the order given.

    ``first`` and ``last`` are the least and the greatest of them, int ns, 0 without any;
    ``interval_s`` is the median of the positive intervals, ``jitter_s`` half the width of the
    central 68 % of them; ``gaps`` are intervals above GAP_FACTOR times the median.
    """

    count: int
    first: int
    last: int
    interval_s: float
    jitter_s: float
    gaps: int
    longest_gap_s: float
    repeated: int
    backwards: int

    @property
    def duration_s(self) -> float:
        """From the first to the last."""
        return (self.last - self.first) * 1e-9

    @property
    def rate_hz(self) -> float:
        """Mean rate, nan where no time passes."""
        return (self.count - 1) / self.duration_s if self.last > self.first else np.nan

    def followed_by(self, later: "Timing") -> "Timing":
        """Of this stretch and a next one, which begins with the last stamp of this one; what is
        usual is that of the first."""
        usual = later if np.isnan(self.interval_s) else self
        return Timing(
            self.count + later.count - 1, min(self.first, later.first), max(self.last, later.last),
            usual.interval_s, usual.jitter_s, self.gaps + later.gaps,
            float(np.fmax(self.longest_gap_s, later.longest_gap_s)),
            self.repeated + later.repeated, self.backwards + later.backwards)


def timing(stamp: np.ndarray) -> Timing:
    """Timing of a stream.

    Args:
        stamp: (n,) int64 ns in order of arrival.
    """
    stamp = np.asarray(stamp, dtype=np.int64)
    if len(stamp) == 0:
        return Timing(0, 0, 0, np.nan, np.nan, 0, np.nan, 0, 0)
    ends = int(stamp.min()), int(stamp.max())
    step = np.diff(stamp)
    repeated, backwards = int(np.sum(step == 0)), int(np.sum(step < 0))
    forward = step[step > 0] * 1e-9
    if len(forward) == 0:
        return Timing(len(stamp), *ends, np.nan, np.nan, 0, np.nan, repeated, backwards)
    interval = float(np.median(forward))
    low, high = np.percentile(forward, [16, 84])
    gaps = forward[forward > GAP_FACTOR * interval]
    return Timing(len(stamp), *ends, interval, float(high - low) / 2, len(gaps),
                  float(forward.max()), repeated, backwards)


def check_stamps(stamp: np.ndarray, name: str) -> list[Finding]:
    """Findings about the order, repetition and gaps of stamps (n,) int64 ns."""
    stamp = np.asarray(stamp, dtype=np.int64)
    result = []
    if len(stamp) and not stamp.any():
        return [Finding("stamp", f"{name}: all stamps are zero; the source does not set "
                                 "header.stamp, and nothing can be estimated from it",
                        unusable=True)]
    negative = int((stamp < 0).sum())
    if negative:
        result.append(Finding("stamp", f"{name}: {negative} stamp{_s(negative)} below zero, the "
                                       f"least {stamp.min()}: these samples are left out"))
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


def check_clock(stamp: np.ndarray, imu_stamp: np.ndarray, name: str) -> list[Finding]:
    """A finding if a topic lies beside the Imu's time altogether: stamps (n,) and (m,) int64 ns."""
    if len(stamp) < 2 or len(imu_stamp) < 2:
        return []
    first, last = int(imu_stamp.min()), int(imu_stamp.max())
    if ((stamp >= first) & (stamp <= last)).any():
        return []
    ahead = (int(np.median(stamp)) - int(np.median(imu_stamp))) * 1e-9
    return [Finding("stamp", f"{name}: no sample lies within the Imu's time; its stamps are "
                             f"{abs(ahead):.3g} s {'later' if ahead > 0 else 'earlier'}: another "
                             "clock, and none of it can be used with the Imu")]


def check_finite(values: np.ndarray, name: str, quantity: str) -> list[Finding]:
    """A finding about rows (n, ...) that are not numbers."""
    values = np.asarray(values)
    values = values.reshape(len(values), int(np.prod(values.shape[1:])))
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad) == 0:
        return []
    return [Finding("nan", f"{name}: {len(bad)} of {len(values)} samples of {quantity} are not "
                           f"finite, first at sample {bad[0]}; they are left out")]


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
                     floor: float) -> list[Finding]:
    """Findings about flat tops of ``values`` (n, 3); ``floor`` see :func:`.flat_tops`."""
    return [Finding("saturation",
                    f"{name}: {quantity} {'xyz'[top.axis]} stands at {top.limit:.6g} {unit} for "
                    f"{top.samples} samples in {top.runs} run{_s(top.runs)}: saturated")
            for top in flat_tops(values, floor)]


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


def check_parts(gyr: np.ndarray, acc: np.ndarray, name: str) -> list[Finding]:
    """Findings about rates and specific forces (n, 3) of one Imu that are exactly zero: parts that
    the sensor does not have, or that come in messages of their own. Without rates a sensor that
    never turns is as well described."""
    known = np.isfinite(gyr).all(axis=1) & np.isfinite(acc).all(axis=1)
    if known.sum() < _ENOUGH:
        return []
    turns, feels = gyr[known].any(axis=1), acc[known].any(axis=1)
    if not turns.any() and feels.any():
        return [Finding(
            "lacking", f"{name}: angular velocity is exactly zero throughout: no gyroscope behind "
            "it. Cameras such as RealSense send it on a topic of its own (.../gyro/sample beside "
            ".../accel/sample): have the driver unite them (unite_imu_method: 2) and take that "
            "topic", unusable=_turns(acc[known]))]
    alone = np.mean(turns & ~feels), np.mean(feels & ~turns)
    if min(alone) > _HALVES:
        return [Finding(
            "lacking", f"{name}: {alone[0]:.0%} of the messages hold an angular velocity alone and "
            f"{alone[1]:.0%} a specific force alone, the rest of them zeros: two halves of one "
            "sensor; have the driver unite them by interpolation (RealSense: unite_imu_method: 2)",
            unusable=True)]
    return []


def _turns(acc):
    """Whether specific forces (n, 3) turn, by means over tenths of the recording."""
    means = np.array([part.mean(axis=0) for part in np.array_split(acc, 10)])
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)
    return bool((means @ means.T).min() < np.cos(_TURNED))


def check_gravity_sign(acc: np.ndarray, stamp: np.ndarray, name: str) -> list[Finding]:
    """A finding if the quietest specific force (n, 3) points along -z."""
    force = _quiet_mean(acc, stamp)
    size = float(np.linalg.norm(force))
    # Quiet moments that point everywhere are no rest.
    if not force[2] < -_UPSIDE_DOWN * size or size < _UPSIDE_DOWN * _quiet_norm(acc, stamp):
        return []
    return [Finding("axes", f"{name}: at rest -z is up ({force[2]:.4g} of {size:.4g} m/s^2): the "
                            "sensor lies upside down, or the sign of the specific force is "
                            "reversed (at rest it points up, REP 145)")]


def check_frames(frame_ids: Collection[str], name: str) -> list[Finding]:
    """A finding if messages of one topic name several frames."""
    named = sorted(set(frame_ids))
    if len(named) < 2:
        return []
    return [Finding("frame", f"{name}: messages of {len(named)} frames ("
                             + ", ".join(f"'{shown(frame, 60)}'" for frame in named[:4])
                             + "): several sensors on one topic; give each one of its own",
                    unusable=True)]


def check_accelerometer(log: AccelerometerLog | ImuLog, name: str,
                        feels_gravity: bool = True) -> list[Finding]:
    """All findings about an accelerometer alone, whose axes may point anywhere."""
    return [*check_stamps(log.stamp, name),
            *check_finite(log.acc, name, "acceleration"),
            *(check_acceleration(log.acc, log.stamp, name) if feels_gravity else ()),
            *check_held(log.acc, log.stamp, name),
            *check_saturation(log.acc, name, "acceleration", "m/s^2", ACC_FLOOR)]


def check_imu(log: ImuLog, name: str = "imu/data_raw") -> list[Finding]:
    """All findings about an ImuLog; that it lacks one of its two parts throughout is none."""
    if not np.isfinite(log.gyr).any():
        return check_accelerometer(log, name)
    parts = [(part, what) for part, what in ((log.gyr, "angular velocity"),
                                             (log.acc, "acceleration"))
             if np.isfinite(part).any()]
    return [*check_stamps(log.stamp, name),
            *(finding for part, what in parts for finding in check_finite(part, name, what)),
            *check_parts(log.gyr, log.acc, name),
            *check_acceleration(log.acc, log.stamp, name),
            *check_gravity_sign(log.acc, log.stamp, name),
            *(check_standing(log, name) or check_turning(log, name)
              or check_agreement(log, name) or check_force_errors(log, name)),
            *check_held(np.hstack([log.gyr, log.acc]), log.stamp, name),
            *check_saturation(log.gyr, name, "angular velocity", "rad/s", GYRO_FLOOR),
            *check_saturation(log.acc, name, "acceleration", "m/s^2", ACC_FLOOR)]


def check_mag(log: MagLog, name: str = "imu/mag") -> list[Finding]:
    """All findings about a MagLog."""
    return [*check_stamps(log.stamp, name), *check_finite(log.mag, name, "the magnetic field"),
            *check_field(log.mag, name), *check_held(log.mag, log.stamp, name),
            *check_saturation(log.mag, name, "the field", "T", MAG_FLOOR)]


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
    usable = log[log.usable]
    return [*result, *check_held(position[log.usable], usable.stamp, name),
            *check_alternating(usable, name), *_check_coarse(usable, name)]


def _check_coarse(log, name):
    """Fixes that say of themselves that they are no GNSS."""
    variance = np.trace(log.cov_enu[:, :2, :2], axis1=1, axis2=2) / 2
    sd = np.sqrt(variance[variance > 0])
    if not len(sd) or np.median(sd) < _COARSE:
        return []
    return [Finding("fix", f"{name}: the positions state standard deviations of {sd.min():.0f} to "
                           f"{sd.max():.0f} m, {np.median(sd):.0f} m as a rule: of a telephone "
                           "network or a receiver indoors, whose errors stay for minutes "
                           "(gnss.position_error_sd). Places and speeds made of them are guesses: "
                           "record under the open sky, or leave the trajectory out "
                           "(--without smoother)")]


def _s(count: int) -> str:
    return "" if count == 1 else "s"


def _quiet_blocks(values, stamp):
    """Means (b, 4) of (n, 3) and its norm in the half seconds in which the norm varies least; none
    if there are too few samples.

    Noise alone decides which of them is the quietest, and steady braking is as quiet as rest: all
    that are nearly so.
    """
    values, stamp = np.asarray(values, dtype=np.float64), np.asarray(stamp)
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        values, stamp = values[finite], stamp[finite]
    interval = timing(stamp).interval_s
    window = max(int(round(0.5 / interval)), 2) if np.isfinite(interval) else 0
    if not 0 < window <= len(values):
        return np.empty((0, 4))
    blocks = values[:len(values) // window * window].reshape(-1, window, 3)
    norm = np.sqrt(np.einsum("bni,bni->bn", blocks, blocks))
    spread = norm.std(axis=1)
    quiet = spread <= _AS_QUIET * spread.min()
    return np.column_stack([blocks[quiet].mean(axis=1), norm[quiet].mean(axis=1)])


def _quiet_norm(values, stamp):
    """Norm of (n, 3) where it varies least; nan if there are too few samples."""
    blocks = _quiet_blocks(values, stamp)
    return float(np.median(blocks[:, 3])) if len(blocks) else np.nan


def _quiet_mean(values, stamp):
    """(3,) where the norm varies least; nan if there are too few samples."""
    blocks = _quiet_blocks(values, stamp)
    return np.median(blocks[:, :3], axis=0) if len(blocks) else np.full(3, np.nan)
