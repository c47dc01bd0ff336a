"""Do gyroscope, accelerometer and magnetometer tell of one rotation?

In axes that do not turn, gravity and the Earth's field stand still. So what a sensor says of them
is carried there by the gyroscope, over windows of a few seconds, and its spread is compared with
the spread under other hypotheses: rates in deg/s, reversed, axes exchanged. What accelerations and
iron add is the same under all; the hypothesis under which most of the spread goes away is right.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.samples.findings import Finding
from imu_fusion.samples.logs import ImuLog, MagLog, seconds

_WINDOW = 2.0           # s: the body turns, a bias hardly adds
_STEP = 0.01            # s of the integration
_MOST = 60              # windows that are looked at
_FEWEST = 3             # windows that prove anything
_TURNED = 0.5           # rad by which the direction must turn within a window
_BETTER = 0.5           # of the spread: what the right hypothesis leaves of it
_SHARE = 0.8            # of the windows in which it is better,
_PROOF = 5.0            # by so many standard errors
_EXPLAINED = 0.1        # of the spread is left where nothing is wrong and nothing disturbs
_EXACTLY = 1e-3         # where there is no noise, either
_GRAVITY = 9.81
_LEAST_TURN = 0.26      # rad: frames that differ by less are a matter of calibration
_PATH = 10.0            # rad that the rates say within a window: few sensors turn by more
_LIKE_GRAVITY = (0.7, 1.3)   # times 9.81 m/s^2: where the rates are that high, but the force is not
_RESTING = 0.35         # rad/s: no bias is that large (20 deg/s)
_STANDS = 0.05          # rad/s by which a direction may turn that stands still
_STUCK = 0.02           # of the field: a magnetometer that turned by 30 deg and did not change
_SCATTER = 0.3          # of its mean, by which the norm of a field may scatter while turning
_DEGREE = np.pi / 180.0


@dataclass(frozen=True, eq=False)
class Verdict:
    """What fits the turning of a direction.

    ``kind``: "unknown", too little turns; "fits", what was recorded; "rates in deg/s"; "axes",
    other axes. ``axes`` (3, 3): the right vector, in the axes of the other sensor, is axes @ what
    was recorded; ``angle`` rad by which these turn, nan where they are mirrored.
    """

    kind: str
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))

    @property
    def angle(self) -> float:
        """Of the rotation ``axes``."""
        rotation = scipy.spatial.transform.Rotation
        return float(rotation.from_matrix(self.axes).magnitude()) if np.linalg.det(self.axes) > 0 \
            else float("nan")

    @property
    def letters(self) -> str:
        """The axes as letters with signs, such as "y, x, -z"; empty for a rotation of no such
        kind."""
        if np.abs(np.abs(self.axes).max(axis=1) - 1.0).max() > 1e-6:
            return ""
        return ", ".join(("-" if row.sum() < 0.0 else "") + "xyz"[int(np.argmax(np.abs(row)))]
                         for row in self.axes)


class Windows:
    """Stretches of a recording in which a direction turns.

    ``rates`` (w, n, 3) rad/s and ``vectors`` (w, n, 3) of the other sensor, means over steps of
    ``step`` s. With ``gravity``, m/s^2: also those in which the rates alone say that it turns,
    while the vectors are about as long as that.
    """

    def __init__(self, stamp: np.ndarray, gyr: np.ndarray, vectors: np.ndarray,
                 gravity: float = 0.0) -> None:
        interval = float(np.median(np.diff(stamp))) * 1e-9 if len(stamp) > 1 else np.nan
        self.step = np.nan
        self.rates = self.vectors = np.empty((0, 0, 3))
        if not 0.0 < interval < 0.1 * _WINDOW:
            return
        group = max(int(round(_STEP / interval)), 1)
        size = max(int(round(_WINDOW / (group * interval))), 2)
        length = group * size
        count = len(stamp) // length
        if count == 0:
            return
        self.step = group * interval
        rows = slice(0, count * length)
        self.rates, self.vectors = (
            values[rows].reshape(count, size, group, 3).mean(axis=2) for values in (gyr, vectors))
        stamps = stamp[rows].reshape(count, length)
        whole = (np.abs(stamps[:, -1] - stamps[:, 0] - (length - 1) * interval * 1e9)
                 < 0.05 * length * interval * 1e9)
        whole &= np.isfinite(self.rates).all(axis=(1, 2)) & np.isfinite(
            self.vectors).all(axis=(1, 2))
        turned = self._turned()
        if gravity:
            path = self.step * np.linalg.norm(self.rates, axis=2).sum(axis=1)
            norm = np.median(np.linalg.norm(self.vectors, axis=2), axis=1) / gravity
            calm = (norm > _LIKE_GRAVITY[0]) & (norm < _LIKE_GRAVITY[1])
            turned = np.maximum(turned, np.where(calm & (path > _PATH), path / _PATH, 0.0))
        turned = np.where(whole, turned, 0.0)
        best = np.argsort(-turned, kind="stable")[:_MOST]
        best = best[turned[best] > _TURNED]
        self.rates, self.vectors = self.rates[best], self.vectors[best]

    def __len__(self) -> int:
        return len(self.rates)

    def keep(self, which: np.ndarray) -> None:
        """Only those of these numbers."""
        self.rates, self.vectors = self.rates[which], self.vectors[which]

    def _turned(self) -> np.ndarray:
        """Greatest angle (w,) between the means of four parts of each window."""
        parts = [part.mean(axis=1) for part in np.array_split(self.vectors, 4, axis=1)]
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = [part / np.linalg.norm(part, axis=1, keepdims=True) for part in parts]
        cosines = [np.sum(a * b, axis=1) for a, b in itertools.combinations(unit, 2)]
        return np.arccos(np.clip(np.nan_to_num(np.min(cosines, axis=0), nan=1.0), -1.0, 1.0))

    def turns(self, scale: float = 1.0) -> np.ndarray:
        """Rotations (w, n, 3, 3) from the axes of each step to those of the first."""
        w, n, _ = self.rates.shape
        rotation = scipy.spatial.transform.Rotation
        steps = rotation.from_rotvec((scale * self.step * self.rates).reshape(-1, 3))
        steps = steps.as_matrix().reshape(w, n, 3, 3)
        result = np.empty_like(steps)
        result[:, 0] = np.eye(3)
        for i in range(1, n):
            # Half of the turn of either step lies between their middles.
            half = rotation.from_rotvec(0.5 * scale * self.step
                                        * (self.rates[:, i - 1] + self.rates[:, i])).as_matrix()
            result[:, i] = result[:, i - 1] @ half
        return result


def spread(turns: np.ndarray, vectors: np.ndarray, with_bias: bool = False) -> np.ndarray:
    """Mean square (w,) by which vectors (w, n, 3), carried by turns (w, n, 3, 3), vary; with_bias:
    but for the one constant of the sensor that explains most."""
    carried = np.einsum("wnij,wnj->wni", turns, vectors)
    carried -= carried.mean(axis=1, keepdims=True)
    if with_bias:
        moved = turns - turns.mean(axis=1, keepdims=True)
        normal = np.einsum("wnki,wnkj->ij", moved, moved)
        bias = np.linalg.lstsq(normal, np.einsum("wnki,wnk->i", moved, carried), rcond=1e-2)[0]
        carried -= moved @ bias
    return np.asarray(np.mean(np.sum(carried ** 2, axis=2), axis=1))


def gravity_follows(stamp: np.ndarray, gyr: np.ndarray, acc: np.ndarray) -> bool:
    """Whether gravity turns exactly as the gyroscope says, and nothing else is felt, not even
    noise; by stamps (n,) ns, rates and specific forces (n, 3)."""
    windows = Windows(stamp, gyr, acc)
    if not len(windows):
        return False
    right = windows.turns()
    still = np.broadcast_to(np.eye(3), right.shape)
    return bool(np.median(spread(right, windows.vectors) / spread(still, windows.vectors))
                < _EXACTLY)


def gravity_verdict(imu: ImuLog) -> Verdict:
    """Whether gravity turns as the gyroscope says; ``axes`` of the verdict are the rates'."""
    windows = Windows(imu.stamp, imu.gyr, imu.acc, _GRAVITY)
    if len(windows) < _FEWEST:
        return Verdict("unknown")
    right = windows.turns()
    still = np.broadcast_to(np.eye(3), right.shape)
    recorded = spread(right, windows.vectors)
    if np.median(recorded / spread(still, windows.vectors)) < _EXPLAINED:
        return Verdict("fits")
    turns = {(scale, sign): windows.turns(scale * sign)
             for scale in (1.0, _DEGREE) for sign in (1.0, -1.0)}

    # Rates Q w turn by Q R(w) Q', if Q is a rotation; if it is mirrored, -Q is one.
    def spread_of(scale, axes):
        sign = 1.0 if np.linalg.det(axes) > 0.0 else -1.0
        return spread(turns[scale, sign], windows.vectors @ (sign * axes))

    found = [(spread_of(scale, axes), scale, axes)
             for scale in (1.0, _DEGREE) for axes in signed_permutations()]
    best, scale, axes = min(found, key=lambda each: each[0].sum())
    simple = spread_of(scale, np.eye(3))
    if simple.sum() < 1.2 * best.sum():
        best, axes = simple, np.eye(3)
    if scale == 1.0 and not is_better(best, recorded):
        best, axes = _best_rotation(lambda axes: spread_of(1.0, axes), axes)
    if not is_better(best, recorded):
        return Verdict("unknown")
    if scale != 1.0:
        return Verdict("rates in deg/s", axes)
    verdict = Verdict("axes", axes)
    return Verdict("unknown") if verdict.angle < _LEAST_TURN else verdict


