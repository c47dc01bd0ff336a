"""Do gyroscope, accelerometer and magnetometer tell of one rotation?

In axes that do not turn, gravity and the Earth's field stand still. So what a sensor says of them
is carried there by the gyroscope, over windows of a few seconds, and its spread is compared with
the spread under other hypotheses: rates in deg/s, reversed, axes exchanged. What accelerations and
iron add is the same under all; the hypothesis under which most of the spread goes away is right.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.samples.findings import Finding
from imu_fusion.samples.logs import ImuLog

_WINDOW = 2.0           # s: the body turns, a bias hardly adds
_STEP = 0.01            # s of the integration
_MOST = 60              # windows that are looked at
FEWEST = 3             # windows that prove anything
TURNED = 0.5           # rad by which the direction must turn within a window
_BETTER = 0.5           # of the spread: what the right hypothesis leaves of it
_SHARE = 0.8            # of the windows in which it is better,
_PROOF = 5.0            # by so many standard errors
EXPLAINED = 0.1        # of the spread is left where nothing is wrong and nothing disturbs
_EXACTLY = 1e-3         # where there is no noise, either
_GRAVITY = 9.81
LEAST_TURN = 0.26      # rad: frames that differ by less are a matter of calibration
_PATH = 10.0            # rad that the rates say within a window: few sensors turn by more
_LIKE_GRAVITY = (0.7, 1.3)   # times 9.81 m/s^2: where the rates are that high, but the force is not
_RESTING = 0.35         # rad/s: no bias is that large (20 deg/s)
_STANDS = 0.05          # rad/s by which a direction may turn that stands still
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
        best = best[turned[best] > TURNED]
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
    if len(windows) < FEWEST:
        return Verdict("unknown")
    right = windows.turns()
    still = np.broadcast_to(np.eye(3), right.shape)
    recorded = spread(right, windows.vectors)
    if np.median(recorded / spread(still, windows.vectors)) < EXPLAINED:
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
        best, axes = best_rotation(lambda axes: spread_of(1.0, axes), axes)
    if not is_better(best, recorded):
        return Verdict("unknown")
    if scale != 1.0:
        return Verdict("rates in deg/s", axes)
    verdict = Verdict("axes", axes)
    return Verdict("unknown") if verdict.angle < LEAST_TURN else verdict


def is_better(best: np.ndarray, recorded: np.ndarray) -> bool:
    """Whether a hypothesis leaves so much less of the spread (w,), window by window, that neither
    accelerations nor the choice among many explain it."""
    gain = np.log(recorded) - np.log(best)
    proof = gain.mean() * np.sqrt(len(gain)) / max(float(gain.std()), 0.1)
    return bool(best.sum() < _BETTER * recorded.sum() and proof > _PROOF
                and np.mean(gain > 0) >= _SHARE)


def best_rotation(spread_of: Callable[[np.ndarray], np.ndarray],
                  axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least spread_of(axes) (w,) by a rotation near (or far from) ``axes`` (3, 3), and that."""
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
