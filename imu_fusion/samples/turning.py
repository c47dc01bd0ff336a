"""Do gyroscope, accelerometer and magnetometer tell of one rotation?

In axes that do not turn, gravity and the Earth's field stand still. So what a sensor says of them
is carried there by the gyroscope, over windows of a few seconds, and its spread is compared with
the spread under other hypotheses: rates in deg/s, reversed, axes exchanged. What accelerations and
iron add is the same under all; the hypothesis under which most of the spread goes away is right.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from imu_fusion.samples.logs import ImuLog, MagLog, seconds

_WINDOW = 2.0           # s: the body turns, a bias hardly adds
_STEP = 0.01            # s of the integration
_MOST = 60              # windows that are looked at
_FEWEST = 3             # windows that prove anything
_TURNED = 0.5           # rad by which the direction must turn within a window
_BETTER = 0.3           # of the spread: what the right hypothesis leaves of it
_SHARE = 0.8            # of the windows in which it is better
_EXPLAINED = 0.3        # of the spread that turning explains where nothing is wrong
_LEAST_TURN = 0.26      # rad: frames that differ by less are a matter of calibration
_DEGREE = np.pi / 180.0


@dataclass(frozen=True, eq=False)
class Verdict:
    """What fits the turning of a direction.

    ``kind``: "unknown", too little turns; "fits", what was recorded; "rates in deg/s"; "axes", other
    axes; "nothing". ``axes`` (3, 3): the right vector, in the axes of the other sensor, is axes @
    what was recorded; ``angle`` rad by which these turn, nan where they are mirrored.
    """

    kind: str
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))

    @property
    def angle(self) -> float:
        """Of the rotation ``axes``."""
        return float(Rotation.from_matrix(self.axes).magnitude()) if np.linalg.det(self.axes) > 0 \
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
    ``step`` s.
    """

    def __init__(self, stamp: np.ndarray, gyr: np.ndarray, vectors: np.ndarray) -> None:
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
        turned = np.where(whole, self._turned(), 0.0)
        best = np.argsort(-turned, kind="stable")[:_MOST]
        best = best[turned[best] > _TURNED]
        self.rates, self.vectors = self.rates[best], self.vectors[best]

    def __len__(self) -> int:
        return len(self.rates)

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
        steps = Rotation.from_rotvec((scale * self.step * self.rates).reshape(-1, 3))
        steps = steps.as_matrix().reshape(w, n, 3, 3)
        result = np.empty_like(steps)
        result[:, 0] = np.eye(3)
        for i in range(1, n):
            # Half of the turn of either step lies between their middles.
            half = Rotation.from_rotvec(0.5 * scale * self.step
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


def check_gravity(imu: ImuLog) -> Verdict:
    """Whether gravity turns as the gyroscope says; ``axes`` of the verdict are those of the rates.
    """
    windows = Windows(imu.stamp, imu.gyr, imu.acc)
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
    if scale == 1.0 and not _is_better(best, recorded):
        best, axes = _best_rotation(lambda axes: spread_of(1.0, axes), axes)
    if not _is_better(best, recorded):
        return Verdict("nothing" if best.sum() > recorded.sum() else "unknown")
    if scale != 1.0:
        return Verdict("rates in deg/s", axes)
    verdict = Verdict("axes", axes)
    return Verdict("unknown") if verdict.angle < _LEAST_TURN else verdict


def check_magnetic_axes(imu: ImuLog, mag: MagLog) -> Verdict:
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
    if not _is_better(best, recorded):
        best, axes = _best_rotation(
            lambda axes: spread(turns, windows.vectors @ axes.T, with_bias=True), axes)
    if not _is_better(best, recorded):
        return Verdict("unknown")
    verdict = Verdict("axes", axes)
    return Verdict("unknown") if verdict.angle < _LEAST_TURN else verdict


def _is_better(best, recorded):
    return (best.sum() < _BETTER * recorded.sum() and np.mean(best < recorded) >= _SHARE)


def _best_rotation(spread_of, axes):
    """The rotation near (or far from) ``axes`` with the least spread, and that."""
    if np.linalg.det(axes) < 0.0:
        axes = -axes
    found = minimize(
        lambda turn: spread_of(Rotation.from_rotvec(turn).as_matrix() @ axes).sum(), np.zeros(3),
        method="Nelder-Mead", options={"maxfev": 120, "xatol": 1e-2, "fatol": 0.0,
                                       "initial_simplex": 0.4 * np.vstack([np.zeros(3),
                                                                           np.eye(3)])})
    axes = Rotation.from_rotvec(found.x).as_matrix() @ axes
    return spread_of(axes), axes


def signed_permutations() -> list[np.ndarray]:
    """All 48, the identity first."""
    return [np.diag(signs) @ np.eye(3)[list(order)]
            for order in itertools.permutations(range(3))
            for signs in itertools.product((1.0, -1.0), repeat=3)]