def field_verdict(imu: ImuLog, mag: MagLog) -> Verdict:
    """Whether the field turns as the gyroscope says, for a magnetometer in other axes; ``axes`` of
    the verdict are those of the field."""
    time = seconds(imu.stamp, imu.stamp[0])
    if np.any(np.diff(time) <= 0.0) or len(mag) < 2:
        return Verdict("unknown")
    measured = seconds(mag.stamp, imu.stamp[0])
    fields = np.column_stack([np.interp(time, measured, mag.mag[:, i], left=np.nan, right=np.nan)
                              for i in range(3)])
    windows = Windows(imu.stamp, imu.gyr, fields)
    if len(windows) < _FEWEST:
        return Verdict("unknown")
    turns = windows.turns()
    recorded = spread(turns, windows.vectors, with_bias=True)
    still = np.broadcast_to(np.eye(3), turns.shape)
    if np.median(recorded / spread(still, windows.vectors)) < _EXPLAINED:
        return Verdict("fits")
    found = [(spread(turns, windows.vectors @ axes.T, with_bias=True), axes)
             for axes in signed_permutations()]
    best, axes = min(found, key=lambda each: each[0].sum())
    if not is_better(best, recorded):
        best, axes = _best_rotation(
            lambda axes: spread(turns, windows.vectors @ axes.T, with_bias=True), axes)
    if not is_better(best, recorded):
        return Verdict("unknown")
    verdict = Verdict("axes", axes)
    return Verdict("unknown") if verdict.angle < _LEAST_TURN else verdict


