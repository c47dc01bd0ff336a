"""Fixed-lag smoothing beside the causal filter: rows again, corrected by what came after.

The recording is cut into windows of the lag's length. When two are full, the smoother runs
over both from the filter's state at the start of the first, and the rows of the first are
final: each has seen between one and two lags of what followed it. A burst at a sensor's
limit is solved at once that way, live.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from imu_fusion.estimation.orientation.fixed_interval import smooth
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE

_Portion = tuple[np.ndarray, np.ndarray]    # stamps (n,) int64 ns, values (n, 6) or (n, 3)


@dataclass
class _Window:
    """The filter's state before the first sample, and what it was handed since."""

    start: int
    state: np.ndarray
    imus: list[_Portion] = field(default_factory=list)
    mags: list[_Portion] = field(default_factory=list)

    def copy(self) -> "_Window":
        return _Window(self.start, self.state, list(self.imus), list(self.mags))


class FixedLag:
    """Corrected rows of the fusion kernel.

    Args:
        lag: s.
    """

    def __init__(self, lag: float) -> None:
        self._lag = int(round(lag * 1e9))
        self._windows: list[_Window] = []
        self._rows: list[np.ndarray] = []

    def copy(self) -> "FixedLag":
        """One that goes on independently."""
        other = FixedLag(self._lag * 1e-9)
        other._windows = [window.copy() for window in self._windows]
        other._rows = list(self._rows)
        return other

    @property
    def border(self) -> int:
        """Stamp (ns) from which on a sample belongs to the next window."""
        return self._windows[-1].start + self._lag if self._windows else 0

    def cross(self, stamp: int, state: np.ndarray, par: np.ndarray) -> None:
        """A window begins: the filter is about to take the sample of ``stamp`` >= border."""
        if len(self._windows) == 2:
            self._correct(par)
        self._windows.append(_Window(stamp, state.copy()))

    def add_imu(self, stamps: np.ndarray, samples: np.ndarray) -> None:
        """Imu samples that the filter takes in this window, in any portions."""
        if len(stamps):
            self._windows[-1].imus.append((stamps, samples))

    def add_mag(self, stamps: np.ndarray, mags: np.ndarray) -> None:
        """Magnetometer samples, likewise."""
        if len(stamps) and self._windows:
            self._windows[-1].mags.append((stamps, mags))

    def finish(self, par: np.ndarray) -> None:
        """The end: all that is left is corrected by what there is."""
        while self._windows:
            self._correct(par)

    def keep(self, rows: np.ndarray) -> None:
        """Rows of before that nobody has taken yet."""
        self._rows.insert(0, rows)

    def take(self) -> np.ndarray:
        """Corrected rows since the last call, ORIENTATION_DTYPE."""
        rows, self._rows = self._rows, []
        return np.concatenate([np.zeros(0, ORIENTATION_DTYPE), *rows])

    def _correct(self, par: np.ndarray) -> None:
        first = self._windows.pop(0)
        windows = [first, *self._windows]
        stamps, samples = _joined([part for w in windows for part in w.imus], 6)
        mag_stamps, mags = _joined([part for w in windows for part in w.mags], 3)
        rows = np.zeros(len(stamps), ORIENTATION_DTYPE)
        written = smooth(first.state, par, stamps, samples, mag_stamps, mags, rows)
        rows = rows[:written]
        if self._windows:
            rows = rows[rows["stamp"] < self._windows[0].start]
        self._rows.append(rows)


def _joined(parts: Sequence[_Portion], width: int) -> _Portion:
    """Portions (stamps, values) as one."""
    return (np.concatenate([np.empty(0, np.int64), *(stamps for stamps, _ in parts)]),
            np.concatenate([np.empty((0, width)), *(values for _, values in parts)]))