def is_better(best: np.ndarray, recorded: np.ndarray) -> bool:
    """Whether a hypothesis leaves so much less of the spread (w,), window by window, that neither
    accelerations nor the choice among many explain it."""
    gain = np.log(recorded) - np.log(best)
    proof = gain.mean() * np.sqrt(len(gain)) / max(float(gain.std()), 0.1)
    return bool(best.sum() < _BETTER * recorded.sum() and proof > _PROOF
                and np.mean(gain > 0) >= _SHARE)


def _best_rotation(spread_of, axes):
    """The rotation near (or far from) ``axes`` with the least spread, and that."""
    if np.linalg.det(axes) < 0.0:
        axes = -axes
    rotation = scipy.spatial.transform.Rotation
    found = scipy.optimize.minimize(
        lambda turn: spread_of(rotation.from_rotvec(turn).as_matrix() @ axes).sum(), np.zeros(3),
        method="Nelder-Mead", options={"maxfev": 120, "xatol": 1e-2, "fatol": 0.0,
                                       "initial_simplex": 0.4 * np.vstack([np.zeros(3),
                                                                           np.eye(3)])})
    axes = rotation.from_rotvec(found.x).as_matrix() @ axes
    return spread_of(axes), axes


def signed_permutations() -> list[np.ndarray]:
    """All 48, the identity first."""
    return [np.diag(signs) @ np.eye(3)[list(order)]
            for order in itertools.permutations(range(3))
            for signs in itertools.product((1.0, -1.0), repeat=3)]


def check_turning(imu: ImuLog, name: str) -> list[Finding]:
    """A finding if gravity does not turn as the gyroscope says."""
    if not (np.isfinite(imu.gyr).any() and imu.gyr.any() and imu.acc.any()):
        return []
    verdict = gravity_verdict(imu)
    if verdict.kind == "rates in deg/s":
        return [Finding("unit", f"{name}: gravity turns 57 times slower than the gyroscope says: "
                                "angular velocity in deg/s; multiply by pi/180", unusable=True)]
    if verdict.kind == "axes":
        if verdict.letters:
            how = (f"as if its axes x, y, z were ({verdict.letters}) of what the gyroscope calls "
                   "x, y, z")
        else:
            how = f"as if its axes were turned by {np.degrees(verdict.angle):.0f} deg"
        return [Finding("axes", f"{name}: gravity turns against the gyroscope {how}: gyroscope and "
                                "accelerometer are not in one frame; turn one into the axes of the "
                                "other before they become one message", unusable=True)]
    rate = _rate_at_rest(imu)
    if rate > _RESTING:
        return [Finding("unit", f"{name}: at rest the gyroscope reports {rate:.2g} rad/s, and "
                                "gravity does not turn: rates in deg/s (multiply by pi/180), or a "
                                "bias of that size")]
    return []


def _rate_at_rest(imu):
    """Median rate (rad/s) about horizontal axes in half seconds in which gravity stands still; nan
    if there are none."""
    interval = float(np.median(np.diff(imu.stamp))) * 1e-9 if len(imu) > 1 else np.nan
    if not 0.0 < interval < 0.05:
        return np.nan
    size = int(round(0.5 / interval))
    count = len(imu) // size
    gyr, acc = (values[:count * size].reshape(count, size, 3) for values in (imu.gyr, imu.acc))
    first, last = acc[:, :size // 2].mean(axis=1), acc[:, size // 2:].mean(axis=1)
    up = first + last
    with np.errstate(invalid="ignore", divide="ignore"):
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        turned = 2.0 * np.linalg.norm(np.cross(first, last), axis=1) / np.linalg.norm(
            first, axis=1) ** 2 / (size * interval)
        shaken = acc.std(axis=1).max(axis=1) / np.linalg.norm(first, axis=1)
    rates = np.linalg.norm(np.cross(gyr.mean(axis=1), up), axis=1)
    still = (turned < _STANDS) & (shaken < 0.02) & np.isfinite(rates)
    return float(np.median(rates[still])) if still.any() else np.nan


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
    return _scatter(imu, mag, name)


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
    if len(windows) < _FEWEST:
        return []
    field = np.nanmean(mag.mag, axis=0) / norm
    turned = spread(windows.turns(), np.broadcast_to(field, windows.vectors.shape))
    # Its direction would vary by as much.
    if np.median(turned) < _TURNED ** 2 / 12.0:
        return []
    return [Finding("held", f"{name}: the field does not change while the gyroscope turns: stuck, "
                            "or not on the same body; leave it out (remap the topic)",
                    unusable=True)]


def _scatter(imu, mag, name):
    """A finding on a field whose norm scatters while the body turns."""
    rates = np.linalg.norm(imu.gyr, axis=1)
    near = np.clip(np.searchsorted(imu.stamp, mag.stamp), 0, len(imu) - 1)
    norms = np.linalg.norm(mag.mag, axis=1)[rates[near] > _TURNED]
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
